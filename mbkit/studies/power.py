"""Power balance: dE/dt = (τ + τ_damping) · v, with each engine's own acceleration.

The rate of energy is differentiated exactly from T and V by the oracle;
acceleration and damping are the engine's. So it fails if either the engine's
dynamics or the energies are wrong, whatever two engines agree on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from mbkit.engines import Dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import MbkitError
from mbkit.studies.measure import Errors, Scales
from mbkit.studies.states import States

__all__ = ["power_rows"]


def power_rows(
    made: Mapping[str, Dynamics],
    oracle: OracleDynamics,
    at: States,
    scales: Scales,
    refuse: Callable[[str, MbkitError], None],
) -> Iterator[tuple[str, Errors]]:
    """Yield (engine, errors) for every engine; what cannot be had is told to `refuse`."""
    for name, dyn in made.items():
        try:
            a = dyn.forward_dynamics(at.q, at.v, at.tau)
            damping = dyn.passive(at.q, at.v) - dyn.passive(at.q, np.zeros_like(at.v))
            inertial, rate = oracle.inverse_dynamics(at.q, at.v, a), oracle.energy_rate(at.q, at.v, a)
        except MbkitError as error:
            refuse(name, error)
            continue
        e = np.abs(rate - np.sum((at.tau + damping) * at.v, axis=1))
        # M a is as large as M's norm lets it be, and that is where it is rounded.
        root = np.sqrt(scales.diagonal)
        speed, size = np.linalg.norm(root * at.v, axis=1), np.linalg.norm(root * a, axis=1)
        pushes = np.linalg.norm(inertial, axis=1) + np.linalg.norm(at.tau, axis=1) + np.linalg.norm(damping, axis=1)
        scale = speed * size + np.linalg.norm(at.v, axis=1) * pushes + scales.inertial
        relative = np.where(e == 0, 0.0, e / np.where(scale == 0, np.finfo(float).tiny, scale))
        yield name, Errors(e, relative, np.empty(0))
