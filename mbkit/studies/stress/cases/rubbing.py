"""Cases with dry friction: far above the other forces, at hardly any speed, and at many joints at rest."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from mbkit._check import EPS, Array
from mbkit.model import ModelBuilder
from mbkit.studies.measurement import Problem
from mbkit.studies.stress.cases._common import case, motion, powers

_rubbed = partial(case, "friction")
_ALONG: Final = (1.0, 0.0, 0.0)
#: The pull of gravity on a block of 1 kg along its slope, N.
_PULL: Final = 4.0


def _thrown(friction: float, speed: float) -> Problem:
    """Return a block that is thrown up a slope and rests where it stops, for twice that time."""
    b = ModelBuilder("block", gravity=(-_PULL, 0.0, -9.0))
    b.add_body("block", mass=1.0)
    b.add_joint("x", "prismatic", parent="world", child="block", axis=_ALONG, friction=friction)
    slowed = _PULL + friction
    stops = speed / slowed
    way = speed * stops / 2

    def exact(t: Array) -> Array:
        s = np.minimum(t, stops)
        return (s * (speed - slowed * s / 2))[:, None]

    source = "Coulomb's law: uniformly slowed, and at rest"
    facts = {"friction over the other forces": friction / _PULL, "fastest change, 1/s": 1 / stops}
    return motion(b.build(), [0.0], speed, 2 * stops, exact, 4 * EPS * way, source, facts=facts, scale=way)


@_rubbed("friction over pull", "", (1.1, 11.0, 110.0, 1100.0), (1.1, 110.0, 1100.0))
def strong_friction(ratio: float) -> Problem:
    """A block is thrown up a slope, where friction above gravity's pull lets it rest."""
    return _thrown(ratio * _PULL, 1.0)


@_rubbed("speed", "m/s", powers(0, -9), (1.0, 1e-3, 1e-6, 1e-9))
def slow_slip(speed: float) -> Problem:
    """A block comes up a slope at hardly any speed and rests."""
    return _thrown(2 * _PULL, speed)


@_rubbed("joints at rest", "", (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), (1.0, 4.0, 16.0))
def many_at_rest(count: float) -> Problem:
    """A stack of blocks swings on a spring; friction just holds each block on the one below."""
    n, frequency, reach = int(count), 3.0, 0.5
    b = ModelBuilder("stack", gravity=np.zeros(3))
    for i in range(n + 1):
        b.add_body(f"block{i}", mass=1.0)
        # Friction is a hundredth above the force that accelerates the blocks above a joint.
        holds: dict[str, Any] = {"friction": 1.01 * (n + 1 - i) * reach * frequency**2}
        holds = holds if i else {"stiffness": (n + 1) * frequency**2}
        b.add_joint(
            f"x{i}", "prismatic", parent=f"block{i - 1}" if i else "world", child=f"block{i}", axis=_ALONG, **holds
        )
    q = np.zeros(n + 1)
    q[0] = reach

    def exact(t: Array) -> Array:
        return np.cos(frequency * t)[:, None] * q

    source, facts = "a spring and the mass of all blocks", {"joints with friction": count}
    return motion(b.build(), q, 0.0, 4.0, exact, 4 * EPS, source, facts=facts)
