"""What the families of cases share: registration, values over decades, rods, states of terms, stable steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Model, ModelBuilder
from mbkit.studies.stress.case import Case, Family, Problem

#: From times (K,) to q (K, nq).
Exact = Callable[[Array], Array]
Make = Callable[[float], Problem]

EPS: Final = float(np.finfo(float).eps)
DOWN: Final = (0.0, 0.0, -1.0)
#: The axis of a hinge about which a body that hangs down swings.
SWING: Final = (0.0, -1.0, 0.0)

#: How far along the imaginary and the negative real axis the 8th order of Dormand and Prince 8(5,3) is stable: its
#: stability polynomial is that of exp to z⁸, with four coefficients of its own behind. From the
#: coefficients in Hairer, Nørsett, Wanner 1993, II.10.
_DOP853: Final = (5.96, 6.39)


def register(
    cases: list[Case],
    family: Family,
    parameter: str,
    unit: str,
    values: tuple[float, ...],
    quick: tuple[float, ...],
    **more: Any,
) -> Callable[[Make], Make]:
    """Return a decorator that adds a function as a case, with its name and its docstring of one sentence."""

    def add(make: Make) -> Make:
        about = " ".join((make.__doc__ or "").split())
        cases.append(Case(make.__name__, about, family, parameter, unit, values, quick, make, **more))
        return make

    return add


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


def rods(name: str, masses: Sequence[float], load: float = 0.0) -> Model:
    """Return thin rods of 1 m, hinged end to end, with a point mass at the last end."""
    b = ModelBuilder(name)
    for i, mass in enumerate(masses, start=1):
        across = mass / 12
        parent = f"rod{i - 1}" if i > 1 else "world"
        b.add_body(f"rod{i}", mass=mass, com=(0.0, 0.0, -0.5), inertia=(across, across, 0.0))
        place = (0.0, 0.0, -1.0 if i > 1 else 0.0)
        b.add_joint(f"theta{i}", "continuous", parent=parent, child=f"rod{i}", axis=SWING, translation=place)
    if load:
        b.add_body("load", mass=load)
        b.add_joint("hold", "fixed", parent=f"rod{len(masses)}", child="load", translation=DOWN)
    return b.build()


# The step at which linear theory lets a method break on q̈ + 2 ζ ω q̇ + ω² q = 0.
#
# With x = ω h the amplification of a step has the characteristic polynomials, stable where both roots are within the
# unit circle (Jury 1964; for Runge-Kutta methods Hairer, Wanner 1996, IV.2)
#
# - semi-implicit Euler, v⁺ = v + h a(q, v): λ² - (2 - 2ζx - x²) λ + 1 - 2ζx; at λ = -1, x² + 4ζx = 4
# - the same with the damper implicit: (1 + 2ζx) λ² - (2 + 2ζx - x²) λ + 1; at λ = -1, x² - 4ζx = 4
# - Runge-Kutta of order 4 in 4 stages: λ = 1 + z + z²/2 + z³/6 + z⁴/24 at both roots z of z² + 2ζx z + x²
# - Gauss's, the midpoint rule, and Euler with damper and spring implicit: every x.

#: How far RK4 is stable along the imaginary axis, and along the negative real one: the root of 24 + 12 z + 4 z² + z³.
RK4_IMAGINARY: Final = 2 * math.sqrt(2)
RK4_REAL: Final = 2.785293563405282

_EXPLICIT: Final = ("semi_implicit_euler", "mujoco_euler")
_DAMPER_IMPLICIT: Final = ("mujoco_implicit", "mujoco_implicitfast")
_UNLIMITED: Final = ("implicit_midpoint", "gauss4", "gauss6", "mujoco_discrete")


def largest_step(method: str, frequency: float, damping: float) -> float | None:
    """Return the largest stable step, s, at ω and ζ (0, or at least 1); infinite where none, None without a step."""
    if method in _EXPLICIT:
        return 2 * (math.sqrt(damping**2 + 1) - damping) / frequency
    if method in _DAMPER_IMPLICIT:
        return 2 * (math.sqrt(damping**2 + 1) + damping) / frequency
    if method in ("rk4", "mujoco_rk4"):
        if damping == 0:
            return RK4_IMAGINARY / frequency
        return RK4_REAL / (frequency * (damping + math.sqrt(damping**2 - 1)))
    return math.inf if method in _UNLIMITED else None
