"""The process that evaluates another version of an engine.

It is not a `mbkit.studies.worker.Worker`, which sends pickles of mbkit's objects to a process that imports mbkit: here
the other side has NumPy alone, of any version, and takes arrays and plain data (`remote.serve`). What a library prints
goes into a file, so that it cannot be taken for an answer.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from mbkit import _interrupt
from mbkit._check import Array
from mbkit._child_process import kill_child, start_child
from mbkit._fork import fork_safe
from mbkit.engines.versions.engine_version import EngineVersion
from mbkit.engines.versions.remote import serve
from mbkit.errors import EngineProcessError

#: Seconds until a library is loaded.
_START: Final = 120.0
#: The process ends itself after so many times the limit, in case nobody is left to end it.
_ALARM: Final = 2.0
#: Characters of its output that are read after it died.
_TAIL: Final = 4000
_SERVE: Final = Path(serve.__file__)


class RemoteError(Exception):
    """The engine refused a call; its message. Never leaves `mbkit.engines.versions`."""


class EngineProcess:
    """One process of a version of an engine, started by the first call; it holds any number of models.

    `generation` counts its starts: what an earlier one held is gone.
    """

    def __init__(self, version: EngineVersion) -> None:
        self.version, self.generation = version, 0
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._read: Callable[[int], bytes] | None = None
        self._folder = Path()
        self.owner = os.getpid()
        self._lock = fork_safe(threading.RLock())
        #: Models that nobody needs any more; a garbage collection may come in the middle of a call.
        self.unneeded: list[int] = []

    def call(
        self, name: str, arrays: Sequence[Array] = (), model: int = 0, seconds: float | None = None, **plain: Any
    ) -> tuple[dict[str, Any], list[Array]]:
        """Return the head and the arrays of the answer.

        Raises `RemoteError` where the engine refuses, and `EngineProcessError` where the process died or was ended
        after `seconds`; the next call starts another.
        """
        with self._lock:
            self._start()
            while self.unneeded:
                self._exchange("forget", (), self.unneeded.pop(), self.version.seconds, {})
            limit = self.version.seconds if seconds is None else seconds
            head, out = self._exchange(name, arrays, model, limit, plain)
        if "error" in head:
            raise RemoteError(head["error"])
        return head, out

    def start(self) -> int:
        """Start the process unless it runs, and return its generation."""
        with self._lock:
            self._start()
            return self.generation

    def _start(self) -> None:
        if self.owner != os.getpid():
            # A fork: the process belongs to the parent.
            self._process, self.owner = None, os.getpid()
        if self._process is not None and self._process.poll() is None:
            return
        self.end()
        python = self.version.interpreter()
        ours, its = socket.socketpair()
        self._folder = Path(tempfile.mkdtemp(prefix="mbkit-"))
        environment = {k: x for k, x in os.environ.items() if not k.startswith("PYTHON")}
        command = [str(python), "-E", "-s", str(_SERVE), str(its.fileno()), self.version.engine, str(self._folder)]
        try:
            self._process = start_child(command, self._folder, its, environment)
        except OSError as error:
            ours.close()
            shutil.rmtree(self._folder, ignore_errors=True)
            raise EngineProcessError(f"{self.version}: its interpreter {python} does not start ({error})") from None
        _interrupt.at_end(self._kill)
        self._channel, self._read = ours, serve.reader(ours)
        self.generation += 1
        self.unneeded.clear()
        self._receive(_START)

    def _exchange(
        self, name: str, arrays: Sequence[Array], model: int, limit: float, plain: dict[str, Any]
    ) -> tuple[dict[str, Any], list[Array]]:
        assert self._channel is not None
        head = {"call": name, "model": model, "with": plain, "alarm": _ALARM * limit}
        try:
            self._channel.settimeout(limit)
            self._channel.sendall(serve.packed(head, arrays))
        except TimeoutError:
            raise self._late(limit) from None
        except OSError:
            raise self._death() from None
        except BaseException:
            self.end()
            raise
        return self._receive(limit)

    def _receive(self, seconds: float) -> tuple[dict[str, Any], list[Array]]:
        assert self._channel is not None
        assert self._read is not None
        try:
            self._channel.settimeout(seconds)
            return serve.unpacked(self._read)
        except TimeoutError:
            raise self._late(seconds) from None
        except (EOFError, OSError):
            raise self._death() from None
        except BaseException:
            # An answer that nobody waits for would be taken for that of the next call.
            self.end()
            raise

    def _late(self, seconds: float) -> EngineProcessError:
        self.end()
        return EngineProcessError(
            f"{self.version}: its process was ended after {seconds:g} s without an answer; "
            "mbkit.engine(name, seconds=...) gives it longer"
        )

    def _death(self) -> EngineProcessError:
        """Return the error for a process that is gone, with its last line of output."""
        assert self._process is not None
        code, output = None, ""
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self._process.wait(timeout=5.0)
        with contextlib.suppress(OSError):
            output = (self._folder / "output").read_bytes()[-_TAIL:].decode("utf-8", "replace")
        self.end()
        how = f"ended with status {code}"
        if code is not None and code < 0:
            with contextlib.suppress(ValueError):
                how = f"died of {signal.Signals(-code).name}"
        lines = [" ".join(line.split()) for line in output.splitlines() if line.strip()]
        return EngineProcessError(f"{self.version}: its process {how}" + (f" ({lines[-1][:300]})" if lines else ""))

    def _kill(self) -> None:
        kill_child(self._process)

    def end(self) -> None:
        """End the process and remove its folder; the next call starts another."""
        process, channel = self._process, self._channel
        self._process = self._channel = self._read = None
        if process is None or channel is None:
            return
        kill_child(process)
        _interrupt.at_end(self._kill, remove=True)
        process.wait()
        channel.close()
        shutil.rmtree(self._folder, ignore_errors=True)


_processes: Final[dict[str, EngineProcess]] = {}
_keys: Final = itertools.count(1)


def process_of(version: EngineVersion) -> EngineProcess:
    """Return the process of a version in this process."""
    if version.name not in _processes:
        _processes[version.name] = EngineProcess(version)
    return _processes[version.name]


def new_key() -> int:
    """Return a number for a model that no other has."""
    return next(_keys)


def end(version: EngineVersion) -> None:
    """End the process of a version, where there is one."""
    if own := _processes.get(version.name):
        own.end()


def _end_all() -> None:
    for own in _processes.values():
        if own.owner == os.getpid():
            own.end()


atexit.register(_end_all)
