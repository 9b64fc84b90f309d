"""What slides, rests or is at a stop: how it is decided, when it ends, and the smooth dynamics in between.

Rest beside constraint rows: what rests with what, and how joints share the forces that hold it.

The rows allow velocities v = N u. Joints rest in as many independent ways as their rows of N have; the
others that rest follow from these. Forces λ hold them where Nᵀ λ is the force that is needed along N, and with more
joints than ways λ is not unique. All stay at rest as long as some λ is within all bounds. The λ here is the one whose
largest part of a bound is least, so that this part passes 1 where they let go. What its stop pushes has no bound; it
lets go where no force is left that pushes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.sparse.csgraph import connected_components

from mbkit._check import EPS, Array
from mbkit._reproducible import pivoted, unit_rows
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.engines.elements.jumps import Mask
from mbkit.engines.elements.stop_impacts import StopImpacts, after_impacts, over
from mbkit.errors import NumericalError
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.parts import POSE_ROUNDING, RESTING, ROUNDING, STOPPED
from mbkit.model.stops import HITS, RESTS
from mbkit.simulate.constraint_projection import settled
from mbkit.simulate.events import Hit
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force, Torque

#: Part of a motion that is left where it stops, by the rounding of late times; at a dead centre all of it is.
_LEFT: Final = 1e-3
#: Time within which stops are reached at once, relative to times of 1 s or more: less than the error of any run.
_SIMULTANEOUS: Final = 1e-12
#: Height of the last bounce, rad or m, relative to coordinates of 1 or more: of lower ones the rounding of coordinates
#: would move the times more than their sum is.
_LOWEST_BOUNCE: Final = 1e-11
#: Acceleration, relative to speeds of 1 or more: a speed that fades as c s², s before its end, is zero by rounding from
#: where its rate is 2 √(c eps).
_FADED: Final = 8 * float(np.sqrt(EPS))


def slow(v: Array) -> Array:
    """Return the speed up to which a joint may be at rest by rounding, (1,) or (N, 1)."""
    return np.asarray(POSE_ROUNDING * np.maximum(1.0, np.abs(v).max(axis=-1, keepdims=True, initial=0.0)))


def fades(N: Array, v: Array, a: Array) -> Mask:
    """Return which joints without velocity the rows alone move, and do not but by rounding of their end, (..., nv)."""
    size = np.maximum(1.0, np.abs(v).max(axis=-1, keepdims=True, initial=0.0))
    return np.asarray((np.linalg.norm(N, axis=-1) < POSE_ROUNDING) & (np.abs(a) <= _FADED * size))


def independent(N: Array, still: Mask) -> Mask:
    """Return as many of the joints at rest, (nv,), as rest in independent ways by N, (nv, k)."""
    out, at = np.zeros(still.shape, dtype=bool), np.flatnonzero(still)
    if len(at):
        out[at[pivoted(N[at], POSE_ROUNDING)[0]]] = True
    return out


def stopped(N: Array, v: Array, rests: Mask, rubs: Mask) -> Array:
    """Return the velocity at which some joints have come to rest: so do those that can rest with them alone, (nv,)."""
    U, s, Vt = np.linalg.svd(N[rests], full_matrices=False)
    speeds = (U.T @ v[rests]) / np.where(s > POSE_ROUNDING, s, np.inf)
    # A joint at its dead centre turns there, while the others go on.
    known = (s > POSE_ROUNDING) & (np.abs(speeds) <= _LEFT * max(1.0, float(np.abs(v).max())))
    along = N @ Vt[known].T
    out: Array = v - along @ speeds[known]
    held = np.linalg.norm(N, axis=1) ** 2 - np.linalg.norm(along, axis=1) ** 2 < POSE_ROUNDING
    return np.where(rests | (held & rubs & (np.abs(out) <= slow(v))), 0.0, out)


def shares(N: Array, needed: Array, bound: Array, still: Mask, locked: Mask, stop: Array) -> Array:
    """Return the forces at joints that give the `needed` ones along N, zero where nothing rests, (m, nv).

    Parameters
    ----------
    N : (m, nv, k) array
    needed, bound : (m, nv) array
    still, locked : (nv,) array of bool
        What rests, and as many of it as rest in independent ways.
    stop : (nv,) array
        1 and -1 for joints at their lower and upper stops.
    """
    out, own = np.zeros(needed.shape), np.flatnonzero(still)
    ways = np.linalg.pinv(N[:, locked])
    # Velocities of what rests by those of what is locked, and the forces that would do there alone.
    R = N[:, own] @ ways
    alone = np.einsum("mkd,mnk,mn->md", ways, N, needed)
    R = np.where(np.abs(R) > POSE_ROUNDING, R, 0.0)
    linked = (R != 0).any(axis=0)
    size, label = connected_components(linked.T.astype(int) @ linked.astype(int))
    for part in range(size):
        columns = np.flatnonzero(label == part)
        rows = np.flatnonzero(linked[:, columns].any(axis=1))
        at, G = own[rows], R[:, rows][..., columns] * bound[:, own[rows], None]
        if stop[at].any():
            sizes = bound[:, at], np.abs(alone).max(axis=1)
            given = R[:, rows][..., columns], alone[:, columns], *sizes
            out[:, at] = [_pushed(*one, stop[at]) for one in zip(*given, strict=True)]
            continue
        if len(columns) == 1:
            used = np.sign(G[..., 0]) * alone[:, columns] / np.abs(G[..., 0]).sum(axis=1, keepdims=True)
        else:
            used = np.array([_least(*one) for one in zip(G, alone[:, columns], strict=True)])
        out[:, at] = used * bound[:, at]
    return out


def _pushed(R: Array, needed: Array, bound: Array, size: float, stop: Array) -> Array:
    """Return the x with Rᵀ x = needed, of which none is near the end of what friction or a stop may give, (n,).

    That is the least u with ``|x| <= u bound`` of joints without a stop, ``stop x >= size - u (bound + size)`` at one.
    """
    n, size = len(stop), size + np.finfo(float).tiny
    if n == R.shape[1] == 1:
        return np.asarray(needed / R[0])
    at, free = np.diag(stop), np.diag(1.0 - np.abs(stop))
    scale = np.where(stop != 0, bound / size + 1, bound / size)
    limits = np.block([[-at, -scale[:, None]], [free, -scale[:, None]], [-free, -scale[:, None]]])
    most = np.concatenate([np.where(stop != 0, -1.0, 0.0), np.zeros(2 * n)])
    exact = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    rows = np.column_stack([R.T, np.zeros(R.shape[1])])
    found = linprog(np.eye(n + 1)[n], limits, most, rows, needed / size, (None, None), options=exact)
    if found.x is None:
        raise NumericalError(f"what holds {n} joints at rest on their stops is not known, as bounds differ much")
    return np.asarray(found.x[:n] * size)


def _least(G: Array, needed: Array) -> Array:
    """Return the x with Gᵀ x = needed whose largest entry is least, (n,)."""
    n, d = G.shape
    size, largest = float(np.abs(needed).max()), float(np.abs(G).max())
    if size == 0:
        return np.zeros(n)
    box = np.block([[np.eye(n), -np.ones((n, 1))], [-np.eye(n), -np.ones((n, 1))]])
    exact = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    rows = np.column_stack([G.T / largest, np.zeros(d)])
    found = linprog(np.eye(n + 1)[n], box, np.zeros(2 * n), rows, needed / size, (None, None), options=exact)
    if found.x is None:
        raise NumericalError(f"{EFFECTS['jump']}: what holds {n} joints at rest is not known, as bounds differ much")
    # The dual is the motion in which they let go. It tells how each of them moves, however small its bound is.
    x, y = found.x[:n] * (size / largest), found.eqlin.marginals
    moves = G @ y
    turns = np.abs(moves) > POSE_ROUNDING * np.linalg.norm(G, axis=1) * np.linalg.norm(y)
    most = (needed @ y) / np.abs(moves).sum()
    x = np.where(turns, np.copysign(most, moves), x)
    return np.asarray(np.where(np.abs(x) < (1 - POSE_ROUNDING) * most, x, np.copysign(most, x)))


_GIVES_WAY: Final = "this engine's constraints give way, and so would what rests; pinocchio and lagrangian hold both"
BESIDE_SOFT_ROWS: Final = Path(
    *("friction beside soft constraints", "simulate: not known of", ALL),
    apart=(("jump", "row", _GIVES_WAY), ("jump", "speed", _GIVES_WAY)),
)


@dataclass(frozen=True, eq=False)
class Phase:
    """Smooth dynamics in which velocities have signs, (nv,), or rest; of trajectories side by side (m, nv).

    `locked` are those at rest that have rotors which nothing moves. Constraints let the others rest with them.
    `rubbed` are the dynamics with friction of the same trajectories.
    """

    dyn: Dynamics
    sides: Array
    still: Mask
    locked: Mask
    rubbed: Dynamics

    @property
    def pattern(self) -> tuple[Array, Mask, Mask]:
        """The sides, and what rests and is locked."""
        return self.sides, self.still, self.locked

    def take(self, which: Indices) -> Phase:
        """Return the phases of these trajectories, by index, which may repeat."""
        dyn, rubbed = self.dyn._of_samples(which), self.rubbed._of_samples(which)
        return Phase(dyn, self.sides[which], self.still[which], self.locked[which], rubbed)


class Impact(NamedTuple):
    """An impact of a trajectory on a stop.

    Attributes
    ----------
    row, velocity : int
    name : str
        Of the event.
    delay : float
        s from the impact to the event.
    after : (nv,) array
        The velocities after it.
    before : (nv,) array or None
        Those before it, with the first of several at one time.
    energy_change : float
        J.
    """

    row: int
    velocity: int
    name: str
    delay: float
    after: Array
    before: Array | None = None
    energy_change: float = 0.0

    def event(self, t: float, q: Array, member: int | None) -> Hit:
        """Return the event of a run."""
        return Hit(self.name, t + self.delay, q, self.after.copy(), member, self.before, self.energy_change)


def in_order(events: Sequence[Hit], end: float) -> list[Hit]:
    """Return the events of trajectories by time, up to the end of the run.

    The end of bounces is known before it comes, and does not come where the joint is hit again before.
    """
    ends, gone = dict[tuple[int | None, str], int](), set[int]()
    for k, x in enumerate(events):
        rests = x.name.replace(f" {HITS} its ", f" {RESTS} its ")
        own = x.member, rests
        if rests == x.name:
            ends[own] = k
        elif events[ends.get(own, k)].t > x.t:
            gone.add(ends[own])
    left = (x for k, x in enumerate(events) if k not in gone and x.t <= end)
    return sorted(left, key=lambda x: (x.member or 0, x.t))


class Phases:
    """Dry friction and stops of one trajectory's dynamics, or of trajectories `side_by_side` on the own derivation."""

    def __init__(self, dyn: Dynamics, *, side_by_side: bool = False) -> None:
        #: Whether constraints may hold with friction what rests.
        self._bound = dyn.model.constrained
        if self._bound and dyn._soft_constraints:
            BESIDE_SOFT_ROWS.admit(dyn.model)
        self.dyn, self._own, self._side_by_side = dyn, dyn._jumps, side_by_side
        self._names = dyn.model.velocity_names
        #: Velocities with friction or stops. The law of all samples is made here, so that those of some are its rows.
        law = self._own.law_of(dyn)
        self.which, self._stops, self.with_stops = law.which, law.stops, law.stops.which[law.which]
        self._rubs = np.isin(np.arange(dyn.model.nv), self.which)
        layout = dyn.model.layout
        places = (
            range(layout.q[j.name].start, layout.q[j.name].start + j.type.nv) for j in dyn.model.independent_joints
        )
        # Such joints have a coordinate for each velocity.
        self._places = np.array([i for part in places for i in part], dtype=np.intp)[self.which]

    def phase(
        self,
        t: float | Array,
        q: Array,
        v: Array,
        force: Force,
        leaving: Array | None = None,
        members: Indices | None = None,
    ) -> Phase:
        """Return the phase that begins in a state, or those of `members` side by side, (m, nv).

        `leaving` has the signs of velocities that are about to be.
        """
        tau = applied(force, t, q, v)
        rubbed = self.dyn if members is None else self.dyn._of_samples(members)
        law = self._own.law_of(rubbed)
        # A velocity whose friction is zero in these dynamics has no side, but with a stop one that says that it moves.
        resting, signs = law.at_rest(q, v), np.where(law.bound > 0, np.sign(v), 1.0 * self._stops.which)
        held, still = np.zeros(v.shape), np.zeros(v.shape, dtype=bool)
        if resting.any():
            rows: Any = np.flatnonzero(resting.any(axis=1)) if self._side_by_side else ...
            own = rubbed._of_samples(rows) if self._side_by_side else rubbed
            when: Any = t[rows] if isinstance(t, np.ndarray) else t
            sliding = at_time(self._dynamics(own, signs[rows], still[rows]), when)
            held[rows], still[rows] = self._own.decided(
                sliding,
                lambda f: sliding.forward_dynamics(q[rows], v[rows], f),
                *(q[rows], tau[rows], resting[rows], None if leaving is None else leaving[rows]),
                law=self._own.law_of(own),
            )
            if self._bound:
                rate = sliding.forward_dynamics(q[rows], v[rows], tau[rows])
                stays = resting[rows] & fades(self._directions(own, when, q[rows]), v[rows], rate)
                still[rows] |= stays if leaving is None else stays & (leaving[rows] == 0)
        locked = self._locked(rubbed, t, q, still)
        return self.given(np.where(resting & (law.bound > 0), -np.sign(held), signs), still, locked, rubbed)

    def given(self, sides: Array, still: Mask, locked: Mask, rubbed: Dynamics) -> Phase:
        """Return a phase that is known."""
        return Phase(self._dynamics(rubbed, np.where(still, 0.0, sides), locked), sides, still, locked, rubbed)

    def _dynamics(self, rubbed: Dynamics, sides: Array, still: Mask) -> Dynamics:
        if self._side_by_side:
            return self._own.phases(rubbed, sides, still)  # type: ignore[no-any-return]  # of the same engine
        one: Dynamics = self._own.phase(rubbed, *(_rows(x)[0] for x in (sides, still)))
        return one

    def _directions(self, dyn: Dynamics, t: float | Array, q: Array) -> Array:
        return self._own.directions(at_time(dyn, t), q)

    def held(self, still: Mask, start: Array, q: Array, v: Array) -> tuple[Array, Array]:
        """Return states of a phase from `start` on in which what rests keeps its place and no velocity, to the bit."""
        if not still.any():
            return q, v
        return np.where(self.places(still), start, q), np.where(still, 0.0, v)

    def places(self, still: Mask) -> Mask:
        """Return which coordinates keep their place, (..., nq)."""
        rests = np.zeros((*still.shape[:-1], self.dyn.model.nq), dtype=bool)
        rests[..., self._places] = still[..., self.which]
        return rests

    def onto_rows(self, t: float, still: Mask, start: Array, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the consistent states beside those in which joints rest that were there at the `start`; (N, ...)."""
        rests = self.given(np.zeros(v.shape), still, self._locked(self.dyn, t, q, still), self.dyn).dyn
        return self.held(still, start, *settled(rests, t, q, v))

    def _locked(self, dyn: Dynamics, t: float | Array, q: Array, still: Mask) -> Mask:
        """Return which of those at rest have rotors that nothing moves, of the shape of v."""
        out = still.copy()
        if self._bound and still.any():
            free, rests = _rows(self._directions(dyn, t, q), 2), _rows(out)
            for i in np.flatnonzero(rests.any(axis=1)):
                rests[i] = independent(free[i], rests[i])
        return out

    def margins(self, phase: Phase, t: float | Array, q: Array, v: Array, force: Force) -> Array:
        """Return how far each velocity with friction or stops is from the end of its phase; (k,) or (N, k).

        Of one that slides it is the speed, of one that rests the part of its bound that is left, and 1 without a side;
        with a stop it is the distance, or the part of all forces that pushes the joint there. It is negative beyond.
        """
        out = self.speeds(phase, q, v)
        still = phase.still[..., self.which]
        if still.any():
            held = np.where(phase.still, 0.0, v)
            bound = self.bounds(phase)
            at_rest = self.holding(phase, t, q, held, force)[..., self.which]
            used = np.abs(at_rest) / np.where(still & (bound > 0), bound, 1.0)
            left = 1 + ROUNDING - used
            if self._stops and (side := self._pushed(phase, q)[..., self.which]).any():
                size = self._size(phase, t, q, held, force)
                left = np.where(side != 0, (bound + side * at_rest) / (bound + size) + ROUNDING, left)
            out = np.where(still, left, out)
            if self._bound:
                # A joint that rows alone hold moves as soon as they do.
                moved = np.abs(v) / slow(v)
                out = np.where(still & ~phase.locked[..., self.which], np.minimum(out, 1 - moved[..., self.which]), out)
        return out

    def approach(self, q: Array, v: Array) -> Array:
        """Return the rates of the distances from the nearest stops, (m, k); NaN without one."""
        if not self._stops:
            return np.full((len(v), len(self.which)), np.nan)
        low, high = np.moveaxis(self._stops.distance(q), -2, 0)
        rate = np.where(self._stops.which, np.where(low <= high, v, -v), np.nan)
        return np.asarray(rate[:, self.which])

    def _pushed(self, phase: Phase, q: Array) -> Array:
        """Return 1 and -1 for what rests on lower and upper stops, of the shape of v."""
        return np.where(phase.still, self._stops.against(q), 0.0)

    def _size(self, phase: Phase, t: float | Array, q: Array, v: Array, force: Force) -> Array:
        """Return the size of the forces in a state, whose rounding is that of what pushes a joint to its stop."""
        own = at_time(phase.dyn._bare or phase.dyn, t)
        acts = np.abs(own.inverse_dynamics(q, v, 0 * v)) + np.abs(applied(force, t, q, v)[..., : v.shape[-1]])
        return np.asarray(acts.max(axis=-1, keepdims=True, initial=np.finfo(float).tiny))

    def speeds(self, phase: Phase, q: Array, v: Array) -> Array:
        """Return the margins of what slides or may come to a stop, and 1 of others; (k,), (N, k) or (m, N, k)."""
        rubs = np.broadcast_to(self._own.law_of(phase.rubbed).bound > 0, phase.still.shape)
        along, loose = np.where(phase.still | ~rubs, 0.0, phase.sides)[..., self.which], ~phase.still[..., self.which]
        if v.ndim > along.ndim > 1:
            along, loose = along[:, None], loose[:, None]
        out = np.where(along == 0, 1.0, along * v[..., self.which] - STOPPED)
        if self._stops:
            out = np.where(loose, np.minimum(out, self._stops.clearance(q, v)[..., self.which]), out)
        return np.asarray(out)

    def margin_part(self, dyn: Any) -> Any:
        """Return the least margin as a part behind the steps of a phase's dynamics on the own derivation."""
        from mbkit.derivation.steps.moreau import phase_margin

        sliding, which = self._own.sliding, self.which.tolist()
        sides, locks = [sliding.sides.get(i) for i in which], [sliding.locks[i] for i in which]
        return phase_margin(dyn.equations, which, sides, locks, self._stops)

    def holding(self, phase: Phase, t: float | Array, q: Array, v: Array, force: Force) -> Array:
        """Return the forces of friction on what rests, and zero elsewhere; of the shape of v."""
        tau = applied(force, t, q, v)
        a = at_time(phase.dyn, t).forward_dynamics(q, v, tau)
        if not self._bound:
            # What holds a joint accelerates its rotor.
            return np.where(phase.still, -RESTING * a, 0.0)
        # Beside rows, so small an acceleration may be their rounding: without the friction of what rests and its rotor.
        free = self._dynamics(phase.rubbed, np.where(phase.still, 0.0, phase.sides), phase.still & False)
        loose = at_time(free._bare or free, t)
        pulled = loose.inverse_dynamics(q, v, np.where(phase.still, 0.0, a)) - tau[..., : v.shape[-1]]
        if phase.dyn._acting[0]:
            pulled = pulled - _of_wrenches(phase.rubbed, q, tau)
        bound, out = np.ones(v.shape), np.zeros(v.shape)
        bound[..., self.which] = self.bounds(phase)
        N, needed, most = self._directions(phase.rubbed, t, q), _rows(pulled), _rows(bound)
        stop = self._pushed(phase, q)
        shape = stop.shape
        patterns = _rows(np.concatenate([*(np.broadcast_to(x, shape) for x in (phase.still, phase.locked)), stop], -1))
        patterns, which = np.unique(patterns, axis=0, return_inverse=True)
        which = np.broadcast_to(which, len(needed))
        for i, pattern in enumerate(patterns):
            its, (still, locked, pushed) = which == i, np.split(pattern, 3)
            _rows(out)[its] = shares(_rows(N, 2)[its], needed[its], most[its], still > 0, locked > 0, pushed)
        return out

    def bounds(self, phase: Phase) -> Array:
        """Return the largest forces at rest of velocities with friction, (k,) or (m, k)."""
        bound = self._own.law_of(phase.rubbed).bound[..., self.which]
        return np.broadcast_to(bound, (*phase.still.shape[:-1], len(self.which)))

    def after(
        self, phase: Phase, t: float | Array, q: Array, v: Array, force: Force, margins: Array | None = None
    ) -> tuple[Array, Array, Array, list[Impact]]:
        """Return the state at the end of a phase, the signs of what lets go, and the impacts on stops.

        What stopped has no velocity. Those velocities end their phase that have the least margins, to rounding.
        """
        margins = self.margins(phase, t, q, v, force) if margins is None else margins
        ended = np.zeros(v.shape, dtype=bool)
        ended[..., self.which] = margins <= np.maximum(margins.min(axis=-1, keepdims=True), 0.0) + 1e-15
        stops, arrives = ended & ~phase.still, np.zeros(v.shape, dtype=bool)
        if self._stops:
            arrives = ~phase.still & self._arriving(t, q, v)
            # What comes to its stop slides on up to there.
            stops &= ~arrives & (~self._stops.which | (np.abs(v) <= slow(v)))
        lets_go = ended & phase.still
        out, leaving = np.where(phase.still | stops, 0.0, v), np.zeros(v.shape)
        if self._bound:
            out = self.stopped(phase.rubbed, t, q, v, phase.still | stops)
        if lets_go.any():
            leaving = np.where(lets_go, -np.sign(self.holding(phase, t, q, v, force)), 0.0)
            leaving = np.where(lets_go & ((side := self._pushed(phase, q)) != 0), side, leaving)
            if self._bound:
                # Without a share in what holds, rows alone move it.
                rate = at_time(phase.dyn, t).forward_dynamics(q, v, applied(force, t, q, v))
                leaving = np.where(lets_go & (leaving == 0), np.sign(rate), leaving)
        if not arrives.any():
            return q, out, leaving, []
        q = self._stops.onto(q, arrives)
        return q, *self.hit(phase.rubbed, t, q, out, force, leaving)

    def _arriving(self, t: float | Array, q: Array, v: Array) -> Mask:
        """Return which velocities lead to stops that are reached now, within the digits of a time."""
        near = _SIMULTANEOUS * np.maximum(1.0, np.abs(np.asarray(t)))[..., None, None]
        speed = v[..., None, :] * np.array([[-1.0], [1.0]])
        reached = self._stops.distance(q) <= self._stops.room + near * np.maximum(speed, 0.0)
        return np.asarray((reached & (speed > 0)).any(axis=-2))

    def hit(
        self, rubbed: Dynamics, t: float | Array, q: Array, v: Array, force: Force, leaving: Array | None = None
    ) -> tuple[Array, Array, list[Impact]]:
        """Return the velocity after impacts on the stops that coordinates are at, what lets go, and the impacts.

        Bounces that are lower than rounding are over, at the time to which their times add up.
        """
        leaving, side = np.zeros(v.shape) if leaving is None else leaving, self._stops.against(q)
        rows: Any = np.flatnonzero((_rows(side * v) < 0).any(axis=1))
        if not len(rows):
            return v, leaving, []
        own, when, out = rubbed, t, v.copy()
        if self._side_by_side:
            own, when = rubbed._of_samples(rows), t[rows] if isinstance(t, np.ndarray) else t
        own = at_time(own, when)
        states, before, side = (_rows(x)[rows] for x in (q, v, side))
        self.require_response(own, when, states, before, side)
        impact = after_impacts(self._own, own, states, before)
        _rows(out)[rows] = impact.v
        tau = _rows(applied(force, t, q, out))[rows]
        ends, delays = self._last_bounces(own, states, impact, side, tau)
        last = over(self._own, own, states, impact.v, ends) if ends.any() else impact
        _rows(out)[rows] = last.v
        # What rows hold together with a stop rests too.
        out = self.stopped(rubbed, t, q, out, out == 0)
        _rows(leaving)[rows] = 0.0
        M = (own._bare or own).mass_matrix(states) if self._bound else None
        impacts: list[Impact] = []
        for k in np.flatnonzero(impact.hit.any(axis=1)).tolist():
            row, new, energy = int(rows[k]), impact.v[k], impact.energy_change[k]
            whole = energy.sum() if M is None else 0.5 * (new - before[k]) @ M[k] @ (new + before[k])
            # The first event tells of a stop that was not hit, and has a part in the impact, and of drives.
            first: Array | None = before[k]
            more = float(whole - energy[impact.hit[k]].sum())
            for i in np.flatnonzero(impact.hit[k]).tolist():
                name = partial(self._stops.event, i, side[k, i])
                impacts.append(Impact(row, i, name(HITS), 0.0, new, first, float(energy[i]) + more))
                first, more = None, 0.0
                if ends[k, i] and self._stops.restitution_at(side[k])[i]:
                    left = float(delays[k, i]), _rows(out)[row], None, float(last.energy_change[k, i])
                    impacts.append(Impact(row, i, name(RESTS), *left))
        return out, leaving, impacts

    def _last_bounces(
        self, own: Dynamics, q: Array, impact: StopImpacts, side: Array, tau: Array
    ) -> tuple[Mask, Array]:
        """Return which bounces are too low to go on, and the s after which their series end; states (m, ...)."""
        v, e = impact.v, self._stops.restitution_at(side)
        # One that was hit, or that an impact elsewhere sends off.
        bounces = side * v > 0
        if not bounces.any():
            return bounces, np.zeros(v.shape)
        a = own.forward_dynamics(q, v, tau)
        bound = np.where(side > 0, self._stops.bounds[0], np.where(side < 0, self._stops.bounds[1], 0.0))
        low = bounces & (v**2 <= 2 * np.abs(a) * _LOWEST_BOUNCE * np.maximum(1.0, np.abs(bound)))
        # Low bounces on several stops keep each other up; together they rest where forces hold all of them.
        ends = low & (own.forward_dynamics(q, np.where(low, 0.0, v), tau) == 0) if low.any() else low
        series = ends & impact.hit & (e < 1) & (side * a < 0)
        return ends, np.where(series, 2 * np.abs(v) / np.where(series, np.abs(a) * (1 - e), 1.0), 0.0)

    def require_response(self, dyn: Dynamics, t: float | Array, q: Array, v: Array, side: Array) -> None:
        """Raise `NumericalError` where rows alone lead a velocity beyond its stop; states (m, ...)."""
        if self._bound:
            # What rows alone move has no response to impulses; at a singular pose nothing seems to have one.
            moved = np.linalg.norm(self._directions(dyn, t, q), axis=-1) < POSE_ROUNDING
            for k, i in np.argwhere(moved & (side * v < -slow(v))).tolist():
                J = unit_rows(at_time(dyn, t).constraint_jacobian(q)[k, list(dyn._row_choice.independent)])
                singular = np.linalg.matrix_rank(J, POSE_ROUNDING) < len(J)
                raise NumericalError((self._stops.singular if singular else self._stops.led_beyond)(i, side[k, i]))

    def stopped(self, dyn: Dynamics, t: float | Array, q: Array, v: Array, rests: Mask) -> Array:
        """Return velocities of which some have come to rest, and with them those that constraints let rest too."""
        if not self._bound:
            return v
        rubs = np.broadcast_to(self._own.law_of(dyn).bound > 0, v.shape)
        states = _rows(self._directions(dyn, t, q), 2), *map(_rows, (v, rests, rubs))
        return np.array([stopped(*state) for state in zip(*states, strict=True)]).reshape(v.shape)

    def changes(self, before: Phase, after: Phase, q: Array, impacts: Sequence[Impact] = ()) -> list[tuple[int, str]]:
        """Return which trajectory's velocity stops, lets go or turns from one phase to the next, in words.

        What rests after one of the `impacts` is not told of again.
        """
        rested, rests = np.atleast_2d(before.still, after.still)
        turned = np.atleast_2d(before.sides * after.sides < 0) & self._rubs & ~(rested | rests)
        side, hit, out = _rows(self._stops.against(q)), {(x.row, x.velocity) for x in impacts}, []
        for row, i in zip(*(x.tolist() for x in np.nonzero((rested != rests) | turned)), strict=True):
            what = "stops" if rests[row, i] else "lets go" if rested[row, i] else "turns"
            if not side[row, i]:
                out.append((row, f"{self._names[i]} {what}"))
            elif rested[row, i] or (row, i) not in hit:
                does = RESTS if rests[row, i] else "leaves"
                out.append((row, self._stops.event(i, side[row, i], does)))
        return out


def _of_wrenches(dyn: Dynamics, q: Array, tau: Array) -> Array:
    frames, axes = dyn._acting
    wrenches = np.split(tau[..., dyn.model.nv :], len(frames), axis=-1)
    bare = dyn._bare or dyn
    return bare.generalized_force(q, dict(zip((f.name for f in frames), wrenches, strict=True)), axes)


def applied(force: Force, t: float | Array, q: Array, v: Array) -> Array:
    """Return the force at one state, (n,), or at several of a trajectory, (N, n)."""
    return np.asarray(force(t, q, v) if callable(force) else force)


def side_by_side(problem: IntegrationProblem) -> bool:
    """Return whether trajectories go side by side: of a batch whose torque is no function of one state."""
    torque = problem.torque
    return problem.batch is not None and problem.dyn._derived and (not torque.callable or torque.feedback is not None)


def force_of(torque: Torque, alone: Callable[[int], Any] | None, k: Indices, members: Indices) -> Any:
    """Return the force of members behind k steps, (m, n), or a function; `alone` gives that of one by itself."""
    if alone is not None:
        force = alone(int(k[0]))
        return of_each(force) if callable(force) else force[None]
    return torque.feedback or torque.rows(k[:, None], members)[:, 0]


def of_each(force: Any) -> Callable[[float, Array, Array], Array]:
    """Return the function of states of a trajectory, (N, ...), for that of one state."""
    return lambda t, q, v: np.array([force(t, *state) for state in zip(q, v, strict=True)])


def _rows(x: Any, axes: int = 1) -> Any:
    """Return numbers of one state or of several as those of several."""
    lead = x.ndim - axes
    # Without freedom there are no directions, and their number tells nothing of the states'.
    return x.reshape(math.prod(x.shape[:lead]), *x.shape[lead:])
