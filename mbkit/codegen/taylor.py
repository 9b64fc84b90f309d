"""The equations of motion as Taylor integrators of heyoka's, in double and beyond.

A Taylor step expands the solution to the order that its tolerance asks for, by automatic differentiation of every
operation (Jorba and Zou 2005; Biscani and Izzo 2021, Revisiting high-order Taylor methods for astrodynamics and
celestial mechanics). So CasADi's graph is handed over operation by operation, and q̇ = D(q) v and v̇ of it are compiled
together.

Each quaternion is divided by its norm before it enters the dynamics, while its rate D(q) v stays linear in it. Its norm
is then a constant of the exact flow, and what it drifts by never bends the motion.
"""

from __future__ import annotations

import math
import operator
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit._check import DOUBLE_BITS, Array
from mbkit._process import fork_safe
from mbkit.codegen.program import Operation, Program, program
from mbkit.derivation.equations import Equations, kept
from mbkit.derivation.mass_matrix_solve import elimination_size
from mbkit.errors import UnsupportedError
from mbkit.model.elements.formula import completed
from mbkit.model.loops import discs_of

# A compiler's time for more is no longer spent unasked: 34,000 operations take 9 s.
_MAX_TAYLOR_OPERATIONS: Final = 100_000
# Up to this many operations times order², the recurrences are written out: 2 to 3
# times as fast to run as loops over them, compiled in about a second.
_MAX_UNROLLED_OPERATIONS: Final = 25_000
_KINKS: Final = frozenset(
    {"fabs", "sign", "fmin", "fmax", "lt", "le", "eq", "ne", "not", "and", "or", "if_else_zero"}
    # A series follows the branch that it began on.
    | {"sqrt", "hypot", "pow", "asin", "acos", "acosh", "atan2"}
)
#: Functions that heyoka calls as we do.
_SAME: Final = (
    *("sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "atan2"),
    *("exp", "expm1", "log", "log1p", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
#: heyoka's compiler has locks of its own, which a forked child must not find held.
_COMPILING: Final = fork_safe(threading.RLock())
_REMEDY: Final = "method='rk853' and method='dop853' go without it"


@dataclass(frozen=True)
class Precision:
    """A format of numbers: bits of the significand (53, 64 or 113) and the type of arrays."""

    bits: int
    dtype: Any

    @property
    def eps(self) -> float:
        """Spacing of the numbers at 1."""
        return 2.0 ** (1 - self.bits)

    def array(self, high: Array, low: Array | float = 0.0) -> Any:
        """Return high + low."""
        first, rest = (np.asarray(x, dtype=np.float64).astype(self.dtype) for x in (high, low))
        return first + rest

    def pair(self, x: Any) -> tuple[Array, Array]:
        """Return (high, low): numbers rounded to double, and the rounded rest."""
        high = np.asarray(x).astype(np.float64)
        return high, (x - high.astype(self.dtype)).astype(np.float64)


#: Bits of a format -> the name that heyoka and NumPy know it by.
PRECISIONS: Final = {53: "double", 64: "80-bit extended", 113: "quadruple"}


def precision(bits: int) -> Precision:
    """Return a format of heyoka's numbers; `UnsupportedError` where heyoka or this machine does not have it."""
    heyoka = _heyoka()
    if bits == 53:
        return Precision(53, np.float64)
    if bits == 64 and np.finfo(np.longdouble).nmant == 63 and hasattr(heyoka, "taylor_adaptive_ldbl"):
        return Precision(64, np.longdouble)
    if bits == 113 and hasattr(heyoka, "real128"):
        return Precision(113, heyoka.real128)
    name = PRECISIONS.get(bits, f"{bits}-bit")
    raise UnsupportedError(f"taylor: heyoka has no {name} numbers on this machine; in double: dynamics(model)")


def _heyoka() -> Any:
    try:
        import heyoka
    except ImportError:
        raise UnsupportedError(
            "taylor: heyoka is not installed; pip install heyoka (Linux), or conda install -c conda-forge heyoka.py; "
            + _REMEDY
        ) from None
    # heyoka keeps 2 GiB of machine code in memory unless somebody says otherwise; this is enough for a hundred systems.
    if heyoka.llvm_state.get_memcache_limit() == 2**31:
        heyoka.llvm_state.set_memcache_limit(2**26)
    return heyoka


def order_of(tolerance: float) -> int:
    """Return the order of the Taylor series that a tolerance asks for (Jorba and Zou 2005, eq. 3.4)."""
    return max(2, math.ceil(1 - math.log(tolerance) / 2))


def rates(equations: Equations) -> ca.Function:
    """Return (q, v, tau) -> (q̇, v̇), with the equations' extra arguments behind; quaternions of any norm."""
    eq, q = equations, ca.SX(equations.q)
    for start, _ in eq.model.quaternions:
        part = eq.q[start : start + 4]
        q[start : start + 4] = part / ca.sqrt(ca.sumsqr(part))
    forward = eq.function("forward_dynamics")
    a = forward(q, eq.v, eq.force, *eq.extra_arguments.values())
    inputs = {"q": eq.q, "v": eq.v, "tau": eq.force, **eq.extra_arguments}
    outs = [ca.densify(eq.kin.qdot), ca.densify(a)]
    return ca.Function("rates", list(inputs.values()), outs, list(inputs), ["qdot", "a"])


class TaylorSystem:
    """A model's equations of motion, ready to be compiled for any tolerance and format.

    `UnsupportedError` where heyoka is not installed or the forward dynamics is too large. Beyond double the equations
    need symbols for constants, which keep all digits. `kinked`: a length, an absolute value, a decision or a function
    with branches enters, where forces can jump and a series goes on analytically. `clock`: place of the time among the
    arguments behind tau, or None.
    """

    def __init__(self, equations: Equations) -> None:
        heyoka = _heyoka()
        # Written out from M, the size is known before the derivation, which would take long.
        size = 0 if equations.elimination == "links" else elimination_size(equations.model)
        if size <= _MAX_TAYLOR_OPERATIONS:
            self.rates = rates(equations)
            graph = program(self.rates)
            size = graph.arithmetic
        if size > _MAX_TAYLOR_OPERATIONS:
            name = equations.model.name
            raise UnsupportedError(
                f"taylor: {name} takes {size} operations, too many for a Taylor series; method='rk853' or 'dop853'"
            )
        self.operations = size
        # Each quaternion's norm is a square root too, each constraint's weight, and each disc's height, of what never
        # vanishes.
        kinks, model = sum(o.name in _KINKS for o in graph.operations), equations.model
        rows = len(equations.constraints.names) if model.constrained else 0  # type: ignore[attr-defined]  # written
        self.kinked = kinks > len(model.quaternions) + rows + len(discs_of(model))
        # Parameters stand first among the arguments behind tau.
        self.clock = list(model.parameters).index(model.time_parameter) if model.time_parameter else None
        self._nq, self._nv = graph.inputs[:2]
        #: Place of each parameter among heyoka's -> (argument, entry); unused ones have none.
        self._places: dict[tuple[int, int], int] = {}
        variables = heyoka.make_vars(*(f"y{i}" for i in range(self._nq + self._nv)))
        variables = [variables] if self._nq + self._nv == 1 else list(variables)
        self._system = list(zip(variables, self._expressions(heyoka, graph, variables), strict=True))
        self._idle: dict[tuple[int, int], list[Any]] = {}

    def _expressions(self, heyoka: Any, graph: Program, variables: list[Any]) -> list[Any]:
        functions, clock = _functions(heyoka), self.clock
        values: list[Any] = []

        def entry(operation: Operation) -> Any:
            which, at = operation.arguments
            if which < 2:
                return variables[at + which * self._nq]
            if which == 3 and at == clock:
                return heyoka.time
            return heyoka.par[self._places.setdefault((which, at), len(self._places))]

        for operation in graph.operations:
            if operation.name == "input":
                values.append(entry(operation))
            elif operation.name == "const":
                values.append(heyoka.expression(operation.value))
            else:
                values.append(functions[operation.name](*(values[i] for i in operation.arguments)))
        return [values[k] for out in graph.outputs for k in out.ravel()]

    @contextmanager
    def integrator(self, kind: Precision, tolerance: float) -> Iterator[Any]:
        """Lend a `heyoka.taylor_adaptive` for exclusive use, in the state in which its last user left it."""
        key = (kind.bits, order_of(tolerance))
        idle = self._idle.setdefault(key, [])
        try:
            integrator = idle.pop()
        except IndexError:
            integrator = self._compiled(kind, tolerance)
        yield integrator
        # One whose run ended in an error is not lent again.
        idle.append(integrator)

    def _compiled(self, kind: Precision, tolerance: float) -> Any:
        n = self._nq + self._nv
        # Beyond double the arithmetic itself takes so long that loops cost nothing.
        compact = kind.bits > DOUBLE_BITS or self.operations * order_of(tolerance) ** 2 > _MAX_UNROLLED_OPERATIONS
        with _COMPILING:
            return _heyoka().taylor_adaptive(
                self._system,
                np.zeros(n).astype(kind.dtype),
                pars=np.zeros(len(self._places)).astype(kind.dtype),
                tol=kind.dtype(max(tolerance, kind.eps)),
                fp_type=float if kind.bits == 53 else kind.dtype,
                compact_mode=compact,
                # In loops more optimization takes half as long again, and gains nothing; where every
                # operation is a call, any takes three times as long.
                opt_level=0 if kind.bits == 113 else 1 if compact else 3,
            )

    def fill(self, integrator: Any, *arguments: Any) -> None:
        """Write tau, and what else stands behind (q, v), into an integrator's parameters."""
        for (which, at), place in self._places.items():
            if which - 2 < len(arguments):
                integrator.pars[place] = arguments[which - 2][at]


@kept
def taylor_system(equations: Equations) -> TaylorSystem:
    """Return the Taylor system of equations, once for all dynamics that share them."""
    return TaylorSystem(equations)


def _functions(heyoka: Any) -> dict[str, Any]:
    zero, one, select = heyoka.expression(0.0), heyoka.expression(1.0), heyoka.select
    compared = {"lt": heyoka.lt, "le": heyoka.lte, "eq": heyoka.eq, "ne": heyoka.neq}
    joined = {"and": lambda *x: heyoka.logical_and([*x]), "or": lambda *x: heyoka.logical_or([*x])}
    own = {name: getattr(heyoka, name) for name in _SAME} | compared
    own["pow"] = operator.pow
    # At zero a series goes on with none of the argument's.
    own["sign"] = lambda a: select(heyoka.lt(a, zero), -one, select(heyoka.lt(zero, a), one, zero))
    return completed(own, heyoka.expression, select, compared | joined)
