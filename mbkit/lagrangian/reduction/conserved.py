"""Conserved quantities: momenta of cyclic coordinates along which nothing acts, and Jacobi's integral.

Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 2.6 and 2.7.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import sympy as sp

from mbkit._escape import terminal
from mbkit.lagrangian.energies.energy_form import EnergyForm, acting_forces, vanish
from mbkit.lagrangian.printer import ExpressionPrinter, Printable

#: Meaning of h where it is not the energy.
JACOBI: Final = "Jacobi's integral T2 - T0 + V, not the energy T + V"


@dataclass(frozen=True, repr=False)
class ConservedQuantity(Printable):
    """A constant of every motion.

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
        # As its author wrote it.
        return system.T + system.V
    k = system.kinetic
    return k.T2 - k.T0 + system.V


def is_energy(system: EnergyForm) -> bool:
    """Return whether h, and with it H, is the energy T + V: where T1 = T0 = 0."""
    k = system.kinetic
    return not any(k.b) and k.T0 == 0


def keeps_energy(system: EnergyForm) -> bool:
    """Return whether h is constant: dh/dt = Qᵀ v - ∂L/∂t, and moving constraints do work too."""
    if system.time is not None:
        k, t = system.kinetic, system.time
        if not vanish(sp.diff(x, t) for x in (*k.M, *k.b, k.T0, system.V, *system.constraints)):
            return False
    power = sum((x * w for x, w in zip(acting_forces(system), system.velocities, strict=True)), sp.Integer(0))
    return vanish([power])


def conserved_quantities(
    system: EnergyForm, momenta: Mapping[sp.Symbol, sp.Expr], energy: sp.Expr, moving: tuple[sp.Symbol, ...]
) -> tuple[ConservedQuantity, ...]:
    """Return the conserved momenta, and the energy or Jacobi's integral if it is constant, in `moving` velocities."""
    symbols = (system.coordinates, moving)
    out = [
        ConservedQuantity(f"p_{q.name}", p, f"momentum of {q.name}, which is cyclic", symbols)
        for q, p in momenta.items()
    ]
    if keeps_energy(system):
        name, meaning = ("E", "energy T + V") if is_energy(system) else ("h", JACOBI)
        out.append(ConservedQuantity(name, energy, meaning, symbols))
    return tuple(out)
