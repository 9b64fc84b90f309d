"""Wrenches on bodies, the loads in joints, and the balance of each body. A part of `Dynamics`.

The balance of a body, with everything that acts on it::

    Σ F = m a_G            Σ M_G = d/dt (I ω)

A wrench is six numbers, force then moment about the origin of a frame, N and Nm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, batch_of, rows
from mbkit.engines.elements.passive import pull
from mbkit.engines.evaluation import Evaluation
from mbkit.engines.frames_and_momenta import ALIGNED, CLASSICAL, LOCAL, Parts, axes_named, momentum_rates
from mbkit.errors import InputError, require_known
from mbkit.model import Frame, Joint, PointSpring
from mbkit.model.elements.kinds import that_do
from mbkit.model.elements.paths import Path

#: Wrenches by the names of the frames on which they act.
Wrenches = Mapping[str, ArrayLike]
_CARRIED: Final = ("q", "loss", "jump", "stop", "row", "bound", "t", "gravity", "point.spring")
#: Whose energies are of coordinates alone, and act along the directions of joints.
_OF_COORDINATES: Final = ("joints", "couplings")
_BY_FUNCTIONS: Final = "forces by functions are known by what they do to the motion, not to single bodies"
LOADS: Final = Path(
    "loads",
    "",
    frozenset([*_CARRIED, *that_do("T", *_OF_COORDINATES), *that_do("V", *_OF_COORDINATES)]),
    why={
        "speed": "its forces act on bodies beside those of loops; constraint_forces(q, v, tau) has them",
        **dict.fromkeys(("force", "force.compensation", "body.rotor"), _BY_FUNCTIONS),
    },
)


class Loads(Evaluation):
    """Wrenches on bodies and in joints; `Dynamics` inherits it."""

    #: Those of inverse and forward dynamics whose methods take wrenches, frames and axes behind their arguments.
    _takes_wrenches: ClassVar[tuple[str, ...]] = ()
    _frames: Callable[..., tuple[tuple[Frame, ...], bool]]
    _loads_under: Callable[..., Array]

    def _stacked_wrenches(self, wrenches: Wrenches) -> tuple[tuple[Frame, ...], Array]:
        """Return the frames, and the wrenches one behind the other, (6 k,) or (N, 6 k)."""
        if not isinstance(wrenches, Mapping):
            raise InputError(
                f"wrenches: expected a dict of frame names to arrays (6,) or (N, 6), got {type(wrenches).__name__}"
            )
        given = {
            name: rows(f"wrench on {name!r}", x, 6, "a wrench", "force and moment") for name, x in wrenches.items()
        }
        frames, _ = self._frames(list(given))
        if (size := batch_of(**given)) is not None:
            given = {name: np.broadcast_to(x, (size, 6)) for name, x in given.items()}
        return frames, np.concatenate(list(given.values()), axis=-1)

    def generalized_force(self, q: ArrayLike, wrenches: Wrenches, axes: str = ALIGNED) -> Array:
        """Return Σ Jᵀ w of wrenches on frames, shape (nv,) or (N, nv).

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        wrenches : dict of str to (6,) or (N, 6) array_like
            Frame or body -> force, N, then moment, Nm, about the frame's origin.
        axes : {"local", "local_world_aligned", "world"}
            Axes in which they are written, the same ones and the same default as in `jacobian`: the world's axes, or
            the frame's own (``"local"``). ``"world"`` has the moment about the world's origin.

        Examples
        --------
        >>> import numpy as np
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0), "lagrangian")
        >>> weight = np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0])
        >>> force = dyn.generalized_force([0.5], {"tip": weight})
        >>> bool(np.allclose(force, dyn.jacobian([0.5], "tip").T @ weight))
        True
        """
        if isinstance(wrenches, Mapping) and not wrenches:
            q = self.model.check_q(q)
            return np.zeros((*q.shape[:-1], self.model.nv))
        frames, stacked = self._stacked_wrenches(wrenches)
        return self._evaluate("generalized_force", frames, axes_named(axes), q=q, wrenches=stacked)

    def _inverse_dynamics_with_wrenches(self, q: Array, v: Array, a: Array, *acting: Any) -> Any:
        if "inverse_dynamics" in self._takes_wrenches:
            return self._inverse_dynamics(q, v, a, *acting)
        return self._inverse_dynamics(q, v, a) - self._generalized_force(q, *acting)

    def _forward_dynamics_with_wrenches(self, q: Array, v: Array, tau: Array, *acting: Any) -> Any:
        if "forward_dynamics" in self._takes_wrenches:
            return self._forward_dynamics(q, v, tau, *acting)
        return self._forward_dynamics(q, v, tau + self._generalized_force(q, *acting))

    def _solved_motion(self, q: Array, v: Array, tau: Array, *acting: Any) -> Array:
        """Return v̇ by a solution with M, where the engine's own forward dynamics does not know all that acts."""
        inverse = self._inverse_dynamics_with_wrenches if acting else self._inverse_dynamics
        rest = inverse(q, v, np.zeros(self.model.nv), *acting)
        return np.asarray(np.linalg.solve(self._mass_matrix(q), tau - rest))

    def _generalized_force(self, q: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> Any:
        """Return Σ Jᵀ w at one state, with the engine's own Jacobians."""
        return np.einsum("kij,ki->j", self._jacobian(q, frames, axes), wrenches.reshape(-1, 6))

    def mass_matrix_inverse(self, q: ArrayLike) -> Array:
        """Return M⁻¹(q), shape (nv, nv) or (N, nv, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum(), "lagrangian")
        >>> unit = dyn.mass_matrix_inverse([0.1, 0.2]) @ dyn.mass_matrix([0.1, 0.2])
        >>> bool(abs(unit - [[1.0, 0.0], [0.0, 1.0]]).max() < 1e-12)
        True
        """
        return self._evaluate("mass_matrix_inverse", q=q)

    def joint_wrenches(
        self,
        q: ArrayLike,
        v: ArrayLike,
        a: ArrayLike | None = None,
        wrenches: Wrenches | None = None,
        axes: str = ALIGNED,
        joints: Sequence[str] | None = None,
        tau: ArrayLike | None = None,
    ) -> Array:
        """Return the load of each joint: what the parent's side exerts on the child through the joint.

        Force, N, then moment, Nm, about the child's origin, in the child's axes. The load is that of the motion
        (q, v, a), or under a force τ where a is None. Its part in the joint's own directions is τ + τ_passive of the
        joint, with the force of its drive, less what its rotor takes.

        In a mechanism it depends on τ too, which decides the forces in the loops; `loop_wrenches` has those, and
        `undetermined_loads` tells which components the laws of rigid bodies do not determine.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v, a : (nv,) or (N, nv) array_like
            Without a, a is ``forward_dynamics(q, v, tau, wrenches, axes)``.
        wrenches : dict of str to (6,) or (N, 6) array_like, optional
            That act on frames, as in `generalized_force`.
        axes : {"local", "local_world_aligned", "world"}
            Axes of the applied wrenches, as in `generalized_force`.
        joints : sequence of str, optional
            By default all that move, in the order of ``model.joints``. Fixed joints may be named.
        tau : (nv,) or (N, nv) array_like, optional
            The generalized force under which the motion happens; needed in a mechanism, and where a is None.

        Returns
        -------
        (n, 6) or (N, n, 6) array

        Raises
        ------
        InputError
            A mechanism without τ, or a motion that is not the one under τ.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(mass=2.0, length=1.0), "lagrangian")
        >>> dyn.joint_wrenches([0.0], [0.0], [0.0]) + 0.0
        array([[ 0.  ,  0.  , 19.62,  0.  ,  0.  ,  0.  ]])
        """
        if self.model.constrained:
            return self._loads_under(joints, q, v, a, tau, wrenches, axes)
        if a is None:
            if tau is None:
                raise InputError("tau: expected the force under which the model moves where a is None; give a or tau")
            a = self.forward_dynamics(q, v, tau, wrenches, axes)
        elif tau is not None:
            raise InputError(
                f"tau: the loads of {self.model.name}, a tree, follow from its motion; give a or tau alone"
            )
        loaded = self._joints(joints)
        states: dict[str, Any] = {"q": q, "v": v, "a": a}
        frames: tuple[Frame, ...] = ()
        if wrenches:
            frames, states["wrenches"] = self._stacked_wrenches(wrenches)
        return self._evaluate("joint_wrenches", loaded, frames, axes_named(axes), **states)

    @cached_property
    def _moving_joints(self) -> tuple[Joint, ...]:
        return Parts(joint for joint in self.model.joints if joint.type.nv)

    def _joints(self, names: Sequence[str] | None) -> tuple[Joint, ...]:
        if names is None:
            return self._moving_joints
        if isinstance(names, str) or not isinstance(names, Sequence):
            raise InputError(f"joints: expected a list of names, got {names!r}")
        held: dict[Any, tuple[Joint, ...]] = self.__dict__.setdefault("_joints_held", {})
        key = tuple(names)
        if key not in held:
            known = {joint.name: joint for joint in self.model.joints}
            require_known("joint", known, *key)
            held[key] = Parts(known[name] for name in key)
        return held[key]

    def newton_euler_residual(
        self,
        q: ArrayLike,
        v: ArrayLike,
        a: ArrayLike,
        tau: ArrayLike,
        wrenches: Wrenches | None = None,
        axes: str = ALIGNED,
    ) -> Array:
        """Return Σ F - m a_G and Σ M_G - d/dt (I ω) of every body: how far a motion is from the laws of mechanics.

        Forces and loads are those that act at (q, v) under τ; a is the acceleration in question. The residual vanishes,
        up to rounding, where a is ``forward_dynamics(q, v, tau)``.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v, a, tau : (nv,) or (N, nv) array_like
        wrenches, axes
            As in `generalized_force`.

        Returns
        -------
        (n, 6) or (N, n, 6) array
            In the order of ``model.bodies``, force, N, then moment about the body's centre of mass, Nm, in its axes.

        Raises
        ------
        UnsupportedError
            The engine cannot tell the load of a joint; mostly of a fixed one, where it merges bodies.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum(), "lagrangian")
        >>> q, v = [0.1, 0.2], [1.0, -2.0]
        >>> tau = [0.5, 0.0]
        >>> a = dyn.forward_dynamics(q, v, tau)
        >>> bool(abs(dyn.newton_euler_residual(q, v, a, tau)).max() < 1e-12)
        True
        >>> bool(abs(dyn.newton_euler_residual(q, v, a + 0.1, tau)).max() > 0.01)
        True
        """
        model = self.model
        states = {"q": model.check_q(q), "v": model.check_v(v), "a": model.check_v(a, "a")}
        states["tau"] = model.check_v(tau, "tau")
        pushes = {name: np.asarray(w, dtype=float) for name, w in (wrenches or {}).items()}
        size = self._samples or batch_of(**states, **{f"wrench on {name!r}": w for name, w in pushes.items()})
        q, v, a, tau = (np.broadcast_to(x, (1 if size is None else size, x.shape[-1])) for x in states.values())
        names = [joint.name for joint in model.tree]
        loads = self.joint_wrenches(q, v, None, wrenches, axes, names, tau)
        balance = _Balance(self, q, v, a)
        if model.loops:
            wrenches_of_loops = np.moveaxis(self.loop_wrenches(q, v, tau, wrenches, axes), 1, 0)
            for loop, wrench in zip(model.loops, wrenches_of_loops, strict=True):
                balance.load(loop.body_a, loop.body_b, wrench, loop.rotation_a, loop.translation_a)
        for k, joint in enumerate(model.tree):
            balance.load(joint.child, joint.parent, loads[:, k], np.eye(3), np.zeros(3))
        for name, wrench in pushes.items():
            balance.apply(name, wrench, axes_named(axes))
        for spring in model.springs:
            balance.stretch(spring)
        out = balance.residual()
        return out[0] if size is None else out


def _times(R: Array, x: Array) -> Array:
    return np.asarray(np.einsum("...ij,...j->...i", R, x))


class _Balance:
    """Forces and moments about the origin of each body, gathered in the world's axes, at a batch of states."""

    def __init__(self, dyn: Loads, q: Array, v: Array, a: Array) -> None:
        self._dyn, self._model, self._q, self._v, self._a = dyn, dyn.model, q, v, a
        self._index = {body.name: k for k, body in enumerate(self._model.bodies)}
        self._X = dyn.body_poses(q)
        self._names = list(self._index)
        shape = (len(q), len(self._names), 3)
        self._force, self._moment = np.zeros(shape), np.zeros(shape)

    def _push(self, body: str, force: Array, moment: Array | float, point: Array) -> None:
        if (k := self._index.get(body)) is not None:
            self._force[:, k] += force
            self._moment[:, k] += moment + np.cross(point - self._X[:, k, :3, 3], force)

    def _placed(self, body: str, point: Array) -> tuple[Array, Array]:
        """Return the rotation of a body or the world, and a point of it."""
        k = self._index.get(body)
        X = np.broadcast_to(np.eye(4), (len(self._q), 4, 4)) if k is None else self._X[:, k]
        return X[:, :3, :3], X[:, :3, 3] + _times(X[:, :3, :3], point)

    def load(self, to: str, by: str, wrench: Array, rotation: Array, point: Array) -> None:
        """Add a wrench about a point of a body, in its axes turned by `rotation`, and the opposite to another body."""
        R, place = self._placed(to, point)
        force, moment = (_times(R @ rotation, x) for x in (wrench[:, :3], wrench[:, 3:]))
        self._push(to, force, moment, place)
        self._push(by, -force, -moment, place)

    def apply(self, name: str, wrench: Array, axes: str) -> None:
        """Add a wrench on a frame."""
        X = self._dyn.pose(self._q, name)
        R = X[:, :3, :3] if axes == LOCAL else np.eye(3)
        point = X[:, :3, 3] if axes in (LOCAL, ALIGNED) else np.zeros(3)
        self._push(self._model.frame(name).body, _times(R, wrench[..., :3]), _times(R, wrench[..., 3:]), point)

    def stretch(self, spring: PointSpring) -> None:
        """Add the pull of a spring to the bodies at its ends."""
        bodies = spring.body_a, spring.body_b
        ends = [self._placed(*end)[1] for end in zip(bodies, (spring.point_a, spring.point_b), strict=True)]
        speeds = [np.zeros((len(self._q), 3)) for _ in ends]
        for k, body in enumerate(bodies):
            if body in self._index:
                # It is that of the frame of the body's name, which may be another one than its own.
                V = self._dyn.velocity(self._q, self._v, body)
                speeds[k] = V[:, :3] + np.cross(V[:, 3:], ends[k] - self._dyn.pose(self._q, body)[:, :3, 3])
        on_first = pull(spring, ends[1] - ends[0], speeds[1] - speeds[0])
        for sign, body, end in zip((1, -1), bodies, ends, strict=True):
            self._push(body, sign * on_first, 0.0, end)

    def residual(self) -> Array:
        """Return forces and moments less the rates of momentum: the residual of the balance."""
        dyn, bodies = self._dyn, self._model.bodies
        com = np.array([b.com for b in bodies])
        R = self._X[:, :, :3, :3].swapaxes(2, 3)
        # Frames of the bodies' names may be other ones than their own; their motion is turned into the bodies' axes.
        frames = [self._model.frame(name) for name in self._names]
        turn = np.array([f.rotation for f in frames])
        arm = -np.array([f.translation for f in frames])
        local = dyn.acceleration(self._q, self._v, self._a, self._names, LOCAL, CLASSICAL)
        linear, angular = _times(turn, local[..., :3]), _times(turn, local[..., 3:])
        w = _times(turn, dyn.velocity(self._q, self._v, self._names, LOCAL)[..., 3:])
        own = linear + np.cross(angular, arm) + np.cross(w, np.cross(w, arm))
        force, moment = _times(R, self._force), _times(R, self._moment)
        weight = np.array([b.mass for b in bodies])[:, None] * _times(R, self._model.gravity)
        # Gravity acts at the centre of mass.
        acting = np.concatenate([force + weight, moment - np.cross(com, force)], axis=-1)
        return np.asarray(acting - momentum_rates(bodies, w, np.concatenate([own, angular], axis=-1)))
