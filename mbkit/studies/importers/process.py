"""Importers in worker processes, so that none of them can end, hang or fill the user's process.

The processes are kept from one comparison to the next: libraries take longer to load than files.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any, Final

from mbkit._check import Array
from mbkit.engines.imported import IMPORTERS, Beside, Imported, Importer, reader
from mbkit.model import Model
from mbkit.studies.worker import WALL_PER_CPU, Worker, WorkerDiedError, WorkerStartError, WorkerTimeoutError, describe

#: Seconds more than all importers may take, after which a process ends that nobody waits for any more.
_GRACE: Final = 30.0
#: The most seconds that a reading may have; the system's calls take no more.
_MAX_SECONDS: Final = 1e6

_workers: Final[dict[Importer, Worker]] = {}
_lock = threading.Lock()


class ImporterError(Exception):
    """An importer refuses a text, ended its process over it, or took too long; never leaves `mbkit.studies`."""


def one_at_a_time() -> threading.Lock:
    """Return the lock that a comparison holds: each importer's process holds one file."""
    return _lock


def _renew_lock() -> None:
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)


class Reading:
    """A text that an engine's importer reads, in at most `seconds` of processor time; so is each call of its terms."""

    def __init__(
        self, engine: str, text: str, format_: str, floating_base: bool, files: dict[str, bytes], seconds: float
    ) -> None:
        self._engine, self._seconds = engine, min(seconds, _MAX_SECONDS)
        importer = IMPORTERS[engine]
        self._worker = _workers.setdefault(importer, Worker(outlives_thread=True))
        self._text = (importer.module, text, format_, floating_base, files)

    def begin(self) -> None:
        """Begin to read; raises `ImporterError`."""
        self._begin(_read, *self._text)

    def result(self) -> Imported:
        """Return the reading that was begun; raises `ImporterError`."""
        model, notes, beside = self._finish()
        return Imported(model, self._terms, notes, beside)

    def _terms(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:
        self._begin(_terms, q, v, without)
        terms: dict[str, Array] = self._finish()
        return terms

    def _begin(self, function: Callable[..., Any], *args: Any) -> None:
        # It may be waited for after all others.
        alarm = len(IMPORTERS) * WALL_PER_CPU * self._seconds + _GRACE
        try:
            self._worker.begin(function, *args, alarm=alarm)
        except (WorkerDiedError, WorkerStartError) as error:
            raise ImporterError(self._failure(error)) from None

    def _finish(self) -> Any:
        try:
            return self._worker.finish(self._seconds)
        except Exception as error:  # importers raise errors of all kinds
            raise ImporterError(self._failure(error)) from None

    def _failure(self, error: Exception) -> str:
        if isinstance(error, WorkerTimeoutError):
            return f"its importer was {error}, without an answer"
        if isinstance(error, WorkerDiedError):
            if not error.signal:
                return f"its importer: {error}"
            return f"its importer ended the process with {error.signal}" + (f" ({error.last})" if error.last else "")
        return describe(error).removeprefix(f"{self._engine}: ")


# In the worker process

_held: Imported | None = None


def _read(
    module: str, text: str, format_: str, floating_base: bool, files: dict[str, bytes]
) -> tuple[Model, tuple[str, ...], tuple[Beside, ...]]:
    global _held
    # The file before can be as large.
    _held = None
    _held = reader(module)(text, format_, floating_base, files)
    return _held.model, _held.notes, _held.beside


def _terms(q: Array, v: Array, without: tuple[str, ...]) -> dict[str, Array]:
    assert _held is not None
    return _held.terms(q, v, without)
