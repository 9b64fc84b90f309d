"""Pinocchio behind the protocol: CRBA for M, RNEA for nle, ABA for forward dynamics.

Carpentier et al. 2019, "The Pinocchio C++ library"; the algorithms are those of
Featherstone 2008, ch. 5 to 7. Where the description's coordinates are Pinocchio's,
single states take the short way of `pinocchio_direct`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.engines import defects
from mbkit.engines.base import Dynamics, per_sample
from mbkit.engines.passive import JointPassive
from mbkit.engines.pinocchio_direct import direct_calls
from mbkit.engines.pinocchio_model import PinModel, build
from mbkit.engines.pinocchio_springs import PointSprings
from mbkit.model import Model

__all__ = ["PinocchioDynamics"]

_DIRECT: Final = ("mass_matrix", "gravity", "nle", "inverse_dynamics", "forward_dynamics")


class PinocchioDynamics(Dynamics):
    """Pinocchio's algorithms on a description.

    Attributes
    ----------
    pin_model : pinocchio.Model
        What was built; free to read.
    """

    engine = "pinocchio"
    refuses: ClassVar[dict[str, str]] = {"function": "it has no symbolic form; mbkit.dynamics(model, 'lagrangian') has"}

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._pin: PinModel = build(model)
        self.pin_model = self._m = self._pin.model
        self._d = self._m.createData()
        self._joint_passive = JointPassive(model)
        self._springs = PointSprings(model, self._pin) if model.springs else None
        self._reduced = model.layout.reduced
        self._passive_any = model.needs.springs or model.needs.damping
        #: Whether q and v go to Pinocchio as they are.
        self._direct = self._pin.ordered and not self._reduced
        if self._direct:
            passive: Callable[[Array, Array], Array] | None = self._full_passive if self._passive_any else None
            if passive is not None and self._springs is None and not model.needs.springs:
                passive = self._damping_alone()
            checked = {name: getattr(self, name) for name in _DIRECT}
            for name, call in direct_calls(model, self._m, self._d, passive, checked).items():
                setattr(self, name, functools.update_wrapper(call, checked[name]))

    def _damping_alone(self) -> Callable[[Array, Array], Array]:
        against = -self._joint_passive.damping

        def force(_q: Array, v: Array) -> Array:
            return against * v

        return force

    # Between the description's coordinates and Pinocchio's.

    def _full_q(self, q: Array) -> Array:
        return q if self._direct else np.ascontiguousarray(self.model.layout.expand_q(q)[self._pin.q_order])

    def _full_v(self, v: Array) -> Array:
        return v if self._direct else np.ascontiguousarray(self.model.layout.expand_v(v)[self._pin.v_order])

    def _force(self, f: Array) -> Array:
        if self._direct:
            return f
        full = np.empty_like(f)
        full[self._pin.v_order] = f
        return self.model.layout.G.T @ full if self._reduced else full

    def _matrix(self, A: Array) -> Array:
        if self._direct:
            return A
        full = np.empty_like(A)
        full[np.ix_(self._pin.v_order, self._pin.v_order)] = A
        G = self.model.layout.G
        return np.asarray(G.T @ full @ G) if self._reduced else full

    def _columns(self, J: Array) -> Array:
        if self._direct:
            return J
        full = np.empty_like(J)
        full[:, self._pin.v_order] = J
        return np.asarray(full @ self.model.layout.G) if self._reduced else full

    # The protocol.

    def _mass_matrix(self, q: Array) -> Array:
        return per_sample(lambda q: self._matrix(pin.crba(self._m, self._d, self._full_q(q))), q)

    def _gravity(self, q: Array) -> Array:
        return per_sample(lambda q: self._force(pin.computeGeneralizedGravity(self._m, self._d, self._full_q(q))), q)

    def _nle(self, q: Array, v: Array) -> Array:
        return per_sample(
            lambda q, v: self._force(pin.nonLinearEffects(self._m, self._d, self._full_q(q), self._full_v(v))), q, v
        )

    def _coriolis_matrix(self, q: Array, v: Array) -> Array:
        if self._coriolis_wrong:
            announce = ", ".join(repr(j.name) for j in self._suspect_joints)
            defects.announce(defects.CORIOLIS, f"joint {announce}")
        return per_sample(
            lambda q, v: self._matrix(pin.computeCoriolisMatrix(self._m, self._d, self._full_q(q), self._full_v(v))),
            q,
            v,
        )

    def _passive(self, q: Array, v: Array) -> Array:
        return per_sample(lambda q, v: self._force(self._full_passive(self._full_q(q), self._full_v(v))), q, v)

    def _full_passive(self, q: Array, v: Array) -> Array:
        # In Pinocchio's order; the joints' part is kept in the description's.
        if self._pin.ordered:
            out = self._joint_passive.force(q, v)
        else:
            q_full, v_full = np.empty_like(q), np.empty_like(v)
            q_full[self._pin.q_order], v_full[self._pin.v_order] = q, v
            out = self._joint_passive.force(q_full, v_full)[self._pin.v_order]
        if self._springs is not None:
            out += self._springs.force(self._m, self._d, q, v)
        return out

    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        def one(q: Array, v: Array, a: Array) -> Array:
            q, v = self._full_q(q), self._full_v(v)
            return self._force(pin.rnea(self._m, self._d, q, v, self._full_v(a)) - self._full_passive(q, v))

        return per_sample(one, q, v, a)

    def _forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        return per_sample(self._forward_reduced if self._reduced else self._forward_tree, q, v, tau)

    def _forward_tree(self, q: Array, v: Array, tau: Array) -> Array:
        q, v = self._full_q(q), self._full_v(v)
        a = pin.aba(self._m, self._d, q, v, self._full_v(tau) + self._full_passive(q, v))
        return self._force(a)

    def _forward_reduced(self, q: Array, v: Array, tau: Array) -> Array:
        # ABA knows no mimic joints: solve GᵀMG a = τ + Gᵀ(passive - nle).
        q, v = self._full_q(q), self._full_v(v)
        M = self._matrix(pin.crba(self._m, self._d, q))
        h = pin.nonLinearEffects(self._m, self._d, q, v)
        return np.asarray(np.linalg.solve(M, tau + self._force(self._full_passive(q, v) - h)))

    def _kinetic_energy(self, q: Array, v: Array) -> Array:
        if self._kinetic_wrong:
            joints = ", ".join(repr(n) for n in self._pin.unaligned_armature)
            defects.announce(defects.KINETIC_ENERGY, f"the armature of joint {joints}")
        return per_sample(
            lambda q, v: pin.computeKineticEnergy(self._m, self._d, self._full_q(q), self._full_v(v)), q, v
        )

    def _potential_energy(self, q: Array) -> Array:
        ground = -float(self.model.gravity @ self._pin.ground_moment)

        def one(q: Array) -> Any:
            full = self.model.layout.expand_q(q)
            q = self._full_q(q)
            stored = self._joint_passive.energy(full)
            if self._springs is not None:
                stored = stored + self._springs.energy(self._m, self._d, q)
            return pin.computePotentialEnergy(self._m, self._d, q) + stored + ground

        return per_sample(one, q)

    def _frame_in_joint(self, frame: str) -> tuple[int, pin.SE3]:
        f = self.model.frame(frame)
        carrier, R, p = self._pin.bodies[f.body]
        return carrier, pin.SE3(R @ f.rotation, p + R @ f.translation)

    def _pose(self, q: Array, frame: str) -> Array:
        carrier, X_JF = self._frame_in_joint(frame)

        def one(q: Array) -> Array:
            pin.forwardKinematics(self._m, self._d, self._full_q(q))
            return np.array((self._d.oMi[carrier] * X_JF).homogeneous)

        return per_sample(one, q)

    def _jacobian(self, q: Array, frame: str, axes: str) -> Array:
        carrier, X_JF = self._frame_in_joint(frame)

        def one(q: Array) -> Array:
            q = self._full_q(q)
            if carrier:
                # One column comes back as a vector.
                own = pin.computeJointJacobian(self._m, self._d, q, carrier).reshape(6, self._m.nv)
                J = X_JF.toActionMatrixInverse() @ own
            else:
                J = np.zeros((6, self._m.nv))
            if axes == "world":
                pin.forwardKinematics(self._m, self._d, q)
                R = (self._d.oMi[carrier] * X_JF).rotation
                J = np.vstack([R @ J[:3], R @ J[3:]])
            return self._columns(J)

        return per_sample(one, q)

    # Known defects, measured on this very model.

    @cached_property
    def _suspect_joints(self) -> tuple[Any, ...]:
        return tuple(j for j in self.model.tree if j.kind in ("spherical_zyx", "universal"))

    @cached_property
    def _coriolis_wrong(self) -> bool:
        if not self._suspect_joints:
            return False
        q, v = self._probe
        C = pin.computeCoriolisMatrix(self._m, self._d, q, v)
        h = pin.nonLinearEffects(self._m, self._d, q, v)
        g = pin.computeGeneralizedGravity(self._m, self._d, q)
        return bool(np.abs(C @ v + g - h).max() > 1e-9 * (np.abs(h).max() + np.abs(g).max()))

    @cached_property
    def _kinetic_wrong(self) -> bool:
        if not self._pin.unaligned_armature:
            return False
        q, v = self._probe
        right = 0.5 * float(v @ pin.crba(self._m, self._d, q) @ v)
        return bool(abs(pin.computeKineticEnergy(self._m, self._d, q, v) - right) > 1e-12 * right)

    @cached_property
    def _probe(self) -> tuple[Array, Array]:
        q, v = self.model.random_state(np.random.default_rng(1))
        return self._full_q(q), self._full_v(v)
