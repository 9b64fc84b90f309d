"""The step at which linear theory lets a method break on q̈ + 2 ζ ω q̇ + ω² q = 0.

With x = ω h the amplification of a step has the characteristic polynomials, stable where both roots are within the
unit circle (Jury 1964; for Runge-Kutta methods Hairer, Wanner 1996, IV.2)

- semi-implicit Euler, v⁺ = v + h a(q, v): λ² - (2 - 2ζx - x²) λ + 1 - 2ζx; at λ = -1, x² + 4ζx = 4
- the same with the damper implicit: (1 + 2ζx) λ² - (2 + 2ζx - x²) λ + 1; at λ = -1, x² - 4ζx = 4
- Runge-Kutta of order 4 in 4 stages: λ = 1 + z + z²/2 + z³/6 + z⁴/24 at both roots z of z² + 2ζx z + x²
- Gauss's, the midpoint rule, and Euler with damper and spring implicit: every x.
"""

from __future__ import annotations

import math
from typing import Final

__all__ = ["RK4_IMAGINARY", "RK4_REAL", "largest_step"]

#: How far RK4 is stable along the imaginary axis, and along the negative real one: the root of 24 + 12 z + 4 z² + z³.
RK4_IMAGINARY: Final = 2 * math.sqrt(2)
RK4_REAL: Final = 2.785293563405282

_EXPLICIT: Final = ("semi_implicit_euler", "mujoco_euler")
_DAMPER_IMPLICIT: Final = ("mujoco_implicit", "mujoco_implicitfast")
_UNLIMITED: Final = ("implicit_midpoint", "gauss4", "gauss6", "mujoco_discrete")


def largest_step(method: str, frequency: float, damping: float) -> float | None:
    """Return the largest stable step, s: infinite where there is none; None for methods without a step.

    Parameters
    ----------
    method : str
        mbkit's step of MuJoCo's Euler takes dampers explicitly.
    frequency : float
        ω, rad/s.
    damping : float
        ζ: 0 for none, or at least 1, with two real rates.
    """
    if method in _EXPLICIT:
        return 2 * (math.sqrt(damping**2 + 1) - damping) / frequency
    if method in _DAMPER_IMPLICIT:
        return 2 * (math.sqrt(damping**2 + 1) + damping) / frequency
    if method in ("rk4", "mujoco_rk4"):
        if damping == 0:
            return RK4_IMAGINARY / frequency
        return RK4_REAL / (frequency * (damping + math.sqrt(damping**2 - 1)))
    return math.inf if method in _UNLIMITED else None
