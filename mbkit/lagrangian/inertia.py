"""Whether every motion has kinetic energy, or is bound by a constraint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import mpmath
import numpy as np
import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.probe import DIGITS, Probe

__all__ = ["require_inertia"]

_PLACES: Final = 3
#: Of 30 digits, what a determinant that is zero has left beside its rows' lengths.
_ROUNDED: Final = 1e-20
#: Letters of a matrix that is told.
_TOLD: Final = 200


def require_inertia(
    M: sp.ImmutableMatrix, coordinates: Sequence[sp.Symbol], velocities: Sequence[sp.Symbol], constraints: Sequence[Any]
) -> None:
    """Refuse a mass matrix that is singular everywhere, unless constraints bind what it leaves without mass.

    M + Jᵀ J has an inverse exactly where M v̇ - Jᵀ λ = f, J v̇ = -γ determines v̇.

    Raises
    ------
    InputError
        With the velocities that have no kinetic energy.
    """
    n = len(velocities)
    J = sp.Matrix(len(constraints), 1, list(constraints)).jacobian(coordinates) if constraints else sp.zeros(0, n)
    idle = [w for i, w in enumerate(velocities) if not any(M[i, :]) and not any(J[:, i])]
    if idle:
        bound = " and no constraint holds its coordinate" if constraints else ""
        names = ", ".join(w.name for w in idle)
        raise InputError(f"T: the mass matrix is singular everywhere: no kinetic energy has {names}{bound}")
    probe = Probe([*M, *J])
    for seed in range(_PLACES):
        values = probe(probe.place(seed))
        if values is None:
            # No judgement where it has no value.
            return
        with mpmath.workdps(DIGITS):
            A = mpmath.matrix(n, n)
            for i in range(n):
                for j in range(n):
                    pulls = (mpmath.conj(values[k + i]) * values[k + j] for k in range(n * n, len(values), n))
                    A[i, j] = values[n * i + j] + mpmath.fsum(pulls)
            rows = [mpmath.norm(A[i, :]) for i in range(n)]
            if any(x == 0 for x in rows):
                continue
            # Masses may differ by any number of decades.
            scaled = mpmath.matrix(n, n)
            for i in range(n):
                for j in range(n):
                    scaled[i, j] = A[i, j] / mpmath.sqrt(rows[i] * rows[j])
            sizes = (mpmath.norm(scaled[i, :]) for i in range(n))
            if abs(mpmath.det(scaled)) > _ROUNDED * mpmath.fprod(sizes):
                return
    told = f" {M.tolist()}" if len(str(M)) <= _TOLD else ""
    raise InputError(
        f"T: its mass matrix{told} is singular everywhere: {_unmoved(A, velocities)} can change without kinetic "
        "energy; a velocity is missing, or there is a coordinate too many"
    )


def _unmoved(A: Any, velocities: Sequence[sp.Symbol]) -> str:
    """Return the velocities of a motion that moves no mass."""
    _, _, V = np.linalg.svd(np.array(A.tolist(), dtype=complex))
    names = [w.name for w, x in zip(velocities, V[-1], strict=True) if abs(x) > 1e-6]
    return names[0] if len(names) == 1 else f"{', '.join(names)} together"
