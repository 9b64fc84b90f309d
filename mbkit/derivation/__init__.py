"""Kinematics to equations to functions: mbkit's own derivation."""

from mbkit.derivation.equations import ELIMINATIONS, FUNCTIONS, Elimination, Equations
from mbkit.derivation.link_equations import LinkEquations, elimination_of, equations_of

__all__ = ["ELIMINATIONS", "FUNCTIONS", "Elimination", "Equations", "LinkEquations", "elimination_of", "equations_of"]
