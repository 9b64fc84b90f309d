"""Runs under constraints: projection of their states onto f = 0 and ḟ = 0.

The equation of motion holds f̈ = 0 only, so that f and ḟ drift. One-step methods project each step's end, by Newton's
iteration with the mass matrix as the weight; it moves a state by the step's own error, so that the order stays. Near a
singular pose explicit methods project their stages too, since f̈ = 0 divides their errors by J's smallest singular
value. A projection would spoil the history of multistep methods (BDF, LSODA, CVODES): only their kept states have it.
An engine with soft constraints projects nothing: how far its states leave the constraints is part of its answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_times
from mbkit.errors import InputError
from mbkit.simulate.result import SolverResult

if TYPE_CHECKING:
    from mbkit.engines.constraint_manifold import Manifold

#: Tolerance that rk853 may take near a singular pose, where rounding keeps it from a tighter one.
LOOSEST: Final = 1e-9
#: Steps ahead in which a pose would be singular at the present pace.
_AHEAD: Final = 4
#: A sign change of the smallest singular value makes its third differences smaller than this part of those without.
_SMOOTHER: Final = 0.5
#: Steps' ends that decide on one interval.
_WINDOW: Final = 4
#: Of a unit vector: the entries of the constraints that depend on each other.
_TAKES_PART: Final = 0.1


def _manifold(dyn: Dynamics, t: float) -> Manifold:
    # The import loads CasADi.
    from mbkit.engines.constraint_manifold import manifold_of

    return manifold_of(dyn).at(t)


def from_consistent(dyn: Dynamics, q: Array, v: Array, t: float) -> tuple[Array, Array]:
    """Return initial states without rounding; an `InputError` where one or the constraints are inconsistent."""
    if not dyn.model.constrained:
        return q, v
    from mbkit.engines.constraint_manifold import refuse_unreachable, require_independent

    manifold = _manifold(dyn, t)
    try:
        manifold.check(q, v)
    except InputError:
        refuse_unreachable(manifold.member(0).dyn, np.atleast_2d(q)[0])
        raise
    if not dyn.projects:
        # Soft ones need no independence.
        return q, v
    poses = np.atleast_2d(q)
    for k in np.flatnonzero(manifold.doubtful(poses)) if len(poses) > 1 else range(len(poses)):
        require_independent(manifold.member(int(k)).dyn, poses[k])
    return manifold.pulled(q, v)


def settled(dyn: Dynamics, t: float, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the consistent states near the ends of a step."""
    return _manifold(dyn, t).pulled(q, v)


def beside(dyn: Dynamics, t: float, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the state after one step of Newton's iteration onto the constraints."""
    q, v, *_ = _manifold(dyn, t).call("constraint_step", q, v)
    return q[..., 0], v[..., 0]


class Approach:
    """Whether a run comes near a singular pose, by the smallest singular value of J at the ends of its last two steps.

    `near` is whether it would be zero within a few steps, of any state of a batch; true until two steps are known.
    """

    def __init__(self) -> None:
        self.near = True
        self._size = np.inf

    def saw(self, dyn: Dynamics, t: float, q: Array) -> None:
        """Take in the end of a step."""
        J = _manifold(dyn, t).jacobian(q)
        size = float(np.linalg.svd(J, compute_uv=False)[..., -1].min()) if np.isfinite(J).all() else np.inf
        self.near = not size >= _AHEAD * abs(size - self._size)
        self._size = size


class SingularPoses:
    """The singular poses that one trajectory passes, by J's smallest singular value at the ends of steps.

    Through a singular pose the value is smooth once its sign is changed there.
    """

    def __init__(self, dyn: Dynamics) -> None:
        self._dyn = dyn
        self._seen: list[tuple[float, float, Array]] = []
        self.times: list[float] = []
        self._rows: list[int] = []

    def saw(self, t: float, q: Array) -> None:
        """Take in the end of a step."""
        self.saw_all(np.array([t]), np.reshape(q, (1, -1)))

    def saw_all(self, t: Array, q: Array) -> None:
        """Take in the ends of steps, (n,) and (n, nq)."""
        if self._dyn.model.time_parameter is None:
            J = _manifold(self._dyn, 0.0).jacobian(q)
        else:
            J = np.array([_manifold(self._dyn, at).jacobian(x) for at, x in zip(t.tolist(), q, strict=True)])
        J = J.reshape(len(t), -1, J.shape[-1])
        finite = np.isfinite(J).all(axis=(1, 2))
        U, sizes, _ = np.linalg.svd(J[finite])
        for at, size, rows in zip(t[finite].tolist(), sizes[:, -1].tolist(), U[:, :, -1], strict=True):
            self._seen = [*self._seen[1 - _WINDOW :], (at, size, rows)]
            if len(self._seen) == _WINDOW:
                self._decide()

    def _decide(self) -> None:
        (first, s0, _), (_, s1, _), (_, s2, _), (_, s3, _) = self._seen
        if not (s1 <= s0 and s2 <= s3) or (self.times and self.times[-1] >= first):
            return
        times = [t for t, _, _ in self._seen]
        plain, turned = _third_difference(times, [s0, s1, s2, s3]), _third_difference(times, [s0, s1, -s2, -s3])
        if not abs(turned) < _SMOOTHER * abs(plain):
            return
        middle = np.array(times) - times[1]
        roots = np.roots(np.polyfit(middle, [s0, s1, -s2, -s3], 3))
        within = roots[(abs(roots.imag) < 1e-12) & (roots.real >= 0) & (roots.real <= middle[2])].real
        if len(within):
            nearest = 1 if s1 < s2 else 2
            self._rows = np.flatnonzero(np.abs(self._seen[nearest][2]) > _TAKES_PART).tolist()
            self.times.append(times[1] + float(within[0]))

    def describe(self) -> str:
        """Return the poses in a sentence; empty where there are none."""
        if not self.times:
            return ""
        when = ", ".join(f"{t:.4g}" for t in self.times[:3]) + (" and later" if len(self.times) > 3 else "")
        names = _manifold(self._dyn, self.times[0]).names
        rows = " and ".join(names[k] for k in self._rows)
        return (
            f"passed a singular pose at t = {when} (s), where {rows} lose their independence; other motions may begin "
            f"there, and the run followed the smooth one; a step there may be off by {LOOSEST:g} whatever the tolerance"
        )


def _third_difference(t: Sequence[float], x: Sequence[float]) -> float:
    """Return the divided difference of four values: the leading coefficient of the cubic through them."""
    difference = list(x)
    for order in range(1, len(t)):
        difference = [(b - a) / (t[k + order] - t[k]) for k, (a, b) in enumerate(pairwise(difference))]
    return difference[0]


def along_constraints(dyn: Dynamics, outcome: SolverResult) -> SolverResult:
    """Return a run with its kept states projected onto the constraints; an engine's soft ones keep their drift."""
    if not dyn.projects or not outcome.q.size:
        return outcome
    from mbkit.engines.constraint_manifold import manifold_of

    q, v = outcome.q.copy(), outcome.v.copy()
    shape = q.shape
    flat_q, flat_v = q.reshape(-1, shape[-1]), v.reshape(-1, v.shape[-1])
    good = np.flatnonzero(np.isfinite(flat_q).all(axis=1) & np.isfinite(flat_v).all(axis=1))
    own = manifold_of(dyn).dyn
    trajectories = shape[0] if q.ndim == 3 else None
    if own.model.time_parameter is not None:
        own = at_times(own, outcome.t, trajectories)
    elif trajectories is not None:
        own = own.of_samples(np.repeat(np.arange(trajectories), shape[1]))
    flat_q[good], flat_v[good] = manifold_of(own.of_samples(good)).pulled(flat_q[good], flat_v[good])
    return replace(outcome, q=q, v=v)
