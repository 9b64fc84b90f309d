"""What a comparison returns: frozen rows, and ways to read them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final

from mbkit._check import by_key
from mbkit._escape import one_line
from mbkit.engines.base import DOUBLE_BITS
from mbkit.engines.constrained import off_by
from mbkit.model.elements.kinds import EFFECTS
from mbkit.simulate.plotting.style import (
    CROSS,
    PLAIN,
    Palette,
    drawing,
    engine_mark,
    error_words,
    figure_of,
    legend,
    name_points,
)
from mbkit.studies.compare.errors import digits_of, named_precision
from mbkit.studies.results import Block, Column, Items, Refusal, ResultTable, Table, Title, columns_of
from mbkit.studies.work_precision.result import WorkPrecision

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: The reference of terms of an engine whose constraints are soft.
OWN_LAW: Final = "own law"
#: Kinds of findings.
ACTUATORS: Final = "actuators"
LIMITS: Final = "limits"
STIFF: Final = "stiff joint"
#: Where an error of exactly zero stands on an axis of digits.
_SAME: Final = 17.0


@dataclass(frozen=True)
class Row:
    """One term of one engine against the reference, worst over all samples.

    `reference` is ``"oracle"``, an engine where the oracle has no value, or ``"own law"`` where an engine's constraints
    are soft. `max_abs` is the largest absolute difference of any entry, in the term's own unit; `relative` the worst
    normwise error of a sample, and `median` the median, see `mbkit.studies.compare.errors`; `per_joint` the worst error
    of a joint relative to its own scale, and `joint` that joint, empty for energies. `worst_kind` (random, neutral, at
    limits, near singular), `worst_q` and `worst_v` are the state of the worst sample. `ns` is the median of nanoseconds
    per evaluation of a single state, `ns_spread` half their interquartile range. `reason` says why the row failed,
    naming joints and a known defect where there is one; or why more than the comparison's tolerance was allowed.
    `allowed` is the error that passes: that tolerance, or more where the engine's own formula cannot do better.
    `defect` is the engine's known defect, where the row failed with one announced. `zero` says whether the reference is
    zero in every entry at every state, so that the row is no evidence. `bits` are those of the significand with which
    the engine computes: 53, or 24 in single precision, where `allowed` is what that precision costs the term.
    """

    term: str
    engine: str
    reference: str
    joint: str
    max_abs: float
    relative: float
    per_joint: float
    median: float
    samples: int
    worst_kind: str
    worst_q: tuple[float, ...]
    worst_v: tuple[float, ...]
    ns: float
    ns_spread: float
    passed: bool
    reason: str = ""
    allowed: float = math.nan
    defect: str = ""
    zero: bool = False
    bits: int = DOUBLE_BITS

    @property
    def digits(self) -> str:
        """Digits of a row of an engine in another precision than double, as in ``6.4 of 7.2 digits``."""
        return f"{-math.log10(max(self.relative, 1e-16)):.1f} of {digits_of(self.bits):.1f} digits"


@dataclass(frozen=True)
class RolloutRow:
    """A trajectory of mbkit's integrator on one engine against MuJoCo's own, by the same formula.

    `dt` is the step, `duration` the compared horizon and `asked` the wanted one, s. `error` is the largest difference
    of q over the horizon, on the manifold. `condition` says how far q moves per relative disturbance of the forces,
    see `mbkit.studies.compare.beyond_terms`; `tolerance` is 1e-12, or a multiple of eps times the condition if that
    is more, as where an engine's formula for M loses digits. `off` is MuJoCo where the other engines' runs all differ
    from its own and not from each other: then its own is the one that is off. `seconds` and `seconds_against` are the
    run times of the two. `judged` is False where too few steps are well conditioned to say anything, and of a row for
    information, whose tolerance is infinite; `passed` is None there.
    """

    method: str
    engine: str
    against: str
    dt: float
    duration: float
    error: float
    condition: float
    tolerance: float
    steps: int
    seconds: float
    seconds_against: float
    passed: bool | None
    note: str = ""
    judged: bool = True
    asked: float = math.nan
    off: str = ""

    @property
    def cut(self) -> bool:
        """Whether the compared horizon is shorter than the one wanted."""
        return self.duration < self.asked * (1 - 1e-9)

    @property
    def informs(self) -> bool:
        """Whether the row is for information, since it compares another formula and cannot fail."""
        return math.isinf(self.tolerance)


@dataclass(frozen=True)
class Finding:
    """What the description has that bears on runs: what no engine uses, forces that jump, joints for other methods.

    `kind` is ``"actuators"``, ``"left out of the motion"``, ``"dry friction"``, ``"limits"`` or ``"stiff joint"``;
    `says` tells it in words, and `joints` has its joints. `mbkit check` adds ``"the file itself"``, with the links and
    joints that `mbkit.lint` names.
    `size` of dry friction is its ratio to the other forces at that joint and the median state, the largest of all
    joints; of a stiff joint its time constant, s; of the file the number of findings; of limits NaN.
    """

    kind: str
    says: str
    joints: tuple[str, ...]
    size: float = math.nan


@dataclass(frozen=True)
class Omission:
    """One thing that was left out, need by need.

    `present` says whether the description has it, and `what` what was off. `saved_ns` are the nanoseconds saved per
    evaluation, the difference of two medians, NaN where nothing was timed; `saved_spread` is half the interquartile
    range of that difference; `saved_setup` are the seconds of set-up saved, NaN where none. `change` is the largest
    relative change of the accelerations with the thing on, and `unchanged` says whether it is within rounding. What
    the description has and no engine uses may change them; what it has not may not, so that is a `fault`.
    """

    need: str
    present: bool
    what: str
    saved_ns: float
    saved_spread: float
    saved_setup: float
    change: float
    unchanged: bool
    note: str = ""

    _derived: ClassVar = ("measurable", "fault")

    @property
    def fault(self) -> bool:
        """Whether leaving out what the description has not changes the accelerations."""
        return not self.unchanged and not self.present

    @property
    def measurable(self) -> bool:
        """Whether the time saved stands out from the spread of the timings, by twice that."""
        return abs(self.saved_ns) > 2 * self.saved_spread


def _outcome(row: Row) -> str:
    if not row.passed:
        return row.reason
    if row.zero:
        return "zero in all states"
    single = row.bits < DOUBLE_BITS and row.relative > 0
    return f"agrees to {named_precision(row.bits)} ({row.digits})" if single else "agree"


_COLUMNS: Final = (
    Column("term", attrgetter("term")),
    Column("engine", attrgetter("engine")),
    Column("worst", attrgetter("relative"), ".1e"),
    Column("median", attrgetter("median"), ".1e"),
    Column("per joint", attrgetter("per_joint"), ".1e"),
    Column("joint", attrgetter("joint")),
    Column("ns", attrgetter("ns"), ".0f"),
    Column("", _outcome),
)


@dataclass(frozen=True, repr=False)
class Comparison(ResultTable):
    """Several engines on one description: do they agree, to how many digits, at what cost.

    `facts` has nq, nv, mass, digest, needs and notes of the model. `reference` is what the terms of all `engines` were
    measured by: the oracle. Accelerations of an engine with soft constraints are measured by its own written law
    instead, and `softness` has the digits that it keeps of the exact ones, at the median state. `findings` are what the
    description has that no engine uses, its dry friction and its stiff joints. `precision` is the error against run
    time of a few methods on a short horizon. `setup` has the seconds to build each engine; the derivation works when
    first called.
    `seconds` is the time of the whole study.
    """

    model: str
    facts: dict[str, Any]
    engines: tuple[str, ...]
    reference: str
    samples: int
    seed: int
    tolerance: float
    rows: tuple[Row, ...]
    rollouts: tuple[RolloutRow, ...] = ()
    precision: WorkPrecision | None = None
    omissions: tuple[Omission, ...] = ()
    refusals: tuple[Refusal, ...] = ()
    findings: tuple[Finding, ...] = ()
    setup: dict[str, float] = field(default_factory=dict)
    softness: dict[str, float] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    processor: str = ""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether at least two engines were compared, in terms that are not all zero, and nothing differed.

        What the description has and no engine uses, among `findings`, is no difference between engines.
        """
        agreed = bool(self.rows) and not self.nothing and all(r.passed for r in self.rows)
        return agreed and not self._beyond

    @property
    def worst(self) -> Row | None:
        """The row with the largest relative error; a failed one first."""
        return max(self.rows, key=lambda r: (not r.passed, r.relative), default=None)

    @property
    def verdict(self) -> str:
        """Whether they agree, and to how many digits, or which engine differs in what, and by which known defect."""
        if self.nothing:
            return f"nothing compared: {self.nothing}"
        missing = "".join(f"; {x}" for x in self.shortened)
        if self.passed:
            return f"{self.agreement()}{missing}"
        known = by_key(((r.engine, r.defect), r.term) for r in self.rows if r.defect)
        parts = [f"{engine} differs in {', '.join(terms)}: {defect}" for (engine, defect), terms in known.items()]
        if self.only_known_defects:
            return f"{'; '.join(parts)}; all else agrees to {self.digits:.1f} digits{missing}"
        failed = [r for r in self.rows if not r.passed and not r.defect]
        parts += [f"{r.engine} differs in {r.term}" + (f" at {r.joint}" if r.joint else "") for r in failed]
        beyond = [
            f"rollout {x.against if x.off else x.method} on {x.off or x.engine} differs"
            if isinstance(x, RolloutRow)
            else f"leaving out {x.need} changes the accelerations"
            for x in self._beyond
        ]
        return "; ".join([*parts, *dict.fromkeys(beyond)]) + missing

    @property
    def nothing(self) -> str:
        """Why the comparison says nothing although no row differs; empty where it does say something."""
        if not self.rows:
            # Engines that refuse a model for the same reason say so once.
            return "; ".join(dict.fromkeys(r.reason for r in self.refusals)) or "no engines"
        if any(not r.passed for r in self.rows):
            return ""
        if any(r.zero for r in self.rows if r.term == "M"):
            return "the mass matrix is zero at every state, as no joint moves any mass"
        return "every term is zero at every state" if all(r.zero for r in self.rows) else ""

    @property
    def only_known_defects(self) -> bool:
        """Whether something differs, and all of it by known defects of engines."""
        failed = [r for r in self.rows if not r.passed]
        return bool(failed) and all(r.defect for r in failed) and not self._beyond

    @property
    def _beyond(self) -> list[RolloutRow | Omission]:
        """The failures beyond the terms."""
        return [*(r for r in self.rollouts if r.passed is False), *(o for o in self.omissions if o.fault)]

    @property
    def shortened(self) -> tuple[str, ...]:
        """Terms, engines, studies and curves that the comparison left out, and horizons that were cut."""
        out = [f"not compared: {', '.join(self.not_compared)}"] if self.not_compared else []
        absent = dict.fromkeys(r.engine for r in self.refusals if not r.term and r.engine not in self.engines)
        out += [f"{', '.join(absent)} left out"] if absent else []
        out += [f"no {r.term}" for r in self.refusals if not r.engine]
        loops = self.facts["needs"]["loops"] if self.softness else False
        what, them, exact = ("loops", "them", "rigid") if loops else (EFFECTS["jump"], "it", "exact")
        out += [
            f"{name} holds {what} softly, and agrees with its own law of {them}; its accelerations are "
            f"{off_by(10.0**-x, f'the {exact} ones')} at the median state"
            for name, x in self.softness.items()
        ]
        rows = [r for r in self.rollouts if not r.informs]
        rubbing = [x.size for x in self.findings if x.kind == EFFECTS["jump"]]
        if rows and rubbing:
            size = f"{rubbing[0]:.2g} times the other forces"
            out += [f"rollouts and error against run time are without {EFFECTS['jump']} ({size})"]
        judged = [r for r in rows if r.judged]
        if rows and not judged:
            out.append(f"none of {len(rows)} rollouts judged" if len(rows) > 1 else "the rollout not judged")
        elif len(judged) < len(rows):
            out.append(f"{len(rows) - len(judged)} of {len(rows)} rollouts not judged")
        if cut := [r for r in judged if r.cut]:
            least = min(r.duration for r in cut)
            out.append(f"{len(cut)} of {len(rows)} rollouts cut, to {least:.3g} s at the least")
        if self.precision is not None:
            # A comparison's runs are short by its own choice.
            out += [f"error against run time: {x}" for x in self.precision.shortened if x != self.precision.bounded]
        return tuple(out)

    @property
    def not_compared(self) -> tuple[str, ...]:
        """Terms that no engine could give, as where M is singular; `refusals` has the reasons."""
        known = {r.term for r in self.rows}
        return tuple(dict.fromkeys(r.term for r in self.refusals if r.engine and r.term and r.term not in known))

    def agreement(self, reference: str = "") -> str:
        """Return to how many digits engines agree: those in double precision together, each other one by itself."""
        lower = {r.engine: r for r in sorted(self.rows, key=lambda r: r.relative) if r.bits < DOUBLE_BITS}
        doubles = [name for name in self.engines if name not in lower and not (reference and name == self.reference)]
        agree = "agree" if len(doubles) > 1 else "agrees" if reference else f"agrees with the {self.reference}"
        parts = [f"{', '.join(doubles)} {agree} to {self.digits:.1f} digits{reference}"] if doubles else []
        parts += [f"{name} agrees to {named_precision(r.bits)} ({r.digits})" for name, r in lower.items()]
        return "; ".join(parts)

    @property
    def digits(self) -> float:
        """Decimal digits on which all terms agree, known defects apart, at most 16; zeros are no evidence.

        Of engines in double precision, where there are some.
        """
        evidence = [r for r in self.rows if not r.zero and not r.defect]
        errors = [r.relative for r in evidence if r.bits >= DOUBLE_BITS] or [r.relative for r in evidence]
        if not errors or any(math.isnan(e) for e in errors):
            return math.nan
        return -math.log10(max(*errors, 1e-16))

    def by_term(self) -> dict[str, dict[str, Row]]:
        """Return the rows by term and engine, terms in their order."""
        out: dict[str, dict[str, Row]] = {}
        for row in self.rows:
            out.setdefault(row.term, {})[row.engine] = row
        return out

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the digits of each engine and term with Matplotlib: the worst state, and the median behind it.

        What failed is crossed out. `ax` is where to draw; by default in a figure of its own.
        """
        with drawing():
            return figure(self, PLAIN, ax)

    _derived = ("passed", "verdict", "digits", "shortened")
    _csv_columns = columns_of(Row)

    def _blocks(self) -> Iterator[Block]:
        yield Title(self.model, f": {self.verdict}")
        yield Items(f"{x.kind}: {x.says}" for x in self.findings)
        yield Table(_COLUMNS, self.rows)
        yield Items(f"{r.engine}{' ' + r.term if r.term else ''}: {r.reason}" for r in self.refusals)


def figure(result: Comparison, palette: Palette, ax: Axes | None = None) -> Figure:
    """Draw the digits of agreement of each term and engine, in the style that is set."""
    from matplotlib.figure import Figure

    terms, engines = result.by_term(), result.engines
    own = ax is None
    if ax is None:
        ax = Figure(figsize=(7.2, 1.3 + 0.36 * len(terms)), layout="constrained").add_subplot()
    step = 0.8 / max(len(engines), 3)
    for k, engine in enumerate(engines):
        colour, label = palette.engine(engine), f"{one_line(engine, 30)} against {result.reference}"
        ax.plot([], [], engine_mark(engine), color=colour, label=label)
        shown = [(place, by[engine]) for place, by in enumerate(terms.values()) if engine in by]
        if not shown:
            continue
        y = [place + (k - (len(engines) - 1) / 2) * step for place, _ in shown]
        errors = {"median": [r.median for _, r in shown], "worst": [r.relative for _, r in shown]}
        ends = {kind: [_shown_digits(x) for x in some] for kind, some in errors.items()}
        ax.hlines(y, ends["median"], ends["worst"], color=colour, linewidth=1.2)
        # One line for all terms: Matplotlib's time goes by the lines.
        for kind, look in (("median", {"marker": "|", "markersize": 8}), ("worst", {"marker": engine_mark(engine)})):
            texts = [
                f"{r.term}, {engine}: {kind} error {error_words(x)}"
                for (_, r), x in zip(shown, errors[kind], strict=True)
            ]
            name_points(ax.plot(ends[kind], y, ls="none", color=colour, **look), texts)
        if failed := [(x, h) for (_, r), x, h in zip(shown, ends["worst"], y, strict=True) if not r.passed]:
            ax.plot(*zip(*failed, strict=True), "x", color=palette.bad, **CROSS)
    ax.set_yticks(range(len(terms)), [one_line(t, 40) for t in terms])
    ax.set_ylim(len(terms) - 0.4, -1.1)
    # The digits that all have say nothing; the tolerance's stay in sight.
    least = min((_shown_digits(row.relative) for row in result.rows), default=0.0)
    begin = max(0, min(10, 2 * (math.floor(least) // 2) - 2))
    ticks = range(begin, 17, 2)
    limit = -math.log10(result.tolerance)
    ax.axvline(limit, color=palette.muted, linestyle=(0, (2, 2)), linewidth=1.0)
    side = "left" if limit < (begin + _SAME) / 2 else "right"
    text = f" tolerance {result.tolerance:g} "
    ax.text(limit, -0.75, text, color=palette.muted, ha=side, va="center", fontsize=9)
    ax.set_xlim(begin - 0.1, _SAME + 0.3)
    ax.set_xticks([*ticks, _SAME], [*map(str, ticks), "same"])
    ax.set_xlabel("digits of agreement, −log₁₀ of the relative error")
    ax.grid(axis="x")
    ax.tick_params(axis="y", length=0)
    handles = ax.get_legend_handles_labels()[0]
    legend(ax, handles, "upper", own=own, columns=3 if own and len(max(engines, key=len, default="")) < 12 else 2)
    return figure_of(ax)


def _shown_digits(error: float) -> float:
    return 0.0 if math.isnan(error) else _SAME if error == 0 else min(max(-math.log10(error), 0.0), 16.5)
