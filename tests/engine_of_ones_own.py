"""An engine of one's own: Pinocchio, with the mass matrix of a planar pendulum in closed form."""

from __future__ import annotations

import numpy as np

from mbkit.engines import EngineInfo
from mbkit.engines.pinocchio.engine import PinocchioDynamics
from mbkit.errors import UnsupportedError


class ClosedForm(PinocchioDynamics):
    engine = "closed_form"

    def __init__(self, model):
        super().__init__(model)
        if model.nv != 1 or len(model.bodies) != 1:
            raise UnsupportedError(f"closed_form: {model.name} is no pendulum; use mbkit.dynamics(model, 'pinocchio')")
        body, joint = model.bodies[0], model.joints[0]
        axis = joint.axes[0]
        arm = np.cross(axis, body.com)
        self._inertia = float(axis @ body.inertia @ axis + body.mass * arm @ arm)

    def _mass_matrix(self, q):
        return np.full((*q.shape[:-1], 1, 1), self._inertia)


INFO = EngineInfo("closed_form", ClosedForm, package="closed-form", shown=("rk4",), quick=("rk4",))
