"""`diff`: what two baselines differ in."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from mbkit.errors import BaselineError
from mbkit.studies.baseline import versions
from mbkit.studies.baseline.changes import changes
from mbkit.studies.baseline.content import Baseline
from mbkit.studies.baseline.file import read
from mbkit.studies.baseline.links import without_consequences
from mbkit.studies.baseline.result import BaselineResult, Status
from mbkit.studies.baseline.yardstick import FINE, OWN, Moved, Yardstick
from mbkit.studies.result import Refusal

__all__ = ["diff"]


def diff(path_a: str | os.PathLike[str], path_b: str | os.PathLike[str]) -> BaselineResult:
    """Say what the second of two baselines has that the first has not.

    Nothing is computed: it reads what was recorded. Numbers are the oracle's, so they tell what
    became of the robot; engines' own are compared where they were recorded.

    Parameters
    ----------
    path_a, path_b : path

    Returns
    -------
    BaselineResult
        With all that differs: parameters, numbers and versions.

    Raises
    ------
    BaselineError
        A file cannot be read, or the two are of different robots.
    """
    a, b = read(path_a), read(path_b)
    if a.model != b.model and not set(a.coordinates) & set(b.coordinates):
        raise BaselineError(
            f"{path_a} is a baseline of {a.model!r}, {path_b} of {b.model!r}; they have no joint in common"
        )
    notes = _notes(a, b)
    rows: list[Moved] = []
    if not notes:
        rows = _rows(a, b)
    found = without_consequences(changes(a.description, b.description), a.description)
    moved = versions.moved(a.versions, b.versions)
    status: Status = "description" if found else "numbers" if rows or notes else "versions" if moved else "same"
    return BaselineResult(
        question="diff",
        model=a.model,
        path=os.fspath(path_a),
        against=os.fspath(path_b),
        status=status,
        engines=tuple(e for e in a.engines if e in b.engines),
        changes=found,
        moved=tuple(rows),
        versions=moved,
        processors=(a.processor, b.processor),
        skipped=tuple(
            Refusal(e, "", f"in {path_a if e in a.engines else path_b} alone")
            for e in dict.fromkeys([*a.engines, *b.engines])
            if (e in a.engines) != (e in b.engines)
        ),
        notes=tuple(notes),
    )


def _notes(a: Baseline, b: Baseline) -> list[str]:
    """Return why numbers cannot be compared."""
    if a.coordinates != b.coordinates or a.velocities != b.velocities:
        return ["the coordinates are others, so no number can be compared"]
    same = all(np.array_equal(getattr(a.states, x), getattr(b.states, x)) for x in ("q", "v", "a", "tau"))
    if same and a.rollout == b.rollout:
        return []
    return [
        f"the states are others (seed {a.seed} and {b.seed}, {len(a.states.q)} and {len(b.states.q)} of them), "
        "so no number can be compared"
    ]


def _rows(a: Baseline, b: Baseline) -> list[Moved]:
    yardstick = Yardstick.of(a)
    moved = versions.moved(a.versions, b.versions)
    rows = []
    for term, x in a.terms.items():
        if term in b.terms and (row := yardstick.moved("oracle", term, b.terms[term], x, FINE)):
            rows.append(row)
    for engine, terms in a.own.items():
        for term, x in terms.items():
            y = b.own.get(engine, {}).get(term)
            if y is None and term in b.errors.get(engine, {}):
                y = b.terms[term]
            if y is not None and (row := yardstick.moved(engine, term, y, x, OWN)):
                rows.append(replace(row, cause=versions.of_engine(engine, a.versions, moved)))
    return rows
