"""Singular poses of constraints: whether a motion is determined there, how it goes through, and when it did.

At a singular pose rows of J depend on each other: Uᵀ J = 0 for some combinations U of rows, and other branches of
motion may begin there. A motion that arrives with a velocity goes on along its own branch: the derivative of
Uᵀ (J v̇ + γ) = 0 is Uᵀ J̇ v̇ + Uᵀ (∂γ/∂v v̇ + ∂γ/∂q q̇ + ∂γ/∂t) = 0, which takes the place of the rows that are lost. The
motion is determined where the rows of J and of Uᵀ J̇ together are independent: where the singular values of J that
vanish do so at a rate. At rest they do not, and no equation says which branch comes next.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import MAX_NAMES, at_times
from mbkit.engines.constrained import TAKES_PART
from mbkit.model.validation import listing

if TYPE_CHECKING:
    from mbkit.engines.constraint_manifold import Manifold

#: Tolerance that rk853 may take near a singular pose, where rounding keeps it from a tighter one.
LOOSEST: Final = 1e-9
#: Steps within which a pose is near. At a third of the way a series of the tightest tolerance never arrives.
AHEAD: Final = 4
#: Steps' ends that decide on one interval.
_WINDOW: Final = 4
#: Largest velocity residual, relative to the rows (1/s), that counts as zero.
_STILL: Final = 1e-7
#: Rest of γ at a velocity that stays on a branch to a loose run's digits, relative to its size at any velocity.
_ON_BRANCH: Final = 1e-5
#: Difference of times by which J's rate is found, relative to the motion's time scale.
_APART: Final = 1e-4
#: Where a step of rk853 has the pose: in the middle of the widest gap between its stages, 1/3 and 0.6.
_BETWEEN: Final = 7 / 15
#: Least distance of the end of a step of rk853 from a pose, in lengths of the step.
_END_DISTANCE: Final = 0.45


def manifold_at(dyn: Dynamics, t: float) -> Manifold:
    """Return the states that the constraints of dynamics allow at a time."""
    # The import loads CasADi.
    from mbkit.engines.constraint_manifold import manifold_of

    return manifold_of(dyn).at(t)


def _known(dyn: Dynamics, t: float) -> float:
    """Return a time beside one of a run, or the last one before it of which tables of motions know."""
    first, last = dyn.model.interval
    return min(max(t, first), last)


class _Slopes(NamedTuple):
    """v, J, γ, M and the force of gravity, springs and velocities at a state, and how J and γ change from there.

    J̇ and `gamma_rate` are along the motion with constant velocity; `by_velocity` is ∂γ/∂v.
    """

    v: Array
    J: Array
    gamma: Array
    M: Array
    force: Array
    J_rate: Array
    gamma_rate: Array
    by_velocity: Array


def _slopes(manifold: Manifold, t: float, q: Array, v: Array) -> _Slopes:
    model, n = manifold.dyn.model, len(v)
    apart = _APART / float(np.abs(v).max())
    # γ is quadratic in v: differences of any length are its derivative.
    around = float(np.abs(v).max()) * np.eye(n)
    here = manifold.call("embedded", np.tile(q, (2 * n + 1, 1)), np.array([v, *(v + around), *(v - around)]))
    J, _, gamma, M, force = (x[0] for x in here)
    both = []
    for side in (apart, -apart):
        J1, _, gamma1, *_ = manifold.at(_known(manifold.dyn, t + side)).call(
            "embedded", model.integrate(q, side * v), v
        )
        both.append((J1, gamma1[:, 0]))
    (J1, g1), (J0, g0) = both
    by_velocity = (here[2][1 : n + 1, :, 0] - here[2][n + 1 :, :, 0]).T / (2 * around[0, 0])
    return _Slopes(v, J, gamma[:, 0], M, force[:, 0], (J1 - J0) / (2 * apart), (g1 - g0) / (2 * apart), by_velocity)


class Passage:
    """A motion at a singular pose: by which rows it is one, why it is not determined there, and its acceleration."""

    def __init__(self, manifold: Manifold, t: float, q: Array, v: Array) -> None:
        self._manifold = manifold
        from mbkit.engines.constraint_manifold import AT_POSE

        U, sizes, Vt = np.linalg.svd(manifold.jacobian(q))
        rank = min(int(np.count_nonzero(sizes > AT_POSE * sizes[0])), len(U) - 1)
        # Rows that are all zero have no size of their own.
        self._size = float(sizes[0]) or 1.0
        self._lost, self._kept = U[:, rank:], U[:, :rank]
        self._free = Vt[rank:].T
        self._slopes = _slopes(manifold, t, q, v) if v.any() else None

    @property
    def rows(self) -> list[int]:
        """Which rows depend on each other."""
        return [int(k) for k in np.flatnonzero(np.abs(self._lost).max(axis=1) > TAKES_PART)]

    @cached_property
    def undetermined(self) -> str:
        """Where the motion is, and why it does not go on in one way; empty where it does."""
        why = self._undetermined()
        if not why:
            return ""
        rows = listing([self._manifold.names[k] for k in self.rows], MAX_NAMES)
        return f"at a singular pose, where {rows} depend on each other, and {why}"

    def _undetermined(self) -> str:
        x = self._slopes
        if x is None:
            return "at rest there each branch of its motion is as good as another"
        turning = self._turned(x.J_rate) @ self._free
        if not np.linalg.svd(turning, compute_uv=False)[-1] > _STILL:
            return "its velocity does not say on which branch it goes on"
        # γ is quadratic in v, and zero in these rows on a branch.
        rest = float(np.abs(self._turned(x.gamma)).max())
        most = float(np.abs(self._turned(x.by_velocity)).sum(axis=1).max()) * float(np.abs(x.v).max())
        if not rest <= _ON_BRANCH * most:
            return f"its velocity is off each branch by {rest / most:.1g} of its size"
        return ""

    def acceleration(self, tau: Array) -> Array:
        """Return v̇ on the branch of the velocity; NaN where it is not determined."""
        x, n = self._slopes, self._free.shape[0]
        if x is None or self.undetermined or tau.shape[-1] != n:
            return np.full(n, np.nan)
        rows, equations = (
            np.concatenate([self._kept.T @ x.J / self._size, self._turned(lost)])
            for lost in (x.J_rate, x.J_rate + x.by_velocity)
        )
        right = -np.concatenate([self._kept.T @ x.gamma / self._size, self._turned(x.gamma_rate)])
        weight = float(np.abs(x.M).max())
        K = np.block([[x.M / weight, -rows.T], [equations, np.zeros((len(rows), len(rows)))]])
        given = np.concatenate([(tau + x.force) / weight, right])
        out: Array = np.linalg.lstsq(K, given, rcond=None)[0][:n]
        return out

    def _turned(self, x: Array) -> Array:
        return np.asarray(self._lost.T @ x / self._size)


def at_singular_poses(dyn: Dynamics, t: float, q: Array, v: Array, tau: Array) -> tuple[NDArray[np.bool_], Array, str]:
    """Return which states are at singular poses, v̇ of these, and why one of them has none.

    v̇ is NaN where the motion is not determined and, for now, of all other states.
    """
    manifold = manifold_at(dyn, t)
    which, a, why = manifold.at_pose(q) & np.isfinite(v).all(axis=-1), np.full(v.shape, np.nan), ""
    if not which.any():
        return which, a, why
    for i in map(tuple, np.argwhere(which)):
        own = manifold.member(i[0]) if i else manifold
        here = Passage(own, t, q[i], v[i])
        a[i] = here.acceleration(np.broadcast_to(tau, (*v.shape[:-1], tau.shape[-1]))[i])
        if here.undetermined:
            why = f"the motion is {here.undetermined}"
    return which, a, why


class Approach:
    """Whether a run comes near a singular pose, of one state or a batch.

    Attributes
    ----------
    ahead : float or array
        When J's smallest singular value will be zero at its present rate, s from the last end of a step; negative
        where it was before, and infinite where the last step says already that no pose is near.
    near : bool
        Whether that is within a few steps, of any state.
    """

    def __init__(self) -> None:
        self.near, self.ahead = True, np.asarray(np.inf)
        self._t, self._distance, self._pace = -np.inf, np.asarray(np.inf), np.asarray(np.nan)
        self._unseen: tuple[Dynamics, float, Array, Array] | None = None

    def saw(self, dyn: Dynamics, t: float, q: Array, v: Array) -> None:
        """Take in the end of a step."""
        since, last = t - self._t, self._distance
        with np.errstate(divide="ignore", invalid="ignore"):
            self._t, self._distance = t, manifold_at(dyn, t).dependence(q) ** -0.5
            self._pace = np.abs(self._distance - last) / since
        self._unseen, self.ahead = (dyn, t, q, v), np.asarray(np.inf)
        self.crosses(since)

    def crosses(self, h: float) -> bool:
        """Return whether a pose is within a few steps of length h, ahead or behind; then it is `near`."""
        # A pace that is not known is not above.
        self.near = not (self._distance > AHEAD * h * self._pace).all()
        if self.near and self._unseen is not None:
            self.ahead, self._unseen = _time_ahead(*self._unseen), None
        self.near = self.near and bool((np.abs(self.ahead) <= AHEAD * h).any())
        return self.near

    def length(self, h: float) -> float:
        """Return the length, up to h, of the next step of rk853 with which no stage comes close to a pose ahead."""
        d = float(self.ahead)
        if not 0.02 * h < d < (1 + _END_DISTANCE) * h:
            return h
        # A little longer is better than a short step before it.
        return d / _BETWEEN if d <= 1.05 * _BETWEEN * h else min(h, d - _END_DISTANCE * h)

    def ends_close(self, h: float) -> bool:
        """Return whether a step of rk853 of this length would end close to a pose."""
        return bool(abs(float(self.ahead) - h) < _END_DISTANCE * h)


def _time_ahead(dyn: Dynamics, t: float, q: Array, v: Array) -> Array:
    """Return when J's smallest singular value will be zero at its present rate, s from now; 0 at a singular pose."""
    from mbkit.engines.constraint_manifold import AT_POSE

    manifold = manifold_at(dyn, t)
    apart = _APART / np.maximum(np.abs(v).max(axis=-1, keepdims=True), np.finfo(float).tiny)
    J, beside = (manifold.jacobian(x) for x in (q, dyn.model.integrate(q, apart * v)))
    U, sizes, V = np.linalg.svd(np.where(np.isfinite(J), J, 0.0), full_matrices=False)
    # By the vectors, as the value itself turns round where it is zero.
    change = (U[..., None, :, -1] @ (beside - J) @ V[..., -1, :, None])[..., 0, 0]
    ahead = np.divide(-sizes[..., -1] * apart[..., 0], change, out=np.full(change.shape, np.inf), where=change != 0)
    return np.where(sizes[..., -1] <= AT_POSE * sizes[..., 0], 0.0, ahead)[()]


class SingularPoses:
    """The singular poses that one trajectory passes, by how far from one the ends of its steps are.

    Through a singular pose this distance, 1/√`dependence`, is smooth once its sign is changed there.
    """

    def __init__(self, dyn: Dynamics) -> None:
        self._dyn = dyn
        self._seen: list[tuple[float, float, Array]] = []
        self.times: list[float] = []
        self._rows: list[int] = []

    def began(self, t: float, q: Array) -> None:
        """Take in the start."""
        if manifold_at(self._dyn, t).at_pose(q):
            self._passed(t, t, q)

    def _passed(self, t: float, near: float, q: Array) -> None:
        """Keep the time of a pose, and the rows that depend on each other at the state nearest to it."""
        manifold = manifold_at(self._dyn, near)
        self._rows = Passage(manifold, near, q, np.zeros(manifold.dyn.model.nv)).rows
        self.times.append(t)

    def saw(self, t: float, q: Array) -> None:
        """Take in the end of a step."""
        self.take(t, float(manifold_at(self._dyn, t).dependence(q)), q)

    def saw_all(self, t: Array, q: Array) -> None:
        """Take in the ends of steps, (n,) and (n, nq)."""
        from mbkit.engines.constraint_manifold import manifold_of

        depends = manifold_of(at_times(manifold_of(self._dyn).dyn, t, 1)).dependence(q)
        for end in zip(t.tolist(), depends.tolist(), q, strict=True):
            self.take(*end)

    def take(self, t: float, dependence: float, q: Array) -> None:
        """Take in the end of a step by the `dependence` of rows there; one that is not finite says nothing."""
        if dependence != dependence:
            return
        self._seen = [*self._seen[1 - _WINDOW :], (t, dependence**-0.5, q)]
        if len(self._seen) == _WINDOW:
            self._decide()

    def _decide(self) -> None:
        times, (s0, s1, s2, s3), q = zip(*self._seen, strict=True)
        if not (s1 <= s0 and s2 <= s3) or (self.times and self.times[-1] >= times[0]):
            return
        if not _bend(times, [s0, s1, -s2, -s3]) < _bend(times, [s0, s1, s2, s3]):
            return
        middle = np.array(times) - times[1]
        roots = np.roots(np.polyfit(middle, [s0, s1, -s2, -s3], 3))
        within = roots[np.isreal(roots) & (roots.real >= 0) & (roots.real <= middle[2])].real
        if len(within):
            nearest = 1 if s1 < s2 else 2
            self._passed(times[1] + float(within[0]), times[nearest], q[nearest])

    def describe(self, tolerance: bool) -> str:
        """Return the poses in a sentence, for a method with or without a tolerance; empty where there are none."""
        if not self.times:
            return ""
        when = ", ".join(f"{t:.4g}" for t in self.times[:3]) + (" and later" if len(self.times) > 3 else "")
        names = manifold_at(self._dyn, self.times[0]).names
        rows = " and ".join(names[k] for k in self._rows)
        error = f"; a step there may be off by {LOOSEST:g} whatever the tolerance" if tolerance else ""
        return (
            f"passed a singular pose at t = {when} (s), where {rows} lose their independence; other motions may begin "
            f"there, and the run followed the smooth one{error}"
        )


class SingularPosesOfBatch:
    """The singular poses that trajectories pass which step together, by their numbers."""

    def __init__(self, dyn: Dynamics, t: float, q: Array, members: Iterable[int] | None = None) -> None:
        which = range(len(q)) if members is None else members
        self.members = {i: SingularPoses(dyn._of_samples([i])) for i in which}
        for i, poses in self.members.items():
            poses.began(t, q[i])

    def saw(self, dyn: Dynamics, t: float, q: Array, members: Iterable[int]) -> None:
        """Take in the ends of the steps of these members, whose dynamics are `dyn`."""
        for i, depends, at in zip(members, manifold_at(dyn, t).dependence(q).tolist(), q, strict=True):
            self.members[int(i)].take(t, depends, at)


def describe_poses(members: Mapping[int, SingularPoses], batch: int | None, tolerance: bool) -> str:
    """Return the poses that one trajectory, or some of a batch, passed in a sentence; empty where there are none.

    Its method has a tolerance, or a step.
    """
    passed = {i: poses for i, poses in members.items() if poses.times}
    if not passed:
        return ""
    first, poses = min(passed.items())
    if batch is None:
        return poses.describe(tolerance)
    return (
        f"{len(passed)} of {batch} trajectories passed singular poses; trajectory {first} {poses.describe(tolerance)}"
    )


def _bend(t: Iterable[float], x: Iterable[float]) -> float:
    """Return how much the slope of a line through points changes, in all."""
    slopes = [(x1 - x0) / (t1 - t0) for (t0, t1), (x0, x1) in zip(pairwise(t), pairwise(x), strict=True)]
    return sum(abs(b - a) for a, b in pairwise(slopes))
