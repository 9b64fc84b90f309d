"""The end of a step under constraints: positions projected onto f = 0, velocities onto all rows, as CasADi expressions.

The equation of motion holds J v̇ + γ = 0 only, so that f and the rates drift by the step's own error. Newton's iteration
in the metric of the mass matrix takes both to rounding, and the order of the method stays (Hairer, Lubich, Wanner 2006,
Geometric Numerical Integration, ch. IV.4). Rows that hold velocities alone move no position: the coordinates go where
the velocities led them.

As a rule one iteration is enough, with the factors that the last stage has left: the drift is that of a step, and the
stage is near the end. `quick_projection` says where it was not, and the step is then taken again with
`thorough_projection`, three iterations with factors of its own.
"""

from __future__ import annotations

from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit.derivation.constraints import ConstraintTerms
from mbkit.derivation.mass_matrix_solve import Factors
from mbkit.derivation.steps.symbols import SymbolicSpace
from mbkit.model.manifold import random_state

#: A pose is singular ahead where J's rows would depend on each other within so many steps at the present pace.
_AHEAD: Final = 4
#: Of the coordinates: what the last of three iterations may move. The next one would move it times the first one's.
_LAST: Final = 1e-11
#: Of the coordinates and velocities: about what one iteration may leave, if rows bend as much as they slope.
_LEFT: Final = 1e-16
#: Configurations at which the usual size of a row is found.
_POSES: Final = 8


def quick_projection(equations: Any) -> ca.Function:
    """Return (q, v, near, more) -> (q1, v1, far): the consistent state beside a step's end.

    The factors are those at the configuration `near`; far is 1 where one iteration leaves more than rounding.
    """
    if "quick projection" not in equations.kept:
        c: ConstraintTerms = equations.constraints
        q, v, extra = equations.q, equations.v, equations.extra_arguments
        near, by = ca.SX.sym("near", *q.shape), ca.SX.sym("by", *v.shape)
        more, shift, change = [*extra.values()], _shift(equations), _change(equations)
        du = ca.densify(shift(near, c.value, *more))
        # To first order in the move: the rest is its square times the velocity.
        rate = ca.substitute(c.rate + c.rate_along(by), by, du)
        dv = change(near, rate, *more)
        size, apart = ca.sumsqr(du), ca.sumsqr(q - near)
        left = (size + ca.sumsqr(dv)) * (size + apart)
        far = left > _LEFT**2 * (1 + ca.sumsqr(q) + ca.sumsqr(v))
        outs = [_moved(equations, q, du), v + dv, far]
        equations.kept["quick projection"] = ca.Function("quick_projection", [q, v, near, *more], outs)
    out: ca.Function = equations.kept["quick projection"]
    return out


def thorough_projection(equations: Any) -> ca.Function:
    """Return (q, v, more) -> (q1, v1, far): the consistent state near a step's end, and 1 where it is too far."""
    if "thorough projection" not in equations.kept:
        c: ConstraintTerms = equations.constraints
        q, v, extra = equations.q, equations.v, equations.extra_arguments
        more, shift, change = [*extra.values()], _shift(equations), _change(equations)
        rows = ca.Function("rows", [q, v, *more], [c.value, c.rate])
        q1 = _moved(equations, q, shift(q, c.value, *more))
        q1 = _moved(equations, q1, shift(q, rows(q1, v, *more)[0], *more))
        residual, rate = rows(q1, v, *more)
        v1 = v + change(q, rate, *more)
        v1 = v1 + change(q, rows(q1, v1, *more)[1], *more)
        last = shift(q, residual, *more)
        far = ca.sumsqr(last) > _LAST**2 * (1 + ca.sumsqr(q1))
        outs = [_moved(equations, q1, last), v1, far]
        equations.kept["thorough projection"] = ca.Function("thorough_projection", [q, v, *more], outs)
    out: ca.Function = equations.kept["thorough projection"]
    return out


def _moved(equations: Any, q: Any, by: Any) -> Any:
    space = SymbolicSpace(equations.model)
    return space.retract(q, space.to_integrator_velocity(q, by))


def _shift(equations: Any) -> ca.Function:
    """Return the same as `_change` for the rows that hold positions alone."""
    k, rows = equations.constraints.positions, equations.constraints.jacobian.shape[0]
    if k == rows:
        return _change(equations)
    if "shift" not in equations.kept:
        own, extra = equations.constraint_factors, equations.extra_arguments
        residual = ca.SX.sym("residual", k)
        held = Factors(own.matrix[:k, :k], range(k)).solve(residual) if k else residual
        out = -ca.mtimes(own.Y[:, :k], held)
        equations.kept["shift"] = ca.Function("shift", [equations.q, residual, *extra.values()], [out])
    shift: ca.Function = equations.kept["shift"]
    return shift


def _change(equations: Any) -> ca.Function:
    """Return (q, residual, more) -> -M⁻¹ Jᵀ S⁻¹ residual: the least change of velocities by which rows lose a residual.

    Its factors are those of forward dynamics at q, which a program has once.
    """
    if "change" not in equations.kept:
        own, extra = equations.constraint_factors, equations.extra_arguments
        residual = ca.SX.sym("residual", equations.constraints.jacobian.shape[0])
        out = -ca.mtimes(own.Y, own.S.solve(residual))
        equations.kept["change"] = ca.Function("change", [equations.q, residual, *extra.values()], [out])
    change: ca.Function = equations.kept["change"]
    return change


def dependence(equations: Any) -> ca.Function:
    """Return (q, more) -> how nearly rows of J depend on each other.

    The largest ratio of a pivot of S at usual poses to the one at q: about 1, and infinite where a row follows from
    others or has no slope. Its root grows as the inverse of the distance from such a pose.
    """
    if "dependence" not in equations.kept:
        worst: Any = 0.0
        for inverse, size in zip(equations.constraint_factors.S.inverse, _largest(equations), strict=True):
            worst = ca.fmax(worst, size * inverse)
        given = [equations.q, *equations.extra_arguments.values()]
        equations.kept["dependence"] = ca.Function("dependence", given, [worst])
    out: ca.Function = equations.kept["dependence"]
    return out


def _largest(equations: Any) -> list[float]:
    """Return the largest diagonal entries of S at some configurations, at the nominal values of parameters."""
    model, extra = equations.model, equations.extra_arguments
    given = [np.array([1.0 if x is None else x for x in model.parameters.values()])] if extra else []
    diagonal = ca.Function(
        "S", [equations.q, *extra.values()], [ca.densify(ca.diag(equations.constraint_factors.matrix))]
    )
    poses = random_state(model, np.random.default_rng(0), _POSES)[0]
    values = np.array([np.array(diagonal(q, *given))[:, 0] for q in poses])
    return [float(x) for x in np.nanmax(values, axis=0)]


def nears_singular(before: Any, behind: Any) -> Any:
    """Return 1 where a step that changes the `dependence` so would meet a singular pose within a few more of its kind.

    With r = 1/√dependence, as far from such a pose: r1 < n abs(r1 - r0), or r1 > n/(n - 1) r0, or r1 < n/(n + 1) r0.
    """
    nearer, farther = (_AHEAD + 1) ** 2 / _AHEAD**2, (_AHEAD - 1) ** 2 / _AHEAD**2
    return ca.logic_or(behind > nearer * before, behind < farther * before)
