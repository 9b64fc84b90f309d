"""Conserved quantities, Hamilton's function and the canonical equations of a system written as energies.

With p = ∂T/∂v = M v + b the Legendre transform of L = T2 + T1 + T0 - V is ::

    H(q, p, t) = ½ (p - b)ᵀ M⁻¹ (p - b) - T0 + V
    q̇ = ∂H/∂p        ṗ = -∂H/∂q + Q

(Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 8.1). Conserved are the momenta of cyclic coordinates along
which nothing acts, and Jacobi's integral (ch. 2.6 and 2.7).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._check import Array, real, rows
from mbkit._escape import terminal
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.energies.energy_form import (
    EnergyForm,
    acting_forces,
    parameter_values,
    read_expression,
    symbols_of,
    timed_parameters,
    vanish,
)
from mbkit.lagrangian.energies.kinetic_energy import completed_squares
from mbkit.lagrangian.energies.symbols import free_name, velocity_of
from mbkit.lagrangian.energies.sympy_to_casadi import Numeric
from mbkit.lagrangian.printer import ExpressionPrinter, Printable, aligned
from mbkit.lagrangian.trig.simplify import is_zero, slope, tidy_short

#: Meaning of h where it is not the energy.
_JACOBI: Final = "Jacobi's integral T2 - T0 + V, not the energy T + V"


@dataclass(frozen=True, repr=False)
class ConservedQuantity(Printable):
    """A constant of every motion.

    Attributes
    ----------
    name : str
        ``"p_phi"`` for the momentum of ``phi``; ``"E"`` for the energy, ``"h"`` for Jacobi's integral where it differs.
    expression : sympy.Expr
    meaning : str
    moving : tuple of tuples of sympy.Symbol
        Coordinates and velocities, or momenta, in the order in which they are written.
    """

    name: str
    expression: sp.Expr
    meaning: str
    moving: tuple[tuple[sp.Symbol, ...], ...] = field(default=(), repr=False, compare=False)

    def __str__(self) -> str:
        return terminal(f"{self.name} = {self.expression} ({self.meaning})")

    def latex(self) -> str:
        """Return name = expression."""
        board = ExpressionPrinter(*self.moving)
        return f"{board.latex(sp.Symbol(self.name))} = {board.latex(self.expression)}"


def conserved_momenta(system: EnergyForm) -> dict[sp.Symbol, sp.Expr]:
    """Return ∂L/∂v of each cyclic coordinate along which nothing acts."""
    free = system.cyclic_coordinates()
    return {q: p for q, p in zip(system.coordinates, system.momenta, strict=True) if q in free}


def energy_function(system: EnergyForm) -> sp.Expr:
    """Return h = vᵀ ∂L/∂v - L = T2 - T0 + V."""
    if is_energy(system):
        # It stays as its author wrote it.
        return system.T + system.V
    k = system.kinetic
    return k.T2 - k.T0 + system.V


def is_energy(system: EnergyForm) -> bool:
    """Return whether h, and with it H, is the energy T + V: where T1 = T0 = 0."""
    k = system.kinetic
    return not any(k.b) and k.T0 == 0


def keeps_energy(system: EnergyForm) -> bool:
    """Return whether h is constant: dh/dt = Qᵀ v - ∂L/∂t + λᵀ J v, where J v = -a of constraints that move."""
    if system.time is not None:
        k, t = system.kinetic, system.time
        if not vanish(sp.diff(x, t) for x in (*k.M, *k.b, k.T0, system.V, *system.constraints)):
            return False
    if not vanish(system.velocity_rows[1]):
        return False
    power = sum((x * w for x, w in zip(acting_forces(system), system.velocities, strict=True)), sp.Integer(0))
    return vanish([power])


def conserved_quantities(
    system: EnergyForm,
    momenta: Mapping[sp.Symbol, tuple[str, sp.Expr]],
    name: str,
    energy: sp.Expr,
    moving: tuple[sp.Symbol, ...],
) -> tuple[ConservedQuantity, ...]:
    """Return the conserved momenta, by coordinate, and the energy or Jacobi's integral, if constant, by its name.

    They are in `moving` velocities or momenta.
    """
    symbols = (system.coordinates, moving)
    out = [ConservedQuantity(p, x, f"momentum of {q.name}, which is cyclic", symbols) for q, (p, x) in momenta.items()]
    if keeps_energy(system):
        out.append(ConservedQuantity(name, energy, "energy T + V" if is_energy(system) else _JACOBI, symbols))
    return tuple(out)


def numbers_at(system: EnergyForm, t: float, values: Mapping[str, float], what: str) -> Array:
    """Return the time, where it enters, and the numbers of the parameters, with some replaced."""
    numbers = parameter_values(system, values, what)
    return numbers if system.time is None else np.array([real("t", t), *numbers])


def momentum_symbols(system: EnergyForm, coordinates: Iterable[sp.Symbol]) -> tuple[sp.Symbol, ...]:
    """Return a symbol for each coordinate's momentum: theta -> p_theta, or P_theta where that name is in use."""
    used = {s.name for s in symbols_of(system)}
    out = []
    for q in coordinates:
        out.append(sp.Symbol(free_name(f"p_{q.name}", used)))
        used.add(out[-1].name)
    return tuple(out)


def bracket(f: Any, g: Any, coordinates: Sequence[sp.Symbol], momenta: Sequence[sp.Symbol]) -> sp.Expr:
    """Return {f, g} = Σ ∂f/∂q ∂g/∂p - ∂f/∂p ∂g/∂q, tidied (Goldstein, Poole, Safko 2002, eq. 9.67)."""
    terms = (
        sp.diff(f, q) * sp.diff(g, p) - sp.diff(f, p) * sp.diff(g, q) for q, p in zip(coordinates, momenta, strict=True)
    )
    return shorter(sum(terms, sp.Integer(0)))


def shorter(x: sp.Expr) -> sp.Expr:
    """Return a short bracket tidied, and a long one as it is unless it is zero: nested ones grow fast."""
    return sp.Integer(0) if is_zero(x) else tidy_short(x)


@dataclass(frozen=True, repr=False)
class CanonicalEquations(Printable):
    """q̇ = ∂H/∂p and ṗ = -∂H/∂q + Q.

    Attributes
    ----------
    coordinates, momenta, velocities, momentum_rates : tuple of sympy.Symbol
        q, p and the left sides, q̇ and ṗ.
    qdot, pdot : (n, 1) sympy.Matrix
        In coordinates and momenta, with the generalized forces.
    """

    coordinates: tuple[sp.Symbol, ...]
    momenta: tuple[sp.Symbol, ...]
    velocities: tuple[sp.Symbol, ...]
    momentum_rates: tuple[sp.Symbol, ...]
    qdot: sp.ImmutableMatrix
    pdot: sp.ImmutableMatrix

    def equations(self) -> tuple[sp.Eq, ...]:
        """Return the 2 n equations, those of the coordinates first."""
        left = (*self.velocities, *self.momentum_rates)
        return tuple(sp.Eq(a, b, evaluate=False) for a, b in zip(left, (*self.qdot, *self.pdot), strict=True))

    def latex(self) -> str:
        """Return the equations as an aligned LaTeX block."""
        board = ExpressionPrinter(self.coordinates, self.momenta)
        return aligned((board.latex(e.lhs), board.latex(e.rhs)) for e in self.equations())

    def __str__(self) -> str:
        return terminal("\n".join(f"{e.lhs} = {e.rhs}" for e in self.equations()))


@dataclass(frozen=True, eq=False, repr=False)
class Hamiltonian(Printable):
    """H of a system and its canonical equations, the result of `Lagrangian.hamiltonian`.

    Attributes
    ----------
    system : Lagrangian
    H : sympy.Expr
        Of coordinates, momenta, time and parameters.
    momenta : tuple of sympy.Symbol
        p, one for each coordinate: ``p_theta`` for ``theta``.
    definitions : (n, 1) sympy.Matrix
        p in velocities: M v + b.
    velocities : (n, 1) sympy.Matrix
        v in momenta: M⁻¹ (p - b).
    """

    system: EnergyForm = field(repr=False)
    H: sp.Expr
    momenta: tuple[sp.Symbol, ...]
    definitions: sp.ImmutableMatrix
    velocities: sp.ImmutableMatrix

    def __reduce__(self) -> tuple[Any, ...]:
        return hamiltonian, (self.system,)

    @property
    def coordinates(self) -> tuple[sp.Symbol, ...]:
        """q."""
        return self.system.coordinates

    @cached_property
    def is_energy(self) -> bool:
        """Whether H is T + V, where T has neither terms linear in the velocities nor terms without them."""
        return is_energy(self.system)

    @cached_property
    def is_conserved(self) -> bool:
        """Whether dH/dt = ∂H/∂t + Qᵀ q̇ is zero."""
        return keeps_energy(self.system)

    @cached_property
    def _equations(self) -> CanonicalEquations:
        s = self.system
        forces = [self.canonical(x) for x in acting_forces(s)]
        return CanonicalEquations(
            coordinates=s.coordinates,
            momenta=self.momenta,
            velocities=s.velocities,
            momentum_rates=tuple(velocity_of(p) for p in self.momenta),
            qdot=self.velocities,
            # The squares of H stay together.
            pdot=sp.ImmutableMatrix([x - slope(self.H, q) for q, x in zip(s.coordinates, forces, strict=True)]),
        )

    def equations(self) -> CanonicalEquations:
        """Return the canonical equations, frozen."""
        return self._equations

    # Brackets

    def canonical(self, f: Any) -> sp.Expr:
        """Return an expression with its velocities written in momenta; refuse symbols that the system does not know."""
        out = read_expression(self.system, "f", f, self.momenta)
        return sp.sympify(out.subs(dict(zip(self.system.velocities, self.velocities, strict=True)), simultaneous=True))

    def poisson(self, f: Any, g: Any) -> sp.Expr:
        """Return Poisson's bracket {f, g} = Σ ∂f/∂q ∂g/∂p - ∂f/∂p ∂g/∂q, with velocities written in momenta first."""
        return bracket(self.canonical(f), self.canonical(g), self.coordinates, self.momenta)

    def time_derivative(self, f: Any) -> sp.Expr:
        """Return df/dt along the motion: {f, H} + ∂f/∂t + Σ ∂f/∂p Q."""
        f = self.canonical(f)
        out = bracket(f, self.H, self.coordinates, self.momenta)
        if self.system.time is not None:
            out += sp.diff(f, self.system.time)
        forces = (self.canonical(x) for x in acting_forces(self.system))
        pushed = sum((sp.diff(f, p) * x for p, x in zip(self.momenta, forces, strict=True)), sp.Integer(0))
        return shorter(out + pushed)

    def conserved_quantities(self) -> tuple[ConservedQuantity, ...]:
        """Return the momenta of the cyclic coordinates, and H if it is constant, in coordinates and momenta."""
        symbols = dict(zip(self.coordinates, self.momenta, strict=True))
        momenta = {q: (symbols[q].name, symbols[q]) for q in conserved_momenta(self.system)}
        return conserved_quantities(self.system, momenta, "H", self.H, self.momenta)

    # Numbers

    @cached_property
    def _linear(self) -> Numeric:
        k, s = self.system.kinetic, self.system
        return Numeric(sp.Matrix.hstack(k.M, k.b), s.coordinates, timed_parameters(s))

    @cached_property
    def _rates(self) -> Numeric:
        s, eq = self.system, self.equations()
        names = (s.coordinates, self.momenta, (*s.inputs.values(), *timed_parameters(s)))
        return Numeric(sp.Matrix.vstack(eq.qdot, eq.pdot), *names)

    def _mass(self, q: ArrayLike, other: ArrayLike, name: str, t: float, values: dict[str, float]) -> Any:
        n = len(self.coordinates)
        q, other = rows("q", q, n, self.system.name, "nq"), rows(name, other, n, self.system.name, "nv")
        both = self._linear(q, numbers_at(self.system, t, values, name))
        return both[..., :n], both[..., n], other

    def to_momentum(self, q: ArrayLike, v: ArrayLike, *, t: float = 0.0, **values: float) -> Array:
        """Return p = M v + b in numbers, of q and v (n,) or (N, n), t in s, and values of parameters by name."""
        M, b, velocity = self._mass(q, v, "v", t, values)
        return np.asarray((M @ velocity[..., None])[..., 0] + b)

    def to_velocity(self, q: ArrayLike, p: ArrayLike, *, t: float = 0.0, **values: float) -> Array:
        """Return v = M⁻¹ (p - b) in numbers, as `to_momentum`; NumericalError where the mass matrix is singular."""
        M, b, momentum = self._mass(q, p, "p", t, values)
        try:
            out = np.linalg.solve(M, (momentum - b)[..., None])[..., 0]
        except np.linalg.LinAlgError:
            out = np.full(1, np.nan)
        if not np.isfinite(out).all():
            raise NumericalError(f"{self.system.name}: the mass matrix is singular at q = {np.asarray(q).tolist()}")
        return np.asarray(out)

    def field(self, tau: ArrayLike | None = None, **values: float) -> Callable[[float, ArrayLike], Array]:
        """Return f(t, y) = (q̇, ṗ) with y = (q, p), as SciPy's integrators take it.

        `tau` (n,) are the inputs, one entry a coordinate, zero by default; `values` are those of parameters, by name.
        Where the mass matrix is singular the result is not finite, at which an integrator takes a shorter step.
        """
        s, n = self.system, len(self.coordinates)
        force = np.zeros(n) if tau is None else rows("tau", tau, n, s.name, "nv")
        acting = force[[s.coordinates.index(q) for q in s.inputs]] if s.inputs else np.empty(0)
        idle = [q.name for q, x in zip(s.coordinates, force, strict=True) if q not in s.inputs and x]
        if idle:
            raise InputError(f"tau: {s.name} has no input along {', '.join(idle)}; add forces={{{idle[0]}: tau}} to it")
        numbers, timed = parameter_values(s, values, "field"), s.time is not None

        def f(t: float, y: ArrayLike) -> Array:
            y = rows("y", y, 2 * n, s.name, "nq + nv")
            behind = np.concatenate([acting, [real("t", t)] if timed else [], numbers])
            return self._rates(y[..., :n], y[..., n:], behind)[..., 0]

        return f

    # Reading

    def latex(self) -> str:
        """Return H = ... ."""
        return f"H = {ExpressionPrinter(self.coordinates, self.momenta, time=self.system.time).latex(self.H)}"

    def __str__(self) -> str:
        return terminal(f"H = {self.H}")


def hamiltonian(system: EnergyForm) -> Hamiltonian:
    """Return H of a system; constraints are refused (UnsupportedError), as no H holds their forces."""
    if system.multiplier_symbols:
        raise UnsupportedError(
            f"hamiltonian: {system.name} has constraints, whose forces no H holds; embed them first, or leave them out"
        )
    k = system.kinetic
    momenta = momentum_symbols(system, system.coordinates)
    p = [symbol - x for symbol, x in zip(momenta, k.b, strict=True)]
    squares = completed_squares(k.M, "T: its mass matrix")
    return Hamiltonian(
        system=system,
        H=squares.form(p, p) / 2 - k.T0 + system.V,
        momenta=momenta,
        definitions=system.momenta,
        velocities=sp.ImmutableMatrix(squares.solve(p)),
    )
