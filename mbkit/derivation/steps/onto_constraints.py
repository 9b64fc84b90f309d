"""The end of a step under constraints: projection onto f = 0 and ḟ = 0, as CasADi expressions.

The equation of motion holds f̈ = 0 only, so that f and ḟ drift by the step's own error. One step of Newton's iteration
in the metric of the mass matrix, and two more with the same factors, take both to rounding, and the order of the method
stays (Hairer, Lubich, Wanner 2006, Geometric Numerical Integration, ch. IV.4).
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
#: Of the coordinates: what the last iteration may move. The next one would move it times the first one's.
_LAST: Final = 1e-11
#: Configurations at which the usual size of a row is found.
_POSES: Final = 8


def projection(equations: Any) -> ca.Function:
    """Return (q, v, more) -> (q1, v1, reach, far): the consistent state near a step's end, and 1 where it is too far.

    `reach` is 0 where rows of J depend on each other or have no slope, and about 1 where they are far from that.
    """
    if "projection" not in equations.kept:
        c: ConstraintTerms = equations.constraints
        q, v, extra = equations.q, equations.v, equations.extra_arguments
        space = SymbolicSpace(equations.model)
        Y, S, reach = _factors(equations)

        def change(residual: Any) -> Any:
            return -ca.mtimes(Y, S.solve(residual))

        def moved(q: Any, by: Any) -> Any:
            return space.retract(q, space.to_integrator_velocity(q, by))

        more = [*extra.values()]
        rows = ca.Function("rows", [q, v, *more], [c.value, c.rate])
        q1 = moved(q, change(c.value))
        q1 = moved(q1, change(rows(q1, v, *more)[0]))
        residual, rate = rows(q1, v, *more)
        v1 = v + change(rate)
        v1 = v1 + change(rows(q1, v1, *more)[1])
        last = change(residual)
        far = ca.sumsqr(last) > _LAST**2 * (1 + ca.sumsqr(q1))
        equations.kept["projection"] = ca.Function("projection", [q, v, *more], [moved(q1, last), v1, reach, far])
    out: ca.Function = equations.kept["projection"]
    return out


def reach(equations: Any) -> ca.Function:
    """Return (q, more) -> the reach of `projection`."""
    if "reach" not in equations.kept:
        given = [equations.q, *equations.extra_arguments.values()]
        equations.kept["reach"] = ca.Function("reach", given, [_factors(equations)[2]])
    out: ca.Function = equations.kept["reach"]
    return out


def _factors(equations: Any) -> tuple[Any, Factors, Any]:
    """Return Y = M⁻¹ Jᵀ, the factors of S = J Y, and the root of the smallest pivot of S beside what it can be."""
    own, sizes = equations.constraint_factors, _largest(equations)
    worst: Any = 0.0
    for inverse, size in zip(own.S.inverse, sizes, strict=True):
        worst = ca.fmax(worst, size * inverse)
    return own.Y, own.S, 1 / ca.sqrt(worst)


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
    """Return 1 where a step that changes the reach so would meet a singular pose within a few more of its kind."""
    return behind < _AHEAD * ca.fabs(behind - before)
