"""The ignored coordinates of a reduced motion, by quadrature along it.

The intervals between saved states do not depend on each other: all of them are
integrated side by side, as one system on the unit interval, with the rates of the
ignored coordinates as further states. What each adds is then summed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from mbkit._check import Array, finite_array, real, require_finite
from mbkit.derivation.machine import Machine
from mbkit.errors import InputError, NumericalError, UnknownNameError, UnsupportedError
from mbkit.lagrangian.numeric import Numeric
from mbkit.lagrangian.written_equations import WrittenEquations

if TYPE_CHECKING:
    from mbkit.lagrangian.routh import Routhian

__all__ = ["Motion", "reconstructed"]

# SciPy's limit is 100 eps; the norm is a mean over all intervals.
_TOLERANCE: Final = 1e-13
# The two starts are the same number, rounded apart.
_SAME: Final = 1e-9


class Motion(NamedTuple):
    """States in time.

    Attributes
    ----------
    t : (K,) array
        s.
    q, v : (K, n) arrays
    """

    t: Array
    q: Array
    v: Array


def reconstructed(routhian: Routhian, run: Any, q0: ArrayLike, values: Mapping[str, float]) -> Motion:
    """Return the motion of the whole system; see `Routhian.reconstruct`."""
    t, q, v, parameters = _read(routhian, run, values)
    kept, ignored = routhian._places
    start = _start(routhian, q0, q)
    rates = _rates(routhian)
    steps = _increments(routhian, t, q, v, parameters, rates)
    n = len(kept) + len(ignored)
    whole, speeds = np.empty((len(t), n)), np.empty((len(t), n))
    whole[:, kept], speeds[:, kept] = q, v
    whole[:, ignored] = start + np.concatenate([np.zeros((1, len(ignored))), np.cumsum(steps, axis=0)])
    speeds[:, ignored] = rates(q, v, parameters)[..., 0]
    return Motion(t, whole, speeds)


def _read(routhian: Routhian, run: Any, values: Mapping[str, float]) -> tuple[Array, Array, Array, Array]:
    """Return t, q, v and a row of the reduced model's parameters for each state, the time among them."""
    model, held = routhian.lagrangian.model, {}
    if hasattr(run, "tau") and hasattr(run, "model"):
        if np.any(run.tau()):
            raise UnsupportedError(
                "run: a torque acted on it, which is not known between its states; write it as one of the "
                "Lagrangian's forces"
            )
        held = dict(run.model.parameters)
        t, q, v = run.t, run.q, run.v
    else:
        try:
            t, q, v = run
        except (TypeError, ValueError):
            raise InputError(f"run: expected a Trajectory or (t, q, v), got {type(run).__name__}") from None
    t = np.asarray(t, dtype=np.float64)
    if t.ndim != 1 or not len(t) or np.any(np.diff(t) < 0):
        raise InputError(f"run: expected times (K,) that ascend, got shape {t.shape}")
    if np.ndim(q) == 3:
        raise InputError("run: expected one trajectory, got a batch; reconstruct them one by one")
    require_finite("run: t", t)
    q, v = (finite_array(f"run: {name}", x, (len(t), model.nq)) for name, x in (("q", q), ("v", v)))
    told = {**model.parameters, **{n: x for n, x in held.items() if n in model.parameters}}
    for name, x in values.items():
        if name not in told:
            raise UnknownNameError("parameter", name, told)
        told[name] = real(f"parameter {name!r}", x)
    missing = [n for n, x in told.items() if x is None]
    if missing:
        given = ", ".join(f"{n}=..." for n in missing)
        raise InputError(f"reconstruct: no value for parameter {', '.join(map(repr, missing))}; give it as {given}")
    parameters = np.tile(np.array(list(told.values()), dtype=np.float64), (len(t), 1))
    if model.clock is not None:
        parameters[:, list(told).index(model.clock)] = t
    return t, q, v, parameters


def _start(routhian: Routhian, q0: ArrayLike, q: Array) -> Array:
    kept, ignored = routhian._places
    whole = len(kept) + len(ignored)
    given = np.asarray(q0, dtype=np.float64)
    if given.shape == (len(ignored),):
        require_finite("q0", given)
        return given
    if given.shape != (whole,):
        raise InputError(
            f"q0: expected the whole configuration ({whole},) or its ignored coordinates ({len(ignored)},), "
            f"got shape {given.shape}"
        )
    require_finite("q0", given)
    off = float(np.abs(given[kept] - q[0]).max())
    if off > _SAME * (1 + float(np.abs(q[0]).max())):
        names = ", ".join(x.name for x in routhian.lagrangian.coordinates)
        raise InputError(f"q0: its {names} differ from the run's first state by {off:.3g}")
    return given[ignored]


def _rates(routhian: Routhian) -> Numeric:
    s = routhian.lagrangian
    names = {p.name: p for p in (*s.parameters, *((s.time,) if s.time is not None else ()))}
    behind = [names[n] for n in s.model.parameters]
    return Numeric(sp.Matrix(list(routhian.rates.values())), s.coordinates, s.velocities, behind)


def _increments(routhian: Routhian, t: Array, q: Array, v: Array, parameters: Array, rates: Numeric) -> Array:
    """Return what each interval adds to the ignored coordinates, (K - 1, m)."""
    spans, m = np.diff(t), len(routhian.cyclic)
    if not len(spans):
        return np.empty((0, m))
    model = routhian.lagrangian.model
    equations = WrittenEquations(model)
    forward = ca.substitute(equations.forward_dynamics, equations.tau, ca.SX.zeros(model.nv))
    given = [equations.q, equations.v, equations.parameters]
    machine = Machine(ca.Function("reduced", given, [ca.densify(forward)], {"cse": True}))
    clock = None if model.clock is None else list(model.parameters).index(model.clock)
    r, behind = model.nq, parameters[:-1].copy()

    def field(s: float, y: Array) -> Array:
        state = y.reshape(len(spans), 2 * r + m)
        position, speed = np.ascontiguousarray(state[:, :r]), np.ascontiguousarray(state[:, r : 2 * r])
        if clock is not None:
            behind[:, clock] = t[:-1] + s * spans
        a = machine(position, speed, behind)[0][..., 0]
        moved = rates(position, speed, behind)[..., 0]
        return np.asarray(spans[:, None] * np.concatenate([speed, a, moved], axis=1)).ravel()

    start = np.concatenate([q[:-1], v[:-1], np.zeros((len(spans), m))], axis=1).ravel()
    # A mean over N numbers hides one that is √N times as wrong.
    tight = max(_TOLERANCE / np.sqrt(len(spans)), 3e-14)
    solved = solve_ivp(field, (0.0, 1.0), start, "DOP853", t_eval=[1.0], rtol=tight, atol=tight)
    if not solved.success or not np.isfinite(solved.y).all():
        raise NumericalError(f"{model.name}: the motion between the saved states cannot be followed: {solved.message}")
    return np.asarray(solved.y[:, -1].reshape(len(spans), 2 * r + m)[:, 2 * r :])
