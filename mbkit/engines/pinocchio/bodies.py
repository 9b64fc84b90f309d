"""Motion of frames, momenta and loads by Pinocchio. A part of `PinocchioDynamics`.

Two things differ. Pinocchio leaves bodies that are welded to the world out of the centre of mass, and they are added
here. It merges bodies that are welded to each other: the load of a fixed joint is the sum over the bodies behind it,
with Pinocchio's inertias and motion.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Final

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.engines.frames_and_momenta import ALIGNED, CLASSICAL, LOCAL, WORLD, Composed
from mbkit.engines.pinocchio.model import OnBody, PinModel, PointSprings, inertia_of
from mbkit.model import Frame, Joint, Model

_REFERENCE_FRAMES: Final = {
    LOCAL: pin.ReferenceFrame.LOCAL,
    WORLD: pin.ReferenceFrame.WORLD,
    ALIGNED: pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
}


class PinocchioBodies(Composed):
    """Pinocchio's quantities of frames, of the whole system, and loads; `PinocchioDynamics` inherits it."""

    model: Model
    _m: Any
    _d: Any
    _pin: PinModel
    _springs: PointSprings | None
    _direct: bool
    _G: Array
    _placements: dict[str, tuple[int, Any]]
    # These stand in the other part.
    _full_q: Callable[[Array], Array]
    _full_v: Callable[[Array], Array]
    _joints_of: Callable[[Callable[[Array, Array], bool]], str]

    def _columns(self, J: Any) -> Array:
        """Return a Jacobian of Pinocchio's in the description's velocities."""
        # One column comes back as a vector.
        J = np.reshape(J, (len(J), self._m.nv))
        return np.asarray(J) if self._direct else J @ self._G

    # Frames

    def _in_joint(self, frame: Frame) -> tuple[int, Any]:
        """Return the joint that carries a frame, and X_JF."""
        if frame.name not in self._placements:
            carrier, R, p = self._pin.bodies[frame.body]
            self._placements[frame.name] = carrier, pin.SE3(R @ frame.rotation, p + R @ frame.translation)
        return self._placements[frame.name]

    def _pose(self, q: Array, frames: tuple[Frame, ...]) -> Array:
        pin.forwardKinematics(self._m, self._d, self._full_q(q))
        placed = (self._d.oMi[carrier] * X_JF for carrier, X_JF in map(self._in_joint, frames))
        return np.array([X.homogeneous for X in placed])

    def _jacobian(self, q: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        m, d, reference = self._m, self._d, _REFERENCE_FRAMES[axes]
        pin.computeJointJacobians(m, d, self._full_q(q))
        out = np.zeros((len(frames), 6, self.model.nv))
        for k, (carrier, X_JF) in enumerate(map(self._in_joint, frames)):
            # Pinocchio would read beyond an array for the world's joint in a model without others.
            if carrier:
                out[k] = self._columns(pin.getFrameJacobian(m, d, carrier, X_JF, reference))
        return out

    def _velocity(self, q: Array, v: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        m, d, reference = self._m, self._d, _REFERENCE_FRAMES[axes]
        pin.forwardKinematics(m, d, self._full_q(q), self._full_v(v))
        return np.array([pin.getFrameVelocity(m, d, *self._in_joint(f), reference).vector for f in frames])

    def _acceleration(self, q: Array, v: Array, a: Array, frames: tuple[Frame, ...], axes: str, kind: str) -> Array:
        m, d, reference = self._m, self._d, _REFERENCE_FRAMES[axes]
        pin.forwardKinematics(m, d, self._full_q(q), self._full_v(v), self._full_v(a))
        own = pin.getFrameClassicalAcceleration if kind == CLASSICAL else pin.getFrameAcceleration
        return np.array([own(m, d, *self._in_joint(f), reference).vector for f in frames])

    def _jacobian_dot_v(self, q: Array, v: Array, frames: tuple[Frame, ...], axes: str) -> Array:
        m, d, v = self._m, self._d, self._full_v(v)
        pin.computeJointJacobiansTimeVariation(m, d, self._full_q(q), v)
        out = []
        for carrier, X_JF in map(self._in_joint, frames):
            # Pinocchio has J̇ of frames that it holds and of joints, and not of a placement on a joint.
            rate = pin.getJointJacobianTimeVariation(m, d, carrier, pin.ReferenceFrame.LOCAL) if carrier else None
            own = pin.Motion.Zero() if rate is None else X_JF.actInv(pin.Motion(rate.reshape(6, m.nv) @ v))
            if axes == WORLD:
                own = (d.oMi[carrier] * X_JF).act(own)
            if axes == ALIGNED:
                R = d.oMi[carrier].rotation @ X_JF.rotation
                at = pin.getFrameVelocity(m, d, carrier, X_JF, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
                own = pin.Motion(R @ own.linear + pin.skew(at.angular) @ at.linear, R @ own.angular)
            out.append(own.vector)
        return np.array(out)

    @cached_property
    def _rate_fault(self) -> str:
        """Where J̇ v is not the acceleration without v̇; empty where it is."""
        m, d, reference = self._m, self._d, pin.ReferenceFrame.WORLD

        def wrong(q: Array, v: Array) -> bool:
            pin.computeJointJacobiansTimeVariation(m, d, q, v)
            rates = [
                pin.getJointJacobianTimeVariation(m, d, i, reference).reshape(6, m.nv) @ v for i in range(1, m.njoints)
            ]
            J = np.abs(d.J).max()
            pin.forwardKinematics(m, d, q, v, np.zeros(m.nv))
            right = [pin.getAcceleration(m, d, i, reference).vector for i in range(1, m.njoints)]
            # J ‖v‖² is the size of what cancels in an acceleration of zero.
            return bool(np.abs(np.subtract(rates, right)).max() > 1e-9 * (np.abs(right).max() + J * float(v @ v)))

        return self._joints_of(wrong)

    # The whole

    @cached_property
    def _moving_mass(self) -> float:
        return float(sum(self._m.inertias[i].mass for i in range(1, self._m.njoints)))

    def _of_all(self, moving: Array, ground: Array | float = 0.0) -> Array:
        """Return a mean over all bodies, of that over those that move and of m x over those fixed to the world."""
        fixed, mass = self._pin.ground.mass, self._moving_mass
        if not fixed:
            return moving
        # Where nothing moves, Pinocchio's mean is 0 / 0.
        return np.asarray(((mass * moving if mass else np.zeros_like(moving)) + ground) / (fixed + mass))

    def _about_all(self, h: Array) -> Array:
        """Return momenta, or their rates, about p_G, of those about the centre of mass of the bodies that move."""
        if not self._pin.ground.mass:
            return h
        if not self._moving_mass:
            return np.zeros_like(h)
        center = self._d.com[0]
        out = np.array(h)
        # Neither centre has a velocity across the momentum, so that rates have no further part.
        out[3:] += pin.skew(center - self._of_all(center, self._pin.ground_moment)) @ h[:3]
        return out

    def _center_of_mass(self, q: Array) -> Array:
        return self._of_all(pin.centerOfMass(self._m, self._d, self._full_q(q), False), self._pin.ground_moment)

    def _center_of_mass_velocity(self, q: Array, v: Array) -> Array:
        pin.centerOfMass(self._m, self._d, self._full_q(q), self._full_v(v), False)
        return self._of_all(self._d.vcom[0])

    def _center_of_mass_acceleration(self, q: Array, v: Array, a: Array) -> Array:
        pin.centerOfMass(self._m, self._d, self._full_q(q), self._full_v(v), self._full_v(a), False)
        return self._of_all(self._d.acom[0])

    def _center_of_mass_jacobian(self, q: Array) -> Array:
        return self._of_all(self._columns(pin.jacobianCenterOfMass(self._m, self._d, self._full_q(q), False)))

    def _centroidal_momentum(self, q: Array, v: Array) -> Array:
        h = pin.computeCentroidalMomentum(self._m, self._d, self._full_q(q), self._full_v(v))
        return self._about_all(h.vector)

    def _centroidal_momentum_matrix(self, q: Array) -> Array:
        return self._about_all(self._columns(pin.computeCentroidalMap(self._m, self._d, self._full_q(q))))

    def _centroidal_momentum_bias(self, q: Array, v: Array) -> Array:
        v = self._full_v(v)
        # computeCentroidalMapTimeVariation of 4.1.0 reads the velocity of the centre of mass of an earlier call.
        rate = pin.dccrba(self._m, self._d, self._full_q(q), v)
        return self._about_all(np.asarray(rate).reshape(6, self._m.nv) @ v)

    def _locked_inertia(self, q: Array) -> Array:
        pin.ccrba(self._m, self._d, self._full_q(q), np.zeros(self._m.nv))
        own = self._d.Ig
        if self._pin.ground.mass:
            own = self._pin.ground
            if self._moving_mass:
                own = own + pin.SE3(np.eye(3), self._d.com[0]).act(self._d.Ig)
            own.lever = np.zeros(3)
        return np.asarray(own.matrix())

    # Loads

    def _applied(self, q: Array, wrenches: Array, frames: tuple[Frame, ...], axes: str) -> list[OnBody]:
        """Return wrenches on frames as forces about the origin of the joint that carries each, in its axes."""
        if axes != LOCAL:
            pin.forwardKinematics(self._m, self._d, q)
        out = []
        for frame, wrench in zip(frames, wrenches.reshape(-1, 6), strict=True):
            (carrier, X_JF), force = self._in_joint(frame), pin.Force(wrench)
            if axes == WORLD:
                out.append((frame.body, self._d.oMi[carrier].actInv(force)))
                continue
            if axes == ALIGNED:
                X_JF = pin.SE3(self._d.oMi[carrier].rotation.T, X_JF.translation)
            out.append((frame.body, X_JF.act(force)))
        return out

    def _on_joints(self, forces: list[OnBody]) -> Any:
        """Return forces as Pinocchio's algorithms take them, the sum on each joint."""
        out = pin.StdVec_Force(self._m.njoints, pin.Force.Zero())
        for body, force in forces:
            out[self._pin.bodies[body][0]] += force
        return out

    def _outside(self, q: Array, *acting: Any) -> list[Any]:
        """Return what stands behind the arguments of `rnea` and `aba` for wrenches on frames, where there are some."""
        return [self._on_joints(self._applied(q, *acting))] if acting else []

    def _joint_wrenches(self, q: Array, v: Array, a: Array, *given: Any) -> Array:
        *wrenches, joints, frames, axes = given
        m, d = self._m, self._d
        q, v, a = self._full_q(q), self._full_v(v), self._full_v(a)
        outside = [] if self._springs is None else self._springs.forces(m, d, q, v)
        if wrenches:
            outside += self._applied(q, wrenches[0], frames, axes)
        pin.forwardKinematics(m, d, q)
        pin.rnea(m, d, q, v, a, self._on_joints(outside))
        fixed = {} if all(joint.type.nv for joint in joints) else self._fixed_loads(outside)

        def load(joint: Joint) -> Any:
            return d.f[self._pin.bodies[joint.child][0]] if joint.type.nv else fixed[joint.name]

        return np.array([load(joint).vector for joint in joints]).reshape(-1, 6)

    def _fixed_loads(self, outside: list[OnBody]) -> dict[str, Any]:
        """Return the loads of the fixed joints, of Pinocchio's motion and forces after `rnea`."""
        d, bodies = self._d, self._pin.bodies
        # The wrench of a body and all behind it, about the origin of the joint that carries it.
        needed = {name: pin.Force.Zero() for name in bodies}
        for body, force in outside:
            needed[body] -= force
        out = {}
        for joint in reversed(self.model.tree):
            carrier, R, p = bodies[joint.child]
            if joint.type.nv:
                above = bodies[joint.parent][0]
                needed[joint.parent] += (d.oMi[above].inverse() * d.oMi[carrier]).act(d.f[carrier])
                continue
            X_JB = pin.SE3(R, p)
            matter, moving = X_JB.act(inertia_of(self.model.body(joint.child))), d.v[carrier]
            total = needed[joint.child] + matter * d.a_gf[carrier] + moving.cross(matter * moving)
            needed[joint.parent] += total
            out[joint.name] = X_JB.actInv(total)
        return out
