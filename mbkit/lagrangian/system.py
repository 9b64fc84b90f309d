"""`Lagrangian`: a system written down as energies, and all that mechanics says about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import sympy as sp

from mbkit._check import real
from mbkit.errors import InputError
from mbkit.lagrangian import cyclic
from mbkit.lagrangian.constrained import Constrained
from mbkit.lagrangian.cyclic import ConservedQuantity
from mbkit.lagrangian.degree import KineticSplit, split
from mbkit.lagrangian.motion import EquationsOfMotion, christoffel
from mbkit.lagrangian.symbols import Plain, acceleration_of, plain, velocity_of
from mbkit.lagrangian.tidy import tidy_matrix

if TYPE_CHECKING:
    from mbkit.engines import Dynamics
    from mbkit.lagrangian.hamilton import Hamiltonian
    from mbkit.lagrangian.quasi import QuasiLagrangian
    from mbkit.lagrangian.routh import Routhian
    from mbkit.lagrangian.written import WrittenModel

__all__ = ["Lagrangian"]


class Lagrangian(Constrained):
    """A system as its energies in generalized coordinates, to read and to run.

    Parameters
    ----------
    T : sympy.Expr
        Kinetic energy, of second degree in the velocities at most; J.
    V : sympy.Expr
        Potential energy, of coordinates, parameters and time; J.
    coordinates : sequence of sympy symbols
        Plain symbols, or `sympy.physics.mechanics.dynamicsymbols`.
    velocities : sequence of sympy symbols, optional
        One per coordinate: q̇. When not given, the derivatives of dynamicsymbols, or
        symbols named like the coordinates: ``theta1`` has ``thetadot1``.
    time : sympy.Symbol, optional
        Where T, V, a force or a constraint depends on it. Dynamicsymbols bring their own.
    forces : mapping of coordinate to sympy.Expr, optional
        Generalized forces beside V's, of coordinates, velocities, time and parameters.
        A symbol that stands alone and nowhere else is an input: it is that coordinate's
        entry of ``tau`` when the equation is run.
    dissipation : sympy.Expr, optional
        Rayleigh's function R of the velocities; the force is -∂R/∂v.
    parameters : mapping of sympy.Symbol to float or None, or sequence of symbols, optional
        Every other symbol, with its value where it has one.
    constraints : sequence of sympy.Expr, optional
        Holonomic: f(q, t) = 0 each.
    name : str

    Attributes
    ----------
    T, V, dissipation : sympy.Expr
    coordinates, velocities, accelerations : tuple of sympy.Symbol
        Plain symbols, whatever was given.
    time : sympy.Symbol or None
        Where something depends on it.
    forces : (n, 1) sympy.Matrix
        Without the dissipation.
    inputs : mapping of coordinate to sympy.Symbol
        The symbols that stand for ``tau``.
    parameters : mapping of sympy.Symbol to float or None
    constraints : tuple of sympy.Expr

    Raises
    ------
    InputError
        T of another degree (the term is named), a velocity without its coordinate, symbols
        that are not declared (they are named), a mass matrix that is singular everywhere.

    Examples
    --------
    >>> import sympy as sp
    >>> import mbkit as mb
    >>> th, w, m, l, g, u = sp.symbols("theta omega m l g tau")
    >>> T, V = m * l**2 * w**2 / 2, -m * g * l * sp.cos(th)
    >>> lag = mb.lagrangian.Lagrangian(T, V, [th], [w], forces={th: u}, parameters={m: 1.0, l: 1.0, g: 9.81})
    >>> print(lag.equations())
    l**2*m*omegadot + g*l*m*sin(theta) = tau
    """

    def __init__(
        self,
        T: Any,
        V: Any = 0,
        coordinates: Sequence[Any] = (),
        velocities: Sequence[Any] | None = None,
        *,
        time: sp.Symbol | None = None,
        forces: Mapping[Any, Any] | None = None,
        dissipation: Any = 0,
        parameters: Mapping[sp.Symbol, float | None] | Iterable[sp.Symbol] | None = None,
        constraints: Sequence[Any] = (),
        name: str = "system on paper",
    ) -> None:
        into = Plain(coordinates, velocities, time, among=getattr(T, "free_symbols", ()))
        self.name = name
        self.coordinates, self.velocities, self.time = into.coordinates, into.velocities, into.time
        # A velocity of a name of its own, such as omega, has its derivative named after it.
        self.accelerations = tuple(
            acceleration_of(q) if w.name == velocity_of(q).name else velocity_of(w)
            for q, w in zip(self.coordinates, self.velocities, strict=True)
        )
        self.parameters = _parameters(parameters)
        self.T, self.V = into("T", T), into("V", V)
        self.dissipation = into("dissipation", dissipation)
        given = _forces(into, forces or {}, self.coordinates)
        self.constraints = tuple(into(f"constraints[{k}]", c) for k, c in enumerate(constraints))
        # Dynamicsymbols bring a time that need not enter by itself.
        held = (self.T, self.V, self.dissipation, *given.values(), *self.constraints)
        if not any(self.time in x.free_symbols for x in held):
            self.time = None
        self.inputs = self._inputs(given)
        self.forces = sp.ImmutableMatrix([x if q not in self.inputs else 0 for q, x in given.items()])
        self._check()

    def _inputs(self, given: Mapping[sp.Symbol, sp.Expr]) -> Mapping[sp.Symbol, sp.Symbol]:
        known = {*self.coordinates, *self.velocities, *self.parameters, *([self.time] if self.time else [])}
        elsewhere: set[Any] = set().union(
            *(x.free_symbols for x in (self.T, self.V, self.dissipation, *self.constraints))
        )
        counts: dict[Any, int] = {}
        for x in given.values():
            for s in x.free_symbols:
                counts[s] = counts.get(s, 0) + 1
        return MappingProxyType(
            {
                q: x
                for q, x in given.items()
                if isinstance(x, sp.Symbol) and x not in known and x not in elsewhere and counts[x] == 1
            }
        )

    def _check(self) -> None:
        q, w = set(self.coordinates), set(self.velocities)
        t = {self.time} if self.time else set()
        known = q | w | t | set(self.parameters)
        parts = {"T": self.T, "V": self.V, "dissipation": self.dissipation}
        parts |= {f"forces[{c}]": x for c, x in zip(self.coordinates, self.forces, strict=True)}
        parts |= {f"constraints[{k}]": x for k, x in enumerate(self.constraints)}
        unknown = {s for x in parts.values() for s in x.free_symbols} - known
        if unknown:
            where = ", ".join(n for n, x in parts.items() if x.free_symbols & unknown)
            first = min(unknown, key=lambda s: s.name)
            raise InputError(
                f"parameters: {plain(unknown)} stands in {where} and is not declared; "
                f"add {first}=... to it as parameters={{{first}: 1.0}}, or with None for no value yet"
            )
        clash = set(self.parameters) & (q | w | t)
        if clash:
            raise InputError(f"parameters: {plain(clash)} is a coordinate, a velocity or the time already")
        for part in ("V", *(f"constraints[{k}]" for k in range(len(self.constraints)))):
            moving = parts[part].free_symbols & w
            if moving:
                raise InputError(
                    f"{part}: expected coordinates, time and parameters only, got the velocity {plain(moving)}"
                )
        # Coordinates that move no mass can still be bound to some that do.
        idle = [w for i, w in enumerate(self.velocities) if not any(self.kinetic.M[i, :])]
        if idle and not self.constraints:
            raise InputError(f"T: the mass matrix is singular everywhere: no kinetic energy has {plain(idle)}")
        if not self.constraints and self.kinetic.M.shape[0] <= 4 and self.kinetic.M.det(method="berkowitz") == 0:
            raise InputError(
                f"T: its mass matrix {self.kinetic.M.tolist()} is singular everywhere; a velocity is missing"
            )

    # The parts

    @cached_property
    def kinetic(self) -> KineticSplit:
        """T = T2 + T1 + T0, with M and b."""
        return split(self.T, self.velocities)

    def kinetic_split(self) -> tuple[sp.Expr, sp.Expr, sp.Expr]:
        """Return T2, T1 and T0: T's parts of second, first and zeroth degree in the velocities."""
        k = self.kinetic
        return k.T2, k.T1, k.T0

    @cached_property
    def momenta(self) -> sp.ImmutableMatrix:
        """p = ∂T/∂v, (n, 1)."""
        return tidy_matrix(self.kinetic.M * sp.Matrix(self.velocities) + self.kinetic.b)

    @property
    def L(self) -> sp.Expr:
        """T - V."""
        return self.T - self.V

    @cached_property
    def _equations(self) -> EquationsOfMotion:
        q, v, k = self.coordinates, sp.Matrix(self.velocities), self.kinetic
        t = self.time
        drift = sp.zeros(len(q), 1)
        if any(k.b) or k.T0 != 0:
            curl = k.b.jacobian(q)
            drift += (curl - curl.T) * v - sp.Matrix([sp.diff(k.T0, x) for x in q])
        if t is not None:
            drift += sp.diff(k.M, t) * v + sp.diff(k.b, t)
        friction = [sp.diff(self.dissipation, w) for w in self.velocities]
        inputs = [self.inputs.get(x, sp.Integer(0)) for x in q]
        forces = sp.Matrix(self.forces) + sp.Matrix(inputs) - sp.Matrix(friction)
        m = len(self.constraints)
        f = sp.Matrix(m, 1, self.constraints)
        jacobian = f.jacobian(q) if m else sp.zeros(0, len(q))
        by_time = sp.zeros(m, 1) if t is None else sp.diff(f, t)
        rate = jacobian * v + by_time
        gamma = rate.jacobian(q) * v + (sp.zeros(m, 1) if t is None else sp.diff(rate, t)) if m else rate
        return EquationsOfMotion(
            coordinates=q,
            velocities=self.velocities,
            accelerations=self.accelerations,
            mass_matrix=k.M,
            coriolis_matrix=christoffel(k.M, q, self.velocities),
            drift=tidy_matrix(drift),
            potential_gradient=tidy_matrix([sp.diff(self.V, x) for x in q]),
            forces=tidy_matrix(forces),
            constraint_jacobian=sp.ImmutableMatrix(jacobian),
            constraint_acceleration=tidy_matrix(gamma),
            constraints=sp.ImmutableMatrix(f),
            multipliers=tuple(sp.Symbol(f"lambda{i + 1}") for i in range(m)),
        )

    def equations(self) -> EquationsOfMotion:
        """Return the equation of motion, frozen: its matrices, and `latex()` and `explicit()`."""
        return self._equations

    # What it keeps, and other forms of it

    def cyclic_coordinates(self) -> tuple[sp.Symbol, ...]:
        """Return the coordinates that L does not hold and along which nothing acts: their momenta are constant."""
        return cyclic.cyclic_coordinates(self)[1]

    def forced_cyclic_coordinates(self) -> dict[sp.Symbol, sp.Expr]:
        """Return the other coordinates that L does not hold, each with the force that acts along it."""
        return {q: force for q, force in cyclic.cyclic_coordinates(self)[0].items() if force != 0}

    def conserved_momenta(self) -> dict[sp.Symbol, sp.Expr]:
        """Return p = ∂L/∂v of each cyclic coordinate, by coordinate."""
        return cyclic.conserved_momenta(self)

    def conserved_quantities(self) -> tuple[ConservedQuantity, ...]:
        """Return what is constant along every motion: those momenta, and the energy or Jacobi's integral."""
        return cyclic.conserved_quantities(self)

    @property
    def energy_function(self) -> sp.Expr:
        """h = vᵀ ∂L/∂v - L = T2 - T0 + V: Jacobi's integral, the energy T + V where T = T2."""
        return cyclic.energy_function(self)

    def routhian(self, cyclic: sp.Symbol | Sequence[sp.Symbol] | None = None) -> Routhian:
        """Return Routh's reduction: the same system less its cyclic coordinates, or those given.

        Raises
        ------
        InputError
            One is not cyclic or a force acts along it; none is, or none would remain.
        """
        from mbkit.lagrangian.routh import routhian

        return routhian(self, cyclic)

    def hamiltonian(self) -> Hamiltonian:
        """Return Hamilton's function H(q, p, t) with its canonical equations.

        Raises
        ------
        UnsupportedError
            Constraints act on the system.
        """
        return self._hamiltonian

    @cached_property
    def _hamiltonian(self) -> Hamiltonian:
        from mbkit.lagrangian.hamilton import hamiltonian

        return hamiltonian(self)

    def quasi_velocities(self, D: sp.Matrix, names: str | Sequence[str | sp.Symbol] | None = None) -> QuasiLagrangian:
        """Return the same system in velocities w that are no coordinates' rates: q̇ = D(q) w.

        Parameters
        ----------
        D : (n, n) sympy.Matrix
            Of coordinates (and parameters), one row per coordinate.
        names : str or sequence of str or sympy.Symbol, optional
            Of w; ``w1``, ``w2``, ... when not given.

        Raises
        ------
        InputError
            D of another shape, with other symbols, or singular everywhere.
        UnsupportedError
            Constraints act on the system.
        """
        from mbkit.lagrangian.quasi import QuasiLagrangian

        return QuasiLagrangian(self, D, names)

    # Variants

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Lagrangian, **self._given()), ()

    def _given(self) -> dict[str, Any]:
        return {
            "T": self.T,
            "V": self.V,
            "coordinates": self.coordinates,
            "velocities": self.velocities,
            "time": self.time,
            "forces": {q: self.inputs.get(q, x) for q, x in zip(self.coordinates, self.forces, strict=True)},
            "dissipation": self.dissipation,
            "parameters": dict(self.parameters),
            "constraints": self.constraints,
            "name": self.name,
        }

    def _like(self, **changes: Any) -> Lagrangian:
        return Lagrangian(**{**self._given(), **changes})

    def substituted(self, values: Mapping[sp.Symbol, Any]) -> Lagrangian:
        """Return the same system with numbers for some parameters."""
        for s in values:
            if s not in self.parameters:
                raise InputError(f"values: {s} is no parameter; they are {plain(self.parameters) or 'none'}")
        put = {s: sp.sympify(x) for s, x in values.items()}
        forces = {q: self.inputs.get(q, x.subs(put)) for q, x in zip(self.coordinates, self.forces, strict=True)}
        return self._like(
            T=self.T.subs(put),
            V=self.V.subs(put),
            dissipation=self.dissipation.subs(put),
            forces=forces,
            constraints=[c.subs(put) for c in self.constraints],
            parameters={s: x for s, x in self.parameters.items() if s not in put},
        )

    def conservative(self) -> Lagrangian:
        """Return the same system without dissipation and forces; inputs stay."""
        return self._like(dissipation=0, forces=dict(self.inputs))

    # Running it

    @cached_property
    def model(self) -> WrittenModel:
        """The system as engines take it: ``mb.dynamics(lag.model, "lagrangian")``."""
        from mbkit.lagrangian.written import WrittenModel

        return WrittenModel(self)

    def dynamics(
        self, engine: str = "lagrangian", *, options: Mapping[str, Any] | None = None, **values: float
    ) -> Dynamics:
        """Return the compiled dynamics, which `simulate`, `compare` and `work_precision` take.

        Parameters
        ----------
        engine : {"lagrangian", "oracle"}
            Machine code in double, or 34 digits.
        options : mapping, optional
            Of `mbkit.dynamics`, such as ``{"compile": False}``.
        **values
            Of parameters, by name; the others keep theirs.
        """
        from mbkit.engines import dynamics

        made = dynamics(self.model, engine, **(options or {}))
        return made.at(**values) if values else made

    # Reading

    def __repr__(self) -> str:
        return f"<Lagrangian {self.name!r}: coordinates {', '.join(map(str, self.coordinates))}>"

    def _repr_latex_(self) -> str:
        return f"$T = {sp.latex(self.T)},\\quad V = {sp.latex(self.V)}$"


def _parameters(given: Any) -> Mapping[sp.Symbol, float | None]:
    pairs = given.items() if isinstance(given, Mapping) else ((s, None) for s in given or ())
    out: dict[sp.Symbol, float | None] = {}
    for symbol, value in pairs:
        if not isinstance(symbol, sp.Symbol):
            raise InputError(f"parameters: expected SymPy symbols, got {symbol!r}")
        if any(s.name == symbol.name for s in out):
            raise InputError(f"parameters: {symbol.name!r} stands twice")
        out[symbol] = None if value is None else real(f"parameter {symbol}", value)
    return MappingProxyType(out)


def _forces(into: Plain, given: Mapping[Any, Any], coordinates: Sequence[sp.Symbol]) -> dict[sp.Symbol, sp.Expr]:
    out: dict[sp.Symbol, sp.Expr] = dict.fromkeys(coordinates, sp.Integer(0))
    for key, value in given.items():
        coordinate = into("forces", key)
        if coordinate not in out:
            raise InputError(f"forces: {key} is no coordinate; the coordinates are {', '.join(map(str, coordinates))}")
        out[coordinate] = into(f"forces[{key}]", value)
    return out
