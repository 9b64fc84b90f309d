"""A bar for work that takes longer than two seconds, on stderr and only on a terminal."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Any

from mbkit import _interrupt
from mbkit._escape import one_line

_PATIENCE = 2.0  # s before the bar appears


class Bar:
    """A context manager; called with a fraction and a text, it shows both."""

    def __init__(self, label: str) -> None:
        self._label, self._text, self._fraction = one_line(label, 60), "", 0.0
        self._begun = 0.0
        self._bar: Any = None
        self._timer: threading.Timer | None = None

    def __enter__(self) -> Bar:
        self._begun = time.monotonic()
        if sys.stderr.isatty():
            # A timer, because the first step may itself take long.
            self._timer = threading.Timer(_PATIENCE, self._show)
            self._timer.daemon = True
            self._timer.start()
        return self

    def __call__(self, fraction: float, text: str) -> None:
        """Show how far the work is, and with what; where Ctrl-C was swallowed by a library, it is raised here."""
        _interrupt.raise_again()
        self._fraction, self._text = fraction, one_line(text, 60)
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=fraction, doing=self._text)

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[doing]}", markup=False),
        )
        bar = Progress(*columns, console=Console(stderr=True), transient=True)
        task = bar.add_task(self._label, total=1.0, doing=self._text)
        bar.update(task, completed=self._fraction)
        bar.tasks[0].start_time = self._begun
        bar.start()
        self._bar = bar

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()
        if self._bar is not None:
            self._bar.stop()
