"""What slides and what rests: how it is decided, when it ends, and the smooth dynamics in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.model.changes.dry_friction import ROUNDING
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force


@dataclass(frozen=True, eq=False)
class Phase:
    """Smooth dynamics in which velocities have signs, (nv,), or rest."""

    dyn: Dynamics
    sides: Array
    still: NDArray[np.bool_]


class Friction:
    """Dry friction of one trajectory's dynamics."""

    def __init__(self, dyn: Dynamics) -> None:
        self._dyn, self._own = dyn, dyn._friction
        self.law = self._own.law
        #: Velocities with friction.
        self.which = np.flatnonzero(self.law.bound > 0)
        layout = dyn.model.layout
        places = (
            range(layout.q[j.name].start, layout.q[j.name].start + j.type.nv) for j in dyn.model.independent_joints
        )
        # Joints with friction have a coordinate for each velocity.
        self._places = np.array([i for part in places for i in part], dtype=np.intp)[self.which]

    def phase(self, t: float, q: Array, v: Array, force: Force, leaving: Array | None = None) -> Phase:
        """Return the phase that begins in a state, or those of a batch on the own derivation.

        `leaving` has the signs of velocities that are about to be.
        """
        tau = applied(force, t, q, v)
        resting, signs = self.law.at_rest(v), np.sign(v)
        held, still = np.zeros(v.shape), np.zeros(v.shape, dtype=bool)
        if resting.any():
            sliding = at_time(self._dynamics(signs, still), t)
            held, still = self._own.decided(
                sliding, lambda f: sliding.forward_dynamics(q, v, f), q, tau, resting, leaving
            )
        sides = np.where(resting, -np.sign(held), signs)
        return Phase(self._dynamics(sides, still), sides, still)

    def _dynamics(self, sides: Array, still: NDArray[np.bool_]) -> Dynamics:
        make = self._own.phases if sides.ndim == 2 else self._own.phase
        out: Dynamics = make(self._dyn, sides, still)
        return out

    def held(self, phase: Phase, start: Array, q: Array, v: Array) -> tuple[Array, Array]:
        """Return states of a phase from `start` on in which what rests keeps its place and no velocity, to the bit."""
        if not phase.still.any():
            return q, v
        rests = np.zeros((*phase.still.shape[:-1], q.shape[-1]), dtype=bool)
        rests[..., self._places] = phase.still[..., self.which]
        return np.where(rests, start, q), np.where(phase.still, 0.0, v)

    def margins(self, phase: Phase, t: float, q: Array, v: Array, force: Force) -> Array:
        """Return how far each velocity with friction is from the end of its phase, negative beyond; (k,) or (N, k).

        Of one that slides it is the speed, of one that rests the part of its bound that is left.
        """
        out = phase.sides * v
        if phase.still.any():
            out = np.where(phase.still, 1 + ROUNDING - np.abs(self.holding(phase, t, q, v, force)) / self._bound, out)
        return out[..., self.which]

    def holding(self, phase: Phase, t: float, q: Array, v: Array, force: Force) -> Array:
        """Return the forces of friction on what rests, and zero elsewhere; of the shape of v."""
        tau = applied(force, t, q, v)
        # Without the friction of what rests, and without its rotor.
        free = self._dynamics(np.where(phase.still, 0.0, phase.sides), phase.still & False)
        dyn, loose = (at_time(x, t) for x in (phase.dyn, free._bare or free))
        a = np.where(phase.still, 0.0, dyn.forward_dynamics(q, v, tau))
        pulled = loose.inverse_dynamics(q, v, a) - tau[..., : v.shape[-1]]
        if dyn._acting[0]:
            pulled = pulled - self._of_wrenches(q, tau)
        return np.where(phase.still, pulled, 0.0)

    @property
    def _bound(self) -> Array:
        return np.where(self.law.bound > 0, self.law.bound, 1.0)

    def _of_wrenches(self, q: Array, tau: Array) -> Array:
        frames, axes = self._dyn._acting
        wrenches = np.split(tau[..., self._dyn.model.nv :], len(frames), axis=-1)
        bare = self._dyn._bare or self._dyn
        return bare.generalized_force(q, dict(zip((f.name for f in frames), wrenches, strict=True)), axes)

    def ended(self, margins: Array) -> Indices:
        """Return which velocities end their phase, as indices: those with the least margins, to rounding."""
        return self.which[margins <= max(float(margins.min()), 0.0) + 1e-15]

    def after(self, phase: Phase, t: float, q: Array, v: Array, force: Force) -> tuple[Array, Array]:
        """Return the velocity at the end of a phase, zero of what stopped there, and the signs of what lets go."""
        ended = self.ended(self.margins(phase, t, q, v, force))
        lets_go = ended[phase.still[ended]]
        out, leaving = np.where(phase.still, 0.0, v), np.zeros(len(v))
        out[ended] = 0.0
        if lets_go.size:
            leaving[lets_go] = -np.sign(self.holding(phase, t, q, v, force)[lets_go])
        return out, leaving


def applied(force: Force, t: float, q: Array, v: Array) -> Array:
    """Return the force at one state, (n,), or at several of a trajectory, (N, n)."""
    return np.asarray(force(t, q, v) if callable(force) else force)
