"""Mechanics on paper, and the own derivation's expressions and C code to take out."""

from mbkit.derivation import (
    FUNCTIONS,
    CSource,
    Equations,
    ForwardDynamicsDerivatives,
    InverseDynamicsDerivatives,
    export_c,
)

__all__ = ["FUNCTIONS", "CSource", "Equations", "ForwardDynamicsDerivatives", "InverseDynamicsDerivatives", "export_c"]
