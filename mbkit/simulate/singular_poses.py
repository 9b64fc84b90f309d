"""Singular poses of constraints: whether a motion is determined there, how it goes through, and when it did.

At a singular pose rows of J depend on each other: Uᵀ J = 0 for some combinations U of rows, and other branches of
motion may begin there. A motion that arrives with a velocity goes on along its own branch: the derivative of
Uᵀ (J v̇ + γ) = 0 is Uᵀ J̇ v̇ + Uᵀ (∂γ/∂v v̇ + ∂γ/∂q q̇ + ∂γ/∂t) = 0, which takes the place of the rows that are lost. The
motion is determined where the rows of J and of Uᵀ J̇ together are independent: where the singular values of J that
vanish do so at a rate. At rest they do not, and no equation says which branch comes next.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import CENTRAL_STEP, CONSISTENT, Array
from mbkit.engines import Dynamics
from mbkit.engines.base import MAX_NAMES, at_times
from mbkit.engines.constrained import AT_POSE, AT_SINGULAR_POSE, TAKES_PART
from mbkit.methods.one_step import STEPS_TO_POSE
from mbkit.model.validation import listing

if TYPE_CHECKING:
    from mbkit.engines.constraint_manifold import Manifold

#: Tightest tolerance of states within a step near a singular pose: f, whose rounding is never zero, is divided by the
#: distance from the pose. The end of the step is closer.
LOOSEST: Final = 1e-10
#: Ends of steps that are looked at together.
_ENDS: Final = 256
#: Rest of γ at a velocity that stays on a branch to a loose run's digits, relative to its size at any velocity.
_ON_BRANCH: Final = 1e-5


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
    """A singular pose: which rows depend on each other there, and why a motion through it is not determined."""

    def __init__(self, manifold: Manifold, t: float, q: Array) -> None:
        self._manifold, self._t, self._q = manifold, t, q
        U, sizes, Vt = np.linalg.svd(manifold.jacobian(q))
        rank = min(int(np.count_nonzero(sizes > AT_POSE * sizes[0])), len(U) - 1)
        # Rows that are all zero have no size of their own.
        self._lost, self._free = U[:, rank:] / (float(sizes[0]) or 1.0), Vt[rank:].T

    @property
    def rows(self) -> list[str]:
        """Names of the rows that depend on each other."""
        part = np.abs(self._lost).max(axis=1)
        which = np.flatnonzero(part > TAKES_PART * np.linalg.norm(self._lost[:, 0]))
        return [self._manifold.names[k] for k in which]

    def undetermined(self, v: Array) -> str:
        """Return where a motion with this velocity is, and why it does not go on in one way; empty where it does."""
        why = self._why(v)
        rows = listing(self.rows, MAX_NAMES)
        return f"{AT_SINGULAR_POSE}, where {rows} depend on each other, and {why}" if why else ""

    def _why(self, v: Array) -> str:
        manifold, q = self._manifold, self._q
        speed, dyn = float(np.abs(v).max()), manifold.dyn
        if not speed:
            return "at rest there each branch of its motion is as good as another"
        J1, J0 = (
            manifold.at(_known(dyn, self._t + side)).jacobian(dyn.model.integrate(q, side * v))
            for side in (CENTRAL_STEP / speed, -CENTRAL_STEP / speed)
        )
        turning = self._lost.T @ (J1 - J0) @ self._free / (2 * CENTRAL_STEP)
        if not np.linalg.svd(turning, compute_uv=False)[-1] > CONSISTENT:
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
    return Passage(manifold_at(dyn, t).member(0), t, q).undetermined(v)


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
        self.near = not (self._distance > STEPS_TO_POSE * h * self._pace).all()
        if self.near and self._unseen is not None:
            self.ahead, self._unseen = time_ahead(*self._unseen), None
        self.near = self.near and bool((np.abs(self.ahead) <= STEPS_TO_POSE * h).any())
        return self.near


def time_ahead(dyn: Dynamics, t: float, q: Array, v: Array) -> Array:
    """Return when J's smallest singular value will be zero at its present rate, s from now; 0 at a singular pose."""
    manifold = manifold_at(dyn, t)
    apart = CENTRAL_STEP / np.maximum(np.abs(v).max(axis=-1, keepdims=True), np.finfo(float).tiny)
    J, beside = (manifold.jacobian(x) for x in (q, dyn.model.integrate(q, apart * v)))
    U, sizes, V = np.linalg.svd(np.where(np.isfinite(J), J, 0.0), full_matrices=False)
    # By the vectors, as the value itself turns round where it is zero.
    change = (U[..., None, :, -1] @ (beside - J) @ V[..., -1, :, None])[..., 0, 0]
    ahead = np.divide(-sizes[..., -1] * apart[..., 0], change, out=np.full(change.shape, np.inf), where=change != 0)
    return np.where(sizes[..., -1] <= AT_POSE * sizes[..., 0], 0.0, ahead)[()]


class SingularPoses:
    """The singular poses that one trajectory passes, by the ends of its steps.

    From one end to the next the rows of J turn little, but through a singular pose each combination of them that
    vanishes there comes back the other way round: of the orthonormal rows B = (J Jᵀ)^-½ J at both ends, B1 B0ᵀ is near
    1, but for -1 on these combinations.
    """

    def __init__(self, dyn: Dynamics) -> None:
        self._dyn, self._times, self.rows = dyn, list[float](), list[str]()
        # Ends of steps; those before `_new` are looked at already.
        self._t, self._q, self._new = np.empty(0), np.empty((0, dyn.model.nq)), 1

    def saw(self, t: float | Array, q: Array) -> None:
        """Take in the start, then the ends of one step or more, (n,) and (n, nq)."""
        self._t, self._q = np.append(self._t, t), np.concatenate([self._q, np.atleast_2d(q)])
        if len(self._t) >= _ENDS:
            self._look(last=False)

    @property
    def times(self) -> list[float]:
        """The times of the poses, up to the last state that was taken in."""
        self._look(last=True)
        return self._times

    def join(self, part: SingularPoses, later: float = 0.0, until: float = math.inf) -> None:
        """Take over those that a part of the run passed up to a time, s; its own times count from `later`."""
        last = self._times[-1] if self._times else -math.inf
        times = [t + later for t in part.times if last < t + later <= until]
        if times:
            self._times, self.rows = [*self._times, *times], part.rows

    def _look(self, *, last: bool) -> None:
        """Look for poses in the steps that are kept, in the last one too where no other follows."""
        from mbkit.engines.constraint_manifold import manifold_of

        dyn = manifold_of(self._dyn).dyn
        # Through a pose this distance from it is smooth once its sign is changed there. In it rounding has any sign.
        far = np.abs(manifold_of(at_times(dyn, self._t, 1)).dependence(self._q)) ** -0.5
        # A state that is not finite says nothing, nor one a second time.
        good = np.isfinite(far) & (np.diff(self._t, prepend=-np.inf) > 0)
        t, q, far = self._t[good], self._q[good], far[good]
        pace = np.pad(np.abs(np.diff(far)) / np.diff(t), 1, constant_values=np.inf)
        reach = STEPS_TO_POSE * np.diff(t) * np.max([pace[:-2], pace[1:-1], pace[2:]], axis=0)
        end = len(t) - (not last)
        near = np.flatnonzero(far[:-1] + far[1:] <= 2 * reach) + 1
        near = near[(near >= self._new) & (near < end)]
        if len(near):
            ends = np.union1d(near - 1, near)
            J = manifold_of(at_times(dyn, t[ends], 1)).jacobian(q[ends])
            U, sizes, Vt = np.linalg.svd(np.nan_to_num(J), full_matrices=False)
            rows, at_pose = U @ Vt, np.full(len(t), False)
            at_pose[ends] = sizes[:, -1] <= AT_POSE * sizes[:, 0]
            turn = rows[ends.searchsorted(near)] @ rows[ends.searchsorted(near - 1)].swapaxes(-1, -2)
            passed = np.linalg.eigvalsh(turn + turn.swapaxes(-1, -2))[:, 0] < 0
            for k in near[passed | at_pose[near] | at_pose[near - 1]].tolist():
                self._passed_in(t, q, far, k, at_pose)
        kept = max(end - 2, 0)
        self._t, self._q, self._new = t[kept:], q[kept:], max(end - kept, 1)

    def _passed_in(self, t: Array, q: Array, far: Array, k: int, at_pose: NDArray[np.bool_]) -> None:
        """Keep the time of a pose in the step that ends at the k-th state, and the rows that depend on each other."""
        nearest = k - 1 if far[k - 1] < far[k] else k
        if at_pose[k - 1] or at_pose[k]:
            when = t[k - 1 if at_pose[k - 1] else k]
        else:
            near = slice(max(k - 2, 0), k + 2)
            ends = t[near] - t[k - 1]
            roots = np.roots(np.polyfit(ends, np.where(ends > 0, -far[near], far[near]), len(ends) - 1))
            within = roots[np.isreal(roots) & (roots.real >= 0) & (roots.real <= t[k] - t[k - 1])].real
            when = t[k - 1] + float(within[0]) if len(within) else t[nearest]
        if not self._times or self._times[-1] < when:
            self.rows = Passage(manifold_at(self._dyn, t[nearest]), t[nearest], q[nearest]).rows
            self._times.append(float(when))


class SingularPosesOfBatch:
    """The singular poses that trajectories pass which step together, by their numbers; none where nothing is held."""

    def __init__(self, dyn: Dynamics, t: float, q: Array, members: Iterable[int] | None = None) -> None:
        which = range(len(q)) if members is None else members
        self.members = {int(i): SingularPoses(dyn._of_samples([i])) for i in which if dyn._projects}
        self.saw(t, q[list(self.members)], self.members)

    def saw(self, t: float, q: Array, members: Iterable[int]) -> None:
        """Take in the ends of the steps of these members, (nq,) or (n, nq)."""
        for i, at in zip(members, np.atleast_2d(q), strict=True) if self.members else ():
            self.members[int(i)].saw(t, at)


def describe_poses(poses: Mapping[int, SingularPoses], batch: int | None, tolerance: bool) -> str:
    """Return the poses that one trajectory, or some of a batch, passed in a sentence; empty where there are none.

    Its method has a tolerance, or a step.
    """
    passed = {i: times for i, x in poses.items() if (times := x.times)}
    if not passed:
        return ""
    first, times = min(passed.items())
    of = "" if batch is None else f"{len(passed)} of {batch} trajectories passed singular poses; trajectory {first} "
    when = ", ".join(f"{t:.4g}" for t in times[:MAX_NAMES]) + (" and later" if len(times) > MAX_NAMES else "")
    error = f"; a step there may be off by {LOOSEST:g} whatever the tolerance" if tolerance else ""
    return (
        f"{of}passed a singular pose at t = {when} (s), where {' and '.join(poses[first].rows)} lose their "
        f"independence; other motions may begin there, and the run followed the smooth one{error}"
    )
