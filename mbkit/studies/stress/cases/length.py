"""Chains from short to long."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit import catalog
from mbkit._check import Array
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import terms_at

__all__ = ["CASES", "straight_inertia"]


def straight_inertia(n: int) -> Array:
    """Return M of a straight chain of n thin rods of 1 kg and 1 m, in angles from rod to rod.

    A turn of joint j moves rod i ≥ j as a whole: M_jk = Σ over the rods i ≥ j, k of (i - j + ½)(i - k + ½) + 1/12.
    """
    rods, joints = np.arange(n)[:, None], np.arange(n)
    arms = np.where(rods >= joints, rods - joints + 0.5, 0.0)
    return np.asarray(arms.T @ arms + (n - np.maximum.outer(joints, joints)) / 12)


def _chain(n: float) -> Problem:
    rods = round(n)
    cond = float(np.linalg.cond(straight_inertia(rods)))
    facts = {"cond(M) straight": cond, "cond(M) / N⁴": cond / rods**4}
    return terms_at(catalog.chain(n=rods), samples=4, facts=facts)


CASES: Final = (
    Case(
        "chain",
        "Terms of a planar chain of thin rods, straight and bent: its condition number grows as the fourth power.",
        "length",
        "rods",
        "",
        tuple(2.0**k for k in range(1, 9)),
        (2.0, 8.0, 32.0),
        _chain,
        "terms",
        # The longest take a minute to derive, with 34 digits.
        patience=6.0,
    ),
)
