"""The end of a step under constraints: positions projected onto f = 0, velocities onto all rows, as CasADi expressions.

The equation of motion holds J v̇ + γ = 0 only, so that f and the rates drift by the step's own error. With (q, v) at the
end of the step, Y = M⁻¹ Jᵀ there, and the drift taken away in the metric of the mass matrix ::

    q1 = q ⊕ Y λ      f(q1) = 0      v1 = v + Y μ      J(q1) v1 + c(q1) = 0

the order of the method stays (Hairer, Lubich, Wanner 2006, Geometric Numerical Integration, algorithm IV.4.2). Rows
that hold velocities alone move no position: the coordinates go where the velocities led them.

λ and μ are found by the simplified Newton iteration, with the factors of forward dynamics at q. As a rule one iteration
is enough, even with the factors that the last stage has left: the drift is that of a step, and the stage is near the
end. `quick_projection` says where that leaves more than rounding, and the step is then taken again with
`thorough_projection`. Both have the same result, to rounding, as `mbkit.engines.constraint_manifold.Manifold.pulled`,
which goes on for as long as it takes.
"""

from __future__ import annotations

from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit._check import PROBES
from mbkit.derivation.equations import kept
from mbkit.derivation.mass_matrix_solve import ConstraintTerms
from mbkit.derivation.steps.symbols import SymbolicSpace
from mbkit.methods.one_step import STEPS_TO_POSE
from mbkit.model.manifold import random_state

#: Number of iterations of the thorough projection.
_ITERATIONS: Final = 4
#: Largest error that an iteration may leave, relative to coordinates and velocities, if rows bend as much as they
#: slope.
_MAX_ERROR: Final = 1e-16
#: Largest residual by rounding, relative to the sizes of J and of the state.
_MAX_RESIDUAL: Final = 4e-16


@kept
def quick_projection(equations: Any) -> ca.Function:
    """Return (q, v, near, more) -> (q1, v1, far): the consistent state beside a step's end.

    The factors are those at the configuration `near`; far is 1 where one iteration leaves more than rounding.
    """
    c: ConstraintTerms = equations.constraints
    q, v, extra = equations.q, equations.v, equations.extra_arguments
    near, by = ca.SX.sym("near", *q.shape), ca.SX.sym("by", *v.shape)
    more, shift, change = [*extra.values()], *(_change(equations, rows=n) for n in (c.positions, c.jacobian.shape[0]))
    du = ca.densify(shift(near, c.value, *more))
    # To first order in the move: the rest is its square times the velocity.
    rate = ca.substitute(c.rate + c.rate_along(by), by, du)
    dv = change(near, rate, *more)
    size, apart = ca.sumsqr(du), ca.sumsqr(q - near)
    left = (size + ca.sumsqr(dv)) * (size + apart)
    far = left > _MAX_ERROR**2 * (1 + ca.sumsqr(q) + ca.sumsqr(v))
    outs = [_moved(equations, q, du), v + dv, far]
    return ca.Function("quick_projection", [q, v, near, *more], outs)


@kept
def thorough_projection(equations: Any, *, exact: bool = False) -> ca.Function:
    """Return (q, v, more) -> (q1, v1, far): the consistent state near a step's end, and 1 where it is too far.

    In more digits than double precision has, `exact` takes all iterations.
    """
    name = "thorough_projection" + ("_exact" if exact else "")
    q, v, extra = equations.q, equations.v, equations.extra_arguments
    q1, v1, _, far = projection(equations, exact=exact)(q, v, ca.SX(v.shape[0], 1), *extra.values())
    return ca.Function(name, [q, v, *extra.values()], [q1, v1, far])


@kept
def projection(equations: Any, *, exact: bool = False) -> ca.Function:
    """Return (q, v, moved, more) -> (q1, v1, moved1, far): some iterations onto the constraints from a step's end.

    They begin with q ⊕ moved and end with q1 = q ⊕ moved1; far is 1 where others would change more than rounding.
    """
    name = "projection" + ("_exact" if exact else "")
    c: ConstraintTerms = equations.constraints
    q, v, extra = equations.q, equations.v, equations.extra_arguments
    more, shift, change = [*extra.values()], *(_change(equations, rows=n) for n in (c.positions, c.jacobian.shape[0]))
    rows = ca.Function("rows", [q, v, *more], [c.value, c.rate])
    start = moved = ca.SX.sym("moved", *v.shape)
    q1, v1 = _moved(equations, q, start), v
    f, _ = rows(q1, v, *more)
    # A residual of rounding stays: the factors of a singular pose nearby would make a change of state of it.
    slopes = ca.sumsqr(c.jacobian)
    left = ca.sumsqr(f) > _MAX_RESIDUAL**2 * slopes * (1 + ca.sumsqr(q))
    # The error that is left later is about the product of the last change and of the way from q, where the factors are,
    # if rows bend as much as they slope.
    for _ in range(_ITERATIONS):
        by = shift(q, rows(q1, v, *more)[0], *more)
        by = by if exact else ca.if_else(left, by, 0)
        moved = moved + by
        q1 = _moved(equations, q, moved)
        left = ca.sumsqr(moved) * ca.sumsqr(by) > _MAX_ERROR**2 * (1 + ca.sumsqr(q1))
    far, (_, rate) = left, rows(q1, v, *more)
    left = ca.sumsqr(rate) > _MAX_RESIDUAL**2 * slopes * ca.sumsqr(v)
    for _ in range(_ITERATIONS):
        by = change(q, rows(q1, v1, *more)[1], *more)
        by = by if exact else ca.if_else(left, by, 0)
        v1 = v1 + by
        left = ca.sumsqr(moved) * ca.sumsqr(by) > _MAX_ERROR**2 * (1 + ca.sumsqr(v1))
    far = ca.logic_or(far, left)
    return ca.Function(name, [q, v, start, *more], [q1, v1, moved, far])


def _moved(equations: Any, q: Any, by: Any) -> Any:
    space = SymbolicSpace(equations.model)
    return space.retract(q, space.to_integrator_velocity(q, by))


def rows_change(equations: Any) -> ca.Function:
    """Return (q, residual, more) -> the least change of velocities, in the metric of M, by which all rows lose one."""
    return _change(equations, rows=equations.constraints.jacobian.shape[0])


@kept
def _change(equations: Any, *, rows: int) -> ca.Function:
    """Return (q, residual, more) -> the least change of velocities, in the metric of M, by which rows lose a residual.

    These are the first rows. The factors are those of forward dynamics at q, which a program has once.
    """
    own, extra = equations.constraint_factors, equations.extra_arguments
    residual = ca.SX.sym("residual", rows)
    out = -own.change(residual, rows)
    return ca.Function(f"change_{rows}", [equations.q, residual, *extra.values()], [out])


@kept
def dependence(equations: Any) -> ca.Function:
    """Return (q, more) -> how nearly rows of J depend on each other.

    The largest ratio of a row's square at usual poses, in the metric of M, to that of its part beside the rows before
    it at q: infinite where a row follows from others or has no slope. Its root grows as the inverse of the distance.
    """
    left: Any = ca.SX(np.inf)
    for square, usual in zip(equations.constraint_factors.rows.remainders, _largest(equations), strict=True):
        left = ca.fmin(left, square / usual)
    given = [equations.q, *equations.extra_arguments.values()]
    return ca.Function("dependence", given, [1.0 / left])


def _largest(equations: Any) -> list[float]:
    """Return the largest squares of rows in the metric of M at some configurations, at nominal values of parameters."""
    model, extra = equations.model, equations.extra_arguments
    given = [np.array([1.0 if x is None else x for x in model.parameters.values()])] if extra else []
    diagonal = ca.Function(
        "squares", [equations.q, *extra.values()], [ca.densify(ca.vertcat(*equations.constraint_factors.rows.squares))]
    )
    poses = random_state(model, np.random.default_rng(0), PROBES)[0]
    values = np.array([np.array(diagonal(q, *given))[:, 0] for q in poses])
    return [float(x) for x in np.nanmax(values, axis=0)]


def nears_singular(before: Any, *behind: Any) -> Any:
    """Return 1 where a step that changes the `dependence` so would meet a singular pose within a few more of its kind.

    It is known at the start, and behind it at the end and between: the ends may be as far from a pose in the middle.
    With r = 1/√dependence, as far from such a pose: r1 < n abs(r1 - r0), or r1 > n/(n - 1) r0, or r1 < n/(n + 1) r0.
    """
    n = STEPS_TO_POSE
    nearer, farther = (n + 1) ** 2 / n**2, (n - 1) ** 2 / n**2
    # A sum, which NumPy and CasADi both know.
    return sum((x > nearer * before) + (x < farther * before) for x in behind) > 0
