"""One step of each fixed-step method, on the space of `mbkit.model.integration_space`.

A free joint's linear velocity is integrated in the axes of the joint's fixed
frame and its position by addition (see `mbkit.model.joint_types`); a rotation
is moved by the exponential of what its body-axes velocity adds up to, and inside
a Runge-Kutta step the velocities are pulled back by the inverse of exp's
differential (Munthe-Kaas 1999, High order Runge-Kutta methods on manifolds).
MuJoCo 4 does the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.errors import InputError, NumericalError
from mbkit.methods.one_step import ArrayStages, SemiImplicitEuler
from mbkit.methods.tableaus import Tableau
from mbkit.model.integration_space import Space
from mbkit.simulate.constraint_projection import Approach, beside, settled
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force

__all__ = ["BOUND", "DIVERGED", "DivergenceError", "Field", "Step", "explicit_step", "is_bounded"]

#: step(t, h, q, w, force) -> (q, w) at t + h; one state or a batch
Step = Callable[[float, float, Array, Array, Force], tuple[Array, Array]]

DIVERGED: Final = "the state grew beyond all bounds"
#: A state with a number of this size is none any more.
BOUND: Final = 1e100


class DivergenceError(Exception):
    """A state or an acceleration is none any more; never leaves `mbkit.simulate`."""


def is_bounded(x: Array) -> NDArray[np.bool_]:
    """Return, per state, whether all its numbers are finite and below 1e100.

    No machine goes there, and energies of what lies below can still be computed.
    """
    return np.asarray((np.abs(x) < BOUND).all(axis=-1))


def _finite(q: Array, v: Array) -> bool:
    return bool(np.isfinite(q).all() and np.isfinite(v).all())


class Field:
    """ẇ of the integrators' state, from an engine's forward dynamics.

    Attributes
    ----------
    evaluations : int
        Of the forward dynamics so far, summed over a batch.
    """

    def __init__(self, dyn: Dynamics, space: Space) -> None:
        self._dyn, self._space = dyn, space
        self._use(dyn)
        self.evaluations = 0

    def only(self, members: Indices) -> None:
        """Go on with these members of the whole batch."""
        self._use(self._dyn.of_samples(members))

    def _use(self, own: Dynamics) -> None:
        self._own, self._forward, self._timed = own, own.forward_dynamics, own.model.time_parameter is not None
        self._approach = Approach()

    @property
    def near_singular(self) -> bool:
        """Whether constraints may soon depend on each other."""
        return self._own.model.constrained and self._approach.near

    def settled(self, t: float, q: Array, w: Array) -> tuple[Array, Array]:
        """Return the state that a step led to, on its constraints if there are some."""
        if not self._own.model.constrained:
            return q, w
        q, w = settled(self._own, t, q, w)
        self._approach.saw(self._own, t, q)
        return q, w

    def consistent(self, t: float, q: Array, w: Array, force: Force) -> Array:
        """Return ẇ at an explicit method's stage; near a singular pose at the state on the constraints beside it."""
        if self.near_singular:
            q, w = beside(self._own, t, q, w)
        return self(t, q, w, force)

    def __call__(self, t: float, q: Array, w: Array, force: Force) -> Array:
        """Return ẇ, or raise `DivergenceError`."""
        v = self._space.leave(q, w)
        if not isinstance(force, np.ndarray):
            # A user's function never sees a state that is none.
            if not (is_bounded(q).all() and is_bounded(v).all()):
                raise DivergenceError(DIVERGED)
            force = force(t, q, v)
        self.evaluations += 1 if q.ndim == 1 else len(q)
        if self._timed:
            self._forward = at_time(self._own, t).forward_dynamics
        try:
            a = self._forward(q, v, force)
        except NumericalError as error:
            raise DivergenceError(_blamed(str(error), q, v)) from None
        except InputError:
            if _finite(q, v):
                raise
            raise DivergenceError(DIVERGED) from None
        return np.asarray(self._space.acceleration(q, v, a))


def _blamed(told: str, q: Array, v: Array) -> str:
    # An engine overflows before its state does, and blames the model for it.
    largest = max(float(np.abs(x).max()) for x in (q, v))
    return told if largest < 1e50 else DIVERGED


def explicit_step(formula: Tableau | SemiImplicitEuler, field: Field, space: Space) -> Step:
    """Return the step of a method with an explicit formula."""

    def step(t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        def rates(t: float, q: Array, u: Array | None, w: Array) -> tuple[Array, Array]:
            return w if u is None else space.rate(u, w), field.consistent(t, q, w, force)

        q, w, _ = formula.step(space, rates, ArrayStages(formula.stages, w), t, h, q, w)
        return q, w

    return step
