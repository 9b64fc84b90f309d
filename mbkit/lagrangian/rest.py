"""The search for a configuration at rest: Newton's iteration, damped after Levenberg and Marquardt far from the end."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import NumericalError
from mbkit.lagrangian.balance import BALANCED, Balance

__all__ = ["sought"]

_MOST: Final = 200


def sought(balance: Balance, starts: list[Array], tau: Array) -> tuple[Array, Array]:
    """Return the first configuration at rest that is found, and λ there.

    Raises
    ------
    NumericalError
        None, with the least force that is left over and where.
    """
    least: tuple[float, Array, Array] | None = None
    for start in starts:
        q, multipliers, left = _solved(balance, start, tau)
        if left <= 1.0:
            return q, multipliers
        size = balance.size(q, multipliers, tau)
        if least is None or size < least[0]:
            least = size, q, balance.residual(q, multipliers, tau)
    assert least is not None
    size, q, residual = least
    names = balance.model.velocity_names
    worst = int(np.abs(residual[: len(names)]).argmax())
    raise NumericalError(
        f"{balance.model.name}: no equilibrium found from {len(starts)} start{'s' * (len(starts) > 1)}; the least "
        f"force left over is {size:.3g}, most of it along {names[worst]}, at q = {np.array2string(q, precision=4)}; "
        "give tau= that balances it, or another q0"
    )


def _solved(balance: Balance, q: Array, tau: Array) -> tuple[Array, Array, float]:
    """Return q, λ and what is left over, relative to what rounding would leave."""
    multipliers = balance.multipliers(q, tau)
    r = balance.residual(q, multipliers, tau)
    damping, size = 0.0, float(np.linalg.norm(r))
    for _ in range(_MOST):
        if _left(balance, r, q, tau) <= 1e-3 or size == 0.0:
            break
        K = balance.matrix(q, multipliers)
        step = _damped(K, r, damping)
        moved = balance.model.integrate(q, step[: balance.model.nv])
        tried = multipliers + step[balance.model.nv :]
        new = balance.residual(moved, tried, tau)
        new_size = float(np.linalg.norm(new))
        if new_size < size and np.abs(step[: balance.model.nv]).max() < 3.0:
            q, multipliers, r, size = moved, tried, new, new_size
            damping = 0.0 if damping < 1e-9 else damping / 10
        elif _left(balance, r, q, tau) <= 1.0:
            break
        else:
            damping = max(10 * damping, 1e-6)
            if damping > 1e9:
                break
    return q, multipliers, _left(balance, r, q, tau)


def _left(balance: Balance, r: Array, q: Array, tau: Array) -> float:
    return float(np.abs(r).max(initial=0.0)) / (BALANCED * balance.scale(q, tau))


def _damped(K: Array, r: Array, damping: float) -> Array:
    """Return Levenberg's and Marquardt's step; Newton's without damping."""
    if not damping:
        try:
            step = np.linalg.solve(K, -r)
            if np.isfinite(step).all():
                return np.asarray(step)
        except np.linalg.LinAlgError:
            pass
        return np.asarray(np.linalg.lstsq(K, -r, rcond=1e-10)[0])
    square = K.T @ K
    scale = max(float(np.trace(square)) / len(K), np.finfo(float).tiny)
    return np.asarray(np.linalg.solve(square + damping * scale * np.eye(len(K)), -K.T @ r))
