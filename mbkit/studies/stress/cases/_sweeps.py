"""What the families share: values over decades, states to measure terms at, and exact motions as a type."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Model
from mbkit.studies.stress.case import Problem

__all__ = ["EPS", "Exact", "powers", "stable_steps", "terms_at"]

#: From times (K,) to q (K, nq).
Exact = Callable[[Array], Array]

EPS: Final = float(np.finfo(float).eps)

#: How far along the imaginary and the negative real axis the 8th order of Dormand and Prince 8(5,3) is stable: its
#: stability polynomial is that of exp to z⁸, with four coefficients of its own behind. From the
#: coefficients in Hairer, Nørsett, Wanner 1993, II.10.
_DOP853: Final = (5.96, 6.39)


def powers(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Return the powers of ten from one exponent to another, both among them.

    Examples
    --------
    >>> powers(0, -6, 2)
    (1.0, 0.01, 0.0001, 1e-06)
    """
    sign = 1 if last >= first else -1
    # Parsed and not multiplied: 1e-9 is to be the double that everybody writes.
    return tuple(float(f"1e{n}") for n in range(first, last + sign, sign * step))


def stable_steps(duration: float, frequency: float, *, damped: bool = False) -> float:
    """Return how many steps the explicit Runge-Kutta method of the longest stable one needs at the least.

    Parameters
    ----------
    duration : float
        s.
    frequency : float
        Of the fastest mode, rad/s; or its rate of decay, 1/s.
    damped : bool
        Whether it decays without turning.
    """
    return max(1.0, float(math.ceil(duration * frequency / _DOP853[damped])))


def terms_at(
    model: Model, *, samples: int = 8, seed: int = 0, force: float = 1.0, facts: dict[str, float] | None = None
) -> Problem:
    """Return the problem of a model's terms at its neutral configuration and at random states.

    Parameters
    ----------
    model : Model
    samples, seed : int
    force : float
        Size of the generalized forces, N or N m.
    facts : dict, optional
    """
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng, samples)
    q[0] = model.neutral()
    return Problem(model, q, v, tau=force * rng.standard_normal((samples, model.nv)), facts=facts or {})
