"""Coordinates that are moved in time, as expressions of it."""

from __future__ import annotations

from fractions import Fraction
from math import pi
from typing import Final

import sympy as sp

from mbkit.lagrangian.compact import number
from mbkit.lagrangian.symbolic_kinematics import SymbolicKinematics
from mbkit.model.parts import Prescribed

__all__ = ["angle", "motion"]

_EPS: Final = 2.0**-52


def motion(kin: SymbolicKinematics, given: Prescribed, t: sp.Symbol) -> sp.Expr:
    """Return offset + rate t + amplitude sin(frequency t + phase)."""
    fields = ("offset", "rate", "amplitude", "frequency", "phase")
    offset, rate, amplitude, frequency, phase = (kin.written("prescribed", given, f) for f in fields)
    if kin.model.joint(given.joint).type.angular:
        offset = _read(offset)
    return offset + rate * t + amplitude * sp.sin(frequency * t + _read(phase))


def angle(x: float) -> sp.Expr:
    """Return a number as people write an angle: a twelfth of π, and its multiples, where it is one to rounding."""
    twelfths = round(12 * x / pi)
    if abs(x - twelfths * pi / 12) <= 2 * _EPS * abs(x):
        return sp.Rational(twelfths, 12) * sp.pi
    return number(Fraction(repr(x)))


def _read(x: sp.Expr) -> sp.Expr:
    return angle(float(x)) if x.is_Number else x
