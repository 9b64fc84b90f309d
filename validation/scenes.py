"""Ten scenes on which errors are measured: a model, a start, a time, and the exact motion where there is one.

Each is smooth, and short enough that a small change of the start stays small: at the
end no scene has made it a hundred times larger. So a reference holds 12 digits; those
that are exact were found equal to 34-digit runs, to the last digit of double.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

import mbkit as mb
from mbkit.model import Model
from validation import elliptic
from validation.closed_forms import box_inertia, published

Array = NDArray[np.float64]
Exact = Callable[[ArrayLike], tuple[Array, Array]]


@dataclass(frozen=True)
class Scene:
    """A motion to compute.

    Attributes
    ----------
    name : str
    model : callable
        Makes the model.
    q0, v0 : tuple of float
        Start, (nq,) and (nv,).
    duration : float
        s.
    exact : callable or None
        From a time, or (K,) times, to q and v there, (nq,) and (nv,) or (K, nq) and (K, nv): by
        elliptic functions. A quaternion's sign is free.
    about : str
        Why this scene, and why this long.
    """

    name: str
    model: Callable[[], Model]
    q0: tuple[float, ...]
    v0: tuple[float, ...]
    duration: float
    exact: Exact | None
    about: str


_BOX = published()["dzhanibekov_box"]
_TOP = published()["heavy_top"]
_LIGHT = published()["light_cart_pole"]
_SWING = published()["spherical_pendulum"]
_CART_POLE = elliptic.CartPole(2.0)
_LIGHT_CART_POLE = elliptic.CartPole(math.pi / 2, _LIGHT["M"], _LIGHT["m"], _LIGHT["l"], _LIGHT["g"])
_SPHERICAL_PENDULUM = elliptic.SphericalPendulum(math.pi / 3, _SWING["thetadot0"], _SWING["phidot0"])


def _pendulum(t: ArrayLike) -> tuple[Array, Array]:
    return elliptic.pendulum(t, -math.pi / 2)


def _box(t: ArrayLike) -> tuple[Array, Array]:
    """The centre rests, the box turns."""
    spin = elliptic.free_body(t, box_inertia(_BOX["m"], _BOX["dims"]), _BOX["w0"])
    rest = np.zeros((*np.shape(t), 3))
    return np.concatenate([rest, spin.q], axis=-1), np.concatenate([rest, spin.w], axis=-1)


def _top(t: ArrayLike) -> tuple[Array, Array]:
    across, along, _ = _TOP["J_com"]
    spin = elliptic.heavy_top(t, _TOP["m"], across, along, _TOP["com_body"], _TOP["w0_body"])
    return spin.q, spin.w


def _suspended(t: ArrayLike) -> tuple[Array, Array]:
    return suspension(*_SPHERICAL_PENDULUM.positions(t))


def suspension(place: Array, velocity: Array) -> tuple[Array, Array]:
    """Return (α, β) and their rates of the Cardan suspension of a mass on a rod of length 1.

    Its place is (sin α cos β, sin β, -cos α cos β), with |β| below π/2.
    """
    (x, y, z), (vx, vy, vz) = np.moveaxis(place, -1, 0), np.moveaxis(velocity, -1, 0)
    alpha, fork = np.arctan2(x, -z), np.hypot(x, z)
    q = np.stack([alpha, np.arctan2(y, fork)], axis=-1)
    v = np.stack([(vx * np.cos(alpha) + vz * np.sin(alpha)) / fork, vy / fork], axis=-1)
    return q, v


def _heavy_top() -> Model:
    return mb.catalog.heavy_top(mass=_TOP["m"], inertia=_TOP["J_com"], com=_TOP["com_body"])


def _free_body() -> Model:
    return mb.catalog.free_body(mass=_BOX["m"], sides=_BOX["dims"])


def _light_cart_pole() -> Model:
    return mb.catalog.cart_pole(cart_mass=_LIGHT["M"], pole_mass=_LIGHT["m"], length=_LIGHT["l"])


def _panda() -> Model:
    return mb.load("panda", mimic="free").without("damping")


def _anymal() -> Model:
    return mb.load("anymal_b", floating_base=True)


_LEG = (0.05, 0.6, -1.1)  # hip out, hip, knee of a front leg; behind, hip and knee bend the other way

SCENES: tuple[Scene, ...] = (
    Scene(
        "pendulum",
        mb.catalog.pendulum,
        (-math.pi / 2,),
        (0.0,),
        10.0,
        _pendulum,
        "IFToMM A01: horizontal, at rest; its 10 s, four periods",
    ),
    Scene(
        "double_pendulum",
        mb.catalog.double_pendulum,
        (1.0, 0.5),
        (0.0, 0.0),
        3.0,
        None,
        "a swing too low to turn over, so that it is not chaotic yet; two periods of the slow mode",
    ),
    Scene(
        "cart_pole",
        mb.catalog.cart_pole,
        (0.0, 2.0),
        (0.0, 0.0),
        5.0,
        _CART_POLE.states,
        "from above the horizontal at rest, exact by quadrature; three swings",
    ),
    Scene(
        "light_cart_pole",
        _light_cart_pole,
        (0.0, math.pi / 2),
        (0.0, 0.0),
        float(_LIGHT["T"]),
        _LIGHT_CART_POLE.states,
        "IFToMM proposal: a cart of a millionth of the pole turns each passage below into a jerk of 4429 rad/s",
    ),
    Scene(
        "spherical_pendulum",
        mb.catalog.spherical_pendulum,
        tuple(suspension(*_SPHERICAL_PENDULUM.positions(0.0))[0].tolist()),
        tuple(suspension(*_SPHERICAL_PENDULUM.positions(0.0))[1].tolist()),
        10.0,
        _suspended,
        "60° from down with 2 rad/s of azimuth; nine periods of the polar angle",
    ),
    Scene(
        "dzhanibekov_box",
        _free_body,
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        (0.0, 0.0, 0.0, *map(float, _BOX["w0"])),
        float(_BOX["exact_period"]),
        _box,
        "Gazebo's boxes, complex case without gravity: one period of the tumbling, past the unstable axis twice",
    ),
    Scene(
        "heavy_top",
        _heavy_top,
        (0.0, 0.0, 0.0, 1.0),
        tuple(map(float, _TOP["w0_body"])),
        1.0,
        _top,
        "Terze, Müller, Zlatar's fast top: 24 turns of spin, more than one nutation",
    ),
    Scene(
        "ur5",
        lambda: mb.load("ur5"),
        (0.3, -1.2, 1.0, -0.8, -1.2, 0.4),
        (0.2, 0.0, 0.3, -0.4, 0.5, 1.0),
        1.0,
        None,
        "six joints without drives, falling out of a working pose; the wrist turns over",
    ),
    Scene(
        "panda",
        _panda,
        (0.2, 1.2, 0.1, -1.0, 0.3, 1.8, 0.785, 0.02, 0.02),
        (0.3, 0.0, -0.2, 0.1, 0.4, -0.3, 0.5, 0.01, -0.01),
        0.5,
        None,
        "an arm stretched forward that falls without drives and without damping, both fingers free; longer is wilder",
    ),
    Scene(
        "anymal_b",
        _anymal,
        (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, *_LEG, 0.05, -0.6, 1.1, -0.05, 0.6, -1.1, -0.05, -0.6, 1.1),
        (0.5, 0.2, 0.3, 0.8, -0.5, 1.0, *(1.0, -0.5, 1.5) * 4),
        1.0,
        None,
        "a floating quadruped that falls, tumbles slowly and moves its legs; no contact",
    ),
)
