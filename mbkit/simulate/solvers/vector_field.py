"""The right-hand side that solvers integrate: ẇ on the manifold, and (q̇, v̇) as one vector."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mbkit._attributes import forwarded
from mbkit._check import BOUND, Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.errors import InputError, NumericalError
from mbkit.model.integration_space import Space
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.constraint_projection import settled
from mbkit.simulate.singular_poses import Approach
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force

DIVERGED: Final = "the state grew beyond all bounds"
#: An engine overflows before its state does, and blames the model: from this size on its reason does not count.
BLAMELESS: Final = 1e50
ALL: Final = np.array(True)


class DivergenceError(Exception):
    """The state or acceleration is not finite or exceeds 1e100; never leaves `mbkit.simulate`."""


def is_bounded(x: Array) -> NDArray[np.bool_]:
    """Return, per state, whether all its numbers are finite and below 1e100."""
    return np.asarray((np.abs(x) < BOUND).all(axis=-1))


def are_bounded(q: Array, w: Array) -> NDArray[np.bool_]:
    """Return which states are bounded; of one state the squares usually tell, and are quicker."""
    if q.ndim == 1 and q @ q + w @ w < BOUND**2:
        return ALL
    return np.asarray(is_bounded(q) & is_bounded(w))


class Field:
    """ẇ of the integrators' state, from an engine's forward dynamics; `evaluations` are summed over a batch.

    Without a space, w is mbkit's v. Under constraints an adaptive run looks how near a singular pose it is.
    """

    #: Whether the ends of steps are looked at.
    looks: bool = True

    def __init__(self, dyn: Dynamics, space: Space | None) -> None:
        self._dyn, self._space = dyn, None if space is None or space.flat else space
        self._use(dyn)
        self.evaluations = 0

    def only(self, members: Indices) -> None:
        """Go on with these members of the whole batch."""
        self._use(self._dyn._of_samples(members))

    def _use(self, own: Dynamics) -> None:
        self._own, self._forward, self._timed = own, own.forward_dynamics, own.model.time_parameter is not None
        self._approach, self._constrained = Approach(), own._projects

    dyn: Dynamics = forwarded("_own", "The dynamics of the members of the batch that go on.")
    projects: bool = forwarded("_constrained", "Whether states are projected onto constraints.")

    @property
    def near_singular(self) -> bool:
        """Whether constraints may soon depend on each other."""
        return self._constrained and self._approach.near

    def settled(self, t: float, q: Array, w: Array) -> tuple[Array, Array]:
        """Return the state that a step led to, on its constraints if there are some."""
        if not self._constrained:
            return q, w
        if self._space is None:
            q, w = settled(self._own, t, q, w)
        else:
            q, v = settled(self._own, t, q, self._space.to_body_velocity(q, w))
            w = self._space.to_integrator_velocity(q, v)
        self.look(t, q, w)
        return q, w

    def look(self, t: float, q: Array, w: Array) -> None:
        """Look how near a singular pose the run is, at the start or the end of a step."""
        if self._constrained and self.looks:
            self._approach.saw(self._own, t, q, w if self._space is None else self._space.to_body_velocity(q, w))

    approach: Approach = forwarded("_approach", "How near a singular pose the run is.")

    def __call__(self, t: float, q: Array, w: Array, force: Force) -> Array:
        """Return ẇ, or raise `DivergenceError`."""
        v = w if self._space is None else self._space.to_body_velocity(q, w)
        if not isinstance(force, np.ndarray):
            # Never call the user's function on a state that is not finite.
            if not are_bounded(q, v).all():
                raise DivergenceError(DIVERGED)
            force = force(t, q, v)
        self.evaluations += 1 if q.ndim == 1 else len(q)
        forward = at_time(self._own, t).forward_dynamics if self._timed else self._forward
        try:
            a = forward(q, v, force)
        except NumericalError as error:
            largest = max(float(np.abs(x).max()) for x in (q, v))
            raise DivergenceError(str(error) if largest < BLAMELESS else DIVERGED) from None
        except InputError:
            if np.isfinite(q).all() and np.isfinite(v).all():
                raise
            raise DivergenceError(DIVERGED) from None
        a = np.asarray(a if a.ndim == v.ndim else a[0])
        return a if self._space is None else np.asarray(self._space.acceleration(q, v, a))


class Rates:
    """The right-hand side on y = (q, v) of one state, with quaternions of any length as four numbers.

    `why` is the engine's reason when it last failed.
    """

    def __init__(self, dyn: Dynamics) -> None:
        self._model, self._field = dyn.model, Field(dyn, None)
        # Steps near a singular pose are not made of these.
        self._field.looks = False
        layout = dyn.model.layout
        self._joints = [(j.type, layout.q[j.name], layout.v[j.name]) for j in dyn.model.independent_joints]
        self.why = ""

    evaluations: int = forwarded("_field.evaluations", "Evaluations of the forward dynamics.")

    def only(self, member: int) -> None:
        """Go on with this member of a batch."""
        self._field.only(np.array([member]))

    def settled(self, t: float, y: Array) -> Array:
        """Return the state that a step led to, on its constraints if there are some."""
        nq = self._model.nq
        return np.concatenate(self._field.settled(t, y[:nq], y[nq:])) if self._field.projects else y

    def __call__(self, t: float, y: Array, force: Force) -> Array:
        """Return ẏ; NaN where it cannot be computed, so that the solver tries a smaller step."""
        # Never call the user's function on a non-finite state; testing the norm is cheapest.
        if not float(y @ y) < BOUND**2:
            return np.full(len(y), np.nan)
        nq = self._model.nq
        q, lengths = unit_quaternions(self._model, y[:nq])
        v = y[nq:]
        try:
            a = self._field(t, q, v, force)
        except DivergenceError as error:
            self.why = str(error)
            return np.full(len(y), np.nan)
        return np.concatenate([self._qdot(q, v, lengths), a])

    def _qdot(self, q: Array, v: Array, lengths: Array) -> Array:
        if self._model.velocity_map is not None:
            return np.asarray(self._model.velocity_map.to_integrator_velocity(q, v))
        if not self._model.quaternions:
            return v
        out = np.empty(len(q))
        for kind, a, b in self._joints:
            out[a] = kind.qdot(q[a].tolist(), v[b].tolist())
        # D is linear in the quaternion: with its length put back, the drift of that length never bends the rotation.
        for (start, _), length in zip(self._model.quaternions, lengths, strict=True):
            out[start : start + 4] *= length
        return out
