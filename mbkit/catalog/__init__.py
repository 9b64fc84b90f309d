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

from mbkit.catalog import mechanisms, planar_loops, rigid_bodies, rolling, spatial_loops
from mbkit.catalog._system import SYSTEMS
from mbkit.catalog.mechanisms import *  # noqa: F403  # each family names its systems once
from mbkit.catalog.planar_loops import *  # noqa: F403
from mbkit.catalog.rigid_bodies import *  # noqa: F403
from mbkit.catalog.rolling import *  # noqa: F403
from mbkit.catalog.spatial_loops import *  # noqa: F403
from mbkit.errors import require_known
from mbkit.model import Model

__all__ = ["get", "systems"]
__all__ += mechanisms.__all__
__all__ += planar_loops.__all__
__all__ += rigid_bodies.__all__
__all__ += rolling.__all__
__all__ += spatial_loops.__all__


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
    require_known("system", SYSTEMS, name)
    return SYSTEMS[name]


def __dir__() -> list[str]:
    return list(__all__)
