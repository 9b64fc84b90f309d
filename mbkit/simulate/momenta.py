"""Momenta along a run: of the bodies in space, and the canonical ones."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import UnsupportedError
from mbkit.model import Body, Frame, Model
from mbkit.simulate.along import along

__all__ = ["canonical_momentum", "member_of", "momentum"]


def canonical_momentum(dyn: Dynamics, q: Array, v: Array) -> Array:
    """Return p = ∂T/∂v; (K, nv) or (N, K, nv)."""
    return along(dyn, v.shape[-1:], _canonical, q, v)


def _canonical(dyn: Dynamics, q: Array, v: Array) -> Array:
    p = np.einsum("nij,nj->ni", dyn.mass_matrix(q), v)
    if dyn.model.written is None:
        return np.asarray(p)
    # T's part of first degree is half of what changes with the sign of v.
    first = [dyn.kinetic_energy(q, e + 0 * v) - dyn.kinetic_energy(q, -e + 0 * v) for e in np.eye(v.shape[1])]
    return np.asarray(p + 0.5 * np.array(first).T)


def momentum(dyn: Dynamics, q: Array, v: Array) -> Array:
    """Return the bodies' linear and angular momentum about the world's origin; (K, 6) or (N, K, 6)."""
    if dyn.model.written is not None:
        raise UnsupportedError(f"momentum: {dyn.model.name} was written as energies and has no bodies")
    if dyn.samples is None:
        return along(dyn, (6,), lambda own, q, v: _momentum(own, dyn.model, q, v), q, v)
    # Of a batch with values of its own, each trajectory is a system of its own.
    return np.array([momentum(member_of(dyn, i), q[i], v[i]) for i in range(len(q))]).reshape(*q.shape[:-1], 6)


def member_of(dyn: Dynamics, i: int) -> Dynamics:
    """Return the dynamics of one trajectory of a batch, with plain values of the parameters."""
    if dyn.samples is None:
        return dyn
    # Other engines need no CasADi.
    from mbkit.engines.lagrangian import LagrangianDynamics

    assert isinstance(dyn, LagrangianDynamics)  # the others have no samples
    values = dyn.of_samples([i]).parameter_values[0].tolist()
    return dyn.at(**dict(zip(dyn.model.parameters, values, strict=True)))


def _momentum(dyn: Dynamics, model: Model, q: Array, v: Array) -> Array:
    out = np.zeros((len(q), 6))
    for body in model.bodies:
        if not body.mass and not body.inertia.any():
            continue
        frame = _handle(model, body)
        X, J = dyn.pose(q, frame.name), dyn.jacobian(q, frame.name)
        twist = np.einsum("nij,nj->ni", J, v)
        R = X[:, :3, :3] @ frame.rotation.T
        arm, turning = R @ (body.com - frame.translation), twist[:, 3:]
        p = body.mass * (twist[:, :3] + np.cross(turning, arm))
        spin = np.einsum("nij,jk,nlk,nl->ni", R, body.inertia, R, turning)
        out[:, :3] += p
        out[:, 3:] += np.cross(X[:, :3, 3] + arm, p) + spin
    return out


def _handle(model: Model, body: Body) -> Frame:
    """Return a frame on the body that engines know by its name: its own, unless another goes by that name."""
    own = model.frame(body.name)
    if own.body == body.name:
        return own
    for frame in model.frames:
        if frame.body == body.name and model.frame(frame.name) is frame:
            return frame
    raise UnsupportedError(
        f"{model.name}: frame {own.name!r} on {own.body!r} hides the body of that name; rename one of them"
    )
