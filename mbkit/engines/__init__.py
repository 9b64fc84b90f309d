"""The engines: one adapter each behind the protocol `Dynamics`, imported when it is first asked for."""

from mbkit.engines.base import QUANTITIES, Dynamics
from mbkit.engines.linearization import DiscreteLinearization, InverseDynamicsSecondDerivatives, Linearization
from mbkit.engines.registry import ENGINES, EngineInfo, dynamics, register_engine
from mbkit.engines.versions.engine_version import EngineVersion, engine

__all__ = [
    "ENGINES",
    "QUANTITIES",
    "DiscreteLinearization",
    "Dynamics",
    "EngineInfo",
    "EngineVersion",
    "InverseDynamicsSecondDerivatives",
    "Linearization",
    "dynamics",
    "engine",
    "register_engine",
]
