"""`all_robots`: compare the engines on every robot of example-robot-data."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Literal

from mbkit.engines.registry import STANDARD
from mbkit.errors import MbkitError, MbkitWarning, UnknownNameError
from mbkit.load import load, robots
from mbkit.load.loader import find
from mbkit.simulate.plotting.style import log_ticks, name_points, new_figure
from mbkit.studies import document as doc
from mbkit.studies import results
from mbkit.studies.compare.figure import shown_error
from mbkit.studies.compare.result import Comparison, states_text
from mbkit.studies.compare.study import compare
from mbkit.studies.formatting import error_text
from mbkit.studies.svg import PAGE, page_style, svg
from mbkit.studies.worker import run

Status = Literal["agree", "differ", "refused", "failed"]
STATUSES: Final[tuple[Status, ...]] = ("agree", "differ", "refused", "failed")


_STATUS: Final = {
    "agree": doc.Span("✓ agree", "good"),
    "refused": doc.Span("– refused", "allowed"),
    "differ": doc.Span("✗ differ", "bad"),
    "failed": doc.Span("✗ failed", "bad"),
}


@dataclass(frozen=True)
class RobotOutcome:
    """How one robot ended."""

    robot: str
    status: Status  # "refused": by the file, or by all engines but one; "failed": an error of mbkit
    reason: str = ""  # why not all engines agree
    comparison: Comparison | None = None


@dataclass(frozen=True)
class Sweep(results.ResultTable):
    """The outcomes of many robots."""

    outcomes: tuple[RobotOutcome, ...]
    expected: int  # more than there are outcomes after an interruption
    engines: tuple[str, ...]
    samples: int
    seed: int
    seconds: float
    versions: dict[str, str] = field(default_factory=results.versions)
    processor: str = field(default_factory=results.processor)

    @property
    def counts(self) -> dict[str, int]:
        """How many ended in which status."""
        number = Counter(o.status for o in self.outcomes)
        return {status: number[status] for status in STATUSES}

    @property
    def passed(self) -> bool:
        """Whether all were reached, one agrees at least, and each other does too or is refused with a reason."""
        states = {o.status for o in self.outcomes}
        return len(self.outcomes) == self.expected and "agree" in states and states <= {"agree", "refused"}

    @property
    def verdict(self) -> str:
        """One sentence: how many agree, in how many engines, and what became of the others."""
        agreed = [o.comparison for o in self.outcomes if o.status == "agree" and o.comparison]
        parts = []
        for n, count in sorted(Counter(len(c.engines) for c in agreed).items(), reverse=True):
            digits = min(c.digits for c in agreed if len(c.engines) == n)
            parts.append(f"{count} agree in {n} engines, to {digits:.1f} digits or more")
        counts = self.counts
        parts += [f"{counts[status]} {status}" for status in STATUSES[1:] if counts[status]]
        missing = self.expected - len(self.outcomes)
        parts += [f"{missing} not reached"] if missing else []
        return f"{self.expected} robots: " + ("; ".join(parts) or "nothing compared")

    def document(self) -> doc.Document:
        """Return the document of many robots."""
        reasons = [
            doc.Bullet(o.robot, o.reason, _STATUS[o.status].text[0], _STATUS[o.status].style)
            for o in self.outcomes
            if o.reason
        ]
        compared = any(o.comparison and o.comparison.rows for o in self.outcomes)
        about = "Worst relative error of any term and state, one marker per robot; the dotted line is the tolerance."
        columns = (
            doc.Column("result", lambda o: _STATUS[o.status], width=9),
            doc.Column("robot", lambda o: o.robot, width=20),
            doc.Column("nv", _of(lambda c: str(c.facts["nv"])), right=True, width=3),
            doc.Column("engines", _of(lambda c: str(len(c.engines))), right=True, width=7, on="terminal"),
            doc.Column("engines", _of(lambda c: ", ".join(c.engines)), on="page"),
            doc.Column("digits", _of(lambda c: f"{c.digits:.1f}" if c.worst else ""), right=True, width=6),
            doc.Column("worst", _of(lambda c: error_text(c.worst.relative) if c.worst else ""), right=True, width=7),
            doc.Column("where", _of(lambda c: f"{c.worst.term}, {c.worst.engine}" if c.worst else ""), on="page"),
        )
        return doc.Document(
            name="",
            heading="All robots of example-robot-data",
            title=f"all robots: {'agree' if self.passed else 'differ'}",
            verdict=self.verdict,
            sentence=self._sentence(),
            good=self.passed,
            opening=[doc.Figure(lambda: drawn_robots(self), about)] if compared else [],
            sections=[
                doc.Section("Robot by robot", [doc.Table(columns, self.outcomes, dense=True)]),
                doc.Section("Reasons", [doc.Items(reasons)]),
            ],
            result=self,
            basis=states_text(self.samples, self.seed),
            last=True,
        )

    def _sentence(self) -> str:
        states = [c.rows[0].samples for o in self.outcomes if (c := o.comparison) and c.rows]
        if not states:
            return self.verdict
        least, most = min(states), max(states)
        span = f"{least} to {most}" if least != most else f"{least}"
        return f"{self.verdict}; each against its own derivation evaluated with 34 digits, at {span} states"

    _derived = ("passed", "verdict", "counts")
    _listed = "outcomes"
    _csv_columns = results.columns_of(RobotOutcome)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        out = super().to_dict()
        return out | {"robots": out.pop("outcomes")}


def _of(text: Callable[[Any], str]) -> Callable[[RobotOutcome], str]:
    return lambda o: text(o.comparison) if o.comparison else ""


_GROUP_MARKS: Final = "osD^vP"


def drawn_robots(result: Sweep) -> str:
    """Draw the worst error of each robot against its size."""
    groups: dict[tuple[str, ...], list[tuple[int, float, str]]] = {}
    compared = [(o.robot, o.comparison) for o in result.outcomes if o.comparison is not None]
    for robot, c in compared:
        if (worst := c.worst) is not None:
            text = f"{robot}: {error_text(worst.relative)}, {worst.term} of {worst.engine}"
            groups.setdefault(c.engines, []).append((int(c.facts["nv"]), shown_error(worst.relative, 1e-17), text))
    with page_style("robots"):
        fig = new_figure(7.2, 3.4)
        ax = fig.add_subplot()
        for k, (engines, points) in enumerate(groups.items()):
            nv, errors, texts = zip(*points, strict=True)
            look: dict[str, Any] = {"color": PAGE.series[k % 6], "label": ", ".join(engines)}
            name_points(ax.plot(nv, errors, _GROUP_MARKS[k % 6], **look), texts)
        ax.set_yscale("log")
        ax.set_xlabel("velocities, nv")
        ax.set_ylabel("worst relative error")
        ax.grid()
        for tolerance in {c.tolerance for _, c in compared}:
            ax.axhline(tolerance, color=PAGE.muted, linestyle=(0, (2, 2)), linewidth=1.0)
        log_ticks(ax)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
        return svg(fig, "Worst relative error of each robot against its size")


def all_robots(
    names: Sequence[str] | None = None,
    *,
    engines: Sequence[str] = STANDARD,
    samples: int = 64,
    seed: int = 0,
    floating_base: bool = False,
    mimic: Literal["reduce", "free"] = "reduce",
    executor: Executor | None = None,
    jobs: int | None = None,
) -> Iterator[RobotOutcome]:
    """Compare the terms of many robots, each in its own call to an executor, and yield each as it finishes.

    Parameters as in `mbkit.compare` and `mbkit.load`; `names` are all of `mbkit.robots` by default. The executor is
    any of `concurrent.futures`; by default `jobs` worker processes, for which a script needs
    ``if __name__ == "__main__":``. Nothing that happens to one robot ends the others.
    """
    known = {r.name: r.path for r in robots()}
    shorter = {alias: r.name for r in robots() for alias in r.aliases}
    wanted = []
    for name in known if names is None else names:
        if name not in known and name not in shorter:
            raise UnknownNameError("robot", name, [*shorter, *known])
        wanted.append(shorter.get(name, name))
    # The largest first, or the last processor would work alone at the end.
    wanted.sort(key=lambda n: -known[n].stat().st_size if known[n].exists() else 0)
    calls = {
        name: partial(outcome_of, name, tuple(engines), samples, seed, floating_base=floating_base, mimic=mimic)
        for name in wanted
    }
    for name, result in run(calls, executor=executor, jobs=jobs):
        if isinstance(result, Exception):
            yield RobotOutcome(name, "failed", f"{type(result).__name__}: {result}")
        else:
            yield result


def outcome_of(
    name: str,
    engines: tuple[str, ...],
    samples: int,
    seed: int,
    *,
    floating_base: bool,
    mimic: Literal["reduce", "free"],
) -> RobotOutcome:
    """Compare one robot, and return how it ended."""
    with warnings.catch_warnings(action="ignore", category=MbkitWarning):
        # Nonphysical bodies are in the comparison's facts.
        try:
            model = load(name, floating_base=floating_base, mimic=mimic)
        except MbkitError as error:
            file = find(name)
            return RobotOutcome(name, "refused", str(error).removeprefix(f"{file.path}: " if file else ""))
        result = compare(model, engines, samples, seed, terms_only=True)
    reasons = (f"{r.name}: {r.reason}" for r in result.refusals)
    refused = "; ".join(dict.fromkeys(reasons))
    if result.nothing:
        return RobotOutcome(name, "refused", refused or result.verdict, result)
    if result.passed:
        allowed = [f"{r.engine}, {r.term}: {r.reason}" for r in result.rows if r.reason]
        return RobotOutcome(name, "agree", "; ".join([*allowed, *([refused] if refused else [])]), result)
    failed = "; ".join(f"{r.engine}, {r.term}: {r.reason}" for r in result.rows if not r.passed)
    return RobotOutcome(name, "differ", failed + (f"; {refused}" if refused else ""), result)
