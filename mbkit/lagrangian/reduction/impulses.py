"""Impacts on paper: Lagrange's equation integrated over a time that goes to zero.

Momenta jump by the impulses, p⁺ - p⁻ = Ŝ + Jᵀ P, while coordinates stay. Rows J are those of the system's constraints,
of constraints that are imposed at once, and of contacts that rebound: G v⁺ = -e G v⁻ (Pars 1965, A Treatise on
Analytical Dynamics, ch. XIV; Greenwood 2003, Advanced Dynamics, ch. 6). `mbkit.impact` has the same in numbers, on any
engine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import sympy as sp
from sympy.matrices.exceptions import NonInvertibleMatrixError

from mbkit._escape import terminal
from mbkit.errors import InputError
from mbkit.lagrangian.energies.energy_form import EnergyForm, read_expression, symbols_of, vanish
from mbkit.lagrangian.energies.symbols import free_name, listed, name_of, plain
from mbkit.lagrangian.printer import ExpressionPrinter, Printable, aligned
from mbkit.lagrangian.trig.simplify import tidy


@dataclass(frozen=True, repr=False)
class ImpulseEquations(Printable):
    """M (v⁺ - v⁻) = Ŝ + Jᵀ P with rows of v⁺, the result of `Lagrangian.impulse`.

    Attributes
    ----------
    velocities, velocities_after : tuple of sympy.Symbol
        v⁻ and v⁺: ``thetadot`` and ``thetadot_after``.
    impulse_symbols : tuple of sympy.Symbol
        P of each row.
    mass_matrix : (n, n) sympy.Matrix
    impulses : (n, 1) sympy.Matrix
        Ŝ.
    jacobian : (k, n) sympy.Matrix
    right : (k, 1) sympy.Matrix
        J v⁺, in what is known before.
    """

    coordinates: tuple[sp.Symbol, ...]
    velocities: tuple[sp.Symbol, ...]
    velocities_after: tuple[sp.Symbol, ...]
    impulse_symbols: tuple[sp.Symbol, ...]
    mass_matrix: sp.ImmutableMatrix
    impulses: sp.ImmutableMatrix
    jacobian: sp.ImmutableMatrix
    right: sp.ImmutableMatrix

    def equations(self) -> tuple[sp.Eq, ...]:
        """Return the jump of each momentum, then the rows of v⁺."""
        after = sp.Matrix(self.velocities_after)
        change = after - sp.Matrix(self.velocities)
        pushed = self.impulses + self.jacobian.T * sp.Matrix(len(self.impulse_symbols), 1, self.impulse_symbols)
        jumps = zip(self.mass_matrix * change, pushed, strict=True)
        rows = zip(self.jacobian * after, self.right, strict=True)
        return tuple(sp.Eq(a, b, evaluate=False) for a, b in (*jumps, *rows))

    @cached_property
    def _solved(self) -> sp.Matrix:
        M, J, n = self.mass_matrix, self.jacobian, len(self.velocities)
        whole = sp.Matrix(sp.BlockMatrix([[M, -J.T], [J, sp.zeros(J.rows)]])) if J.rows else sp.Matrix(M)
        before = self.impulses + M * sp.Matrix(self.velocities)
        try:
            solved = whole.LUsolve(sp.Matrix(before).col_join(self.right))
        except NonInvertibleMatrixError:
            raise InputError(
                "rows: they depend on each other, or on the system's constraints, so that impulses are undetermined; "
                "leave one out"
            ) from None
        assert solved.rows == n + J.rows
        return solved.applyfunc(tidy)

    def after(self) -> dict[sp.Symbol, sp.Expr]:
        """Return v⁺ of each velocity, solved for in symbols."""
        return dict(zip(self.velocities_after, self._solved[: len(self.velocities)], strict=True))

    def reactions(self) -> dict[sp.Symbol, sp.Expr]:
        """Return P of each row, solved for in symbols."""
        return dict(zip(self.impulse_symbols, self._solved[len(self.velocities) :], strict=True))

    @property
    def energy_change(self) -> sp.Expr:
        """T⁺ - T⁻ in symbols."""
        after, before = sp.Matrix(list(self.after().values())), sp.Matrix(self.velocities)
        return tidy(((after - before).T * self.mass_matrix * (after + before))[0] / 2)

    def latex(self) -> str:
        """Return the equations as an aligned LaTeX block."""
        board = ExpressionPrinter(self.coordinates, self.velocities, self.velocities_after, self.impulse_symbols)
        return aligned((board.latex(e.lhs), board.latex(e.rhs)) for e in self.equations())

    def __str__(self) -> str:
        return terminal("\n".join(f"{e.lhs} = {e.rhs}" for e in self.equations()))


def impulse_equations(
    system: EnergyForm, impulses: Mapping[Any, Any] | None, rows: Sequence[Any], restitution: Any
) -> ImpulseEquations:
    """Return the equations of an impact; arguments are those of `Lagrangian.impulse`."""
    rows = () if rows is None else rows
    rows = listed("rows", rows) if isinstance(rows, (sp.Basic, str)) or not hasattr(rows, "__len__") else list(rows)
    if not impulses and not rows:
        raise InputError("impulses: expected impulses on coordinates or rows that are imposed, got neither")
    n, applied = len(system.coordinates), _given(system, impulses or {})
    G = [_row(system, f"rows[{k}]", row) for k, row in enumerate(rows)]
    e = read_expression(system, "restitution", restitution, others=True)
    if e.is_number and not 0 <= e <= 1:
        raise InputError(f"restitution: expected a number from 0 to 1, got {restitution!r}")
    moving = e.free_symbols & set(system.velocities)
    if moving:
        raise InputError(f"restitution: expected a number or parameters, got the velocity {plain(moving)} in {e}")
    v, own = sp.Matrix(system.velocities), system.constraint_matrix
    J = sp.Matrix(own).col_join(sp.Matrix(len(G), n, [x for row, _ in G for x in row]))
    rebound = [-e * (sp.Matrix([row]) * v)[0] - (1 + e) * rest for row, rest in G]
    # Symbols of the arguments keep their names.
    shown = sp.Tuple(e, *applied, *(x for row, rest in G for x in (*row, rest)))
    used = {s.name for s in (*symbols_of(system), *shown.free_symbols)}
    after = tuple(sp.Symbol(free_name(f"{w.name}_after", used)) for w in system.velocities)
    names = tuple(sp.Symbol(free_name(f"P{k + 1}", used)) for k in range(J.rows))
    return ImpulseEquations(
        coordinates=system.coordinates,
        velocities=system.velocities,
        velocities_after=after,
        impulse_symbols=names,
        mass_matrix=system.kinetic.M,
        impulses=sp.ImmutableMatrix(applied),
        jacobian=sp.ImmutableMatrix(J),
        right=sp.ImmutableMatrix([*(-x for x in system.constraint_drift), *rebound])
        if J.rows
        else sp.ImmutableMatrix(0, 1, []),
    )


def _given(system: EnergyForm, impulses: Mapping[Any, Any]) -> list[sp.Expr]:
    if not isinstance(impulses, Mapping):
        raise InputError(f"impulses: expected {{coordinate: impulse}}, got {impulses!r}")
    out, names = [sp.Integer(0)] * len(system.coordinates), [q.name for q in system.coordinates]
    for key, value in impulses.items():
        if name_of(key) not in names:
            raise InputError(f"impulses: {key} is no coordinate; the coordinates are {', '.join(names)}")
        if [name_of(x) for x in impulses].count(name_of(key)) > 1:
            raise InputError(f"impulses: {key} stands twice; add the impulses along it")
        out[names.index(name_of(key))] = read_expression(system, f"impulses[{key}]", value, others=True)
    return out


def _row(system: EnergyForm, what: str, source: Any) -> tuple[list[sp.Expr], sp.Expr]:
    """Return the slopes of a row in the velocities, and what it is at rest."""
    x = source.lhs - source.rhs if isinstance(source, sp.Equality) else source
    x = read_expression(system, what, x, others=True)
    slopes = [sp.diff(x, w) for w in system.velocities]
    if not any(slopes) or not vanish(sp.diff(s, w) for s in slopes for w in system.velocities):
        raise InputError(f"{what}: expected an expression that is linear in the velocities, got {x}")
    return slopes, x.subs(dict.fromkeys(system.velocities, 0))
