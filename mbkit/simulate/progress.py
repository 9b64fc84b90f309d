"""Progress of long work: a bar on a terminal or in a notebook once it takes more than two seconds, or a call."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from mbkit import _process as _interrupt
from mbkit._escape import one_line
from mbkit._process import LOOK_SECONDS
from mbkit.errors import InputError

#: progress(fraction), from 0 to 1
ProgressFunction = Callable[[float], object]

#: Time before a bar appears, s.
_PATIENCE = 2.0


class Bar:
    """A bar on stderr; called with a fraction and a text, it shows both."""

    def __init__(self, label: str) -> None:
        self._label, self._text, self._fraction = one_line(label, 60), "", 0.0
        self._start = 0.0
        self._bar: Any = None
        # A timer, because the first step may itself take long.
        self._timer = threading.Timer(_PATIENCE, self._show)
        self._timer.daemon = True

    def __enter__(self) -> Bar:
        self._start = time.monotonic()
        if sys.stderr.isatty() or "ipykernel" in sys.modules:
            self._timer.start()
        return self

    def __call__(self, fraction: float, text: str = "") -> None:
        """Show how far the work is, and with what; where Ctrl-C was swallowed by a library, it is raised here."""
        _interrupt.raise_again()
        self._fraction, self._text = fraction, one_line(text, 60)
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=fraction, doing=self._text)

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        label, doing = (TextColumn(f"{{task.{name}}}", markup=False) for name in ("description", "fields[doing]"))
        bar = Progress(label, BarColumn(), TimeElapsedColumn(), doing, console=Console(stderr=True), transient=True)
        bar.update(bar.add_task(self._label, total=1.0, doing=self._text), completed=self._fraction)
        bar.tasks[0].start_time = self._start
        bar.start()
        self._bar = bar

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        if self._timer.is_alive():
            self._timer.join()
        if self._bar is not None:
            self._bar.stop()


class Progress:
    """Nothing, a `Bar`, or calls of a function, at most ten a second and at the end."""

    def __init__(self, wanted: bool | ProgressFunction | None, label: str) -> None:
        if wanted is not None and not isinstance(wanted, bool) and not callable(wanted):
            raise InputError(f"progress: expected None, True or a callable, got {wanted!r}")
        self._bar = Bar(label) if wanted is True else None
        self._report = self._bar or (wanted if callable(wanted) else None)
        self._done = self._next = 0.0

    def __enter__(self) -> Progress:
        self._next = time.perf_counter() + LOOK_SECONDS
        if self._bar is not None:
            self._bar.__enter__()
        return self

    def update(self, fraction: float) -> None:
        """Report the fraction done, if it is time to."""
        self._done = fraction
        if self._report and (now := time.perf_counter()) >= self._next:
            self._next = now + LOOK_SECONDS
            self._report(fraction)

    def __exit__(self, kind: object, *_: object) -> None:
        if self._bar is not None:
            self._bar.__exit__()
        elif kind is None and self._report is not None:
            self._report(self._done)
