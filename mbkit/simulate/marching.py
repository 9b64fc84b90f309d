"""Many steps of many states at once, by a compiled step on coordinate-major arrays."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.derivation.compiled import Compiled, aligned
from mbkit.derivation.sequence import Call, CallSequence
from mbkit.derivation.step import Part, march, march_in_stages
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.simulate.methods import METHODS

__all__ = ["BLOCK", "Chunk", "Plan"]

#: Steps that are made without a look at them, at most.
BLOCK: Final = 16

# Above this many operations the forward dynamics is compiled once and called for each
# stage: LLVM's time grows faster than the step, which then runs no faster than its parts.
_ONE_PIECE: Final = 20_000
# Half of what a core has in its second cache.
_CACHE: Final = 2**19
_LANES: Final = 8
_MOST: Final = 1032
# What a step writes -> what the next one reads.
_STATE: Final = {"q1": "q", "w1": "w", "squares1": "squares"}


class Plan:
    """A method's step for one model, in machine code.

    Parameters
    ----------
    dyn : LagrangianDynamics
    method : {"rk4", "semi_implicit_euler"}

    Attributes
    ----------
    parts : tuple of Part
        What is run for a step, in this order.
    codes : tuple of Compiled
        The parts' machine code.
    sizes : dict of str to int
        Rows of each array that the parts read or write.
    """

    def __init__(self, dyn: LagrangianDynamics, method: str) -> None:
        def code(part: Part) -> Compiled:
            made: Compiled = dyn.code(part.name, make=part.make)
            return made

        self.parts = march_in_stages(dyn.equations, method)
        forward = next(part for part in self.parts if part.name == "forward_dynamics")
        if METHODS[method].stages * code(forward).operations <= _ONE_PIECE:
            self.parts = march(dyn.equations, method)
        self.codes = tuple(code(part) for part in self.parts)
        self.sizes: dict[str, int] = {}
        for part, made in zip(self.parts, self.codes, strict=True):
            self.sizes.update(zip(part.reads, made.inputs, strict=True))
            self.sizes.update(zip(part.writes, (rows for rows, _ in made.shapes), strict=True))

    @property
    def widest(self) -> int:
        """States that the cache holds with all that belongs to them, from 72 to 1032."""
        return min(max(_padded(_CACHE // (8 * sum(self.sizes.values()))), 9 * _LANES), _MOST)


def _padded(count: int) -> int:
    # An odd number of cache lines, so that no two rows fall on the same ones of a
    # cache that is split by powers of two: 20 % of the time at 1024 states.
    return -(-count // _LANES) * _LANES | _LANES


class Chunk:
    """Room for states side by side, one in each column, on their way through a run.

    Columns beyond the states repeat the last one.

    Parameters
    ----------
    plan : Plan
    most : int
        States that it has room for.
    torques : bool
        Whether each step of a block has a torque of its own.
    all_kept : bool
        Whether all states of a block can be read after it, or the last one alone.
    """

    def __init__(self, plan: Plan, most: int, *, torques: bool, all_kept: bool) -> None:
        width = _padded(most)
        self._places = BLOCK + 1 if all_kept else 2
        self._torques = BLOCK if torques else 1
        rooms = {**dict.fromkeys(_STATE.values(), self._places), "tau": self._torques}
        read = {name: size for name, size in plan.sizes.items() if name not in _STATE}
        self._held = {name: _room(rooms.get(name, 1), size, width) for name, size in read.items()}
        self._calls = len(plan.parts)
        period = BLOCK if all_kept or torques else 2
        steps = [call for j in range(period) for call in self._step(plan, j)]
        self._sequence = CallSequence(steps, BLOCK // period)
        self._count = self._taken = 0

    def begin(self, q: Array, w: Array, parameters: Array) -> None:
        """Put states in.

        Parameters
        ----------
        q, w : (n, nq) and (n, nv) arrays
            In the integrators' own velocity.
        parameters : (p,) or (n, p) array
            Values of the model's named parameters.
        """
        self._count = len(q)
        self._fill("q", 0, q.T)
        self._fill("w", 0, w.T)
        self._held["squares"][0] = 0.0
        if parameters.size:
            self._fill("parameters", 0, np.atleast_2d(parameters).T)

    def _step(self, plan: Plan, j: int) -> list[Call]:
        def array(name: str) -> Array:
            held = self._held[_STATE.get(name, name)]
            return np.asarray(held[(j + (name in _STATE)) % len(held)].T)

        return [
            Call(code, [array(n) for n in part.reads], [array(n) for n in part.writes])
            for part, code in zip(plan.parts, plan.codes, strict=True)
        ]

    def _fill(self, name: str, place: int, columns: Array) -> None:
        held = self._held[name][place]
        held[:, : self._count] = columns
        held[:, self._count :] = held[:, self._count - 1 : self._count]

    def advance(self, steps: int, dt: float, torques: Array) -> None:
        """Take some steps, at most `BLOCK`, from where the last ones ended.

        Parameters
        ----------
        steps : int
        dt : float
        torques : (steps or 1, nv, n or 1) array
        """
        self._held["dt"][:] = dt
        for j in range(min(steps, self._torques)):
            self._fill("tau", j, torques[j])
        self._sequence.run(0, steps * self._calls)
        self._taken = steps

    def again(self) -> None:
        """Make the last state the first one of the next block."""
        for name in _STATE.values():
            held = self._held[name]
            held[0] = held[self._taken % len(held)]

    def states(self, name: str) -> Array:
        """Return q, w or squares after each step of the block, or after its last one: (steps or 1, rows, n)."""
        held = self._held[name]
        first = self._taken % len(held)
        places = held[1 : self._taken + 1] if self._places > 2 else held[first : first + 1]
        return places[:, :, : self._count]

    def start(self, name: str) -> Array:
        """Return q, w or squares before the block, (rows, n)."""
        return self._held[name][0, :, : self._count]


def _room(places: int, rows: int, width: int) -> Array:
    out = aligned(places * rows * width).reshape(places, rows, width)
    out[:] = 0.0
    return out
