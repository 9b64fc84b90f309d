"""A system written as energies, in the shape in which engines, simulation and studies take a model."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, partial
from html import escape
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import sympy as sp

from mbkit._check import Array, count, real
from mbkit.derivation.equations import Equations
from mbkit.derivation.values import Constants, Values
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.lagrangian.constraints import ConstraintTerms, Manifold, manifold_of
from mbkit.lagrangian.conversion import Conversion
from mbkit.lagrangian.multipliers import constrained, derivatives
from mbkit.lagrangian.redundancy import require_independent
from mbkit.model import Model
from mbkit.model.needs import Needs
from mbkit.model.parts import Body, Frame, Joint

if TYPE_CHECKING:
    from mbkit.lagrangian.system import Lagrangian

__all__ = ["WrittenEquations", "WrittenModel", "abstract_parts"]

#: Random states that are tried, of which each may be too far from the constraints.
_DRAWS = 50


class WrittenModel(Model):
    """A `Lagrangian` as a model: coordinates that add, named parameters, and no bodies.

    Parameters
    ----------
    system : Lagrangian
    values : mapping of str to float or None, optional
        Of its parameters, instead of their own.
    """

    def __init__(self, system: Lagrangian, values: Mapping[str, float | None] | None = None) -> None:
        bodies, joints = abstract_parts([q.name for q in system.coordinates])
        # The parts of a frozen class are set once, here.
        put = object.__setattr__
        put(self, "system", system)
        put(self, "_values", dict(values or {s.name: x for s, x in system.parameters.items()}))
        super().__init__(system.name, np.zeros(3), bodies, joints)

    system: Lagrangian
    _values: dict[str, float | None]

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.system, self._values)

    @property
    def written(self) -> Callable[..., WrittenEquations]:
        """What makes the equations: a function of how numbers stand in them."""
        return partial(WrittenEquations, self)

    @property
    def clock(self) -> str | None:
        """Name of the time, a parameter that simulation moves."""
        return self.system.time.name if self.system.time is not None else None

    @property
    def constrained(self) -> bool:
        """Whether constraints bind the coordinates to each other."""
        return bool(self.system.constraints)

    @cached_property
    def parameters(self) -> Mapping[str, float | None]:
        """Value of each named parameter, None where it has none; the time is the last of them."""
        time = {self.clock: self._values.get(self.clock, 0.0)} if self.clock else {}
        return MappingProxyType({**self._values, **time})

    @property
    def mass(self) -> float:
        """Not known: energies do not tell."""
        raise UnsupportedError(f"mass: {self.name} was written as energies and has no bodies")

    @cached_property
    def needs(self) -> Needs:
        """Damping where a force or dissipation stands; energies tell nothing else apart."""
        s = self.system
        flags = dict.fromkeys(Needs.__dataclass_fields__, False)
        return Needs(**{**flags, "damping": any(x != 0 for x in (s.dissipation, *s.forces))})

    @cached_property
    def digest(self) -> str:
        """SHA-256 over the expressions and the values of the parameters."""
        return _sha(self._form, *(f"{n}={x!r}" for n, x in self.parameters.items()))

    @cached_property
    def form_digest(self) -> str:
        """The digest without the values."""
        return _sha(self._form, *self.parameters)

    @cached_property
    def _form(self) -> str:
        s = self.system
        parts = (s.T, s.V, s.dissipation, s.forces, s.constraints, s.coordinates, s.velocities, s.time)
        return "\n".join((s.name, *(sp.srepr(sp.sympify(x)) for x in parts)))

    def with_nominal(self, values: Mapping[str, Any]) -> WrittenModel:
        """Return the same system at other values of its parameters."""
        for name in values:
            if name not in self.parameters:
                raise UnknownNameError("parameter", name, self.parameters)
        moved = {n: real(f"parameter {n!r}", x) for n, x in values.items()}
        out = object.__new__(type(self))
        # Nothing but the values differs: what was derived from the rest is kept.
        kept = {k: x for k, x in self.__dict__.items() if k not in ("parameters", "digest", "_states")}
        out.__dict__.update(kept, _values={**self._values, **moved})
        return out

    def with_parameters(self, /, **values: float) -> WrittenModel:
        """Return the same system with plain numbers for some or all parameters."""
        return self.with_nominal(values).system_at(tuple(values))

    def system_at(self, names: tuple[str, ...]) -> WrittenModel:
        """Return the model in which these parameters are the numbers that they have now."""
        own = {s.name: s for s in self.system.parameters}
        numbers = {own[n]: sp.Float(self.parameters[n], 17) for n in names if n in own}
        return self.system.substituted(numbers).model

    def without(self, *features: str) -> Model:
        """Return the same system less its damping; energies do not tell what else there is."""
        if set(features) == {"damping"}:
            return self.system.conservative().model
        raise UnsupportedError(
            f"without: {self.name} was written as energies, of which only 'damping' can be left out, got {features}"
        )

    def random_state(self, rng: np.random.Generator, size: int | None = None) -> tuple[Array, Array]:
        """Draw a random state as `Model.random_state` does; under constraints the consistent one that is nearest."""
        if not self.constrained:
            return super().random_state(rng, size)
        drawn = [self._consistent_state(rng) for _ in range(1 if size is None else count("size", size))]
        q, v = np.array(drawn).reshape(len(drawn), 2, self.nv).transpose(1, 0, 2)
        return (q[0], v[0]) if size is None else (q, v)

    def _consistent_state(self, rng: np.random.Generator) -> tuple[Array, Array]:
        for _ in range(_DRAWS):
            # From some places there is no way to the constraints.
            with suppress(InputError):
                return self._states.project(*super().random_state(rng))
        self.require_independent()
        return self._states.project(*super().random_state(rng))

    def require_independent(self) -> None:
        """Refuse constraints that follow from each other or contradict each other, with the rows.

        Not while a parameter has no value, of which it may depend.
        """
        if self.constrained and None not in self.parameters.values():
            require_independent(LagrangianDynamics(self, compile=False))

    @cached_property
    def _states(self) -> Manifold:
        return manifold_of(LagrangianDynamics(self, compile=False))

    def frame(self, name: str) -> Frame:
        """Refuse: energies have no frames."""
        raise UnsupportedError(f"frame {name!r}: {self.name} was written as energies and has no frames")

    def __repr__(self) -> str:
        return f"<WrittenModel {self.name!r}: coordinates {', '.join(self.coordinate_names)}>"

    def _repr_html_(self) -> str:
        return f"<p><b>{escape(self.name)}</b>: {self.system._repr_latex_()}</p>"


class WrittenEquations(Equations):
    """The equations of a `WrittenModel`, derived from its T and V as those of a robot are."""

    model: WrittenModel

    def __init__(self, model: WrittenModel, constants: Constants = "literal") -> None:
        values = Values(model, constants)
        self.model = model
        self.q, self.v = ca.SX.sym("q", model.nq), ca.SX.sym("v", model.nv)
        self.a, self.tau = ca.SX.sym("a", model.nv), ca.SX.sym("tau", model.nv)
        s = model.system
        names = {**{p: values.named[p.name] for p in s.parameters}}
        names |= {c: self.q[i] for i, c in enumerate(s.coordinates)}
        names |= {w: self.v[i] for i, w in enumerate(s.velocities)}
        self.time = values.named[model.clock] if model.clock else None
        if s.time is not None:
            names[s.time] = values.named[s.time.name]
        read = Conversion(names, values.number)
        self._T, self._V, self._R = ca.SX(read(s.T)), ca.SX(read(s.V)), ca.SX(read(s.dissipation))
        self._Q = read.matrix(s.forces)
        self.constraints = ConstraintTerms(read.matrix(s.constraints), self.q, self.v, self.time)
        self._kinematics(read)
        self.parameters = values.parameters
        self.constants, self.constant_values = values.constants, values.constant_values

    def _kinematics(self, read: Conversion) -> None:  # noqa: ARG002  # quasi-velocities have something to read
        """Set what velocities are to coordinates: their rates."""
        self.kin = SimpleNamespace(qdot=self.v, pullback=lambda x: x)  # type: ignore[assignment]

    def _turned(self, p: Any) -> Any:  # noqa: ARG002
        """Return what quasi-velocities add to the rate of a momentum."""
        return 0

    @property
    def kinetic_energy(self) -> Any:
        """T(q, v)."""
        return self._T

    @property
    def potential_energy(self) -> Any:
        """V(q)."""
        return self._V

    @cached_property
    def gravity(self) -> Any:
        """∂V/∂q, whatever it comes from."""
        return self.kin.pullback(ca.gradient(self._V, self.q))

    @cached_property
    def damping(self) -> Any:
        """Q - ∂R/∂v."""
        return self._Q - ca.gradient(self._R, self.v)

    @property
    def passive(self) -> Any:
        """The same: springs are in V."""
        return self.damping

    @cached_property
    def energy_rate(self) -> Any:
        """d/dt (T + V) along (v, a), with the time's own part."""
        E = self._T + self._V
        rate = ca.jtimes(E, ca.vertcat(self.q, self.v), ca.vertcat(self.kin.qdot, self.a))
        return rate if self.time is None else rate + ca.gradient(E, self.time)

    def _inertial(self, a: ca.SX) -> Any:
        """D/dt ∂T/∂v - ∂T/∂q: M a + C v + d."""
        rate = ca.jtimes(self.momentum, ca.vertcat(self.q, self.v), ca.vertcat(self.kin.qdot, a))
        if self.time is not None:
            rate += ca.jacobian(self.momentum, self.time)
        return rate + self._turned(self.momentum) - self.kin.pullback(ca.gradient(self._T, self.q))

    @cached_property
    def coriolis_force(self) -> Any:
        """C(q, v) v, of T2 alone."""
        T2 = 0.5 * ca.dot(self.v, ca.mtimes(self.mass_matrix, self.v))
        p = ca.mtimes(self.mass_matrix, self.v)
        rate = ca.jtimes(p, self.q, self.kin.qdot) + self._turned(p)
        return rate - self.kin.pullback(ca.gradient(T2, self.q))

    @cached_property
    def nle(self) -> Any:
        """C v + d + ∂V/∂q."""
        return self._inertial(ca.SX(self.model.nv, 1)) + self.gravity

    @cached_property
    def _constrained(self) -> tuple[Any, Any]:
        return constrained(self)

    @property
    def multipliers(self) -> Any:
        """λ(q, v, τ) of the constraints."""
        return self._constrained[1]

    @cached_property
    def forward_dynamics(self) -> Any:
        """M⁻¹ (τ + τ_passive - nle + Jᵀ λ); every other term of the equation is the one without constraints."""
        if not self.model.constrained:
            return super().forward_dynamics
        self.model.require_independent()
        return self._constrained[0]

    @cached_property
    def forward_dynamics_derivatives(self) -> tuple[Any, Any, Any]:
        """∂FD/∂q, ∂FD/∂v and ∂FD/∂τ, under the constraints."""
        return derivatives(self) if self.model.constrained else super().forward_dynamics_derivatives

    @property
    def elimination_order(self) -> tuple[int, ...]:
        """The coordinates as they stand."""
        return tuple(range(self.model.nv))

    def _frame(self, name: str) -> tuple[str, Any]:
        raise UnsupportedError(f"frame {name!r}: {self.model.name} was written as energies and has no frames")


def abstract_parts(names: Sequence[str]) -> tuple[tuple[Body, ...], tuple[Joint, ...]]:
    """Return what gives a model coordinates of these names, and nothing else."""
    # One coordinate a joint, each on the one before: the pattern of a full mass matrix.
    joints = tuple(_coordinate(name, before) for name, before in zip(names, ["world", *names], strict=False))
    return tuple(_massless(name) for name in names), joints


def _coordinate(name: str, before: str) -> Joint:
    zero, endless = np.zeros(1), np.full(1, np.inf)
    return Joint(
        name=name,
        kind="prismatic",
        parent=before,
        child=name,
        rotation=np.eye(3),
        translation=np.zeros(3),
        axes=np.array([[1.0, 0.0, 0.0]]),
        pitch=0.0,
        lower=-endless,
        upper=endless,
        velocity_limit=endless,
        effort_limit=endless,
        armature=zero,
        damping=zero,
        friction=zero,
        stiffness=zero,
        rest=zero,
    )


def _massless(name: str) -> Body:
    return Body(name=name, mass=0.0, com=np.zeros(3), inertia=np.zeros((3, 3)))


def _sha(*parts: str) -> str:
    total = hashlib.sha256()
    for part in parts:
        total.update(part.encode() + b"\0")
    return total.hexdigest()
