"""Progress of a study, and checkpoints of its result so far."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, TypeVar

from mbkit.errors import InputError, MbkitWarning
from mbkit.studies.results import ResultTable, write_whole

R = TypeVar("R", bound=ResultTable)
#: progress(fraction, text)
Progress = Callable[[float, str], object]
Checkpoint = str | os.PathLike[str] | Callable[[Any], object]

_SECONDS_BETWEEN_RESULTS: Final = 5.0


class InterruptedSweepError(KeyboardInterrupt):
    """A study was interrupted by Ctrl-C; `result` holds the part that was finished, with ``complete=False``.

    A `KeyboardInterrupt`, so that a program that does not handle it ends as usual.
    """

    def __init__(self, result: Any) -> None:
        super().__init__("interrupted; what was finished is in .result")
        self.result = result

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.result,)


def silent(_fraction: float, _text: str) -> None:
    """Report no progress."""


class Checkpointer:
    """Reports progress, and saves results to a JSON file or by a function."""

    def __init__(self, progress: Progress | None, checkpoint: Checkpoint | None) -> None:
        if progress is not None and not callable(progress):
            raise InputError(f"progress: expected a function of (fraction, text), got {progress!r}")
        if checkpoint is not None and not callable(checkpoint):
            if not isinstance(checkpoint, (str, os.PathLike)):
                raise InputError(f"checkpoint: expected a path or a function, got {checkpoint!r}")
            folder = Path(checkpoint).parent
            if not folder.is_dir():
                raise InputError(f"checkpoint: there is no folder {folder}; choose one that exists")
        self._progress, self._checkpoint = progress or silent, checkpoint
        self._reported, self._saved = 0.0, time.perf_counter()

    def report(self, fraction: float, text: str) -> None:
        """Report progress, never less than before."""
        self._reported = max(self._reported, min(fraction, 1.0))
        self._progress(self._reported, text)

    def run(self, steps: Iterable[tuple[float, str]], result: Callable[..., R]) -> R:
        """Work through the steps of a study, and return its result; `result` takes ``complete``.

        The result is saved on the way, at the end, and when an interruption or an error ends the study.
        """
        try:
            for fraction, text in steps:
                self.report(fraction, text)
                if self._checkpoint is not None and time.perf_counter() - self._saved > _SECONDS_BETWEEN_RESULTS:
                    self.save(result(complete=False))
                    self._saved = time.perf_counter()
            whole = result(complete=True)
        except KeyboardInterrupt:
            part = result(complete=False)
            self.save(part)
            raise InterruptedSweepError(part) from None
        except Exception:
            # Such as one of the progress function: the finished part is not lost.
            self.save(result(complete=False))
            raise
        self.save(whole)
        try:
            self.report(1.0, "done")
        except KeyboardInterrupt:
            raise InterruptedSweepError(whole) from None
        return whole

    def save(self, result: ResultTable) -> None:
        """Save a result; where that fails, a warning says so and the study goes on."""
        message = ""
        if callable(self._checkpoint):
            try:
                self._checkpoint(result)
            except Exception as error:
                message = f"the function raised {type(error).__name__}: {error}"
        elif self._checkpoint is not None:
            try:
                write_whole(Path(self._checkpoint), f"{result.to_json()}\n".encode())
            except OSError as error:
                message = f"cannot write {self._checkpoint}: {error.strerror or error}"
        if message:
            warnings.warn(f"checkpoint: {message}; the study goes on", MbkitWarning, stacklevel=4)
