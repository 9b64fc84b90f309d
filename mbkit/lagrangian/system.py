"""`Lagrangian`: a system written down as energies, and all that mechanics says about it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._check import Array, real
from mbkit._escape import one_line
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion, equations_of_motion
from mbkit.lagrangian.energies.kinetic_energy import KineticSplit, require_inertia, split
from mbkit.lagrangian.energies.symbols import declared, name_of, plain
from mbkit.lagrangian.printing.printer import Blackboard
from mbkit.lagrangian.reduction import conserved
from mbkit.lagrangian.reduction.conserved import ConservedQuantity
from mbkit.lagrangian.trig.simplify import tidy_matrix

if TYPE_CHECKING:
    from mbkit.engines import Dynamics
    from mbkit.lagrangian.constraints.independent_coordinates import Embedded
    from mbkit.lagrangian.constraints.manifold import Manifold
    from mbkit.lagrangian.energies.model import WrittenModel
    from mbkit.lagrangian.reduction.hamilton import Hamiltonian
    from mbkit.lagrangian.reduction.quasi_velocities import QuasiLagrangian
    from mbkit.lagrangian.reduction.routh import Routhian

__all__ = ["Constrained", "Lagrangian"]


# What a `Lagrangian` with constraints answers by number.


class Constrained:
    """Constraints, their Jacobian and multipliers, consistent states and the embedded form."""

    name: str
    coordinates: tuple[sp.Symbol, ...]
    constraints: tuple[sp.Expr, ...]

    @property
    @abstractmethod
    def model(self) -> WrittenModel:
        """The system as engines take it."""

    @abstractmethod
    def dynamics(
        self, engine: str = "lagrangian", *, options: Mapping[str, Any] | None = None, **values: float
    ) -> Dynamics:
        """Return the compiled dynamics."""

    def constraint(self, q: ArrayLike, t: float = 0.0, **values: float) -> Array:
        """Return f(q, t), (m,) or (N, m); zero where the constraints hold.

        Parameters
        ----------
        q : (n,) or (N, n) array_like
        t : float
            s.
        **values
            Of parameters, by name.
        """
        manifold = self._manifold(t, values)
        return manifold.value(self.model.check_q(q))

    def constraint_jacobian(self, q: ArrayLike, t: float = 0.0, **values: float) -> Array:
        """Return J = ∂f/∂q, (m, n) or (N, m, n); arguments are those of `constraint`."""
        manifold = self._manifold(t, values)
        return manifold.jacobian(self.model.check_q(q))

    def multipliers(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike | None = None, t: float = 0.0, **values: float
    ) -> Array:
        """Return λ, (m,) or (N, m): the forces Jᵀ λ that hold the constraints.

        Parameters
        ----------
        q, v : (n,) or (N, n) array_like
            A consistent state; `project` makes one.
        tau : (n,) or (N, n) array_like, optional
            Zero when not given.
        t : float
            s.
        **values
            Of parameters, by name.
        """
        from mbkit.lagrangian.constraints.redundancy import require_independent

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
        """Return the nearest state that the constraints allow, by the mass matrix's measure.

        Parameters
        ----------
        q, v : (n,) or (N, n) array_like
        t : float
            s.
        **values
            Of parameters, by name.

        Returns
        -------
        q, v : (n,) or (N, n) arrays
            With f(q, t) = 0 and J v + ∂f/∂t = 0 to rounding.

        Raises
        ------
        InputError
            Constraints that contradict or follow from each other, or too far a way.
        """
        manifold = self._manifold(t, values)
        q, v = np.broadcast_arrays(self.model.check_q(q), self.model.check_v(v))
        if q.ndim == 1:
            return self._projected(manifold, q, v)
        found = [self._projected(manifold, *pair) for pair in zip(q, v, strict=True)]
        return np.array([pair[0] for pair in found]), np.array([pair[1] for pair in found])

    def _projected(self, manifold: Manifold, q: Array, v: Array) -> tuple[Array, Array]:
        from mbkit.lagrangian.constraints.redundancy import refuse_unreachable, require_independent

        try:
            found = manifold.project(q, v)
        except InputError:
            refuse_unreachable(manifold.dyn, q)
            raise
        require_independent(manifold.dyn, found[0], everywhere=True)
        return found

    def embedded(self, independent: Sequence[Any] | None = None, **values: float) -> Embedded:
        """Return the system on independent coordinates alone, for `mbkit.simulate`.

        Parameters
        ----------
        independent : sequence of coordinates or their names, optional
            As many as there are coordinates less constraints. When not given, those on
            which the others depend best, chosen anew where that changes.
        **values
            Of parameters, by name.
        """
        from mbkit.lagrangian.constraints.independent_coordinates import Embedded

        dyn = self.dynamics().at(**values)
        if isinstance(independent, (str, sp.Basic)):
            independent = [independent]
        names = None if independent is None else tuple(name_of(x) for x in independent)
        return Embedded(self._consistent(dyn), names)

    def _manifold(self, t: float, values: Mapping[str, float]) -> Manifold:
        return self._consistent(self._interpreted.at(**values) if values else self._interpreted).at(real("t", t))

    def _consistent(self, dyn: Dynamics) -> Manifold:
        # It loads CasADi.
        from mbkit.lagrangian.constraints.manifold import manifold_of

        if not self.constraints:
            raise UnsupportedError(f"{self.name}: has no constraints; give them as constraints=[...]")
        return manifold_of(dyn)

    @cached_property
    def _interpreted(self) -> Dynamics:
        return self.dynamics(options={"compile": False})


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
    constraints : sequence of sympy.Expr or sympy.Eq, optional
        Holonomic: f(q, t) = 0 each.
    name : str

    Notes
    -----
    A name stands for one thing: ``Symbol("m", positive=True)`` and ``Symbol("m")`` are the same parameter.

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
    multiplier_symbols : tuple of sympy.Symbol
        λ of each constraint.

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
        d = declared(T, V, coordinates, velocities, time, forces, dissipation, parameters, constraints)
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"name: expected a text, got {name!r}")
        self.name = name
        self.coordinates, self.velocities, self.time = d.coordinates, d.velocities, d.time
        self.accelerations, self.multiplier_symbols = d.accelerations, d.multipliers
        self.parameters, self.inputs = d.parameters, d.inputs
        self.T, self.V, self.dissipation, self.constraints = d.T, d.V, d.dissipation, d.constraints
        self.forces = sp.ImmutableMatrix([x if q not in self.inputs else 0 for q, x in d.given.items()])
        require_inertia(self.kinetic.M, self.coordinates, self.velocities, self.constraints)

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
        return equations_of_motion(self)

    def equations(self) -> EquationsOfMotion:
        """Return the equation of motion, frozen: its matrices, and `latex()` and `explicit()`."""
        return self._equations

    # What it keeps, and other forms of it

    def cyclic_coordinates(self) -> tuple[sp.Symbol, ...]:
        """Return the coordinates that L does not hold and along which nothing acts: their momenta are constant."""
        return self._cyclic[1]

    @cached_property
    def _cyclic(self) -> tuple[dict[sp.Symbol, sp.Expr], tuple[sp.Symbol, ...]]:
        return conserved.cyclic_coordinates(self)

    def forced_cyclic_coordinates(self) -> dict[sp.Symbol, sp.Expr]:
        """Return the other coordinates that L does not hold, each with the force that acts along it."""
        return {q: force for q, force in self._cyclic[0].items() if force != 0}

    def conserved_momenta(self) -> dict[sp.Symbol, sp.Expr]:
        """Return p = ∂L/∂v of each cyclic coordinate, by coordinate."""
        return conserved.conserved_momenta(self)

    def conserved_quantities(self) -> tuple[ConservedQuantity, ...]:
        """Return what is constant along every motion: those momenta, and the energy or Jacobi's integral."""
        return conserved.conserved_quantities(self)

    @property
    def energy_function(self) -> sp.Expr:
        """h = vᵀ ∂L/∂v - L = T2 - T0 + V: Jacobi's integral, the energy T + V where T = T2."""
        return conserved.energy_function(self)

    def routhian(self, cyclic: sp.Symbol | Sequence[sp.Symbol] | None = None) -> Routhian:
        """Return Routh's reduction: the same system less its cyclic coordinates, or those given.

        Raises
        ------
        InputError
            One is not cyclic or a force acts along it; none is, or none would remain.
        """
        from mbkit.lagrangian.reduction.routh import routhian

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
        from mbkit.lagrangian.reduction.hamilton import hamiltonian

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
        from mbkit.lagrangian.reduction.quasi_velocities import QuasiLagrangian

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
        own = {s.name: s for s in self.parameters}
        put = {}
        for given, x in values.items():
            symbol = own.get(str(given))
            if symbol is None:
                raise InputError(f"values: {given} is no parameter; they are {plain(self.parameters) or 'none'}")
            put[symbol] = sp.sympify(x)
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
        from mbkit.lagrangian.energies.model import WrittenModel

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
        return one_line(f"<Lagrangian {self.name!r}: coordinates {', '.join(map(str, self.coordinates))}>")

    def _repr_latex_(self) -> str:
        board = Blackboard(self.coordinates, self.velocities, time=self.time)
        return f"$T = {board.latex(self.T)},\\quad V = {board.latex(self.V)}$"
