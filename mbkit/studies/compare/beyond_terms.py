"""What `compare` does beyond terms: rollouts, and what a scene does not need.

Rollouts compare mbkit's integrators on each engine with MuJoCo's own, step for step. Two right programs round
differently in every step, and a system multiplies that, a chaotic one without bound. So each rollout's condition is
measured beside it: how far q moves when the forces are disturbed in every step, relative to |M||a| + |nle|, the size
at which any backward-stable program rounds them. Over examples from 1 to 1e7 two engines differed by 2 to 125 eps times
that number. What may differ is a multiple of it, and the comparison ends where that would say little.

What a description has that bears on runs: servos, forces that jump, limits, joints too fast for ordinary steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from mbkit._check import EPS, Array, by_key
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.registry import DERIVED, MUJOCO, PINOCCHIO, find_engine
from mbkit.methods.registry import ADAPTIVE_METHOD, DEFAULT_METHOD, EULER_METHOD, METHODS
from mbkit.model import Model
from mbkit.model.description import LEFT_OUT, SERVOS
from mbkit.model.elements.kinds import EFFECTS, PART_KINDS, kind, that_do
from mbkit.model.parts import Joint, rules_of
from mbkit.simulate import Trajectory
from mbkit.studies.compare.errors import ROUNDINGS, interleaved
from mbkit.studies.compare.terms import ACTUATORS, LIMITS, STIFF, Finding, Omission, RolloutRow
from mbkit.studies.results import counted
from mbkit.studies.study_runs import quiet_simulate, runs_to_limits, start_state, state_within_limits

#: The step of the rollouts, s.
STEP: Final = 1e-3


def findings(model: Model, forces: Array, M: Array, J: Array | None = None) -> tuple[Finding, ...]:
    """Return what the file has and is left out, forces that jump beside the other forces, limits, and stiff joints.

    `forces` are the sums of the sizes of gravity, velocity and passive forces at some states, (N, nv), `M` and `J` the
    mass matrices and the Jacobians of the constraints there, (N, nv, nv) and (N, m, nv).
    """
    noted = [
        Finding(ACTUATORS if x.startswith(SERVOS) else LEFT_OUT, x.removeprefix(LEFT_OUT).lstrip(": "), ())
        for x in model.notes
        if x.startswith((SERVOS, LEFT_OUT))
    ]
    return tuple(x for x in (*noted, _largest_jump(model, forces), _limits(model), *stiff_joints(model, M, J)) if x)


def _largest_jump(model: Model, forces: Array) -> Finding | None:
    (name,) = Joint.adding_to("jump")
    size, other = model.per_velocity(name), np.median(forces, axis=0)
    if not size.any():
        return None
    with np.errstate(divide="ignore"):
        ratios = np.where(size > 0, size / np.where(size > 0, other, 1.0), 0.0)
    worst, names = int(np.argmax(ratios)), model.velocity_joints
    joint, ratio = model.joint(names[worst]), float(ratios[worst])
    turn, slide = rules_of(Joint)[name].unit.split(", ")
    unit = f"{slide} or {turn}" if joint.type.nv > 1 else slide if joint.type.lengths else turn
    beside = f"{ratio:.2g} times the other forces there" if np.isfinite(ratio) else "where no other acts"
    joints = tuple(dict.fromkeys(name for name, x in zip(names, size, strict=True) if x))
    says = (
        f"{size[worst]:.3g} {unit} at {joint.name}, {beside} (gravity, velocities, springs and dampers, at the median "
        f"state); {counted(len(joints), 'joint')} in all"
    )
    return Finding(EFFECTS["jump"], says, joints, ratio)


def _limits(model: Model) -> Finding | None:
    # What the same joints have stands together, and a finer kind with its own.
    there = [x for x in that_do("bound", "joints") if x in model.acts and x.rpartition(".")[0] not in PART_KINDS]
    alike = by_key((model.acts[x], kind(x).words.rpartition("has ")[2]) for x in there)
    parts = [f"{', '.join(some)} at {counted(len(joints), 'joint')}" for joints, some in alike.items()]
    if not parts:
        return None
    every = tuple(dict.fromkeys(name for some in alike for name in some))
    off = "stops in terms, and off in runs" if model.needs.stops else "off here in every engine"
    return Finding(LIMITS, f"{off}: {'; '.join(parts)}", every)


def reached_limits(model: Model, engines: Mapping[str, Dynamics], seed: int) -> str:
    """Return how many free motions reach a limit, which first, and how far rigid stops move that one; "" if unknown."""
    moving, stopping = (next(x for x in (own, *engines) if x in engines) for own in (DERIVED, PINOCCHIO))
    run, reached = runs_to_limits(engines[moving], DURATION, seed)
    # Motions may be too fast for the step.
    if not np.isfinite(run.q).all() or run.t[-1] < DURATION:
        return ""
    says = f"; {len(reached)} of {len(run.q)} motions of {DURATION:g} s from random states within them reach one"
    for t, i, k in reached[:1]:
        dyn = dynamics(model.with_stops(), stopping, **find_engine(stopping).brief)
        t10, (q, v) = run.t[::10], (x[i, ::10] for x in (run.q, run.v))
        stopped = quiet_simulate(dyn, q[0], v[0], DURATION, ADAPTIVE_METHOD, rtol=_STOPPED, save=t10)
        off = np.abs(model.difference(q[: len(stopped.t)], stopped.q)).max()
        says += f", {model.coordinate_names[k]} first, after {t:.2g} s; rigid stops move that one by {off:.2g} rad or m"
    return says


def stiff_joints(model: Model, M: Array, J: Array | None = None, step: float = STEP) -> list[Finding]:
    """Return the joints whose own damper or spring is faster than a step, s, the fastest first.

    With all others free, a joint's velocity decays by its damper at the rate d (M⁻¹)ⱼⱼ, and swings by its spring at
    √(k (M⁻¹)ⱼⱼ). Constraints take the place of M⁻¹ by the mobility that they leave.
    """
    damping, stiffness = model.per_velocity("damping"), model.per_velocity("stiffness")
    if not (damping.any() or stiffness.any()):
        return []
    mobility = np.max([np.diag(_mobility(*x)) for x in zip(M, [None] * len(M) if J is None else J, strict=True)], 0)
    out = []
    for what, rates in (("damping", damping * mobility), ("stiffness", np.sqrt(stiffness * mobility))):
        for j, (joint, rate) in enumerate(zip(model.velocity_joints, rates, strict=True)):
            if rate * step > 1.0:
                of = f"{what} over inertia is {rate:.2g} 1/s" if what == "damping" else f"it swings at {rate:.2g} rad/s"
                value = (damping if what == "damping" else stiffness)[j]
                says = (
                    f"{joint}: {of}, a time constant of {1e3 / rate:.2g} ms ({what} {value:.3g}); take a shorter step, "
                    "or a method for stiff systems"
                )
                out.append(Finding(STIFF, says, (joint,), 1 / rate))
    return sorted(out, key=lambda x: x.size)


def _mobility(M: Array, J: Array | None) -> Array:
    """Return M⁻¹, or what constraints leave of it; zero where M is singular, which has findings of its own."""
    free = np.eye(len(M))
    if J is not None and len(J):
        _, sizes, rows = np.linalg.svd(J)
        free = rows[int((sizes > len(M) * EPS * sizes[0]).sum()) :].T
    try:
        return free @ np.linalg.solve(free.T @ M @ free, free.T)
    except np.linalg.LinAlgError:
        return np.zeros_like(M)


DURATION: Final = 1.0
#: Tolerance of a run of which two digits are told.
_STOPPED: Final = 1e-6
TOLERANCE: Final = 1e-12
#: The largest difference of two engines over eps times the condition.
_MAX_ROUNDINGS: Final = 256.0
#: Beyond this condition a comparison could not see an error below 1e-9.
_MAX_CONDITION: Final = 1e-9 / (_MAX_ROUNDINGS * EPS)
_RELATIVE_DISTURBANCE: Final = 1e-8
#: A rollout with fewer well-conditioned steps says nothing.
_MIN_JUDGED_STEPS: Final = 50
#: MuJoCo's own method of the same formula.
_NATIVE: Final = {m.own: m.name for m in METHODS.values() if m.own}


def rollouts(model: Model, engines: Mapping[str, Dynamics], seed: int, note: str) -> tuple[RolloutRow, ...]:
    """Compare trajectories of 1 s at 1 ms of MuJoCo and other engines, for rk4 and semi-implicit Euler."""
    ours_on = [name for name in (PINOCCHIO, DERIVED) if name in engines]
    if model.constrained:
        # Where loops are rigid the motion is another one: the same formula on the same soft accelerations is compared.
        ours_on = [MUJOCO]
        note = "; ".join(x for x in (note, "on MuJoCo's own accelerations, whose loops are soft") if x)
    if MUJOCO not in engines or not ours_on:
        return ()
    rows: list[RolloutRow] = []
    q0, v0 = start_state(model, seed)
    for method in (DEFAULT_METHOD, EULER_METHOD):
        native = _NATIVE[method]
        theirs = quiet_simulate(engines[MUJOCO], q0, v0, DURATION, native, STEP)
        condition = _condition(engines[MUJOCO], engines[ours_on[0]], native, theirs)
        # The last step before the condition says too little.
        last = int(next(iter(np.flatnonzero(condition > _MAX_CONDITION)), len(condition))) - 1
        own: list[tuple[RolloutRow, Trajectory]] = []
        for name in ours_on:
            # One step first: compiling it is not run time.
            quiet_simulate(engines[name], q0, v0, STEP, method, STEP)
            ours = quiet_simulate(engines[name], q0, v0, STEP * last, method, STEP)
            # How far their formulas for M amplify rounding along the run.
            places = [(engines[x], theirs.q[k]) for x in (MUJOCO, name) for k in (0, (last + 1) // 2, last)]
            amplified = max(dyn._mass_matrix_rounding(q) for dyn, q in places)
            grown = condition[: last + 1], last + 1 < len(condition)
            own.append((_row(engines[name], ours, theirs, *grown, amplified, note), ours))
        rows += _blamed(model, own)
    if model.needs.damping:
        rows.append(_implicit_damping(model, engines[MUJOCO], q0, v0))
    return tuple(rows)


def _blamed(model: Model, own: Sequence[tuple[RolloutRow, Trajectory]]) -> Iterator[RolloutRow]:
    """Yield the rows; where all differ from MuJoCo's run and not from each other, MuJoCo's is the one that is off."""
    (first, run), *others = own
    n = min(len(x.t) for _, x in own)
    apart = max((float(np.abs(model.difference(run.q[:n], x.q[:n])).max()) for _, x in others), default=np.inf)
    alone = all(row.passed is False for row, _ in own) and apart <= first.tolerance
    for row, _ in own:
        says = f"{' and '.join(x.engine for x, _ in own)} agree with each other to {apart:.1e}"
        yield replace(row, off=MUJOCO, note="; ".join(x for x in (row.note, says) if x)) if alone else row


def _condition(mujoco: Dynamics, own: Dynamics, native: str, straight: Trajectory) -> Array:
    """Return the condition of the rollout up to each step."""
    model, q, v = mujoco.model, straight.q, straight.v
    M, a = own.mass_matrix(q), own.forward_dynamics(q, v, np.zeros(model.nv))
    size = np.einsum("nij,nj->ni", np.abs(M), np.abs(a)) + np.abs(own.nle(q, v))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size[:-1].shape)
    disturbance = _RELATIVE_DISTURBANCE * size[:-1] * signs
    for joint in model.independent_joints:
        if joint.type.floating:
            # MuJoCo holds such a force in other axes; the torques disturb enough.
            start = model.layout.v[joint.name].start
            disturbance[:, start : start + 3] = 0.0
    steps = len(disturbance)
    bent, _ = mujoco.rollout(native.removeprefix("mujoco_"), q[0], v[0], STEP, disturbance, steps)  # type: ignore[attr-defined]
    off = np.abs(model.difference(q, np.where(np.isfinite(bent), bent, q))).max(axis=1) / _RELATIVE_DISTURBANCE
    off[~np.isfinite(bent).all(axis=1)] = np.inf
    return np.asarray(np.maximum.accumulate(off))


def _row(
    dyn: Dynamics, ours: Trajectory, theirs: Trajectory, condition: Array, beyond: bool, amplified: float, note: str
) -> RolloutRow:
    """Return two runs compared up to the last step that has a condition; beyond it may have grown too much.

    `amplified` is what the formulas of M must lose, which the accelerations, and so the runs, cannot do without.
    """
    model, q0 = dyn.model, theirs.q[:1]
    last = len(condition) - 1
    n = min(len(ours.t), last + 1)
    grown = float(condition[:n].max(initial=0.0))
    tolerance = max(TOLERANCE, max(_MAX_ROUNDINGS, ROUNDINGS * amplified) * EPS * grown)
    error = float(np.abs(model.difference(theirs.q[:n], ours.q[:n])).max()) if n > 1 else 0.0
    notes = [note] if note else []
    if n <= last:
        notes.append(f"stopped at t = {ours.t[-1]:.3g} s: {ours.stats.message}")
    judged = last >= _MIN_JUDGED_STEPS
    if last < round(DURATION / STEP):
        grows = f"beyond it rounding errors have grown above {_MAX_ROUNDINGS * EPS * _MAX_CONDITION:.0e} of q"
        why = grows if beyond else "MuJoCo's own run diverges there"
        notes.append(f"{'judged' if judged else 'not judged: well conditioned'} up to {last * STEP:.3g} s alone; {why}")
        J = dyn.constraint_jacobian(q0) if model.constrained else None
        stiff = stiff_joints(model, dyn.mass_matrix(q0), J)
        notes += [f"stiff: {stiff[0].says}"] if stiff else []
    return RolloutRow(
        method=ours.method,
        engine=ours.engine,
        against=theirs.method,
        dt=STEP,
        duration=(n - 1) * STEP,
        error=error,
        condition=grown,
        tolerance=tolerance,
        steps=n - 1,
        seconds=ours.stats.seconds,
        seconds_against=theirs.stats.seconds,
        passed=(n > last and error <= tolerance) if judged else None,
        note="; ".join(notes),
        judged=judged,
        asked=DURATION,
    )


def _implicit_damping(model: Model, dyn: Dynamics, q0: Array, v0: Array) -> RolloutRow:
    """Compare with MuJoCo's default Euler, whose damping is implicit: another formula."""
    steps = round(DURATION / STEP)
    begun = quiet_simulate(dyn, q0, v0, DURATION, _NATIVE[EULER_METHOD], STEP)
    q, _ = dyn.rollout("euler", q0, v0, STEP, None, steps, euler_damping=True)  # type: ignore[attr-defined]
    n = int(min(len(begun.t), np.isfinite(q).all(axis=1).sum()))
    difference = float(np.abs(model.difference(begun.q[:n], q[:n])).max())
    return RolloutRow(
        method="mujoco_euler, damping explicit",
        engine=MUJOCO,
        against="mujoco_euler, damping implicit (MuJoCo's default)",
        dt=STEP,
        duration=(n - 1) * STEP,
        error=difference,
        condition=float("nan"),
        tolerance=float("inf"),
        steps=n - 1,
        seconds=begun.stats.seconds,
        seconds_against=float("nan"),
        passed=None,
        judged=False,
        note="for information: by default MuJoCo solves (M + h D) a = f, a first-order change; mbkit switches that off",
    )


# Omissions: parts that a scene does not need, the time that leaving them out saves, and that nothing changes.

# Accelerations of the same model with one more feature compiled in differ by the
# order of a few sums, amplified by the conditioning that both share.
_MAX_UNCHANGED: Final = 1e-9

_JUMP: Final = EFFECTS["jump"]
#: Need, field of Needs or effect, MuJoCo's bits, what was off.
_NEEDS: Final = (
    ("geometry", "", (), "meshes and shapes never opened (measured with one small sphere on each body)"),
    ("contacts", "", ("CONTACT", "CONSTRAINT"), "collision detection and contact forces (with the same spheres)"),
    ("limits", "limits", ("LIMIT", "CONSTRAINT"), "joint limits kept as data; no limit rows, no constraint solver"),
    (_JUMP, "jump", ("FRICTIONLOSS", "CONSTRAINT"), f"MuJoCo's soft {_JUMP}; no constraint solver"),
    ("damping", "damping", ("DAMPER",), "dampers"),
    ("springs", "springs", ("SPRING",), "springs"),
    ("gravity", "gravity", ("GRAVITY",), "gravity"),
    ("loops", "loops", ("EQUALITY", "CONSTRAINT"), "loop closures and equality rows"),
)
#: Needs that are on where the description has them.
_KEPT: Final = ("damping", "springs", "gravity", "loops")


def omissions(model: Model, engines: Mapping[str, Dynamics], seed: int) -> tuple[Omission, ...]:
    """Return one row per need, measured on the engines at hand."""
    # Within the limits, where none of them acts but those that a mechanism's loops lead to.
    q, v = state_within_limits(model, np.random.default_rng([seed, 2]))
    rows = _in_mujoco(model, engines[MUJOCO], q, v) if MUJOCO in engines else []
    return (*rows, *([_coriolis(model, q, v)] if DERIVED in engines else []))


def _in_mujoco(model: Model, dyn: Any, q: Array, v: Array) -> list[Omission]:
    from mbkit.engines.mujoco.engine import Variant

    needs = model.needs.as_dict() | {"jump": model.needs.friction}
    variants = {
        need: Variant(dyn, bits, spheres=not field)
        for need, field, bits, _ in _NEEDS
        if not (need in _KEPT and needs[field])
    }
    lean = Variant(dyn)
    reference = lean.accelerations(q, v)
    # Where nothing accelerates, what turning at v would ask for is the measure.
    scale = max(float(np.abs(reference).max(initial=0.0)), float(v @ v))
    changes = {
        need: float(np.abs(variant.accelerations(q, v) - reference).max(initial=0.0)) / scale
        for need, variant in variants.items()
    }
    times = interleaved({"lean": lean.forward} | {n: x.forward for n, x in variants.items()}, rounds=15)
    rows = []
    for need, field, _, what in _NEEDS:
        if need not in variants:
            unmeasured = (math.nan,) * 4
            rows.append(Omission(need, True, "needed, so it is on", *unmeasured, unchanged=True))
            continue
        present = bool(field) and needs[field]
        saved = times[need][0] - times["lean"][0]
        spread = math.hypot(times[need][1], times["lean"][1])
        # A part that is there and off would act: leaving it out is a choice, said aloud, and no engine's fault.
        instead = f"without it mbkit's exact {_JUMP} acts" if need == _JUMP else ""
        instead = f"without it mbkit's {EFFECTS['stop']} act" if need == "limits" and model.needs.stops else instead
        note = instead or "it is off in every engine, so that the smooth terms compare" if present else ""
        unchanged = changes[need] <= _MAX_UNCHANGED
        rows.append(Omission(need, present, what, saved, spread, math.nan, changes[need], unchanged, note))
    return rows


def _coriolis(model: Model, q: Array, v: Array) -> Omission:
    """Measure the Coriolis matrix, derived only when somebody asks for it."""
    from mbkit.codegen.backend import Machine
    from mbkit.derivation import equations_of

    equations = equations_of(model)
    nle = Machine(equations.function("coriolis_force"))
    start = time.perf_counter()
    matrix = Machine(equations.function("coriolis_matrix"))
    setup = time.perf_counter() - start
    # The time alone is left of the parameters of a model with values.
    held = [np.array(list(model.parameters.values()), dtype=float)] if model.parameters else []
    times = interleaved({"matrix": lambda: matrix(q, v, *held), "nle": lambda: nle(q, v, *held)})
    force, M = nle(q, v, *held)[0][:, 0], Machine(equations.function("mass_matrix"))(q, *held)[0]
    scale = max(float(np.linalg.norm(force)), float(np.linalg.norm(M, 2) * (v @ v)))
    change = float(np.linalg.norm(matrix(q, v, *held)[0] @ v - force)) / scale
    return Omission(
        "Coriolis matrix",
        False,
        "C(q, v) is derived only on demand; C v comes without it",
        times["matrix"][0] - times["nle"][0],
        math.hypot(times["matrix"][1], times["nle"][1]),
        setup,
        change,
        change <= _MAX_UNCHANGED,
    )
