"""Loop closures of a model as holonomic constraints, in SymPy.

Both ends are written in the axes of the body that carries both, the last one that their ways to
the ground share. So only the joints of the loop stand in the rows, and a mechanism in a plane has
no row across it, whatever carries the plane. Rows that say nothing of their own are left out.
"""

from __future__ import annotations

from fractions import Fraction
from math import atan2
from typing import Any, Final

import numpy as np
import sympy as sp

from mbkit._check import Array
from mbkit.errors import InputError
from mbkit.lagrangian.harmonic import Harmonic
from mbkit.lagrangian.prescribed import angle
from mbkit.lagrangian.symbolic_kinematics import SymbolicKinematics
from mbkit.model import Joint
from mbkit.model.kinds import cross3
from mbkit.model.parts import Loop

__all__ = ["closure"]

#: Of the largest coefficient: what rounded rotations leave where one row is made of the others.
_DEPENDENT: Final = 1e-12
#: Of the largest number, or rad: what a few typed digits leave where ends can meet.
_MEETS: Final = 1e-9


def closure(kin: SymbolicKinematics, loop: Loop) -> list[sp.Expr]:
    """Return what is zero where a loop is closed.

    Of points, and of the frames' origins: r_a - r_b, three rows or those that are independent, so that their
    multipliers are the force on body a. Of orientations, where all axes in the loop are parallel:
    2 sin(φ/2) of the angle φ from frame b to frame a, which is zero at whole turns only and has the torque on body
    a for its multiplier (its negative after an odd number of turns). Else ½ Σ b_k x a_k of the frames'
    axes, the sine of their angle about its axis; it is zero at half a turn too, where its rows depend on each other.

    Raises
    ------
    InputError
        The ends can never meet, or nothing moves between them.
    """
    ends = _ways(kin, loop)
    rows = _meeting(kin, loop, ends)
    if loop.kind == "frame":
        rows += _aligned(kin, loop, ends)
    if not rows:
        raise InputError(
            f"{kin.model.name}: loop {loop.name!r} closes nothing: no joint moves its ends against each other; "
            "leave it out"
        )
    return rows


#: From a body of the loop up to the one that carries both ends.
_Way = list[Joint]


def _ways(kin: SymbolicKinematics, loop: Loop) -> tuple[_Way, _Way]:
    """Return the joints from either end to the body that carries both."""
    a, b = kin.way(loop.body_a), kin.way(loop.body_b)
    while a and b and a[-1] is b[-1]:
        a.pop()
        b.pop()
    return a, b


def _meeting(kin: SymbolicKinematics, loop: Loop, ends: tuple[_Way, _Way]) -> list[sp.Expr]:
    values = kin.values["loops", loop.name]
    points = [
        _carried(kin, way, x, 1) for way, x in zip(ends, (values.translation_a, values.translation_b), strict=True)
    ]
    gap = [x - y for x, y in zip(*points, strict=True)]
    return _independent(kin, gap, f"loop {loop.name!r}: its points never meet")


def _carried(kin: SymbolicKinematics, way: _Way, x: list[Any], weight: int) -> list[Any]:
    """Return a point (weight 1) or a direction (0) of the first body in the axes of the last."""
    for joint in way:
        x = kin.to_parent(joint, x, weight)
    return x


def _aligned(kin: SymbolicKinematics, loop: Loop, ends: tuple[_Way, _Way]) -> list[sp.Expr]:
    told = f"loop {loop.name!r}: its frames are never parallel"
    axes = [axis for way in ends for axis in _axes(way)]
    if all(np.linalg.norm(np.cross(axis, axes[0])) < _DEPENDENT for axis in axes):
        return _in_plane(kin, loop, ends, axes[0] if axes else None, told)
    values = kin.values["loops", loop.name]
    frames = [
        [_carried(kin, way, [row[k] for row in R], 0) for k in range(3)]
        for way, R in zip(ends, (values.rotation_a, values.rotation_b), strict=True)
    ]
    half = kin.space.number(Fraction(1, 2))
    turned = [cross3(y, x) for x, y in zip(*frames, strict=True)]
    return _independent(kin, [half * (turned[0][i] + turned[1][i] + turned[2][i]) for i in range(3)], told)


def _in_plane(
    kin: SymbolicKinematics, loop: Loop, ends: tuple[_Way, _Way], axis: Array | None, told: str
) -> list[sp.Expr]:
    """Return the row of the angle about the axis that all joints share."""
    a, b = (_at_rest(way) @ R for way, R in zip(ends, (loop.rotation_a, loop.rotation_b), strict=True))
    E = a @ b.T
    axis = np.zeros(3) if axis is None else axis
    turn = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
    about = float(turn @ axis)
    start = atan2(about, (np.trace(E) - 1) / 2)
    # Whatever turns about the axis leaves the rest as it is.
    if np.abs(E @ axis - axis).max() > _MEETS or (not axis.any() and np.abs(E - np.eye(3)).max() > _MEETS):
        raise InputError(f"{kin.model.name}: {told}, whatever the joints do; turn one of them by rotation_a")
    total = angle(start)
    for sign, way in zip((1, -1), ends, strict=True):
        # An axis that points the other way turns back.
        signs = [int(np.sign(x @ axis)) for x in _axes(way)]
        angles = [kin.coordinates_of(joint)[i] for joint in way for i in joint.type.angular]
        total += sp.Add(*(sign * s * x for s, x in zip(signs, angles, strict=True)))
    total = sp.expand(total)
    if not total.free_symbols & set(kin.coordinates):
        if abs(sp.sin(total / 2).evalf()) < _MEETS:
            return []
        raise InputError(f"{kin.model.name}: {told}: between them stays an angle of {total}")
    return [2 * sp.sin(total / 2)]


def _axes(way: _Way) -> list[Array]:
    """Return what a way's joints turn about, each in the axes of the body at its end while no other has moved."""
    out = []
    for k, joint in enumerate(way):
        own = joint.axes if joint.type.n_axes else np.eye(3)[3 - len(joint.type.angular) :]
        out += [_at_rest(way[k:]) @ x for x in own if joint.type.angular]
    return out


def _at_rest(way: _Way) -> Array:
    R = np.eye(3)
    for joint in way:
        R = joint.rotation @ R
    return R


def _independent(kin: SymbolicKinematics, sums: list[Harmonic], told: str) -> list[sp.Expr]:
    """Return those of three sums that the others do not imply."""
    # This loads SciPy.
    from scipy.linalg import qr

    kin.drop_dust(sums)
    keys = list(dict.fromkeys(key for x in sums for key in x.terms))
    moving = np.array([kin.moves(key) for key in keys], dtype=bool)
    A = np.array([[float(x.terms.get(key, 0)) for key in keys] for x in sums]).reshape(3, len(keys))
    largest = float(np.abs(A).max(initial=0.0))
    kept: list[int] = []
    if moving.any():
        _, R, order = qr(A[:, moving].T, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(R))
        kept = sorted(order[: int(np.count_nonzero(sizes > _DEPENDENT * sizes[0]))].tolist())
    for i in set(range(3)) - set(kept):
        weights = np.linalg.lstsq(A[kept][:, moving].T, A[i, moving], rcond=None)[0]
        left = A[i] - weights @ A[kept]
        if np.abs(left[~moving]).max(initial=0.0) > _MEETS * largest:
            rest = kin.shown(Harmonic(kin.space, {k: x for k, x in sums[i].terms.items() if not kin.moves(k)}))
            why = f": {f'{float(rest):.6g}' if rest.is_number else rest} is left between them"
            raise InputError(f"{kin.model.name}: {told}, whatever the joints do{'' if weights.any() else why}")
    return [kin.shown(sums[i]) for i in kept]
