"""Textbook and published systems, each a function that returns a `Model`.

Every function takes keyword parameters in SI units, numbers or `mbkit.Parameter`;
its docstring gives the coordinates, the zero pose and the source. Planar systems move in the x-z plane,
gravity along -z, with angles from the downward vertical that grow towards +x: a
right-handed turn about -y.
"""

from __future__ import annotations

from collections.abc import Callable

from mbkit.catalog.cart_pole import cart_pole
from mbkit.catalog.chain import chain
from mbkit.catalog.double_pendulum import double_pendulum
from mbkit.catalog.free_body import free_body
from mbkit.catalog.heavy_top import heavy_top
from mbkit.catalog.pendulum import pendulum
from mbkit.catalog.spherical_pendulum import spherical_pendulum
from mbkit.errors import UnknownNameError
from mbkit.model import Model

__all__ = [
    "cart_pole",
    "chain",
    "double_pendulum",
    "free_body",
    "get",
    "heavy_top",
    "pendulum",
    "spherical_pendulum",
    "systems",
]

_SYSTEMS: dict[str, Callable[..., Model]] = {
    f.__name__: f for f in (pendulum, double_pendulum, cart_pole, spherical_pendulum, chain, heavy_top, free_body)
}


def systems() -> dict[str, Callable[..., Model]]:
    """Return every system's function by its name.

    Examples
    --------
    >>> import mbkit as mb
    >>> list(mb.catalog.systems())
    ['pendulum', 'double_pendulum', 'cart_pole', 'spherical_pendulum', 'chain', 'heavy_top', 'free_body']
    """
    return dict(_SYSTEMS)


def get(name: str) -> Callable[..., Model]:
    """Return the function of the system of this name.

    Raises
    ------
    UnknownNameError
        With near names.
    """
    if name not in _SYSTEMS:
        raise UnknownNameError("system", str(name), _SYSTEMS)
    return _SYSTEMS[name]


def __dir__() -> list[str]:
    return list(__all__)
