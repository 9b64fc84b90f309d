"""Canonical momenta as symbols, and Poisson's bracket on coordinates and momenta."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import sympy as sp

from mbkit.lagrangian.probe import vanishes
from mbkit.lagrangian.symbols import free_name
from mbkit.lagrangian.tidy import tidy

if TYPE_CHECKING:
    from mbkit.lagrangian.system import Lagrangian

__all__ = ["bracket", "momentum_symbols", "shorter"]

# Operations up to which a bracket is tidied.
_SHORT: Final = 100


def momentum_symbols(system: Lagrangian, coordinates: Iterable[sp.Symbol]) -> tuple[sp.Symbol, ...]:
    """Return a symbol for each coordinate's momentum: theta -> p_theta, or P_theta where that is taken already."""
    own = (*system.parameters, *system.coordinates, *system.velocities, *system.inputs.values())
    taken = {s.name for s in (*own, *([system.time] if system.time is not None else []))}
    out = []
    for q in coordinates:
        out.append(sp.Symbol(free_name(f"p_{q.name}", taken)))
        taken.add(out[-1].name)
    return tuple(out)


def bracket(f: Any, g: Any, coordinates: Sequence[sp.Symbol], momenta: Sequence[sp.Symbol]) -> sp.Expr:
    """Return {f, g} = Σ ∂f/∂q ∂g/∂p - ∂f/∂p ∂g/∂q, tidied, so that {q, p} = 1.

    Goldstein, Poole, Safko 2002, Classical Mechanics, eq. (9.67).
    """
    terms = (
        sp.diff(f, q) * sp.diff(g, p) - sp.diff(f, p) * sp.diff(g, q) for q, p in zip(coordinates, momenta, strict=True)
    )
    return shorter(sum(terms, sp.Integer(0)))


def shorter(x: sp.Expr) -> sp.Expr:
    """Return a short bracket tidied, and a long one as it is unless it is zero: nested ones grow fast."""
    if vanishes(x):
        return sp.Integer(0)
    return tidy(x) if x.count_ops() <= _SHORT else x
