"""Expressions as functions of arrays, in CasADi's machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import sympy as sp

from mbkit._check import Array, real
from mbkit.derivation.machine import Machine
from mbkit.errors import InputError, UnknownNameError
from mbkit.lagrangian.conversion import Conversion

if TYPE_CHECKING:
    from mbkit.lagrangian.system import Lagrangian

__all__ = ["Numeric", "values_of"]


class Numeric:
    """A matrix of expressions as a function of vectors of symbols.

    Parameters
    ----------
    expressions : (m, n) sympy.Matrix
    *arguments : sequence of sympy.Symbol
        One for each argument; not all of them are empty.
    """

    def __init__(self, expressions: Any, *arguments: Sequence[sp.Symbol]) -> None:
        given = [ca.SX.sym(f"x{k}", len(symbols)) for k, symbols in enumerate(arguments)]
        self._shape = expressions.shape
        names = {s: x[i] for symbols, x in zip(arguments, given, strict=True) for i, s in enumerate(symbols)}
        column = Conversion(names, float).matrix(list(expressions))
        self._machine = Machine(ca.Function("expressions", given, [ca.densify(column)], {"cse": True}))

    def __call__(self, *arguments: Array) -> Array:
        """Return the matrix at one state, (m, n), or at each of a batch, (N, m, n)."""
        lead = np.broadcast_shapes(*(x.shape[:-1] for x in arguments))
        rows = [np.ascontiguousarray(np.broadcast_to(x, (*lead, x.shape[-1])), dtype=np.float64) for x in arguments]
        return self._machine(*rows)[0].reshape(*lead, *self._shape)


def values_of(system: Lagrangian, values: Mapping[str, float], what: str) -> Array:
    """Return the numbers of a system's parameters in their order, with some replaced.

    Raises
    ------
    InputError, UnknownNameError
        A parameter without a value; no such parameter.
    """
    names = {s.name: x for s, x in system.parameters.items()}
    for name in values:
        if name not in names:
            raise UnknownNameError("parameter", name, names)
    told = {**names, **{n: real(f"parameter {n!r}", x) for n, x in values.items()}}
    missing = [n for n, x in told.items() if x is None]
    if missing:
        given = ", ".join(f"{n}=..." for n in missing)
        raise InputError(f"{what}: no value for parameter {', '.join(map(repr, missing))}; give it as {given}")
    return np.array(list(told.values()), dtype=np.float64)
