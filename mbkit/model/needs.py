"""What a description needs from an engine, so that the rest can be left out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np

from mbkit._check import Array
from mbkit.model.parts import Joint, JointCoupling, Loop, PointSpring, Prescribed

__all__ = ["Needs"]


@dataclass(frozen=True)
class Needs:
    """One flag per feature; True where the description has it.

    Friction, limits (of coordinates, and of efforts and velocities) and loops are kept
    as data and named here; the smooth terms of every engine leave friction and limits out.
    """

    gravity: bool
    springs: bool
    damping: bool
    armature: bool
    friction: bool
    limits: bool
    effort_limits: bool
    mimic: bool
    loops: bool
    quaternions: bool
    time: bool

    @classmethod
    def of(
        cls,
        gravity: Array,
        joints: Iterable[Joint],
        springs: Iterable[PointSpring],
        couplings: Iterable[JointCoupling],
        loops: Iterable[Loop],
        prescribed: Iterable[Prescribed],
        bound: Iterable[str] = (),
    ) -> Needs:
        """Read the flags off the parts of a description.

        `bound` names the attributes that stand for parameters somewhere: what is
        zero now may have another value when it is evaluated.
        """
        joints, bound = tuple(joints), frozenset(bound)
        couplings = tuple(couplings)
        between: tuple[PointSpring | JointCoupling, ...] = (*springs, *couplings)
        return cls(
            gravity="gravity" in bound or bool(np.any(gravity)),
            springs="stiffness" in bound
            or any(np.any(j.stiffness) for j in joints)
            or any(s.stiffness for s in between),
            damping="damping" in bound or any(np.any(j.damping) for j in joints) or any(s.damping for s in between),
            armature="armature" in bound
            or any(np.any(j.armature) for j in joints)
            or any(c.armature for c in couplings),
            friction=any(np.any(j.friction) for j in joints),
            limits=any(np.any(np.isfinite([j.lower, j.upper])) for j in joints),
            effort_limits=any(np.any(np.isfinite([j.effort_limit, j.velocity_limit])) for j in joints),
            mimic=any(j.mimic is not None for j in joints),
            loops=bool(tuple(loops)),
            quaternions=any(j.type.quaternion is not None for j in joints),
            time=bool(tuple(prescribed)),
        )

    def as_dict(self) -> dict[str, bool]:
        """Return the flags by name."""
        return asdict(self)

    def __str__(self) -> str:
        present = [k for k, on in self.as_dict().items() if on]
        absent = [k for k, on in self.as_dict().items() if not on]
        return f"has {', '.join(present) or 'nothing'}; without {', '.join(absent) or 'nothing'}"
