"""The settings of a sweep: which method on which engine, and with which steps or tolerances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from mbkit.engines.registry import find_engine
from mbkit.errors import InputError
from mbkit.methods.registry import METHODS, Method, method_of
from mbkit.studies._targets import engine_names, names_of

#: Errors are measured at the ends of this many equal parts of the horizon.
INTERVALS: Final = 10
#: The coarsest step, s, and the finest, as a part of the horizon.
_COARSEST: Final = 0.05
_FINEST: Final = 1e-7
#: Ratio of neighbouring steps, by the method's order: an error falls by 4 to 16 at each.
_RATIOS: Final[dict[int | None, float]] = {1: 4.0, 2: 2.5, 4: 2.0, 6: 1.5}
#: An evaluation called from Python costs so many compiled ones.
_PYTHON_CALL: Final = 8


@dataclass(frozen=True)
class Settings:
    """The steps, s, or tolerances of one method on one engine, coarse to fine."""

    engine: str
    method: str
    setting: Literal["dt", "rtol"]
    values: tuple[float, ...]
    #: Whether the caller chose the values, so that each is reported. Otherwise the sweep ends where finer values
    #: improve nothing or take too much work.
    required: bool

    @property
    def info(self) -> Method:
        """The method as data."""
        return method_of(self.method)

    def work(self, steps: int, evaluations: int) -> int:
        """Return the cost of a run in compiled evaluations of the forward dynamics, equal on every machine."""
        each = 1 if self.info.runs_compiled(derived=find_engine(self.engine).derived) else _PYTHON_CALL
        return each * (evaluations or steps * max(self.info.stages, 1))


def save_grid(duration: float) -> np.ndarray:
    """Return the times at which errors are measured, shape (11,)."""
    return np.linspace(0.0, duration, INTERVALS + 1)


def plans(
    pairs: Mapping[str, Sequence[str]],
    interval: float,
    steps: Sequence[float] | None,
    tolerances: Sequence[float] | None,
) -> tuple[Settings, ...]:
    """Return the settings for every engine's methods.

    A step of the caller is shortened so that a whole number of them is an interval between two saved states; a
    tolerance below a method's least is left out.
    """
    out = []
    for engine, names in pairs.items():
        for name in names:
            method = METHODS[name]
            if method.kind == "adaptive":
                wanted = _tolerances(method) if tolerances is None else tolerances
                values = tuple(sorted({float(x) for x in wanted if x >= method.least}, reverse=True))
                out.append(Settings(engine, name, "rtol", values, tolerances is not None))
            else:
                wanted = _steps(method, interval) if steps is None else steps
                counts = sorted({max(1, int(np.ceil(interval / h * (1 - 1e-9)))) for h in wanted})
                out.append(Settings(engine, name, "dt", tuple(interval / n for n in counts), steps is not None))
    return tuple(out)


def _tolerances(method: Method) -> tuple[float, ...]:
    # A Taylor series is compiled for each order that a tolerance needs.
    return tuple(float(f"1e-{k}") for k in range(3, 16, 4 if method.extended else 1))


def _steps(method: Method, interval: float) -> tuple[float, ...]:
    ratio = _RATIOS.get(method.order, 2.0)
    coarsest = min(interval, _COARSEST)
    count = int(np.log(coarsest / (interval * INTERVALS * _FINEST)) / np.log(ratio)) + 1
    return tuple(coarsest / ratio**k for k in range(count))


def pairs(
    engines: Sequence[str], methods: Sequence[str] | Mapping[str, Sequence[str]] | None
) -> dict[str, tuple[str, ...]]:
    """Return the methods of each engine, checked: all, those named for all engines that have them, or for each."""
    names = engine_names(engines)
    if isinstance(methods, Mapping):
        for engine in methods:
            if engine not in names:
                raise InputError(f"methods: {engine!r} is not among the engines {list(names)}")
        wanted = {engine: names_of(f"methods[{engine!r}]", methods[engine]) for engine in names if engine in methods}
        if not wanted:
            raise InputError("methods: expected the methods of at least one engine, got none")
        for engine, own in wanted.items():
            for method in map(method_of, own):
                if method.engines and engine not in method.engines:
                    raise InputError(
                        f"methods[{engine!r}]: {method.name} is not on {engine}; it is on {', '.join(method.engines)}"
                    )
    else:
        wanted = dict.fromkeys(names, tuple(METHODS) if methods is None else names_of("methods", methods))
    out = {e: tuple(m for m in ms if not method_of(m).engines or e in METHODS[m].engines) for e, ms in wanted.items()}
    available = {name for ms in out.values() for name in ms}
    for name in dict.fromkeys(m for ms in wanted.values() for m in ms):
        if methods is not None and name not in available:
            raise InputError(
                f"methods: {name} is not on {' or '.join(wanted)}; it is on {', '.join(METHODS[name].engines)}"
            )
    return out
