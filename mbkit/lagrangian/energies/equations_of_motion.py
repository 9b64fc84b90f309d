"""The equation of motion in symbols, term by term, to read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, Final, NamedTuple

import sympy as sp
from sympy.matrices.exceptions import NonInvertibleMatrixError

from mbkit._escape import terminal
from mbkit.errors import UnsupportedError
from mbkit.lagrangian.energies.energy_form import EnergyForm
from mbkit.lagrangian.printer import Abbreviations, ExpressionPrinter, Printable, aligned, spread
from mbkit.lagrangian.trig.shortest_form import complexity
from mbkit.lagrangian.trig.simplify import gradient, slope, tidy, tidy_matrix

#: A stop's conditions (Signorini; Newton's law of impact): always, where it is touched, and where it is hit.
_CONDITIONS: Final = (
    "0 ≤ {gap} ⟂ {force} ≥ 0",
    "in contact, ġ = 0: 0 ≤ {acceleration} ⟂ {force} ≥ 0",
    "in contact, ġ = {rate} < 0: ġ⁺ = {rebound}, M (v⁺ - v⁻) = Jᵀ Λ{others}, J = [{J}], Λ{alone} ≥ 0",
)
_IN_LATEX: Final = {"in contact": r"\text{in contact}", ", ": r",\ ", ": ": r":\ ", "⁻¹": "^{-1}"} | dict(
    zip("≤≥⟂ġ⁺⁻ᵀΛ", (r"\le", r"\ge", r"\perp", r"\dot{g}", "^{+}", "^{-}", "^{T}", r"\Lambda"), strict=True)
)


class Stop(NamedTuple):
    """A one-sided condition g >= 0 of a system: g, ġ and g̈, J = ∂ġ/∂v, λ of its force Jᵀ λ, and e of impacts on it."""

    gap: sp.Expr
    rate: sp.Expr
    acceleration: sp.Expr
    jacobian: sp.ImmutableMatrix
    multiplier: sp.Symbol
    restitution: sp.Expr


@dataclass(frozen=True, repr=False)
class EquationsOfMotion(Printable):
    """M v̇ + C v + d + ∂V/∂q = Q (+ Jᵀ λ), with q̇ = D v.

    Attributes
    ----------
    coordinates, velocities, accelerations, multipliers : tuple of sympy.Symbol
    mass_matrix, coriolis_matrix : (n, n) sympy.Matrix
        M = ∂²T/∂v², and C of Christoffel's symbols, so that Ṁ - 2C is skew.
    drift : (n, 1) sympy.Matrix
        d: gyroscopic terms of T1, rates of M and T1 with time, centrifugal ones of T0; zero where T = T2 without time.
    potential_gradient, forces : (n, 1) sympy.Matrix
        ∂V/∂q, and Q: generalized forces, Rayleigh's dissipation -∂R/∂v among them.
    constraint_jacobian : (m, n) sympy.Matrix
        J; no rows without constraints.
    constraint_acceleration, constraints : (m, 1) sympy.Matrix
        γ, the terms of J̇ v and of the time, so that J v̇ + γ = 0; and f(q, t), then A v + a of the velocity
        constraints, which are zero.
    stops : tuple of Stop
        Their forces are on the right side as well; `conditions` has what is no equation.
    """

    coordinates: tuple[sp.Symbol, ...]
    velocities: tuple[sp.Symbol, ...]
    accelerations: tuple[sp.Symbol, ...]
    mass_matrix: sp.ImmutableMatrix
    coriolis_matrix: sp.ImmutableMatrix
    drift: sp.ImmutableMatrix
    potential_gradient: sp.ImmutableMatrix
    forces: sp.ImmutableMatrix
    constraint_jacobian: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 0, []))
    constraint_acceleration: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 1, []))
    constraints: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 1, []))
    multipliers: tuple[sp.Symbol, ...] = ()
    stops: tuple[Stop, ...] = ()

    @cached_property
    def coriolis_force(self) -> sp.ImmutableMatrix:
        """C v, (n, 1)."""
        C, v = self.coriolis_matrix, sp.Matrix(self.velocities)
        # One product is as short as its factors.
        return tidy_matrix(C * v) if len(v) > 1 else sp.ImmutableMatrix(C * v)

    def velocity_terms(self) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix]:
        """Return C v in two parts, (n, 1) each: centrifugal terms of v_i², and Coriolis terms of v_i v_j.

        Craig 2005, Introduction to Robotics, ch. 6.8.
        """
        C, v = self.coriolis_matrix, self.velocities
        squares = [sum((sp.diff(C[i, j], w) * w**2 for j, w in enumerate(v)), sp.Integer(0)) for i in range(len(v))]
        centrifugal = tidy_matrix(sp.Matrix(squares))
        return centrifugal, tidy_matrix(self.coriolis_force - centrifugal)

    @property
    def applied(self) -> sp.ImmutableMatrix:
        """Q - C v - d - ∂V/∂q (+ Jᵀ λ), which is M v̇, (n, 1)."""
        return sp.ImmutableMatrix(self._right_side - self.coriolis_force - self.drift - self.potential_gradient)

    @property
    def _right_side(self) -> sp.ImmutableMatrix:
        """Q (+ Jᵀ λ), (n, 1)."""
        J, multipliers = self.constraint_jacobian, self.multipliers
        out = self.forces + J.T * sp.Matrix(multipliers) if multipliers else self.forces
        return sum((stop.jacobian.T * stop.multiplier for stop in self.stops), out)

    def _rows(self) -> list[tuple[list[sp.Expr], sp.Expr]]:
        """Return the terms of each left side in the order of textbooks, and its right side."""
        out = []
        for i, force in enumerate(self._right_side):
            terms = [m * a for m, a in zip(self.mass_matrix[i, :], self.accelerations, strict=True)]
            terms += [self.coriolis_force[i], self.drift[i], self.potential_gradient[i]]
            out.append(([x for x in terms if x != 0], force))
        return out + [([f], sp.Integer(0)) for f in self.constraints]

    def equations(self) -> tuple[sp.Eq, ...]:
        """Return one equation per coordinate: M v̇ + C v + d + ∂V/∂q on the left, Q on the right.

        Constraints follow, f = 0 or A v + a = 0 each.
        """
        return tuple(sp.Eq(sp.Add(*terms), force, evaluate=False) for terms, force in self._rows())

    def explicit(self) -> tuple[sp.Eq, ...]:
        """Return v̇ of each velocity, solved for in symbols: M⁻¹ (Q - C v - d - ∂V/∂q).

        Grows fast with the number of coordinates; `Lagrangian.dynamics` solves numerically instead.

        Raises
        ------
        UnsupportedError
            The mass matrix alone has no inverse, as of coordinates that only constraints bind.
        """
        n = len(self.accelerations)
        # One quotient is worth shortening; SymPy has no bound on its time for a solved system.
        shorter = tidy if n == 1 else sp.factor_terms
        try:
            solved = self.mass_matrix.LUsolve(self.applied)
        except NonInvertibleMatrixError:
            raise UnsupportedError(
                "explicit: the mass matrix has no inverse without the constraints; Lagrangian.dynamics solves with them"
            ) from None
        return tuple(sp.Eq(a, shorter(x), evaluate=False) for a, x in zip(self.accelerations, solved, strict=True))

    def conditions(self, write: Callable[[Any], str] = str, *, latex: bool = False) -> list[str]:
        """Return three conditions of each stop, with expressions as `write` has them; Λ is that of one hit alone."""

        def times(x: sp.Expr) -> str:
            return "-" if x == 1 else f"-({write(x)}) " if x.is_Add else f"-{write(x)} "

        out, others, alone = list[str](), " + Aᵀ P" if self.multipliers else "", not self.multipliers
        for s in self.stops:
            parts = {"gap": s.gap, "rate": s.rate, "acceleration": s.acceleration, "force": s.multiplier}
            texts = {name: write(x) for name, x in parts.items()} | {"J": ", ".join(write(x) for x in s.jacobian)}
            texts["rebound"] = f"{times(s.restitution)}ġ⁻" if not s.restitution.is_zero else "0"
            texts["alone"] = f" = {times(1 + s.restitution)}ġ⁻/(J M⁻¹ Jᵀ)" if alone else ""
            out += [x.format(**texts, others=others) for x in _CONDITIONS]
        for sign, command in _IN_LATEX.items() if latex else ():
            out = [line.replace(sign, command) for line in out]
        return out

    def latex(self, *, apart: bool = False) -> str:
        """Return the equations as an aligned LaTeX block, in the order of textbooks.

        Parameters
        ----------
        apart : bool
            Whether centrifugal terms, of v_i², stand before Coriolis terms, of v_i v_j, and not in one bracket.
        """
        board = ExpressionPrinter(self.coordinates, self.velocities, self.accelerations, self.multipliers)
        shown = (*self.mass_matrix, *self.coriolis_force, *self.drift, *self.potential_gradient, *self.forces)
        shown = (*shown, *self.constraints)
        short = Abbreviations(shown, set().union(*(x.free_symbols for x in shown)))
        pairs = printed_equations(self, board, short, latex=True, apart=apart)
        pairs += [(board.latex(letter), board.latex(root)) for letter, root in short.roots.items()]
        lines = [aligned(pairs), *self.conditions(board.latex, latex=True)]
        whole = r" \\ ".join(lines)
        return rf"\begin{{gathered}}{whole}\end{{gathered}}" if self.stops else whole

    def __str__(self) -> str:
        lines = [f"{_joined(terms, str)} = {force}" for terms, force in self._rows()]
        return terminal("\n".join([*lines, *self.conditions()]))


def _joined(terms: list[sp.Expr], printed: Callable[[sp.Expr], str]) -> str:
    """Return a sum in the order of its terms: SymPy's own order is the alphabet's."""
    flat = [x for term in terms for x in sp.Add.make_args(term)]
    out = ""
    for x in flat:
        text = printed(x)
        if not out:
            out = text
        else:
            out += f" - {text.removeprefix('-').lstrip()}" if text.startswith("-") else f" + {text}"
    return out or "0"


def printed_equations(
    e: EquationsOfMotion,
    board: ExpressionPrinter,
    short: Abbreviations,
    *,
    latex: bool = False,
    apart: bool = False,
    progress: Callable[[float, str], object] = lambda fraction, what: None,  # noqa: ARG005
) -> list[tuple[str, str]]:
    """Return the two sides of each equation and of each constraint; `progress` gets the fraction done."""
    join = board.latex_of if latex else board.text_of
    out, n = [], len(e.coordinates)
    moving = e.velocity_terms() if apart else (e.coriolis_force,)
    for i, force in enumerate(e._right_side):
        progress(i / n, f"equation {i + 1} of {n}")
        parts = [m * a for m, a in zip(e.mass_matrix[i, :], e.accelerations, strict=True)]
        parts += [*(_by_speeds(x[i], e.velocities) for x in moving), e.drift[i], spread(e.potential_gradient[i])]
        out.append((join(short(part) for part in parts), join([short(force)])))
    write = board.latex if latex else board.text
    return out + [(write(short(f)), "0") for f in e.constraints]


def _by_speeds(x: sp.Expr, velocities: tuple[sp.Symbol, ...]) -> sp.Expr:
    """Return a form quadratic in the velocities term by term, where that is shorter or frees cosines from brackets."""
    moving = [v for v in velocities if x.has(v)]
    if len(moving) < 2 or not x.has(sp.sin, sp.cos):
        return x
    pairs = combinations_with_replacement(moving, 2)
    # The second derivative of a square is twice its factor.
    terms = ((tidy(sp.diff(x, v, w) / (2 if v == w else 1)), v * w) for v, w in pairs)
    grouped = sp.Add(*(factor * pair for factor, pair in terms))
    brackets = (a for f in sp.preorder_traversal(x) if f.is_Mul for a in f.args if a.is_Add)
    return grouped if complexity(grouped) < complexity(x) or any(a.has(sp.sin, sp.cos) for a in brackets) else x


def equations_of_motion(system: EnergyForm, *, coriolis: bool = True) -> EquationsOfMotion:
    """Return Lagrange's equations of a system: d/dt ∂L/∂v - ∂L/∂q = Q + Jᵀ λ; C is zero without `coriolis`."""
    q, v, k, t = system.coordinates, sp.Matrix(system.velocities), system.kinetic, system.time
    n = len(q)
    drift = sp.zeros(n, 1)
    if any(k.b) or k.T0 != 0:
        curl = k.b.jacobian(q)
        drift += (curl - curl.T) * v - sp.Matrix(gradient(k.T0, q))
    if t is not None:
        drift += sp.diff(k.M, t) * v + sp.diff(k.b, t)
    losses = gradient(system.dissipation, system.velocities)
    inputs = [system.inputs.get(x, sp.Integer(0)) for x in q]
    forces = sp.Matrix(system.forces) + sp.Matrix(inputs) - sp.Matrix(losses)
    return EquationsOfMotion(
        coordinates=q,
        velocities=system.velocities,
        accelerations=system.accelerations,
        mass_matrix=k.M,
        coriolis_matrix=christoffel(k.M, q, system.velocities) if coriolis else sp.ImmutableMatrix.zeros(n),
        drift=tidy_matrix(drift),
        potential_gradient=sp.ImmutableMatrix(gradient(system.V, q)),
        forces=tidy_matrix(forces),
        **constraint_fields(system, v),
    )


def constraint_fields(system: EnergyForm, qdot: sp.Matrix) -> dict[str, Any]:
    """Return the fields of `EquationsOfMotion` that constraints fill, with the coordinates' rates in velocities."""
    m, t, v = len(system.multiplier_symbols), system.time, sp.Matrix(system.velocities)

    def along(x: sp.Matrix) -> sp.Matrix:
        return x.jacobian(system.coordinates) * qdot + (0 * x if t is None else sp.diff(x, t))

    def stop(g: sp.Expr, *others: Any) -> Stop:
        rate = tidy_matrix(along(sp.Matrix([g])))
        J = tidy_matrix(rate.jacobian(v))
        return Stop(g, rate[0], tidy((J * sp.Matrix(system.accelerations) + along(rate))[0]), J, *others)

    rate = system.constraint_matrix * v + system.constraint_drift
    return {
        "constraint_jacobian": system.constraint_matrix,
        "constraint_acceleration": tidy_matrix(along(rate) if m else rate),
        "constraints": sp.ImmutableMatrix(m, 1, [*system.constraints, *system.velocity_constraints]),
        "multipliers": system.multiplier_symbols,
        "stops": tuple(map(stop, system.stops, system.stop_multipliers, system.restitution)),
    }


def christoffel(M: Any, coordinates: Any, velocities: Any) -> sp.ImmutableMatrix:
    """Return C_ij = ½ Σ_k (∂M_ij/∂q_k + ∂M_ik/∂q_j - ∂M_jk/∂q_i) v_k (Spong, Hutchinson, Vidyasagar 2006, eq. 7.63)."""
    n = len(coordinates)
    dM = [sp.Matrix(M).applyfunc(lambda x, q=q: slope(x, q)) for q in coordinates]

    def entry(i: int, j: int) -> sp.Expr:
        return tidy(sum((dM[k][i, j] + dM[j][i, k] - dM[i][j, k]) * velocities[k] for k in range(n)) / 2)

    return sp.ImmutableMatrix(n, n, entry)
