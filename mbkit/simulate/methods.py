"""The methods of integration, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from mbkit.errors import InputError, UnknownNameError

__all__ = ["METHODS", "Method", "method_of"]


@dataclass(frozen=True)
class Method:
    """A way to integrate.

    Attributes
    ----------
    name : str
    kind : {"fixed", "adaptive", "native"}
        A step `dt` on any engine; a tolerance `rtol` on any engine; or a step of
        the engine's own integrator.
    order : int
        Order of the global error, as a function of the step.
    stages : int
        Evaluations of the forward dynamics per step.
    about : str
        One line, with the source.
    """

    name: str
    kind: Literal["fixed", "adaptive", "native"]
    order: int
    stages: int
    about: str


METHODS: Final[dict[str, Method]] = {
    m.name: m
    for m in (
        Method("rk4", "fixed", 4, 4, "Kutta's method of 1901; Munthe-Kaas (1999) on rotations, as MuJoCo 4 does it"),
        Method("semi_implicit_euler", "fixed", 1, 1, "new velocity, then the position with it, as MuJoCo does it"),
        Method("dop853", "adaptive", 8, 12, "SciPy's DOP853 (Hairer, Nørsett, Wanner 1993, ch. II.5)"),
        Method("mujoco_euler", "native", 1, 1, "MuJoCo's own semi-implicit Euler"),
        Method("mujoco_rk4", "native", 4, 4, "MuJoCo's own RK4"),
        Method("mujoco_implicit", "native", 1, 1, "MuJoCo's own Euler, implicit in velocity"),
        Method("mujoco_implicitfast", "native", 1, 1, "as mujoco_implicit, without the Coriolis derivatives"),
    )
}


def method_of(name: object) -> Method:
    """Return the method of this name."""
    if not isinstance(name, str):
        raise InputError(f"method: expected a name, got {name!r}; there are: {', '.join(METHODS)}")
    if name not in METHODS:
        raise UnknownNameError("method", name, METHODS)
    return METHODS[name]
