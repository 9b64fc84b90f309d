"""Who is told how far a study is, and where its result so far goes."""

from __future__ import annotations

import os
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Protocol

from mbkit.errors import InputError, MbkitWarning

__all__ = ["Checkpoint", "Keeper", "Kept", "Progress"]


class Kept(Protocol):
    """A result that tells itself as JSON."""

    def to_json(self) -> str:
        """Return it."""
        ...


#: progress(fraction, text)
Progress = Callable[[float, str], object]
Checkpoint = str | os.PathLike[str] | Callable[[Any], object]

#: Seconds between two results.
_BETWEEN: Final = 5.0


class Keeper:
    """Tells a progress function, and hands results to a checkpoint.

    Parameters
    ----------
    progress : callable, optional
    checkpoint : path or callable, optional
        A JSON file that is whole at any time, or a function of the result.

    Raises
    ------
    InputError
        What is neither, or a path into a folder that does not exist.
    """

    def __init__(self, progress: Progress | None, checkpoint: Checkpoint | None) -> None:
        if progress is not None and not callable(progress):
            raise InputError(f"progress: expected a function of (fraction, text), got {progress!r}")
        if checkpoint is not None and not callable(checkpoint):
            if not isinstance(checkpoint, (str, os.PathLike)):
                raise InputError(f"checkpoint: expected a path or a function, got {checkpoint!r}")
            folder = Path(checkpoint).parent
            if not folder.is_dir():
                raise InputError(f"checkpoint: there is no folder {folder}; choose one that exists")
        self._progress, self._checkpoint = progress, checkpoint
        self._told, self._kept = 0.0, time.perf_counter()

    def tell(self, fraction: float, text: str) -> None:
        """Tell how far it is, never less than before."""
        self._told = max(self._told, min(fraction, 1.0))
        if self._progress is not None:
            self._progress(self._told, text)

    def now_and_then(self, make: Callable[[], Kept]) -> None:
        """Keep the result so far, unless that was done a moment ago."""
        if self._checkpoint is not None and time.perf_counter() - self._kept > _BETWEEN:
            self.keep(make())
            self._kept = time.perf_counter()

    def keep(self, result: Kept) -> None:
        """Hand a result over; where that fails, the study goes on, and that is told."""
        if callable(self._checkpoint):
            try:
                self._checkpoint(result)
            except Exception as error:
                # What is measured must not be lost by whoever looks at it.
                told = f"checkpoint: the function raised {type(error).__name__}: {error}; the study goes on"
                warnings.warn(told, MbkitWarning, stacklevel=3)
        elif self._checkpoint is not None:
            try:
                _write_whole(Path(self._checkpoint), result.to_json() + "\n")
            except OSError as error:
                # A full disk is no reason to lose what is measured.
                told = f"checkpoint: cannot write {self._checkpoint}: {error.strerror or error}; the study goes on"
                warnings.warn(told, MbkitWarning, stacklevel=3)


def _write_whole(path: Path, text: str) -> None:
    """Write a file that is whole at any time: under another name, and then renamed."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
