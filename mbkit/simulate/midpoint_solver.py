"""One step of the implicit midpoint rule at a time, for torque functions and what is not compiled."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.derivation.midpoint import LEAST, MOST, SMALL, Midpoint
from mbkit.derivation.step import Part
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.model.space import Space
from mbkit.simulate.grid import Indices
from mbkit.simulate.torque import Torque

__all__ = ["MidpointSolver", "called"]

# With a torque function the iteration converges linearly.
_WITH_FUNCTION: Final = 60
_EPS: Final = float(np.finfo(float).eps)


def called(
    dyn: LagrangianDynamics, part: Part, members: slice | Indices, t: Array | float, *arguments: Array
) -> list[Array]:
    """Return a part's results for members of a batch: vectors as (n, rows), matrices as (n, rows, columns).

    `t`, one for all or (n,), is the time of evaluation, where the dynamics depends on it.
    """
    n = len(arguments[0])
    given = [np.broadcast_to(x, (n, x.shape[-1])) for x in arguments]
    if dyn.model.parameters:
        values = dyn.parameter_values
        own = values[members] if values.ndim == 2 else np.broadcast_to(values, (n, len(values)))
        if dyn.model.clock is not None:
            own = own.copy()
            own[:, list(dyn.model.parameters).index(dyn.model.clock)] = t
        given.append(own)
    results = dyn.code(part.name, make=part.make)(*given, threads=dyn.threads)
    return [
        x[..., 0] if x.shape[-1] == 1 and name not in ("M", "jacobian") else x
        for name, x in zip(part.writes, results, strict=True)
    ]


class MidpointSolver:
    """Newton's iteration for trajectories side by side.

    Parameters
    ----------
    dyn : LagrangianDynamics
    torque : Torque
    single : bool
        Whether there is one trajectory, no batch.

    Attributes
    ----------
    iterations : int
        Summed over the trajectories.
    """

    def __init__(self, dyn: LagrangianDynamics, torque: Torque, *, single: bool) -> None:
        self._dyn, self._torque, self._single = dyn, torque, single
        self._midpoint, self._space = Midpoint(dyn.equations), Space(dyn.model)
        self.iterations = 0

    def velocity(
        self, members: Indices, k: int, t: float, h: float, q: Array, pi: Array, guess: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the velocity of step k, the torque that acted, and whether the step is solved, per trajectory.

        With a torque function it goes on until corrections stop shrinking.
        """
        w, good = guess.copy(), np.full(len(q), False)
        tau = np.empty(w.shape)
        if not self._torque.callable:
            tau[:] = self._torque.columns(members, k, k + 1)[0].T
        last, todo = np.full(len(q), np.inf), np.arange(len(q))
        for _ in range(_WITH_FUNCTION if self._torque.callable else MOST):
            # A user's function never sees a state that is none.
            todo = todo[np.isfinite(w[todo]).all(axis=1) & ~good[todo]]
            if not len(todo):
                break
            if self._torque.callable:
                tau[todo] = self._function(members[todo], k, t, h, q[todo], w[todo])
            w1, solved = self._newton(members[todo], t + h / 2, q[todo], pi[todo], w[todo], tau[todo], h)
            change = np.abs(w1 - w[todo]).max(axis=1, initial=0.0)
            if self._torque.callable:
                solved &= (change <= 4 * _EPS * np.abs(w1).max(axis=1, initial=0.0)) | (change >= last[todo] / 2)
            w[todo], good[todo], last[todo] = w1, solved, change
        return w, tau, good

    def _function(self, members: Indices, k: int, t: float, h: float, q: Array, w: Array) -> Array:
        force = self._torque.during(k, None if self._single else members)
        assert callable(force)
        q_m = self._space.move(q, (h / 2) * w)
        state = q_m, self._space.leave(q_m, w)
        if self._single:
            return np.asarray(force(t + h / 2, *(x[0] for x in state)))[None]
        return force(t + h / 2, *state)

    def _newton(
        self, members: Indices, t: float, q: Array, pi: Array, w: Array, tau: Array, h: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        self.iterations += len(q)
        given = (q, pi, w, tau, np.array([[h]]))
        if self._dyn.written_out:
            w1, miss = called(self._dyn, self._midpoint.newton, members, t, *given)
            return w1, miss[:, 0] == 0
        residual, jacobian = called(self._dyn, self._midpoint.system, members, t, *given)
        change = _solved(jacobian, residual)
        w1 = w - change
        limit = SMALL**2 * np.sum(w1**2, axis=1) + (LEAST / h) ** 2 * (1 + np.sum(q**2, axis=1))
        return w1, np.sum(change**2, axis=1) < limit

    def end(
        self, members: Indices, t: float, h: float, q: Array, pi: Array, ws: list[Array], tau: Array
    ) -> tuple[Array, Array, Array]:
        """Return q and π after the step, and the first guess of the next velocity, from those of the last steps."""
        zero = np.zeros((1, 1))
        outs = called(self._dyn, self._midpoint.end, members, t + h / 2, q, pi, *ws, tau, np.array([[h]]), zero, zero)
        return outs[0], outs[1], outs[2]


def _solved(A: Array, b: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])
    except np.linalg.LinAlgError:
        # One singular matrix must not stop the others of a batch.
        out = np.full(b.shape, np.nan)
        for i in range(len(b)):
            try:
                out[i] = np.linalg.solve(A[i], b[i])
            except np.linalg.LinAlgError:
                continue
        return out
