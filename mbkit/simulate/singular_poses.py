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
from typing import TYPE_CHECKING, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import MAX_NAMES, at_times
from mbkit.engines.constrained import AT_SINGULAR_POSE, TAKES_PART
from mbkit.model.validation import listing

if TYPE_CHECKING:
    from mbkit.engines.constraint_manifold import Manifold

#: Tightest tolerance of states within a step near a singular pose: f, whose rounding is never zero, is divided by the
#: distance from the pose. The end of the step is closer.
LOOSEST: Final = 1e-10
#: Steps within which a pose is near. At a third of the way a series of the tightest tolerance never arrives.
AHEAD: Final = 4
#: Ends of steps that decide on one of them, and the parts of it at which it is looked at too.
_WINDOW: Final = 4
_WITHIN: Final = (0.25, 0.5, 0.75)
#: Largest velocity residual, relative to the rows (1/s), that counts as zero.
_STILL: Final = 1e-7
#: Rest of γ at a velocity that stays on a branch to a loose run's digits, relative to its size at any velocity.
_ON_BRANCH: Final = 1e-5
#: Difference of times by which J's rate is found, relative to the motion's time scale.
_APART: Final = 1e-4


def manifold_at(dyn: Dynamics, t: float) -> Manifold:
    """Return the states that the constraints of dynamics allow at a time."""
    # The import loads CasADi.
    from mbkit.engines.constraint_manifold import manifold_of

    return manifold_of(dyn).at(t)


def _known(dyn: Dynamics, t: float) -> float:
    """Return a time beside one of a run, or the last one before it of which tables of motions know."""
    first, last = dyn.model.interval
    return min(max(t, first), last)


class Passage:
    """A motion at a singular pose: by which rows it is one, and why it is not determined there."""

    def __init__(self, manifold: Manifold, t: float, q: Array, v: Array) -> None:
        from mbkit.engines.constraint_manifold import AT_POSE

        self._manifold, self._t, self._q, self._v = manifold, t, q, v
        U, sizes, Vt = np.linalg.svd(manifold.jacobian(q))
        rank = min(int(np.count_nonzero(sizes > AT_POSE * sizes[0])), len(U) - 1)
        # Rows that are all zero have no size of their own.
        self._lost, self._free = U[:, rank:] / (float(sizes[0]) or 1.0), Vt[rank:].T

    @property
    def rows(self) -> list[int]:
        """Which rows depend on each other."""
        part = np.abs(self._lost).max(axis=1)
        return [int(k) for k in np.flatnonzero(part > TAKES_PART * np.linalg.norm(self._lost[:, 0]))]

    @cached_property
    def undetermined(self) -> str:
        """Where the motion is, and why it does not go on in one way; empty where it does."""
        why = self._undetermined()
        if not why:
            return ""
        rows = listing([self._manifold.names[k] for k in self.rows], MAX_NAMES)
        return f"{AT_SINGULAR_POSE}, where {rows} depend on each other, and {why}"

    def _undetermined(self) -> str:
        manifold, q, v = self._manifold, self._q, self._v
        speed, dyn = float(np.abs(v).max()), manifold.dyn
        if not speed:
            return "at rest there each branch of its motion is as good as another"
        J1, J0 = (
            manifold.at(_known(dyn, self._t + side)).jacobian(dyn.model.integrate(q, side * v))
            for side in (_APART / speed, -_APART / speed)
        )
        turning = self._lost.T @ (J1 - J0) @ self._free * (speed / (2 * _APART))
        if not np.linalg.svd(turning, compute_uv=False)[-1] > _STILL:
            return "its velocity does not say on which branch it goes on"
        # γ is quadratic in v, and zero in these rows on a branch. Differences of any length are its derivative.
        around = speed * np.eye(len(v))
        rates = np.array([v, *(v + around), *(v - around)])
        here, *others = manifold.call("embedded", np.tile(q, (len(rates), 1)), rates)[2][..., 0] @ self._lost
        above, below = np.split(np.array(others), 2)
        rest, most = float(np.abs(here).max()), float(np.abs(above - below).sum(axis=0).max()) / 2
        if not rest <= _ON_BRANCH * most:
            return f"its velocity is off each branch by {rest / most:.1g} of its size"
        return ""


def undetermined(dyn: Dynamics, t: float, q: Array, v: Array) -> str:
    """Return why the motion of one state at a singular pose does not go on in one way; empty where it does."""
    (q,), (v,) = np.atleast_2d(q), np.atleast_2d(v)
    return Passage(manifold_at(dyn, t).member(0), t, q, v).undetermined


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
            self.ahead, self._unseen = time_ahead(*self._unseen), None
        self.near = self.near and bool((np.abs(self.ahead) <= AHEAD * h).any())
        return self.near


def time_ahead(dyn: Dynamics, t: float, q: Array, v: Array) -> Array:
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
    """The singular poses that one trajectory passes, by how far from one it is at and between the ends of its steps.

    Through a singular pose this distance, 1/√`dependence`, is smooth once its sign is changed there.
    """

    def __init__(self, dyn: Dynamics) -> None:
        self._dyn = dyn
        self._seen: list[tuple[float, float, Array]] = []
        self._times: list[float] = []
        self._rows: list[int] = []

    def began(self, t: float, q: Array) -> None:
        """Take in the start."""
        self.saw(t, q)
        self._at_end()

    @property
    def times(self) -> list[float]:
        """The times of the poses, up to the last state that was taken in."""
        # No step follows the last one.
        self._decide(len(self._seen) - 1)
        self._at_end()
        return self._times

    def _at_end(self) -> None:
        """Keep a pose at which the last state is."""
        for t, _, q in self._seen[-1:]:
            if manifold_at(self._dyn, t).at_pose(q) and self._new_since(t):
                self._passed(t, t, q)

    def _new_since(self, t: float) -> bool:
        return not self._times or self._times[-1] < t

    def _passed(self, t: float, near: float, q: Array) -> None:
        """Keep the time of a pose, and the rows that depend on each other at the state nearest to it."""
        manifold = manifold_at(self._dyn, near)
        self._rows = Passage(manifold, near, q, np.zeros(manifold.dyn.model.nv)).rows
        self._times.append(t)

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
        """Take in the end of a step by the `dependence` of rows there; one that is not positive says nothing."""
        if dependence > 0 and all(t > before for before, *_ in self._seen[-1:]):
            self._seen = [*self._seen[1 - _WINDOW :], (t, dependence**-0.5, q)]
            # The step before is known to both sides.
            self._decide(len(self._seen) - 2)

    def _decide(self, k: int) -> None:
        """Look for a pose in the step that ends at the state k of those that are kept."""
        seen = self._seen
        if k < 1 or (k > 1 and seen[k - 1][1] > seen[k - 2][1]) or (k + 1 < len(seen) and seen[k][1] > seen[k + 1][1]):
            return
        if not self._new_since(seen[max(k - 2, 0)][0]):
            return
        t, s, q = (list(x) for x in zip(*seen, strict=True))
        passed = [*s[:k], *(-x for x in s[k:])]
        if 1 < k < len(s) - 1 and not _bend(t, passed) < _bend(t, s):
            # Ends on both sides tell that none is here, and cost no evaluation.
            return
        model, h = self._dyn.model, t[k] - t[k - 1]
        way = model.difference(q[k - 1], q[k])
        inner = [t[k - 1] + part * h for part in _WITHIN]
        places = [model.integrate(q[k - 1], part * way) for part in _WITHIN]
        depends = [float(manifold_at(self._dyn, x).dependence(y)) for x, y in zip(inner, places, strict=True)]
        times, sizes = [*t[:k], *inner, *t[k:]], np.array([*s[:k], *np.power(depends, -0.5), *s[k:]])
        turned = (
            _bend(times, np.where(np.arange(len(sizes)) < i, sizes, -sizes)) for i in range(k, k + len(inner) + 1)
        )
        if min(turned) < _bend(times, sizes):
            roots = np.roots(np.polyfit(np.array(t) - t[k - 1], passed, len(s) - 1))
            within = roots[np.isreal(roots) & (roots.real >= 0) & (roots.real <= h)].real
            nearest = k - 1 if s[k - 1] < s[k] else k
            self._passed(t[k - 1] + float(within[0]) if len(within) else t[nearest], t[nearest], q[nearest])

    def describe(self, tolerance: bool) -> str:
        """Return the poses in a sentence, for a method with or without a tolerance; empty where there are none."""
        if not (times := self.times):
            return ""
        when = ", ".join(f"{t:.4g}" for t in times[:3]) + (" and later" if len(times) > 3 else "")
        names = manifold_at(self._dyn, times[0]).names
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
