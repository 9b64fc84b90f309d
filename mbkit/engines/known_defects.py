"""Known wrong values of engines: named here, measured before they are announced.

A defect is announced only where it acts on the model at hand: each adapter compares the value with another of the same
engine that is known to be right, so a version that has mended it stays silent.
"""

from __future__ import annotations

from typing import Final

from mbkit.errors import KnownDefectWarning, warn

# Engine, the first and the last version in which it was reproduced, quantity; the wrong value; the right one. The
# first is the oldest that was tried, or the one that brought what is wrong: Pinocchio's wheels have an armature since
# 3.3.1, MuJoCo's tendons since 3.3.1.
CORIOLIS: Final = (
    "known defect of pinocchio 2.6.18 to 4.1.0, coriolis_matrix: computeCoriolisMatrix leaves C v + g different from "
    "nle for some joint types (pinocchio#2053); nle is right"
)
KINETIC_ENERGY: Final = (
    "known defect of pinocchio 3.3.1 to 4.1.0, kinetic_energy: computeKineticEnergy leaves out the armature of some "
    "joint types; half vᵀ M v is right"
)
JACOBIAN_RATE: Final = (
    "known defect of pinocchio 2.6.18 to 4.1.0, jacobian_dot_v and centroidal_momentum_bias: "
    "computeJointJacobiansTimeVariation and dccrba take the axes of a joint for fixed in its child (pinocchio#2053); "
    "acceleration at a = 0 is right"
)
TINY_MASS: Final = (
    "known defect of pinocchio 2.6.18 to 4.1.0, mass_matrix: the sum of two inertias has a wrong centre of mass where "
    "they weigh less than 2.2e-16 kg together, and with it M, nle and accelerations; the lagrangian engine is right; "
    "or take a larger unit of mass"
)
TENDON_ARMATURE: Final = (
    "known defect of mujoco 3.3.1 to 4.0.0, mass_matrix: the armature of a tendon over joints of different branches is "
    "left out of M's entries between the branches, and with them out of accelerations and the kinetic energy; the "
    "lagrangian and pinocchio engines have all of a c cᵀ"
)

ENERGIES: Final = (
    "known defect of mujoco 3.1.0 to 3.1.3, kinetic_energy: the Python binding's array of energies has stride zero, so "
    "that the entry of the potential energy is read, which may be zero; half vᵀ M v is right"
)

#: Of quantities that begin so, for versions in environments of their own.
OF_MUJOCO: Final = {"kinetic_": ENERGIES}
OF_PINOCCHIO: Final = {"kinetic_": KINETIC_ENERGY, "coriolis": CORIOLIS}


def announce(defect: str, where: str) -> None:
    """Warn, at the line that called the library, that a value is the engine's own and wrong."""
    warn(f"{defect}; returned as it is, because of {where}", KnownDefectWarning)
