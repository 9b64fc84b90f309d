"""Loads in joints and loops of mechanisms, and which of them the laws of rigid bodies determine.

The forces in the loops are those that a motion under τ asks for, Jᵀ λ = M a + h - τ_passive - τ. A loop's rows do
virtual work with λ as its ends move, which is its wrench on body a; body b takes the opposite at the same point. With
these wrenches on its bodies the tree has the loads of the mechanism's joints.

J has a null space of forces, Jᵀ λ = 0, where loops hold what other joints hold already: a planar mechanism in space
may be strained across its plane, and a redundant one in its motion. Rigid bodies do not tell these strains. λ is the
one with the least norm over all rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import CONSISTENT, Array
from mbkit.engines.closed_loops.actuation import Actuation, spread
from mbkit.engines.frames_and_momenta import ALIGNED, LOCAL, WORLD, axes_named
from mbkit.engines.loads import LOADS, Loads
from mbkit.errors import InputError
from mbkit.model import Frame, Joint, Model
from mbkit.model.description import frame_of
from mbkit.model.elements.paths import Path
from mbkit.model.loops import LOOP_KINDS, LOOP_ROWS
from mbkit.model.parts import Loop

LOOP_LOADS: Final = Path(
    "loads of loops", "", LOADS.carries, LOADS.why, asks=(frozenset(f"loop.{x}" for x in LOOP_KINDS), "it has no loops")
)


class UndeterminedLoads(NamedTuple):
    """Which loads the laws of rigid bodies leave open at a pose.

    Attributes
    ----------
    strains : int
        Dimension of the null space of Jᵀ, over all rows of the loops.
    joints : (n, 6) array of bool
        Components of `joint_wrenches` that a strain changes, of all joints that move.
    loops : (k, 6) array of bool
        Components of `loop_wrenches`.
    """

    strains: int
    joints: np.ndarray
    loops: np.ndarray


class LoopLoads(Actuation, Loads):
    """The part of `Dynamics` for loads of mechanisms."""

    def loop_wrenches(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike, wrenches: Any = None, axes: str = ALIGNED
    ) -> Array:
        """Return the load of each loop under τ: what it exerts on its body a.

        Force, N, then moment, Nm, about the origin of the loop's frame a, in the axes of that frame. Body b takes the
        opposite at the same point.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
            Where the loops are closed, which is not looked at.
        v, tau : (nv,) or (N, nv) array_like
        wrenches, axes
            That act on frames, as in `generalized_force`.

        Returns
        -------
        (k, 6) or (N, k, 6) array
            In the order of ``model.loops``. Where loads are not unique, those with the least norm of λ over all rows;
            `undetermined_loads` tells which.

        Raises
        ------
        UnsupportedError
            A model without loops.

        Examples
        --------
        The load in the pin of a four-bar that hangs at rest, held at the crank:

        >>> import numpy as np
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.project([0.5, 0.0, 0.0], np.zeros(3))
        >>> tau, _ = dyn.actuator_forces(q, v, np.zeros(3), actuators=[dyn.model.joint_names[0]])
        >>> load = dyn.loop_wrenches(q, v, tau)
        >>> load.shape
        (1, 6)
        """
        LOOP_LOADS.admit(self.model, "loop_wrenches: not known of")
        (first, last), out = (0, len(self.model.loops)), self._loaded((), q, v, None, tau, wrenches, axes)
        return self._only(out, first, last)

    def _loads_under(
        self, joints: Sequence[str] | None, q: ArrayLike, v: ArrayLike, a: Any, tau: Any, wrenches: Any, axes: str
    ) -> Array:
        """Return the loads of joints of a mechanism whose motion is that of a force."""
        self.model.require_bodies("joint_wrenches")
        LOADS.admit(self.model, "joint_wrenches: not known of")
        if tau is None:
            raise InputError(
                f"tau: expected the force under which {self.model.name} moves, got none: a motion (q, v, a) does not "
                "tell the forces in its loops; give joint_wrenches(..., tau=tau)"
            )
        which = self._joints(joints)
        return self._only(self._loaded(which, q, v, a, tau, wrenches, axes), 0, len(which))

    def _loaded(
        self, joints: tuple[Joint, ...], q: ArrayLike, v: ArrayLike, a: Any, tau: Any, wrenches: Any, axes: str
    ) -> Array:
        self._require_motion(q, v, tau)
        states: dict[str, Any] = {"q": q, "v": v, "a": a, "tau": tau}
        frames: tuple[Frame, ...] = ()
        if wrenches:
            frames, states["wrenches"] = self._stacked_wrenches(wrenches)
        if a is None:
            del states["a"]
            return self._evaluate("loads_under_force", joints, frames, axes_named(axes), **states)
        out = self._evaluate("loads_of_motion", joints, frames, axes_named(axes), **states)
        left, size = (np.ravel(out[..., -1, k]) for k in range(2))
        if len(bad := np.flatnonzero(~(left <= CONSISTENT * size))):
            k = int(bad[0])
            where = f" in sample {k}" if out.ndim > 2 else ""
            raise InputError(
                f"tau: {self.model.name} does not move with these accelerations under this force{where}: {left[k]:.3g} "
                "of M a + h - τ is no force of its constraints; forward_dynamics(q, v, tau) is its motion"
            )
        return out

    def _only(self, out: Array, first: int, last: int) -> Array:
        """Return rows of an answer; an engine that keeps more digits keeps those of the rows."""
        return out[..., first:last, :]

    # They come from an engine's own terms, at one state.

    def _loads_under_force(self, q: Array, v: Array, tau: Array, *given: Any) -> Array:
        pushed = self._generalized_force(q, given[0], *given[2:]) if len(given) > 3 else 0.0
        return self._loads_of_motion(q, v, self._forward_dynamics(q, v, tau + pushed), tau, *given)

    def _loads_of_motion(self, q: Array, v: Array, a: Array, tau: Array, *given: Any) -> Array:
        *applied, joints, frames, axes = given
        pushed = tau + self._generalized_force(q, applied[0], frames, axes) if applied else tau
        inertial = np.array(self._inverse_dynamics(q, v, a))
        acting = inertial - pushed
        J = np.array(self._constraint_jacobian(q))[list(self._row_choice.independent)]
        multipliers = np.asarray(np.linalg.lstsq(J.T, acting, rcond=None)[0])
        shares = spread(J, np.array(self._every_jacobian(q)), multipliers)
        table = self._with_loop_forces(q, v, a, shares, applied[0] if applied else None, joints, frames, axes)
        left, size = np.linalg.norm(acting - J.T @ multipliers), np.linalg.norm(inertial) + np.linalg.norm(pushed)
        return np.vstack([table, [left, size, 0.0, 0.0, 0.0, 0.0]])

    def _with_loop_forces(
        self,
        q: Array,
        v: Array,
        a: Array,
        shares: Array,
        wrenches: Array | None,
        joints: tuple[Joint, ...],
        frames: tuple[Frame, ...],
        axes: str,
    ) -> Array:
        """Return the loads of joints and loops of a motion with multipliers of all rows."""
        on = [*frames]
        acting = [] if wrenches is None else self._about_world(q, wrenches.reshape(-1, 6), frames, axes)
        own = []
        for ends, load, pulling in self._of_loops(lambda x: self._pose(q, x), shares):
            own.append(load)
            for frame, wrench in ((ends[0], pulling), (ends[1], -pulling)):
                if frame.body != "world":
                    on.append(frame)
                    acting.append(wrench)
        given = [np.concatenate(acting)] if acting else []
        loads = self._joint_wrenches(q, v, a, *given, joints, tuple(on), WORLD)
        return np.vstack([np.reshape(loads, (-1, 6)), np.reshape(own, (-1, 6))])

    def _of_loops(
        self, pose: Callable[[tuple[Frame, ...]], Iterable[Array]], shares: Array
    ) -> Iterator[tuple[tuple[Frame, ...], Array, Array]]:
        """Yield the frames of each loop, and its wrench on body a in the axes of frame a and about the world's origin.

        It is that of the virtual work of its rows as end a moves.
        """
        # The import loads CasADi, which trees never need here.
        from mbkit.engines.closed_loops.frame_rows import MovingFrame, loop_rows

        first, still = 0, np.zeros(6)
        for k, loop in enumerate(self.model.loops):
            frames = _frames_of(loop, k, self.model)
            moves = (np.eye(6), np.zeros((6, 6)), np.zeros((6, 6)))
            a, *others = (
                MovingFrame(X[:3, :3], X[:3, 3], J, still, still) for X, J in zip(pose(frames), moves, strict=True)
            )
            J = loop_rows(loop, a, *others).J
            first, (force, moment) = first + len(J), np.split(J.T @ shares[first : first + len(J)], 2)
            own = np.concatenate([a.R.T @ force, a.R.T @ moment])
            yield frames, own, np.concatenate([force, moment + np.cross(a.p, force)])

    def _about_world(self, q: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> list[Array]:
        """Return wrenches on frames about the world's origin, in its axes."""
        out = []
        for X, wrench in zip(self._pose(q, frames), wrenches, strict=True):
            force, moment = (X[:3, :3] @ x if axes == LOCAL else x for x in (wrench[:3], wrench[3:]))
            if axes in (LOCAL, ALIGNED):
                moment = moment + np.cross(X[:3, 3], force)
            out.append(np.concatenate([force, moment]))
        return out

    # Loads that are not determined

    def undetermined_loads(self, q: ArrayLike) -> UndeterminedLoads:
        """Return which components of loads the laws of rigid bodies do not determine at a pose.

        Of these `joint_wrenches` and `loop_wrenches` give the ones with the least norm of λ over all rows, in N and
        N m; the others are unique.

        Parameters
        ----------
        q : (nq,) array_like
            Where the loops are closed.

        Returns
        -------
        UndeterminedLoads
            With `strains`, their number, and the components of `joints` and `loops` that they change.

        Raises
        ------
        UnsupportedError
            A model without loops.

        Examples
        --------
        A planar four-bar with a pin that holds a point in space may be strained across its plane:

        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> dyn.undetermined_loads(dyn.model.random_state(0)[0]).strains
        1
        """
        model = self.model
        LOOP_LOADS.admit(model, "undetermined_loads: not known of")
        q = model.check_q(q)
        if q.ndim > 1 or self._samples is not None:
            got = f"shape {q.shape}" if q.ndim > 1 else f"parameters of {self._samples} samples"
            raise InputError(f"undetermined_loads: expected one configuration, got {got}")
        held = sum(len(LOOP_ROWS[loop.kind][0]) for loop in model.loops)
        # Drives are single, and take no strain from each other.
        J = np.asarray(self._evaluate("every_jacobian", q=q))[:held]
        sizes = np.linalg.norm(J, axis=1)
        scale = np.where(sizes > CONSISTENT * sizes.max(initial=0.0), sizes, 1.0)
        U, singular, _ = np.linalg.svd(J / scale[:, None])
        strains = U[:, int(np.count_nonzero(singular > CONSISTENT)) :].T / scale
        changed = np.zeros((len(self._joints(None)) + len(model.loops), 6), dtype=bool)
        X = {"world": np.eye(4)} | dict(zip((b.name for b in model.bodies), self.body_poses(q), strict=True))
        for strain in strains:
            loads = np.array([*self._strained(X, strain)])
            changed |= np.abs(loads) > CONSISTENT * np.abs(loads).max()
        return UndeterminedLoads(len(strains), changed[: -len(model.loops)], changed[-len(model.loops) :])

    def _strained(self, X: dict[str, Array], shares: Array) -> Iterator[Array]:
        """Yield what forces in the loops, in balance with each other, add to the load of each joint and loop."""
        model, own = self.model, []
        #: Wrench of all that a body carries, about the world's origin.
        total = {name: np.zeros(6) for name in X}
        for (a, b, _), load, pulling in self._of_loops(lambda x: [X[f.body] @ frame_of(f) for f in x], shares):
            own.append(load)
            total[a.body] += pulling
            total[b.body] -= pulling
        for joint in reversed(model.tree):
            total[joint.parent] += total[joint.child]
        for joint in self._joints(None):
            R, p, w = X[joint.child][:3, :3], X[joint.child][:3, 3], -total[joint.child]
            yield np.concatenate([R.T @ w[:3], R.T @ (w[3:] - np.cross(p, w[:3]))])
        yield from own


def _frames_of(loop: Loop, k: int, model: Model) -> tuple[Frame, Frame, Frame]:
    """Return the frames of both ends of a loop and of the body that carries both, by names that no other frame has."""
    return (
        Frame(f"\0loop{k}.a", loop.body_a, loop.rotation_a, loop.translation_a),
        Frame(f"\0loop{k}.b", loop.body_b, loop.rotation_b, loop.translation_b),
        Frame(f"\0loop{k}.c", model.carrier(loop), np.eye(3), np.zeros(3)),
    )
