"""What a description has that bears on runs: servos, forces that jump, limits, joints too fast for ordinary steps."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import EPS, Array, by_key
from mbkit.model import Model
from mbkit.model.description import LEFT_OUT, SERVOS
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.parts import Joint, rules_of
from mbkit.studies.compare.rows import ACTUATORS, LIMITS, STIFF, Finding
from mbkit.studies.results import counted

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
    kinds = {"joint.limit": "position", "joint.velocity_limit": "velocity", "joint.effort_limit": "effort"}
    # Kinds that the same joints have stand together.
    alike = by_key((model.acts[kind], word) for kind, word in kinds.items() if kind in model.acts)
    parts = [f"{', '.join(some)} of {counted(len(joints), 'joint')}" for joints, some in alike.items()]
    if not parts:
        return None
    every = tuple(dict.fromkeys(name for some in alike for name in some))
    return Finding(LIMITS, f"off here in every engine: {'; '.join(parts)}", every)


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
