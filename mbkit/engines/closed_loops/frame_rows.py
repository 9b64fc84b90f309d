"""Rows of constraints in numbers, for an engine that tells how frames move and knows no such rows.

Each row is the formula of `mbkit.model.loops` or `mbkit.model.loops`, on the poses of the ends and of their carrier.
Its rate and γ are derivatives along their motion, so that a frame's pose, Jacobian, velocity, and acceleration at v̇ = 0
are all that an engine hands over. A new kind of loop is a formula there, and nothing here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.codegen.backend import DERIVING, Machine
from mbkit.model import Model
from mbkit.model.elements.motion_laws import MOTION_LAWS
from mbkit.model.loops import LOOP_ROWS, NO_SLIP_ROWS, LoopEnds, contact, tangents
from mbkit.model.parts import Coupler, Loop, NoSlip

#: Position, velocity and acceleration of each motion at a time, by its name.
Laws = Mapping[str, Callable[[float], tuple[float, float, float]]]


@dataclass(frozen=True)
class Rows:
    """f, J, rate and γ of rows; f is zero where a row holds velocities alone."""

    f: Array
    J: Array
    rate: Array
    gamma: Array

    def __getitem__(self, which: Any) -> Rows:
        return Rows(self.f[which], self.J[which], self.rate[which], self.gamma[which])

    @staticmethod
    def stacked(parts: list[Rows]) -> Rows:
        """Return rows one below the other."""
        columns = ([getattr(x, name) for x in parts] for name in ("f", "J", "rate", "gamma"))
        return Rows(*(np.concatenate(x) for x in columns))


@dataclass(frozen=True)
class MovingFrame:
    """A frame in world axes: its pose, and how it moves.

    Attributes
    ----------
    R : (3, 3) array
        Rotation.
    p : (3,) array
        Place of the origin.
    J : (6, nv) array
        Jacobian of the origin's velocity, and below of the angular velocity.
    v, a : (6,) array
        Both velocities, and their rates at v̇ = 0.
    """

    R: Array
    p: Array
    J: Array
    v: Array
    a: Array


class _Poses:
    """Symbols of frames that move: places and rotations, and velocities (v, ω) of each, one below the other."""

    def __init__(self, frames: int) -> None:
        self.p = [ca.SX.sym("p", 3) for _ in range(frames)]
        self.R = [ca.SX.sym("R", 3, 3) for _ in range(frames)]
        self.u = ca.SX.sym("u", 6 * frames)
        self.X = ca.vertcat(*self.p, *map(ca.vec, self.R))
        self.v, self.w = zip(*(ca.vertsplit(x, 3) for x in ca.vertsplit(self.u, 6)), strict=True)
        turning = [ca.vec(ca.mtimes(ca.skew(w), R)) for w, R in zip(self.w, self.R, strict=True)]
        self.rates = ca.vertcat(*self.v, *turning)

    def machine(self, numbers: list[Any], held: list[Any], moving: list[Any]) -> Machine:
        """Return f, the rate, γ at constant u, and the rate's Jacobian on u, of rows that hold f or a velocity."""
        f = ca.vertcat(ca.SX(0, 1), *held)
        rate = ca.vertcat(ca.jtimes(f, self.X, self.rates), *moving)
        value = ca.vertcat(f, ca.SX.zeros(len(moving), 1))
        out = [value, rate, ca.jtimes(rate, self.X, self.rates), ca.jacobian(rate, self.u)]
        given = [self.X, self.u, ca.vertcat(ca.SX(0, 1), *numbers)]
        return Machine(ca.Function("rows", given, [ca.densify(x) for x in out]))


def _evaluated(machine: Machine, frames: Sequence[MovingFrame], numbers: Sequence[float]) -> Rows:
    X = np.concatenate([*(x.p for x in frames), *(x.R.T.ravel() for x in frames)])
    u, du = (np.concatenate([getattr(x, name) for x in frames]) for name in ("v", "a"))
    f, rate, gamma, by_u = machine(X, u, np.array(numbers, dtype=float))
    return Rows(f[:, 0], by_u @ np.concatenate([x.J for x in frames]), rate[:, 0], gamma[:, 0] + by_u @ du)


@lru_cache(maxsize=64)
def _kept(make: Callable[[str], Machine], kind: str) -> Machine:
    with DERIVING:
        return make(kind)


def _loop(kind: str) -> Machine:
    poses, length = _Poses(3), ca.SX.sym("length")
    to = poses.R[2].T
    gap = ca.vertsplit(ca.mtimes(to, poses.p[0] - poses.p[1]))
    a, b = ([ca.vertsplit(x) for x in ca.horzsplit(ca.mtimes(to, R))] for R in poses.R[:2])
    return poses.machine([length], LOOP_ROWS[kind][1](LoopEnds(gap, a, b, length)), [])


def loop_rows(loop: Loop, a: MovingFrame, b: MovingFrame, carrier: MovingFrame) -> Rows:
    """Return the rows of a loop, in the axes of the body that carries both its ends."""
    return _evaluated(_kept(_loop, loop.kind), (a, b, carrier), [loop.length])


def _contact(kind: str) -> Machine:
    poses = _Poses(2)
    # The directions on both bodies, and two along the plane.
    numbers = [ca.SX.sym("d", 3) for _ in range(4)]
    radius, speed = ca.SX.sym("radius"), ca.SX.sym("speed")
    (R_a, R_b), (p_a, p_b) = poses.R, poses.p
    directions = [ca.vertsplit(ca.mtimes(R, x)) for R, x in zip((R_a, *[R_b] * 3), numbers, strict=True)]
    place = contact(kind, directions[0], directions[1], directions[2:], radius, ca.sqrt)
    at = p_a + ca.vertcat(*place.offset)
    ends = (v + ca.cross(w, at - p) for v, w, p in zip(poses.v, poses.w, poses.p, strict=True))
    velocity = ca.vertsplit(next(ends) - next(ends))
    held, moving = place.rows(ca.vertsplit(p_a - p_b), velocity, speed)
    return poses.machine([*numbers, radius, speed], held, moving)


def contact_rows(part: NoSlip, a: MovingFrame, b: MovingFrame) -> tuple[Rows, Rows]:
    """Return the rows of a contact without slip that hold positions, and those that hold velocities.

    Both frames have the axes of their bodies; rows are in world axes.
    """
    numbers = [*part.axis_a, *part.axis_b, *tangents(part.axis_b).ravel(), part.radius, part.speed]
    rows = _evaluated(_kept(_contact, part.kind), (a, b), numbers)
    first = len(NO_SLIP_ROWS[part.kind][0])
    return rows[:first], rows[first:]


def coordinate_rows(model: Model, q: Array, v: Array, laws: Laws, time: float) -> list[Rows]:
    """Return the rows of what follows joints or the time, from the description's q and v."""
    layout, out = model.layout, []
    for x in (x for x in model.constraints if type(x) in (Coupler, *MOTION_LAWS)):
        places = [layout.full_q[name].start for name in (x.joint, *getattr(x, "leaders", ()))]
        at, *leading = layout.G_q[places] @ q + layout.offsets[places]
        if isinstance(x, Coupler):
            follows, slopes = x.follow(leading)
            to, along = layout.coupler_row(x, slopes) @ layout.G, 0.0
            # A curve is of the first leader alone.
            rate = layout.G[layout.full_v[x.leaders[0]].start] @ v
            bend = x.polynomial.deriv(2)(leading[0]) * rate**2
        else:
            follows, along, bend = laws[x.name](time)
            to = layout.G[layout.full_v[x.joint].start]
        out.append(Rows(*(np.array([n]) for n in (at - follows, to, to @ v - along, -bend))))
    return out
