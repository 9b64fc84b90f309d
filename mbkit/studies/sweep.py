"""What a sweep runs: which method on which engine, and with which steps or tolerances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from mbkit.simulate.methods import METHODS, Method

__all__ = ["INTERVALS", "Plan", "plans", "save_grid"]

#: Errors are measured at the ends of this many equal parts of the horizon.
INTERVALS: Final = 10
#: The coarsest step, s, and the finest, as a part of the horizon.
_COARSEST: Final = 0.05
_FINEST: Final = 1e-7
#: Ratio of neighbouring steps, by the method's order: an error falls by 4 to 16 at each.
_RATIOS: Final[dict[int | None, float]] = {1: 4.0, 2: 2.5, 4: 2.0, 6: 1.5}
#: Methods that call the dynamics from Python on every engine, and what such a call costs beside a compiled one.
_FROM_PYTHON: Final = frozenset({"dop853", "radau", "bdf", "lsoda", "gauss4", "gauss6"})
_CALL: Final = 8


@dataclass(frozen=True)
class Plan:
    """The settings of one method on one engine, coarse to fine.

    Attributes
    ----------
    engine, method : str
    setting : {"dt", "rtol"}
    values : tuple of float
        Steps, s, or tolerances.
    asked : bool
        Whether somebody asked for these values, so that each has to be accounted for;
        else the sweep ends where finer ones bring nothing or take too much work.
    """

    engine: str
    method: str
    setting: Literal["dt", "rtol"]
    values: tuple[float, ...]
    asked: bool

    @property
    def kind(self) -> Method:
        """The method as data."""
        return METHODS[self.method]

    def work(self, steps: int, evaluations: int) -> int:
        """Return what a run costs, in compiled evaluations of the forward dynamics; the same on every machine."""
        compiled = self.kind.kind == "native" or self.method.startswith("drake_") or self.engine == "lagrangian"
        each = 1 if compiled and self.method not in _FROM_PYTHON else _CALL
        return each * (evaluations or steps * max(self.kind.stages, 1))


def save_grid(duration: float) -> np.ndarray:
    """Return the times at which errors are measured, shape (11,)."""
    return np.linspace(0.0, duration, INTERVALS + 1)


def plans(
    pairs: Mapping[str, Sequence[str]],
    interval: float,
    steps: Sequence[float] | None,
    tolerances: Sequence[float] | None,
) -> tuple[Plan, ...]:
    """Return a plan for every engine's methods.

    Parameters
    ----------
    pairs : mapping of str to sequence of str
        Engine -> methods.
    interval : float
        Time between two saved states, s, on which steps must end.
    steps, tolerances : sequences of float, optional
        Asked for. A step is shortened so that a whole number of them is an interval; a
        tolerance below a method's least is left out.
    """
    out = []
    for engine, names in pairs.items():
        for name in names:
            method = METHODS[name]
            if method.kind == "adaptive":
                given, asked = (tolerances, True) if tolerances is not None else (_tolerances(method), False)
                values = tuple(sorted({float(x) for x in given if x >= method.least}, reverse=True))
                out.append(Plan(engine, name, "rtol", values, asked))
            else:
                given, asked = (steps, True) if steps is not None else (_steps(method, interval), False)
                counts = sorted({max(1, int(np.ceil(interval / h * (1 - 1e-9)))) for h in given})
                out.append(Plan(engine, name, "dt", tuple(interval / n for n in counts), asked))
    return tuple(out)


def _tolerances(method: Method) -> tuple[float, ...]:
    # A Taylor series is compiled anew for each order that a tolerance asks for.
    decades = range(3, 16, 4 if method.name == "taylor" else 1)
    return tuple(x for x in (float(f"1e-{k}") for k in decades) if x >= method.least)


def _steps(method: Method, interval: float) -> tuple[float, ...]:
    ratio = _RATIOS.get(method.order, 2.0)
    coarsest = min(interval, _COARSEST)
    count = int(np.log(coarsest / (interval * INTERVALS * _FINEST)) / np.log(ratio)) + 1
    return tuple(coarsest / ratio**k for k in range(count))
