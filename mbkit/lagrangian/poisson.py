"""Canonical momenta as symbols, and Poisson's bracket on coordinates and momenta."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Final

import sympy as sp

from mbkit.lagrangian.tidy import tidy

__all__ = ["bracket", "momentum_symbol", "shorter"]

# Operations up to which a bracket is tidied.
_SHORT: Final = 50


def momentum_symbol(coordinate: sp.Symbol, taken: Collection[str]) -> sp.Symbol:
    """Return the symbol of a coordinate's momentum: theta -> p_theta, or P_theta where that is taken already."""
    name = f"p_{coordinate.name}"
    while name in taken:
        name = name.capitalize() if name[0] == "p" else f"{name}_"
    return sp.Symbol(name)


def bracket(f: Any, g: Any, coordinates: Sequence[sp.Symbol], momenta: Sequence[sp.Symbol]) -> sp.Expr:
    """Return {f, g} = Σ ∂f/∂q ∂g/∂p - ∂f/∂p ∂g/∂q, tidied, so that {q, p} = 1.

    Goldstein, Poole, Safko 2002, Classical Mechanics, eq. (9.67).
    """
    terms = (
        sp.diff(f, q) * sp.diff(g, p) - sp.diff(f, p) * sp.diff(g, q) for q, p in zip(coordinates, momenta, strict=True)
    )
    return shorter(sum(terms, sp.Integer(0)))


def shorter(x: sp.Expr) -> sp.Expr:
    """Return a short bracket tidied, and a long one as it is: nested ones grow fast."""
    return tidy(x) if x.count_ops() <= _SHORT else x
