"""Two kinds of elements of one's own: a spring that hardens, and a damper between the rates of two joints."""

from __future__ import annotations

from dataclasses import dataclass

from mbkit.model.elements.forces import JointElement
from mbkit.model.elements.formula import written
from mbkit.model.parts import Constants


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
