"""The process that evaluates another version of an engine.

It is no `mbkit.studies.worker.Worker`, which sends pickles of mbkit's objects to a process that imports mbkit: here the
other side has NumPy alone, of any version, and takes arrays and plain data (`remote.serve`).
"""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from mbkit._check import Array
from mbkit._child_process import START_SECONDS, Child, WorkerDiedError, WorkerStartError, WorkerTimeoutError
from mbkit._process import fork_safe
from mbkit.engines.remote.packages import EngineVersion
from mbkit.engines.remote.served import serve
from mbkit.errors import EngineProcessError, UnsupportedError

_SERVE: Final = Path(serve.__file__)


#: Head and arrays.
Answer = tuple[dict[str, Any], list[Array]]


class RemoteError(Exception):
    """The engine refused a call; its message. Never leaves `mbkit.engines.remote`."""


class EngineProcess(Child):
    """One process of a version of an engine, started by the first call; it holds any number of models."""

    def __init__(self, version: EngineVersion) -> None:
        super().__init__()
        self.version = version
        self._lock = fork_safe(threading.RLock())
        #: Models that nobody needs any more; a garbage collection may come in the middle of a call.
        self.unneeded: list[int] = []

    def call(
        self, name: str, arrays: Sequence[Array], model: int, seconds: float, stacked: bool, **plain: Any
    ) -> Answer:
        """Return the head and the arrays of the answer; `stacked` arrays hold a state in each row.

        Raises `RemoteError` where the engine refuses, and `EngineProcessError` where the process died or was ended
        after `seconds`; the next call starts another.
        """
        with self._lock:
            self.start()
            while self.unneeded:
                self._exchange(serve.packed({"call": "forget", "model": self.unneeded.pop()}), self.version.seconds)
            message = {"call": name, "model": model, "with": plain, "stacked": stacked}
            head, out = self._exchange(serve.packed(message, arrays), seconds)
        if "error" in head:
            raise RemoteError(head["error"])
        return head, out

    def start(self) -> int:
        """Start the process unless it runs, and return its generation."""
        with self._lock, self._translating_errors(START_SECONDS):
            self._start(START_SECONDS)
        return self.generation

    def _command(self, handle: int) -> tuple[Sequence[str], Mapping[str, str]]:
        self._python = self.version.interpreter()
        file = self.version.package.file or self.version.engine
        command = [self._python, "-E", "-s", _SERVE, handle, file, self._folder]
        kept = {k: x for k, x in os.environ.items() if not k.startswith("PYTHON")}
        return [*map(str, command)], kept | self.version.variables()

    def _exchange(self, message: bytes, seconds: float) -> Answer:
        with self._translating_errors(seconds):
            self._send(message)
            answer = self._receive(deadline=time.perf_counter() + seconds)
        self._busy = False
        return serve.unpacked(answer)

    @contextlib.contextmanager
    def _translating_errors(self, seconds: float) -> Iterator[None]:
        """Raise what happens to the process as the errors of an engine."""
        try:
            yield
            return
        except WorkerStartError as error:
            why = f"its interpreter {self._python} does not start ({error.__cause__})"
        except WorkerTimeoutError:
            why = f"its process was ended after {seconds:g} s without an answer; "
            why += "mbkit.engine(name, seconds=...) gives it longer"
        except WorkerDiedError as error:
            why = f"its process {error.ended}" + (f" ({error.last})" if error.last else "")
        raise EngineProcessError(f"{self.version}: {why}")


_processes: Final[dict[str, EngineProcess]] = {}
_keys: Final = itertools.count(1)


def process_of(version: EngineVersion) -> EngineProcess:
    """Return the process of a version in this process."""
    if version.name not in _processes:
        _processes[version.name] = EngineProcess(version)
    return _processes[version.name]


class Held:
    """A model that the process of a version holds, and which is sent again where that process has died.

    `send` makes the process hold it, by calls of the function that it gets; `head` is what it returned. Where the
    engine refuses, the error says so after `refuses`.
    """

    def __init__(
        self, version: EngineVersion, send: Callable[[Callable[..., Answer]], dict[str, Any]], refuses: str = ""
    ) -> None:
        self._process, self._key, self._seconds = process_of(version), next(_keys), version.seconds
        self._send, self._refuses = send, f"{version}: {refuses}"
        weakref.finalize(self, self._process.unneeded.append, self._key)
        self._hold()

    def _hold(self) -> None:
        self._generation = self._process.start()
        try:
            self.head = self._send(self._call)
        except RemoteError as error:
            raise UnsupportedError(f"{self._refuses}{error}") from None

    def ask(self, name: str, *arrays: Array, **plain: Any) -> list[Array]:
        """Return the arrays of an answer, at a state or a stack of them; raises `RemoteError`."""
        if self._process.start() != self._generation:
            self._hold()
        return self._call(name, *arrays, **plain)[1]

    def _call(self, name: str, *arrays: Array, **plain: Any) -> Answer:
        stacked = bool(arrays) and arrays[0].ndim > 1
        return self._process.call(name, arrays, self._key, self._seconds, stacked, **plain)


def end(version: EngineVersion) -> None:
    """End the process of a version, where there is one."""
    if own := _processes.get(version.name):
        own.end()
