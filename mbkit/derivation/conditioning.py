"""How many digits of a mass matrix its elimination can lose, and who is to be spared that.

Eliminating from the leaves to the root leaves D_k of the diagonal entry M_kk: the inertia that a joint moves while all
beyond it give way, of that which it moves while they are locked. What is formed to eps M_kk then is known to
eps M_kk/D_k: a cart of 1e-9 kg below a pole of 1 kg, on which it has to be driven sideways, keeps 7 digits of 16.

The worst pose is looked for, as it may be a special one: the pole upright. D_k there comes from an orthogonal
factorization in NumPy, of rows that are the square root of the kinetic energy.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.derivation.factorize import elimination_order, elimination_size
from mbkit.derivation.squares import has_squares
from mbkit.model import Model
from mbkit.spatial import skew

__all__ = ["cancellation", "loses_digits"]

#: Beyond it M_kk/D_k costs too much: some 6 of 16 digits. Robots as their files have them are below 1e5.
_MOST: Final = 5e5
#: Multiplications of the sparse LᵀDL, some n³/3 for a chain, up to which the orthogonal elimination is written out: it
#: takes several times as many, which doubles all that forward dynamics of 16 links takes, and adds nothing to six.
_SIZE: Final = 2000
#: Where M is singular everywhere, D_k is rounding, and nothing helps.
_SINGULAR: Final = 1e26
#: States of each of a kind: random ones and right angles, and of each round around the worst so far.
_STATES: Final = 16
_ROUNDS: Final = 12
#: How much nearer the next round looks.
_NEARER: Final = 0.3
#: What is below it after so many rounds is no foot of a peak.
_FLAT: Final = (3, 1e2)
#: Kinds whose own velocities become dependent at some angle, whatever the masses are: gimbal lock.
_LOCKING: Final = ("spherical_zyx",)


@lru_cache(maxsize=64)
def loses_digits(model: Model) -> bool:
    """Return whether forward dynamics by LᵀDL of the mass matrix loses some 6 digits or more at some pose.

    Decided at the nominal values of parameters, the same for the same description. No for what was written as
    energies, for a parameter without a value, for a tree too large to be written out, where M is singular at every
    pose, and for inertias that are no sum of squares.
    """
    if model.written is not None or not model.nv or elimination_size(model) > _SIZE:
        return False
    if any(x is None for x in model.parameters.values()) or not has_squares(model):
        return False
    return cancellation(model) > _MOST


def cancellation(model: Model) -> float:
    """Return about the largest M_kk/D_k of any pose, or a bound below 5e5.

    Infinite where a joint can lock; 1 where M is singular at every pose.
    """
    if any(joint.kind in _LOCKING for joint in model.joints):
        return np.inf
    rng = np.random.default_rng(0)
    q = model.random_state(rng, _STATES)[0]
    with np.errstate(all="ignore"):
        bound = _bound(model, q)
        if bound <= _MOST:
            return bound
        q = np.concatenate([q, _right_angles(model, rng)])
        seen = _ratios(model, q)
        if not seen[:_STATES].min() < _SINGULAR:
            return 1.0
        worst, best = float(seen.max()), q[np.argmax(seen)]
        for k in range(_ROUNDS):
            if k >= _FLAT[0] and worst < _FLAT[1]:
                break
            q = _around(model, best, _NEARER ** (k + 1), rng)
            seen = _ratios(model, q)
            if seen.max() > worst:
                worst, best = float(seen.max()), q[np.argmax(seen)]
    return worst


def _right_angles(model: Model, rng: np.random.Generator) -> Array:
    """Return poses whose angles are right ones, where the axes of machines align."""
    turns = np.zeros((_STATES, model.nv))
    for joint in model.independent_joints:
        part, kind = model.layout.v[joint.name], joint.type
        columns = [*range(kind.nv)][-3:] if kind.quaternion is not None else list(kind.angular)
        turns[:, [part.start + k for k in columns]] = np.pi / 2 * rng.integers(-1, 3, size=(_STATES, len(columns)))
    turns[0] = 0.0
    return _within(model, model.integrate(np.tile(model.neutral(), (_STATES, 1)), turns))


def _around(model: Model, q: Array, reach: float, rng: np.random.Generator) -> Array:
    """Return poses near one, some of them moved along each velocity alone."""
    nv = model.nv
    moves = reach * rng.standard_normal((_STATES + nv, nv))
    moves[:nv] *= np.eye(nv)
    return _within(model, model.integrate(np.tile(q, (len(moves), 1)), moves))


def _within(model: Model, q: Array) -> Array:
    return np.clip(q, model.lower, model.upper)


def _bound(model: Model, q: Array) -> float:
    """Return a bound of M_kk/D_k: D_k is not less than what a joint's own body, and what is fixed to it, weighs there.

    Infinite where that tells nothing.
    """
    rows, order = _rows(model, q), list(elimination_order(model))
    total = np.concatenate([*rows.values()], axis=1)
    largest = np.einsum("nrk,nrk->nk", total, total).max(axis=0)
    holder: dict[str, str] = {"world": ""}
    own: dict[str, list[Array]] = {}
    for joint in model.tree:
        holder[joint.child] = holder[joint.parent] if joint.kind == "fixed" else joint.name
        own.setdefault(holder[joint.child], []).append(rows[joint.name])
    worst = 1.0
    for joint in model.independent_joints:
        part = model.layout.v[joint.name]
        if part.start < part.stop:
            later = order[order.index(part.start) :]
            block = np.concatenate(own[joint.name], axis=1)[:, :, later]
            # Of later velocities one moves this body only if it leads a joint before it.
            moving = block.any(axis=(0, 1)) | (np.arange(len(later)) < part.stop - part.start)
            left = _pivots(block[:, :, moving])[:, ::-1][:, : part.stop - part.start].min(axis=0)
            worst = max(worst, float(np.max(largest[part] / left)))
    return worst if np.isfinite(worst) else np.inf


def _ratios(model: Model, q: Array) -> Array:
    """Return the largest M_kk/D_k of each pose."""
    order = list(elimination_order(model))
    B = np.concatenate([*_rows(model, q).values()], axis=1)[:, :, order]
    B = B[:, B.any(axis=(0, 2))]
    size = np.linalg.norm(B, axis=1, keepdims=True)
    left = _pivots(B / size)
    return np.asarray(np.nan_to_num(1 / left, nan=np.inf, posinf=np.inf).max(axis=1))


def _pivots(B: Array) -> Array:
    """Return D of BᵀB = LᵀDL, from the last to the first."""
    R = np.linalg.qr(B[:, :, ::-1], mode="r")
    return np.asarray(np.einsum("nkk->nk", R) ** 2)


def _rows(model: Model, q: Array) -> dict[str, Array]:
    """Return B of T = ½ |B v|² at poses q, (N, nq): of each joint the rows of its body and rotors, (N, rows, nv)."""
    layout, bodies = model.layout, {body.name: body for body in model.bodies}
    full, n, columns = layout.expand_q(q), len(q), layout.sizes[3]
    jacobians = {"world": (np.zeros((n, 3, columns)), np.zeros((n, 3, columns)))}
    out: dict[str, Array] = {}
    for joint in model.tree:
        at, part = list(full[:, layout.full_q[joint.name]].T), layout.full_v[joint.name]
        linear, angular = jacobians[joint.parent]
        R_JC, p_JC = joint.type.placement(np, joint, at)
        R = joint.rotation @ _array(R_JC, n)
        p = joint.translation + _array(p_JC, n) @ joint.rotation.T
        across = R.transpose(0, 2, 1)
        linear = across @ (linear - np.cross(p[:, :, None], angular, axis=1))
        angular = across @ angular
        for k in range(joint.type.nv):
            own = joint.type.twist(np, joint, at, [float(i == k) for i in range(joint.type.nv)])
            linear[:, :, part.start + k] += _array(own[0], n)
            angular[:, :, part.start + k] += _array(own[1], n)
        jacobians[joint.child] = linear, angular
        body = bodies[joint.child]
        moments, axes = np.linalg.eigh(body.inertia)
        rotors = np.zeros((n, joint.type.nv, columns))
        rotors[:, range(joint.type.nv), range(part.start, part.stop)] = np.sqrt(joint.armature)
        rows = [
            np.sqrt(body.mass) * (linear - skew(body.com) @ angular),
            (np.sqrt(moments.clip(0.0)) * axes).T @ angular,
            rotors,
        ]
        out[joint.name] = np.concatenate(rows, axis=1) @ layout.G
    return out


def _array(entries: Any, n: int) -> Array:
    """Return scalars and arrays of n, in lists of lists, as one array, (n, ·) or (n, ·, ·)."""
    if isinstance(entries[0], list):
        return np.stack([_array(row, n) for row in entries], axis=1)
    return np.stack([np.broadcast_to(np.asarray(x, dtype=np.float64), (n,)) for x in entries], axis=1)
