"""Motion in time: one trajectory or a batch, by any engine's forward dynamics."""

from mbkit._callable import make_callable
from mbkit.methods.registry import METHODS, Method, register_method
from mbkit.methods.tableaus import RK4, ImplicitTableau, Tableau
from mbkit.simulate.diagnostics.stiffness import Stiffness, stiffness
from mbkit.simulate.events import Event, Hit, at_energy, at_limits, at_section
from mbkit.simulate.result import Stats
from mbkit.simulate.run import simulate
from mbkit.simulate.sensitivity import Sensitivities, sensitivities
from mbkit.simulate.torque import StateFeedback
from mbkit.simulate.trajectory import RunCheck, Trajectory

__all__ = [
    "METHODS",
    "RK4",
    "Event",
    "Hit",
    "ImplicitTableau",
    "Method",
    "RunCheck",
    "Sensitivities",
    "StateFeedback",
    "Stats",
    "Stiffness",
    "Tableau",
    "Trajectory",
    "at_energy",
    "at_limits",
    "at_section",
    "register_method",
    "sensitivities",
    "simulate",
    "stiffness",
]

make_callable(__name__, simulate)
