"""Mechanics on paper, and the own derivation's expressions and C code to take out.

What is written with SymPy loads when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mbkit.derivation import (
    FUNCTIONS,
    CSource,
    Equations,
    ForwardDynamicsDerivatives,
    InverseDynamicsDerivatives,
    export_c,
)

if TYPE_CHECKING:
    from mbkit.lagrangian import systems as systems
    from mbkit.lagrangian.cyclic import ConservedQuantity as ConservedQuantity
    from mbkit.lagrangian.embedding import Embedded as Embedded
    from mbkit.lagrangian.equilibrium import Equilibrium as Equilibrium
    from mbkit.lagrangian.hamilton import CanonicalEquations as CanonicalEquations
    from mbkit.lagrangian.hamilton import Hamiltonian as Hamiltonian
    from mbkit.lagrangian.motion import EquationsOfMotion as EquationsOfMotion
    from mbkit.lagrangian.on_paper import from_model as from_model
    from mbkit.lagrangian.particles import from_particles as from_particles
    from mbkit.lagrangian.quasi import QuasiEquationsOfMotion as QuasiEquationsOfMotion
    from mbkit.lagrangian.quasi import QuasiLagrangian as QuasiLagrangian
    from mbkit.lagrangian.routh import Routhian as Routhian
    from mbkit.lagrangian.system import Lagrangian as Lagrangian
    from mbkit.lagrangian.virtual_work import generalized_force as generalized_force

_HOME = {
    "CanonicalEquations": "mbkit.lagrangian.hamilton",
    "ConservedQuantity": "mbkit.lagrangian.cyclic",
    "Embedded": "mbkit.lagrangian.embedding",
    "EquationsOfMotion": "mbkit.lagrangian.motion",
    "Equilibrium": "mbkit.lagrangian.equilibrium",
    "Hamiltonian": "mbkit.lagrangian.hamilton",
    "Lagrangian": "mbkit.lagrangian.system",
    "QuasiEquationsOfMotion": "mbkit.lagrangian.quasi",
    "QuasiLagrangian": "mbkit.lagrangian.quasi",
    "Routhian": "mbkit.lagrangian.routh",
    "from_model": "mbkit.lagrangian.on_paper",
    "from_particles": "mbkit.lagrangian.particles",
    "generalized_force": "mbkit.lagrangian.virtual_work",
}

__all__ = [
    "FUNCTIONS",
    "CSource",
    "CanonicalEquations",
    "ConservedQuantity",
    "Embedded",
    "Equations",
    "EquationsOfMotion",
    "Equilibrium",
    "ForwardDynamicsDerivatives",
    "Hamiltonian",
    "InverseDynamicsDerivatives",
    "Lagrangian",
    "QuasiEquationsOfMotion",
    "QuasiLagrangian",
    "Routhian",
    "export_c",
    "from_model",
    "from_particles",
    "generalized_force",
    "systems",
]


def __getattr__(name: str) -> Any:
    if name == "systems":
        return importlib.import_module("mbkit.lagrangian.systems")
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'mbkit.lagrangian' has no attribute {name!r}; it has: {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
