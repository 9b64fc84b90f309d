"""Progress of a run: a bar on the terminal, or a call."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from mbkit.errors import InputError

#: progress(fraction), from 0 to 1
ProgressFunction = Callable[[float], object]

_PERIOD = 0.1  # s between reports
_PATIENCE = 2.0  # s before a bar appears


class Progress:
    """Nothing, a bar once the run takes more than 2 s, or calls of a function, at most ten a second and at the end."""

    def __init__(self, wanted: bool | ProgressFunction | None, label: str) -> None:
        if wanted is not None and not isinstance(wanted, bool) and not callable(wanted):
            raise InputError(f"progress: expected None, True or a callable, got {wanted!r}")
        self._wanted, self._label = wanted, label
        self._bar: Any = None
        self._done = 0.0
        self._next = 0.0

    def __enter__(self) -> Progress:
        self._next = time.perf_counter() + (_PATIENCE if self._wanted is True else _PERIOD)
        return self

    def update(self, fraction: float) -> None:
        """Report the fraction done, if it is time to."""
        self._done = fraction
        if self._wanted and (now := time.perf_counter()) >= self._next:
            self._next = now + _PERIOD
            self._show()

    def _show(self) -> None:
        if callable(self._wanted):
            self._wanted(self._done)
            return
        if self._bar is None:
            from rich.progress import Progress as Bar

            self._bar = Bar(transient=True)
            self._bar.add_task(self._label, total=1.0)
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], completed=self._done)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        elif kind is None and callable(self._wanted):
            self._wanted(self._done)
