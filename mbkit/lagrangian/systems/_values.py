"""Reading the values of a system's parameters."""

from __future__ import annotations

import sympy as sp

from mbkit._check import real

__all__ = ["Value", "values"]

#: A parameter's value in SI units; None for one that is given later.
Value = float | None


def values(
    positive: dict[str, tuple[sp.Symbol, Value]], free: dict[str, tuple[sp.Symbol, Value]] | None = None
) -> dict[sp.Symbol, Value]:
    """Return values by symbol: those above zero, then those that may be any number.

    Parameters
    ----------
    positive, free : dict
        Argument's name -> its symbol and value.
    """
    out: dict[sp.Symbol, Value] = {}
    for given, above in ((positive, True), (free or {}, False)):
        for name, (symbol, value) in given.items():
            out[symbol] = None if value is None else real(name, value, positive=above)
    return out
