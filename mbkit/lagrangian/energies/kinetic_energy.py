"""T as a polynomial of the velocities: its degree is checked, and its parts are separated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import mpmath
import numpy as np
import sympy as sp

from mbkit._check import PROBES, ROUNDING
from mbkit.errors import InputError, MbkitWarning, warn
from mbkit.lagrangian.trig.simplify import (
    MAX_SIMPLIFIED_OPERATIONS,
    PROBE_DIGITS,
    ZERO_PROBE_RATIO,
    RandomEvaluation,
    settled,
    tidy,
    tidy_short,
)

#: Characters of a matrix or a constraint that a message shows: of a loop in space it has thousands.
MAX_SHOWN_LETTERS: Final = 200
#: Places on each line through the velocities.
_STEPS: Final = (3, 1, -1, -3)


@dataclass(frozen=True)
class KineticSplit:
    """T = T2 + T1 + T0 with T2 = ½ vᵀ M v and T1 = bᵀ v (Goldstein et al. 2002, eq. 1.73; Lanczos 1970, ch. V)."""

    T2: sp.Expr
    T1: sp.Expr
    T0: sp.Expr
    M: sp.ImmutableMatrix
    b: sp.ImmutableMatrix


def split(T: sp.Expr, velocities: Sequence[sp.Symbol]) -> KineticSplit:
    """Return the parts of T; InputError names a term that is not of second degree in the velocities."""
    n = len(velocities)
    p = [sp.diff(T, w) for w in velocities]
    seconds = {(i, j): sp.diff(p[i], velocities[j]) for i in range(n) for j in range(i, n)}
    if any(x.free_symbols & set(velocities) for x in seconds.values()):
        _check(T, velocities)
    entries = {place: tidy(_at_rest(x, velocities, sp.Integer(0))) for place, x in seconds.items()}
    M = sp.ImmutableMatrix(n, n, lambda i, j: entries[min(i, j), max(i, j)])
    v = sp.Matrix(velocities)
    b = sp.ImmutableMatrix(n, 1, [tidy(_at_rest(x, velocities, (M[i, :] * v)[0])) for i, x in enumerate(p)])
    T2, T1 = (v.T * M * v)[0] / 2, (b.T * v)[0]
    return KineticSplit(T2=T2, T1=T1, T0=tidy(_at_rest(T, velocities, T2 + T1)), M=M, b=b)


def _at_rest(x: sp.Expr, velocities: Sequence[sp.Symbol], gained: sp.Expr) -> sp.Expr:
    """Return an expression at rest; where it has no value there, at other velocities less its gain."""
    n = len(velocities)
    for speeds in ((0,) * n, range(1, n + 1), range(2, 2 * n + 1, 2)):
        put = dict(zip(velocities, map(sp.Integer, speeds), strict=True))
        out = x.subs(put)
        if not out.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
            return out - gained.subs(put)
    return x


def _check(T: sp.Expr, velocities: Sequence[sp.Symbol]) -> None:
    """Refuse T that is not of second degree, with the first term that is not."""
    if _quadratic(T, velocities):
        return
    terms = sp.Add.make_args(sp.expand_mul(T) if T.count_ops() <= MAX_SIMPLIFIED_OPERATIONS else T)
    term = next((x for x in terms if not _quadratic(x, velocities)), T)
    raise InputError(
        f"T: expected at most the second degree in the velocities {', '.join(map(str, velocities))}, "
        f"but its term {term} is not"
    )


def _quadratic(x: sp.Expr, velocities: Sequence[sp.Symbol]) -> bool:
    """Return whether an expression is of second degree at most: along random lines its third differences are zero."""
    probe = RandomEvaluation([x], velocities)
    with mpmath.workdps(PROBE_DIGITS):
        for seed in range(PROBES):
            start, direction = probe.place(2 * seed), probe.place(2 * seed + 1)
            # Through velocities of both signs, where what has a kink shows it.
            places = ({c: y / 3 + s * direction[c] if c in velocities else y for c, y in start.items()} for s in _STEPS)
            values = [point[0] for point in map(probe, places) if point is not None]
            if len(values) < len(_STEPS):
                continue
            third = sum(k * value for k, value in zip((1, -3, 3, -1), values, strict=True))
            if abs(third) > ZERO_PROBE_RATIO * max(abs(value) for value in values):
                return False
    return True


# The test that every motion has kinetic energy, or is bound by a constraint.


def require_inertia(M: sp.ImmutableMatrix, velocities: Sequence[sp.Symbol], J: sp.ImmutableMatrix) -> None:
    """Refuse a mass matrix that is singular everywhere, unless constraints bind its massless directions (InputError).

    M + Jᵀ J has an inverse exactly where M v̇ - Jᵀ λ = f, J v̇ = -γ determines v̇.
    """
    n = len(velocities)
    idle = [w for i, w in enumerate(velocities) if not any(M[i, :]) and not any(J[:, i])]
    if idle:
        bound = " and no constraint holds its coordinate" if J else ""
        names = ", ".join(w.name for w in idle)
        raise InputError(f"T: the mass matrix is singular everywhere: no kinetic energy has {names}{bound}")
    probe = RandomEvaluation([*M, *J])
    for seed in range(PROBES):
        values = probe(probe.place(seed))
        if values is None:
            # No judgement where it has no value.
            return
        with mpmath.workdps(PROBE_DIGITS):
            A = mpmath.matrix(n, n)
            for i, j in product(range(n), repeat=2):
                pulls = (mpmath.conj(values[k + i]) * values[k + j] for k in range(n * n, len(values), n))
                A[i, j] = values[n * i + j] + mpmath.fsum(pulls)
            rows = [mpmath.norm(A[i, :]) for i in range(n)]
            if all(rows):
                # Masses may differ by any number of decades.
                scale = mpmath.diag([1 / mpmath.sqrt(x) for x in rows])
                scaled = scale * A * scale
                sizes = (mpmath.norm(scaled[i, :]) for i in range(n))
                if abs(mpmath.det(scaled)) > ZERO_PROBE_RATIO * mpmath.fprod(sizes):
                    return
    matrix = f" {M.tolist()}" if len(str(M)) <= MAX_SHOWN_LETTERS else ""
    raise InputError(
        f"T: its mass matrix{matrix} is singular everywhere: {_unmoved(A, velocities)} can change without kinetic "
        "energy; a velocity is missing, or there is a coordinate too many"
    )


def _unmoved(A: Any, velocities: Sequence[sp.Symbol]) -> str:
    """Return the velocities of a motion that moves no mass."""
    _, _, V = np.linalg.svd(np.array(A.tolist(), dtype=complex))
    names = [w.name for w, x in zip(velocities, V[-1], strict=True) if abs(x) > 1e-6]
    return names[0] if len(names) == 1 else f"{', '.join(names)} together"


def warn_of_negative(
    M: sp.ImmutableMatrix, velocities: Sequence[sp.Symbol], values: Mapping[sp.Symbol, float | None]
) -> None:
    """Warn of a mass matrix that is negative along some velocity wherever it is looked at.

    Where a parameter in it has no value, nothing is known.
    """
    numbers = {s: values[s] for s in M.free_symbols if s in values}
    if None in numbers.values():
        return
    probe, n, direction = RandomEvaluation([*M]), len(velocities), None
    for seed in range(2 * PROBES):
        # Small deflections too: what holds for these alone, as of beams, may be negative far away.
        place = {s: x * 1e-3 ** (seed % 2) for s, x in probe.place(seed).items()}
        entries = probe({**place, **{s: mpmath.mpf(x) for s, x in numbers.items()}})
        if entries is None or any(mpmath.im(x) for x in entries):
            return
        sizes, directions = np.linalg.eigh(np.array(entries, dtype=float).reshape(n, n))
        if sizes[0] >= -ROUNDING * abs(sizes[-1]):
            return
        direction = directions[:, 0]
    names = [w.name for w, x in zip(velocities, direction, strict=True) if abs(x) > 1e-6]  # type: ignore[arg-type]
    warn(f"T: a motion of {', '.join(names)} has negative kinetic energy; no mass or inertia does that", MbkitWarning)


# The inverse of a matrix in symbols, block by block.


def inverse(A: Any, what: str) -> sp.ImmutableMatrix:
    """Return A⁻¹ with each entry tidied, coupled block by coupled block; InputError names `what` if A is singular."""
    A = sp.Matrix(A)
    out = sp.zeros(*A.shape)
    for block in blocks(A):
        part = A.extract(block, block)
        det = settled(part.det(method="berkowitz"))
        if det == 0:
            raise InputError(f"{what}: {part.tolist()} is singular everywhere")
        turned = part.adjugate(method="berkowitz") / det
        for i, row in enumerate(block):
            for j, column in enumerate(block):
                out[row, column] = settled(turned[i, j])
    return sp.ImmutableMatrix(out)


def blocks(A: sp.Matrix) -> list[list[int]]:
    """Return the indices that A's entries connect, each set in order."""
    left, out = list(range(A.shape[0])), []
    while left:
        block = [left.pop(0)]
        for i in block:
            block += [j for j in left if A[i, j] != 0 or A[j, i] != 0]
            left = [j for j in left if j not in block]
        out.append(sorted(block))
    return out


# xᵀ M⁻¹ y of a mass matrix in symbols.
#
# Completed squares are how books write H and effective potentials: (p_φ - p_ψ cos θ)² / (2 A sin² θ) + p_ψ² / (2 C),
# where entries of M⁻¹ would be long. A pivot that is a product leaves the shortest quotients.


def completed_squares(M: sp.ImmutableMatrix, what: str) -> _Eliminated | _Inverted:
    """Return the inverse of a symmetric matrix; InputError names a singular one."""
    try:
        return _Eliminated(M)
    except _NoPivotError:
        return _Inverted(M, what)


class _NoPivotError(Exception):
    """All pivots that are left are zero."""


class _Eliminated:
    """M = L D Lᵀ, with pivots of the fewest sums first."""

    def __init__(self, M: sp.ImmutableMatrix) -> None:
        left = list(range(M.shape[0]))
        entries = {(i, j): M[i, j] for i in left for j in left}
        #: Each pivot's index, its D, and the multiple of its row that is subtracted from each later one.
        self._steps: list[tuple[int, sp.Expr, dict[int, sp.Expr]]] = []
        while left:
            pivots = {i: entries[i, i] for i in left if entries[i, i] != 0}
            if not pivots:
                raise _NoPivotError
            k = min(pivots, key=lambda i: (len(pivots[i].atoms(sp.Add)), pivots[i].count_ops()))
            left.remove(k)
            factors = {i: tidy_short(entries[i, k] / pivots[k]) for i in left if entries[i, k] != 0}
            for i, factor in factors.items():
                for j in factors:
                    if j <= i:
                        entries[i, j] = entries[j, i] = tidy_short(entries[i, j] - factor * entries[j, k])
            self._steps.append((k, pivots[k], factors))

    def _lowered(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        """Return L⁻¹ x."""
        out = list(x)
        for k, _, factors in self._steps:
            for i, factor in factors.items():
                out[i] = tidy_short(out[i] - factor * out[k])
        return out

    def form(self, x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr:
        """Return xᵀ M⁻¹ y."""
        a, b = self._lowered(x), self._lowered(y)
        return sum((a[k] * b[k] / pivot for k, pivot, _ in self._steps), sp.Integer(0))

    def solve(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        """Return M⁻¹ x."""
        out = self._lowered(x)
        for k, pivot, factors in reversed(self._steps):
            out[k] = out[k] / pivot - sum((factor * out[i] for i, factor in factors.items()), sp.Integer(0))
        return out


class _Inverted:
    """M⁻¹ entry by entry."""

    def __init__(self, M: sp.ImmutableMatrix, what: str) -> None:
        self._inverse = inverse(M, what)

    def form(self, x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr:
        """Return xᵀ M⁻¹ y."""
        return sum((a * b for a, b in zip(x, self.solve(y), strict=True)), sp.Integer(0))

    def solve(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        """Return M⁻¹ x."""
        return list(self._inverse * sp.Matrix(list(x)))
