"""`EnergyModel`: a `Model` defined by T and V instead of bodies."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._attributes import forwarded
from mbkit._check import Array, batch_of, real
from mbkit._escape import html, one_line
from mbkit.errors import UnsupportedError, require_known
from mbkit.lagrangian.energies.energy_form import EnergyForm
from mbkit.lagrangian.energies.symbols import plain
from mbkit.lagrangian.energies.sympy_to_casadi import EnergyEquations, VelocityMap
from mbkit.lagrangian.printer import ExpressionPrinter
from mbkit.model import Model
from mbkit.model.elements.kinds import Needs
from mbkit.model.joint_types import PRISMATIC
from mbkit.model.parts import Body, Frame, Joint


def energies_latex(form: EnergyForm) -> str:
    """Return T, V and the stops as inline LaTeX."""
    board = ExpressionPrinter(form.coordinates, form.velocities, time=form.time)
    stops = "".join(rf",\quad {board.latex(g)} \ge 0" for g in form.stops)
    return f"$T = {board.latex(form.T)},\\quad V = {board.latex(form.V)}{stops}$"


# Bodies and joints of a model that has coordinates only


def abstract_parts(names: Sequence[str]) -> tuple[tuple[Body, ...], tuple[Joint, ...]]:
    """Return massless bodies and prismatic joints of these names."""
    # One coordinate a joint, each on the one before: the pattern of a full mass matrix.
    joints = tuple(
        Joint._of(name, PRISMATIC.name, before, name, np.eye(3), np.zeros(3), axes=np.eye(3)[:1])
        for name, before in zip(names, ["world", *names], strict=False)
    )
    return tuple(Body(name, 0.0, np.zeros(3), np.zeros((3, 3))) for name in names), joints


class EnergyModel(Model):
    """A system of energies as a model: coordinates that add, named parameters, and no bodies.

    To run quasi-velocities, D must hold coordinates and numbers only (UnsupportedError).
    """

    def __init__(self, form: EnergyForm, values: Mapping[str, float | None] | None = None) -> None:
        rate_symbols = form.quasi.D.free_symbols - set(form.coordinates) if form.quasi is not None else set()
        if form.quasi is not None and (any(form.quasi.drift) or form.clock in rate_symbols):
            raise UnsupportedError(
                f"quasi_velocities: {form.name} runs with q̇ = D(q) w, without time in D and without drift; run its "
                ".system, the same in the coordinates' rates, and read w by to_quasi_velocity"
            )
        if rate_symbols:
            raise UnsupportedError(
                f"D: to run, it must hold coordinates and numbers only, but it holds {plain(rate_symbols)}; "
                f"put numbers in first: substituted({{{min(rate_symbols, key=str)}: ...}})"
            )
        bodies, joints = abstract_parts([q.name for q in form.coordinates])
        # The parts of a frozen class are set once, here.
        put = object.__setattr__
        put(self, "form", form)
        put(self, "_values", dict(values or {s.name: x for s, x in form.parameters.items()}))
        super().__init__(form.name, np.zeros(3), bodies, joints)

    form: EnergyForm
    _values: dict[str, float | None]

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.form, self._values)

    @property
    def energy_equations(self) -> Callable[..., EnergyEquations]:
        """The function that derives the equations, of how numbers stand in them."""
        return partial(EnergyEquations, self, self.form)

    @property
    def time_parameter(self) -> str | None:
        """Name of the time, a parameter that simulation moves."""
        return self.form.time.name if self.form.time is not None else None

    jumping_forces: tuple[str, ...] = forwarded("form.jumps", "Forces that jump where a velocity changes its sign.")

    @property
    def constrained(self) -> bool:
        """Whether constraints bind the coordinates to each other."""
        return bool(self.form.multiplier_symbols)

    @property
    def holds_velocities(self) -> bool:
        """Whether some constraints hold velocities alone."""
        return bool(self.form.velocity_constraints)

    @property
    def constraints_do_work(self) -> bool:
        """Whether constraints may feed energy: those that depend on the time or prescribe a speed."""
        return self.time_parameter is not None or any(self.form.velocity_rows[1])

    @cached_property
    def velocity_map(self) -> VelocityMap | None:
        """q̇ = D(q) v of quasi-velocities; None where v is q̇."""
        return None if self.form.quasi is None else VelocityMap(self.form.quasi)

    @cached_property
    def velocity_names(self) -> tuple[str, ...]:
        """Names of the quasi-velocities, or of the coordinates."""
        return self.coordinate_names if self.form.quasi is None else tuple(w.name for w in self.form.velocities)

    @cached_property
    def parameters(self) -> Mapping[str, float | None]:
        """Value of each named parameter, None where it has none; the time is the last of them."""
        t = self.time_parameter
        time = {t: self._values.get(t, 0.0)} if t else {}
        return MappingProxyType({**self._values, **time})

    @property
    def mass(self) -> float:
        """Unknown for energies."""
        raise UnsupportedError(f"mass: {self.name} was written as energies and has no bodies")

    @cached_property
    def needs(self) -> Needs:
        """Damping where there is a force or dissipation, time, and constraints; energies separate no other features."""
        s = self.form
        flags = dict.fromkeys(Needs.__dataclass_fields__, False)
        flags |= {"damping": any(x != 0 for x in (s.dissipation, *s.forces)), "time": s.time is not None}
        return Needs(**flags | {"loops": bool(s.constraints), "no_slip": self.holds_velocities, "stops": bool(s.stops)})

    @cached_property
    def digest(self) -> str:
        """SHA-256 over the expressions and the values of the parameters, whatever the time is."""
        values = {**self.parameters, **({self.time_parameter: 0.0} if self.time_parameter else {})}
        return _sha(self._expressions, *(f"{n}={x!r}" for n, x in values.items()))

    @cached_property
    def form_digest(self) -> str:
        """The digest without the values."""
        return _sha(self._expressions, *self.parameters)

    @cached_property
    def _expressions(self) -> str:
        s = self.form
        parts = [s.T, s.V, s.dissipation, s.forces, s.constraints, s.coordinates, s.velocities, s.time]
        parts += [] if s.quasi is None else [s.quasi.D]
        parts += [s.velocity_constraints] if s.velocity_constraints else []
        parts += [s.stops, s.restitution] if s.stops else []
        return "\n".join((s.name, *(sp.srepr(sp.sympify(x)) for x in parts)))

    def with_nominal(self, values: Mapping[str, Any]) -> EnergyModel:
        """Return the same system at other values of its parameters."""
        require_known("parameter", self.parameters, *values)
        moved = {n: real(f"parameter {n!r}", x) for n, x in values.items()}
        out = object.__new__(type(self))
        # Nothing but the values differs: what was derived from the rest is kept.
        attributes = {k: x for k, x in self.__dict__.items() if k not in ("parameters", "digest")}
        out.__dict__.update(attributes, _values={**self._values, **moved})
        return out

    def with_parameters(self, /, **values: float) -> EnergyModel:
        """Return the same system with plain numbers for some or all parameters."""
        return self.with_nominal(values).system_at(tuple(values))

    def system_at(self, names: tuple[str, ...]) -> EnergyModel:
        """Return the model in which these parameters are the numbers that they have now."""
        own = {s.name: s for s in self.form.parameters}
        numbers = {own[n]: sp.Float(self.parameters[n], 17) for n in names if n in own}
        return EnergyModel(self.form.substituted(numbers))

    def without(self, *features: str) -> Model:
        """Return the same system less its damping; energies do not separate other features."""
        if set(features) == {"damping"}:
            return EnergyModel(self.form.conservative())
        raise UnsupportedError(
            f"without: {self.name} was written as energies, of which only 'damping' can be left out, got {features}"
        )

    def integrate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """Return q + D(q) dq: the configuration that a displacement dq in the space of v leads to."""
        if self.velocity_map is None:
            return super().integrate(q, dq)
        q, dq = self.check_q(q), self.check_v(dq, "dq")
        batch_of(q=q, dq=dq)
        return np.asarray(q + self.velocity_map.to_integrator_velocity(q, dq))

    def difference(self, q0: ArrayLike, q1: ArrayLike) -> Array:
        """Return the dq with ``integrate(q0, dq) = q1``."""
        if self.velocity_map is None:
            return super().difference(q0, q1)
        q0, q1 = self.check_q(q0, "q0"), self.check_q(q1, "q1")
        batch_of(q0=q0, q1=q1)
        return np.asarray(self.velocity_map.to_body_velocity(q0, q1 - q0))

    def frame(self, name: str) -> Frame:
        """Refuse: energies have no frames."""
        raise UnsupportedError(f"frame {name!r}: {self.name} was written as energies and has no frames")

    def __repr__(self) -> str:
        return one_line(f"<EnergyModel {self.name!r}: coordinates {', '.join(self.coordinate_names)}>")

    def _repr_html_(self) -> str:
        return f"<p><b>{html(self.name)}</b>: {html(energies_latex(self.form))}</p>"


def _sha(*parts: str) -> str:
    total = hashlib.sha256()
    for part in parts:
        total.update(part.encode() + b"\0")
    return total.hexdigest()
