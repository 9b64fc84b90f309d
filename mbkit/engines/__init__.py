"""The engines: one adapter each behind the protocol `Dynamics`, imported when it is first asked for."""

from mbkit.engines.base import QUANTITIES, Dynamics
from mbkit.engines.closed_loops.actuation import ActuatorForces
from mbkit.engines.closed_loops.loop_loads import UndeterminedLoads
from mbkit.engines.closed_loops.reduced_inertia import ReducedInertia
from mbkit.engines.linearization import DiscreteLinearization, InverseDynamicsSecondDerivatives, Linearization
from mbkit.engines.registry import ENGINES, EngineInfo, dynamics, register_engine
from mbkit.engines.remote.packages import EngineVersion, engine

__all__ = [
    "ENGINES",
    "QUANTITIES",
    "ActuatorForces",
    "DiscreteLinearization",
    "Dynamics",
    "EngineInfo",
    "EngineVersion",
    "InverseDynamicsSecondDerivatives",
    "Linearization",
    "ReducedInertia",
    "UndeterminedLoads",
    "dynamics",
    "engine",
    "register_engine",
]
