"""The engines: one adapter each behind the protocol `Dynamics`, imported when it is first asked for."""

from mbkit.engines.base import QUANTITIES, Dynamics
from mbkit.engines.linearization import DiscreteLinearization, InverseDynamicsSecondDerivatives, Linearization
from mbkit.engines.registry import ENGINES, EngineInfo, dynamics, register_engine

__all__ = [
    "ENGINES",
    "QUANTITIES",
    "DiscreteLinearization",
    "Dynamics",
    "EngineInfo",
    "InverseDynamicsSecondDerivatives",
    "Linearization",
    "dynamics",
    "register_engine",
]
