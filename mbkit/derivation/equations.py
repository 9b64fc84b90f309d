"""From energies to the equation of motion, each quantity derived when it is asked for.

Boltzmann and Hamel's form of Lagrange's equations (Greenwood 2003, Advanced Dynamics, ch. 4.3), with p = ∂T/∂v::

    d/dt p + hamel(v, p) - Dᵀ ∂T/∂q + Dᵀ ∂V/∂q = τ + τ_damping

For coordinate velocities D = 1 and the hamel term vanishes: Lagrange's own form. d/dt p is one directional derivative
along (D v, a).

Forward dynamics solves that by the factors of M, or, where those would lose digits, by Gauss's principle of least
constraint (`mbkit.derivation.least_constraint`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, wraps
from typing import Any, Final, Literal, TypeVar, get_args

import casadi as ca
import numpy as np

from mbkit.derivation import kinematics as energies
from mbkit.derivation.body_motion import BODY_QUANTITIES, OF_FRAME, OF_WHOLE, BodyMotion
from mbkit.derivation.constraints import CONSTRAINT_FUNCTIONS, ConstrainedMotion
from mbkit.derivation.fingerprint import SOURCES as _SOURCES  # noqa: F401  # read with the code that it fingerprints
from mbkit.derivation.forces import ElementForces
from mbkit.derivation.kinematics import Kinematics
from mbkit.derivation.least_constraint import LeastConstraint, squares
from mbkit.derivation.mass_matrix_solve import elimination_order, solve
from mbkit.derivation.model_values import Constants, scalar
from mbkit.errors import InputError, UnknownNameError
from mbkit.model import Model
from mbkit.model.quantities import of_groups

Elimination = Literal["links", "mass matrix", "least constraint"]
ELIMINATIONS: Final[tuple[Elimination, ...]] = get_args(Elimination)
#: Names of frames on which wrenches act, and the axes of these.
Acting = tuple[tuple[str, ...], str]
NOTHING: Final[Acting] = ((), "")

T = TypeVar("T")

#: Name of each quantity -> the arguments of its function.
FUNCTIONS: Final = of_groups("equation", "inverse", "rate", "derivatives")


def kept(make: Callable[..., T]) -> Callable[..., T]:
    """Keep what a function of equations returns with these, by its other arguments."""

    @wraps(make)
    def get(equations: Any, **options: Any) -> T:
        key = (make.__name__, *options.items())
        if key not in equations.kept:
            equations.kept[key] = make(equations, **options)
        out: T = equations.kept[key]
        return out

    return get


class Equations:
    """The equations of motion of a model as CasADi expressions and functions.

    Parameters
    ----------
    model : Model
    constants : {"literal", "symbols"}
        Whether the model's numbers stand in the expressions as floats, or as symbols that become the last argument,
        ``"constants"``, of every function.

    elimination : {"mass matrix", "least constraint", "links"}
        What forward dynamics comes from; ``"links"`` is that of `LinkEquations`.
    acting : (tuple of str, str)
        Frames on which wrenches act, and their axes: those of `BodyMotion.generalized_force`.

    Attributes
    ----------
    q, v, a, tau : casadi.SX
        tau is the whole applied generalized force.
    force : (nv + 6 k, 1) casadi.SX
        The argument ``"tau"`` of functions: the generalized force, and behind it six numbers for each of the k frames
        on which wrenches act. Without such frames it is `tau`.
    parameters : (p, 1) casadi.SX
        The model's named parameters in the order of `model.parameters`, the last argument, ``"parameters"``, of every
        function if there are any. With constants as symbols they are among those, at their nominal values.
    constants : (k, 1) casadi.SX
        Empty with literal constants.
    constant_values : (k,) array
        What `constants` stands for.
    """

    def __init__(
        self,
        model: Model,
        constants: Constants = "literal",
        elimination: Elimination = "mass matrix",
        acting: Acting = NOTHING,
    ) -> None:
        self.model = model
        self.elimination: Elimination = elimination
        self.kin = Kinematics(model, constants)
        self.parameters = self.kin.values.parameters
        self.constants, self.constant_values = self.kin.values.constants, self.kin.values.constant_values
        self.q, self.v = self.kin.q, self.kin.v
        self.a = ca.SX.sym("a", model.nv)
        frames, axes = acting
        self.force = self.tau = ca.SX.sym("tau", model.nv + 6 * len(frames))
        if frames:
            wrenches = self.force[model.nv :]
            self.tau = self.force[: model.nv] + self.motion.generalized_force(frames, axes, wrenches)

    def applied(self, q: Any, force: Any) -> Any:
        """Return `tau` of other expressions for the configuration and `force`."""
        return ca.substitute(self.tau, ca.vertcat(self.q, self.force), ca.vertcat(q, force))

    @cached_property
    def kept(self) -> dict[Any, Any]:
        """Derived things that integrators keep here by names of their own, for as long as the equations live."""
        return {}

    @cached_property
    def kinetic_energy(self) -> Any:
        """T(q, v)."""
        return energies.kinetic_energy(self.kin)

    @cached_property
    def momentum(self) -> Any:
        """p = ∂T/∂v."""
        return ca.gradient(self.kinetic_energy, self.v)

    @cached_property
    def potential_energy(self) -> Any:
        """V(q) of gravity, springs, and forces with a potential."""
        return energies.gravity_energy(self.kin) + self._stored

    @cached_property
    def elements(self) -> ElementForces:
        """Forces that are given by functions."""
        return ElementForces(self.kin)

    @cached_property
    def _stored(self) -> Any:
        return energies.spring_energy(self.kin) + self.elements.energy

    @cached_property
    def energy_rate(self) -> Any:
        """d/dt (T + V) along (D v, a)."""
        along = ca.vertcat(self.kin.qdot, self.a)
        return ca.jtimes(self.kinetic_energy + self.potential_energy, ca.vertcat(self.q, self.v), along)

    @cached_property
    def gravity(self) -> Any:
        """g = Dᵀ ∂V_gravity/∂q."""
        return self.kin.pullback(ca.gradient(energies.gravity_energy(self.kin), self.q))

    @cached_property
    def damping(self) -> Any:
        """Forces of dampers, and of functions without a potential."""
        return energies.damping_forces(self.kin) + self.elements.force

    @cached_property
    def passive(self) -> Any:
        """Forces of springs and dampers, and those given by functions."""
        return self.damping - self.kin.pullback(ca.gradient(self._stored, self.q))

    @cached_property
    def _hamel(self) -> Any:
        parts: list[Any] = []
        for joint in self.model.independent_joints:
            part = self.model.layout.v[joint.name]
            p = [scalar(self.momentum[i]) for i in range(part.start, part.stop)]
            parts += joint.type.hamel(self.kin.velocities(joint), p)
        return ca.vertcat(ca.SX(0, 1), *parts)

    def _inertial(self, a: ca.SX) -> Any:
        """M a + C v."""
        along = ca.vertcat(self.kin.qdot, a)
        rate = ca.jtimes(self.momentum, ca.vertcat(self.q, self.v), along)
        return rate + self._hamel - self.kin.pullback(ca.gradient(self.kinetic_energy, self.q))

    @cached_property
    def coriolis_force(self) -> Any:
        """C(q, v) v."""
        return self._inertial(ca.SX(self.model.nv, 1))

    @cached_property
    def nle(self) -> Any:
        """C v + g."""
        return self.coriolis_force + self.gravity

    @cached_property
    def inverse_dynamics(self) -> Any:
        """M a + C v + g - τ_passive."""
        return self._inertial(self.a) + self.gravity - self.passive

    @cached_property
    def mass_matrix(self) -> Any:
        """M = ∂p/∂v."""
        return ca.jacobian(self.momentum, self.v)

    @cached_property
    def _coriolis_by_v(self) -> Any:
        """∂(C v)/∂v."""
        return ca.jacobian(self.coriolis_force, self.v)

    @cached_property
    def coriolis_matrix(self) -> Any:
        """Christoffel's C = ½ ∂(C v)/∂v + ½ M A(v).

        A holds the quasi-velocities' structure, -Aᵀ p = hamel(v, p): [[ω̂, v̂], [0, ω̂]] for a free joint and ω̂ for a
        ball joint, zero where v = q̇. A(v) v = 0 leaves C v as it is, and the second term makes Ṁ - 2C skew.
        """
        half = 0.5 * self._coriolis_by_v
        if not self.model.quaternions:
            return half
        A: Any = ca.SX(self.model.nv, self.model.nv)
        for joint in self.model.independent_joints:
            if joint.type.quaternion is not None:
                own = self.model.layout.v[joint.name]
                v = ca.vertsplit(self.v[own])
                rows = [joint.type.hamel(v, e) for e in np.eye(joint.type.nv).tolist()]
                A[own, own] = -ca.sparsify(ca.vertcat(*(ca.horzcat(*row) for row in rows)))
        return half + 0.5 * ca.mtimes(self.mass_matrix, A)

    @cached_property
    def generalized_force(self) -> Any:
        """τ_passive - C v - g, which accelerates a system without τ."""
        return self.passive - self.nle

    @cached_property
    def forward_dynamics(self) -> Any:
        """M⁻¹ (τ + τ_passive - C v - g), by the tree's sparse factorization or by `least_constraint`."""
        if self.least_constraint is not None:
            return self.least_constraint.accelerations(self.tau + self.passive)
        return self.over_mass(self.tau + self.generalized_force)

    @cached_property
    def least_constraint(self) -> LeastConstraint | None:
        """The orthogonal elimination, where it is chosen."""
        if self.elimination != "least constraint":
            return None
        return LeastConstraint(squares(self.kin), self.elimination_order)

    def over_mass(self, f: ca.SX) -> Any:
        """Return M⁻¹ f of right-hand sides, (nv,) or (nv, k), by the same elimination as forward dynamics."""
        if self.least_constraint is not None:
            return self.least_constraint.solve(f)
        return solve(self.mass_matrix, f, self.elimination_order)

    @cached_property
    def mass_matrix_inverse(self) -> Any:
        """M⁻¹, by the same elimination as forward dynamics."""
        return self.over_mass(ca.SX.eye(self.model.nv))

    @cached_property
    def elimination_order(self) -> tuple[int, ...]:
        """Velocity indices with every parent before its children."""
        return elimination_order(self.model)

    @cached_property
    def inverse_dynamics_derivatives(self) -> tuple[Any, Any, Any]:
        """∂ID/∂q, ∂ID/∂v and ∂ID/∂a = M, as expressions of (q, v, a).

        Column k of ∂/∂q is d/dt f(q ⊕ t e_k) at t = 0, with `Model.integrate`'s ⊕: the directional derivative along
        q̇ = D(q) e_k. Components of v, a and τ are held fixed, those in moving axes (free and ball joints) too.
        """
        tangent = ca.jacobian(self.kin.qdot, self.v)
        by_q = ca.jtimes(self.inverse_dynamics, self.q, tangent)
        return by_q, ca.jacobian(self.inverse_dynamics, self.v), self.mass_matrix

    @cached_property
    def forward_dynamics_derivatives(self) -> tuple[Any, Any, Any]:
        """∂FD/∂q = -M⁻¹ ∂ID/∂q, ∂FD/∂v = -M⁻¹ ∂ID/∂v and ∂FD/∂τ = M⁻¹, as expressions of (q, v, τ).

        From ID(q, v, FD(q, v, τ)) = τ, at a = FD (Carpentier and Mansard 2018, Analytical Derivatives of Rigid Body
        Dynamics Algorithms): forward dynamics is never differentiated through its factorization.
        """
        by_q, by_v, _ = self.inverse_dynamics_derivatives
        n = self.model.nv
        by_q, by_v = ca.substitute([by_q, by_v], [self.a], [self.forward_dynamics])
        out = self.over_mass(ca.horzcat(-by_q, -by_v, ca.SX.eye(n)))
        by_q, by_v, by_tau = ca.horzsplit(out, [0, n, 2 * n, 3 * n])
        return by_q, by_v, by_tau

    def inverse_dynamics_second_derivatives(self) -> ca.Function:
        """Return (q, v, a) -> derivatives of ∂ID/∂q by q and by v, of ∂ID/∂v by v, and of M by q, side by side.

        (nv², 4 nv): row i + nv j has those of entry (i, j). That by q is the directional derivative along q̇ = D(q) e_k.
        """
        by_q, by_v, M = (ca.vec(x) for x in self.inverse_dynamics_derivatives)
        tangent = ca.jacobian(self.kin.qdot, self.v)
        qq, Mq = (ca.mtimes(ca.jacobian(x, self.q), tangent) for x in (by_q, M))
        out = ca.horzcat(qq, ca.jacobian(by_q, self.v), ca.jacobian(by_v, self.v), Mq)
        return self.named("inverse_dynamics_second_derivatives", ("q", "v", "a"), [self.q, self.v, self.a], out)

    def parameter_derivatives(self, name: str) -> ca.Function:
        """Return the derivatives of a quantity by the named parameters, (entries, p), with entries in column order."""
        names = FUNCTIONS[name]
        p = self.parameters if self.parameters.numel() else self.constants[: len(self.model.parameters)]
        if name == "forward_dynamics" and not self.model.constrained:
            # ID(q, v, FD) = τ gives them, as with the state: never a factorization.
            (by_p,) = ca.substitute([ca.jacobian(self.inverse_dynamics, p)], [self.a], [self.forward_dynamics])
            out = self.over_mass(-by_p)
        else:
            out = ca.jacobian(ca.vec(getattr(self, name)), p)
        arguments = {"q": self.q, "v": self.v, "a": self.a, "tau": self.tau}
        return self.named(f"{name}_by_parameters", names, [arguments[n] for n in names], out)

    def function(self, name: str, frame: str | None = None, axes: str = "", kind: str = "") -> ca.Function:
        """Return a quantity as a function of its arguments, with repeated operations as they came.

        `frame`, `axes` and `kind` are those of quantities of a frame.
        """
        if name in OF_FRAME and frame is not None:
            self.model.frame(frame)
            more = {"pose": (), "acceleration": (axes, kind)}.get(name, (axes,))
            f = self.body_quantity(name, (frame,), *more)
            given = f.sx_in()
            (out,) = f.call(given)
            # Six numbers stand below each other.
            return ca.Function(name, given, [out.T if out.shape == (1, 6) else out], f.name_in(), [name])
        if name in OF_WHOLE:
            return self.body_quantity(name)
        known = FUNCTIONS | (CONSTRAINT_FUNCTIONS if self.model.constrained else {})
        if name in OF_FRAME:
            raise InputError(f"frame: {name} is of a frame; expected its name, got None")
        if name not in known:
            raise UnknownNameError("quantity", name, [*known, *OF_FRAME, *OF_WHOLE])
        symbols = {"q": self.q, "v": self.v, "a": self.a, "tau": self.force}
        names = known[name]
        return self.named(name, names, [symbols[n] for n in names], getattr(self, name))

    def stacked(self, name: str) -> ca.Function:
        """Return a quantity's several results as one matrix."""
        f = self.function(name)
        given = f.sx_in()
        return ca.Function(name, given, [ca.horzcat(*f.call(given))], f.name_in(), [name])

    @property
    def extra_arguments(self) -> dict[str, ca.SX]:
        """The last arguments of every function, by name."""
        given = {"parameters": self.parameters, "constants": self.constants}
        return {name: symbols for name, symbols in given.items() if symbols.numel()}

    def named(self, name: str, argument_names: Any, arguments: list[ca.SX], out: Any) -> ca.Function:
        """Return one dense output as a function, or a tuple of derivatives by the first arguments.

        The function takes the `extra_arguments` arguments too.
        """
        outs = out if isinstance(out, tuple) else (out,)
        labels = [f"by_{n}" for n in argument_names[: len(outs)]] if isinstance(out, tuple) else [name]
        dense = [ca.densify(x) for x in outs]
        given = {**dict(zip(argument_names, arguments, strict=True)), **self.extra_arguments}
        return ca.Function(name, list(given.values()), dense, list(given), labels)

    @cached_property
    def motion(self) -> BodyMotion:
        """Motion, momentum and loads of the bodies."""
        return BodyMotion(self.kin, self.a)

    def body_quantity(self, name: str, *extra: Any) -> ca.Function:
        """Return one of `BODY_QUANTITIES` as a function; `extra` are its names of frames and the like."""
        quantity = BODY_QUANTITIES[name]
        given = {"q": self.q, "v": self.v, "a": self.a, "tau": self.tau}
        names = quantity.arguments
        if "wrenches" in names:
            *_, frames, _ = extra
            wrenches = given["wrenches"] = ca.SX.sym("wrenches", 6 * len(frames))
            extra = (*extra, wrenches)
            # Where none acts there is no such argument.
            names = names if frames else tuple(x for x in names if x != "wrenches")
        out = quantity.make(self.motion, *extra)
        if quantity.acts_on == "inverse_dynamics":
            out = self.inverse_dynamics - out
        elif quantity.acts_on == "forward_dynamics":
            out = ca.substitute(self.forward_dynamics, self.tau, self.tau + out)
        return self.named(name, names, [given[n] for n in names], out)


class ConstrainedEquations(ConstrainedMotion, Equations):
    """The same with constraints."""
