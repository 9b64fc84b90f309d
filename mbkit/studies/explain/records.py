"""Two recorded motions of any simulators, and which causes turn one into the other."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array, by_key, finite_array
from mbkit.engines.registry import MUJOCO
from mbkit.errors import InputError, MbkitError
from mbkit.methods.registry import METHODS
from mbkit.methods.simulation_settings import Settings
from mbkit.model import Model
from mbkit.simulate import Trajectory
from mbkit.simulate.progress import Bar
from mbkit.studies.explain.controlled_runs import Motion, Run, Runner, runnable
from mbkit.studies.explain.hypotheses import Change, Hypothesis, absences
from mbkit.studies.explain.motion import Compared
from mbkit.studies.explain.motion_result import RecordComparison, TriedCause
from mbkit.studies.explain.worlds import World, joint_order, setting_differences

#: Names of columns, of which each follows a joint's name.
_SUFFIXES: Final = {
    "q": ("", ".q", "_pos", "_position"),
    "v": (".v", "_vel", "_velocity"),
    "u": (".u", "_ctrl", "_tau"),
}
_TIMES: Final = ("t", "time", "times")
#: Rows to which a starting velocity is fitted where none is recorded.
_ROWS_OF_START: Final = 20
_DEGREE: Final = np.pi / 180
#: Causes of which pairs are tried, the best ones first.
_MAX_IN_PAIRS: Final = 8
#: Best causes that are tried with all others.
_MAX_WITH_ALL: Final = 2
#: A pair is named where it leaves less than this fraction of what the best single cause leaves.
PAIR_GAIN: Final = 0.1
#: Usual steps of simulators, s, and numbers of steps between two rows.
_STEPS: Final = (5e-4, 1e-3, 2e-3, 4e-3, 5e-3, 1e-2)
_ROWS_IN_PERIOD: Final = (1, 2, 4, 5, 10)
_GRAVITY: Final = {"9.8": 9.8, "9.80665": 9.80665, "9.81": 9.81, "0": 0.0}


@dataclass(frozen=True, eq=False)
class Record:
    """A recorded motion: times from zero, (K,), positions (K, nq), and velocities and controls, (K, nv), if any."""

    t: Array
    q: Array
    v: Array | None
    u: Array | None
    named: bool = False


def record_of(data: Any, model: Model, which: str = "record", names: Mapping[str, str] | None = None) -> Record:
    """Return a recorded motion in the coordinates of a model.

    Parameters
    ----------
    data : Trajectory, path of a CSV or NPZ, DataFrame, mapping of columns, or (t, q, v)
        Columns of joints by name, with ``.v`` (or ``_vel``) after it for a velocity and ``.u`` (or ``_ctrl``, ``_tau``)
        for a control; or arrays ``t``, ``q``, ``v``, or MuJoCo's ``qpos`` and ``qvel``.
    model : Model
    which : str
        The argument, for messages.
    names : mapping, optional
        Joint of the model -> its other name in the columns.

    Raises
    ------
    InputError
        Columns that lack a joint, rows that are not finite, times that do not increase, positions in degrees.
    """
    if isinstance(data, Trajectory):
        return _checked(Record(np.asarray(data.t), data.q, data.v, None), model, which)
    if isinstance(data, (str, Path)):
        data = _read(Path(data), which)
    if isinstance(data, tuple):
        data = dict(zip(("t", "q", "v"), data, strict=False))
    try:
        columns = {str(name): np.asarray(data[name], dtype=np.float64) for name in data}
    except (TypeError, ValueError) as error:
        raise InputError(f"{which}: expected a Trajectory, a path, a table or (t, q, v): {error}") from None
    t = next((columns[name] for name in _TIMES if name in columns), None)
    if t is None:
        raise InputError(f"{which}: expected a column {' or '.join(_TIMES)}; there are: {', '.join(columns)[:200]}")
    if "qpos" in columns:
        return _checked(Record(t, *_from_mujoco(model, columns, which), columns.get("u")), model, which)
    if "q" in columns:
        return _checked(Record(t, columns["q"], columns.get("v"), columns.get("u")), model, which)
    found = {kind: _by_joint(model, columns, suffixes, names or {}) for kind, suffixes in _SUFFIXES.items()}
    if lost := [name for name, x in zip(model.coordinate_names, found["q"], strict=True) if x is None]:
        raise InputError(f"{which}: no column of {', '.join(lost)}; there are: {', '.join(columns)[:200]}")
    if any(x is not None for x in found["u"]):
        # A joint without a column has no control.
        found["u"] = [np.zeros(len(t)) if x is None else x for x in found["u"]]
    q, v, u = (None if any(x is None for x in found[kind]) else np.array(found[kind]).T for kind in _SUFFIXES)
    assert q is not None
    return _checked(Record(t, q, v, u, named=True), model, which)


def _read(path: Path, which: str) -> Mapping[str, Any]:
    try:
        if path.suffix == ".npz":
            with np.load(path) as held:
                return {name: held[name] for name in held.files}
        with path.open(newline="", encoding="utf-8-sig") as file:
            head, *rows = (row for row in csv.reader(file) if row)
        return dict(zip((x.strip() for x in head), np.array(rows, dtype=np.float64).T, strict=True))
    except (OSError, ValueError, TypeError, KeyError, csv.Error, zipfile.BadZipFile) as error:
        raise InputError(f"{which}: {path} is no CSV of numbers under a line of names, and no NPZ: {error}") from None


def _by_joint(
    model: Model, columns: Mapping[str, Array], suffixes: Sequence[str], names: Mapping[str, str]
) -> list[Array | None]:
    own = model.coordinate_names if "" in suffixes else model.velocity_names
    asked = ((n, names.get(n, n)) for n in own)
    return [next((columns[n + x] for n in pair for x in suffixes if n + x in columns), None) for pair in asked]


def _in_order(x: Record, model: Model, order: Sequence[str]) -> Record:
    """Return a record whose columns stand in another order of joints in that of the model."""
    layout, known = model.layout, {j.name: j.type for j in model.independent_joints}
    q_ends, v_ends = (np.cumsum([0, *(getattr(known[n], size) for n in order)]) for size in ("nq", "nv"))
    q_of, v_of = np.zeros(model.nq, int), np.zeros(model.nv, int)
    for k, name in enumerate(order):
        q_of[layout.q[name]] = np.arange(q_ends[k], q_ends[k + 1])
        v_of[layout.v[name]] = np.arange(v_ends[k], v_ends[k + 1])
    return replace(x, q=x.q[:, q_of], **{n: y[:, v_of] for n in ("v", "u") if (y := getattr(x, n)) is not None})


def _from_mujoco(model: Model, columns: Mapping[str, Array], which: str) -> tuple[Array, Array | None]:
    """Return MuJoCo's coordinates as mbkit's: quaternions with w last, a free body's velocity in its own axes."""
    q, v = np.array(columns["qpos"]), columns.get("qvel")
    v = None if v is None else np.array(v)
    if q.ndim != 2 or q.shape[1] != model.nq:
        raise InputError(f"{which}: expected qpos of shape (K, {model.nq}), got {q.shape}")
    for start, _ in model.quaternions:
        q[:, start : start + 4] = np.roll(q[:, start : start + 4], -1, axis=1)
    for j in (x for x in model.independent_joints if x.type.floating and v is not None):
        quaternion = q[:, model.layout.q[j.name]][:, 3:]
        rows = slice(model.layout.v[j.name].start, model.layout.v[j.name].start + 3)
        v[:, rows] = spatial.rotate(spatial.conjugate(quaternion), v[:, rows])  # type: ignore[index]
    return q, v


def _checked(x: Record, model: Model, which: str) -> Record:
    t = finite_array(f"{which}: t", x.t, (np.size(x.t),))
    if _holds_at_uneven_times(x):
        raise InputError(f"{which}: controls are held over equal periods; expected rows at equal times")
    if len(t) < 3 or not (np.diff(t) > 0).all():
        raise InputError(f"{which}: expected at least three increasing times, got {len(t)} of them")
    size = {"q": model.nq, "v": model.nv, "u": model.nv}
    held = ((n, k, getattr(x, n)) for n, k in size.items())
    more: dict[str, Any] = {n: finite_array(f"{which}: {n}", y, (len(t), k)) for n, k, y in held if y is not None}
    return replace(x, t=t - t[0], **more)


def _holds_at_uneven_times(x: Record) -> bool:
    """Return whether controls stand at times that are not equal steps."""
    steps = np.diff(x.t)
    return x.u is not None and bool(len(steps)) and bool(np.ptp(steps) > 1e-6 * steps.max())


def expect_same_units(a: Record, b: Record) -> None:
    """Raise where one record begins at the other's positions in degrees."""
    starts = {"first": a.q[0], "second": b.q[0]}
    some = np.all([np.abs(x) > 1e-6 for x in starts.values()], axis=0)
    for (which, y), x in zip(starts.items(), reversed(starts.values()), strict=True):
        if some.any() and np.allclose(y[some] * _DEGREE, x[some], rtol=1e-3, atol=0.0):
            raise InputError(
                f"rollouts: the {which} is in degrees; multiply its positions and velocities by {_DEGREE:.7f}"
            )


def usual_causes(model: Model, settings: Settings, period: float) -> Iterator[Hypothesis]:
    """Yield the usual differences of simulators that no file tells: step, integrator, gravity, parts left out.

    Steps are the usual ones, and the period of the second record's rows in whole parts, s.
    """
    steps = sorted({*_STEPS, *(float(f"{period / k:.6g}") for k in _ROWS_IN_PERIOD)})
    choices: dict[str, Sequence[Any]] = {"time_step": steps, "implicit_damping": (True, False)}
    choices["integrator"] = [m.name for m in METHODS.values() if m.kind == "native" and m.engines and m.on(MUJOCO)]
    for name, values in choices.items():
        for value in values:
            yield from setting_differences(settings, replace(settings, **{name: value}))
    down = float(np.linalg.norm(model.gravity))
    for text, size in _GRAVITY.items():
        if abs(size - down) > 1e-9 and down:
            other = model.gravity * (size / down)
            yield Hypothesis(
                "gravity",
                "",
                f"has gravity of {text} m/s²",
                (Change(("",), {"gravity": model.gravity}, {"gravity": other}),),
            )
    lost = by_key((x.kind, (j, x)) for j in model.joints for x in absences(j))
    for kind, some in lost.items():
        changes = [Change(("joints", j.name), {n: getattr(j, n) for n in x.fields}, x.fields) for j, x in some]
        yield Hypothesis(kind, "", some[0][1].says, tuple(changes))


def compare_records(
    compared: Compared, motion: Motion, records: tuple[Any, Any], names: tuple[str, str]
) -> RecordComparison:
    """Run the first side from the records' start, with each known cause and each pair of them, beside the second's."""
    if not isinstance(records, (tuple, list)) or len(records) != 2:
        raise InputError(f"rollouts: expected two records, got {type(records).__name__}")
    first, second = compared.worlds((motion.settings[0] or Settings(), motion.settings[1] or Settings()))
    first, second, notes = runnable(first, second)
    told = [
        *compared.regular,
        *compared.bases,
        *setting_differences(first.settings, second.settings),
        *joint_order(first, second),
    ]
    known, model = [*told], first.system.model
    own_names = {m.a: m.b for m in compared.matching.pairs}
    a = record_of(records[0], model, "rollouts: first")
    b = record_of(records[1], model, "rollouts: second", own_names)
    # Columns without names stand in the second's own order.
    b = b if b.named else _in_order(b, model, second.order)
    expect_same_units(a, b)
    if a.v is None:
        notes.append("no velocities are recorded: the start has those whose run is nearest the first rows")
    rates = [1 / float(np.median(np.diff(x.t))) for x in (a, b)]
    if abs(rates[0] - rates[1]) > 1e-6 * rates[0]:
        notes.append(
            f"the records have {rates[0]:.6g} and {rates[1]:.6g} rows a second; they are compared at common times"
        )
    # A simulator may do otherwise than its file says.
    known += usual_causes(model, first.settings, 1 / rates[1])
    end = min(float(a.t[-1]), float(b.t[-1]))
    control: Any = motion.controller if motion.controller != "posture" else "passive"
    grid, layout = a.t[a.t <= end + 1e-12], model.layout
    if (off := float(np.abs(a.q[0] - b.q[0]).max(initial=0.0))) > motion.bound:
        notes.append(f"the records begin {off:.3g} rad or m apart, where one start was expected")

    def moved_by(x: Record) -> tuple[World, Motion]:
        """Return the first's world and motion under the controls of a record, if it has any."""
        world, law = first, control if x.u is None else x.u
        if x.u is not None:
            world = first.put(("settings",), {"control_period": float(x.t[1])})
        return world, replace(motion, q=a.q[0], v=np.zeros(model.nv), controller=law, times=(end,))

    world_a, motion_a = moved_by(a)
    start = a.v[0] if a.v is not None else _fitted_velocity(world_a, motion_a, a)
    own_runner = Runner(world_a, replace(motion_a, v=start), names[1], grid)
    # Each record has its own controls.
    first, motion_b = moved_by(b) if b.u is not None else (world_a, motion_a)
    runner = Runner(first, replace(motion_b, v=start), names[1], grid)

    def as_run(x: Record) -> Run:
        from scipy.interpolate import CubicSpline

        at = CubicSpline(x.t, x.q)(grid) if not np.array_equal(x.t, grid) else x.q
        full = layout.expand_q(at)
        return Run(model, {j.name: full[:, layout.full_q[j.name]] for j in layout.joints}, "")

    one, other = as_run(a), as_run(b)

    def left(world: World) -> Array:
        """Return how far the run of a world is from the second record, (K,); infinite where it cannot be run."""
        try:
            off: Array = runner.between(runner.of(world), other)[0].max(axis=1, initial=0.0)
            return off
        except (MbkitError, ArithmeticError):
            return np.full(len(grid), np.inf)

    apart, joints = runner.between(one, other)
    own = runner.between(own_runner.of(world_a), one)[0].max(axis=1, initial=0.0)
    tried = _tried(first, told, known, left)
    best = nearest(tried)
    beyond = apart > motion.bound if (apart > motion.bound).any() else apart > 0.1 * apart.max(initial=0.0)
    rows = np.where(beyond.any(axis=0), beyond.argmax(axis=0), len(grid))
    shown = joints[int(rows.argmin())] if joints and beyond.any() else ""
    rank = sorted((x for x in tried if x[0]), key=_worst)
    return RecordComparison(
        a=names[0],
        b=names[1],
        causes=tuple(h.sentence(names[1]) for h in best[0]),
        kinds=tuple(h.kind for h in best[0]),
        apart=float(apart.max(initial=0.0)),
        reproduced=float(own.max(initial=0.0)),
        residual=_worst(best),
        joint=shown,
        begins=float(grid[rows.min()]) if shown else np.nan,
        tried=tuple(TriedCause("; ".join(h.sentence(names[1]) for h in hs), _worst((hs, x))) for hs, x in rank[:12]),
        notes=tuple(notes),
        grid=tuple(grid.tolist()),
        over_time=tuple(apart.max(axis=1, initial=0.0).tolist()),
        residual_over_time=tuple(best[1].tolist()),
    )


#: Causes, and how far the first side with them is from the second record over time, (K,).
_Try = tuple[tuple[Hypothesis, ...], Array]


def _tried(
    first: World, told: Sequence[Hypothesis], known: Sequence[Hypothesis], left: Callable[[World], Array]
) -> list[_Try]:
    """Return what is left with no cause, with each one, with pairs, and with all that the files tell."""
    tried: list[_Try] = [((), left(first))]
    with Bar("records") as bar:
        for k, h in enumerate(known):
            bar(0.5 * k / len(known), h.kind)
            tried.append(((h,), left(h.apply(first))))
        near = [hs[0] for hs, _ in sorted(tried[1:], key=_worst)[:_MAX_IN_PAIRS]]
        # A step may say nothing until the integrator is the right one.
        pairs = [*combinations(near, 2), *((g, h) for g in near[:_MAX_WITH_ALL] for h in known if h not in near)]
        for k, (g, h) in enumerate(pairs):
            bar(0.5 + 0.5 * k / len(pairs), f"{g.kind} and {h.kind}")
            if {(c.where, *c.ours) for c in g.changes}.isdisjoint((c.where, *c.ours) for c in h.changes):
                tried.append(((g, h), left(h.apply(g.apply(first)))))
        if len(told) > 2:
            every = first
            for h in told:
                every = h.apply(every)
            tried.append((tuple(told), left(every)))
    return tried


def nearest(tried: Sequence[_Try]) -> _Try:
    """Return the causes that leave least; more causes only where they leave far less than fewer do."""
    best, *others = sorted(tried, key=lambda x: (len(x[0]), _worst(x)))
    for x in others:
        if _worst(x) < _worst(best) * (PAIR_GAIN if len(x[0]) > len(best[0]) else 1.0):
            best = x
    return best


def _fitted_velocity(world: World, motion: Motion, a: Record) -> Array:
    """Return the starting velocity whose run is nearest the first rows of a record."""
    from scipy.optimize import least_squares

    n = min(_ROWS_OF_START, len(a.t))
    motion, layout = replace(motion, times=(float(a.t[n - 1]),)), world.system.model.layout
    full = layout.expand_q(a.q[:n])
    rows = {j.name: full[:, layout.full_q[j.name]] for j in layout.joints}

    def off(v: Array) -> Array:
        run = Runner(world, replace(motion, v=v), "", a.t[:n]).of(world)
        return np.concatenate([(run.positions[name] - x).ravel() for name, x in rows.items()])

    slope = (a.q[1] - a.q[0]) / (a.t[1] - a.t[0])
    first = slope if len(slope) == layout.sizes[1] else np.zeros(layout.sizes[1])
    return np.asarray(least_squares(off, first, x_scale="jac", xtol=1e-12, ftol=1e-14, gtol=1e-14).x)


def _worst(x: tuple[Any, Array]) -> float:
    values = x[1]
    return float(np.inf if np.isnan(values).any() else values.max(initial=0.0))
