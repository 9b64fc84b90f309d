"""What the precision of an engine's numbers costs each term: the tolerance for an engine that is not double.

A term can be no better than the numbers that it is made of. So its tolerance is a few times what happens to it when the
description and the state are rounded to the engine's precision, evaluated in double precision: eps times the term's own
condition (Higham 2002, Accuracy and Stability of Numerical Algorithms, ch. 1.6), measured. Lengths are rounded by the
distance from the world's origin, since engines hold places in the world, and rotations by eps.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.registry import DERIVED, find_engine
from mbkit.errors import MbkitError
from mbkit.model import Model
from mbkit.studies.compare.errors import Scales, epsilon
from mbkit.studies.compare.terms import States, Term, power_errors

_SEEDS: Final = (0, 1)
#: An engine rounds on the way too: its error was at most 5.4 times that of the rounded numbers, over the terms of 66
#: robots in Newton (validation/trained_engines.json).
_ERROR_PER_ROUNDING: Final = 8.0


class Precision:
    """Tolerances of terms in a precision lower than double.

    Parameters
    ----------
    model : Model
    at : States
    bits : int
        Of the significand.
    scales : Scales
    oracle : OracleDynamics
    """

    def __init__(self, model: Model, at: States, bits: int, scales: Scales, oracle: OracleDynamics) -> None:
        self._model, self._at, self._scales, self._oracle = model, at, scales, oracle
        self.bits, self._eps = bits, epsilon(bits)

    def allowed(self, term: Term | str) -> float:
        """Return the largest error that passes: of a term, or of the power balance by its name."""
        own = [self._error(term, *rounded) for rounded in self._rounded]
        return _ERROR_PER_ROUNDING * max(self._eps, *own)

    def _error(self, term: Term | str, dyn: Dynamics, at: States) -> float:
        try:
            if isinstance(term, str):
                errors = power_errors(dyn, self._oracle, self._at, self._scales)
            else:
                exact = term.call(self._exact, self._at)
                errors = term.errors(term.call(dyn, at) - exact, exact, self._scales)
        except MbkitError:
            # A term that has no value here has no condition either.
            return 0.0
        return float(errors.relative.max())

    @cached_property
    def _exact(self) -> Dynamics:
        return _derived(self._model)

    @cached_property
    def _rounded(self) -> list[tuple[Dynamics, States]]:
        """Return the description and the states with other last digits, several times."""
        model, at, eps = self._model, self._at, self._eps
        places = self._exact.body_poses(at.q)[..., :3, 3] if model.has_bodies else np.zeros((1, 3))
        reach = float(np.abs(places).max(initial=0.0))
        out = []
        for seed in _SEEDS:
            rng = np.random.default_rng(seed)

            def noise(shape: tuple[int, ...], rng: np.random.Generator = rng) -> Array:
                return eps * rng.uniform(-1.0, 1.0, shape)

            v, a, tau = (np.asarray(x) * (1.0 + noise(np.shape(x))) for x in (at.v, at.a, at.tau))
            q = model.integrate(at.q, noise(at.v.shape))
            states = States(q, v, a, tau, at.kinds)
            bodies = tuple(
                replace(
                    b,
                    mass=b.mass * (1.0 + float(noise(()))),
                    com=b.com + reach * noise((3,)),
                    inertia=b.inertia * (1.0 + float(noise(()))),
                )
                for b in model.bodies
            )
            joints = tuple(
                replace(
                    j,
                    translation=j.translation + reach * noise((3,)),
                    rotation=j.rotation @ spatial.matrix_from_quaternion(spatial.exp_quaternion(noise((3,)))),
                )
                for j in model.joints
            )
            out.append((_derived(replace(model, bodies=bodies, joints=joints)), states))
        return out


def _derived(model: Model) -> Dynamics:
    return dynamics(model, DERIVED, **find_engine(DERIVED).brief)
