"""How many digits of a mass matrix its elimination can lose, and who is to be spared that.

Eliminating from the leaves to the root leaves D_k of the diagonal entry M_kk: the inertia that a joint moves while all
beyond it give way, of that which it moves while they are locked. What is formed to eps M_kk then is known to
eps M_kk/D_k: a cart of 1e-9 kg below a pole of 1 kg, on which it has to be driven sideways, keeps 7 digits of 16.

The worst pose within the limits is looked for, as it may be a special one: the pole upright. It is found where a
coordinate at a time leads to it, and may be missed where several have to be right at once. D_k comes from an orthogonal
factorization in NumPy, of rows that are the square root of the kinetic energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.derivation.least_squares_solve import has_squares
from mbkit.derivation.mass_matrix_solve import elimination_order, elimination_size
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
#: Poses of a whole turn, and along one velocity in each round.
_STEPS: Final = 24
_ALONG: Final = 9


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
    return cancellation(model, enough=_MOST) > _MOST


def cancellation(model: Model, enough: float = np.inf) -> float:
    """Return about the largest M_kk/D_k of any pose, or a bound below 5e5.

    Infinite where a joint can lock; 1 where M is singular at every pose. Nothing is looked for beyond `enough`.
    """
    if any(joint.type.gimbal is not None for joint in model.joints):
        return np.inf
    rng = np.random.default_rng(0)
    q = model.random_state(rng, _STATES)[0]
    with np.errstate(all="ignore"):
        q = np.concatenate([q, _right_angles(model, rng)])
        bound = _bound(model, q)
        if bound <= _MOST:
            return bound
        seen = _ratios(model, q)
        if not seen[:_STATES].min() < _SINGULAR:
            return 1.0
        found = _Worst(float(seen.max()), q[np.argmax(seen)])
        for k in range(model.nv + _ROUNDS):
            if found.ratio > enough:
                break
            if k < model.nv:
                found.look(model, _turn(model, k))
            else:
                found.look_around(model, _NEARER ** (k + 1 - model.nv), rng)
    return found.ratio


@dataclass
class _Worst:
    """The worst pose so far."""

    ratio: float
    q: Array

    def look(self, model: Model, moves: Array) -> Array:
        """Look where some moves lead to, and return the ratio of each."""
        q = _within(model, model.integrate(np.tile(self.q, (len(moves), 1)), moves))
        seen = _ratios(model, q)
        if seen.max() > self.ratio:
            self.ratio, self.q = float(seen.max()), q[np.argmax(seen)]
        return seen

    def look_around(self, model: Model, reach: float, rng: np.random.Generator) -> None:
        """Look along each velocity alone, at the best of all together, and anywhere."""
        nv, q = model.nv, self.q
        alone = np.zeros((nv, _ALONG, nv))
        alone[range(nv), :, range(nv)] = reach * np.linspace(-1.0, 1.0, _ALONG)
        seen = self.look(model, alone.reshape(-1, nv)).reshape(nv, _ALONG)
        together = alone[range(nv), seen.argmax(axis=1)].sum(axis=0)
        anywhere = reach * rng.standard_normal((_STATES, nv))
        # From where it looked alone, or from what that found.
        self.look(model, np.vstack([model.difference(self.q, model.integrate(q, together)), anywhere]))


def _right_angles(model: Model, rng: np.random.Generator) -> Array:
    """Return poses whose angles are right ones, where the axes of machines align."""
    turns = np.zeros((_STATES, model.nv))
    for joint in model.independent_joints:
        part, kind = model.layout.v[joint.name], joint.type
        columns = [*range(kind.nv)][-3:] if kind.quaternion is not None else list(kind.angular)
        turns[:, [part.start + k for k in columns]] = np.pi / 2 * rng.integers(-1, 3, size=(_STATES, len(columns)))
    turns[0] = 0.0
    return _within(model, model.integrate(np.tile(model.neutral(), (_STATES, 1)), turns))


def _turn(model: Model, k: int) -> Array:
    """Return moves that follow one velocity for a whole turn."""
    moves = np.zeros((_STEPS, model.nv))
    moves[:, k] = np.linspace(0.0, 2 * np.pi, _STEPS, endpoint=False)
    return moves


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
        holder[joint.child] = joint.name if joint.type.nv else holder[joint.parent]
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
            # Numbers that overflow tell nothing either.
            worst = max(worst, float(np.max(np.nan_to_num(largest[part] / left, nan=np.inf, posinf=np.inf))))
    return worst


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
    missing = max(0, B.shape[2] - B.shape[1])
    R = np.linalg.qr(np.pad(B, ((0, 0), (0, missing), (0, 0)))[:, :, ::-1], mode="r")
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
    for coupling in model.couplings:
        # They are rows of T, whichever joint they stand with.
        row = np.sqrt(coupling.armature) * layout.coupling_row(coupling) @ layout.G
        at_first = out[coupling.joints[0]]
        out[coupling.joints[0]] = np.concatenate([at_first, np.broadcast_to(row, (n, 1, row.size))], axis=1)
    return out


def _array(entries: Any, n: int) -> Array:
    """Return scalars and arrays of n, in lists of lists, as one array, (n, ·) or (n, ·, ·)."""
    if isinstance(entries[0], list):
        return np.stack([_array(row, n) for row in entries], axis=1)
    return np.stack([np.broadcast_to(np.asarray(x, dtype=np.float64), (n,)) for x in entries], axis=1)
