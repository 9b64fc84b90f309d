"""Drake behind the protocol: terms from its `MultibodyPlant`.

Tedrake and the Drake Development Team 2019, "Drake: Model-based design and verification for robotics". The only place
that knows Drake's conventions: its bias term has no gravity, its gravity forces stand on the right, a free joint is
quaternion (w, x, y, z) then position, and velocities of ball and free joints are angular then linear, in the axes of
the joint's fixed frame F: v_drake = T v with R = R_FM in T's blocks, so M = Tᵀ M_drake T, and a_drake = T a + b with
b = R (ω × v) in the linear rows.
"""

from __future__ import annotations

import contextlib
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.tree import MultibodyForces, MultibodyForces_

from mbkit import spatial
from mbkit._check import Array
from mbkit.engines.base import MappedDynamics
from mbkit.engines.drake.bodies import DrakeBodies
from mbkit.engines.drake.model import DRAKE, NO_CONSTRAINTS, SAP, DrakeModel, build
from mbkit.errors import NumericalError
from mbkit.model import Model
from mbkit.model.quantities import of_groups

_WITHOUT_LOOPS: Final = {
    **dict.fromkeys(
        (
            *("forward_dynamics", "forward_dynamics_derivatives"),
            *of_groups("row", "actuator", "load", "loop", "motion"),
        ),
        f"{{model}} has constraints ({{parts}}), and {NO_CONSTRAINTS}; mbkit.simulate(..., method={SAP!r}) runs its "
        "discrete one, and mbkit.dynamics(model, 'lagrangian') has the terms",
    )
}


class DrakeDynamics(DrakeBodies, MappedDynamics):
    """Drake on a description.

    Of a model with loops the terms are those of the tree, and its runs are Drake's discrete ones: loops are among the
    constraints of the discrete plant alone.

    Attributes
    ----------
    plant : pydrake.multibody.plant.MultibodyPlant
        The plant that was built; free to read.
    maps : DrakeModel
        The plant with the maps between its coordinates and the description's.
    """

    engine = "drake"
    _path = DRAKE
    _why_no_derivatives = ""
    _soft_constraints = True
    _takes_wrenches = ("inverse_dynamics", "forward_dynamics")
    _refuses: ClassVar[dict[str, str]] = {
        "coriolis_matrix": "Drake forms C v without the matrix; nle(q, v) - gravity(q) is C v",
    }

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        if model.constrained:
            parts = {"model": model.name, "parts": model.constraint_parts}
            vars(self)["_refuses"] = self._refuses | {k: why.format(**parts) for k, why in _WITHOUT_LOOPS.items()}
        self._hold(build(model))

    def _hold(self, compiled: DrakeModel) -> None:
        self.maps, self.plant, self._v_index = compiled, compiled.plant, compiled.v_index
        self._applied = self.plant.get_applied_generalized_force_input_port()
        self._acceleration_port = self.plant.get_generalized_acceleration_output_port()
        self._context = self.plant.CreateDefaultContext()

    def _evaluate(self, quantity: str, *more: Any, **arguments: ArrayLike) -> Array:
        try:
            return super()._evaluate(quantity, *more, **arguments)
        except (RuntimeError, SystemExit) as error:
            # Drake's failed demands come as either.
            if isinstance(error, NotImplementedError):
                raise
            reason = str(error).strip().splitlines()[0]
            raise NumericalError(f"drake: {quantity} of {self.model.name}: {reason}{self._suspects()}") from None

    # Between the description's numbers and Drake's.

    def to_drake(self, q: Array, v: Array | None = None) -> tuple[Array, Array, Array]:
        """Return Drake's positions and velocities, and b of a_drake = T a + b."""
        maps, layout = self.maps, self.model.layout
        full_q = layout.expand_q(q)
        x, u, b = full_q[maps.q_index], np.zeros(len(maps.v_index)), np.zeros(len(maps.v_index))
        own = u if v is None else layout.expand_v(v)[maps.v_index]
        self._turned = []
        for joint, iq, iv in maps.turning:
            R = spatial.matrix_from_quaternion(full_q[layout.full_q[joint.name]][-4:])
            self._turned += [(R, slice(k, k + 3)) for k in range(iv, iv + joint.type.nv, 3)]
            if joint.kind == "ball":
                x[iq : iq + 3] = RollPitchYaw(RotationMatrix(R)).vector()
            else:
                b[iv + 3 : iv + 6] = R @ np.cross(own[iv : iv + 3], own[iv + 3 : iv + 6])
        return x, u if v is None else self._to_engine(v), b

    def _place(self, q: Array, v: Array | None = None) -> Array:
        """Put a state into Drake; return b of a_drake = T a + b."""
        x, u, b = self.to_drake(q, v)
        self.put(self.plant, self._context, x, u)
        return b

    @staticmethod
    def put(plant: Any, context: Any, x: Array, u: Array) -> None:
        """Set Drake's positions and velocities."""
        plant.SetPositions(context, x)
        plant.SetVelocities(context, u)

    @cached_property
    def _weightless(self) -> tuple[Any, Any]:
        """A plant without gravity, whose forces Drake adds to those of springs and dampers, and its context."""
        plant = build(self.model, gravity=False).plant
        return plant, plant.CreateDefaultContext()

    @cached_property
    def _without_bushings(self) -> tuple[Any, Any]:
        plant = build(self.model, bushings=False).plant
        return plant, plant.CreateDefaultContext()

    # The protocol.

    def _mass_matrix(self, q: Array) -> Array:
        self._place(q)
        return self._columns(self._columns(self.plant.CalcMassMatrix(self._context)).T)

    def _gravity(self, q: Array) -> Array:
        self._place(q)
        return self._force(-self.plant.CalcGravityGeneralizedForces(self._context))

    def _coriolis_force(self, q: Array, v: Array) -> Array:
        return self._force(self._bias(q, v))

    def _bias(self, q: Array, v: Array) -> Array:
        """Return C v, and M b of the change of velocities."""
        b = self._place(q, v)
        out = self.plant.CalcBiasTerm(self._context)
        return np.asarray(out + self.plant.CalcMassMatrix(self._context) @ b if b.any() else out)

    def _nle(self, q: Array, v: Array) -> Array:
        bias = self._bias(q, v)
        return self._force(bias - self.plant.CalcGravityGeneralizedForces(self._context))

    def _passive(self, q: Array, v: Array) -> Array:
        plant, context = self._weightless
        forces = MultibodyForces(plant)
        self.put(plant, context, *self.to_drake(q, v)[:2])
        plant.CalcForceElementsContribution(context, forces)
        return self._force(plant.CalcGeneralizedForces(context, forces))

    def _inverse_dynamics(self, q: Array, v: Array, a: Array, *acting: Any) -> Array:
        b = self._place(q, v)
        forces = MultibodyForces(self.plant)
        self.plant.CalcForceElementsContribution(self._context, forces)
        if acting:
            forces = self._add_external(forces, *acting)
        return self._force(self.plant.CalcInverseDynamics(self._context, self._to_engine(a) + b, forces))

    def _inverse_dynamics_derivatives(self, q: Array, v: Array, a: Array) -> Array:
        """Return the derivatives by Drake's automatic differentiation: exact, of numbers with 3 nv directions."""
        plant, context = self._on_duals
        x, u, b = self.to_drake(q, v)
        n, start = len(u), self._to_engine(a)
        by_q, by_v, by_a = np.split(np.eye(3 * n), 3)
        moved, pushed = np.array(by_v), np.array(by_a)
        # Directions are in Drake's axes, in which a turn θ of a body turns v and a of mbkit's axes too.
        blocks = [
            (slice(iv, iv + 3), slice(k, k + 3))
            for joint, _, iv in self.maps.turning
            for k in range(iv, iv + joint.type.nv, 3)
        ]
        for turn, part in blocks:
            moved[part] -= spatial.skew(u[part]) @ by_q[turn]
            pushed[part] -= spatial.skew(start[part] + b[part]) @ by_q[turn]
            if part != turn:
                # b = ω × v, of which so far only the turn is counted.
                pushed[part] += spatial.skew(u[turn]) @ by_v[part] - spatial.skew(u[part]) @ by_v[turn]
        self.put(self.plant, self._context, x, u)
        rates = [self.plant.MapVelocityToQDot(self._context, e) for e in np.eye(n)]
        places = np.array(rates).reshape(n, len(x)).T @ by_q
        plant.SetPositions(context, InitializeAutoDiff(x, places)[:, 0])
        plant.SetVelocities(context, InitializeAutoDiff(u, moved)[:, 0])
        forces = MultibodyForces_[AutoDiffXd](plant)
        plant.CalcForceElementsContribution(context, forces)
        f = plant.CalcInverseDynamics(context, InitializeAutoDiff(start + b, pushed)[:, 0], forces)
        value, slope = ExtractValue(f)[:, 0], ExtractGradient(f)
        for turn, part in blocks:
            # Forces in mbkit's axes are Tᵀ f.
            slope[part] += spatial.skew(value[part]) @ by_q[turn]
        return np.stack([self._columns(self._columns(X).T).T for X in np.split(slope, 3, axis=1)])

    @cached_property
    def _on_duals(self) -> tuple[Any, Any]:
        """The plant on numbers with derivatives, and its context."""
        plant = self.plant.ToAutoDiffXd()
        return plant, plant.CreateDefaultContext()

    def _forward_dynamics(self, q: Array, v: Array, tau: Array, *acting: Any) -> Array:
        if self.model.layout.reduced:
            return self._solved_motion(q, v, tau, *acting)
        b = self._place(q, v)
        self._applied.FixValue(self._context, self._to_engine(tau))
        with self._pushed(*acting) if acting else contextlib.nullcontext():
            return self._force(self._acceleration_port.Eval(self._context) - b)

    def _kinetic_energy(self, q: Array, v: Array) -> Any:
        self._place(q, v)
        return self.plant.CalcKineticEnergy(self._context)

    def _potential_energy(self, q: Array) -> Any:
        x, u, _ = self.to_drake(q)
        self.put(self.plant, self._context, x, u)
        if not self.maps.bushings:
            return self.plant.CalcPotentialEnergy(self._context)
        # Drake has no energy of bushings, and fails where it is asked for it.
        total = 0.0
        for stiffness, A, p_AP, B, p_BQ in self.maps.bushings:
            P, Q = (self.plant.EvalBodyPoseInWorld(self._context, X).multiply(p) for X, p in ((A, p_AP), (B, p_BQ)))
            total += 0.5 * stiffness * float((Q - P) @ (Q - P))
        plant, context = self._without_bushings
        self.put(plant, context, x, u)
        return total + plant.CalcPotentialEnergy(context)
