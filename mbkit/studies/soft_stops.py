"""`soft_stops`: how far an engine's own joint limits, which are soft, are from rigid stops in one motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.engines.registry import DERIVED, MUJOCO, dynamics, find_engine
from mbkit.errors import InputError
from mbkit.methods.registry import ADAPTIVE_METHOD, METHODS
from mbkit.model import Model
from mbkit.model.stops import StopLaw
from mbkit.simulate import Trajectory
from mbkit.studies import document as doc
from mbkit.studies._targets import with_values
from mbkit.studies.formatting import error_text, time_text
from mbkit.studies.results import ResultTable, columns_of, versions
from mbkit.studies.study_runs import integrable, quiet_simulate, require_motion, runs_to_limits


@dataclass(frozen=True)
class SoftStop:
    """A limit that a motion reaches, with one softness of the engine's and with the rigid stop; NaN is what is not.

    `penetration` is how far its coordinate goes beyond it, rad or m; the first contact `arrives` and `leaves`, s. Of
    the whole motion are the energy `lost` at all limits, J, and the largest differences of the two, `turned`, rad, and
    `moved`, m.
    """

    softness: str
    limit: str
    penetration: float
    arrives: float
    arrives_rigid: float
    leaves: float
    leaves_rigid: float
    lost: float
    lost_rigid: float
    turned: float
    moved: float


def _cell(name: str) -> Any:
    return lambda row: x if isinstance(x := getattr(row, name), str) else f"{x:.4g}" if np.isfinite(x) else "–"


_COLUMNS: Final = tuple(doc.Column(f.name.replace("_", "\n"), _cell(f.name)) for f in fields(SoftStop))
#: Distance at which a coordinate is at a limit, rad or m: stiff ones may end a motion before it.
_TOUCHES: Final = 1e-6


@dataclass(frozen=True, repr=False)
class SoftStops(ResultTable):
    """Limits of an engine's own beside rigid stops, from one start; a row for each that is reached.

    `notes` are what both motions are without, `doubts` signs that one of them is wrong.
    """

    model: str
    engine: str
    method: str
    dt: float
    duration: float
    q0: tuple[float, ...]
    v0: tuple[float, ...]
    rows: tuple[SoftStop, ...]
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)

    _derived: ClassVar = ("verdict",)
    _csv_columns: ClassVar = columns_of(SoftStop)

    @property
    def verdict(self) -> str:
        """How far the engine passes the first limit that it reaches, and its motion is off."""
        if not self.rows:
            return f"no joint reaches a limit within {time_text(self.duration)}"
        r = self.rows[0]
        off = f"{error_text(r.turned)} rad and {error_text(r.moved)} m off rigid stops"
        passed = f"passes {r.limit} by {error_text(r.penetration)}"
        who = f"{'in doubt: ' * bool(self.doubts)}{self.engine} with {r.softness}"
        return f"{who} {passed}, and within {time_text(self.duration)} is {off}"

    def document(self) -> doc.Document:
        """Return the document: the verdict, then the limits."""
        start = f"{self.method} at {time_text(self.dt)} from q0 = {self.q0}, v0 = {self.v0}"
        units = "angles are in rad, lengths in m, times in s, energies in J; rigid is what the stop does"
        below = doc.Items([doc.Bullet("", x) for x in (*self.doubts, start, *self.notes, units)])
        section = doc.Section("Limits that are reached", [doc.Table(_COLUMNS, self.rows), below])
        return doc.Document(self.model, self.verdict, good=True, marked=False, sections=[section], result=self)


def soft_stops(
    model: Model,
    q0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    *,
    duration: float = 1.0,
    engine: str = MUJOCO,
    dt: float = 1e-3,
    seed: int = 0,
) -> SoftStops:
    """Measure how far an engine's own joint limits are from rigid stops without restitution, from one start.

    MuJoCo's are as soft as its file says, or as MuJoCo's default, and then have half that time constant; Drake's are as
    stiff as its step allows, which is then halved. Dry friction is left out, and mimic joints move freely.

    Parameters
    ----------
    model : Model
    q0, v0 : array_like, optional
        By default a random state of `seed` whose motion reaches a limit; with `q0` alone at rest.
    duration, dt : float
        s; `dt` is the engine's step.
    engine : {"mujoco", "drake"}
    """
    model = with_values(require_motion(model, "stop"), "soft_stops")
    bare, notes = integrable(model.without("stops"))
    soft, smooth = dynamics(bare, engine, limits="soft"), dynamics(bare, DERIVED)
    if not soft._soft_limits:
        raise InputError(f"model: expected joints with limits, {bare.name} has none")
    if q0 is None:
        if v0 is not None:
            raise InputError("v0: expected q0 beside it")
        free, reached = runs_to_limits(smooth, duration, seed)
        q0, v0 = (x[reached[0][1] if reached else 0, 0] for x in (free.q, free.v))
    start = bare.check_q(q0, "q0"), bare.check_v(np.zeros(bare.nv) if v0 is None else v0, "v0")
    if start[0].ndim > 1 or start[1].ndim > 1:
        raise InputError(f"q0, v0: expected one state, got shapes {start[0].shape}, {start[1].shape}")
    natives = [m.name for m in METHODS.values() if m.kind == "native" and m.on(engine)]
    method = max(natives, key=lambda x: x == find_engine(engine).rk4)
    runs = {text: quiet_simulate(dyn, *start, duration, method, h) for text, dyn, h in _softer(soft, dt)}
    grid = max((run.t for run in runs.values()), key=len)
    rigid = quiet_simulate(dynamics(bare.with_stops(), DERIVED), *start, duration, ADAPTIVE_METHOD, save=grid)
    rows = tuple(row for text, run in runs.items() for row in _rows(text, run, rigid, smooth))
    signs = {text: (run.stats.message, *run.stats.doubts) for text, run in (*runs.items(), ("rigid", rigid))}
    doubts = tuple(f"{text}: {x}" for text, told in signs.items() for x in told if x)
    q, v = (tuple(x.tolist()) for x in start)
    return SoftStops(model.name, engine, method, dt, duration, q, v, rows, tuple(notes), doubts, versions())


def _softer(soft: Any, dt: float) -> Iterator[tuple[str, Any, float]]:
    """Yield the engine's own softness and one of half the time: its name, dynamics and step."""
    if (held := getattr(soft, "limit_softness", None)) is None:
        yield from ((f"steps of {time_text(h)}", soft, h) for h in (dt, dt / 2))
        return
    # Numbers below zero have no time constant.
    half = {j: replace(x, solref=(x.solref[0] / 2, x.solref[1])) for j, x in held.items() if x.solref[0] > 0}
    for own in (held, held | half):
        text = " or ".join(dict.fromkeys("solref ({:g}, {:g})".format(*x.solref) for x in own.values()))
        yield text, dynamics(soft.model, soft.engine, limits=own), dt


def _rows(softness: str, run: Trajectory, rigid: Trajectory, smooth: Any) -> list[SoftStop]:
    """Return a row for each limit that one of the motions reaches, in the order of arrivals."""
    model, law, t, out = smooth.model, StopLaw(rigid.model), run.t, list[SoftStop]()
    n, events = int((t <= rigid.t[-1]).sum()), {x.name: x.t for x in reversed(rigid.events)}
    apart = np.abs(model.difference(rigid.q[np.searchsorted(rigid.t, t[:n])], run.q[:n])).max(axis=0)
    lengths = np.concatenate([[k in j.type.lengths for k in range(j.type.nv)] for j in model.independent_joints])
    off = (float(apart[x].max(initial=0.0)) for x in (~lengths, lengths))
    whole = -float(run.power_balance(smooth)[-1]), -sum(x.energy_change for x in rigid.events), *off
    for (upper, k), (_, side) in law.names.items():
        beyond = (run.q[:, law.places[k]] - law.bounds[upper, k]) * (1 if upper else -1)
        near = beyond + _TOUCHES
        hits, leaves = (events.get(law.event(k, 0.5 - upper, does), np.nan) for does in ("hits", "leaves"))
        if (near > 0).any() or np.isfinite(hits):
            limit = f"{model.coordinate_names[law.places[k]]} {side}"
            times = _crossing(t, near), hits, _crossing(t, -near), leaves
            out.append(SoftStop(softness, limit, max(float(beyond.max()), 0.0), *times, *whole))
    return sorted(out, key=lambda r: np.nan_to_num([r.arrives, r.arrives_rigid], nan=np.inf).min())


def _crossing(t: Array, x: Array) -> float:
    """Return the time at which x first comes above zero, or NaN."""
    k = np.flatnonzero((x[:-1] <= 0) & (x[1:] > 0))[:1]
    return float(np.interp(0.0, x[k[0] : k[0] + 2], t[k[0] : k[0] + 2])) if len(k) else np.nan
