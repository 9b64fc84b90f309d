"""Known wrong values of engines: named here, measured before they are announced.

A defect is announced only where it acts on the model at hand: each adapter
compares the value with another of the same engine that is known to be right, so
a version that has mended it stays silent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from mbkit._warn import warn
from mbkit.errors import KnownDefectWarning


@dataclass(frozen=True)
class Defect:
    """A wrong value that an engine is known to return.

    Attributes
    ----------
    engine, quantity : str
    seen_in : str
        Version in which it was reproduced.
    summary : str
        What is wrong.
    instead : str
        What is right in the same engine.
    """

    engine: str
    quantity: str
    seen_in: str
    summary: str
    instead: str

    def __str__(self) -> str:
        return f"known defect of {self.engine} {self.seen_in}, {self.quantity}: {self.summary}; {self.instead}"


CORIOLIS: Final = Defect(
    "pinocchio",
    "coriolis_matrix",
    "4.1.0",
    "computeCoriolisMatrix leaves C v + g different from nle for some joint types (pinocchio#2053)",
    "nle is right",
)
KINETIC_ENERGY: Final = Defect(
    "pinocchio",
    "kinetic_energy",
    "4.1.0",
    "computeKineticEnergy leaves out the armature of some joint types",
    "half vᵀ M v is right",
)
TINY_MASS: Final = Defect(
    "pinocchio",
    "mass_matrix",
    "4.1.0",
    "the sum of two inertias has a wrong centre of mass where they weigh less than 2.2e-16 kg together, and with it M, "
    "nle and accelerations",
    "the lagrangian engine is right; or take a larger unit of mass",
)


TENDON_ARMATURE: Final = Defect(
    "mujoco",
    "mass_matrix",
    "4.0.0",
    "the armature of a tendon over joints of different branches is left out of M's entries between the branches, and "
    "with them out of accelerations and the kinetic energy",
    "the lagrangian and pinocchio engines have all of a c cᵀ",
)


def announce(defect: Defect, where: str) -> None:
    """Warn, at the line that called the library, that a value is the engine's own and wrong."""
    warn(f"{defect}; returned as it is, because of {where}", KnownDefectWarning)
