"""Energies to equations to functions: mbkit's own derivation."""

from mbkit.derivation.derivatives import ForwardDynamicsDerivatives, InverseDynamicsDerivatives
from mbkit.derivation.equations import FUNCTIONS, Equations, equations_of
from mbkit.derivation.export import CSource, export_c

__all__ = [
    "FUNCTIONS",
    "CSource",
    "Equations",
    "ForwardDynamicsDerivatives",
    "InverseDynamicsDerivatives",
    "equations_of",
    "export_c",
]
