"""`Trajectory`: what a simulation returns, frozen."""

from __future__ import annotations

import csv
import html
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mbkit._check import Array
from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.errors import OutputError
from mbkit.model import Model
from mbkit.simulate.stats import Stats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Trajectory"]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States over time, of one run or of a batch; arrays are read-only.

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
    """

    t: Array
    q: Array
    v: Array
    model: Model
    method: str
    engine: str
    stats: Stats
    _dyn: Dynamics | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        for name in ("t", "q", "v"):
            array = getattr(self, name)
            # One that is read-only and its own is as good as a copy.
            if array.flags.writeable or array.base is not None or not array.flags.c_contiguous:
                array = np.array(array, order="C")
                array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        # An engine that can be made again by name is not sent along: deriving it
        # anew for every trajectory of a process pool would cost more than the run.
        dyn = None if self.engine in ENGINES else self._dyn
        return type(self), (self.t, self.q, self.v, self.model, self.method, self.engine, self.stats, dyn)

    def energy(self) -> Array:
        """Return kinetic plus potential energy in J, shape (K,) or (N, K), by the run's own engine.

        The kinetic part is ½ vᵀ M v, which no known defect touches.
        """
        dyn = self._dyn
        if dyn is None:
            dyn = dynamics(self.model, self.engine)
            object.__setattr__(self, "_dyn", dyn)
        n = int(np.prod(self.q.shape[:-1]))
        q, v = self.q.reshape(n, self.model.nq), self.v.reshape(n, self.model.nv)
        good = np.isfinite(q).all(-1) & np.isfinite(v).all(-1)
        out = np.full(len(q), np.nan)
        if good.any():
            # A batch may have parameters of its own for each trajectory.
            dyn = dyn.of_samples(np.repeat(np.arange(len(self.q)), len(self.t))[good]) if self.q.ndim == 3 else dyn
            kinetic = 0.5 * np.einsum("ni,nij,nj->n", v[good], dyn.mass_matrix(q[good]), v[good])
            out[good] = kinetic + dyn.potential_energy(q[good])
        return out.reshape(self.q.shape[:-1])

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
                writer.writerow(header)
                for i, (q, v) in enumerate(zip(self.q, self.v, strict=True) if batch else [(self.q, self.v)]):
                    lead = [i] if batch else []
                    rows = np.column_stack([self.t, q, v]).tolist()
                    writer.writerows([*lead, *row] for row in rows)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror or error}; choose a folder that exists") from error

    def plot(self) -> Figure:
        """Draw q and v over time with Matplotlib; of a batch, the first ten trajectories."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8, 6), layout="constrained")
        axes = figure.subplots(2, 1, sharex=True)
        names = (self.model.coordinate_names, self.model.velocity_names)
        for axis, values, labels, title in zip(
            axes, (self.q, self.v), names, ("q (m, rad)", "v (m/s, rad/s)"), strict=True
        ):
            for i, run in enumerate(values[:10] if values.ndim == 3 else [values]):
                axis.set_prop_cycle(None)
                lines = axis.plot(self.t, run, linewidth=1)
                if not i and len(labels) <= 12:
                    for line, label in zip(lines, labels, strict=True):
                        line.set_label(label)
                    axis.legend(fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
            axis.set_ylabel(title)
        axes[0].set_title(f"{self.model.name}: {self.method} on {self.engine}")
        axes[1].set_xlabel("t (s)")
        return figure

    def _facts(self) -> list[tuple[str, str]]:
        count = f"{len(self.q)} trajectories of " if self.q.ndim == 3 else ""
        span = f", {self.t[0]:g} to {self.t[-1]:g} s" if len(self.t) else ""
        return [
            ("model", self.model.name),
            ("engine", self.engine),
            ("method", self.method),
            ("states", f"{count}{len(self.t)}{span}"),
            ("run", str(self.stats)),
        ]

    def __repr__(self) -> str:
        return f"<Trajectory {'; '.join(f'{k}: {x}' for k, x in self._facts())}>"

    def _repr_html_(self) -> str:
        cells = "".join(f"<tr><th>{k}</th><td>{html.escape(x)}</td></tr>" for k, x in self._facts())
        return f"<table>{cells}</table>"
