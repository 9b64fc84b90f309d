"""Kinematics to equations to functions: mbkit's own derivation."""

from mbkit.derivation.equations import FUNCTIONS, Equations
from mbkit.derivation.link_equations import LinkEquations, equations_of

__all__ = ["FUNCTIONS", "Equations", "LinkEquations", "equations_of"]
