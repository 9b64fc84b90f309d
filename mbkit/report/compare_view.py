"""What is read from a comparison: the headline, what failed, rows term by term."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

from mbkit.report.formatting import time_text
from mbkit.studies.compare.result import Comparison, Omission, RolloutRow, Row
from mbkit.studies.results import Refusal

__all__ = [
    "Failure",
    "Notice",
    "allowances",
    "by_term",
    "failures",
    "headline",
    "judged",
    "notices",
    "omission_state",
    "saving_text",
    "told",
]

# Rounding stays far below this, and anything that acts is far above.
_VISIBLE: Final = 1e-6


@dataclass(frozen=True)
class Failure:
    """One thing that differs, or may; `row` is there for terms."""

    what: str
    reason: str
    row: Row | None = None


@dataclass(frozen=True)
class Notice:
    """Something an engine could not do, for all the terms that it meets."""

    engine: str
    terms: tuple[str, ...]
    reason: str


def headline(result: Comparison) -> str:
    """Return the verdict in one sentence that stays short however much differs."""
    if result.nothing:
        return result.verdict
    if result.passed or result.only_known_defects:
        return result.verdict
    parts = []
    for some, all_, what in (
        (sum(not r.passed for r in result.rows), len(result.rows), "comparisons of terms"),
        (sum(not r.passed for r in result.rollouts), len(judged(result)), "rollouts"),
        (sum(not o.unchanged for o in result.omissions), len(result.omissions), "omissions"),
    ):
        parts += [f"{some} of {all_} {what}"] if some else []
    # Rows are measured by the oracle: what differs is who fails. Rollouts are measured by MuJoCo's own.
    rows = [r for r in result.rows if not r.passed]
    who = dict.fromkeys([*(r.engine for r in rows), *(r.engine for r in result.rollouts if not r.passed)])
    known = len([r for r in rows if r.defect])
    by_defect = f" ({known} by a known defect of {_engines(r for r in rows if r.defect)})" if known else ""
    missing = "".join(f"; {x}" for x in result.shortened)
    subject = f"{', '.join(who)} differ{'s' * (len(who) == 1)}: " if who else ""
    return f"{subject}{', '.join(parts)}{by_defect}{missing}"


def _engines(rows: Iterable[Row]) -> str:
    return ", ".join(dict.fromkeys(r.engine for r in rows))


def judged(result: Comparison) -> list[RolloutRow]:
    """Return the rollouts that can fail."""
    return [r for r in result.rollouts if math.isfinite(r.tolerance)]


def told(result: Comparison) -> list[RolloutRow]:
    """Return the rollouts that are there for information, with an infinite tolerance."""
    return [r for r in result.rollouts if not math.isfinite(r.tolerance)]


def saving_text(omission: Omission) -> str:
    """Return the time that leaving a thing out saves at each call, with its spread, where it can be measured."""
    if math.isnan(omission.saved_ns):
        return ""
    if not omission.measurable:
        return "not measurable"
    return f"{time_text(omission.saved_ns * 1e-9)} ± {time_text(omission.saved_spread * 1e-9)}"


def omission_state(omission: Omission) -> Literal["on", "same", "chosen", "changed"]:
    """Return whether the thing was on, off without effect, off by choice, or off to an effect."""
    if math.isnan(omission.change):
        return "on"
    if not omission.unchanged:
        return "changed"
    return "chosen" if omission.present and omission.change > _VISIBLE else "same"


def failures(result: Comparison) -> list[Failure]:
    """Return everything that differs, with its reason."""
    out = [Failure(f"{r.term}, {r.engine}", r.reason or "differs", r) for r in result.rows if not r.passed]
    for r in result.rollouts:
        if not r.passed:
            reason = f"differs from {r.against} by {r.error:.1e} in q, {r.tolerance:.0e} expected"
            out.append(Failure(f"rollout {r.method}, {r.engine}", reason + (f"; {r.note}" if r.note else "")))
    out += [
        Failure(f"leaving out {o.need}", f"changes the accelerations by {o.change:.1e}")
        for o in result.omissions
        if not o.unchanged
    ]
    return out


def allowances(result: Comparison) -> list[Failure]:
    """Return the rows that passed above the tolerance, with the reason why."""
    return [Failure(f"{r.term}, {r.engine}", r.reason, r) for r in result.rows if r.passed and r.reason]


def by_term(result: Comparison) -> dict[str, dict[str, Row]]:
    """Return term -> engine -> row, terms in their order."""
    out: dict[str, dict[str, Row]] = {}
    for row in result.rows:
        out.setdefault(row.term, {})[row.engine] = row
    return out


def notices(refusals: Iterable[Refusal]) -> list[Notice]:
    """Return refusals with those of one reason taken together."""
    found: dict[tuple[str, str], list[str]] = {}
    for r in refusals:
        found.setdefault((r.engine, r.reason), []).extend([r.term] if r.term else [])
    return [Notice(engine, tuple(dict.fromkeys(terms)), reason) for (engine, reason), terms in found.items()]
