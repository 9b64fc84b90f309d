"""All checks of a finished run, also those that integrate again."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit._escape import html
from mbkit.engines import Dynamics
from mbkit.errors import MbkitWarning
from mbkit.methods.registry import AUTOMATIC_METHOD, METHODS, Method
from mbkit.simulate.diagnostics.checks import CHECKED_TIMES, diagnostics
from mbkit.simulate.integrate import integrate
from mbkit.simulate.run_data import RunData, RunSettings

#: Numbers of steps for which a method of first order is compared with itself at twice the step.
_STEPS: Final = (4, 20_000)
#: Part of the motion: a hundredth is wrong, and at a few times the gap is not yet the largest.
_OFF: Final = 0.008
#: Velocities at twice the step beyond this many times those of the run: unstable there, which says nothing of the run.
_UNSTABLE: Final = 3.0


@dataclass(frozen=True)
class RunCheck:
    """Signs that a run is wrong; true where there are none.

    Attributes
    ----------
    title : str
        Model and method.
    doubts : tuple of str
        Each with its measured reason and a remedy.
    """

    title: str
    doubts: tuple[str, ...]

    def __bool__(self) -> bool:
        return not self.doubts

    @property
    def passed(self) -> bool:
        """Whether no sign was found."""
        return bool(self)

    def __str__(self) -> str:
        return f"{self.title}: {'; '.join(self.doubts) or 'no sign of an error'}"

    def _repr_html_(self) -> str:
        items = "".join(f"<li>{html(one)}</li>" for one in self.doubts or ("no sign of an error",))
        return f"<p><b>{html(self.title)}</b></p><ul>{items}</ul>"


def check_run(run: RunData, dyn: Dynamics, settings: RunSettings | None, *, driven: bool) -> RunCheck:
    """Return the doubts about a run; see `mbkit.simulate.Trajectory.check`."""
    title, stats = f"{run.model.name}: {run.method}", run.stats
    if not stats.finished:
        return RunCheck(title, (stats.message,))
    if settings is None:
        return RunCheck(title, stats.doubts)
    method, states = METHODS[run.method], settings.with_start(run.t, run.q, run.v)
    found = diagnostics(dyn, method, settings.setting, states, driven=driven, steps=stats.steps)
    if not driven:
        found += step_doubling(dyn, method, settings, states)
    return RunCheck(title, (*settings.doubts, *found))


def step_doubling(
    dyn: Dynamics, method: Method, settings: RunSettings, states: tuple[Array, Array, Array]
) -> Iterator[str]:
    """Compare a run by a method of first order with one at twice the step: the gap is about the error."""
    h, model = settings.setting, dyn.model
    if method.order != 1 or not isinstance(h, float) or model.time_parameter or not states[2].size:
        return
    t, q, v = states[0] - settings.t0, *(x.reshape(-1, *x.shape[-2:])[0] for x in states[1:])
    # Twice the step would change the length of the last one.
    if not _STEPS[0] <= round(t[-1] / h) <= _STEPS[1] or not np.isfinite(q).all():
        return
    both = np.flatnonzero(np.abs(t / (2 * h) - np.rint(t / (2 * h))) < 1e-6)[1:]
    motion = float(np.abs(model.difference(np.broadcast_to(q[0], q.shape), q)).max(initial=0.0))
    if not len(both) or not motion:
        return
    both = both[np.unique(np.linspace(0, len(both) - 1, CHECKED_TIMES).astype(int))]
    times = states[0][both]
    one = (dyn, q[0], v[0]) if dyn.samples is None else (dyn.of_samples([0]), q[:1], v[:1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        coarse, _ = integrate(*one, float(times[-1] - settings.t0), method.name, 2 * h, save=times, t0=settings.t0)
    if not coarse.stats.finished or np.abs(coarse.v).max() > _UNSTABLE * np.abs(v).max():
        return
    off = float(np.abs(model.difference(q[both], coarse.q.reshape(len(both), -1))).max()) / motion
    if off > _OFF:
        yield (
            f"by a run with a step of {2 * h:g} s it is off by {off:.2g} of the motion, since {method.name} is of "
            f"first order; take a smaller step, or method={AUTOMATIC_METHOD!r}"
        )
