"""Energies to equations to functions: mbkit's own derivation."""

from mbkit.lagrangian.derivatives import ForwardDynamicsDerivatives, InverseDynamicsDerivatives
from mbkit.lagrangian.equations import FUNCTIONS, Equations
from mbkit.lagrangian.export import CSource, export_c

__all__ = ["FUNCTIONS", "CSource", "Equations", "ForwardDynamicsDerivatives", "InverseDynamicsDerivatives", "export_c"]
