"""The quantities of a model's dynamics, one row each, which engines, C code, checks and comparisons read.

A quantity of bodies is added with its row here, its expression in `mbkit.derivation.body_motion`, its method of
`Dynamics` and its term in `mbkit.studies.compare`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from mbkit.model.elements.kinds import EFFECTS


class Quantity(NamedTuple):
    """What is known of a quantity before any engine evaluates it.

    Attributes
    ----------
    arguments : tuple of str
        The arrays of its method: q, v, a and tau, and "wrenches", six numbers for each frame.
    shape : tuple of str
        Axes of one state's value, such as ``("nv", "nv")``; none of a number.
    group : str
        What it is of, such as the "equation" of motion, a "frame", the "whole" or a "row" of constraints.
    listed : bool
        Whether it is among the quantities that `Dynamics.supports` names.
    follows : str
        The quantity that it is formed from on every engine.
    symbol, meaning : str
        Its name and its description in a header of C.
    elsewhere : tuple of str
        Its names in Pinocchio, in MuJoCo and in textbooks.
    """

    arguments: tuple[str, ...]
    shape: tuple[str, ...]
    group: str
    listed: bool = True
    follows: str = ""
    symbol: str = ""
    meaning: str = ""
    elsewhere: tuple[str, ...] = ()


# Group | name | arguments | shape | symbol and meaning in C | names elsewhere. A name with an underscore is not listed;
# what stands behind "<" is the quantity that it follows from.
_TABLE: Final = """
equation | mass_matrix | q | nv nv | M | mass matrix M(q), symmetric | M crba mass inertia_matrix qM full_m
equation | coriolis_matrix | q v | nv nv | C | Coriolis matrix C(q, v), Christoffel's | C coriolis computeCoriolisMatrix
equation | coriolis_force | q v | nv | Cv | C(q, v) v |
equation | gravity | q | nv | g | gravity g(q), without springs | g G computeGeneralizedGravity
equation | nle | q v | nv | nle | C(q, v) v + g(q) | h bias qfrc_bias nonLinearEffects non_linear_effects
equation | passive | q v | nv | tau_passive | forces of springs, dampers, {jump} and functions \
    | qfrc_passive damping
equation | inverse_dynamics | q v a | nv | tau | forces M a + C(q, v) v + g(q) - tau_passive(q, v) \
    | rnea id mj_inverse qfrc_inverse
equation | forward_dynamics | q v tau | nv | a | accelerations dv/dt under forces tau, by the equation of motion \
    | aba fd mj_forward qacc acc
equation | kinetic_energy | q v | | T | kinetic energy, J |
equation | potential_energy | q | | V | potential energy of gravity and springs, J |
stop | _stop_forces | q v tau | nv | | |
inverse | mass_matrix_inverse | q | nv nv | | | Minv computeMinverse compute_minverse
rate | _energy_rate | q v a | | dE_dt | d(T + V)/dt at accelerations a, W |
derivatives | _inverse_dynamics_derivatives | q v a | 3 nv nv | | | computeRNEADerivatives
derivatives | _forward_dynamics_derivatives | q v tau | 3 nv nv | | | computeABADerivatives
wrenches | _inverse_dynamics_with_wrenches | q v a wrenches | nv | | |
wrenches | _forward_dynamics_with_wrenches | q v tau wrenches | nv | | |
symbols | function | | | | |
frame | pose | q | frames 4 4 | X | pose X_WF of the frame, homogeneous \
    | oMf oMi fk forward_kinematics frame_placement xpos
frame | jacobian | q | frames 6 nv | J | Jacobian of the frame's velocity, linear then angular \
    | J Jacobian getFrameJacobian mj_jac mj_jacBody frame_jacobian
frame | velocity | q v | frames 6 | V | velocity of the frame, linear then angular |
frame | acceleration | q v a | frames 6 | A \
    | classical acceleration of the frame, linear then angular, without gravity |
frame | jacobian_dot_v | q v | frames 6 | Jdot_v | rate of the frame's velocity at dv/dt = 0 |
frame | generalized_force | q wrenches | nv | tau | J^T w of a wrench on the frame, force then moment |
whole | center_of_mass | q | 3 | p_G | centre of mass of all bodies in the world, m | com centerOfMass subtree_com
whole | center_of_mass_velocity | q v | 3 | v_G | its velocity, m/s |
whole | center_of_mass_acceleration | q v a | 3 | a_G | its acceleration, m/s^2 |
whole | center_of_mass_jacobian | q | 3 nv | J_G | Jacobian of its velocity |
whole | centroidal_momentum | q v | 6 | h_G \
    | linear, then angular momentum about the centre of mass, in world axes |
whole | centroidal_momentum_matrix | q | 6 nv | A_G | matrix that takes v to the centroidal momentum | Ag ccrba A_G
whole | centroidal_momentum_bias | q v | 6 | Adot_G_v | rate of the centroidal momentum at dv/dt = 0 |
whole | locked_inertia | q | 6 6 | I_G | inertia of the whole about its centre of mass, in world axes |
load | joint_wrenches | q v a wrenches | joints 6 | | |
load | _loads_under_force | q v tau | loads 6 | | |
load | _loads_of_motion | q v a tau | loads 6 | | |
body | newton_euler_residual < joint_wrenches | q v a tau | bodies 6 | | |
regressor | regressor | q v a | nv columns | | | computeJointTorqueRegressor
regressor | momentum_regressor | q v | nv columns | | |
regressor | energy_regressor | q v | 2 columns | | |
row | constraint_residual | q | rows | | |
row | constraint_jacobian | q | rows nv | | |
row | _every_jacobian | q | rows nv | | |
row | constraint_rate | q v | rows | | |
row | constraint_rate_gradient | q v | rows nv | | |
row | constraint_bias | q v | rows | | |
row | constraint_forces | q v tau | rows | | |
row | _independent_multipliers | q v tau | rows | | |
row | generalized_constraint_force | q v tau | nv | | |
actuator | actuator_forces | q v a | | | |
loop | loop_wrenches < loads_under_force | q v tau | loops 6 | | |
loop | undetermined_loads < every_jacobian | q | | | |
motion | reduced_inertia < constraint_bias | q | | | |
"""


def _row(line: str) -> tuple[str, Quantity]:
    group, name, arguments, shape, symbol, meaning, elsewhere = (x.strip() for x in line.split("|"))
    meaning = meaning.replace("{jump}", EFFECTS["jump"])
    name, _, follows = name.partition(" < ")
    given, axes = tuple(arguments.split()), tuple(shape.split())
    listed = not name.startswith("_")
    return name.removeprefix("_"), Quantity(
        given, axes, group, listed, follows, symbol, meaning, tuple(elsewhere.split())
    )


#: Quantity by name.
QUANTITIES: Final[dict[str, Quantity]] = dict(map(_row, _TABLE.strip().splitlines()))
#: Groups that models written as energies do not have.
OF_BODIES: Final = frozenset({"frame", "whole", "load", "body", "regressor", "loop"})


def of_groups(*groups: str) -> dict[str, tuple[str, ...]]:
    """Return the arguments of the quantities of some groups, by name."""
    return {name: x.arguments for name, x in QUANTITIES.items() if x.group in groups}
