"""Motion laws and joint forces of a model in SymPy: its formulas on exact numbers and symbols."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import sympy as sp

from mbkit.lagrangian.description_kinematics import SymbolicKinematics, exact, read_angle
from mbkit.model.elements.forces import RATE, TIME, JointElement
from mbkit.model.elements.formula import Arithmetic, completed
from mbkit.model.elements.motion_laws import MOTION_LAWS, Motion
from mbkit.model.parts import rules_of


def _select(holds: Any, yes: Any, no: Any) -> Any:
    return sp.Piecewise((yes, holds), (no, True))


def _condition(x: Any) -> Any:
    """Return what makes a decision of 1 or 0 true; one that is a choice of these is read back."""
    x = sp.sympify(x)
    if isinstance(x, sp.Piecewise) and x.args[0][0] == 1 and len(x.args) == 2:
        return x.args[0][1]
    return sp.Ne(x, 0)


def _same(name: str) -> Callable[..., Any]:
    return lambda *x: getattr(sp, name)(*map(sp.sympify, x))


_SAME_NAME: Final = "sqrt sin cos tan asin acos atan exp log sinh cosh tanh asinh acosh atanh atan2 sign"
_CONDITIONS: Final = {"lt": sp.Lt, "le": sp.Le, "eq": sp.Eq, "ne": sp.Ne, "and": sp.And, "or": sp.Or}
#: The operations of formulas in SymPy, on the decimals that were written.
SYMPY: Final = Arithmetic(
    exact,
    completed(
        {
            **{name: _same(name) for name in _SAME_NAME.split()},
            "fabs": _same("Abs"),
            "fmin": _same("Min"),
            "fmax": _same("Max"),
            "expm1": lambda x: sp.exp(x) - 1,
            "log1p": lambda x: sp.log(1 + x),
            "div": lambda a, b: sp.sympify(a) / b,
            "pow": lambda a, b: sp.sympify(a) ** b,
            "not": lambda x: _select(sp.Not(_condition(x)), 1, 0),
        },
        sp.Integer,
        _select,
        _CONDITIONS,
        _condition,
    ),
)


def law(kin: SymbolicKinematics, part: Motion, t: sp.Symbol) -> sp.Expr:
    """Return a motion in time as a function of it."""
    numbers = kin.written.values.of(part)
    if hasattr(numbers, "knots"):
        return _pieces(numbers, t)
    units = ("rad", "rad, m") if kin.model.joint(part.joint).type.angular else ("rad",)
    for name in (n for n, rule in rules_of(type(part)).items() if rule.added and rule.unit in units):
        setattr(numbers, name, read_angle(getattr(numbers, name)))
    return sp.sympify(MOTION_LAWS[type(part)](part, numbers, t, SYMPY))


def _pieces(numbers: Any, t: sp.Symbol) -> sp.Expr:
    """Return a spline as polynomials between its knots; the last one goes on."""
    knots, out = numbers.knots, []
    for k in range(len(knots) - 1):
        s, polynomial = t - knots[k], sp.Integer(0)
        for row in numbers.coefficients:
            polynomial = polynomial * s + row[k]
        out.append((polynomial, t < knots[k + 1] if k < len(knots) - 2 else sp.true))
    return sp.Piecewise(*out)


def acting(kin: SymbolicKinematics, t: sp.Symbol) -> tuple[sp.Expr, list[sp.Expr]]:
    """Return the potential of joint forces and weights' compensations, and one force along each coordinate."""
    model = kin.model
    V, forces = kin.compensation_energy, [sp.Integer(0)] * model.nv
    for force in model.forces:
        if not isinstance(force, JointElement):
            continue
        joints, constants = [model.joint(x) for x in force.joints], kin.written.values.of(force).numbers
        coordinates = [x for j in model.independent_joints for x in kin.described(j)]
        others = dict(
            zip(
                (*model.coordinate_names, *(n + RATE for n in model.velocity_names)),
                (*coordinates, *kin.rates),
                strict=True,
            )
        )
        rates = [x for j in joints for x in kin.rates_of[j.name]]
        described = [x for j in joints for x in kin.described(j)]
        own = dict(zip(force.own(model), (*described, *rates), strict=True))
        values = others | dict(zip(force.symbols, constants, strict=True)) | {TIME: t} | own
        if force.potential is not None:
            V += force.potential(values, SYMPY)[0]
        if force.formula is not None:
            for x, rate in zip(force.formula(values, SYMPY), rates, strict=True):
                for i, w in enumerate(kin.rates):
                    forces[i] += x * sp.diff(rate, w)
    return V, forces
