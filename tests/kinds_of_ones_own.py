"""Two kinds of elements of one's own and their truth: a spring that hardens, and a damper between two joints' rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbkit.model.elements.forces import JointElement
from mbkit.model.elements.formula import written
from mbkit.model.parts import Constants
from tests.kind_examples import Arm, Site
from tests.plain_mechanics import Case, Part


@dataclass(frozen=True, eq=False)
class HardeningSpring(JointElement):
    """V = ½ k q² + ¼ h q⁴ of a joint."""

    name: str
    joint: str
    numbers: Constants
    symbols = ("k", "h")
    formula = None
    potential = written(lambda q, k, h: k * q**2 / 2 + h * q**4 / 4, "q", "k", "h")

    @property
    def joints(self) -> tuple[str, ...]:  # type: ignore[override]  # it follows from the joint
        """The joint."""
        return (self.joint,)


@dataclass(frozen=True, eq=False)
class RateDamper(JointElement):
    """The forces ∓c (v_0 - v_1) on the rates of two joints."""

    name: str
    joints: tuple[str, ...]
    numbers: Constants
    symbols = ("c",)
    potential = None
    formula = written(lambda v_0, v_1, c: (-c * (v_0 - v_1), c * (v_0 - v_1)), "v_0", "v_1", "c")


K, H, C = 3.0, 50.0, 0.7


def spring(a: Arm, at: Site) -> None:
    k = a.link[at.joint]

    def energy(c: Case, x: np.ndarray) -> np.ndarray:
        q = c.G[k] @ x + c.c[k]
        return K * q**2 / 2 + H * q**4 / 4

    part = HardeningSpring(at.name, at.joint, np.array([K, H]))
    a.with_part(Part(at.name, (), lambda b: b._parts["forces"].append(part), energy=energy))


def damper(a: Arm, at: Site) -> None:
    joints = at.joint, at.others[0]
    i, j = (a.link[x] for x in joints)

    def force(c: Case, _t: float, _x: np.ndarray, u: np.ndarray) -> np.ndarray:
        along = c.G[i] - c.G[j]
        return -C * along * (along @ u)

    part = RateDamper(at.name, joints, np.array([C]))
    a.with_part(Part(at.name, (), lambda b: b._parts["forces"].append(part), force=force))


#: Class of each, and what adds it to an arm.
OWN = {"spring": (HardeningSpring, spring), "damper": (RateDamper, damper)}
