"""Velocity and acceleration of a motion law, exactly differentiated."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from mbkit.derivation.elements.arithmetic import casadi_arithmetic
from mbkit.model.elements.motion_laws import Motion, position


def law_rates(motion: Motion) -> Callable[[float], tuple[float, float, float]]:
    """Return a function of the time, s, that gives a motion's x, ẋ and ẍ at its own numbers."""
    t = ca.SX.sym("t")
    x = ca.SX(position(motion, t, casadi_arithmetic()))
    speed = ca.jacobian(x, t)
    call = ca.Function("law", [t], [ca.densify(e) for e in (x, speed, ca.jacobian(speed, t))])

    def rates(time: float) -> tuple[float, float, float]:
        at, first, second = call(time)
        return float(at), float(first), float(second)

    return rates
