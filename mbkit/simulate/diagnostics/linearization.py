"""The exact Jacobian of q̇ = D(q) v, v̇ = forward_dynamics on y = (q, v), for implicit methods.

The derivatives of the acceleration come from the engine, or from the lagrangian engine where the engine has none.
They are along the manifold; for a quaternion x of any length the tangent of a change dx is 2 Eᵀ dx / |x|², with
ẋ = ½ E(x) ω, since Eᵀ E = |x|².
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.base import at_time
from mbkit.engines.registry import DERIVED
from mbkit.errors import NumericalError
from mbkit.model import Model
from mbkit.model.joint_types import JointType
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.torque import Force

_TWIN = "_derived_twin"


class Linearization:
    """∂ẏ/∂y of one state, for the right-hand side `Rates`; `evaluations` counts Jacobians."""

    def __init__(self, dyn: Dynamics) -> None:
        self._twin, self._model = _twin(dyn), dyn.model
        self._own = self._twin
        layout = dyn.model.layout
        self._joints = [(j.type, layout.q[j.name], layout.v[j.name]) for j in dyn.model.independent_joints]
        nq, nv = dyn.model.nq, dyn.model.nv
        self._last: Array = np.zeros((nq + nv,) * 2)
        # Where positions add and v is q̇.
        self._plain = np.eye(nq + nv, k=nq) if dyn.model.velocity_map is None and not dyn.model.quaternions else None
        self.evaluations = 0

    def only(self, member: int) -> None:
        """Go on with this member of a batch."""
        self._own = self._twin.of_samples([member])

    def __call__(self, t: float, y: Array, force: Force) -> Array:
        """Return the Jacobian, (nq + nv, nq + nv); the last one where the state is not finite or singular."""
        nq, nv = self._model.nq, self._model.nv
        # The step from such a state fails by its rate.
        if not np.isfinite(y).all():
            return self._last
        q, lengths = unit_quaternions(self._model, y[:nq])
        v = y[nq:]
        tau = force if isinstance(force, np.ndarray) else force(t, q, v)
        own = at_time(self._own, t)
        try:
            by_q, by_v, by_tau = (x.reshape(nv, nv) for x in own.forward_dynamics_derivatives(q, v, tau))
        except NumericalError:
            return self._last
        self.evaluations += 1
        if not isinstance(force, np.ndarray):
            torque_by_q, torque_by_v = _differences(self._model, force, t, q, v, tau)
            by_q, by_v = by_q + by_tau @ torque_by_q, by_v + by_tau @ torque_by_v
        if self._plain is not None:
            out = self._plain.copy()
            out[nq:, :nq], out[nq:, nq:] = by_q, by_v
        else:
            out = np.empty((nq + nv, nq + nv))
            rate_by_q, D, tangent = self._kinematics(q, v, lengths)
            out[:nq, :nq], out[:nq, nq:] = rate_by_q, D
            out[nq:, :nq], out[nq:, nq:] = by_q @ tangent, by_v
        self._last = out
        return out

    def _kinematics(self, q: Array, v: Array, lengths: Array) -> tuple[Array, Array, Array]:
        """Return ∂(D v)/∂q, D, and the tangent of a change of q, (nv, nq)."""
        nq, nv = self._model.nq, self._model.nv
        if self._model.velocity_map is not None:
            rate, D, tangent = self._model.velocity_map.linear(q, v)
            return rate, D, tangent
        rate, D, tangent = np.zeros((nq, nq)), np.zeros((nq, nv)), np.zeros((nv, nq))
        left = iter(lengths.tolist())
        for kind, a, b in self._joints:
            if kind.quaternion is None:
                D[a, b] = tangent[b, a] = np.eye(kind.nv)
                continue
            length = next(left)
            rate[a, a], D[a, b], tangent[b, a] = _of_rotation(kind, q[a], v[b], length)
        return rate, D, tangent


def _of_rotation(kind: JointType, q: Array, v: Array, length: float) -> tuple[Array, Array, Array]:
    start = kind.quaternion
    assert start is not None
    x = q.tolist()
    D = np.array([kind.qdot(x, e) for e in np.eye(kind.nv).tolist()]).T
    tangent = D.T.copy()
    tangent[:, start:] *= 4 / length
    rate = np.zeros((kind.nq, kind.nq))
    # The quaternion's own rate is linear in it.
    for i, e in enumerate(np.eye(kind.nq)[start:].tolist()):
        rate[start:, start + i] = kind.qdot(e, v.tolist())[start:]
    if kind.floating:
        # d(R v) = -R (v × dθ)
        linear = v[:start]
        moved = np.cross(linear, tangent[start:, start:], axisb=0, axisc=0)
        rate[:start, start:] = -D[:start, :start] @ moved
    D[start:] *= length
    return rate, D, tangent


def _differences(
    model: Model, force: Callable[[float, Array, Array], Array], t: float, q: Array, v: Array, tau: Array
) -> tuple[Array, Array]:
    """Return ∂τ/∂q along the manifold and ∂τ/∂v of a user's function, good to half of the digits."""
    by_q, by_v = np.empty((model.nv, model.nv)), np.empty((model.nv, model.nv))
    root = float(np.sqrt(np.finfo(float).eps))
    for k, e in enumerate(np.eye(model.nv)):
        h = root * max(1.0, abs(float(v[k])))
        by_q[:, k] = (force(t, model.integrate(q, root * e), v) - tau) / root
        by_v[:, k] = (force(t, q, v + h * e) - tau) / h
    return by_q, by_v


def _twin(dyn: Dynamics) -> Dynamics:
    if not dyn.lacks_derivatives:
        return dyn
    # Deriving and compiling costs more than most runs: once for each engine's object.
    if _TWIN not in vars(dyn):
        vars(dyn)[_TWIN] = dynamics(dyn.model, DERIVED)
    return cast("Dynamics", vars(dyn)[_TWIN])
