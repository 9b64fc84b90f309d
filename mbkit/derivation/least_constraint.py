"""Accelerations from Gauss's principle of least constraint, where the elimination of a mass matrix would lose digits.

With the kinetic energy as ½ Σ w ẋ², ẋ = J v, the mass matrix is M = Jᵀ W J, and the accelerations solve ::

    min ½ (J v̇ + c)ᵀ W (J v̇ + c) - fᵀ v̇        c: drifts, f: forces of joints

(Gauss 1829; Lanczos 1970, The Variational Principles of Mechanics, ch. IV.8). J's columns are made orthogonal from the
leaves to the root, in W's measure, and c with them (modified Gram-Schmidt, which is backward stable so: Björck 1996,
Numerical Methods for Least Squares Problems, ch. 2.4 and 4.1). That gives M's LᵀDL with D as sums of squares.

Elimination of a formed M loses eps M_kk/D_k, where D_k is the inertia that joint k moves while all later joints give
way: a cart of 1e-9 kg below a pole of 1 kg keeps 7 digits of 16 where the pole is upright. So does the formed Jᵀ W c, a
sum of forces that mostly cancel. Here neither is formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.derivation.kinematics import Kinematics, Vector, add, along_rates, constant_times
from mbkit.derivation.mass_matrix_solve import Elimination, elimination_order, elimination_size, reciprocal
from mbkit.derivation.model_values import is_zero, scalar
from mbkit.model import Model
from mbkit.model.joint_types import cross3, dot3
from mbkit.model.manifold import random_state
from mbkit.spatial import skew

# An inertia as a sum of squares of rates, in rational numbers.
#
# The description's doubles are rounded once, however thin the body: LᵀDL in doubles, or principal axes, would lose an
# inertia about the long axis of a rod as it loses the remainder of a mass matrix.

_PAIRS: Final = tuple(combinations_with_replacement(range(3), 2))


class InertiaSquare(NamedTuple):
    """One of the rates u · ω with Σ weight u uᵀ = I; forms c in ω have Σ weight u c = ω × I ω."""

    #: kg m²; below zero by rounding, where the doubles' matrix is so.
    weight: float
    direction: tuple[float, ...]
    turning: tuple[tuple[tuple[int, int], float], ...]


_Form = dict[tuple[int, int], Fraction]


@lru_cache(maxsize=1024)
def inertia_squares(inertia: tuple[float, ...]) -> tuple[InertiaSquare, ...] | None:
    """Return the squares of an inertia from its rows; None if inconsistent."""
    exact = [Fraction(x) for x in inertia]
    I = [exact[3 * i : 3 * i + 3] for i in range(3)]
    torque = _torque(I)
    left, out = [0, 1, 2], []
    while any(I[i][j] for i in left for j in left):
        pivot = max(left, key=lambda i: abs(I[i][i]))
        weight, form = I[pivot][pivot], torque[pivot]
        if not weight:
            return None
        u = [I[pivot][j] / weight if j in left else Fraction(0) for j in range(3)]
        left.remove(pivot)
        for i in left:
            torque[i] = {pair: torque[i][pair] - u[i] * form[pair] for pair in _PAIRS}
        I = [[I[i][j] - weight * u[i] * u[j] for j in range(3)] for i in range(3)]
        try:
            turning = tuple((pair, float(x / weight)) for pair, x in form.items() if x)
            out.append(InertiaSquare(float(weight), tuple(float(x) for x in u), turning))
        except OverflowError:
            return None
    # A torque that no motion of the body resists.
    if any(x for i in left for x in torque[i].values()):
        return None
    return tuple(out)


def _torque(I: list[list[Fraction]]) -> list[_Form]:
    """Return ω × I ω as three forms in ω."""
    out: list[_Form] = []
    for i in range(3):
        form = dict.fromkeys(_PAIRS, Fraction(0))
        for a, b, sign in (((i + 1) % 3, (i + 2) % 3, 1), ((i + 2) % 3, (i + 1) % 3, -1)):
            for j in range(3):
                form[min(a, j), max(a, j)] += sign * I[b][j]
        out.append(form)
    return out


# The kinetic energy as a sum of squares of the bodies' velocities in their own axes, where a tree's zeros are exact.


@dataclass(frozen=True)
class Squares:
    """The rows of the sum, those that move."""

    weights: list[Any]
    #: J = ∂ẋ/∂v, (rows, nv).
    jacobian: Any
    #: ẍ - ẍ_free at v̇ = 0.
    drifts: list[Any]
    #: (nv,), of the turning of bodies whose inertia is a parameter, which may become zero: on the left, like nle.
    force: Any


def has_squares(model: Model) -> bool:
    """Return whether the kinetic energy is such a sum: no parameter off an inertia's diagonal, nor a mere product."""
    bound = {(b.part, b.index) for b in model.bindings if b.where == "bodies" and b.field == "inertia"}
    for body in model.bodies:
        off = {(i, j) for i in range(3) for j in range(3) if i != j}
        diagonal = not any(body.inertia[i] for i in off)
        indices = {index for part, index in bound if part == body.name}
        if indices & off or (indices and not diagonal):
            return False
        if not diagonal and inertia_squares(tuple(body.inertia.ravel().tolist())) is None:
            return False
    return True


def squares(kin: Kinematics) -> Squares:
    """Return the sum, of a model that `has_squares`."""
    model, values = kin.model, kin.values
    if not has_squares(model):
        raise ValueError(f"{model.name}: an inertia is no sum of squares")
    gravity: dict[str, Vector] = {"world": values.gravity}
    for joint in model.tree:
        gravity[joint.child] = kin.from_parent(joint, gravity[joint.parent])
    # Weight, rate, and what the rate's acceleration is beside its derivative.
    rows: list[tuple[Any, Any, Any]] = []
    turned: list[tuple[Any, Any]] = []
    for body in model.bodies:
        linear, angular = kin.twists[body.name]
        own = values.of(body)
        at_com = add(linear, cross3(angular, own.com))
        # The axes turn below the vector.
        centripetal = cross3(angular, at_com)
        rows += [(own.mass, at_com[i], centripetal[i] - gravity[body.name][i]) for i in range(3)]
        entries = [x for row in own.inertia for x in row]
        parts = inertia_squares(tuple(entries)) if all(isinstance(x, float) for x in entries) else None
        for square in parts or ():
            turning = (c * (angular[i] * angular[j]) for (i, j), c in square.turning)
            rows.append((square.weight, dot3(square.direction, angular), sum(turning, 0.0)))
        if parts is None:
            # A diagonal of parameters, which may become zero; or flat, turning where nothing resists.
            torque = cross3(angular, constant_times(own.inertia, angular))
            rows += [(own.inertia[k][k], angular[k], 0.0) for k in range(3)]
            turned += [(angular[k], torque[k]) for k in range(3) if not is_zero(torque[k])]
    rows += [(rotor, rate, 0.0) for rotor, rate in along_rates(kin, "T")]
    # A column that nothing moves is zero.
    rows = [row for row in rows if not is_zero(row[0]) and isinstance(row[1], ca.SX)]
    rates = ca.vertcat(ca.SX(0, 1), *(rate for _, rate, _ in rows))
    accelerations = ca.jtimes(rates, kin.q, kin.qdot)
    drifts = [scalar(accelerations[i]) + drift for i, (_, _, drift) in enumerate(rows)]
    force: Any = ca.SX(kin.v.shape[0], 1)
    if turned:
        turning_rates, torques = (ca.vertcat(*(ca.SX(x) for x in column)) for column in zip(*turned, strict=True))
        force = ca.jtimes(turning_rates, kin.v, torques, True)
    return Squares([weight for weight, _, _ in rows], ca.jacobian(rates, kin.v), drifts, force)


class LeastConstraint(Elimination):
    """The orthogonal elimination of a system's squares; `order` has every parent before its children."""

    def __init__(self, squares: Squares, order: Sequence[int]) -> None:
        super().__init__(order)
        self._force = squares.force
        weights = squares.weights
        columns: list[dict[int, Any]] = [{} for _ in self._order]
        for row, i in zip(*squares.jacobian.sparsity().get_triplet(), strict=True):
            columns[i][row] = scalar(squares.jacobian[row, i])
        drifts = dict(enumerate(squares.drifts))
        #: Weight of the drifts along each column.
        self._pulls: list[Any] = [0.0] * len(self._order)
        for place in reversed(range(len(self._order))):
            k = self._order[place]
            column = columns[k]
            weighted = {row: x * weights[row] for row, x in column.items()}
            # A joint that moves nothing has no entry at all: the inverse is then infinite, and the
            # evaluation reports it.
            inverse = self.inverse[k] = reciprocal(_dot(weighted, column))
            for i in self._order[:place]:
                other = columns[i]
                if not weighted.keys().isdisjoint(other):
                    factor = self.factors[k][i] = _dot(weighted, other) * inverse
                    _subtract(other, factor, column)
            pull = self._pulls[k] = _dot(weighted, drifts)
            if column:
                _subtract(drifts, pull * inverse, column)

    def accelerations(self, f: ca.SX) -> ca.SX:
        """Return v̇ under forces f of the joints, (n,), which hold neither gravity nor what v makes."""
        return self.solve(f - self._force, self._pulls)


def _dot(weighted: dict[int, Any], x: dict[int, Any]) -> Any:
    return sum((w * x[row] for row, w in weighted.items() if row in x), 0.0)


def _subtract(x: dict[int, Any], factor: Any, y: dict[int, Any]) -> None:
    for row, entry in y.items():
        x[row] = x.get(row, 0.0) - factor * entry


# Where it is taken: D_k comes from an orthogonal factorization B = QR, T = ½ |B v|².

#: Largest M_kk/D_k of an elimination, some 5 of 16 digits.
_MAX_RATIO: Final = 1e5
#: Largest count of multiplications of the sparse LᵀDL, some n³/3 for a chain: the orthogonal elimination takes several
#: times as many, which doubles forward dynamics of 16 links.
_MAX_SIZE: Final = 2000
#: Where M is singular everywhere, D_k is rounding, and no solver helps.
_SINGULAR: Final = 1e26
#: Random poses, and as many with right angles.
_STATES: Final = 8
#: The poses tried along one velocity, over a reach that shrinks from a half turn to the last one.
_GRID: Final = np.linspace(-1.0, 1.0, 9)
_LAST_REACH: Final = 1e-4


@lru_cache(maxsize=64)
def loses_digits(model: Model) -> bool:
    """Return whether eliminating one acceleration after the other loses more than some 5 digits at some pose.

    Decided at nominal parameters. False where the orthogonal solver is not available: energies, a parameter without a
    value, a tree too large, a mass matrix singular at every pose, inertias that are no sum of squares.
    """
    if not model.has_bodies or not model.nv or elimination_size(model) > _MAX_SIZE:
        return False
    if any(x is None for x in model.parameters.values()) or not has_squares(model):
        return False
    return cancellation(model, enough=_MAX_RATIO) > _MAX_RATIO


def cancellation(model: Model, enough: float = np.inf) -> float:
    """Return about the largest M_kk/D_k of any pose, or an upper bound if that is below 1e5.

    Infinite where a joint can lock; 1 where M is singular at every pose. The search goes from the worst of a few poses
    along the velocities, and ends beyond `enough`; it may miss a pose where several have to be right at once.
    """
    if any(joint.type.gimbal is not None for joint in model.joints):
        return np.inf
    rng = np.random.default_rng(0)
    poses = hard_poses(model, rng)
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
            reach *= 0.3
    return worst


def hard_poses(model: Model, rng: np.random.Generator) -> Array:
    """Return random poses, and as many with right angles, where the axes of machines align."""
    return np.concatenate([random_state(model, rng, _STATES)[0], _right_angles(model, rng)])


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
        part, nv = model.layout.v[joint.name], joint.type.nv
        if nv:
            later = order[order.index(part.start) :]
            block = np.concatenate(own[joint.name], axis=1)[:, :, later]
            # A later velocity moves this body only if it leads a mimic joint before it.
            moving = block.any(axis=(0, 1)) | (np.arange(len(later)) < nv)
            left = _pivots(block[:, :, moving])[:, ::-1][:, :nv].min(axis=0)
            worst = max(worst, float(np.max(np.nan_to_num(largest[part] / left, nan=np.inf, posinf=np.inf))))
    return worst


def _ratios(model: Model, q: Array) -> Array:
    """Return the largest M_kk/D_k of each pose."""
    B = np.concatenate([*_rows(model, q).values()], axis=1)[:, :, list(elimination_order(model))]
    B = B[:, B.any(axis=(0, 2))]
    left = _pivots(B / np.linalg.norm(B, axis=1, keepdims=True))
    return np.asarray(np.nan_to_num(1 / left, nan=np.inf, posinf=np.inf).max(axis=1))


def mass_matrices(model: Model, q: Array) -> Array:
    """Return M at poses (N, nq) from the bodies' Jacobians, (N, nv, nv)."""
    return np.asarray(sum(B.transpose(0, 2, 1) @ B for B in _rows(model, q).values()))


def _pivots(B: Array) -> Array:
    """Return D of BᵀB = LᵀDL, from the last to the first."""
    missing = max(0, B.shape[2] - B.shape[1])
    R = np.linalg.qr(np.pad(B, ((0, 0), (0, missing), (0, 0)))[:, :, ::-1], mode="r")
    return np.asarray(np.einsum("nkk->nk", R) ** 2)


def _rows(model: Model, q: Array) -> dict[str, Array]:
    """Return the rows of B at poses (N, nq): of each joint those of its body and rotors, (N, rows, nv)."""
    layout, n = model.layout, len(q)
    full, still = layout.expand_q(q), np.zeros((n, 3, model.nv))
    jacobians = {"world": (still, still)}
    out: dict[str, Array] = {}
    for joint in model.tree:
        at, G = list(full[:, layout.full_q[joint.name]].T), layout.G[layout.full_v[joint.name]]
        linear, angular = jacobians[joint.parent]
        R_JC, p_JC = joint.type.placement(np, joint, at)
        R = joint.rotation @ np.stack([_columns(row, n) for row in R_JC], axis=1)
        p = joint.translation + _columns(p_JC, n) @ joint.rotation.T
        across = R.transpose(0, 2, 1)
        linear = across @ (linear - np.cross(p[:, :, None], angular, axis=1))
        # The joint's own velocity, of all unit velocities at once: a row each.
        own = joint.type.twist(np, joint, at, list(np.eye(joint.type.nv)[:, :, None]))
        columns = (np.stack([np.broadcast_to(x, (joint.type.nv, n)).T for x in entries], axis=1) for entries in own)
        linear, angular = (J + new @ G for J, new in zip((linear, across @ angular), columns, strict=True))
        jacobians[joint.child] = linear, angular
        body = model.body(joint.child)
        moments, axes = np.linalg.eigh(body.inertia)
        added = np.broadcast_to(np.sqrt(joint.rotors)[:, None] * G, (n, *G.shape))
        moving = np.sqrt(body.mass) * (linear - skew(body.com) @ angular)
        turning = (np.sqrt(moments.clip(0.0)) * axes).T @ angular
        out[joint.name] = np.concatenate([moving, turning, added], axis=1)
    for coupling in model.couplings:
        row = np.sqrt(coupling.rotors) * layout.coupling_row(coupling) @ layout.G
        first = coupling.joints[0]
        out[first] = np.concatenate([out[first], np.broadcast_to(row, (n, 1, row.size))], axis=1)
    return out


def _columns(entries: Any, n: int) -> Array:
    """Return scalars and arrays of n as the columns of one array."""
    return np.stack([np.broadcast_to(np.asarray(x, dtype=np.float64), (n,)) for x in entries], axis=1)
