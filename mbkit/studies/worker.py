"""Worker processes: calls with limits of processor time and memory, of which a crash ends one and loses no other.

A worker is a new Python process: engines and threads do not survive a fork. It answers one call after the other, and
keeps what its modules keep in between.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import faulthandler
import os
import pickle
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor, as_completed
from functools import partial
from math import inf
from multiprocessing import spawn
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, TypeVar
from weakref import WeakSet

from mbkit import _interrupt
from mbkit._child_process import kill_child, start_child
from mbkit.engines.registry import registered_engines
from mbkit.errors import MbkitError, UnsupportedError
from mbkit.methods.registry import METHODS, registered_methods

T = TypeVar("T")

OUT_OF_MEMORY: Final = "it took more memory than allowed"
#: A call that computes little is ended after so many times its processor time on the wall's clock.
WALL_PER_CPU: Final = 4.0
#: Seconds until a worker has started.
_START: Final = 60.0
#: The longest and the shortest time between two looks at a worker, s.
_LONGEST_WAIT, _SHORTEST_WAIT = 3600.0, 0.05
#: Seconds after which a worker that nobody calls gives its memory back.
_IDLE: Final = 900.0
#: Characters of a worker's output that are read after it died.
_TAIL: Final = 20_000
#: Linux's prctl: the signal that a process gets when the thread that started it is gone.
_PR_SET_PDEATHSIG: Final = 1
#: That signal, SIGUSR1. Its handler is alarm(2), which takes the signal's number as seconds: time to remove the
#: folder, after which the kernel ends even a process that hangs in a library.
_PARENT_GONE: Final = 10
#: The folders of modules are known before the worker changes into its own folder.
_PROGRAM: Final = (
    "import sys; folder, *numbers = sys.argv[1:5]; sys.path[:] = sys.argv[5:]; "
    "from mbkit.studies.worker import _serve; _serve(folder, *map(int, numbers))"
)


class WorkerDiedError(RuntimeError):
    """The process ended without an answer: how, by which signal (such as SIGSEGV), and its last line of output."""

    def __init__(self, how: str, signal: str = "", last: str = "") -> None:
        super().__init__(how)
        self.how, self.signal, self.last = how, signal, last


class WorkerTimeoutError(RuntimeError):
    """A call took longer than allowed; its process was ended after `seconds`."""

    def __init__(self, seconds: float) -> None:
        super().__init__(f"stopped after {seconds:.2g} s")
        self.seconds = seconds


class WorkerStartError(UnsupportedError):
    """Worker processes do not start here."""


class WorkerClosedError(RuntimeError):
    """The worker was closed by another thread."""


class CallError(RuntimeError):
    """The worker cannot import the function or its arguments."""


class RemoteError(RuntimeError):
    """An exception of the function that cannot be sent as it is: its type and message."""


def describe(error: BaseException) -> str:
    """Return an exception in one line; errors of mbkit and of workers without their type."""
    plain = isinstance(error, (MbkitError, RemoteError, CallError))
    return " ".join((str(error) if plain else f"{type(error).__name__}: {error}").split())


class Worker:
    """A process that makes one call at a time in a folder below `home`; started by the first call.

    The worker removes `home` if the caller is killed.
    It may take `memory` bytes (Linux; 0: no limit), and ends with the thread that started it unless `outlives_thread`
    (Linux). `stage` is what the call last reported by `report_stage`.
    """

    def __init__(
        self,
        home: Path | None = None,
        memory: int = 0,
        environment: Mapping[str, str] | None = None,
        *,
        outlives_thread: bool = False,
    ) -> None:
        self._home, self._memory, self._environment = home, memory, environment
        self._follow = not outlives_thread
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: Connection[Any, Any] | None = None
        self._folder = Path()
        #: Length of the output before the current call.
        self._output_before = 0
        self._busy = False
        self._closed = threading.Event()
        self.stage = ""
        _workers.add(self)

    def call(
        self,
        function: Callable[..., T],
        *args: Any,
        cpu_seconds: float = inf,
        stage_seconds: Mapping[str, float] | None = None,
        deadline: float = inf,
    ) -> T:
        """Return the function's result, or raise its exception.

        Function and arguments are picklable. `cpu_seconds` limits the processor time, and four times as much the wall's
        clock; `stage_seconds` does so for stages that the function reports; `deadline` is on `time.perf_counter`.
        Raises `WorkerDiedError`, `WorkerTimeoutError` or `WorkerClosedError` when the process is gone (the next call
        starts another), `CallError` when it cannot import the function, `WorkerStartError` when none starts.
        """
        self.begin(function, *args)
        result: T = self.finish(cpu_seconds, stage_seconds, deadline)
        return result

    def begin(self, function: Callable[..., Any], *args: Any, alarm: float = 0.0) -> None:
        """Send a call, whose result `finish` waits for.

        After `alarm` seconds the process ends itself, in case its parent is gone; 0 for never.
        """
        if self._closed.is_set():
            raise WorkerClosedError
        call = pickle.dumps((registered_engines(), registered_methods(), function, args))
        # As multiprocessing has its children import the script that they were started from.
        main = spawn.get_preparation_data("mbkit") if b"__main__" in call else {}
        main = {k: x for k, x in main.items() if k.startswith("init_main")}
        # An interrupted call would answer what nobody asks any more.
        if self._process is not None and (self._busy or self._process.poll() is not None):
            self.end()
        try:
            if self._process is None:
                self._start()
            assert self._channel is not None
            self.stage, self._busy = "", True
            with contextlib.suppress(OSError):
                self._output_before = (self._folder / "output").stat().st_size
            try:
                self._channel.send((main, call, alarm))
            except OSError:
                raise self._end_dead() from None
        except BaseException:
            self.end()
            raise

    def finish(
        self,
        cpu_seconds: float = inf,
        stage_seconds: Mapping[str, float] | None = None,
        deadline: float = inf,
    ) -> Any:
        """Return the result of the call that was begun; see `call`."""
        limits = stage_seconds or {}
        try:
            while True:
                kind, value = self._receive(limits.get(self.stage, cpu_seconds), deadline)
                if kind != "stage":
                    break
                self.stage = value
        except BaseException:
            self.end()
            raise
        self._busy = False
        if kind == "error":
            raise value
        return value

    def _start(self) -> None:
        ours, its = socket.socketpair()
        self._folder = Path(tempfile.mkdtemp(prefix="mbkit-", dir=self._home))
        arguments = (self._home or self._folder, its.fileno(), self._memory, int(self._follow))
        command = [sys.executable, "-c", _PROGRAM, *map(str, arguments), *map(os.path.abspath, sys.path)]
        try:
            self._process = start_child(command, self._folder, its, self._environment)
        except OSError as error:
            ours.close()
            shutil.rmtree(self._folder, ignore_errors=True)
            raise WorkerStartError(f"worker: a process cannot be started ({error})") from None
        _interrupt.at_end(self._kill)
        self._channel, self._output_before = Connection(ours.detach()), 0
        if self._closed.is_set():
            self._kill()
        try:
            self._receive(_START, inf)
        except (WorkerDiedError, WorkerTimeoutError) as error:
            raise WorkerStartError(
                f"worker processes do not start: {error}; each needs some 300 MB of memory, "
                "and a Python with which mbkit can be imported"
            ) from None

    def _receive(self, seconds: float, deadline: float) -> Any:
        """Return the next message, within so many seconds of the process's time."""
        if self._process is None or self._channel is None:
            raise WorkerDiedError("the process is gone")
        spent, begun = _processor_seconds(self._process.pid), time.perf_counter()
        end, last = begun + seconds, min(begun + WALL_PER_CPU * seconds, deadline)
        while True:
            try:
                if self._channel.poll(min(max(0.0, min(end, last) - time.perf_counter()), _LONGEST_WAIT)):
                    return self._channel.recv()
            except (EOFError, OSError):
                raise self._end_dead() from None
            if time.perf_counter() < min(end, last):
                continue
            # On a busy machine the process may not have had its processor time.
            missing = seconds - (_processor_seconds(self._process.pid) - spent)
            if missing <= 0 or end >= last:
                self.end()
                raise WorkerTimeoutError(time.perf_counter() - begun)
            end = time.perf_counter() + max(missing, _SHORTEST_WAIT)

    def _end_dead(self) -> RuntimeError:
        """Return the exception for a process that is gone."""
        assert self._process is not None
        code, output = None, b""
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self._process.wait(timeout=5.0)
        with contextlib.suppress(OSError):
            output = (self._folder / "output").read_bytes()[self._output_before :][-_TAIL:]
        self.end()
        return WorkerClosedError() if self._closed.is_set() else _death(code, output.decode("utf-8", "replace"))

    def _kill(self) -> None:
        kill_child(self._process)

    def close(self) -> None:
        """End the process for good, from any thread; a call that is under way raises `WorkerClosedError`."""
        self._closed.set()
        self._kill()

    def end(self) -> None:
        """End the process and all that it started, and remove its folder; the next call starts another."""
        process, channel = self._process, self._channel
        if process is None or channel is None:
            return
        self._kill()
        _interrupt.at_end(self._kill, remove=True)
        process.wait()
        channel.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        self._process = self._channel = None
        self._busy = False

    def _detach(self) -> None:
        """Forget the process, in a fork of the process that started it."""
        if self._process is not None and self._channel is not None:
            _interrupt.at_end(self._kill, remove=True)
            self._channel.close()
            self._process.returncode = 0
            self._process = self._channel = None


_workers: Final[WeakSet[Worker]] = WeakSet()


def _each(do: Callable[[Worker], None]) -> None:
    for worker in list(_workers):
        do(worker)


atexit.register(_each, Worker.end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=partial(_each, Worker._detach))


def _processor_seconds(pid: int) -> float:
    """Return the processor time of a process, s; the wall's where the system does not say."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return time.perf_counter()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _death(code: int | None, output: str) -> WorkerDiedError:
    """Return how a process ended, from its status and its output."""
    if "std::bad_alloc" in output or "MemoryError" in output or "out of memory" in output.lower():
        return WorkerDiedError(OUT_OF_MEMORY)
    if code is None:
        return WorkerDiedError("the process gave up the connection")
    if code == -signal.SIGKILL:
        return WorkerDiedError("the process was killed, as systems do that have no memory left", "SIGKILL")
    lines = [line.strip()[:200] for line in output.splitlines() if line.strip()]
    name = ""
    if code < 0:
        with contextlib.suppress(ValueError):
            name = signal.Signals(-code).name
        name = name or f"signal {-code}"
        # What came before Python's own report of the crash.
        crash = re.compile(r"Fatal Python error|Current thread|Thread 0x|Extension modules")
        lines = lines[: next((k for k, line in enumerate(lines) if crash.match(line)), None)]
    how = f"the process died of {name}" if name else f"the process ended with status {code}"
    last = lines[-1] if lines else ""
    return WorkerDiedError(how + (f" ({last})" if last else ""), name, last)


# In the worker process

_to_parent: Connection[Any, Any] | None = None


def in_worker() -> bool:
    """Return whether this process is a worker."""
    return _to_parent is not None


def report_stage(name: str) -> None:
    """Report to the parent the part of a call that begins, which has its own time limit; without effect elsewhere."""
    if _to_parent is not None:
        _to_parent.send(("stage", name))


def _serve(folder: str, handle: int, memory: int, follow: int) -> None:
    """Answer calls from a file descriptor until the parent is gone; then remove the folder."""
    global _to_parent
    # Ctrl-C is the parent's.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if follow and sys.platform == "linux":
        libc = ctypes.CDLL(None)
        libc.signal(_PARENT_GONE, libc.alarm)
        libc.prctl(_PR_SET_PDEATHSIG, _PARENT_GONE)
    faulthandler.enable()
    _limit_memory(memory)
    _to_parent = channel = Connection(handle)
    ending = threading.Thread(target=_end_after_parent, args=(os.path.abspath(folder), handle), daemon=True)
    ending.start()
    try:
        channel.send(("ready", None))
        while channel.poll(_IDLE):
            main, call, alarm = channel.recv()
            # What hangs does not see that its parent is gone; the kernel ends it then.
            signal.setitimer(signal.ITIMER_REAL, alarm)
            answer = _answer(main, call)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            channel.send_bytes(answer)
    except (EOFError, OSError):
        ending.join()
    # Destructors of loaded libraries could only fail.
    os._exit(0)


def _end_after_parent(folder: str, handle: int) -> None:
    """Wait until the parent is gone, even if it was killed; remove the folder, end this process and what it started."""
    hang_up = select.poll()
    hang_up.register(handle, 0)
    hang_up.poll()
    shutil.rmtree(folder, ignore_errors=True)
    os.killpg(0, signal.SIGKILL)


def _answer(main: dict[str, Any], call: bytes) -> bytes:
    try:
        if main:
            spawn.prepare(main)
        # Unpickling registers the engines.
        _, methods, function, args = pickle.loads(call)
    except Exception as error:  # a user's module may raise anything
        return pickle.dumps(("error", CallError(describe(error))))
    METHODS.update((method.name, method) for method in methods)
    try:
        return pickle.dumps(("result", function(*args)))
    except BaseException as error:
        if isinstance(error, Exception):
            with contextlib.suppress(Exception):
                answer = pickle.dumps(("error", error))
                pickle.loads(answer)
                return answer
        return pickle.dumps(("error", RemoteError(describe(error))))


def _limit_memory(memory: int) -> None:
    import resource

    # A crash leaves no core file behind.
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if memory:
        # What is written to, not what LLVM and heyoka only reserve.
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        limit = memory if hard == resource.RLIM_INFINITY else min(memory, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


# Many calls


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerPool(ThreadPoolExecutor):
    """An executor of so many threads, each of which makes its calls in a worker of its own."""

    def __init__(self, jobs: int) -> None:
        super().__init__(jobs)
        self._idle = [Worker() for _ in range(jobs)]
        self._all = tuple(self._idle)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Make a call in one of the workers."""
        return super().submit(self._call, fn, args, kwargs)

    def _call(self, fn: Callable[..., T], args: tuple[Any, ...], kwargs: dict[str, Any]) -> T:
        worker = self._idle.pop()
        try:
            return worker.call(partial(fn, *args, **kwargs))
        finally:
            self._idle.append(worker)

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is not None:
            for worker in self._all:
                worker.close()
        self.shutdown(wait=True, cancel_futures=True)
        for worker in self._all:
            worker.end()


def run(
    calls: Mapping[str, Callable[[], T]], *, executor: Executor | None = None, jobs: int | None = None
) -> Iterator[tuple[str, T | Exception]]:
    """Yield the name and the result, or the exception, of each call as it finishes.

    By default `jobs` worker processes make the calls, where a crash ends its own call only.
    """
    if not calls:
        return
    with contextlib.ExitStack() as stack:
        if executor is None:
            executor = stack.enter_context(WorkerPool(min(jobs or processors(), len(calls))))
        running: dict[Future[T], str] = {}
        refused = []
        try:
            for name, call in calls.items():
                try:
                    running[executor.submit(call)] = name
                except RuntimeError:
                    refused.append(name)
            for future in as_completed(running):
                result: T | Exception = _result(future)
                yield running.pop(future), result
        finally:
            for future in running:
                future.cancel()
        for name in refused:
            yield name, WorkerDiedError("not computed: the executor takes no more calls")


def _result(future: Future[Any]) -> Any:
    error = None if future.cancelled() else future.exception()
    if future.cancelled() or isinstance(error, BrokenExecutor):
        return WorkerDiedError("its process ended without an answer: a crash, or no memory left")
    if error is not None and not isinstance(error, Exception):
        raise error
    return error or future.result()
