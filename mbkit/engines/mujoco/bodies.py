"""Motion of frames, momenta and loads by MuJoCo. A part of `MujocoDynamics`.

MuJoCo writes spatial vectors angular first, about the centre of mass of a body's whole tree, in world axes. Its
accelerations hold gravity as an acceleration of the world, and its forces between bodies hold the pull of tendons,
which springs between points are. Both are off where motion alone is asked for.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from mbkit._check import Array
from mbkit.engines.frames_and_momenta import Composed, MovingFrames
from mbkit.engines.mujoco.model import MujocoModel
from mbkit.errors import UnsupportedError
from mbkit.model import Frame, Joint, Model
from mbkit.spatial import skew

#: The frame of a body, not that of its inertia.
_BODY_FRAME = mujoco.mjtObj.mjOBJ_XBODY
#: Entries of an inertia as MuJoCo stores them, as a matrix.
_SYMMETRIC = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


class MujocoBodies(MovingFrames, Composed):
    """MuJoCo's quantities of frames, of the whole system, and loads; `MujocoDynamics` inherits it."""

    model: Model
    _m: Any
    _d: Any
    _maps: MujocoModel
    _reduced: bool
    # These stand in the other parts.
    _set: Callable[..., Array]
    _velocities: Callable[[], None]
    _directed: Callable[[Array], Array]
    _to_engine: Callable[[Array], Array]
    _columns: Callable[[Array], Array]
    _force: Callable[[Array], Array]

    def _place(self, q: Array, v: Array | None = None) -> Array:
        """Put a state in, with poses and velocities of the bodies; return b of a_mj = T a + b."""
        b = self._set(q, v)
        mujoco.mj_kinematics(self._m, self._d)
        mujoco.mj_comPos(self._m, self._d)
        if v is not None:
            mujoco.mj_comVel(self._m, self._d)
        return b

    @contextlib.contextmanager
    def _without_forces(self) -> Iterator[None]:
        """Turn gravity, springs and dampers off."""
        flags, bits = self._m.opt.disableflags, mujoco.mjtDisableBit
        self._m.opt.disableflags |= int(bits.mjDSBL_GRAVITY) | int(bits.mjDSBL_SPRING) | int(bits.mjDSBL_DAMPER)
        try:
            yield
        finally:
            self._m.opt.disableflags = flags

    def _accelerate(self, q: Array, v: Array, a: Array) -> None:
        """Put a state and its accelerations in, with those of the bodies and the forces between them."""
        b = self._place(q, v)
        if self._m.ntendon:
            # Their lengths and rates are those of the last state yet.
            self._velocities()
        self._d.qacc[:] = self._to_engine(a) + b
        mujoco.mj_rnePostConstraint(self._m, self._d)

    # Frames

    def _placed(self, frame: Frame) -> tuple[Array, Array, int]:
        """Return R_WF and p_WF at the state that is in, and the number of the frame's body."""
        if frame.body in self._maps.absorbed:
            raise UnsupportedError(
                f"mujoco: frame {frame.name!r} rides on {frame.body!r}, a body without mass between two joints, "
                "which MuJoCo holds as two joints of one body"
            )
        body = self._maps.bodies[frame.body]
        R = self._d.xmat[body].reshape(3, 3)
        return R @ frame.rotation, self._d.xpos[body] + R @ frame.translation, body

    def _point_jacobian(self, p: Array, body: int, of: Callable[..., None] = mujoco.mj_jac) -> tuple[Array, Array]:
        linear, angular = np.zeros((3, self._m.nv)), np.zeros((3, self._m.nv))
        of(self._m, self._d, linear, angular, p, body)
        return linear, angular

    def _twist(self, p: Array, body: int) -> Array:
        six = np.zeros(6)
        mujoco.mj_objectVelocity(self._m, self._d, _BODY_FRAME, body, six, 0)
        return np.concatenate([six[3:] + skew(six[:3]) @ (p - self._d.xpos[body]), six[:3]])

    def _move(self, q: Array, v: Array, a: Array) -> None:
        with self._without_forces():
            self._accelerate(q, v, a)

    def _point_acceleration(self, p: Array, body: int, w: Array) -> Array:
        six, turning = np.zeros(6), skew(w)
        # It is that of the point at the body's origin: MuJoCo adds ω × v to the spatial one.
        mujoco.mj_objectAcceleration(self._m, self._d, _BODY_FRAME, body, six, 0)
        return np.concatenate([six[3:] + (skew(six[:3]) + turning @ turning) @ (p - self._d.xpos[body]), six[:3]])

    def _point_rate(self, p: Array, body: int) -> Array:
        return np.asarray(np.concatenate(self._point_jacobian(p, body, mujoco.mj_jacDot)) @ self._d.qvel)

    # The whole: the subtree of the world.

    def _center_of_mass(self, q: Array) -> Array:
        self._place(q)
        return np.array(self._d.subtree_com[0])

    def _center_of_mass_velocity(self, q: Array, v: Array) -> Array:
        self._place(q, v)
        mujoco.mj_subtreeVel(self._m, self._d)
        return np.array(self._d.subtree_linvel[0])

    def _center_of_mass_acceleration(self, q: Array, v: Array, a: Array) -> Array:
        return np.asarray(self._momentum_rate(q, v, a)[:3] / self._m.body_subtreemass[0])

    def _center_of_mass_jacobian(self, q: Array) -> Array:
        self._place(q)
        out = np.zeros((3, self._m.nv))
        mujoco.mj_jacSubtreeCom(self._m, self._d, out, 0)
        return self._columns(out)

    def _centroidal_momentum(self, q: Array, v: Array) -> Array:
        self._place(q, v)
        mujoco.mj_subtreeVel(self._m, self._d)
        return np.concatenate([self._m.body_subtreemass[0] * self._d.subtree_linvel[0], self._d.subtree_angmom[0]])

    def _centroidal_momentum_matrix(self, q: Array) -> Array:
        linear = self._m.body_subtreemass[0] * self._center_of_mass_jacobian(q)
        angular = np.zeros((3, self._m.nv))
        mujoco.mj_angmomMat(self._m, self._d, angular, 0)
        return np.concatenate([linear, self._columns(angular)])

    def _centroidal_momentum_bias(self, q: Array, v: Array) -> Array:
        return self._momentum_rate(q, v, np.zeros_like(v))

    def _momentum_rate(self, q: Array, v: Array, a: Array) -> Array:
        """Return the rate of the momentum about p_G: without gravity all that bodies exert on the world, turned."""
        self._move(q, v, a)
        return sum((self._held(i) for i in range(1, self._m.nbody) if not self._m.body_parentid[i]), np.zeros(6))

    def _held(self, body: int) -> Array:
        """Return force and moment about p_G, (6,), that the parent exerts on a body, in world axes."""
        d = self._d
        moment, force = d.cfrc_int[body, :3], d.cfrc_int[body, 3:]
        arm = d.subtree_com[self._m.body_rootid[body]] - d.subtree_com[0]
        return np.concatenate([force, moment + skew(arm) @ force])

    def _locked_inertia(self, q: Array) -> Array:
        self._place(q)
        d, out = self._d, np.zeros((6, 6))
        # Ixx, Iyy, Izz, Ixy, Ixz, Iyz, m cx, m cy, m cz, m about the centre of mass of each body's tree.
        matter, arm = d.cinert, d.subtree_com[self._m.body_rootid] - d.subtree_com[0]
        moment = np.einsum("ni,nj->ij", matter[:, 6:9], arm)
        spread = moment + moment.T + np.einsum("n,ni,nj->ij", matter[:, 9], arm, arm)
        out[:3, :3] = self._m.body_subtreemass[0] * np.eye(3)
        out[3:, 3:] = matter.sum(axis=0)[_SYMMETRIC] + np.trace(spread) * np.eye(3) - spread
        return out

    def _mass_matrix_inverse(self, q: Array) -> Array:
        if self._reduced:
            return super()._mass_matrix_inverse(q)
        self._set(q)
        mujoco.mj_fwdPosition(self._m, self._d)
        out = np.zeros((self._m.nv, self._m.nv))
        if self._m.nv:
            mujoco.mj_solveM(self._m, self._d, out, np.eye(self._m.nv))
        return self._columns(self._columns(out).T)

    # Loads

    def _generalized_force(self, q: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        self._place(q)
        out = np.zeros(self._m.nv)
        for external in self._external(wrenches, frames, axes):
            mujoco.mj_applyFT(self._m, self._d, *external, out)
        return self._force(out)

    @contextlib.contextmanager
    def _applied(self, q: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> Iterator[None]:
        """Hold wrenches on the bodies' centres of mass, in world axes."""
        self._place(q)
        applied = self._d.xfrc_applied
        for force, moment, point, body in self._external(wrenches, frames, axes):
            applied[body, :3] += force
            applied[body, 3:] += moment + skew(point - self._d.xipos[body]) @ force
        try:
            yield
        finally:
            applied[:] = 0.0

    def _joint_wrenches(self, q: Array, v: Array, a: Array, *given: Any) -> Array:
        *wrenches, joints, frames, axes = given
        for joint in joints:
            if joint.child in self._maps.absorbed:
                raise UnsupportedError(
                    f"mujoco cannot give joint_wrenches of {joint.name!r}: its child {joint.child!r} is a body without "
                    "mass between two joints, which MuJoCo holds as two joints of one body"
                )
        applied = self._applied(q, wrenches[0], frames, axes) if wrenches else contextlib.nullcontext()
        with applied:
            self._accelerate(q, v, a)
        carried = self._carried()

        def load(joint: Joint) -> Array:
            body, held = self._maps.bodies[joint.child], carried[joint.child]
            R, arm = self._d.xmat[body].reshape(3, 3), self._d.subtree_com[0] - self._d.xpos[body]
            return np.concatenate([R.T @ held[:3], R.T @ (held[3:] + skew(arm) @ held[:3])])

        return self._directed(np.array([load(joint) for joint in joints]).reshape(-1, 6))

    def _carried(self) -> dict[str, Array]:
        """Return what each body's parent exerts on it, as `_held`, with all that hangs on it in the description."""
        bodies = self._maps.bodies
        out = {b.name: self._held(bodies[b.name]) if b.name in bodies else np.zeros(6) for b in self.model.bodies}
        for joint in reversed(self.model.tree):
            # A body on one that is fixed to the world hangs on the world itself in MuJoCo's model.
            apart = joint.child not in bodies or not self._m.body_parentid[bodies[joint.child]]
            if apart and joint.parent in out:
                out[joint.parent] += out[joint.child]
        return out
