"""Motion of frames, centre of mass and momentum. A part of `Dynamics`.

**Axes** name the point and the axes of a six-vector, linear then angular. ``"local"``: the frame's origin, in the
frame's axes. ``"local_world_aligned"``: the frame's origin, in the world's axes. ``"world"``: the point of the frame's
body that is at the world's origin, in the world's axes, as in spatial algebra (Featherstone 2008, ch. 2). These are
Pinocchio's names and meanings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import ALIGNED as ALIGNED
from mbkit._check import AXES as AXES
from mbkit._check import CLASSICAL as CLASSICAL
from mbkit._check import LOCAL as LOCAL
from mbkit._check import SPATIAL as SPATIAL
from mbkit._check import WORLD as WORLD
from mbkit._check import Array, shown
from mbkit._check import axes_named as axes_named
from mbkit.engines.evaluation import Evaluation
from mbkit.errors import InputError
from mbkit.model import Body, Frame, Model
from mbkit.model.description import frame_of
from mbkit.model.quantities import QUANTITIES, of_groups
from mbkit.spatial import skew

_EYE, _LAST_ROW = np.eye(3), np.eye(4)[3]
#: Quantities of all matter together.
OF_THE_WHOLE: Final = frozenset(of_groups("whole"))


def seen_from(R: Array, p: Array, linear: Array, angular: Array, axes: str) -> Array:
    """Return a six-vector, or the rows of a Jacobian, in these axes.

    `linear` and `angular`, (3,), (3, nv) or (N, 3, nv), are those of a frame's origin in world axes; R_WF and p_WF are
    its pose.
    """
    if axes == LOCAL:
        linear, angular = R.mT @ linear, R.mT @ angular
    elif axes == WORLD:
        linear = linear + skew(p) @ angular
    return np.concatenate([linear, angular], axis=-2 if linear.ndim > 1 else 0)


def accelerated(R: Array, p: Array, velocity: Array, classical: Array, axes: str, kind: str) -> Array:
    """Return an acceleration, (6,), in these axes.

    `velocity` and `classical`, (6,), are velocity and acceleration of a frame's origin in world axes, and angular ones.
    """
    v, w = velocity[:3], velocity[3:]
    spatial = seen_from(R, p, classical[:3] - skew(w) @ v, classical[3:], axes)
    if kind == CLASSICAL:
        seen = seen_from(R, p, v, w, axes)
        spatial[:3] += skew(seen[3:]) @ seen[:3]
    return spatial


class Parts(tuple[Any, ...]):
    """Frames or joints, the same object in every call: quicker to look up than their values."""

    __slots__ = ()
    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other


class FramesAndMomenta(Evaluation):
    """Motion of frames, centre of mass and momentum; `Dynamics` inherits it.

    Frames are named: those of the description, and bodies. A list of names gives one value for each, on an axis before
    the value's own: (k, 6) or (N, k, 6). The rates are exact derivatives along the motion, and zero motion of the
    world's frame is a value like any other.
    """

    _frames_held: dict[Any, tuple[Frame, ...]]

    def _frames(self, frame: str | Sequence[str]) -> tuple[tuple[Frame, ...], bool]:
        """Return the frames, and whether it is one alone."""
        single = isinstance(frame, str)
        if not single and not isinstance(frame, Sequence):
            raise InputError(f"frame: expected a name or a list of names, got {type(frame).__name__}")
        key: tuple[str, ...] = (frame,) if isinstance(frame, str) else tuple(frame)
        held = self.__dict__.setdefault("_frames_held", {})
        if key not in held:
            if not key:
                raise InputError("frame: expected a name or a list of names, got an empty list")
            held[key] = Parts(map(self.model.frame, key))
        return held[key], single

    def _of_frames(self, quantity: str, frame: str | Sequence[str], *more: str, **states: ArrayLike) -> Array:
        frames, single = self._frames(frame)
        out = self._evaluate(quantity, frames, *more, **states)
        if not single:
            return out
        # The frames come first in the value of one state.
        return out[0] if out.ndim == len(QUANTITIES[quantity].shape) else out[:, 0]

    def pose(self, q: ArrayLike, frame: str | Sequence[str]) -> Array:
        """Return X_WF of a frame or body, shape (4, 4) or (N, 4, 4).

        X_WF has the rotation R_WF and the origin p_WF, m: it takes a point from the frame's axes to the world's.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.pose([0.0], "tip")[:3, 3]
        array([ 0.,  0., -2.])
        """
        return self._of_frames("pose", frame, q=q)

    def body_poses(self, q: ArrayLike) -> Array:
        """Return X_WB of all bodies in the order of ``model.bodies``, shape (n, 4, 4) or (N, n, 4, 4).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.body_poses([0.0]).shape
        (1, 4, 4)
        """
        out = self._of_frames("pose", [b.name for b in self.model.bodies], q=q)
        for k, body in enumerate(self.model.bodies):
            # A frame of a body's name, as an MJCF has them, hides the body: X_WB = X_WF X_FB.
            frame = self.model.frame(body.name)
            if frame.translation.any() or not np.array_equal(frame.rotation, np.eye(3)):
                out[..., k, :, :] = out[..., k, :, :] @ np.linalg.inv(frame_of(frame))
        return out

    def jacobian(self, q: ArrayLike, frame: str | Sequence[str], axes: str = ALIGNED) -> Array:
        """Return J with velocity(q, v, frame, axes) = J v, shape (6, nv) or (N, 6, nv).

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        frame : str or sequence of str
        axes : {"local", "world", "local_world_aligned"}
            As in `velocity`; ``"body"`` is another name for ``"local"``.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.jacobian([0.0], "tip").T + 0.0
        array([[ 2.,  0.,  0.,  0., -1.,  0.]])
        """
        return self._of_frames("jacobian", frame, axes_named(axes), q=q)

    def velocity(self, q: ArrayLike, v: ArrayLike, frame: str | Sequence[str], axes: str = ALIGNED) -> Array:
        """Return the velocity of a frame relative to the world, m/s and rad/s, linear then angular.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v : (nv,) or (N, nv) array_like
        frame : str or sequence of str
        axes : {"local", "world", "local_world_aligned"}
            ``"local_world_aligned"``: of the frame's origin, in the world's axes. ``"local"``: of the frame's origin,
            in the frame's axes. ``"world"``: of the body's point at the world's origin, in the world's axes.

        Returns
        -------
        (6,) or (N, 6) array
            With a list of frames (k, 6) or (N, k, 6).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0), "lagrangian")
        >>> dyn.velocity([0.0], [3.0], "tip", axes="local") + 0.0
        array([ 6.,  0.,  0.,  0., -3.,  0.])
        """
        return self._of_frames("velocity", frame, axes_named(axes), q=q, v=v)

    def acceleration(
        self,
        q: ArrayLike,
        v: ArrayLike,
        a: ArrayLike,
        frame: str | Sequence[str],
        axes: str = ALIGNED,
        kind: str = CLASSICAL,
    ) -> Array:
        """Return the acceleration of a frame, m/s² and rad/s², linear then angular, without gravity.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v, a : (nv,) or (N, nv) array_like
            Velocity and acceleration, v̇.
        frame : str or sequence of str
        axes : {"local", "world", "local_world_aligned"}
            As in `velocity`.
        kind : {"classical", "spatial"}
            ``"classical"``: of the point, the second derivative of its position. ``"spatial"``: the rate of the twist
            in the frame's own axes, which differs by ω × v (Featherstone 2008, ch. 2.11).

        Returns
        -------
        (6,) or (N, 6) array
            With a list of frames (k, 6) or (N, k, 6).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.acceleration([0.0], [3.0], [0.0], "tip")[:3] + 0.0  # to the pivot, l θ̇²
        array([ 0.,  0., 18.])
        """
        if kind not in (SPATIAL, CLASSICAL):
            raise InputError(f"kind: expected {SPATIAL!r} or {CLASSICAL!r}, got {kind!r}")
        return self._of_frames("acceleration", frame, axes_named(axes), kind, q=q, v=v, a=a)

    def jacobian_dot_v(self, q: ArrayLike, v: ArrayLike, frame: str | Sequence[str], axes: str = ALIGNED) -> Array:
        """Return J̇ v with the J of `jacobian`: the rate of the velocity at v̇ = 0, shape (6,) or (N, 6).

        So J a + J̇ v is the rate of the velocity's six numbers: the classical acceleration in
        ``"local_world_aligned"`` axes, the spatial one in the others.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.jacobian_dot_v([0.0], [3.0], "tip")[:3] + 0.0
        array([ 0.,  0., 18.])
        """
        return self._of_frames("jacobian_dot_v", frame, axes_named(axes), q=q, v=v)

    def function(self, name: str, frame: str | None = None, axes: str = ALIGNED, kind: str = CLASSICAL) -> Any:
        """Return a quantity as a `casadi.Function`; the lagrangian engine only.

        Inputs are named as in `mbkit.derivation.FUNCTIONS` (q, v, a, tau), all of them column vectors; of a model with
        parameters the last one is "parameters", in the order of ``model.parameters``. The output has the quantity's
        name and is dense: (nv, nv), (nv, 1) or (1, 1); derivatives are by_q, by_v and by_a or by_tau. It may be called
        with MX or SX and differentiated. `mbkit.lagrangian.export_c` writes it as C. A `frame` is that of pose (4, 4),
        jacobian (6, nv), velocity, acceleration and jacobian_dot_v (6, 1), and of generalized_force, whose input
        "wrenches" is (6, 1); `axes` and `kind` are as in these methods. Those of the whole, such as center_of_mass and
        centroidal_momentum_matrix, take none.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.function("jacobian", frame="tip")
        Function(jacobian:(q)->(jacobian[6]) SXFunction)
        """
        if not isinstance(name, str):
            raise InputError(f"name: expected the name of a quantity, such as 'mass_matrix', got {shown(name)}")
        dyn = self._matter if name in OF_THE_WHOLE and self.model.rotors else self
        return dyn._method("function")(name, frame, axes_named(axes), kind)

    # The whole

    def center_of_mass(self, q: ArrayLike) -> Array:
        """Return p_G, the centre of mass of all bodies in the world, m, shape (3,) or (N, 3).

        Bodies that are welded to the world count, as they do in ``model.mass`` and in the potential energy.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.center_of_mass([0.0])
        array([ 0.,  0., -2.])
        """
        return self._evaluate("center_of_mass", q=q)

    def center_of_mass_velocity(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return ṗ_G in world axes, m/s, shape (3,) or (N, 3).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.center_of_mass_velocity([0.0], [3.0]) + 0.0
        array([6., 0., 0.])
        """
        return self._evaluate("center_of_mass_velocity", q=q, v=v)

    def center_of_mass_acceleration(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """Return p̈_G in world axes, m/s², shape (3,) or (N, 3).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.center_of_mass_acceleration([0.0], [3.0], [0.0]) + 0.0
        array([ 0.,  0., 18.])
        """
        return self._evaluate("center_of_mass_acceleration", q=q, v=v, a=a)

    def center_of_mass_jacobian(self, q: ArrayLike) -> Array:
        """Return J_G with ṗ_G = J_G v, shape (3, nv) or (N, 3, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.center_of_mass_jacobian([0.0]).T + 0.0
        array([[2., 0., 0.]])
        """
        return self._evaluate("center_of_mass_jacobian", q=q)

    def centroidal_momentum(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the linear momentum, kg m/s, then the angular one about p_G, kg m²/s, in world axes.

        Shape (6,) or (N, 6). p_G is that of `center_of_mass`. Orin, Goswami and Lee 2013, Centroidal dynamics of a
        humanoid robot, Autonomous Robots 35.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.centroidal_momentum([0.0], [3.0])[:3] + 0.0
        array([18.,  0.,  0.])
        """
        return self._evaluate("centroidal_momentum", q=q, v=v)

    def centroidal_momentum_matrix(self, q: ArrayLike) -> Array:
        """Return A_G with the centroidal momentum A_G v, shape (6, nv) or (N, 6, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.centroidal_momentum_matrix([0.0])[:3].T + 0.0
        array([[6., 0., 0.]])
        """
        return self._evaluate("centroidal_momentum_matrix", q=q)

    def centroidal_momentum_bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return Ȧ_G v: the rate of the centroidal momentum is A_G a + Ȧ_G v; shape (6,) or (N, 6).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.centroidal_momentum_bias([0.0], [3.0])[:3] + 0.0
        array([ 0.,  0., 54.])
        """
        return self._evaluate("centroidal_momentum_bias", q=q, v=v)

    def locked_inertia(self, q: ArrayLike) -> Array:
        """Return the inertia of the whole with its joints locked, about p_G in world axes, shape (6, 6) or (N, 6, 6).

        The first block is the mass, the second the rotational inertia, kg m².

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0, mass=3.0), "lagrangian")
        >>> dyn.locked_inertia([0.0]).shape
        (6, 6)
        """
        return self._evaluate("locked_inertia", q=q)


class Composed(Evaluation):
    """Quantities by formulas from an engine's other ones, for an engine that has no function of its own for them."""

    def _mass_matrix_inverse(self, q: Array) -> Array:
        return np.asarray(np.linalg.inv(self._mass_matrix(q)))

    def _centroidal_momentum_matrix(self, q: Array) -> Array:
        """Return the momentum of each velocity."""
        nv = self.model.nv
        return np.array([self._centroidal_momentum(q, unit) for unit in np.eye(nv)]).reshape(nv, 6).T

    def _centroidal_momentum_bias(self, q: Array, v: Array) -> Array:
        """Return what the bodies' momenta change by, about p_G, at v̇ = 0."""
        bodies = self.model.bodies
        frames = tuple(Frame(b.name, b.name, _EYE, np.zeros(3)) for b in bodies)
        acceleration = self._acceleration(q, v, np.zeros_like(v), frames, LOCAL, CLASSICAL)
        rates = momentum_rates(bodies, self._velocity(q, v, frames, LOCAL)[:, 3:], acceleration)
        X, center = self._pose(q, frames), self._center_of_mass(q)
        force, moment = (np.einsum("nij,nj->ni", X[:, :3, :3], x) for x in np.split(rates, 2, axis=-1))
        arm = np.einsum("nij,nj->ni", X[:, :3], [[*b.com, 1.0] for b in bodies]) - center
        return np.concatenate([force.sum(axis=0), (moment + np.cross(arm, force)).sum(axis=0)])


class FrameByFrame:
    """Frames of an engine that tells of one point of a body at a time. A part of adapters.

    A state is put in first. What the engine says then is in world axes, linear first; rows of its Jacobians are for its
    own velocities, v_engine = T v.
    """

    #: Put a state in; return b of a_engine = T a + b.
    _place: Callable[..., Array]
    #: R_WF and p_WF of a frame, and what the engine needs to tell of that point.
    _placed: Callable[[Frame], tuple[Array, Array, Any]]
    #: From p_WF and the same: Jacobians of the point and of turning.
    _point_jacobian: Callable[[Array, Any], tuple[Array, Array]]
    _columns: Callable[[Array], Array]

    def _each(self, frames: tuple[Frame, ...], of: Callable[[Array, Array, Any], Array]) -> Array:
        return np.array([of(*self._placed(frame)) for frame in frames])

    def _pose(self, q: Array, frames: tuple[Frame, ...]) -> Array:
        self._place(q)
        return self._each(frames, lambda R, p, _: np.vstack([np.column_stack([R, p]), _LAST_ROW]))

    def _jacobian(self, q: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        self._place(q)
        return self._each(frames, lambda R, p, at: self._columns(seen_from(R, p, *self._point_jacobian(p, at), axes)))


class MovingFrames(FrameByFrame):
    """Rates of frames, and wrenches on them, for an engine that tells the motion of points."""

    #: Put a state and its accelerations in, as if there were no forces.
    _move: Callable[[Array, Array, Array], None]
    #: From p_WF and the same as for Jacobians: velocity; acceleration of the point, of its ω too; J̇ v in the engine's
    #: velocities.
    _twist: Callable[[Array, Any], Array]
    _point_acceleration: Callable[[Array, Any, Array], Array]
    _point_rate: Callable[[Array, Any], Array]

    def _velocity(self, q: Array, v: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        self._place(q, v)

        def seen(R: Array, p: Array, at: Any) -> Array:
            linear, angular = np.split(self._twist(p, at), 2)
            return seen_from(R, p, linear, angular, axes)

        return self._each(frames, seen)

    def _acceleration(self, q: Array, v: Array, a: Array, frames: tuple[Frame, ...], axes: str, kind: str) -> Array:
        self._move(q, v, a)

        def seen(R: Array, p: Array, at: Any) -> Array:
            twist = self._twist(p, at)
            return accelerated(R, p, twist, self._point_acceleration(p, at, twist[3:]), axes, kind)

        return self._each(frames, seen)

    def _jacobian_dot_v(self, q: Array, v: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        b, kind = self._place(q, v), CLASSICAL if axes == ALIGNED else SPATIAL

        def rate(R: Array, p: Array, at: Any) -> Array:
            # J = J_engine T, so J̇ v is J̇_engine v_engine + J_engine b.
            out = self._point_rate(p, at)
            if b.any():
                out = out + np.concatenate(self._point_jacobian(p, at)) @ b
            return accelerated(R, p, self._twist(p, at), out, axes, kind)

        return self._each(frames, rate)

    def _external(
        self, wrenches: Array, frames: tuple[Frame, ...], axes: str
    ) -> Iterator[tuple[Array, Array, Array, Any]]:
        """Yield force, moment and their point in world axes, and the engine's place, of wrenches at the state."""
        for frame, wrench in zip(frames, wrenches.reshape(-1, 6), strict=True):
            R, p, at = self._placed(frame)
            force, moment = wrench[:3], wrench[3:]
            if axes == LOCAL:
                force, moment = R @ force, R @ moment
            yield force, moment, np.zeros(3) if axes == WORLD else p, at


def momentum_rates(bodies: Sequence[Body], w: Array, acceleration: Array) -> Array:
    """Return m a_G and d/dt (I ω) of bodies, (..., n, 6), in their own axes.

    They come from the angular velocities, (..., n, 3), and the classical accelerations of the bodies' origins.
    """
    mass, com, inertia = (np.array([getattr(b, name) for b in bodies]) for name in ("mass", "com", "inertia"))
    linear, angular = np.split(acceleration, 2, axis=-1)
    force = mass[:, None] * (linear + np.cross(angular, com) + np.cross(w, np.cross(w, com)))
    I_w, I_a = (np.einsum("nij,...nj->...ni", inertia, x) for x in (w, angular))
    return np.concatenate([force, I_a + np.cross(w, I_w)], axis=-1)


# What an engine's formula for M must lose: the diagonal is M_jj = sᵀ I_C s, with the composite inertia I_C of all that
# joint j moves and its axis s (Featherstone 2008, Rigid Body Dynamics Algorithms, eq. 6.11). An engine turns I_C about
# some point, so that its entries round by eps ‖I_C‖; where a heavy or far body hardly turns with the joint, M_jj is the
# small difference of them.

#: Points about which an engine writes composite inertias: of each joint its own origin, the centre of mass of the tree
#: that the joint belongs to, or the world's origin.
JOINT, TREE = "joint", "tree"


def composite_rounding(dyn: Any, q: Array, about: str) -> float:
    """Return Σ |terms| / M_jj of the sum that makes the worst diagonal entry of M at one configuration.

    The terms are bounded by norms: ‖I‖ |ω|² + 2 |h| |ω| |v| + m |v|² with the composite I, first moment h and mass m
    about the point, and the joint's angular and linear velocity ω, v there.
    """
    model = dyn.model
    diagonal = np.diag(dyn.mass_matrix(q))
    names = [b.name for b in model.bodies]
    poses = dyn.body_poses(q)
    R, p = poses[:, :3, :3], poses[:, :3, 3]
    mass = np.array([b.mass for b in model.bodies])
    com = p + np.einsum("nij,nj->ni", R, np.array([b.com for b in model.bodies]))
    own = np.einsum("nij,njk,nlk->nil", R, np.array([b.inertia for b in model.bodies]), R)
    worst = 1.0
    for joint in model.independent_joints:
        moved = np.array([_moves(model, joint.name, name) for name in names])
        if about == TREE:
            tree = np.array([model.way(name)[-2] == model.way(joint.child)[-2] for name in names])
            total = float(mass[tree].sum())
            point = mass[tree] @ com[tree] / total if total else np.zeros(3)
        else:
            point = np.zeros(3) if about == WORLD else p[names.index(joint.child)]
        d, m = com[moved] - point, mass[moved]
        parallel = (d**2).sum(1)[:, None, None] * _EYE - np.einsum("ni,nj->nij", d, d)
        turning = float(np.linalg.norm((own[moved] + m[:, None, None] * parallel).sum(0), 2))
        moment = float(np.linalg.norm(m @ d))
        at = model.layout.v[joint.name]
        J = dyn.jacobian(q, joint.child)[:, at]
        # A frame may have the name of a body and another origin: J and this origin are of the same one.
        origin = dyn.pose(q, joint.child)[:3, 3]
        angular = np.linalg.norm(J[3:], axis=0)
        linear = np.linalg.norm(J[:3] + np.cross(J[3:].T, point - origin).T, axis=0)
        terms = turning * angular**2 + 2 * moment * angular * linear + float(m.sum()) * linear**2
        size = np.where(diagonal[at] > 0, diagonal[at], np.inf)
        worst = max(worst, float((terms / size).max(initial=0.0)))
    return worst


def _moves(model: Model, joint: str, body: str) -> bool:
    """Return whether a joint, or one that follows it, moves a body."""
    mimics = {j.name for j in model.joints if j.mimic is not None and j.mimic.joint == joint}
    above = set(model.way(body))
    return any(j.child in above for j in model.joints if j.name == joint or j.name in mimics)
