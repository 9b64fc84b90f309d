"""Energies to equations to functions: mbkit's own derivation."""

from mbkit.derivation.equations import FUNCTIONS, Equations, equations_of

__all__ = ["FUNCTIONS", "Equations", "equations_of"]
