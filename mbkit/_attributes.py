"""Read-only attributes, and `AttributeError`s that name the attribute of the same meaning."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mbkit.errors import InputError, nearest

#: Names of Pinocchio, MuJoCo and of textbooks for what is called so here.
ELSEWHERE: Final = {
    **dict.fromkeys(("M", "crba", "mass", "inertia_matrix", "qM", "full_m"), "mass_matrix"),
    **dict.fromkeys(("Minv", "computeMinverse", "compute_minverse"), "mass_matrix_inverse"),
    **dict.fromkeys(("C", "coriolis", "computeCoriolisMatrix"), "coriolis_matrix"),
    **dict.fromkeys(("g", "G", "computeGeneralizedGravity"), "gravity"),
    **dict.fromkeys(("h", "bias", "qfrc_bias", "nonLinearEffects", "non_linear_effects"), "nle"),
    **dict.fromkeys(("qfrc_passive", "damping"), "passive"),
    **dict.fromkeys(("rnea", "id", "mj_inverse", "qfrc_inverse"), "inverse_dynamics"),
    **dict.fromkeys(("aba", "fd", "mj_forward", "qacc", "acc"), "forward_dynamics"),
    **dict.fromkeys(("J", "Jacobian", "getFrameJacobian", "mj_jac", "mj_jacBody", "frame_jacobian"), "jacobian"),
    **dict.fromkeys(("oMf", "oMi", "fk", "forward_kinematics", "frame_placement", "xpos"), "pose"),
    **dict.fromkeys(("com", "centerOfMass", "subtree_com"), "center_of_mass"),
    **dict.fromkeys(("Ag", "ccrba", "A_G"), "centroidal_momentum_matrix"),
    "computeJointTorqueRegressor": "regressor",
    "computeRNEADerivatives": "inverse_dynamics_derivatives",
    "computeABADerivatives": "forward_dynamics_derivatives",
}


class ReadOnly:
    """An object whose methods and public attributes are read-only."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_") and (name == "model" or callable(getattr(type(self), name, None))):
            raise InputError(
                f"{name}: a {type(self).__name__} is read-only; describe another model, as by model.without(...), and "
                "ask for its dynamics"
            )
        object.__setattr__(self, name, value)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # Only for names that are not there.
            known = [] if name.startswith("_") else [x for x in dir(type(self)) if not x.startswith("_")]
            near = [ELSEWHERE[name]] if ELSEWHERE.get(name) in known else nearest(name, known)
            advice = f"; did you mean {' or '.join(near)}?" if near else ""
            raise AttributeError(
                f"{type(self).__name__!r} object has no attribute {name!r}{advice}", name=name, obj=self
            )


def forwarded(path: str, doc: str) -> Any:
    """Return a read-only attribute that is one of the object's parts', such as ``"equations.model"``."""
    return property(attrgetter(path), doc=doc)


def single_values(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return values of parameters, one each."""
    for name, value in values.items():
        if np.ndim(value):
            raise InputError(
                f"parameter {name!r}: expected a number, got shape {np.shape(value)}; the lagrangian engine takes one "
                "value for each sample of a batch"
            )
    return values
