"""Textbook and published systems, each a function that returns a `Model`.

Every function takes keyword parameters in SI units, numbers or `mbkit.Parameter`; its docstring gives the coordinates,
the zero pose and the source. Planar systems move in the x-z plane, gravity along -z, with angles from the downward
vertical that grow towards +x: a right-handed turn about -y. Planar systems without gravity move in the x-y plane.

Mechanisms with loops, of which `slider_crank` is one, are closed in their neutral pose: `Model.neutral` gives a state,
and `mbkit.lagrangian.from_model` solves them. Their angles are measured from that pose. So are `rolling_disc`,
`chaplygin_sleigh` and `bicycle`, which roll or glide without slip, on the ground there.
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
from mbkit.catalog.planar_loops import (
    andrews_squeezer,
    chebyshev,
    five_bar,
    four_bar,
    four_bars,
    hoecken,
    inverted_slider_crank,
    pantograph,
    parallel_gripper,
    peaucellier,
    planar_3rrr,
    scissor,
    watt,
)
from mbkit.catalog.rigid_bodies import (
    clamped_beam,
    flexible_spacecraft,
    free_body,
    gyroscope,
    heavy_top,
    spacecraft_with_wheels,
)
from mbkit.catalog.rolling import bicycle, chaplygin_sleigh, rolling_disc
from mbkit.catalog.spatial_loops import bricard, delta_robot, double_cardan_shaft, flyball_governor, stewart_platform
from mbkit.errors import UnknownNameError
from mbkit.model import Model

__all__ = ["acrobot", "andrews_squeezer", "bicycle", "bricard", "cart_pole", "chain", "chaplygin_sleigh"]
__all__ += ["chebyshev", "clamped_beam"]
__all__ += ["delta_robot", "double_cardan_shaft", "double_pendulum", "elastic_pendulum", "five_bar"]
__all__ += ["flexible_spacecraft", "flyball_governor", "four_bar", "four_bars", "free_body", "furuta_pendulum"]
__all__ += ["get", "gyroscope", "heavy_top", "hoecken", "inverted_slider_crank", "pantograph"]
__all__ += ["parallel_gripper", "peaucellier", "pendulum", "planar_3rrr", "rolling_disc", "scissor", "slider_crank"]
__all__ += ["spacecraft_with_wheels", "spherical_pendulum", "stewart_platform", "systems", "watt"]


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
