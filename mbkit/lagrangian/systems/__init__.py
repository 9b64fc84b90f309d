"""Systems on paper: functions that return a `Lagrangian` in the symbols of textbooks.

Every function takes keyword parameters in SI units, or None for a value that is given later, when the
system is run; its docstring gives the coordinates, the zero pose and the source.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from mbkit.errors import UnknownNameError
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.systems.moving_frames import bead_on_hoop, driven_pendulum
from mbkit.lagrangian.systems.one_degree import (
    falling_body,
    one_degree,
    rigid_slider_crank,
    slider_crank,
    sliding_block,
)
from mbkit.lagrangian.systems.orbits import kepler
from mbkit.lagrangian.systems.pendulums import double_pendulum, elastic_pendulum, pendulum, spherical_pendulum
from mbkit.lagrangian.systems.tops import gyroscope, heavy_top, rigid_body
from mbkit.lagrangian.systems.underactuated import acrobot, cart_pole, furuta_pendulum

_SYSTEMS: Final[dict[str, Callable[..., Lagrangian]]] = {
    f.__name__: f
    for f in (
        pendulum,
        double_pendulum,
        elastic_pendulum,
        spherical_pendulum,
        cart_pole,
        acrobot,
        furuta_pendulum,
        kepler,
        bead_on_hoop,
        driven_pendulum,
        slider_crank,
        rigid_slider_crank,
        heavy_top,
        gyroscope,
        rigid_body,
        sliding_block,
        falling_body,
    )
}

__all__ = [
    "acrobot",
    "bead_on_hoop",
    "cart_pole",
    "double_pendulum",
    "driven_pendulum",
    "elastic_pendulum",
    "falling_body",
    "furuta_pendulum",
    "get",
    "gyroscope",
    "heavy_top",
    "kepler",
    "names",
    "one_degree",
    "pendulum",
    "rigid_body",
    "rigid_slider_crank",
    "slider_crank",
    "sliding_block",
    "spherical_pendulum",
]


def names() -> tuple[str, ...]:
    """Return the systems' names.

    Examples
    --------
    >>> import mbkit as mb
    >>> mb.lagrangian.systems.names()[:3]
    ('pendulum', 'double_pendulum', 'elastic_pendulum')
    """
    return tuple(_SYSTEMS)


def get(name: str) -> Callable[..., Lagrangian]:
    """Return the function of the system of this name.

    Raises
    ------
    UnknownNameError
        With near names.
    """
    if name not in _SYSTEMS:
        raise UnknownNameError("system on paper", str(name), _SYSTEMS)
    return _SYSTEMS[name]
