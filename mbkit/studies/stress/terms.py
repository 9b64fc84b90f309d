"""Terms at extreme states: values with 34 digits, and the errors of engines beside them.

Errors are those of `mbkit.studies.measure`, with one exception. There forward dynamics is divided by
cond(M), to judge engines; here it is not, for whoever uses an acceleration has to live with its
whole error, about eps cond(M) of what acts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.derivation.arithmetic import arithmetic
from mbkit.derivation.extended_solve import solve
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import NumericalError
from mbkit.studies.measure import Errors, Scales, force_errors, matrix_errors
from mbkit.studies.states import States
from mbkit.studies.stress.case import Problem

__all__ = ["TERMS", "Terms", "condition", "error_of", "terms_of"]

#: Method of `Dynamics` -> its arguments, fields of `States`.
TERMS: Final = {
    "mass_matrix": ("q",),
    "inverse_dynamics": ("q", "v", "a"),
    "forward_dynamics": ("q", "v", "tau"),
}
#: Beyond it doubles do not know the smallest eigenvalue of a matrix.
_DOUBLE: Final = 1e15
#: Columns of an inverse that are found side by side.
_BLOCK: Final = 16
#: What an error is at the most, so that JSON can hold it.
_LARGEST: Final = 1e300


@dataclass(frozen=True)
class Terms:
    """The states of a problem, and what the oracle says there.

    Attributes
    ----------
    at : States
    values : dict
        Term -> high and low part.
    missing : dict
        Term -> why the oracle has no value.
    scales : Scales
        In units of 2**exponent kg, m and s, in which nothing overflows.
    exponent : int
    """

    at: States
    values: dict[str, tuple[Array, Array]]
    missing: dict[str, str]
    scales: Scales
    exponent: int


def terms_of(problem: Problem, oracle: OracleDynamics) -> Terms:
    """Return the oracle's values at a problem's states; accelerations are random, by a fixed seed."""
    model = problem.model
    q, v = (np.atleast_2d(x) for x in (model.check_q(problem.q), model.check_v(problem.v)))
    n = max(len(q), len(v))
    q, v = np.broadcast_to(q, (n, model.nq)), np.broadcast_to(v, (n, model.nv))
    tau = np.zeros(model.nv) if problem.tau is None else model.check_v(problem.tau, "tau")
    a = np.random.default_rng(0).standard_normal((n, model.nv))
    at = States(q, v, a, np.broadcast_to(tau, (n, model.nv)), ("given",) * n)
    values, missing = {}, {}
    for term, arguments in TERMS.items():
        try:
            values[term] = oracle.extended(term, *(getattr(at, x) for x in arguments))
        except NumericalError as error:
            missing[term] = f"no truth: {error}"
    M = oracle.mass_matrix(q)
    exponent = -int(np.frexp(np.abs(M).max())[1])
    acting = np.abs(at.tau) + np.abs(oracle.nle(q, v)) + np.abs(oracle.passive(q, v))
    gravity = float(np.linalg.norm(model.gravity))
    weight = gravity * float(np.sqrt(np.ldexp(model.mass, exponent))) if gravity and model.written is None else 0.0
    with np.errstate(all="ignore"):
        scales = Scales.of(np.ldexp(M, exponent), v, np.ldexp(acting, exponent), weight)
    return Terms(at, values, missing, scales, exponent)


def error_of(term: str, value: Array, truth: Terms) -> float:
    """Return the worst error of a term over the states."""
    high, low = truth.values[term]
    with np.errstate(all="ignore"):
        error = (value - high) - low
        if term == "forward_dynamics":
            worst = float(_acceleration(error, high, truth.scales).max())
        else:
            # Forces and inertias both are in kg.
            error, high = np.ldexp(error, truth.exponent), np.ldexp(high, truth.exponent)
            measured: Errors = (
                matrix_errors(error, high, truth.scales)
                if term == "mass_matrix"
                else force_errors(error, high, truth.scales, heavy=True)
            )
            worst = float(measured.relative.max())
    return min(worst, _LARGEST)


def _acceleration(error: Array, reference: Array, scales: Scales) -> Array:
    """Return errors in the norm √M_jj a_j, relative to the accelerations, or to what cancels in them."""
    root = np.sqrt(scales.diagonal)
    pushed = np.linalg.norm(scales.acting / np.where(root > 0, root, np.inf), axis=1)
    size = np.maximum(np.linalg.norm(root * reference, axis=1), pushed)
    off = np.linalg.norm(root * error, axis=1)
    return np.where(off == 0, 0.0, off / np.where(size > 0, size, np.finfo(float).tiny))


def condition(oracle: OracleDynamics, q: Array) -> float:
    """Return the condition number of M in the 2-norm and SI units, the largest of the states; NaN where M is singular.

    Beyond 1e15 it comes from M with 34 digits.
    """
    high, low = oracle.extended("mass_matrix", np.atleast_2d(q))
    exponent = -int(np.frexp(np.abs(high).max())[1])
    high, low = np.ldexp(high, exponent), np.ldexp(low, exponent)
    with np.errstate(all="ignore"):
        seen = np.linalg.cond(high)
    if not (seen >= _DOUBLE).any():
        return float(seen.max())
    at = int(np.argmax(seen))
    return float(np.linalg.norm(high[at], 2)) * _norm_of_inverse(high[at], low[at])


def _norm_of_inverse(high: Array, low: Array) -> float:
    """Return the 2-norm of the inverse of a matrix with 34 digits, NaN where there is none."""
    own, n = arithmetic(), len(high)
    M, one = own.from_pair(high, low), np.eye(n)
    pattern = (high != 0) | (low != 0)
    columns = []
    for k in range(0, n, _BLOCK):
        rows = one[k : k + _BLOCK]
        many = np.broadcast_to(M, (len(rows), n, n))
        columns.append(own.pair(solve(many, own.array(rows), pattern, range(n), own))[0])
    inverse = np.concatenate(columns)
    return float(np.linalg.norm(inverse, 2)) if np.isfinite(inverse).all() else np.nan
