"""Energies along a run, the work that was done on it, and whether they fit.

The work is ∫ (τ + τ_damping)·v dt; springs and gravity are in the potential energy.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.model import Model
from mbkit.simulate.along import along, moved
from mbkit.simulate.applied import Held, Sampled

__all__ = ["is_damped", "kinetic_energy", "potential_energy", "work"]

# Of an interval: far enough from the state for a difference that loses a third of the
# digits of a term that is h/12 of the whole, near enough to be that of a parabola.
_NEAR: Final = 1e-4


def kinetic_energy(dyn: Dynamics, q: Array, v: Array) -> Array:
    """Return ½ vᵀ M v, which no known defect of an engine touches; (K,) or (N, K)."""
    if dyn.model.written is not None:
        # T may have terms of lower degree.
        return along(dyn, (), lambda own, q, v: own.kinetic_energy(q, v), q, v)
    return along(dyn, (), lambda own, q, v: 0.5 * np.einsum("ni,nij,nj->n", v, own.mass_matrix(q), v), q, v)


def potential_energy(dyn: Dynamics, q: Array) -> Array:
    """Return the energy of gravity and springs; (K,) or (N, K)."""
    return along(dyn, (), lambda own, q: own.potential_energy(q), q)


def work(dyn: Dynamics, t: Array, q: Array, v: Array, force: Held | Sampled | None) -> Array:
    """Return the work of τ and of dampers since the first state; (K,) or (N, K).

    A force that was held does τ·Δq over each interval, exactly, where v = q̇. On
    quasi-velocities, and for dampers, the interval's rule is the trapezoid's with its
    end correction, h/2 (p₀ + p₁) + h²/12 (ṗ₀ - ṗ₁), of fourth order, which no jump of
    the force at its ends disturbs. A force that is known at the states alone is
    integrated by the cubic through four of them, of fourth order too where it is smooth.
    """
    h = np.diff(t)
    if isinstance(force, Sampled):
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
    damped, turned = is_damped(dyn.model), len(plain) < nv and bool(pushed.any())
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
    """Return the integral over an interval of what has these values and rates at its ends."""
    return np.asarray(h / 2 * (start[0] + end[0]) + h**2 / 12 * (start[1] - end[1]))


def _damped(dyn: Dynamics, h: Array, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Return the power of the dampers, and its rate along the motion."""

    def power(s: Array) -> Array:
        there = (moved(dyn.model, q, s * v), v + s * a) if s.any() else (q, v)
        return np.asarray(np.sum(_damping(dyn, *there) * there[1], axis=-1))

    s = _NEAR * h
    return power(np.zeros(1)), (power(s) - power(-s)) / (2 * s[:, 0])


def _damping(dyn: Dynamics, q: Array, v: Array) -> Array:
    if not is_damped(dyn.model):
        return np.zeros(v.shape)
    if dyn.model.written is not None:
        return along(dyn, v.shape[-1:], lambda own, q, v: own.passive(q, v), q, v)
    # Springs are what is left of the passive force at rest.
    return along(dyn, v.shape[-1:], lambda own, q, v: own.passive(q, v) - own.passive(q, np.zeros_like(v)), q, v)


def is_damped(model: Model) -> bool:
    """Return whether anything takes energy out."""
    if model.written is not None:
        return model.needs.damping
    bound = any(b.field == "damping" for b in model.bindings)
    return (
        bound
        or any(j.damping.any() for j in model.joints)
        or any(s.damping for s in model.springs)
        or any(c.damping for c in model.couplings)
    )


def _plain(model: Model) -> list[tuple[int, int]]:
    """Return (coordinate, velocity) of those where v = q̇: all but free and ball joints'."""
    out: list[tuple[int, int]] = []
    if model.rates is not None:
        return out
    for joint in model.independent_joints:
        if joint.type.coordinate_velocities:
            q, v = model.layout.q[joint.name], model.layout.v[joint.name]
            out += zip(range(q.start, q.stop), range(v.start, v.stop), strict=True)
    return out


def _by_cubics(t: Array, p: Array) -> Array:
    """Return ∫ p dt over each interval, by the cubic through the four states about it.

    At the ends these are the first or last four; of fewer states, the parabola's
    or the trapezoid's rule.
    """
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
