"""`Trajectory`, the result of a simulation, and all checks of it, also those that integrate again."""

from __future__ import annotations

import csv
import io
import json
import os
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import _check
from mbkit._check import Array, by_key
from mbkit._escape import csv_text, html, one_line
from mbkit.engines import Dynamics
from mbkit.engines.base import MAX_NAMES
from mbkit.errors import InputError, LoadError, MbkitWarning, UnsupportedError, writing
from mbkit.methods.registry import AUTOMATIC_METHOD, METHODS, Method
from mbkit.model import Model
from mbkit.simulate.checks import CHECKED_TIMES, diagnostics
from mbkit.simulate.events import Hit
from mbkit.simulate.integrate import integrate
from mbkit.simulate.problem import RunRequest
from mbkit.simulate.run_data import RunData, RunSettings, Saturation, Stats, dynamics_of_trajectory
from mbkit.simulate.torque import PiecewiseConstantTorque, SampledTorque

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from mbkit.show import Kind, View

#: Fewest and most steps with which a method of first order is compared with itself at twice the step.
_DOUBLED_STEPS: Final = (4, 20_000)
#: Largest gap, relative to the motion: a hundredth is wrong, and at a few times the gap is not yet the largest.
_MAX_GAP: Final = 0.008
#: Largest ratio of velocities at twice the step to those of the run: beyond it twice the step is unstable, which says
#: nothing of the run.
_MAX_VELOCITY_RATIO: Final = 3.0


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
        """Whether there is no sign of an error."""
        return bool(self)

    def __str__(self) -> str:
        return f"{self.title}: {'; '.join(self.doubts) or 'no sign of an error'}"

    def _repr_html_(self) -> str:
        items = "".join(f"<li>{html(one)}</li>" for one in self.doubts or ("no sign of an error",))
        return f"<p><b>{html(self.title)}</b></p><ul>{items}</ul>"


class Trajectory(RunData):
    """States over time of one run or of a batch; arrays are read-only.

    Attributes
    ----------
    t : (K,) array
        s.
    q, v : (K, nq) and (K, nv), or (N, K, nq) and (N, K, nv) arrays
        A run that ended early has fewer times; a trajectory that ended before the others of its batch is NaN from
        there on.
    model : Model
    method, engine : str
    stats : Stats
        Its cost and end.
    events : tuple of Hit
    """

    def check(self) -> RunCheck:
        """Return the signs that the run is wrong, also by integrating again; true where there are none.

        Beside those that `simulate` finds at once (energy from nowhere, a singular mass matrix, coordinates without
        digits, gimbal lock, tolerances that add up): a step too long for a mode of the linearized motion, and of a
        method of first order without torque, up to 20,000 steps, the difference from a run with twice the step. That
        takes up to half as long as the run, and a few ms.
        """
        title, stats, settings = f"{self.model.name}: {self.method}", self.stats, self._settings
        if not stats.finished:
            return RunCheck(title, (stats.message,))
        if settings is None:
            return RunCheck(title, stats.doubts)
        dyn, method, driven = self._own(), METHODS[self.method], self._applied is not None
        states = settings.with_start(self.t, self.q, self.v)
        signs = diagnostics(dyn, method, settings.setting, states, driven=driven, steps=stats.steps)
        if not driven:
            signs += _step_doubling(dyn, method, settings, states)
        return RunCheck(title, (*settings.doubts, *signs))

    # Pictures and files

    def plot(self, fig: Figure | SubFigure | None = None) -> Figure:
        """Draw coordinates, velocities, energies and the power balance over time with Matplotlib.

        Lengths, angles and quaternions have a panel each; of a batch, the first ten trajectories are drawn. Events and
        the end of a run that diverged are marked.

        Parameters
        ----------
        fig : Figure or SubFigure, optional
            An empty one to draw into, best with ``layout="constrained"``. By default a new figure.
        """
        from mbkit.simulate.plotting.time_series import plot

        return plot(self, fig)

    def picture(
        self, count: int = 8, view: str | ArrayLike | None = None, member: int = 0, ax: Axes | None = None
    ) -> Figure:
        """Draw the motion as a strip of stick figures at equal times, with Matplotlib.

        Links run from joint to joint, at the ends to the centre of mass or the last frame; the path of one point is
        drawn too: the end of the longest branch, or the base of a floating robot.

        Parameters
        ----------
        count : int
            Number of figures.
        view : str or (2, 3) array_like, optional
            The plane: two world axes to the right and upwards, such as ``"xz"``, or two directions. By default upwards
            is against gravity, and to the right is where the motion is widest.
        member : int
            Index of the trajectory in a batch.
        ax : Axes, optional
            Where to draw; by default in a figure of its own.
        """
        from mbkit.simulate.plotting.motion_strip import picture

        member, model = self._member(member)
        return picture(self, model, count, view, member, ax)

    def animate(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        model: Model | None = None,
        member: int = 0,
        shapes: Kind = "visual",
        triangles: int = 250_000,
        fps: float = 25.0,
    ) -> View:
        """Show the motion with the robot's shapes, in a notebook, a browser window or a file.

        The page has a time slider, play and pause, speeds, and a turntable camera. It is one HTML file that loads
        nothing, of up to 2,000 of the saved states, and moves smoothly from one to the next.

        Parameters
        ----------
        path : str or path, optional
            A file to write: ``.html``, ``.gif`` or ``.mp4``, or ``.png`` for the first state. Without one see
            `mbkit.show`.
        model : Model, optional
            The description with the bodies, of the same coordinates in the same order; moved ones may be left
            out of the states. By default the run's own. A run of `mbkit.lagrangian.from_model`, such as one with
            loops, has energies without bodies, and needs the description that these came from.
        member : int
            Index of the trajectory in a batch.
        shapes : {"visual", "collision", "sticks"}
        triangles : int
            See `mbkit.show`.
        fps : float
            Frames a second of a film, in the time of the motion.

        Returns
        -------
        mbkit.show.View

        Raises
        ------
        InputError
            No finite state, a description of other coordinates, or a path of another kind.
        UnsupportedError
            A model written as energies, without `model`, or a format whose writer is not installed.
        OutputError
            The file cannot be written.
        """
        from mbkit.show.view import animate

        member, own = self._member(member)
        model = own if model is None else model
        q = self.q[member] if self.q.ndim == 3 else self.q
        return animate(model, q, self.t, path, shapes=shapes, triangles=triangles, fps=fps)

    def _member(self, member: int) -> tuple[int, Model]:
        """Return the checked index of a trajectory, and its description, for which no engine is built."""
        member = _check.count("member", member)
        members = len(self.q) if self.q.ndim == 3 else 1
        if member >= members:
            raise InputError(f"member: expected less than {members}, the number of trajectories, got {member}")
        return member, self.model if self._dyn is None else dynamics_of_trajectory(self._dyn, member).model

    def to_csv(self, path: str | os.PathLike[str] | None = None) -> str:
        """Return t, q, v and τ with all their digits, one line per state; with `path`, write it there too.

        τ is there where a torque acted. A batch has a first column with the index of its trajectory. OutputError where
        the file cannot be written.
        """
        header, rows = self._table()
        stream = io.StringIO()
        writer = csv.writer(stream)
        writer.writerow(map(csv_text, header))
        # The number of a trajectory is a whole one.
        writer.writerows([int(row[0]), *row[1:]] if self.q.ndim == 3 else row for row in rows.tolist())
        text = stream.getvalue()
        if path is not None:
            with writing(path):
                Path(path).write_text(text, encoding="utf-8", newline="")
        return text

    def _table(self) -> tuple[list[str], Array]:
        """Return the names of the columns of a table of all states, and the table."""
        batch, named = self.q.ndim == 3, self.model.velocity_names
        header = [*(["trajectory"] if batch else []), "t", *(f"q.{n}" for n in self.model.coordinate_names)]
        header += [f"v.{n}" for n in named] + ([f"tau.{n}" for n in named] if self.driven else [])
        states = [self.q, self.v, *([self.tau] if self.driven else [])]
        count = len(self.q) if batch else 1
        columns = [np.tile(self.t, count)[:, None], *(x.reshape(-1, x.shape[-1]) for x in states)]
        if batch:
            columns.insert(0, np.repeat(np.arange(float(count)), len(self.t))[:, None])
        return header, np.hstack(columns)

    def to_dataframe(self) -> Any:
        """Return the table of `to_csv` as a `pandas.DataFrame`.

        Raises
        ------
        UnsupportedError
            pandas is not installed.
        """
        with _check.needed("pandas", "to_dataframe"):
            import pandas
        header, rows = self._table()
        out = pandas.DataFrame(rows, columns=header)
        return out.astype({"trajectory": int}) if self.q.ndim == 3 else out

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write states, forces, events and what is known of the run to a file of NumPy's (.npz), which `load` reads.

        The model is not in it: its digest is. OutputError where the file cannot be written.

        Examples
        --------
        >>> import mbkit as mb, tempfile, pathlib
        >>> model = mb.catalog.pendulum()
        >>> run = mb.simulate(mb.dynamics(model), [1.0], [0.0], 0.1)
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.npz"
        >>> run.save(path)
        >>> again = mb.Trajectory.load(path, model)
        >>> bool((again.q == run.q).all()), again.method
        (True, 'rk4')
        """
        if self._dyn is not None and self._dyn._samples is not None:
            which = f"save: trajectories of {self.model.name} have parameters of their own, which no file keeps"
            raise UnsupportedError(f"{which}; save runs of one set of numbers, or pickle the batch")
        about = {"format": 2, "digest": self.model.digest, "model": self.model.name, "method": self.method}
        about |= {"engine": self.engine, "stats": asdict(self.stats)}
        about["wrenches"] = self._acting and ([frame.name for frame in self._acting[0]], self._acting[1])
        arrays: dict[str, Any] = {"t": self.t, "q": self.q, "v": self.v}
        # A held force keeps its rows, whose work is exact.
        if isinstance(acted := self._acted(), SampledTorque):
            arrays["tau"] = acted.values
        elif acted is not None:
            arrays |= {"rows": acted.rows} | ({} if acted.starts is None else {"starts": acted.starts})
        about["events"] = [(x.name, float(x.t), None if x.member is None else int(x.member)) for x in self.events]
        arrays |= {f"event_{name}": np.array([getattr(x, name) for x in self.events]) for name in "qv"}
        arrays["event_before"] = np.array([np.nan * x.v if x.before is None else x.before for x in self.events])
        arrays["event_energy"] = np.array([x.energy_change for x in self.events])
        arrays["about"] = np.array(json.dumps(about))
        with writing(path), open(path, "wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], model: Model) -> Trajectory:
        """Return a run that `save` wrote, of the same model; nothing in the file is executed.

        The settings of the run are not in it: `check` knows its doubts alone.

        Raises
        ------
        LoadError
            The file is missing, or is none of `save`.
        InputError
            It is a run of another model, by the digest.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays = {name: data[name] for name in data.files}
            about = json.loads(str(arrays.pop("about")))
            stats = about["stats"]
            reached = stats["reached"]
            stats |= {"reached": tuple(reached) if isinstance(reached, list) else reached}
            clipped = tuple(Saturation(*x) for x in stats.get("saturated", ()))
            known = Stats(**stats | {"doubts": tuple(stats["doubts"]), "saturated": clipped})
            parts = arrays["t"], arrays["q"], arrays["v"], model, about["method"], about["engine"], known
            digest, acting = about["digest"], about.get("wrenches")
            told, event_v = about.get("events", ()), arrays.get("event_v", np.zeros(0))
            # Files of before stops have no impacts.
            befores = [None if np.isnan(x).any() else x for x in arrays.get("event_before", np.nan * event_v)]
            energies = arrays.get("event_energy", np.zeros(len(told))).tolist()
            listed = zip(told, arrays.get("event_q", ()), event_v, befores, energies, strict=True)
            hits = tuple(Hit(name, t, q, v, i, before, e) for (name, t, i), q, v, before, e in listed)
        except (OSError, EOFError, ValueError, KeyError, TypeError) as error:
            raise LoadError(f"{path}: expected a run that Trajectory.save wrote ({error})") from None
        if digest != model.digest:
            other = f"a run of {about['model']!r} with other numbers than this {model.name!r}"
            raise InputError(f"model: {path} is {other} (digests differ)")
        rows, tau = arrays.get("rows"), arrays.get("tau")
        held = None if rows is None else PiecewiseConstantTorque(rows, arrays.get("starts"))
        frames = acting and (tuple(model.frame(name) for name in acting[0]), acting[1])
        return cls(*parts, events=hits, _applied=held if tau is None else SampledTorque(tau), _acting=frames)

    def _facts(self) -> list[tuple[str, str]]:
        count = f"{len(self.q)} trajectories of " if self.q.ndim == 3 else ""
        span = f", {self.t[0]:g} to {self.t[-1]:g} s" if len(self.t) else ""
        return [
            ("model", self.model.name),
            ("engine", self.engine),
            ("method", self.method),
            ("states", f"{count}{len(self.t)}{span}"),
            ("run", str(self.stats)),
            *([("events", self._event_times())] if self.events else []),
        ]

    def _event_times(self) -> str:
        """Return the events' names and times, the first few of each name."""
        return "; ".join(
            f"{name} at {', '.join(each[:MAX_NAMES])} s" + (f" ({len(each)})" if len(each) > MAX_NAMES else "")
            for name, each in by_key((hit.name, f"{hit.t:.6g}") for hit in self.events).items()
        )

    def __repr__(self) -> str:
        return f"<Trajectory {'; '.join(f'{k}: {one_line(x)}' for k, x in self._facts())}>"

    def _repr_html_(self) -> str:
        cells = "".join(f"<tr><th>{k}</th><td>{html(x)}</td></tr>" for k, x in self._facts())
        return f"<table>{cells}</table>"


def _step_doubling(
    dyn: Dynamics, method: Method, settings: RunSettings, states: tuple[_check.Array, ...]
) -> Iterator[str]:
    """Compare a run by a method of first order with one at twice the step: the gap is about the error."""
    h, model = settings.setting, dyn.model
    if method.order != 1 or not isinstance(h, float) or model.time_parameter or not states[2].size:
        return
    t, q, v = states[0] - settings.t0, *(x.reshape(-1, *x.shape[-2:])[0] for x in states[1:])
    # Twice the step would change the length of the last one.
    if not _DOUBLED_STEPS[0] <= round(t[-1] / h) <= _DOUBLED_STEPS[1] or not np.isfinite(q).all():
        return
    both = np.flatnonzero(np.abs(t / (2 * h) - np.rint(t / (2 * h))) < 1e-6)[1:]
    motion = float(np.abs(model.difference(np.broadcast_to(q[0], q.shape), q)).max(initial=0.0))
    if not len(both) or not motion:
        return
    both = both[np.unique(np.linspace(0, len(both) - 1, CHECKED_TIMES).astype(int))]
    times = states[0][both]
    own, q0, v0 = (dyn, q[0], v[0]) if dyn._samples is None else (dyn._of_samples([0]), q[:1], v[:1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        length = float(times[-1] - settings.t0)
        coarse, _ = integrate(own, RunRequest(q0, v0, length, method.name, 2 * h, save=times, t0=settings.t0))
    if not coarse.stats.finished or np.abs(coarse.v).max() > _MAX_VELOCITY_RATIO * np.abs(v).max():
        return
    off = float(np.abs(model.difference(q[both], coarse.q.reshape(len(both), -1))).max()) / motion
    if off > _MAX_GAP:
        yield (
            f"by a run with a step of {2 * h:g} s it is off by {off:.2g} of the motion, since {method.name} is of "
            f"first order; take a smaller step, or method={AUTOMATIC_METHOD!r}"
        )
