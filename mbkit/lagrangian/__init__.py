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
    from mbkit.lagrangian.motion import EquationsOfMotion as EquationsOfMotion
    from mbkit.lagrangian.system import Lagrangian as Lagrangian

_HOME = {
    "EquationsOfMotion": "mbkit.lagrangian.motion",
    "Lagrangian": "mbkit.lagrangian.system",
}

__all__ = [
    "FUNCTIONS",
    "CSource",
    "Equations",
    "EquationsOfMotion",
    "ForwardDynamicsDerivatives",
    "InverseDynamicsDerivatives",
    "Lagrangian",
    "export_c",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'mbkit.lagrangian' has no attribute {name!r}; it has: {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
