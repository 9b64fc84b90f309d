"""The right-hand side that solvers integrate: ẇ on the manifold, and (q̇, v̇) as one vector."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.errors import InputError, NumericalError
from mbkit.model.integration_space import Space
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.constraint_projection import Approach, beside, settled
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force

DIVERGED: Final = "the state grew beyond all bounds"
#: A state with a number of this size has diverged.
BOUND: Final = 1e100


class DivergenceError(Exception):
    """The state or acceleration is not finite or exceeds 1e100; never leaves `mbkit.simulate`."""


def is_bounded(x: Array) -> NDArray[np.bool_]:
    """Return, per state, whether all its numbers are finite and below 1e100.

    No machine goes there, and energies of what lies below can still be computed.
    """
    return np.asarray((np.abs(x) < BOUND).all(axis=-1))


def _finite(q: Array, v: Array) -> bool:
    return bool(np.isfinite(q).all() and np.isfinite(v).all())


class Field:
    """ẇ of the integrators' state, from an engine's forward dynamics; `evaluations` are summed over a batch."""

    def __init__(self, dyn: Dynamics, space: Space) -> None:
        self._dyn, self._space, self._flat = dyn, space, space.flat
        self._use(dyn)
        self.evaluations = 0

    def only(self, members: Indices) -> None:
        """Go on with these members of the whole batch."""
        self._use(self._dyn.of_samples(members))

    def _use(self, own: Dynamics) -> None:
        self._own, self._forward, self._timed = own, own.forward_dynamics, own.model.time_parameter is not None
        self._approach, self._constrained = Approach(), own.model.constrained

    @property
    def near_singular(self) -> bool:
        """Whether constraints may soon depend on each other."""
        return self._constrained and self._approach.near

    def settled(self, t: float, q: Array, w: Array) -> tuple[Array, Array]:
        """Return the state that a step led to, on its constraints if there are some."""
        if not self._constrained:
            return q, w
        q, w = settled(self._own, t, q, w)
        self._approach.saw(self._own, t, q)
        return q, w

    def consistent(self, t: float, q: Array, w: Array, force: Force) -> Array:
        """Return ẇ at an explicit method's stage; near a singular pose at the state on the constraints beside it."""
        if self._constrained and self._approach.near:
            q, w = beside(self._own, t, q, w)
        return self(t, q, w, force)

    def __call__(self, t: float, q: Array, w: Array, force: Force) -> Array:
        """Return ẇ, or raise `DivergenceError`."""
        v = w if self._flat else self._space.leave(q, w)
        if not isinstance(force, np.ndarray):
            # Never call the user's function on a state that is not finite.
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
        return a if self._flat else np.asarray(self._space.acceleration(q, v, a))


def _blamed(message: str, q: Array, v: Array) -> str:
    # An engine overflows before its state does, and blames the model for it.
    largest = max(float(np.abs(x).max()) for x in (q, v))
    return message if largest < 1e50 else DIVERGED


class Rates:
    """The right-hand side on y = (q, v) of one state, with quaternions of any length as four numbers.

    `why` is the engine's reason when it last failed.
    """

    def __init__(self, dyn: Dynamics, *, explicit: bool = False) -> None:
        self._explicit, self._approach = explicit, Approach()
        self._dyn, self._model, self._own = dyn, dyn.model, dyn
        self._forward, self._timed = dyn.forward_dynamics, dyn.model.time_parameter is not None
        layout = dyn.model.layout
        self._joints = [(j.type, layout.q[j.name], layout.v[j.name]) for j in dyn.model.independent_joints]
        self.evaluations = 0
        self.why = ""

    def only(self, member: int) -> None:
        """Go on with this member of a batch."""
        self._own, self._approach = self._dyn.of_samples([member]), Approach()
        self._forward = self._own.forward_dynamics

    def settled(self, t: float, y: Array) -> Array:
        """Return the state that a step led to, on its constraints if there are some."""
        if not self._model.constrained:
            return y
        nq = self._model.nq
        q, v = settled(self._own, t, y[:nq], y[nq:])
        if self._explicit:
            self._approach.saw(self._own, t, q)
        return np.concatenate([q, v])

    def __call__(self, t: float, y: Array, force: Force) -> Array:
        """Return ẏ; NaN where there is none, so that a step is tried again, smaller."""
        # Never call the user's function on a non-finite state; testing the norm is cheapest.
        if not float(y @ y) < BOUND**2:
            return np.full(len(y), np.nan)
        nq = self._model.nq
        q, lengths = unit_quaternions(self._model, y[:nq])
        v = y[nq:]
        if self._explicit and self._model.constrained and self._approach.near:
            # One of a batch with parameters of its own is a batch of one.
            q, v = (x.reshape(-1) for x in beside(self._own, t, q, v))
        tau = force if isinstance(force, np.ndarray) else force(t, q, v)
        self.evaluations += 1
        if self._timed:
            self._forward = at_time(self._own, t).forward_dynamics
        try:
            # One of a batch with parameters of its own is a batch of one.
            a = self._forward(q, v, tau).reshape(-1)
        except NumericalError as error:
            self.why = str(error)
            return np.full(len(y), np.nan)
        return np.concatenate([self._qdot(q, v, lengths), a])

    def _qdot(self, q: Array, v: Array, lengths: Array) -> Array:
        if self._model.velocity_map is not None:
            return np.asarray(self._model.velocity_map.enter(q, v))
        if not self._model.quaternions:
            return v
        out = np.empty(len(q))
        for kind, a, b in self._joints:
            out[a] = kind.qdot(q[a].tolist(), v[b].tolist())
        # D is linear in the quaternion: with its own length put back, the drift
        # of that length never bends the rotation.
        for (start, _), length in zip(self._model.quaternions, lengths, strict=True):
            out[start : start + 4] *= length
        return out
