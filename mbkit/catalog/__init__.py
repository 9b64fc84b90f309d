"""Textbook and published systems, each a function that returns a `Model`.

Every function takes keyword parameters in SI units, numbers or `mbkit.Parameter`; its docstring gives the coordinates,
the zero pose and the source. Planar systems move in the x-z plane, gravity along -z, with angles from the downward
vertical that grow towards +x: a right-handed turn about -y. Planar systems without gravity move in the x-y plane.
Engines take all but `slider_crank`, which has a loop: `mbkit.lagrangian.from_model` solves it.
"""

from __future__ import annotations

from collections.abc import Callable

from mbkit.catalog._system import SYSTEMS
from mbkit.catalog.mechanisms import (
    acrobot,
    cart_pole,
    chain,
    double_pendulum,
    elastic_pendulum,
    furuta_pendulum,
    pendulum,
    slider_crank,
    spherical_pendulum,
)
from mbkit.catalog.rigid_bodies import (
    clamped_beam,
    flexible_spacecraft,
    free_body,
    gyroscope,
    heavy_top,
    spacecraft_with_wheels,
)
from mbkit.errors import UnknownNameError
from mbkit.model import Model

__all__ = ["acrobot", "cart_pole", "chain", "clamped_beam", "double_pendulum", "elastic_pendulum"]
__all__ += ["flexible_spacecraft", "free_body", "furuta_pendulum", "get", "gyroscope", "heavy_top", "pendulum"]
__all__ += ["slider_crank", "spacecraft_with_wheels", "spherical_pendulum", "systems"]


def systems() -> dict[str, Callable[..., Model]]:
    """Return every system's function by its name.

    Examples
    --------
    >>> import mbkit as mb
    >>> list(mb.catalog.systems())[:4]
    ['pendulum', 'double_pendulum', 'cart_pole', 'spherical_pendulum']
    """
    return dict(SYSTEMS)


def get(name: str) -> Callable[..., Model]:
    """Return the function of the system of this name.

    Raises
    ------
    UnknownNameError
        With near names.
    """
    if name not in SYSTEMS:
        raise UnknownNameError("system", str(name), SYSTEMS)
    return SYSTEMS[name]


def __dir__() -> list[str]:
    return list(__all__)
