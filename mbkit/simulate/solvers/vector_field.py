"""q̇ and v̇ as one vector, for integrators that know no manifold."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.errors import NumericalError
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.constraint_projection import Approach, beside, settled
from mbkit.simulate.solvers.runge_kutta import BOUND
from mbkit.simulate.torque import Force

__all__ = ["Rates"]


class Rates:
    """The right-hand side on y = (q, v) of one state, with quaternions of any length.

    Nothing is shared with the fixed-step methods: quaternions are four numbers
    with the rate D(q) v of their joint, and velocities are mbkit's own.

    Attributes
    ----------
    evaluations : int
        Of the forward dynamics so far.
    why : str
        What the engine said when it last failed.
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
        # A user's function never sees a state that is none. By its norm, which is quicker than by each number.
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
