"""`Lagrangian`: a system of energies T and V, its equations, reductions and dynamics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._attributes import forwarded
from mbkit._check import Array, real, rows
from mbkit._escape import one_line
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.constraint_manifold import Manifold, manifold_of, projected, require_independent
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.energies.energy_form import (
    EnergyForm,
    QuasiVelocities,
    acting_forces,
    parameter_values,
    timed_parameters,
    vanish,
)
from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion, equations_of_motion
from mbkit.lagrangian.energies.symbols import name_of
from mbkit.lagrangian.energies.sympy_to_casadi import Numeric
from mbkit.lagrangian.energy_model import EnergyModel, energies_latex
from mbkit.lagrangian.independent_coordinates import Embedded
from mbkit.lagrangian.reduction import hamilton
from mbkit.lagrangian.reduction.hamilton import ConservedQuantity, Hamiltonian, hamiltonian
from mbkit.lagrangian.reduction.impulses import ImpulseEquations, impulse_equations
from mbkit.lagrangian.reduction.nonholonomic import (
    Integrability,
    NonholonomicEquations,
    integrability,
    nonholonomic_equations,
    require_value,
    symmetry_momenta,
)
from mbkit.lagrangian.reduction.quasi_equations import in_quasi_velocities, quasi_equations
from mbkit.lagrangian.reduction.routh import Routhian, routhian
from mbkit.lagrangian.trig.simplify import tidy


class Lagrangian(EnergyForm):
    """A system as its energies in generalized coordinates, to read and to run.

    Parameters
    ----------
    T : sympy.Expr
        Kinetic energy, of second degree in the velocities at most; J.
    V : sympy.Expr
        Potential energy, of coordinates, parameters and time; J. Terms linear in the velocities make it a generalized
        potential, such as -e A·v of a charge in a magnetic field (Goldstein et al. 2002, ch. 1.5); they are kept as
        terms of T with the other sign, so that L = T - V and conserved quantities are right, and T + V is no energy.
    coordinates : sequence of sympy symbols
        Plain symbols, or `sympy.physics.mechanics.dynamicsymbols`.
    velocities : sequence of sympy symbols, optional
        One per coordinate: q̇. By default the derivatives of dynamicsymbols, or
        symbols named like the coordinates: ``theta1`` has ``thetadot1``.
    time : sympy.Symbol, optional
        Where T, V, a force or a constraint depends on it. Dynamicsymbols bring their own.
    forces : mapping of coordinate to sympy.Expr, optional
        Generalized forces beside V's, of coordinates, velocities, time and parameters. A symbol that stands alone and
        nowhere else is an input: it is that coordinate's entry of ``tau`` when the equation is run.
    dissipation : sympy.Expr, optional
        Rayleigh's function R of the velocities; the force is -∂R/∂v.
    parameters : mapping of sympy.Symbol to float or None, or sequence of symbols, optional
        Every other symbol, with its value where it has one.
    constraints : sequence of sympy.Expr or sympy.Eq, optional
        Holonomic: f(q, t) = 0 each.
    velocity_constraints : sequence of sympy.Expr or sympy.Eq, optional
        Linear in the velocities: A(q, t) v + a(q, t) = 0 each, such as rolling (Neimark and Fufaev 1972, ch. I).
        They need not be integrable. T, V and forces are those of the free system: to put a row that is not
        integrable into T before Lagrange's equations are formed gives other, wrong equations.
    stops : mapping of coordinate to (lower, upper), or sequence of sympy.Expr, optional
        Bounds, None for no bound, or g(q, t) >= 0 each. They are written out; no engine runs them.
    restitution : sympy.Expr or float, or sequence of one for each stop, optional
        e of Newton's law of impact on the stops, from 0 to 1.
    name : str
        A name stands for one thing: ``Symbol("m", positive=True)`` and ``Symbol("m")`` are the same parameter.

    Attributes
    ----------
    T, V, dissipation, coordinates, velocities, accelerations, time, parameters
        The arguments in plain symbols; `time` is None where nothing depends on it.
    constraints, velocity_constraints, stops, restitution
        The arguments in plain symbols; of each stop g and e, and a coordinate's lower bound is before its upper one.
    forces : (n, 1) sympy.Matrix
        Without the dissipation.
    inputs : mapping of coordinate to sympy.Symbol
        The symbols that stand for ``tau``.
    multiplier_symbols, stop_multipliers : tuple of sympy.Symbol
        λ of each constraint, those of the velocity constraints last, and λ of each stop.

    Raises
    ------
    InputError
        T of another degree (the term is named), a velocity without its coordinate, symbols
        that are not declared (they are named), names that stand for two things, a mass matrix
        that is singular everywhere (the velocities are named).

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

    @property
    def _in_rates(self) -> Lagrangian:
        """The system in its coordinates' rates."""
        return getattr(self, "system", self)

    @property
    def _without_stops(self) -> Lagrangian:
        """The same, for forms of the equations that do not hold stops."""
        if self.stops:
            raise UnsupportedError(
                f"{self.name}: has stops, such as {self.stops[0]} >= 0, whose forces and impacts this form of the "
                "equations does not hold; equations() and impulse(stop=...) have them"
            )
        return self._in_rates

    @property
    def _given(self) -> Lagrangian:
        """The system as it was written."""
        return self

    def kinetic_split(self) -> tuple[sp.Expr, sp.Expr, sp.Expr]:
        """Return T2, T1 and T0: T's parts of second, first and zeroth degree in the velocities."""
        k = self.kinetic
        return k.T2, k.T1, k.T0

    @cached_property
    def _equations(self) -> EquationsOfMotion:
        return equations_of_motion(self)

    def equations(self) -> EquationsOfMotion:
        """Return the equation of motion, frozen: its matrices, and `latex()` and `explicit()`."""
        return self._equations

    # Conserved quantities, and other forms

    def conserved_momenta(self) -> dict[sp.Symbol, sp.Expr]:
        """Return p = ∂L/∂v of each cyclic coordinate, by coordinate."""
        return hamilton.conserved_momenta(self)

    def conserved_quantities(self) -> tuple[ConservedQuantity, ...]:
        """Return the constants of every motion: those momenta, and the energy or Jacobi's integral.

        Of constraints' reactions on cyclic coordinates, momenta along sums of these on which none acts are added.
        """
        momenta = {q: (f"p_{q.name}", p) for q, p in self.conserved_momenta().items()}
        name = "E" if hamilton.is_energy(self._given) else "h"
        out = hamilton.conserved_quantities(self._given, momenta, name, self.energy_function, self.velocities)
        return out if self.quasi is not None or not self.multiplier_symbols else (*out, *symmetry_momenta(self))

    @property
    def energy_function(self) -> sp.Expr:
        """h = vᵀ ∂L/∂v - L = T2 - T0 + V, Jacobi's integral, the energy T + V where T = T2."""
        return hamilton.energy_function(self)

    def routhian(self, cyclic: sp.Symbol | Sequence[sp.Symbol] | None = None) -> Routhian[Lagrangian]:
        """Return Routh's reduction: the same system without its cyclic coordinates, or without the named ones.

        Raises
        ------
        InputError
            One is not cyclic or a force acts along it; none is, or none would remain.
        """
        return routhian(self._without_stops, cyclic)

    def hamiltonian(self) -> Hamiltonian:
        """Return Hamilton's function H(q, p, t) with its canonical equations.

        Raises
        ------
        UnsupportedError
            Constraints or stops act on the system.
        """
        return self._without_stops._hamiltonian

    @cached_property
    def _hamiltonian(self) -> Hamiltonian:
        return hamiltonian(self)

    def quasi_velocities(
        self, D: sp.Matrix, names: str | Sequence[str | sp.Symbol] | None = None, *, drift: sp.Matrix | None = None
    ) -> QuasiLagrangian:
        """Return the same system in velocities w that are no coordinates' rates: q̇ = D(q, t) w + e(q, t).

        Parameters
        ----------
        D : (n, n) sympy.Matrix
            Of coordinates, time and parameters, one row per coordinate.
        names : str or sequence of str or sympy.Symbol, optional
            Of w; ``w1``, ``w2``, ... by default.
        drift : (n, 1) sympy.Matrix, optional
            e, the coordinates' rates where w is zero; none by default. Of u = A(q, t) q̇ + a(q, t) it is -A⁻¹ a.

        Raises
        ------
        InputError
            D or e of another shape or with other symbols, or D singular everywhere.
        UnsupportedError
            Holonomic constraints act on the system. One with a time in D, or with e, runs in `system` only.

        Examples
        --------
        A point in a plane in the velocities that a turning table's axes show, with the terms of Coriolis:

        >>> import sympy as sp
        >>> import mbkit as mb
        >>> m, x, y, xdot, ydot, Omega, t = sp.symbols("m x y xdot ydot Omega t")
        >>> point = mb.lagrangian.Lagrangian(m * (xdot**2 + ydot**2) / 2, 0, [x, y], time=t, parameters=[m, Omega])
        >>> c, s = sp.cos(Omega * t), sp.sin(Omega * t)
        >>> print(point.quasi_velocities([[c, -s], [s, c]], "u w").equations())
        m*udot - Omega*m*w = 0
        m*wdot + Omega*m*u = 0
        """
        return QuasiLagrangian(self, D, names, drift)

    # Constraints, eliminated

    def maggi(self, quasi_velocities: Any = None) -> NonholonomicEquations:
        """Return Maggi's equations, with the constraints eliminated by independent quasi-velocities.

        Of holonomic constraints the rates are eliminated: a state has to satisfy f(q, t) = 0, as of `project`.

        Parameters
        ----------
        quasi_velocities : sequence of coordinates, or mapping of name to sympy.Expr, optional
            Coordinates whose rates stay, or w by its definition in the velocities: one for each degree of freedom.
            By default the coordinates whose choice leaves the simplest determinant.

        Raises
        ------
        InputError
            Too many or too few, or some that do not determine every velocity with the constraints.
        UnsupportedError
            No constraints, or stops beside them.
        """
        return nonholonomic_equations(self._without_stops, quasi_velocities, "Maggi")

    def boltzmann_hamel(self, quasi_velocities: Any = None) -> NonholonomicEquations:
        """Return the same equations by Boltzmann and Hamel, from T in n quasi-velocities; arguments as of `maggi`."""
        return nonholonomic_equations(self._without_stops, quasi_velocities, "Hamel")

    def appell(self, quasi_velocities: Any = None) -> NonholonomicEquations:
        """Return the same equations by Gibbs and Appell, with `S`; arguments as of `maggi`."""
        return nonholonomic_equations(self._without_stops, quasi_velocities, "Appell")

    def integrability(self) -> Integrability:
        """Return which velocity constraints are integrable, by Frobenius' theorem.

        Raises
        ------
        UnsupportedError
            No velocity constraints.
        """
        return integrability(self._in_rates)

    # Impacts

    def impulse(
        self, impulses: Mapping[Any, Any] | None = None, *, rows: Any = (), restitution: Any = 0, stop: Any = None
    ) -> ImpulseEquations:
        """Return the equations of an impact, which changes velocities at once: M (v⁺ - v⁻) = Ŝ + Jᵀ P.

        Parameters
        ----------
        impulses : mapping of coordinate to sympy.Expr, optional
            Ŝ, generalized impulses.
        rows : sequence of sympy.Expr or sympy.Eq, optional
            Linear in the velocities: a constraint that is imposed at once, or the approach of a contact.
        restitution : sympy.Expr or float
            e of Newton's law for `rows`: they are -e times what they were before.
        stop : int, optional
            Place in `stops` of the one that is hit: ġ is the row, with its own e. All others take no part.

        Raises
        ------
        InputError
            Neither impulses nor rows, rows that are not linear, e beyond 0 to 1, or no such stop.
        """
        if stop is not None:
            if stop not in range(len(self.stops)) or rows != () or restitution != 0:
                here = f"one of {len(self.stops)} stops, counted from 0, without rows and restitution"
                raise InputError(f"stop: expected {here}, got {stop!r}")
            rows, restitution = [self._in_rates.equations().stops[stop].rate], self.restitution[stop]
        return impulse_equations(self._in_rates, impulses, rows, restitution)

    # Running it

    @cached_property
    def model(self) -> EnergyModel:
        """The system as engines take it, for ``mb.dynamics(lag.model, "lagrangian")``."""
        return EnergyModel(self)

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
        dyn = dynamics(self.model, engine, **(options or {}))
        return dyn.at(**values) if values else dyn

    # Constraints

    def constraint(self, q: ArrayLike, t: float = 0.0, **values: float) -> Array:
        """Return f(q, t), (m,) or (N, m), at q (n,) or (N, n), t in s and values of parameters by name."""
        manifold = self._manifold(t, values)
        return manifold.value(self.model.check_q(q))

    def constraint_jacobian(self, q: ArrayLike, t: float = 0.0, **values: float) -> Array:
        """Return J = ∂f/∂q, (m, n) or (N, m, n); arguments are those of `constraint`."""
        manifold = self._manifold(t, values)
        return manifold.jacobian(self.model.check_q(q))

    def multipliers(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike | None = None, t: float = 0.0, **values: float
    ) -> Array:
        """Return λ, (m,) or (N, m), of the forces Jᵀ λ that hold the constraints; other arguments as of `constraint`.

        Parameters
        ----------
        q, v : (n,) or (N, n) array_like
            A consistent state, such as `project` returns.
        tau : (n,) or (N, n) array_like, optional
            Zero by default.
        """
        q, v = self.model.check_q(q), self.model.check_v(v)
        tau = self.model.check_v(np.zeros_like(v) if tau is None else tau, "tau")
        manifold, (q, v, tau) = self._manifold(t, values), np.broadcast_arrays(q, v, tau)
        for one in np.atleast_2d(q):
            require_independent(manifold.dyn, one)
        out = manifold.multipliers(q, v, tau)
        if not np.isfinite(out).all():
            raise NumericalError(
                f"{self.name}: the multipliers are not finite at q = {q.tolist()}; perhaps the constraints depend on "
                "each other in this pose, or the mass matrix is singular"
            )
        return out

    def project(self, q: ArrayLike, v: ArrayLike, t: float = 0.0, **values: float) -> tuple[Array, Array]:
        """Return the nearest state that the constraints allow, in the metric of the mass matrix.

        f(q, t) = 0 and J v + ∂f/∂t = 0 hold to rounding; arguments are those of `constraint`, shapes stay.

        Raises
        ------
        InputError
            Constraints that contradict or follow from each other, or a state too far from them.
        """
        manifold = self._manifold(t, values)
        q, v = np.broadcast_arrays(self.model.check_q(q), self.model.check_v(v))
        if q.ndim == 1:
            return projected(manifold.dyn, q, v)
        states = [projected(manifold.dyn, *pair) for pair in zip(q, v, strict=True)]
        return np.array([pair[0] for pair in states]), np.array([pair[1] for pair in states])

    def embedded(self, independent: Sequence[Any] | None = None, **values: float) -> Embedded:
        """Return the system on independent coordinates alone, for `mbkit.simulate`.

        Parameters
        ----------
        independent : sequence of coordinates or their names, optional
            As many as there are coordinates less constraints. By default the best conditioned choice, which may
            change during a run.
        **values
            Of parameters, by name.
        """
        dyn = self.dynamics().at(**values)
        if isinstance(independent, (str, sp.Basic)):
            independent = [independent]
        names = None if independent is None else tuple(name_of(x) for x in independent)
        return Embedded(manifold_of(dyn), names)

    def _manifold(self, t: float, values: Mapping[str, float]) -> Manifold:
        return manifold_of(self._interpreted.at(**values) if values else self._interpreted).at(real("t", t))

    @cached_property
    def _interpreted(self) -> Dynamics:
        return self.dynamics(options={"compile": False})

    # Reading

    def __repr__(self) -> str:
        return one_line(f"<Lagrangian {self.name!r}: coordinates {', '.join(map(str, self.coordinates))}>")

    def _repr_latex_(self) -> str:
        return energies_latex(self)


class QuasiLagrangian(Lagrangian):
    """A system in quasi-velocities, the result of `Lagrangian.quasi_velocities`, or of `from_model` with ball joints.

    States are (q, w), and ``tau`` is the force on each w, Dᵀ times that on each coordinate (`to_force`). Routh's and
    Hamilton's functions need the coordinates' rates and are those of `system`.

    Attributes
    ----------
    system : Lagrangian
        The same in its coordinates' rates.
    D, W : (n, n) sympy.Matrix
        q̇ = D w + e and w = W (q̇ - e).
    drift : (n, 1) sympy.Matrix
        e.
    """

    def __init__(self, system: Lagrangian, D: Any, names: Any = None, drift: Any = None) -> None:
        self.__dict__["system"] = system
        # The parts of T are known, and need not be separated again.
        arguments, self.__dict__["kinetic"], self.quasi = in_quasi_velocities(system, D, names, drift)
        super().__init__(**arguments, stops=system.stops, restitution=system.restitution)
        self.time = self.time or self.quasi.time

    quasi: QuasiVelocities
    #: True if its energies were written in w, and not in the coordinates' rates.
    _native = False

    @classmethod
    def of_energies(cls, quasi: QuasiVelocities, **arguments: Any) -> QuasiLagrangian:
        """Return a system of which T and the others, arguments of `Lagrangian`, are written in the quasi-velocities."""
        out = cls.__new__(cls)
        out.quasi, out._native = quasi, True
        Lagrangian.__init__(out, **arguments)
        return out

    @cached_property
    def system(self) -> Lagrangian:
        """The same in its coordinates' rates."""
        quasi, arguments = self.quasi, self._arguments()
        w = dict(zip(self.velocities, quasi.W * sp.Matrix(quasi.rates), strict=True))
        forces = quasi.W.T * self.forces.subs(w, simultaneous=True)
        arguments |= {name: arguments[name].subs(w, simultaneous=True) for name in ("T", "dissipation")}
        arguments |= {"velocities": quasi.rates, "forces": dict(zip(self.coordinates, forces, strict=True))}
        return Lagrangian(**arguments)

    D: sp.ImmutableMatrix = forwarded("quasi.D", "D, (n, n), of q̇ = D w + e.")
    W: sp.ImmutableMatrix = forwarded("quasi.W", "D⁻¹, (n, n).")
    drift: sp.ImmutableMatrix = forwarded("quasi.drift", "The coordinates' rates where w is zero, e, (n, 1).")
    hamel_coefficients: sp.ImmutableDenseNDimArray = forwarded(
        "quasi.hamel_coefficients",
        "γ, (n, n, n), of `mbkit.lagrangian.reduction.quasi_equations`; ``hamel_coefficients[k, i, j]`` = γ^k_ij.",
    )
    input_forces: sp.ImmutableMatrix = forwarded("quasi.input_forces", "Dᵀ u of the coordinates' inputs u, (n, 1).")

    @cached_property
    def _equations(self) -> EquationsOfMotion:
        return quasi_equations(self, self.quasi)

    # Variants

    def __reduce__(self) -> tuple[Any, ...]:
        if self._native:
            return partial(QuasiLagrangian.of_energies, self.quasi, **self._arguments()), ()
        return QuasiLagrangian, (self.system, self.D, self.velocities, self.drift)

    def _like(self, arguments: dict[str, Any]) -> QuasiLagrangian:
        return QuasiLagrangian.of_energies(self.quasi, **arguments)

    def substituted(self, values: Mapping[sp.Symbol, Any]) -> QuasiLagrangian:
        """Return the same system with numbers for some parameters."""
        if self._native:
            return super().substituted(values)
        numbers = {s: sp.sympify(x) for s, x in values.items()}
        D, drift = self.D.subs(numbers), self.drift.subs(numbers)
        return QuasiLagrangian(self.system.substituted(values), D, self.velocities, drift)

    def conservative(self) -> QuasiLagrangian:
        """Return the same system without dissipation and forces; inputs stay."""
        if self._native:
            return super().conservative()
        return QuasiLagrangian(self.system.conservative(), self.D, self.velocities, self.drift)

    def quasi_velocities(self, D: Any, names: Any = None, *, drift: Any = None) -> QuasiLagrangian:
        """Return the system in other quasi-velocities u, with q̇ = D u + drift again."""
        return QuasiLagrangian(self.system, D, names, drift)

    # Reductions in coordinates' rates

    @property
    def _given(self) -> Lagrangian:
        return self if self._native else self.system

    @cached_property
    def _ignorable(self) -> dict[sp.Symbol, sp.Expr]:
        if not self._native:
            return self.system._ignorable
        p, rates = self.momenta, self.D * sp.Matrix(self.velocities)
        forces = self.W.T * sp.Matrix(acting_forces(self))
        # The derivative of L at constant rates of the coordinates.
        slopes = (sp.diff(self.L, q) + (p.T * sp.diff(self.W, q) * rates)[0] for q in self.coordinates)
        candidates = zip(self.coordinates, slopes, forces, strict=True)
        return {q: tidy(force) for q, slope, force in candidates if vanish([slope])}

    def conserved_momenta(self) -> dict[sp.Symbol, sp.Expr]:
        """Return the momentum Wᵀ p of each cyclic coordinate, in quasi-velocities."""
        p, cyclic = self.W.T * self.momenta, self.cyclic_coordinates()
        return {q: tidy(x) for q, x in zip(self.coordinates, p, strict=True) if q in cyclic}

    @property
    def energy_function(self) -> sp.Expr:
        """h of the coordinates' rates, in quasi-velocities."""
        if not any(self.drift):
            return super().energy_function
        rates = self.D * sp.Matrix(self.velocities) + self.drift
        return tidy(
            self.system.energy_function.subs(dict(zip(self.quasi.rates, rates, strict=True)), simultaneous=True)
        )

    # Numbers

    @cached_property
    def _maps(self) -> dict[str, Numeric]:
        arguments = self.coordinates, timed_parameters(self)
        maps = {"w": self.D.row_join(self.drift), "v": self.W.row_join(-self.W * self.drift), "tau": self.D.T}
        return {name: Numeric(A, *arguments) for name, A in maps.items()}

    def _mapped(self, name: str, q: ArrayLike, x: ArrayLike, t: float, values: dict[str, float]) -> Array:
        n, own = len(self.coordinates), (self.D.free_symbols | self.drift.free_symbols) & set(self.parameters)
        q, x = rows("q", q, n, self.name, "nq"), rows(name, x, n, self.name, "nv")
        numbers = parameter_values(self, values, name) if own else np.zeros(len(self.parameters))
        timed = numbers if self.time is None else np.array([real("t", t), *numbers])
        A = require_value(self._maps[name](q, timed), self.name, q, "1/det D, or det D,")
        return np.asarray(np.einsum("...ij,...j->...i", A[..., :n], x) + A[..., n:].sum(axis=-1))

    def to_velocity(self, q: ArrayLike, w: ArrayLike, *, t: float = 0.0, **values: float) -> Array:
        """Return the coordinates' rates D w + e in numbers, (n,) or (N, n), t in s."""
        return self._mapped("w", q, w, t, values)

    def to_quasi_velocity(self, q: ArrayLike, v: ArrayLike, *, t: float = 0.0, **values: float) -> Array:
        """Return w = D⁻¹ (v - e) of the coordinates' rates in numbers, (n,) or (N, n), t in s."""
        return self._mapped("v", q, v, t, values)

    def to_force(self, q: ArrayLike, tau: ArrayLike, *, t: float = 0.0, **values: float) -> Array:
        """Return the forces Dᵀ τ on w of those on the coordinates in numbers, (n,) or (N, n), t in s."""
        return self._mapped("tau", q, tau, t, values)

    def __repr__(self) -> str:
        return one_line(f"<QuasiLagrangian {self.name!r}: quasi-velocities {', '.join(map(str, self.velocities))}>")
