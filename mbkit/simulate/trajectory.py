"""`Trajectory`: the result of a simulation."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import _check
from mbkit._escape import csv_text, html, one_line
from mbkit.errors import InputError, OutputError
from mbkit.simulate.along_trajectory import dynamics_of_trajectory
from mbkit.simulate.events import Hit
from mbkit.simulate.run_check import RunCheck, check_run
from mbkit.simulate.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Times of an event that `repr` shows.
_SHOWN: Final = 4


class Trajectory(RunData):
    """States over time of one run or of a batch; arrays are read-only.

    Attributes
    ----------
    t : (K,) array
        s.
    q : (K, nq) or (N, K, nq) array
    v : (K, nv) or (N, K, nv) array
        A run that ended early has fewer times; a trajectory that ended before
        the others of its batch is NaN from there on.
    model : Model
    method, engine : str
    stats : Stats
        What it cost, and how it ended.
    events : tuple of Hit
        Those that happened.

    Notes
    -----
    Derived quantities are computed on request, by the run's own engine or by the one that is given.
    """

    def check(self) -> RunCheck:
        """Look for signs that the run is wrong, also by integrating again.

        Beside what `simulate` looks for at once (energy from nowhere, a singular mass matrix, coordinates
        without digits, gimbal lock, tolerances that add up): a step too long for a mode of the linearized
        motion, and of a method of first order without torque, up to 20,000 steps, the difference from a
        run with twice the step. That takes up to half as long as the run, and a few ms.

        Returns
        -------
        RunCheck
            True where nothing was found; ``check.doubts`` are the signs, each with its measured reason and a remedy.
        """
        return check_run(self, self._own(), self._settings, driven=self._applied is not None)

    # Pictures and files

    def plot(self) -> Figure:
        """Draw coordinates, velocities, energies and the power balance over time with Matplotlib.

        Lengths, angles and quaternions have a panel each. Of a batch, the first ten
        trajectories are drawn. Events and the end of a run that diverged are marked.
        """
        from mbkit.simulate.plotting.time_series import plot

        return plot(self)

    def picture(self, count: int = 8, view: str | ArrayLike | None = None, member: int = 0) -> Figure:
        """Draw the motion as a strip of stick figures at equal times, with Matplotlib.

        Links run from joint to joint, at the ends to the centre of mass or the last
        frame; the path of one point is drawn along: the end of the longest branch,
        or the base of a floating robot.

        Parameters
        ----------
        count : int
            How many figures.
        view : str or (2, 3) array_like, optional
            The plane: two world axes to the right and upwards, such as ``"xz"``, or two
            directions. By default upwards is against gravity, and to the right is where
            the motion is widest.
        member : int
            Which trajectory of a batch.
        """
        from mbkit.simulate.plotting.motion_strip import picture

        member = _check.count("member", member)
        members = len(self.q) if self.q.ndim == 3 else 1
        if member >= members:
            raise InputError(f"member: expected less than {members}, the number of trajectories, got {member}")
        # The description is enough: no engine is made.
        model = self.model if self._dyn is None else dynamics_of_trajectory(self._dyn, member).model
        return picture(self, model, count, view, member)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write t, q and v with all their digits, one line per state.

        A batch has a first column with the index of its trajectory.

        Raises
        ------
        OutputError
            The file cannot be written.
        """
        batch = self.q.ndim == 3
        header = [*(["trajectory"] if batch else []), "t"]
        header += [f"q.{n}" for n in self.model.coordinate_names] + [f"v.{n}" for n in self.model.velocity_names]
        try:
            with Path(path).open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                writer.writerow(map(csv_text, header))
                for i, (q, v) in enumerate(zip(self.q, self.v, strict=True) if batch else [(self.q, self.v)]):
                    lead = [i] if batch else []
                    rows = np.column_stack([self.t, q, v]).tolist()
                    writer.writerows([*lead, *row] for row in rows)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror or error}; choose a folder that exists") from error

    def _facts(self) -> list[tuple[str, str]]:
        count = f"{len(self.q)} trajectories of " if self.q.ndim == 3 else ""
        span = f", {self.t[0]:g} to {self.t[-1]:g} s" if len(self.t) else ""
        return [
            ("model", self.model.name),
            ("engine", self.engine),
            ("method", self.method),
            ("states", f"{count}{len(self.t)}{span}"),
            ("run", str(self.stats)),
            *([("events", _event_times(self.events))] if self.events else []),
        ]

    def __repr__(self) -> str:
        return f"<Trajectory {'; '.join(f'{k}: {one_line(x)}' for k, x in self._facts())}>"

    def _repr_html_(self) -> str:
        cells = "".join(f"<tr><th>{k}</th><td>{html(x)}</td></tr>" for k, x in self._facts())
        return f"<table>{cells}</table>"


def _event_times(events: tuple[Hit, ...]) -> str:
    """Return the events' names and times, the first few of each name."""
    times: dict[str, list[float]] = {}
    for hit in events:
        times.setdefault(hit.name, []).append(hit.t)
    return "; ".join(
        f"{name} at {', '.join(f'{t:.6g}' for t in found[:_SHOWN])}"
        + (" s" if len(found) <= _SHOWN else f" s ({len(found)})")
        for name, found in times.items()
    )
