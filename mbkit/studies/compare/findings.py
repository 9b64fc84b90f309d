"""What a description has that no engine of a comparison uses, and its joints that are too fast for ordinary steps."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Model
from mbkit.studies.compare.result import FRICTION, LIMITS, STIFF, Finding

#: The step of the rollouts, s.
STEP: Final = 1e-3


def findings(model: Model, forces: Array, M: Array, J: Array | None = None) -> tuple[Finding, ...]:
    """Return dry friction beside the other forces, limits, and stiff joints.

    Parameters
    ----------
    model : Model
    forces : (N, nv) array
        Sum of the sizes of gravity, velocity and passive forces at some states.
    M : (N, nv, nv) array
        Mass matrices there.
    J : (N, m, nv) array, optional
        Jacobians of the constraints there.
    """
    return tuple(x for x in (_friction(model, forces), _limits(model), *stiff_joints(model, M, J)) if x)


def _friction(model: Model, forces: Array) -> Finding | None:
    friction = _per_velocity(model, "friction")
    if not friction.any():
        return None
    other = np.median(forces, axis=0)
    with np.errstate(divide="ignore"):
        ratio = np.where(friction > 0, friction / np.where(friction > 0, other, 1.0), 0.0)
    worst = int(np.argmax(ratio))
    owners = _owners(model)
    joints = tuple(dict.fromkeys(name for name, f in zip(owners, friction, strict=True) if f))
    beside = f"{ratio[worst]:.2g} times the other forces there" if np.isfinite(ratio[worst]) else "where no other acts"
    says = (
        f"no engine applies it: {friction[worst]:.3g} {_unit(model, worst)} at {owners[worst]}, {beside} (gravity, "
        f"velocities, springs and dampers, at the median state); {_counted(len(joints))} in all"
    )
    return Finding(FRICTION, says, joints, float(ratio[worst]))


def _limits(model: Model) -> Finding | None:
    kinds = {"position": ("lower", "upper"), "velocity": ("velocity_limit",), "effort": ("effort_limit",)}
    having = {
        kind: [j.name for j in model.joints if any(np.isfinite(getattr(j, name)).any() for name in names)]
        for kind, names in kinds.items()
    }
    # Kinds that the same joints have stand together.
    alike: dict[tuple[str, ...], list[str]] = {}
    for kind, joints in having.items():
        if joints:
            alike.setdefault(tuple(joints), []).append(kind)
    parts = [f"{', '.join(some)} of {_counted(len(joints))}" for joints, some in alike.items()]
    if not parts:
        return None
    every = tuple(dict.fromkeys(name for some in alike for name in some))
    return Finding(LIMITS, f"no engine applies them: {'; '.join(parts)}", every)


def stiff_joints(model: Model, M: Array, J: Array | None = None) -> list[Finding]:
    """Return the joints whose own damper or spring is faster than a step of 1 ms, the fastest first.

    With all others free, a joint's velocity decays by its damper at the rate d (M⁻¹)ⱼⱼ, and swings by its spring at
    √(k (M⁻¹)ⱼⱼ). Constraints take the place of M⁻¹ by the mobility that they leave.
    """
    damping, stiffness = _per_velocity(model, "damping"), _per_velocity(model, "stiffness")
    if not (damping.any() or stiffness.any()):
        return []
    mobility = np.max([np.diag(_mobility(*x)) for x in zip(M, [None] * len(M) if J is None else J, strict=True)], 0)
    out = []
    for what, rates in (("damping", damping * mobility), ("stiffness", np.sqrt(stiffness * mobility))):
        for j, (joint, rate) in enumerate(zip(_owners(model), rates, strict=True)):
            if rate * STEP > 1.0:
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
        free = rows[int((sizes > len(M) * np.finfo(float).eps * sizes[0]).sum()) :].T
    try:
        return free @ np.linalg.solve(free.T @ M @ free, free.T)
    except np.linalg.LinAlgError:
        return np.zeros_like(M)


def _per_velocity(model: Model, name: str) -> Array:
    """Return numbers of joints per independent velocity.

    A mimic joint's count by the square of its ratio, as those of springs and dampers do, whose force grows with the
    ratio too; of dry friction by its size alone.
    """
    full = np.concatenate([np.zeros(0), *(getattr(j, name) for j in model.joints)])
    ratios = np.abs(model.layout.G) if name == "friction" else np.square(model.layout.G)
    return np.asarray(ratios.T @ full if model.layout.reduced else full)


def _owners(model: Model) -> list[str]:
    return [j.name for j in model.independent_joints for _ in range(j.type.nv)]


def _unit(model: Model, velocity: int) -> str:
    joint = [j for j in model.independent_joints for _ in range(j.type.nv)][velocity]
    return "N or N m" if joint.type.nv > 1 else "N" if joint.type.lengths else "N m"


def _counted(n: int) -> str:
    return f"{n} joint{'s' * (n != 1)}"
