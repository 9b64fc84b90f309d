"""Energies to equations to functions: mbkit's own derivation."""

from mbkit.lagrangian.equations import FUNCTIONS, Equations

__all__ = ["FUNCTIONS", "Equations"]
