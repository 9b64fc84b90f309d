"""Many steps, and whether the energy stays."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit import catalog
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import powers

__all__ = ["CASES"]

#: RK4 drifts over the bar between a million steps and ten, the midpoint rule never does.
_STEP: Final = 4e-3


def _steps(count: float) -> Problem:
    return Problem(
        catalog.double_pendulum(),
        np.array([2.0, 1.0]),
        np.zeros(2),
        duration=count * _STEP,
        dt=_STEP,
        facts={"duration, s": count * _STEP},
    )


CASES: Final = (
    Case(
        "long_run",
        "A double pendulum, chaotic from (2, 1) rad at rest, for ever more steps of 4 ms.",
        "long",
        "steps",
        "",
        powers(3, 7),
        (1e3, 1e4, 1e5),
        _steps,
        "energy",
        bar=1e-3,
        why=(
            "along a chaotic motion only what is conserved can be compared; a thousandth of the energy is half a "
            "thousandth of the speed, which no plot shows"
        ),
        methods=(
            "rk4",
            "semi_implicit_euler",
            "implicit_midpoint",
            "gauss4",
            "gauss6",
            "mujoco_euler",
            "mujoco_rk4",
            "mujoco_implicit",
            "mujoco_implicitfast",
            "mujoco_discrete",
            "rk853",
            "taylor",
            "auto",
        ),
        patience=6.0,
    ),
)
