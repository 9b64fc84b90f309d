"""Rounds of exchanges between joints that rest and that move (`mbkit.methods.exchanges`) as CasADi functions."""

from __future__ import annotations

from functools import reduce
from typing import Any, Final

import casadi as ca

from mbkit.derivation.mass_matrix_solve import solve
from mbkit.derivation.steps.symbols import choose
from mbkit.methods.exchanges import ROUNDS, Operations, Problem, Signs, exchange


def restricted(A: Any, right: Any, on: Any) -> Any:
    """Return the x with A x = right in the entries that are on, and zero in the others, of a definite A."""
    own = A * ca.mtimes(on, on.T) + ca.diag(1 - on)
    return solve(own, right * on, range(right.numel()))


def _behind(x: Any) -> Any:
    return reduce(lambda sums, entry: ca.vertcat(entry + sums[0], sums), reversed(ca.vertsplit(x)[:-1]), x[-1])


COLUMNS: Final = Operations(
    times=ca.mtimes,
    solved=restricted,
    total=ca.sum1,
    largest=lambda x: reduce(ca.fmax, ca.vertsplit(x)),
    behind=_behind,
    choose=choose,
    size=ca.fabs,
    sign=ca.sign,
)


def exchange_rounds(n: int, *, stops: bool) -> ca.Function:
    """Return (A by rows, b, bound, less, on, known, noise, signs) -> (signs, forces, holds, going) after some rounds.

    With `stops` their two arrays stand behind the noise. A is definite, so that there is no last point among the signs.
    """
    given = [ca.SX.sym(name, n) for name in Problem._fields[2:8]]
    square, state = ca.SX.sym("A", n * n), [ca.SX.sym(name, n) for name in Signs._fields[:4]]
    state += [ca.SX.sym(name) for name in Signs._fields[4:6]]
    more: list[Any] = [ca.SX.sym(name, n) for name in Problem._fields[9:]] if stops else []
    A = ca.reshape(square, n, n)
    problem = Problem._make([A, A, *given, None, *(more or (None, None))])
    signs, out = Signs._make([*state, ca.SX(n, 1)]), list[Any]()
    for _ in range(ROUNDS):
        signs, *out = exchange(COLUMNS, problem, signs, n)
    return ca.Function("exchange_rounds", [square, *given, *more, *state], [ca.densify(x) for x in (*signs[:6], *out)])
