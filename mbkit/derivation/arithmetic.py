"""Arrays of numbers with 113 bits, about 34 digits: heyoka's or mpmath's.

Both round to the format of IEEE 754's binary128. heyoka's `real128` is a NumPy type
whose loops run in C; where heyoka is not installed, or its build has no `real128`,
arrays hold mpmath's numbers, some twenty times slower.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, Literal

import numpy as np

from mbkit._check import Array
from mbkit.errors import InputError, UnsupportedError

__all__ = ["BITS", "Arithmetic", "Backend", "arithmetic", "digits", "mpmath_context"]

Backend = Literal["real128", "mpmath"]
BITS: Final = 113


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
    divide, sqrt, sin, cos : callable
        Of arrays; sums, differences and products are NumPy's own operators.
    """

    name: Backend
    dtype: Any
    number: Callable[[float], Any]
    divide: Callable[[Any, Any], Any]
    sqrt: Callable[[Any], Any]
    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]

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
        return Arithmetic("real128", heyoka.real128, heyoka.real128, np.divide, np.sqrt, np.sin, np.cos)
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
        if b == 0:
            return context.nan if a == 0 else context.inf
        return a / b

    return Arithmetic(
        "mpmath",
        object,
        lambda x: context.mpf(float(x)),
        np.frompyfunc(divide, 2, 1),
        np.frompyfunc(context.sqrt, 1, 1),
        np.frompyfunc(context.sin, 1, 1),
        np.frompyfunc(context.cos, 1, 1),
    )


def digits(x: Any, own: Arithmetic) -> Any:
    """Return an array of 113-bit numbers as mpmath's, exactly, for looking at."""
    context = mpmath_context()
    high, _ = own.pair(x)
    rest = x - own.array(high)
    middle, low = own.pair(rest)
    # 113 bits are at most three doubles.
    return np.frompyfunc(lambda *parts: context.fsum(context.mpf(float(p)) for p in parts), 3, 1)(high, middle, low)
