"""What a system keeps: the momenta of cyclic coordinates, and Jacobi's integral.

A coordinate is cyclic where L does not hold it. Its momentum p = ∂L/∂v is then constant,
provided that no force, input, dissipation or constraint acts along it (Goldstein,
Poole, Safko 2002, Classical Mechanics, ch. 2.6). The energy function h = vᵀ ∂L/∂v - L is
T2 - T0 + V, and is constant where L does not hold the time and nothing does work; it is
the energy T + V where T has neither T1 nor T0 (ch. 2.7).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import sympy as sp

from mbkit._escape import one_line, terminal
from mbkit.lagrangian.printing.printer import Blackboard
from mbkit.lagrangian.trig.simplify import tidy
from mbkit.lagrangian.trig.zero_test import vanishes

if TYPE_CHECKING:
    from mbkit.lagrangian.system import Lagrangian

__all__ = [
    "ConservedQuantity",
    "acting",
    "conserved_momenta",
    "conserved_quantities",
    "cyclic_coordinates",
    "energy_function",
    "is_energy",
    "keeps_energy",
]


@dataclass(frozen=True)
class ConservedQuantity:
    """What stays as it is along every motion.

    Attributes
    ----------
    name : str
        ``"p_phi"`` for the momentum of ``phi``; ``"E"`` for the energy, ``"h"`` for Jacobi's
        integral where that is something else.
    expression : sympy.Expr
    meaning : str
        In words.
    moving : tuple of tuples of sympy.Symbol
        Coordinates and velocities, or momenta, in the order in which they are written.
    """

    name: str
    expression: sp.Expr
    meaning: str
    moving: tuple[tuple[sp.Symbol, ...], ...] = field(default=(), repr=False, compare=False)

    def __repr__(self) -> str:
        return f"<ConservedQuantity: {one_line(str(self))}>"

    def __str__(self) -> str:
        return terminal(f"{self.name} = {self.expression} ({self.meaning})")

    def latex(self) -> str:
        """Return name = expression."""
        board = Blackboard(*self.moving)
        return f"{board.latex(sp.Symbol(self.name))} = {board.latex(self.expression)}"

    def _repr_latex_(self) -> str:
        return f"${self.latex()}$"


def _vanish(parts: Iterable[sp.Expr]) -> bool:
    # Decimals that cancel do so in their own digits only.
    return all(vanishes(x) or (x.has(sp.Float) and tidy(x) == 0) for x in parts)


def _in_no_energy(system: Lagrangian, q: sp.Symbol) -> bool:
    """Return whether ∂L/∂q = 0: term by term in the velocities, so that each is short."""
    k = system.kinetic
    return _vanish(sp.diff(x, q) for x in (*k.M, *k.b, k.T0, system.V))


def acting(system: Lagrangian) -> list[sp.Expr]:
    """Return the generalized forces beside V's: forces, inputs and dissipation, one a coordinate."""
    named = zip(system.coordinates, system.velocities, system.forces, strict=True)
    # Not from the equations of motion, whose Christoffel symbols nobody asks for here.
    return [tidy(x + system.inputs.get(q, sp.Integer(0)) - sp.diff(system.dissipation, w)) for q, w, x in named]


def _along(system: Lagrangian) -> dict[sp.Symbol, sp.Expr]:
    """Return what acts along each coordinate beside V, the constraints with their λ among it."""
    multipliers = list(zip(system.multiplier_symbols, system.constraints, strict=True))
    return {
        q: tidy(x + sum((sp.diff(f, q) * symbol for symbol, f in multipliers), sp.Integer(0)))
        for q, x in zip(system.coordinates, acting(system), strict=True)
    }


def cyclic_coordinates(system: Lagrangian) -> tuple[dict[sp.Symbol, sp.Expr], tuple[sp.Symbol, ...]]:
    """Return the force along each coordinate that L does not hold, and those of them along which there is none."""
    forces = _along(system)
    cyclic = {q: forces[q] for q in system.coordinates if _in_no_energy(system, q)}
    return cyclic, tuple(q for q, force in cyclic.items() if force == 0)


def conserved_momenta(system: Lagrangian) -> dict[sp.Symbol, sp.Expr]:
    """Return ∂L/∂v of each cyclic coordinate along which nothing acts."""
    free = system.cyclic_coordinates()
    return {q: p for q, p in zip(system.coordinates, system.momenta, strict=True) if q in free}


def energy_function(system: Lagrangian) -> sp.Expr:
    """Return h = vᵀ ∂L/∂v - L = T2 - T0 + V."""
    if is_energy(system):
        # As its author wrote it.
        return system.T + system.V
    k = system.kinetic
    return k.T2 - k.T0 + system.V


def is_energy(system: Lagrangian) -> bool:
    """Return whether h, and with it H, is the energy T + V: where T1 = T0 = 0."""
    k = system.kinetic
    return not any(k.b) and k.T0 == 0


def keeps_energy(system: Lagrangian) -> bool:
    """Return whether h is constant: dh/dt = Qᵀ v - ∂L/∂t, and moving constraints do work too."""
    if system.time is not None:
        k, t = system.kinetic, system.time
        if not _vanish(sp.diff(x, t) for x in (*k.M, *k.b, k.T0, system.V, *system.constraints)):
            return False
    power = sum((x * w for x, w in zip(acting(system), system.velocities, strict=True)), sp.Integer(0))
    return _vanish([power])


def conserved_quantities(system: Lagrangian, form: Lagrangian | None = None) -> tuple[ConservedQuantity, ...]:
    """Return the conserved momenta, and the energy or Jacobi's integral if that is constant.

    Parameters
    ----------
    system : Lagrangian
        In its coordinates' rates.
    form : Lagrangian, optional
        The same in other velocities, to write them in.
    """
    form = form or system
    moving = (form.coordinates, form.velocities)
    out = [
        ConservedQuantity(f"p_{q.name}", p, f"momentum of {q.name}, which is cyclic", moving)
        for q, p in form.conserved_momenta().items()
    ]
    if keeps_energy(system):
        if is_energy(system):
            out.append(ConservedQuantity("E", form.energy_function, "energy T + V", moving))
        else:
            told = "Jacobi's integral T2 - T0 + V, not the energy T + V"
            out.append(ConservedQuantity("h", form.energy_function, told, moving))
    return tuple(out)
