"""Numbers of joints per independent velocity, and dry friction beside the other forces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.model.model import Model
from mbkit.model.parts import Joint, rules_of


class DryFriction(NamedTuple):
    """The dry friction of the joint where it is largest beside the other forces.

    Attributes
    ----------
    force : float
        N or Nm.
    joint, unit : str
    ratio : float
        To the median of the other forces of that joint; infinite where there are none.
    joints : tuple of str
        All joints with dry friction.
    """

    force: float
    joint: str
    unit: str
    ratio: float
    joints: tuple[str, ...]

    def __str__(self) -> str:
        beside = f"{self.ratio:.2g} times the other forces there" if np.isfinite(self.ratio) else "where no other acts"
        return f"{self.force:.3g} {self.unit} at {self.joint}, {beside}"


def dry_friction(model: Model, forces: Array) -> DryFriction | None:
    """Return the largest dry friction, or None without any.

    Parameters
    ----------
    model : Model
    forces : (N, nv) array
        Sum of the sizes of the other forces at some states.
    """
    friction = per_velocity(model, "friction")
    if not friction.any():
        return None
    other = np.median(forces, axis=0)
    with np.errstate(divide="ignore"):
        ratio = np.where(friction > 0, friction / np.where(friction > 0, other, 1.0), 0.0)
    worst = int(np.argmax(ratio))
    names = owners(model)
    joints = tuple(dict.fromkeys(name for name, f in zip(names, friction, strict=True) if f))
    return DryFriction(float(friction[worst]), names[worst], _unit(model, worst), float(ratio[worst]), joints)


def per_velocity(model: Model, name: str) -> Array:
    """Return numbers of joints per independent velocity.

    A mimic joint's count by the square of its ratio, as those of springs and dampers do, whose force grows with the
    ratio too; of dry friction by its size alone.
    """
    full = np.concatenate([np.zeros(0), *(getattr(j, name) for j in model.joints)])
    ratios = np.abs(model.layout.G) if name == "friction" else np.square(model.layout.G)
    return np.asarray(ratios.T @ full if model.layout.reduced else full)


def owners(model: Model) -> list[str]:
    """Return the joint of each independent velocity."""
    return [j.name for j in model.independent_joints for _ in range(j.type.nv)]


def _unit(model: Model, velocity: int) -> str:
    joint = [j for j in model.independent_joints for _ in range(j.type.nv)][velocity]
    turn, slide = rules_of(Joint)["friction"].unit.split(", ")
    return f"{slide} or {turn}" if joint.type.nv > 1 else slide if joint.type.lengths else turn
