"""SymPy's expressions as exact sums of cosines and sines, and back in a short form."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, Final

import sympy as sp

from mbkit.errors import UnsupportedError
from mbkit.lagrangian.compact import written_out
from mbkit.lagrangian.harmonic import Harmonic, Space

__all__ = ["shortened"]

#: Products of terms that one expression may cost: about a second.
_MOST: Final = 100_000
_HIGHEST: Final = 12


def shortened(x: sp.Expr) -> sp.Expr | None:
    """Return a short form of a polynomial of cosines, sines, symbols and other functions; None of what is long.

    Cosines and sines of sums are combined, and cancel where they do: what
    `sympy.trigsimp` searches for is found without a search.
    """
    angles: dict[sp.Expr, None] = {}
    generators: dict[sp.Expr, None] = {}
    if not _known(x, angles, generators):
        return None
    space = Space("expression", list(angles), list(generators), _MOST)
    try:
        return written_out(_sum(x, space), decimals=x.has(sp.Float))
    except UnsupportedError:
        return None


def _known(x: sp.Expr, angles: dict[sp.Expr, None], generators: dict[sp.Expr, None]) -> bool:
    """Gather angles and generators; return whether the expression is a polynomial of them."""
    if x.is_Rational or x.is_Float:
        return True
    if isinstance(x, (sp.sin, sp.cos)):
        angles.update(dict.fromkeys(_turns(x.args[0])))
        return True
    if x.is_Add or x.is_Mul:
        return all(_known(e, angles, generators) for e in x.args)
    if x.is_Pow and x.exp.is_Integer and 0 < x.exp <= _HIGHEST:
        return _known(x.base, angles, generators)
    root = _root(x)
    if root is None:
        return False
    generators[root[0]] = None
    return True


def _root(x: sp.Expr) -> tuple[sp.Expr, int] | None:
    """Return what is not looked into, and its power: a symbol, a root, a reciprocal or a function of anything."""
    if x.is_Symbol or x.is_Function or x.is_NumberSymbol:
        return x, 1
    if not x.is_Pow or not x.exp.is_Rational or abs(x.exp) > _HIGHEST:
        return None
    if x.exp.q == 2:
        return sp.sqrt(x.base), int(x.exp.p)
    if x.exp.q != 1:
        return None
    return (x.base, int(x.exp)) if x.base.is_Symbol else (1 / x.base, -int(x.exp))


def _turns(angle: sp.Expr) -> dict[sp.Expr, int]:
    """Return an angle as whole multiples of others."""
    out = {}
    for term in sp.Add.make_args(sp.expand(angle)):
        value, rest = term.as_coeff_Mul()
        if value.is_Integer and rest != 1:
            out[rest] = int(value)
        else:
            out[term] = 1
    return out


def _sum(x: Any, space: Space) -> Harmonic:
    if x.is_Float:
        return space.number(Fraction(repr(float(x))))
    if x.is_Rational:
        return space.number(Fraction(int(x.p), int(x.q)))
    if isinstance(x, (sp.sin, sp.cos)):
        return space.turned(int(isinstance(x, sp.sin)), _turns(x.args[0]))
    if x.is_Pow and x.exp.is_Integer and x.exp > 0:
        base = _sum(x.base, space)
        out = base
        for _ in range(int(x.exp) - 1):
            out = out * base
        return out
    root = _root(x)
    if root is not None:
        return space.power(*root)
    parts = [_sum(e, space) for e in x.args]
    out = parts[0]
    for part in parts[1:]:
        out = out + part if x.is_Add else out * part
    return out
