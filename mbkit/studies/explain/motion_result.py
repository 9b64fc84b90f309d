"""What causes do to a motion, as a result: a table in radians, a picture, CSV."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from mbkit.engines.base import MAX_NAMES
from mbkit.model.validation import listing
from mbkit.studies.document import Bullet, Column, Items, Section, Table
from mbkit.studies.explain.hypotheses import Hypothesis
from mbkit.studies.explain.worlds import Changed, World, changed
from mbkit.studies.formatting import error_text
from mbkit.studies.results import NOT_PLAIN, ResultTable, columns_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class CauseMotion:
    """The largest change of a coordinate, rad or m, that one cause makes, at the times of the comparison.

    `alone` is that of the first side with this cause alone, `without` that of the second side without it; NaN where
    it cannot be run so, or after a run's end. `passes` is the time, s, at which one of them passes the bound, NaN where
    none does; `joint` moves most. `over_time` is the larger of both on the grid.
    """

    kind: str
    subject: str
    says: str
    alone: tuple[float, ...]
    without: tuple[float, ...]
    passes: float
    joint: str
    over_time: tuple[float, ...]
    change: Hypothesis | None = field(default=None, repr=False, compare=False, metadata=NOT_PLAIN)

    @property
    def at_times(self) -> tuple[float, ...]:
        """The larger of both effects at each time."""
        return tuple(np.fmax(self.alone, self.without).tolist())

    @property
    def measured(self) -> bool:
        """Whether a run could be made with this cause alone, or without it."""
        return not all(map(math.isnan, self.at_times))

    @property
    def largest(self) -> float:
        """The largest change at any time of the comparison."""
        return float(np.nanmax([0.0, *self.at_times]))

    def __str__(self) -> str:
        return self.says

    def apply(self, side: Changed) -> Changed:
        """Return the first description, or the settings of its simulator, with this change alone; see `Cause.apply`."""
        return changed(self.change, self.says, side)

    def revert(self, side: Changed) -> Changed:
        """Return the second description, or the settings of its simulator, without this change."""
        return changed(self.change, self.says, side, back=True)


def _of_cause(value: Callable[[Any], Any], row: tuple[CauseMotion, float, float, float]) -> Any:
    return value(row[0])


@dataclass(frozen=True)
class MotionComparison(ResultTable):
    """How far two simulations move apart, and which cause does how much of it.

    `whole` is the largest difference of a coordinate, rad or m, at `times`; `explained` the change that all causes
    make together, `unexplained` what is then left of the difference. `effects` has the causes, the
    largest change first. `settings` are those of the two sides, `not_compared` what no run has. `joint` is the one that
    is furthest apart, `paths` are its coordinates on both sides at the times of `grid`, and `over_time` the whole
    difference there.
    """

    a: str
    b: str
    times: tuple[float, ...]
    bound: float
    controller: str
    settings: tuple[str, ...]
    whole: tuple[float, ...]
    explained: tuple[float, ...]
    unexplained: tuple[float, ...]
    effects: tuple[CauseMotion, ...]
    not_compared: tuple[str, ...]
    notes: tuple[str, ...]
    grid: tuple[float, ...]
    joint: str
    paths: tuple[tuple[tuple[float, ...], ...], ...]
    over_time: tuple[float, ...]
    first: World | None = field(default=None, repr=False, compare=False, metadata=NOT_PLAIN)

    _called = "a"
    _listed = "effects"
    _derived = ("verdict",)
    _csv_columns: ClassVar = {
        **{name: partial(_of_cause, value) for name, value in columns_of(CauseMotion).items()},
        "time": lambda row: row[1],
        "alone": lambda row: row[2],
        "without": lambda row: row[3],
    }

    def _csv_rows(self) -> Iterator[tuple[CauseMotion, float, float, float]]:
        for x in self.effects:
            yield from ((x, *row) for row in zip(self.times, x.alone, x.without, strict=True))

    @property
    def verdict(self) -> str:
        """One sentence: how far apart, and how much of it is explained."""
        apart = ", ".join(f"{error_text(x)} after {t:g} s" for x, t in zip(self.whole, self.times, strict=True))
        # NaN where a run had ended is the largest.
        left = float(np.max(self.unexplained))
        beside = f"; not compared: {', '.join(self.not_compared)}" if self.not_compared else ""
        return f"the motions are apart by {apart} (rad or m); unexplained: {error_text(left)}{beside}"

    def alike(self, tolerance: float) -> bool:
        """Return whether both sides move as one, in runs that all went to their end."""
        sizes = [*self.whole, *(x for cause in self.effects for x in (cause.largest, *cause.at_times))]
        return bool(np.all(np.array(sizes) <= tolerance))

    def sections(self) -> list[Section]:
        """Return the sections of a document."""
        numbered = [(k, x) for k, x in enumerate(self.effects, 1) if x.largest != 0]
        zero = [(k, x) for k, x in enumerate(self.effects, 1) if x.largest == 0]
        still, unknown = ([f"{k}. {x}" for k, x in zero if x.measured is known] for known in (True, False))
        rows = [
            ("both sides as they are", self.whole, math.nan, ""),
            *((f"{k}. {x}", x.at_times, x.passes, x.joint) for k, x in numbered),
            ("all causes together", self.explained, math.nan, ""),
            ("unexplained", self.unexplained, math.nan, ""),
        ]

        def at(k: int) -> Column:
            return Column(f"{self.times[k]:g} s", lambda row: _size(row[1][k]), right=True)

        table = Table(
            (
                Column("", lambda row: row[0]),
                *map(at, range(len(self.times))),
                Column(
                    f"passes {self.bound:g}", lambda row: "" if math.isnan(row[2]) else f"at {row[2]:.3g} s", right=True
                ),
                Column("joint", lambda row: row[3]),
            ),
            rows,
        )
        says = [
            Bullet("control", self.controller),
            *(Bullet(name, text) for name, text in zip((self.a, self.b), self.settings, strict=True)),
            *(Bullet("not compared", x) for x in self.not_compared),
            *([Bullet("moved nothing in these runs", listing(still, MAX_NAMES))] if still else []),
            *([Bullet("not measured alone", listing(unknown, MAX_NAMES))] if unknown else []),
            *(Bullet("", x) for x in self.notes),
        ]
        return [Section("What each cause does to the motion, rad or m", [table]), Section("Runs", [Items(says)])]

    def plot(self) -> Figure:
        """Draw the coordinate that is furthest apart on both sides, and the change by each cause over time."""
        from matplotlib import pyplot as plt

        fig, (upper, lower) = plt.subplots(2, 1, sharex=True, figsize=(7.5, 5.5), layout="constrained")
        for k, (name, path) in enumerate(zip((self.a, self.b), self.paths, strict=True)):
            values = np.array(path).reshape(len(self.grid), -1)
            for line in upper.plot(self.grid, values, f"C{k}", ls=("-", "--")[k])[:1]:
                line.set_label(name)
        upper.set(ylabel=f"{self.joint} (rad or m)")
        upper.legend(loc="best")
        for x in self.effects[:8]:
            lower.semilogy(self.grid, _positive(x.over_time), label=f"{x.kind} {x.subject}".strip())
        lower.semilogy(self.grid, _positive(self.over_time), "k:", label="whole difference")
        lower.axhline(self.bound, color="0.6", lw=0.8)
        lower.set(xlabel="t (s)", ylabel="largest change (rad or m)")
        lower.legend(loc="best", fontsize="small")
        return fig


@dataclass(frozen=True)
class TriedCause:
    """A cause, or two, and the largest difference from the second record, rad or m, that it leaves."""

    says: str
    residual: float


@dataclass(frozen=True)
class RecordComparison(ResultTable):
    """Which causes turn one recorded motion into the other.

    `apart` is the largest difference of the two records, rad or m, `joint` where it begins, and `begins` when, s.
    `reproduced` is the largest difference of the first record from a run of the first description. `causes`, of
    `kinds`, are those whose run is nearest the second record, empty where none is nearer than the description as it is;
    `residual` is what they leave. `tried` has the best ones. `over_time` and `residual_over_time` are both over `grid`.
    """

    a: str
    b: str
    causes: tuple[str, ...]
    kinds: tuple[str, ...]
    apart: float
    reproduced: float
    residual: float
    joint: str
    begins: float
    tried: tuple[TriedCause, ...]
    notes: tuple[str, ...]
    grid: tuple[float, ...]
    over_time: tuple[float, ...]
    residual_over_time: tuple[float, ...]

    _called = "a"
    _listed = "tried"
    _derived = ("verdict",)
    _csv_columns: ClassVar = columns_of(TriedCause)

    @property
    def verdict(self) -> str:
        """One sentence: what turns the first record into the second, and what is left."""
        own = f"a run of {self.a} is {error_text(self.reproduced)} from its record"
        if not self.causes:
            return (
                f"the records are {error_text(self.apart)} apart, and no cause that was tried brings them nearer; {own}"
            )
        says = " and ".join(self.causes)
        return f"the records are {error_text(self.apart)} apart: {says}; {error_text(self.residual)} is left; {own}"

    def sections(self) -> list[Section]:
        """Return the sections of a document."""
        columns = (
            Column("with", lambda x: x.says),
            Column("left of the difference", lambda x: error_text(x.residual), right=True),
        )
        begins = f"the records part at joint {self.joint!r}, from {self.begins:.3g} s on" if self.joint else ""
        says = [Bullet("", x) for x in (begins, *self.notes) if x]
        return [
            Section("What turns the first record into the second, rad or m", [Table(columns, self.tried), Items(says)])
        ]

    def plot(self) -> Figure:
        """Draw the difference of the records over time, and what the named causes leave of it."""
        from matplotlib import pyplot as plt

        fig, ax = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
        ax.semilogy(self.grid, _positive(self.over_time), "k:", label="difference of the records")
        ax.semilogy(self.grid, _positive(self.residual_over_time), label="left with the causes named")
        ax.set(xlabel="t (s)", ylabel="rad or m")
        ax.legend(loc="best")
        return fig


def _positive(x: tuple[float, ...]) -> np.ndarray:
    values = np.array(x)
    return np.where(values > 0, values, np.nan)


def _size(x: float) -> str:
    return "" if math.isnan(x) else error_text(x)
