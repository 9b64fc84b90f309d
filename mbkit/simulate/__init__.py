"""Motion in time: one trajectory or a batch, by any engine's forward dynamics.

Start with `run`: `simulate` integrates, checks, and returns a `Trajectory`. `integrate` reads the arguments, makes an
`IntegrationProblem` of them (`problem`), and hands it to the solver that the method's entry in `methods` names.
`solvers` has one module for each way to integrate: fixed steps in Python or compiled, adaptive ones, `auto`, and those
of SciPy, heyoka, MuJoCo and Drake. Each returns a `SolverResult`. Phases of dry friction and charts are `stretches` of
a run, each with a solver's run of its own. `run_data` has the states and what follows from them; `trajectory` adds the
checks that integrate once more. `checks` asks after a run whether its numbers can be believed; its doubts stand in the
run's `Stats`.

In: an engine's `Dynamics`, start states, torques (`torque`), events. Out: times and states, with what they cost.
Callers: users, every study, `mbkit simulate`.
"""

from mbkit._imports import make_callable
from mbkit.methods.registry import METHODS, Method, register_method
from mbkit.methods.tableaus import RK4, ImplicitTableau, Tableau
from mbkit.simulate.events import Event, Hit, at_energy, at_limits, at_section
from mbkit.simulate.run import simulate
from mbkit.simulate.run_data import Saturation, Stats
from mbkit.simulate.sensitivity import Sensitivities, sensitivities
from mbkit.simulate.stiffness_measure import Stiffness, stiffness
from mbkit.simulate.torque import Policy, StateFeedback
from mbkit.simulate.trajectory import RunCheck, Trajectory

__all__ = [
    "METHODS",
    "RK4",
    "Event",
    "Hit",
    "ImplicitTableau",
    "Method",
    "Policy",
    "RunCheck",
    "Saturation",
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
