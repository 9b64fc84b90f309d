"""Equations of motion as lines on a blackboard: accelerations, then velocities, then the potential."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations_with_replacement

import sympy as sp

from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion
from mbkit.lagrangian.printing.printer import Abbreviations, Blackboard, spread
from mbkit.lagrangian.trig.shortest_form import cost
from mbkit.lagrangian.trig.simplify import tidy

__all__ = ["board_of", "letters_for", "lines"]


def board_of(e: EquationsOfMotion) -> Blackboard:
    """Return how the expressions of a system are written."""
    return Blackboard(e.coordinates, e.velocities, e.accelerations, e.multipliers)


def letters_for(e: EquationsOfMotion) -> Abbreviations:
    """Return letters for the long roots of a system's equations."""
    shown = (*e.mass_matrix, *e.coriolis_force, *e.drift, *e.potential_gradient, *e.forces, *e.constraints)
    return Abbreviations(shown, set().union(*(x.free_symbols for x in shown)))


def lines(
    e: EquationsOfMotion,
    board: Blackboard,
    short: Abbreviations,
    *,
    latex: bool = False,
    progress: Callable[[float, str], object] = lambda fraction, what: None,  # noqa: ARG005
) -> list[tuple[str, str]]:
    """Return the two sides of each equation and of each constraint; `progress` gets the fraction done."""
    right = e.forces
    if e.multipliers:
        right = right + e.constraint_jacobian.T * sp.Matrix(e.multipliers)
    join = board.latex_of if latex else board.text_of
    out = []
    for i, force in enumerate(right):
        progress(i / len(right), f"equation {i + 1} of {len(right)}")
        parts = [m * a for m, a in zip(e.mass_matrix[i, :], e.accelerations, strict=True)]
        parts += [by_speeds(e.coriolis_force[i], e.velocities), e.drift[i], spread(e.potential_gradient[i])]
        out.append((join(short(part) for part in parts), join([short(force)])))
    write = board.latex if latex else board.text
    return out + [(write(short(f)), "0") for f in e.constraints]


def by_speeds(x: sp.Expr, velocities: tuple[sp.Symbol, ...]) -> sp.Expr:
    """Return what is quadratic in the velocities term by term, where that is shorter or frees cosines from brackets."""
    moving = [v for v in velocities if x.has(v)]
    if len(moving) < 2 or not x.has(sp.sin, sp.cos):
        return x
    pairs = combinations_with_replacement(moving, 2)
    # Of a square the second derivative is twice its factor.
    terms = ((tidy(sp.diff(x, v, w) / (2 if v == w else 1)), v * w) for v, w in pairs)
    grouped = sp.Add(*(factor * pair for factor, pair in terms))
    brackets = (a for f in sp.preorder_traversal(x) if f.is_Mul for a in f.args if a.is_Add)
    return grouped if cost(grouped) < cost(x) or any(a.has(sp.sin, sp.cos) for a in brackets) else x
