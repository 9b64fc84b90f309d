"""A quantity of the state, at every state of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import UnsupportedError
from mbkit.model import Body, Frame, Model
from mbkit.simulate.torque import PiecewiseConstantTorque, SampledTorque

# States at once: the matrices of a long run would fill the memory.
_MANY: Final = 4096


def along(dyn: Dynamics, shape: tuple[int, ...], evaluate: Callable[..., Array], *states: Array) -> Array:
    """Return evaluate(dyn, q, v, ...), of a shape, at states (K, ·) or (N, K, ·); NaN where one is not finite.

    Where time enters the model, `dyn` has one sample for each state (`mbkit.engines.base.at_times`).
    """
    lead = states[0].shape[:-1]
    flat = [x.reshape(-1, x.shape[-1]) for x in states]
    good = np.flatnonzero(np.logical_and.reduce([np.isfinite(x).all(-1) for x in flat]))
    out = np.full((int(np.prod(lead)), *shape), np.nan)
    for start in range(0, len(good), _MANY):
        which = good[start : start + _MANY]
        if dyn.model.time_parameter is not None:
            own = dyn.of_samples(which)
        else:
            own = dyn.of_samples(which // lead[1]) if len(lead) == 2 else dyn
        out[which] = evaluate(own, *(x[which] for x in flat))
    return out.reshape(*lead, *shape)


def moved(model: Model, q: Array, u: Array) -> Array:
    """Return `model.integrate(q, u)` on any number of leading axes; NaN where a state is not finite."""
    out = np.full(q.shape, np.nan)
    good = np.isfinite(q).all(-1) & np.isfinite(u).all(-1)
    out[good] = model.integrate(q[good], u[good])
    return out


# Energies and work along a run. The work is ∫ (τ + τ_damping)·v dt; springs and gravity are in the potential energy.

# Part of an interval for differences: they lose a third of the digits of a term that is h/12 of the whole.
_NEAR: Final = 1e-4


def kinetic_energy(dyn: Dynamics, q: Array, v: Array) -> Array:
    """Return ½ vᵀ M v, which no known defect of an engine touches; (K,) or (N, K)."""
    if not dyn.model.has_bodies:
        # T may have terms of lower degree.
        return along(dyn, (), lambda own, q, v: own.kinetic_energy(q, v), q, v)
    return along(dyn, (), lambda own, q, v: 0.5 * np.einsum("ni,nij,nj->n", v, own.mass_matrix(q), v), q, v)


def potential_energy(dyn: Dynamics, q: Array) -> Array:
    """Return the energy of gravity and springs; (K,) or (N, K)."""
    return along(dyn, (), lambda own, q: own.potential_energy(q), q)


def work(dyn: Dynamics, t: Array, q: Array, v: Array, force: PiecewiseConstantTorque | SampledTorque | None) -> Array:
    """Return the work of τ and of dampers since the first state; (K,) or (N, K).

    A held force does τ·Δq over each interval, exactly, where v = q̇. On quasi-velocities and for dampers it is the
    trapezoid's rule with its end correction, h/2 (p₀ + p₁) + h²/12 (ṗ₀ - ṗ₁), of fourth order. A force that is known
    at the states alone is integrated by the cubic through four of them.
    """
    h = np.diff(t)
    if isinstance(force, SampledTorque):
        power = np.sum((force.values + _damping(dyn, q, v)) * v, axis=-1)
        steps = _by_cubics(t, power)
    else:
        tau = np.zeros(v.shape[-1]) if force is None else force.between(t)
        steps = _of_held(dyn, h, q, v, tau)
    out = np.zeros(q.shape[:-1])
    np.cumsum(steps, axis=-1, out=out[..., 1:])
    return out


def _of_held(dyn: Dynamics, h: Array, q: Array, v: Array, tau: Array) -> Array:
    """Return the work in each interval, of a force that is constant there."""
    nv = v.shape[-1]
    pushed = np.broadcast_to(tau, (*v.shape[:-2], len(h), nv))
    coordinates, plain = np.array(_plain(dyn.model), dtype=int).reshape(-1, 2).T
    damped, turned = dyn.model.needs.damping, len(plain) < nv and bool(pushed.any())
    ends = [(q[..., i : len(h) + i, :], v[..., i : len(h) + i, :]) for i in (0, 1)]
    a = [np.zeros(0)] * 2
    if damped or turned:
        a = [along(dyn, (nv,), lambda own, *at: own.forward_dynamics(*at), *end, pushed) for end in ends]
    distance = np.zeros(pushed.shape)
    if turned:
        distance = _corrected(h[:, None], *((v, rate) for (_, v), rate in zip(ends, a, strict=True)))
    distance[..., plain] = np.diff(q, axis=-2)[..., coordinates]
    out = np.sum(pushed * distance, axis=-1)
    if damped:
        out = out + _corrected(h, *(_damped(dyn, h[:, None], *end, rate) for end, rate in zip(ends, a, strict=True)))
    return np.asarray(out)


def _corrected(h: Array, start: tuple[Array, Array], end: tuple[Array, Array]) -> Array:
    """Return the integral over an interval from values and rates at its ends."""
    return np.asarray(h / 2 * (start[0] + end[0]) + h**2 / 12 * (start[1] - end[1]))


def _damped(dyn: Dynamics, h: Array, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Return the power of the dampers, and its rate along the motion."""

    def power(s: Array) -> Array:
        there = (moved(dyn.model, q, s * v), v + s * a) if s.any() else (q, v)
        return np.asarray(np.sum(_damping(dyn, *there) * there[1], axis=-1))

    s = _NEAR * h
    return power(np.zeros(1)), (power(s) - power(-s)) / (2 * s[:, 0])


def _damping(dyn: Dynamics, q: Array, v: Array) -> Array:
    if not dyn.model.needs.damping:
        return np.zeros(v.shape)
    if not dyn.model.has_bodies:
        return along(dyn, v.shape[-1:], lambda own, q, v: own.passive(q, v), q, v)
    # At rest the passive force is that of springs.
    return along(dyn, v.shape[-1:], lambda own, q, v: own.passive(q, v) - own.passive(q, np.zeros_like(v)), q, v)


def _plain(model: Model) -> list[tuple[int, int]]:
    """Return (coordinate, velocity) of those where v = q̇: all but free and ball joints'."""
    out: list[tuple[int, int]] = []
    if model.velocity_map is not None:
        return out
    for joint in model.independent_joints:
        if joint.type.coordinate_velocities:
            q, v = model.layout.q[joint.name], model.layout.v[joint.name]
            out += zip(range(q.start, q.stop), range(v.start, v.stop), strict=True)
    return out


def _by_cubics(t: Array, p: Array) -> Array:
    """Return ∫ p dt over each interval, by the cubic through four states near it, or fewer where there are fewer."""
    n = len(t)
    if n < 2:
        return np.zeros((*p.shape[:-1], 0))
    width = min(n, 4)
    first = np.clip(np.arange(n - 1) - (width - 2) // 2, 0, n - width)
    around = first[:, None] + np.arange(width)
    # In each interval's own unit, whatever the times are: weights w with V w = moments.
    h = np.diff(t)
    x = (t[around] - t[:-1, None]) / h[:, None]
    powers = np.arange(width)
    V = x[:, None, :] ** powers[:, None]
    moments = np.broadcast_to((1.0 / (powers + 1))[:, None], (n - 1, width, 1))
    weights = np.linalg.solve(V, moments)[..., 0] * h[:, None]
    return np.asarray(np.sum(weights * p[..., around], axis=-1))


# Momenta along a run: of the bodies in space, and the canonical ones.


def canonical_momentum(dyn: Dynamics, q: Array, v: Array) -> Array:
    """Return p = ∂T/∂v; (K, nv) or (N, K, nv)."""
    return along(dyn, v.shape[-1:], _canonical, q, v)


def _canonical(dyn: Dynamics, q: Array, v: Array) -> Array:
    p = np.einsum("nij,nj->ni", dyn.mass_matrix(q), v)
    if dyn.model.has_bodies:
        return np.asarray(p)
    # T's part of first degree is half of what changes with the sign of v.
    first = [dyn.kinetic_energy(q, e + 0 * v) - dyn.kinetic_energy(q, -e + 0 * v) for e in np.eye(v.shape[1])]
    return np.asarray(p + 0.5 * np.array(first).T)


def momentum(dyn: Dynamics, q: Array, v: Array) -> Array:
    """Return the bodies' linear and angular momentum about the world's origin; (K, 6) or (N, K, 6)."""
    if not dyn.model.has_bodies:
        raise UnsupportedError(f"momentum: {dyn.model.name} was written as energies and has no bodies")
    if dyn.samples is None:
        return along(dyn, (6,), lambda own, q, v: _momentum(own, dyn.model, q, v), q, v)
    # Of a batch with values of its own, each trajectory is a system of its own.
    return np.array([momentum(dynamics_of_trajectory(dyn, i), q[i], v[i]) for i in range(len(q))]).reshape(
        *q.shape[:-1], 6
    )


def dynamics_of_trajectory(dyn: Dynamics, i: int) -> Dynamics:
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
