"""What tries the steps of an embedded pair, whichever way they are computed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from mbkit._check import Array
from mbkit.methods.registry import Tolerances
from mbkit.model.integration_space import Space

__all__ = ["ROUNDS", "AcceptedSteps", "StepAttempts", "first_length"]

#: Tries between two looks at them, at most.
ROUNDS: Final = 256


@dataclass(frozen=True, eq=False)
class AcceptedSteps:
    """Accepted steps of one trajectory in a row, the state before the first in front.

    Attributes
    ----------
    t : (n + 1,) array
    q, w : (n + 1, nq) and (n + 1, nv) arrays
        In the integrators' own velocity.
    tried : int
        Steps that were tried on the way.
    """

    t: Array
    q: Array
    w: Array
    tried: int


class StepAttempts(Protocol):
    """Steps of a few trajectories side by side, each with times and lengths of its own.

    Attributes
    ----------
    width : int
        How many trajectories at once.
    rounds : int
        Tries between two looks at them, at most; 1 where nothing is gained by more.
    """

    width: int
    rounds: int

    @property
    def evaluations(self) -> int:
        """Of the forward dynamics so far."""

    @property
    def jacobians(self) -> int:
        """Of the forward dynamics so far."""

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        """Begin with these members of the batch, (n, nq) and (n, nv), and a first step that is given or looked for."""

    def hold(self, k: int, stop: float) -> None:
        """Go on to a time, under the force of interval k."""

    def advance(self) -> list[tuple[int, AcceptedSteps]]:
        """Take some steps; return, of each trajectory that had a way to go, its place and steps."""

    def drop(self, place: int) -> None:
        """Leave a trajectory where it is."""

    def stuck(self, place: int) -> bool | None:
        """Return whether no step at all could be made for a trajectory.

        True if the tries were no numbers, False if they were inaccurate however short;
        None where all is well.
        """

    def why(self, place: int) -> str:
        """Return why a try was no number."""

    def tighten(self, place: int, tolerances: Tolerances) -> None:
        """Go on with other tolerances."""

    def rates(self, place: int, q: Array, w: Array) -> Array:
        """Return ẇ at states, (n, nq) and (n, nv), of a trajectory's parameters under the force that acts now."""

    def within(self, place: int, start: AcceptedSteps, times: Array) -> tuple[Array, Array]:
        """Return (q, w) at times, (m, nq) and (m, nv), each by one step from the state of the same row."""


def first_length(
    space: Space,
    q: Array,
    w: Array,
    k: Array,
    tolerances: Tolerances,
    probe: Callable[[Array, Array], Array],
    grows: int = 8,
) -> Array:
    """Return how long a first step may be, one for each state: (n,).

    Hairer, Nørsett, Wanner 1993, II.4, as SciPy does it.

    Parameters
    ----------
    space : Space
    q, w, k : (n, nq), (n, nv), (n, nv) arrays
        States and ẇ there.
    tolerances : Tolerances
    probe : callable
        probe(q, w) -> ẇ at other states.
    grows : int
        The power of a step's length with which its estimated error grows.
    """
    sizes = np.concatenate([space.sizes(q, w), np.abs(w)], axis=-1)
    scale = tolerances.atol + tolerances.rtol * sizes

    def norm(x: Array) -> Array:
        return np.asarray(np.sqrt(np.sum((x / scale) ** 2, axis=-1) / max(x.shape[-1], 1)))

    d0, d1 = norm(sizes), norm(np.concatenate([w, k], axis=-1))
    h0 = np.where((d0 < 1e-5) | (d1 < 1e-5), 1e-6, 0.01 * d0 / d1)
    by = h0[:, None]
    bent = probe(space.move(q, by * w), w + by * k)
    d2 = norm(np.concatenate([by * k, bent - k], axis=-1)) / h0
    steep = np.maximum(d1, d2)
    h1 = np.where(steep <= 1e-15, np.maximum(1e-6, h0 * 1e-3), (0.01 / steep) ** (1 / grows))
    return np.asarray(np.minimum(100 * h0, h1))
