"""Mechanics on paper, and the expressions and C code of mbkit's own derivation.

Modules that need SymPy load at their first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mbkit._check import needed
from mbkit.codegen.c_source import CSource, export_c
from mbkit.derivation import FUNCTIONS, Equations
from mbkit.engines.linearization import ForwardDynamicsDerivatives, InverseDynamicsDerivatives

if TYPE_CHECKING:
    from mbkit.lagrangian import systems as systems
    from mbkit.lagrangian.continua.beam import beam as beam
    from mbkit.lagrangian.continua.beam import clamped_free as clamped_free
    from mbkit.lagrangian.continua.continuum import Continuum as Continuum
    from mbkit.lagrangian.continua.continuum import FieldEquations as FieldEquations
    from mbkit.lagrangian.continua.ritz import AssumedModes as AssumedModes
    from mbkit.lagrangian.continua.ritz import NormalModes as NormalModes
    from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion as EquationsOfMotion
    from mbkit.lagrangian.from_description import from_model as from_model
    from mbkit.lagrangian.independent_coordinates import Embedded as Embedded
    from mbkit.lagrangian.program_text import ProgramText as ProgramText
    from mbkit.lagrangian.program_text import program as program
    from mbkit.lagrangian.reduction.hamilton import CanonicalEquations as CanonicalEquations
    from mbkit.lagrangian.reduction.hamilton import ConservedQuantity as ConservedQuantity
    from mbkit.lagrangian.reduction.hamilton import Hamiltonian as Hamiltonian
    from mbkit.lagrangian.reduction.impulses import ImpulseEquations as ImpulseEquations
    from mbkit.lagrangian.reduction.nonholonomic import Integrability as Integrability
    from mbkit.lagrangian.reduction.nonholonomic import NonholonomicEquations as NonholonomicEquations
    from mbkit.lagrangian.reduction.quasi_equations import QuasiEquationsOfMotion as QuasiEquationsOfMotion
    from mbkit.lagrangian.reduction.routh import Routhian as Routhian
    from mbkit.lagrangian.statics.equilibrium import Equilibrium as Equilibrium
    from mbkit.lagrangian.statics.newton_euler import FreeBodies as FreeBodies
    from mbkit.lagrangian.statics.newton_euler import newton_euler as newton_euler
    from mbkit.lagrangian.statics.portrait import portrait as portrait
    from mbkit.lagrangian.statics.virtual_work import from_particles as from_particles
    from mbkit.lagrangian.statics.virtual_work import generalized_force as generalized_force
    from mbkit.lagrangian.system import Lagrangian as Lagrangian
    from mbkit.lagrangian.system import QuasiLagrangian as QuasiLagrangian

#: Names by the modules that hold them.
_NAMES = {
    "continua.beam": "beam clamped_free",
    "continua.continuum": "Continuum FieldEquations",
    "continua.ritz": "AssumedModes NormalModes",
    "energies.equations_of_motion": "EquationsOfMotion",
    "from_description": "from_model",
    "independent_coordinates": "Embedded",
    "program_text": "ProgramText program",
    "reduction.hamilton": "CanonicalEquations ConservedQuantity Hamiltonian",
    "reduction.impulses": "ImpulseEquations",
    "reduction.nonholonomic": "Integrability NonholonomicEquations",
    "reduction.quasi_equations": "QuasiEquationsOfMotion",
    "reduction.routh": "Routhian",
    "statics.equilibrium": "Equilibrium",
    "statics.newton_euler": "FreeBodies newton_euler",
    "statics.portrait": "portrait",
    "statics.virtual_work": "from_particles generalized_force",
    "system": "Lagrangian QuasiLagrangian",
}
_HOME = {name: f"mbkit.lagrangian.{module}" for module, names in _NAMES.items() for name in names.split()}

__all__ = ["FUNCTIONS", "CSource", "Equations", "ForwardDynamicsDerivatives", "InverseDynamicsDerivatives", "export_c"]
__all__ += ["systems", *_HOME]


def __getattr__(name: str) -> Any:
    with needed("sympy", "mechanics on paper"):
        if name == "systems":
            return importlib.import_module("mbkit.lagrangian.systems")
        if name in _HOME:
            return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'mbkit.lagrangian' has no attribute {name!r}; it has: {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
