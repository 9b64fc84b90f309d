"""Arrays of numbers with 113 bits, about 34 digits: heyoka's or mpmath's.

Both round to the format of IEEE 754's binary128. heyoka's `real128` is a NumPy type
whose loops run in C; where heyoka is not installed, or its build has no `real128`,
arrays hold mpmath's numbers, some twenty times slower.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final, Literal

import numpy as np

from mbkit._check import Array
from mbkit.errors import InputError, UnsupportedError

__all__ = ["BITS", "Arithmetic", "Backend", "arithmetic", "digits", "mpmath_context"]

Backend = Literal["real128", "mpmath"]
BITS: Final = 113

#: Functions' names in C -> in NumPy.
_FUNCTIONS: Final = {
    "sqrt": "sqrt",
    "sin": "sin",
    "cos": "cos",
    "tan": "tan",
    "asin": "arcsin",
    "acos": "arccos",
    "atan": "arctan",
    "atan2": "arctan2",
    "exp": "exp",
    "expm1": "expm1",
    "log": "log",
    "log1p": "log1p",
    "sinh": "sinh",
    "cosh": "cosh",
    "tanh": "tanh",
    "asinh": "arcsinh",
    "acosh": "arccosh",
    "atanh": "arctanh",
    "pow": "power",
}
#: Beyond it binary128 has no numbers, nor anything between 0 and its inverse.
_LARGEST: Final = 16384


@dataclass(frozen=True)
class Arithmetic:
    """What computes with arrays of 113-bit numbers.

    Attributes
    ----------
    name : {"real128", "mpmath"}
    dtype : type
        Of the arrays.
    number : callable
        From a float to one number, exactly.
    divide : callable
        Of arrays; sums, differences and products are NumPy's own operators.
    functions : mapping of str to callable
        Of arrays, by their names in C: sqrt, sin, ..., pow. Outside of its domain a
        function is no number.
    """

    name: Backend
    dtype: Any
    number: Callable[[float], Any]
    divide: Callable[[Any, Any], Any]
    functions: Mapping[str, Callable[..., Any]] = field(compare=False, repr=False)

    def sqrt(self, x: Any) -> Any:
        """Return square roots."""
        return self.functions["sqrt"](x)

    def array(self, x: Any) -> Any:
        """Return an array of floats, or one that is extended already, as 113-bit numbers."""
        x = np.asarray(x)
        if x.dtype == np.dtype(self.dtype):
            return x
        if self.dtype is object:
            return np.frompyfunc(self.number, 1, 1)(x.astype(np.float64))
        return x.astype(self.dtype)

    def zeros(self, shape: tuple[int, ...]) -> Any:
        """Return zeros."""
        return np.full(shape, self.number(0.0), dtype=self.dtype)

    def pair(self, x: Any) -> tuple[Array, Array]:
        """Return (high, low): the numbers rounded to double, and the rounded rest."""
        with np.errstate(all="ignore"):
            high = np.asarray(x).astype(np.float64)
            return high, np.asarray(x - self.array(high)).astype(np.float64)

    def from_pair(self, high: Array, low: Array) -> Any:
        """Return high + low."""
        return self.array(high) + self.array(low)


@cache
def arithmetic(name: Backend | None = None) -> Arithmetic:
    """Return a backend; by default the faster one that is at hand.

    Raises
    ------
    InputError
        No backend of this name.
    UnsupportedError
        heyoka, or its `real128`, is not installed.
    """
    if name not in (None, "real128", "mpmath"):
        raise InputError(f"arithmetic: expected 'real128' or 'mpmath', got {name!r}")
    if name == "mpmath":
        return _mpmath()
    try:
        import heyoka
    except ImportError:
        heyoka = None
    if hasattr(heyoka, "real128"):
        functions = {name: getattr(np, its) for name, its in _FUNCTIONS.items()}
        return Arithmetic("real128", heyoka.real128, heyoka.real128, np.divide, functions)
    if name == "real128":
        raise UnsupportedError("real128 takes heyoka, built with it; pip install heyoka (Linux), or use 'mpmath'")
    return _mpmath()


@cache
def mpmath_context() -> Any:
    """Return a context of mpmath's of our own, so that nobody's `mp.prec` is touched."""
    import mpmath

    context = mpmath.MPContext()
    context.prec = BITS
    return context


def _mpmath() -> Arithmetic:
    context = mpmath_context()

    def divide(a: Any, b: Any) -> Any:
        # As IEEE 754 has it, so that a singular matrix is found where results are checked.
        return a / b if b != 0 else context.sign(a) * context.inf

    def real(function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that is no number where mpmath's is complex or a pole, as with IEEE 754."""

        def within(*x: Any) -> Any:
            try:
                y = function(*x)
            except (ValueError, ZeroDivisionError):
                return context.nan
            return y if isinstance(y, context.mpf) else context.nan

        return within

    def bounded(growing: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Return a function that grows like exp, within the range of binary128: mpmath has no bounds but memory."""
        most = context.mpf(_LARGEST) * context.ln2
        return lambda x: growing(x if abs(x) < most else context.sign(x) * context.inf)

    def power(a: Any, b: Any) -> Any:
        if b == 0 or a == 1:
            return context.one
        if a == 0:
            return context.inf if b < 0 else context.zero if b > 0 else context.nan
        size = b * context.log(abs(a), 2)
        if abs(size) < _LARGEST:
            return context.power(a, b)
        return context.nan if a < 0 or context.isnan(size) else context.inf if size > 0 else context.zero

    own = {name: getattr(context, name) for name in _FUNCTIONS if name != "pow"}
    own |= {name: bounded(own[name]) for name in ("exp", "expm1", "sinh", "cosh")}
    # mpmath's own loses two digits near 1.
    own["acosh"] = lambda x: context.log1p(x - 1 + context.sqrt((x - 1) * (x + 1)))
    own["pow"] = power
    functions = {name: np.frompyfunc(real(f), 2 if name in ("atan2", "pow") else 1, 1) for name, f in own.items()}
    return Arithmetic("mpmath", object, lambda x: context.mpf(float(x)), np.frompyfunc(divide, 2, 1), functions)


def digits(x: Any, own: Arithmetic) -> Any:
    """Return an array of 113-bit numbers as mpmath's, exactly, for looking at."""
    context = mpmath_context()
    high, _ = own.pair(x)
    rest = x - own.array(high)
    middle, low = own.pair(rest)
    # 113 bits are at most three doubles.
    return np.frompyfunc(lambda *parts: context.fsum(context.mpf(float(p)) for p in parts), 3, 1)(high, middle, low)
