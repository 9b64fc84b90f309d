"""`Trajectory`: what a simulation returns, frozen."""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import _check
from mbkit._check import Array
from mbkit._escape import csv_text, html, one_line
from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.engines.base import at_times
from mbkit.errors import InputError, OutputError, UnsupportedError
from mbkit.model import Model
from mbkit.simulate.along_trajectory import (
    canonical_momentum,
    kinetic_energy,
    momentum,
    potential_energy,
    record_of,
    work,
)
from mbkit.simulate.events import Hit
from mbkit.simulate.result import Stats
from mbkit.simulate.torque import Applied, Asked, Held, Sampled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Trajectory"]

_FEW: Final = 4


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
    events : tuple of Hit
        What happened on the way, of the events that were asked for.

    Notes
    -----
    What is derived from the states is computed when it is asked for, by the run's own
    engine or, where there is an argument for it, by another one.
    """

    t: Array
    q: Array
    v: Array
    model: Model
    method: str
    engine: str
    stats: Stats
    _dyn: Dynamics | None = field(default=None, repr=False)
    events: tuple[Hit, ...] = ()
    _applied: Applied | None = field(default=None, repr=False)

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
        known = self.engine in ENGINES and (self._dyn is None or self._dyn.samples is None)
        applied = self._applied
        if isinstance(applied, Asked):
            # Functions seldom travel; what this one says does.
            applied = applied.sampled(self.t, self.q, self.v, strict=False)
        dyn = None if known else self._dyn
        return type(self), (
            *(self.t, self.q, self.v, self.model, self.method, self.engine, self.stats),
            *(dyn, self.events, applied),
        )

    # Energies, work and momenta

    def energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return kinetic plus potential energy in J, shape (K,) or (N, K).

        Parameters
        ----------
        engine : str or Dynamics, optional
            Who computes it; the run's own engine when not given.
        """
        dyn = self._by(engine)
        return kinetic_energy(dyn, self.q, self.v) + potential_energy(dyn, self.q)

    def kinetic_energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return ½ vᵀ M v in J, which no known defect of an engine touches; shape (K,) or (N, K)."""
        return kinetic_energy(self._by(engine), self.q, self.v)

    def potential_energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return the energy of gravity and springs in J, shape (K,) or (N, K)."""
        return potential_energy(self._by(engine), self.q)

    def tau(self) -> Array:
        """Return the generalized force that acted at each state, of the shape of v.

        Of an array, the row that acts from there on (at the end, the last one); of a
        function, what it returns at the saved states, for which it is asked once more,
        unless the trajectory has been pickled, which asks it then. Where the function
        ended the run, the last state has NaN.

        Raises
        ------
        TorqueError
            The function fails at a state that it has passed before.
        """
        acted = self._acted()
        if acted is None:
            return np.zeros(self.v.shape)
        if isinstance(acted, Sampled):
            return acted.values.copy()
        rows = np.broadcast_to(acted.at(self.t), self.v.shape)
        return np.where(np.isfinite(self.v).all(-1, keepdims=True), rows, np.nan)

    def work(self, engine: str | Dynamics | None = None) -> Array:
        """Return ∫ (τ + τ_damping)·v dt since the first state in J, shape (K,) or (N, K).

        The work of a constant or held torque is τ·Δq, exact for the saved positions,
        where v = q̇. On quasi-velocities, of dampers, and of a torque function, it is a
        quadrature of fourth order in the distance of the saved states, where what is
        integrated is smooth: a function that jumps makes it first order.

        Parameters
        ----------
        engine : str or Dynamics, optional
            Who computes damping and accelerations.

        Raises
        ------
        UnsupportedError
            The rows of a held torque change between two saved states.
        """
        return work(self._by(engine), self.t, self.q, self.v, self._acted())

    def power_balance(self, engine: str | Dynamics | None = None) -> Array:
        """Return E(t) - E(0) - work(t) in J: zero for a run without error, shape (K,) or (N, K).

        It holds the error of the run and that of `work`; the second is that of a
        quadrature on the saved states, so save every step where they are to be told
        apart. With no torque or one that is constant or held, on coordinates with
        v = q̇ and no dampers, only the run's own error is left.
        """
        energy = self.energy(engine)
        return np.asarray(energy - energy[..., :1] - self.work(engine))

    def momentum(self, engine: str | Dynamics | None = None) -> Array:
        """Return the bodies' momentum, shape (K, 6) or (N, K, 6), in world axes.

        Linear, kg m/s, then angular about the world's origin, kg m²/s: summed over the
        bodies with the engine's poses and Jacobians. Armature, which belongs to no
        body, has no part in it.
        """
        return momentum(self._by(engine), self.q, self.v)

    def canonical_momentum(self, engine: str | Dynamics | None = None) -> Array:
        """Return p = M v, shape (K, nv) or (N, K, nv)."""
        return canonical_momentum(self._by(engine), self.q, self.v)

    def _by(self, engine: str | Dynamics | None) -> Dynamics:
        if engine is None or engine == self.engine:
            if self._dyn is None:
                object.__setattr__(self, "_dyn", dynamics(self.model, self.engine))
            assert self._dyn is not None
            return at_times(self._dyn, self.t, len(self.q) if self.q.ndim == 3 else None)
        if isinstance(engine, Dynamics):
            if engine.model.coordinate_names != self.model.coordinate_names:
                raise InputError(f"engine: expected a Dynamics of {self.model.name}, got one of {engine.model.name}")
            return at_times(engine, self.t, len(self.q) if self.q.ndim == 3 else None)
        if self._dyn is not None and self._dyn.samples is not None:
            raise UnsupportedError(
                f"{engine}: the trajectories have parameters of their own, which only the {self.engine} engine holds"
            )
        return at_times(dynamics(self.model, engine), self.t, len(self.q) if self.q.ndim == 3 else None)

    def _acted(self) -> Held | Sampled | None:
        if isinstance(self._applied, Asked):
            strict = self.stats.ended != "function_failed"
            answers = self._applied.sampled(self.t, self.q, self.v, strict=strict)
            object.__setattr__(self, "_applied", answers)
        acted = self._applied
        assert not isinstance(acted, Asked)
        return acted

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
        # What is drawn is the description alone: no engine is made for it.
        model = self.model if self._dyn is None else record_of(self._dyn, member).model
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
            *([("events", _told(self.events))] if self.events else []),
        ]

    def __repr__(self) -> str:
        return f"<Trajectory {'; '.join(f'{k}: {one_line(x)}' for k, x in self._facts())}>"

    def _repr_html_(self) -> str:
        cells = "".join(f"<tr><th>{k}</th><td>{html(x)}</td></tr>" for k, x in self._facts())
        return f"<table>{cells}</table>"


def _told(events: tuple[Hit, ...]) -> str:
    """Return the events' names and times, the first few of each name."""
    times: dict[str, list[float]] = {}
    for hit in events:
        times.setdefault(hit.name, []).append(hit.t)
    return "; ".join(
        f"{name} at {', '.join(f'{t:.6g}' for t in found[:_FEW])}"
        + (" s" if len(found) <= _FEW else f" s ({len(found)})")
        for name, found in times.items()
    )
