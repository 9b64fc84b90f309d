"""Child processes: calls with limits of time and memory, of which a crash ends one process and loses nothing else.

A child is a new program, because engines and threads do not survive a fork: this Python or another, with mbkit or
without. The two sides exchange messages of bytes; what they mean is for subclasses of `Child`. The other side is
`mbkit.engines.remote.served.serve.attend`.

No package does it. Pebble 5.2 ends the calls of a script without a guard and leaves orphans when the parent is killed;
loky 3.7 ends no call that hangs, and one crash takes all calls with it. Both want themselves on the other side.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import re
import select
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from mbkit import _process as _interrupt
from mbkit.errors import UnsupportedError

OUT_OF_MEMORY: Final = "it took more memory than allowed"
#: Wall-clock limit as a multiple of the CPU limit.
_WALL_SECONDS_PER_CPU_SECOND: Final = 4.0
#: Seconds until a process has started, and loaded its libraries.
START_SECONDS: Final = 120.0
#: Seconds that may pass between two parts of a message.
_MAX_SILENT_SECONDS: Final = 60.0


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerDiedError(RuntimeError):
    """The process ended without an answer: how, by which signal (such as SIGSEGV), and its last line of output.

    `ended` is what its status says, where `how` may know better.
    """

    def __init__(self, how: str, signal: str = "", last: str = "", ended: str = "") -> None:
        super().__init__(how)
        self.how, self.signal, self.last, self.ended = how, signal, last, ended


class WorkerTimeoutError(RuntimeError):
    """A call took longer than allowed; its process was ended after `seconds`."""

    def __init__(self, seconds: float) -> None:
        super().__init__(f"stopped after {seconds:.2g} s")
        self.seconds = seconds


class WorkerStartError(UnsupportedError):
    """Worker processes do not start here."""


class WorkerClosedError(RuntimeError):
    """The worker was closed by another thread."""


class Child:
    """A process that answers one message at a time, in a folder of its own below `home`, where its output goes.

    `generation` counts its starts: what an earlier one held is gone.
    """

    def __init__(self, home: Path | None = None) -> None:
        self._home, self._folder, self._output = home, Path(), ""
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: Connection[Any, Any] | None = None
        #: Length of the output before the current call.
        self._output_before = 0
        #: Whether the process owes an answer.
        self._busy = False
        self._closed = threading.Event()
        self.generation = 0

    def _command(self, handle: int) -> tuple[Sequence[str], Mapping[str, str] | None]:
        """Return how it is started, with the number of its channel, and in which environment (None: this one)."""
        raise NotImplementedError

    def _start(self, seconds: float) -> None:
        """Start the process, which has so long to get ready, unless one runs."""
        if self._closed.is_set():
            raise WorkerClosedError
        # An interrupted call would answer what nobody asks any more.
        if self._process is not None and (self._busy or self._process.poll() is not None):
            self.end()
        if self._process is not None:
            return
        ours, its = socket.socketpair()
        self._folder = Path(tempfile.mkdtemp(prefix="mbkit-", dir=self._home))
        self._output, self._busy = str(self._folder / "output"), True
        try:
            with its, open(self._output, "wb") as output:
                command, environment = self._command(its.fileno())
                try:
                    self._process = subprocess.Popen(
                        command,
                        cwd=self._folder,
                        # Nothing is written there: that it closes tells the process that its parent is gone.
                        stdin=subprocess.PIPE,
                        stdout=output,
                        stderr=output,
                        pass_fds=[its.fileno()],
                        env=environment,
                        # Ctrl-C is for its parent, and what it starts ends with it.
                        start_new_session=True,
                    )
                except OSError as error:
                    raise WorkerStartError(f"worker: a process cannot be started ({error})") from error
        except BaseException:
            ours.close()
            shutil.rmtree(self._folder, ignore_errors=True)
            raise
        # Neither side waits for ever for the rest of a message.
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(_MAX_SILENT_SECONDS), 0))
        self._channel, self._output_before = Connection(ours.detach()), 0
        self.generation += 1
        _running.add(self)
        if self._closed.is_set():
            self._kill()
        self._receive(seconds)
        self._busy = False

    def _send(self, message: bytes) -> None:
        """Send a message, whose answer is awaited then."""
        assert self._channel is not None
        self._busy = True
        with contextlib.suppress(OSError):
            self._output_before = os.stat(self._output).st_size
        try:
            self._channel.send_bytes(message)
        except BlockingIOError:
            self.end()
            raise WorkerTimeoutError(_MAX_SILENT_SECONDS) from None
        except OSError:
            raise self._end_dead() from None
        except BaseException:
            self.end()
            raise

    def _receive(self, seconds: float = inf, deadline: float = inf) -> bytes:
        """Return the next message, or end the process.

        It may take so many seconds of its processor time, four times as many of the wall's, and until `deadline` on
        `time.perf_counter`.
        """
        if self._process is None or self._channel is None:
            raise WorkerDiedError("the process is gone")
        spent, begun = _processor_seconds(self._process.pid) if seconds < inf else 0.0, time.perf_counter()
        end, last = begun + seconds, min(begun + _WALL_SECONDS_PER_CPU_SECOND * seconds, deadline)
        try:
            # `Connection.poll` makes such an object each time.
            coming = select.poll()
            coming.register(self._channel, select.POLLIN)
            # A poll knows no endless time: it is repeated each hour.
            while not coming.poll(1e3 * min(max(0.0, min(end, last) - time.perf_counter()), 3600.0)):
                if time.perf_counter() < min(end, last):
                    continue
                # On a busy machine the process may not have had its processor time.
                missing = seconds - (_processor_seconds(self._process.pid) - spent)
                if missing <= 0 or end >= last:
                    raise TimeoutError
                end = time.perf_counter() + max(missing, 0.05)
            return self._channel.recv_bytes()
        except (TimeoutError, BlockingIOError):
            self.end()
            raise WorkerTimeoutError(time.perf_counter() - begun) from None
        except (EOFError, OSError):
            raise self._end_dead() from None
        except BaseException:
            self.end()
            raise

    def _end_dead(self) -> RuntimeError:
        """Return the exception for a process that is gone."""
        assert self._process is not None
        code, output = None, b""
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self._process.wait(timeout=5.0)
        with contextlib.suppress(OSError):
            output = Path(self._output).read_bytes()[self._output_before :][-20_000:]
        self.end()
        return WorkerClosedError() if self._closed.is_set() else _death(code, output.decode("utf-8", "replace"))

    def _kill(self) -> None:
        """Kill the process and all that it started, if it is still there."""
        if (process := self._process) is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)

    def close(self) -> None:
        """End the process for good, from any thread; a call that is under way raises `WorkerClosedError`."""
        self._closed.set()
        self._kill()

    def end(self) -> None:
        """End the process and all that it started, and remove its folder; the next call starts another."""
        if self._process is not None:
            self._kill()
            self._process.wait()
            self._forget()
            shutil.rmtree(self._folder, ignore_errors=True)

    def _forget(self) -> None:
        """Forget the process, which has ended or belongs to the process that this is a fork of."""
        for end in (self._process.stdin if self._process else None, self._channel):
            if end is not None:
                end.close()
        self._process = self._channel = None
        self._busy = False
        _running.discard(self)


_running: Final[set[Child]] = set()


def _kill_all() -> None:
    for child in tuple(_running):
        child._kill()


def end_all() -> None:
    """End all processes that run."""
    for child in tuple(_running):
        child.end()


def _forget_all() -> None:
    for child in tuple(_running):
        if child._process is not None:
            # Nothing is left to wait for.
            child._process.returncode = 0
        child._forget()


atexit.register(end_all)
_interrupt.at_end(_kill_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_all)


def _processor_seconds(pid: int) -> float:
    """Return the processor time of a process, s; the wall's where the system does not say."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return time.perf_counter()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _death(code: int | None, output: str) -> WorkerDiedError:
    """Return how a process ended, from its status and its output."""
    lines = [line[:300] for text in output.splitlines() if (line := " ".join(text.split()))]
    ended, name = f"ended with status {code}", ""
    if code is None:
        ended = "gave up the connection"
    elif code < 0:
        with contextlib.suppress(ValueError):
            name = signal.Signals(-code).name
        name = name or f"signal {-code}"
        ended = f"died of {name}"
        # The output before Python's own report of the crash.
        crash = re.compile(r"Fatal Python error|Current thread|Thread 0x|Extension modules")
        lines = lines[: next((k for k, line in enumerate(lines) if crash.match(line)), None)]
    last = lines[-1] if lines else ""
    if "std::bad_alloc" in output or "MemoryError" in output or "out of memory" in output.lower():
        return WorkerDiedError(OUT_OF_MEMORY, "", last, ended)
    if code == -signal.SIGKILL:
        return WorkerDiedError("the process was killed, as systems do that have no memory left", name, last, ended)
    return WorkerDiedError(f"the process {ended}" + (f" ({last})" if last else ""), name, last, ended)
