"""Mechanisms: forces of actuators, in joints and loops, motion by independent coordinates, rows from moving frames."""

from typing import Final

#: What models with constraints have beside `mbkit.engines.constrained.QUANTITIES`.
QUANTITIES: Final = ("actuator_forces", "loop_wrenches", "undetermined_loads", "reduced_inertia")
#: Quantity -> the one that it follows from.
FOLLOWING: Final = {
    "loop_wrenches": "loads_under_force",
    "undetermined_loads": "every_jacobian",
    "reduced_inertia": "constraint_bias",
}
#: Of these, what takes loops of bodies.
OF_BODIES: Final = frozenset({"loop_wrenches", "undetermined_loads"})
