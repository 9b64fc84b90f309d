"""Motion about a centre."""

from __future__ import annotations

import sympy as sp

from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.systems._values import Value, values

__all__ = ["kepler"]


def kepler(*, mass: Value = 1.0, strength: Value = 1.0) -> Lagrangian:
    """Return a point mass in the potential -k/r: T = ½ m (ṙ² + r² φ̇²).

    Two coordinates: ``r``, the distance from the centre, above zero, and ``phi``, the angle, which is cyclic.
    There is no motion through the centre, where T and V are not defined.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 3.
    """
    m, k, r, ph = sp.symbols("m k r phi")
    u, w = velocity_of(r), velocity_of(ph)
    given = values({"mass": (m, mass)}, {"strength": (k, strength)})
    return Lagrangian(m * (u**2 + r**2 * w**2) / 2, -k / r, [r, ph], parameters=given, name="kepler")
