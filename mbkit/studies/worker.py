"""Worker processes: functions are called in them, with limits of processor time and memory.

A worker is a new Python process with mbkit. It answers one call after the other, and keeps what its modules keep in
between.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from functools import partial
from math import inf
from multiprocessing import spawn
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, TypeVar

from mbkit._child_process import START_SECONDS, Child, WorkerDiedError, WorkerStartError, WorkerTimeoutError, cores
from mbkit.engines.registry import registered_engines
from mbkit.engines.remote.served.serve import attend
from mbkit.errors import InputError, MbkitError
from mbkit.methods.registry import METHODS, registered_methods

T = TypeVar("T")

#: Seconds after which a worker that nobody calls gives its memory back.
_IDLE: Final = 900.0
#: The folders of modules are known before the worker changes into its own folder.
_PROGRAM: Final = (
    "import sys; folder, *numbers = sys.argv[1:4]; sys.path[:] = sys.argv[4:]; "
    "from mbkit.studies.worker import _serve; _serve(folder, *map(int, numbers))"
)


class CallError(RuntimeError):
    """The worker cannot import the function or its arguments."""


class RemoteError(RuntimeError):
    """An exception of the function that cannot be sent as it is: its type and message."""


def describe(error: BaseException) -> str:
    """Return an exception in one line; errors of mbkit and of workers without their type."""
    plain = isinstance(error, (MbkitError, RemoteError, CallError))
    return " ".join((str(error) if plain else f"{type(error).__name__}: {error}").split())


class Worker(Child):
    """A process that makes one call at a time in a folder below `home`; started by the first call.

    The worker removes `home` if the caller is killed. It may take `memory` bytes (Linux; 0: no limit). `stage` is what
    the call last reported by `report_stage`.
    """

    def __init__(self, home: Path | None = None, memory: int = 0, environment: Mapping[str, str] | None = None) -> None:
        super().__init__(home)
        self._memory, self._environment = memory, environment
        self.stage = ""

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

    def begin(self, function: Callable[..., Any], *args: Any) -> None:
        """Send a call, whose result `finish` waits for."""
        call = pickle.dumps((registered_engines(), registered_methods(), function, args))
        # As multiprocessing has its children import the script that they were started from.
        main = spawn.get_preparation_data("mbkit") if b"__main__" in call else {}
        main = {k: x for k, x in main.items() if k.startswith("init_main")}
        try:
            self._start(START_SECONDS)
        except (WorkerDiedError, WorkerTimeoutError) as error:
            raise WorkerStartError(
                f"worker processes do not start: {error}; each needs some 300 MB of memory, "
                "and a Python with which mbkit can be imported"
            ) from None
        self.stage = ""
        self._send(pickle.dumps(main) + call)

    def finish(
        self, cpu_seconds: float = inf, stage_seconds: Mapping[str, float] | None = None, deadline: float = inf
    ) -> Any:
        """Return the result of the call that was begun; see `call`."""
        limits = stage_seconds or {}
        kind: str = "stage"
        value: Any = self.stage
        while kind == "stage":
            self.stage = value
            kind, value = pickle.loads(self._receive(limits.get(self.stage, cpu_seconds), deadline))
        self._busy = False
        if kind == "error":
            raise value
        return value

    def _command(self, handle: int) -> tuple[list[str], Mapping[str, str] | None]:
        arguments = (self._home or self._folder, handle, self._memory, *map(os.path.abspath, sys.path))
        return [sys.executable, "-c", _PROGRAM, *map(str, arguments)], self._environment


# The worker process

_to_parent: Connection[Any, Any] | None = None


def in_worker() -> bool:
    """Return whether this process is a worker."""
    return _to_parent is not None


def report_stage(name: str) -> None:
    """Report to the parent the part of a call that begins, which has its own time limit; without effect elsewhere."""
    if _to_parent is not None:
        _to_parent.send_bytes(pickle.dumps(("stage", name)))


def _serve(folder: str, handle: int, memory: int) -> None:
    attend(handle, folder, _prepare, memory, _IDLE)


def _prepare(channel: Connection[Any, Any]) -> Callable[[bytes], bytes]:
    global _to_parent
    _to_parent = channel
    return _answer


def _answer(message: bytes) -> bytes:
    try:
        stream = io.BytesIO(message)
        if main := pickle.load(stream):
            spawn.prepare(main)
        # Unpickling registers the engines.
        _, methods, function, args = pickle.load(stream)
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


# Many calls


class WorkerPool(ThreadPoolExecutor):
    """An executor of so many threads, each of which makes its calls in a worker of its own; see `Worker`."""

    def __init__(
        self, jobs: int, home: Path | None = None, memory: int = 0, environment: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(jobs)
        self._idle = [Worker(home, memory, environment) for _ in range(jobs)]
        self._all = tuple(self._idle)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Make a call in one of the workers."""
        return self.lend(lambda worker: worker.call(partial(fn, *args, **kwargs)))

    def lend(self, work: Callable[..., T], *args: Any) -> Future[T]:
        """Call a function here, with one of the workers as its first argument."""
        return super().submit(self._with_worker, work, args)

    def _with_worker(self, work: Callable[..., T], args: tuple[Any, ...]) -> T:
        worker = self._idle.pop()
        try:
            return work(worker, *args)
        finally:
            self._idle.append(worker)

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is not None:
            for worker in self._all:
                worker.close()
        self.shutdown(wait=True, cancel_futures=True)
        for worker in self._all:
            worker.end()


def check_executor(executor: object, **sent: object) -> None:
    """Refuse what is no executor, and arguments that cannot be sent to its processes."""
    if executor is not None and not isinstance(executor, Executor):
        raise InputError(
            f"executor: expected a concurrent.futures.Executor, got {type(executor).__name__}; "
            "use a ProcessPoolExecutor, or the result of Dask's client.get_executor()"
        )
    for name, value in sent.items() if isinstance(executor, ProcessPoolExecutor) else ():
        check_sendable(f"{name}:", value)


def check_sendable(subject: str, value: object) -> None:
    """Refuse what no other process can be given."""
    try:
        pickle.dumps(value)
    except Exception as error:  # pickle raises errors of several kinds
        raise InputError(
            f"{subject} cannot be sent to other processes ({error}); define its functions in a module"
        ) from None


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
            executor = stack.enter_context(WorkerPool(min(jobs or cores(), len(calls))))
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
