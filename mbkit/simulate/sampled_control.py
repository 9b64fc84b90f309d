"""Runs with a controller that samples: its torque is computed at equal times and held between them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, batch_of, real
from mbkit.engines import Dynamics
from mbkit.errors import InputError, TorqueError
from mbkit.methods.registry import method_of
from mbkit.simulate.integrate import acting_of, integrate, times_of
from mbkit.simulate.run_data import RunData
from mbkit.simulate.time_grid import Grid, save_times
from mbkit.simulate.torque import PiecewiseConstantTorque, Torque, TorqueCallback

#: Of a step: a hold that is no multiple of it is off by more.
_MULTIPLE = 1e-6


def integrate_held(
    dyn: Dynamics,
    q0: ArrayLike,
    v0: ArrayLike,
    duration: float,
    method: str,
    dt: float | None,
    rtol: float | None,
    atol: float | None,
    torque: Any,
    save: Any,
    progress: Any,
    events: Any,
    doubt: bool,
    t0: float | None,
    wrenches: Any,
    wrench_axes: str,
    *,
    hold: float,
) -> tuple[RunData, TorqueError | None]:
    """Return a run's data, and the error of a torque function that ended it; see `mbkit.simulate`.

    Each interval between two samples is a run of its own, from the state where the last one ended.
    """
    if not callable(torque):
        raise InputError("hold: expected a torque function, which is sampled; an array is held as it is")
    if events is not None:
        raise InputError("hold: events end a run within an interval; leave out events, or hold")
    if acting_of(dyn, wrenches, wrench_axes) and any(map(callable, wrenches.values())):
        raise InputError("hold: wrenches by functions are not sampled; give arrays, or leave out hold")
    hold, chosen, model = real("hold", hold, positive=True), method_of(method), dyn.model
    start, duration, step = times_of(dyn, chosen, t0, duration, dt)
    fixed = chosen.kind != "adaptive"
    if fixed and abs(hold / step - round(hold / step)) > _MULTIPLE:
        raise InputError(f"hold: expected a multiple of the step, {step:g} s, got {hold:g} s")
    q, v = model.check_q(q0, "q0"), model.check_v(v0, "v0")
    batch = batch_of(q0=q, v0=v)
    if batch is not None:
        q, v = np.broadcast_to(q, (batch, model.nq)), np.broadcast_to(v, (batch, model.nv))
    control = TorqueCallback(torque, model.nv)
    count = max(1, int(np.ceil(duration / hold - _MULTIPLE)))
    samples: Array = start + hold * np.arange(count, dtype=float)
    ends = np.append(samples[1:], start + duration)
    wanted = None if fixed or save is None else save_times(save, start, start + duration)
    grid = Grid.of(start, duration, step)
    # Tables of wrenches count from the start of the run.
    bounds = grid.times if fixed else wanted
    covered = bounds is not None and bounds[0] == start and bounds[-1] == start + duration
    pushed: Any = Torque(None, model, batch, len(bounds) - 1 if covered and bounds is not None else None, wrenches)
    pushed = pushed.applied(bounds)
    parts: list[RunData] = []
    rows: list[Array] = []
    starts: list[Array] = []
    failed: TorqueError | None = None
    for begin, end in zip(samples.tolist(), ends.tolist(), strict=True):
        try:
            row = _sampled(control, begin, q, v)
        except TorqueError as error:
            failed = error
            break
        length = end - begin
        if fixed:
            # The difference of two late times is rounded, and no multiple of the step.
            whole = round(length / step)
            length = whole * step if abs(length / step - whole) <= _MULTIPLE else length
        times = Grid.of(begin, length, step).times if fixed else _kept(wanted, begin, begin + length)
        steps = len(times) - 1
        starts.append(times[: max(steps, 1)])
        acting = np.zeros((*q.shape[:-1], len(starts[-1]), model.nv + 6 * len(wrenches or ())))
        if pushed is not None:
            acting += pushed.at(0.5 * (starts[-1] + times[-len(starts[-1]) :]))
        acting[..., : model.nv] = row[..., None, :]
        rows.append(acting)
        constant = batch is None and (pushed is None or pushed.starts is None)
        held = {
            name: acting[0, k : k + 6] if constant else acting[..., :steps, k : k + 6]
            for name, k in zip(wrenches or (), range(model.nv, acting.shape[-1], 6), strict=True)
        }
        torque = row if batch is None else acting[..., :steps, : model.nv]
        arguments = (q, v, length, method, dt, rtol, atol, torque, None if fixed else times, None, None, doubt, begin)
        data, _ = integrate(dyn, *arguments, held, wrench_axes)
        if data.stats.finished:
            # Where the next sample is taken.
            data = replace(data, t=np.append(data.t[:-1], end))
        parts.append(data)
        if callable(progress):
            progress(min(1.0, (end - start) / duration))
        if not data.stats.finished:
            break
        q, v = data.q[..., -1, :], data.v[..., -1, :]
    if not parts:
        assert failed is not None
        raise failed
    acted = PiecewiseConstantTorque(np.concatenate(rows, axis=-2), np.concatenate(starts))
    return _joined(parts, acted, failed, fixed, wanted, save, grid), failed


def _kept(wanted: Array | None, begin: float, end: float) -> Array:
    within = np.zeros(0) if wanted is None else wanted[(wanted > begin) & (wanted < end)]
    return np.concatenate([[begin], within, [end]])


def _sampled(control: TorqueCallback, t: float, q: Array, v: Array) -> Array:
    if q.ndim == 1:
        return control.one(t, q, v)
    return np.array([control.one(t, *state, member=i) for i, state in enumerate(zip(q, v, strict=True))])


def _joined(
    parts: list[RunData],
    acted: PiecewiseConstantTorque,
    failed: TorqueError | None,
    fixed: bool,
    wanted: Array | None,
    save: Any,
    grid: Grid,
) -> RunData:
    """Return the intervals as one run."""
    first, last = parts[0], parts[-1]
    # Each begins where the one before it ended.
    cut = [slice(None), *[slice(1, None)] * (len(parts) - 1)]
    t = np.concatenate([x.t[c] for x, c in zip(parts, cut, strict=True)])
    q, v = (np.concatenate([getattr(x, n)[..., c, :] for x, c in zip(parts, cut, strict=True)], -2) for n in "qv")
    which: Any = slice(None)
    if fixed and save is not None:
        which = grid.kept(save, q.shape[-1] + v.shape[-1])
        which = which[which < len(t)]
    elif wanted is not None:
        which = np.isin(t, wanted)
    stats = [x.stats for x in parts]
    message = last.stats.message if failed is None else f"stopped by the torque function after t = {t[-1]:.6g} s"
    added = ("steps", "evaluations", "seconds", "rejected", "jacobians")
    whole = replace(
        last.stats,
        **{name: sum(getattr(x, name) for x in stats) for name in added},
        ended=last.stats.ended if failed is None else "function_failed",
        message=message,
        chosen="",
        doubts=tuple(dict.fromkeys(one for x in stats for one in x.doubts)),
    )
    states = {"t": t[which], "q": q[..., which, :], "v": v[..., which, :]}
    events = tuple(sorted((hit for x in parts for hit in x.events), key=lambda hit: (hit.member or 0, hit.t)))
    return replace(first, **states, stats=whole, events=events, _applied=acted, _settings=None)
