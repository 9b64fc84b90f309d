"""Estimate the digits lost in the LᵀDL factorization and select the orthogonal solver where it is more than six.

Elimination from the leaves to the root leaves D_k of the diagonal entry M_kk: the inertia that a joint moves while all
later joints give way. M_kk is known to eps M_kk, so D_k to a relative eps M_kk/D_k: a cart of 1e-9 kg below a pole of
1 kg keeps 7 digits of 16 where the pole is upright. D_k comes from an orthogonal factorization B = QR, T = ½ |B v|².
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.derivation.least_squares_solve import has_squares
from mbkit.derivation.mass_matrix_solve import elimination_order, elimination_size
from mbkit.model import Model
from mbkit.spatial import skew

#: Largest M_kk/D_k of the LᵀDL factorization, some 6 of 16 digits. Robots as their files describe them are below 1e5.
_MAX_RATIO: Final = 5e5
#: Largest count of multiplications of the sparse LᵀDL, some n³/3 for a chain: the orthogonal elimination takes several
#: times as many, which doubles forward dynamics of 16 links.
_MAX_SIZE: Final = 2000
#: Where M is singular everywhere, D_k is rounding, and no solver helps.
_SINGULAR: Final = 1e26
#: Random poses, and as many with right angles.
_STATES: Final = 8
#: The poses tried along one velocity, over a reach that shrinks from a half turn to the last one.
_GRID: Final = np.linspace(-1.0, 1.0, 9)
_SHRINK, _LAST_REACH = 0.3, 1e-4


@lru_cache(maxsize=64)
def loses_digits(model: Model) -> bool:
    """Return whether forward dynamics by LᵀDL of the mass matrix loses more than some 6 digits at some pose.

    Decided at nominal parameters. False where the orthogonal solver is not available: energies, a parameter without a
    value, a tree too large, a mass matrix singular at every pose, inertias that are no sum of squares.
    """
    if not model.has_bodies or not model.nv or elimination_size(model) > _MAX_SIZE:
        return False
    if any(x is None for x in model.parameters.values()) or not has_squares(model):
        return False
    return cancellation(model, enough=_MAX_RATIO) > _MAX_RATIO


def cancellation(model: Model, enough: float = np.inf) -> float:
    """Return about the largest M_kk/D_k of any pose, or an upper bound if that is below 5e5.

    Infinite where a joint can lock; 1 where M is singular at every pose. The search goes from the worst of a few poses
    along the velocities, and ends beyond `enough`; it may miss a pose where several have to be right at once.
    """
    if any(joint.type.gimbal is not None for joint in model.joints):
        return np.inf
    rng = np.random.default_rng(0)
    poses = np.concatenate([model.random_state(rng, _STATES)[0], _right_angles(model, rng)])
    with np.errstate(all="ignore"):
        bound = _bound(model, poses)
        if bound <= _MAX_RATIO:
            return bound
        ratios = _ratios(model, poses)
        if not ratios[:_STATES].min() < _SINGULAR:
            return 1.0
        worst, q, reach, n = float(ratios.max()), poses[np.argmax(ratios)], np.pi, model.nv
        while reach > _LAST_REACH and worst <= enough:
            # Along each velocity alone, then along all at once by the best of each.
            alone = reach * _GRID[:, None] * np.eye(n)[:, None, :]
            poses = _moved(model, q, alone.reshape(-1, n))
            ratios = _ratios(model, poses)
            best = alone[range(n), ratios.reshape(n, -1).argmax(axis=1)].sum(axis=0)
            poses = np.concatenate([poses, _moved(model, q, best[None])])
            ratios = np.append(ratios, _ratios(model, poses[-1:]))
            if ratios.max() > worst:
                worst, q = float(ratios.max()), poses[np.argmax(ratios)]
            reach *= _SHRINK
    return worst


def _right_angles(model: Model, rng: np.random.Generator) -> Array:
    """Return poses with right angles, where the axes of machines align; the first is the zero pose."""
    turns = np.zeros((_STATES, model.nv))
    for joint in model.independent_joints:
        part, kind = model.layout.v[joint.name], joint.type
        columns = [*range(kind.nv)][-3:] if kind.quaternion is not None else list(kind.angular)
        turns[:, [part.start + k for k in columns]] = np.pi / 2 * rng.integers(-1, 3, size=(_STATES, len(columns)))
    turns[0] = 0.0
    return _moved(model, model.neutral(), turns)


def _moved(model: Model, q: Array, moves: Array) -> Array:
    """Return the poses, within the limits, to which moves (N, nv) lead from q."""
    poses = model.integrate(np.tile(q, (len(moves), 1)), moves)
    return np.clip(poses, model.lower, model.upper)


def _bound(model: Model, q: Array) -> float:
    """Return an upper bound of M_kk/D_k: D_k is at least the inertia of the joint's own body and those fixed to it."""
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
            # A later velocity moves this body only if it leads a mimic joint before it.
            moving = block.any(axis=(0, 1)) | (np.arange(len(later)) < part.stop - part.start)
            left = _pivots(block[:, :, moving])[:, ::-1][:, : part.stop - part.start].min(axis=0)
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
    """Return the rows of B at poses (N, nq): of each joint those of its body and rotors, (N, rows, nv)."""
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
        row = np.sqrt(coupling.armature) * layout.coupling_row(coupling) @ layout.G
        at_first = out[coupling.joints[0]]
        out[coupling.joints[0]] = np.concatenate([at_first, np.broadcast_to(row, (n, 1, row.size))], axis=1)
    return out


def _array(entries: Any, n: int) -> Array:
    """Return scalars and arrays of n, in lists of lists, as one array, (n, ·) or (n, ·, ·)."""
    if isinstance(entries[0], list):
        return np.stack([_array(row, n) for row in entries], axis=1)
    return np.stack([np.broadcast_to(np.asarray(x, dtype=np.float64), (n,)) for x in entries], axis=1)
