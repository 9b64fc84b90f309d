"""Arrays of numbers with 113 bits, about 34 digits: heyoka's or mpmath's.

Both round to the format of IEEE 754's binary128. heyoka's `real128` is a NumPy type whose loops run in C; where heyoka
is not installed, or its build has no `real128`, arrays hold mpmath's numbers, some twenty times slower.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final, Literal

import numpy as np

from mbkit._check import Array, needed
from mbkit.codegen.program import Program
from mbkit.errors import InputError, UnsupportedError
from mbkit.model.elements.formula import completed

Backend = Literal["real128", "mpmath"]
BINARY128_BITS: Final = 113

#: Functions' names in C -> in NumPy.
_FUNCTIONS: Final = {
    **{f: f for f in ("sqrt", "sin", "cos", "tan", "exp", "expm1", "log", "log1p", "sinh", "cosh", "tanh")},
    **{f"a{f}": f"arc{f}" for f in ("sin", "cos", "tan", "tan2", "sinh", "cosh", "tanh")},
    "pow": "power",
}
#: Beyond it binary128 has no numbers, nor anything between 0 and its inverse.
_MAX_EXPONENT: Final = 16384


@dataclass(frozen=True)
class Arithmetic:
    """Arithmetic of arrays of 113-bit numbers; sums, differences and products are NumPy's own operators."""

    name: Backend
    dtype: Any
    #: Converts a float to one number, exactly.
    number: Callable[[float], Any]
    divide: Callable[[Any, Any], Any]
    #: Functions by their names in C; NaN outside of the domain.
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
    """Return a backend, by default the faster one installed; `UnsupportedError` without heyoka's `real128`."""
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
    """Return a private context of mpmath, so that the user's `mp.prec` is unchanged."""
    with needed("mpmath", "arithmetic of 34 digits"):
        import mpmath

    context = mpmath.MPContext()
    context.prec = BINARY128_BITS
    return context


def _mpmath() -> Arithmetic:
    context = mpmath_context()

    def divide(a: Any, b: Any) -> Any:
        # As IEEE 754 has it, so that the check of results sees a singular matrix.
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
        most = context.mpf(_MAX_EXPONENT) * context.ln2
        return lambda x: growing(x if abs(x) < most else context.sign(x) * context.inf)

    def power(a: Any, b: Any) -> Any:
        if b == 0 or a == 1:
            return context.one
        if a == 0:
            return context.inf if b < 0 else context.zero if b > 0 else context.nan
        size = b * context.log(abs(a), 2)
        if abs(size) < _MAX_EXPONENT:
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


# Run a program on arrays of 113-bit numbers, a batch of states at once.
#
# Nothing is compiled: each operation is one loop over the states. Temporaries are dropped with their last use. What
# does not depend on the state is computed once: an argument that is the same for all states is one row, and
# NumPy's broadcasting does the rest.

# States per pass: enough to share the interpreter's work, few enough for memory.
_MAX_PASS_STATES: Final = 128


class Extended:
    """A program in extended precision."""

    def __init__(self, program: Program, arithmetic: Arithmetic) -> None:
        self.program, self.arithmetic = program, arithmetic
        functions = _functions(arithmetic)
        last: dict[int, int] = {}
        for k, operation in enumerate(program.operations):
            if operation.name != "input":
                for i in operation.arguments:
                    last[i] = k
        for out in program.outputs:
            last.update((int(k), -1) for k in out.flat)
        dying: list[list[int]] = [[] for _ in program.operations]
        for i, k in last.items():
            if k >= 0:
                dying[k].append(i)
        self._inputs: list[tuple[int, int, int]] = []
        self._constants: list[tuple[int, Any]] = []
        self._steps: list[tuple[int, Callable[..., Any], tuple[int, ...], list[int]]] = []
        for k, operation in enumerate(program.operations):
            if operation.name == "input":
                which, entry = operation.arguments
                self._inputs.append((k, which, entry))
            elif operation.name == "const":
                self._constants.append((k, arithmetic.array(np.full(1, operation.value))))
            else:
                self._steps.append((k, functions[operation.name], operation.arguments, dying[k]))

    def __call__(self, *arguments: Any) -> list[Any]:
        """Return each output, (N, rows, columns), as 113-bit numbers; arguments are (N, n), or (1, n) for all."""
        n = max((len(x) for x in arguments), default=1) if all(len(x) for x in arguments) else 0
        own = self.arithmetic
        outputs = [np.empty((n, *shape), dtype=own.dtype) for shape in self.program.shapes]
        with np.errstate(all="ignore"):
            columns = [np.ascontiguousarray(own.array(x).T) for x in arguments]
            for start in range(0, n, _MAX_PASS_STATES):
                part = slice(start, start + _MAX_PASS_STATES)
                self._run([c if c.shape[1] == 1 else c[:, part] for c in columns], [out[part] for out in outputs])
        return outputs

    def _run(self, columns: list[Any], outputs: list[Any]) -> None:
        values: list[Any] = [None] * len(self.program.operations)
        for k, which, entry in self._inputs:
            values[k] = columns[which][entry]
        for k, constant in self._constants:
            values[k] = constant
        for k, function, used, dying in self._steps:
            # Nearly all have two.
            if len(used) == 2:
                values[k] = function(values[used[0]], values[used[1]])
            else:
                values[k] = function(values[used[0]])
            for i in dying:
                values[i] = None
        for out, where in zip(outputs, self.program.outputs, strict=True):
            for index in np.ndindex(where.shape):
                out[(slice(None), *index)] = values[int(where[index])]


def _functions(own: Arithmetic) -> dict[str, Callable[..., Any]]:
    return completed({**own.functions, "div": own.divide}, lambda x: own.array(np.full(1, x)))


# Solve M a = f in extended precision, for all states at once.
#
# The same elimination as `mbkit.derivation.mass_matrix_solve` (Featherstone 2008, Rigid Body
# Dynamics Algorithms, ch. 6.5), on arrays of numbers instead of expressions.


def product(M: Any, x: Any) -> Any:
    """Return M x for (N, n, n) and (N, n) arrays of 113-bit numbers."""
    out = np.zeros_like(x)
    for j in range(x.shape[1]):
        out = out + M[:, :, j] * x[:, j : j + 1]
    return out


def solve(M: Any, f: Any, pattern: Array, order: Sequence[int], own: Arithmetic) -> Any:
    """Return M⁻¹ f for M (N, n, n) and f (N, n) or (N, n, m) of 113-bit numbers; not finite where M is singular.

    `pattern` (n, n) says where M can be other than zero; `order` has every parent before its children.
    """
    n = len(order)
    zero = own.zeros((1,))
    rows: list[dict[int, Any]] = []
    for k, i in enumerate(order):
        rows.append({m: M[:, i, j] for m, j in enumerate(order[: k + 1]) if pattern[i, j] or m == k})
    x = [f[:, i] for i in order]
    across = (slice(None),) + (None,) * (f.ndim - 2)
    diagonal: list[Any] = [None] * n
    factors: list[dict[int, Any]] = [{} for _ in range(n)]
    with np.errstate(all="ignore"):
        for k in reversed(range(n)):
            row = rows[k]
            diagonal[k] = row.pop(k)
            for i in sorted(row, reverse=True):
                factors[k][i] = own.divide(row[i], diagonal[k])
                for j, entry in row.items():
                    if j <= i:
                        rows[i][j] = rows[i].get(j, zero) - factors[k][i] * entry
            for i, factor in factors[k].items():
                x[i] = x[i] - factor[across] * x[k]
        for k in range(n):
            x[k] = own.divide(x[k], diagonal[k][across])
            for i, factor in factors[k].items():
                x[k] = x[k] - factor[across] * x[i]
    out = np.empty_like(f)
    for k, i in enumerate(order):
        out[:, i] = x[k]
    return out
