"""How a simulator runs a description: engine, integrator, step, servos, rate of control.

A setting that nobody has said is None; what compares two sides gives it the value of the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Final

import numpy as np

from mbkit._check import count, real
from mbkit.errors import InputError, require_known

_NO_BOUND: Final = (-np.inf, np.inf)


@dataclass(frozen=True)
class Servo:
    """An actuator of one joint, as MuJoCo's: a position servo has the force f = kp (u - l) - kv dl/dt, l = gear q.

    A velocity servo has f = kv (u - dl/dt), a motor f = u. The joint feels gear times f.

    Attributes
    ----------
    joint : str
    kind : {"position", "velocity", "motor"}
    kp, kv : float
        N m/rad or N/m, N m s/rad or N s/m.
    gear : float
    control_range, force_range : (float, float)
        Bounds of u and of f.
    """

    joint: str
    kind: str = "motor"
    kp: float = 0.0
    kv: float = 0.0
    gear: float = 1.0
    control_range: tuple[float, float] = _NO_BOUND
    force_range: tuple[float, float] = _NO_BOUND

    def __post_init__(self) -> None:
        require_known("kind of servo", ("position", "velocity", "motor"), self.kind)
        for name in ("control_range", "force_range"):
            low, high = getattr(self, name)
            if not low < high:
                raise InputError(f"{name}: expected a lower and a higher bound, got ({low}, {high})")

    def torque(self, u: float, q: float, v: float) -> float:
        """Return the generalized force at a control, a position and a velocity."""
        u = min(max(u, self.control_range[0]), self.control_range[1])
        length, rate = self.gear * q, self.gear * v
        force = {"position": self.kp * (u - length) - self.kv * rate, "velocity": self.kv * (u - rate)}.get(
            self.kind, u
        )
        return self.gear * min(max(force, self.force_range[0]), self.force_range[1])


@dataclass(frozen=True)
class Settings:
    """Settings of a simulation; None is one that nobody has said.

    Attributes
    ----------
    engine : str
        As in `mbkit.dynamics`.
    integrator : str
        A method of `mbkit.simulate` on that engine.
    time_step : float
        s; of a method with a fixed step.
    implicit_damping : bool
        Whether MuJoCo's Euler takes the joints' damping at the end of a step.
    solver, iterations, tolerance : str, int, float
        Of MuJoCo's constraints: friction, limits, loops.
    limits : bool
        Whether the limits that joints have act, softly.
    servos : tuple of Servo
        Of the joints that have one; the others get the control as a torque.
    control_period : float
        s; the controller is asked this often, and its answer is held.
    limit_softness : tuple of (str, solref, solimp)
        Of the joints whose limits have another softness than MuJoCo's own.
    """

    engine: str | None = None
    integrator: str | None = None
    time_step: float | None = None
    implicit_damping: bool | None = None
    solver: str | None = None
    iterations: int | None = None
    tolerance: float | None = None
    limits: bool | None = None
    servos: tuple[Servo, ...] | None = None
    control_period: float | None = None
    limit_softness: tuple[tuple[str, tuple[float, ...], tuple[float, ...]], ...] | None = None

    def __post_init__(self) -> None:
        for name in ("time_step", "control_period"):
            if getattr(self, name) is not None:
                real(name, getattr(self, name), positive=True)
        if self.iterations is not None:
            count("iterations", self.iterations)

    def filled(self, other: Settings) -> Settings:
        """Return these settings, those that nobody has said from another."""
        mine = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{n: getattr(other, n) for n, x in mine.items() if x is None})

    def servo(self, joint: str) -> Servo | None:
        """Return the servo of a joint, or None."""
        return next((x for x in self.servos or () if x.joint == joint), None)


#: Kind of a cause and unit, for each setting and each number of a servo.
WORDS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        "engine": ("engine", ""),
        "integrator": ("integrator", ""),
        "time_step": ("time step", "s"),
        "implicit_damping": ("implicit damping", ""),
        "solver": ("constraint solver", ""),
        "iterations": ("solver iterations", ""),
        "tolerance": ("solver tolerance", ""),
        "limits": ("joint limits", ""),
        "control_period": ("control period", "s"),
        "limit_softness": ("softness of joint limits", ""),
        "kind": ("servo", ""),
        "kp": ("servo kp", ""),
        "kv": ("servo kv", ""),
        "gear": ("servo gear", ""),
        "control_range": ("control range", ""),
        "force_range": ("force range", ""),
    }
)
