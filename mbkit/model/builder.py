"""`ModelBuilder`: write a system down, and get every fault of it at once."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit.errors import InputError, ModelError, NonPhysicalWarning, nearest
from mbkit.model.arguments import ArgumentReader, shape_of
from mbkit.model.kinds import KINDS, kind_of
from mbkit.model.model import Model
from mbkit.model.parts import Body, Frame, Joint, Loop, Mimic, PointSpring, Prescribed
from mbkit.model.physical import body_fault, idle_joints
from mbkit.model.structure import structure_faults

__all__ = ["ModelBuilder"]


class ModelBuilder:
    """Collects bodies, joints and forces, and builds a frozen `Model` of them.

    A faulty call is remembered and not raised: `build` reports all faults in one
    `ModelError`. Parts may be declared in any order; coordinates follow the
    order in which the joints are declared.

    Parameters
    ----------
    name : str
        Name of the system.
    gravity : (3,) array_like
        m/s², in world axes.

    Examples
    --------
    >>> import mbkit as mb
    >>> b = mb.ModelBuilder("pendulum")
    >>> b.add_body("bob", mass=1.0, com=(0, 0, -1.0))
    >>> b.add_joint("hinge", "revolute", parent="world", child="bob", axis=(0, 1, 0))
    >>> b.build().nv
    1
    """

    def __init__(self, name: str, gravity: ArrayLike = (0.0, 0.0, -9.81)) -> None:
        self._name = str(name)
        self._read = ArgumentReader()
        self._gravity = self._read.vector("gravity", gravity, 3)
        self._bodies: list[Body] = []
        self._joints: list[Joint] = []
        self._frames: list[Frame] = []
        self._springs: list[PointSpring] = []
        self._loops: list[Loop] = []
        self._prescribed: list[Prescribed] = []
        self._notes: list[str] = []

    def add_body(
        self, name: str, *, mass: float = 0.0, com: ArrayLike = (0.0, 0.0, 0.0), inertia: ArrayLike | None = None
    ) -> None:
        """Add a rigid body.

        Parameters
        ----------
        name : str
        mass : float
            kg; zero for a mere frame.
        com : (3,) array_like
            Centre of mass in body axes, m.
        inertia : (3, 3) or (3,) array_like, optional
            About the centre of mass, in body axes (or its diagonal), kg m².
            Without it the body is a point mass.
        """
        who = f"body {name!r}"
        raw = np.zeros((3, 3)) if inertia is None else inertia
        if shape_of(raw) == (3,):
            matrix = np.diag(self._read.vector(f"{who}: inertia", raw, 3))
        else:
            matrix = self._read.matrix(f"{who}: inertia", raw)
            if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
                self._read.faults.append(f"{who}: inertia is not symmetric; expected I = Iᵀ")
            matrix = (matrix + matrix.T) / 2
        self._bodies.append(
            Body(str(name), self._read.real(f"{who}: mass", mass), self._read.vector(f"{who}: com", com, 3), matrix)
        )

    def add_joint(
        self,
        name: str,
        kind: str,
        *,
        parent: str,
        child: str,
        translation: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        rpy: ArrayLike | None = None,
        axis: ArrayLike | None = None,
        axis2: ArrayLike | None = None,
        pitch: float = 0.0,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        velocity_limit: ArrayLike | None = None,
        effort_limit: ArrayLike | None = None,
        armature: ArrayLike = 0.0,
        damping: ArrayLike = 0.0,
        friction: ArrayLike = 0.0,
        stiffness: ArrayLike = 0.0,
        rest: ArrayLike = 0.0,
        mimic: Mimic | tuple[str, float, float] | None = None,
    ) -> None:
        """Add the joint that carries `child`.

        Parameters
        ----------
        name, kind : str
            `kind` is one of fixed, revolute, continuous, prismatic, helical,
            universal, spherical_zyx, ball, planar, free.
        parent, child : str
            Names of bodies; `parent` may be ``"world"``.
        translation : (3,) array_like
            Origin of the joint's frame in the parent's axes, m.
        rotation, rpy : (3, 3) or (3,) array_like, optional
            Orientation of the joint's frame in the parent: a matrix, or URDF's
            roll, pitch, yaw in rad. At most one of the two.
        axis, axis2 : (3,) array_like, optional
            Axes in the joint's frame; normalized here. A universal joint takes
            two; ball, planar, spherical_zyx and free take none.
        pitch : float
            Helical: metres per radian.
        lower, upper : float or (nq,) array_like, optional
            Limits of the coordinates; data, not dynamics.
        velocity_limit, effort_limit, friction : float or (nv,) array_like
            Data, not dynamics.
        armature : float
            Added to M's diagonal, kg m² (kg for a prismatic joint); joints of one
            velocity only.
        damping : float or (nv,) array_like
            N m s/rad (N s/m).
        stiffness, rest : float or (nv,) array_like
            Joint spring, torque -stiffness (q - rest); not for ball and free joints.
        mimic : Mimic or (joint, ratio, offset), optional
            The joint that this one follows.
        """
        who = f"joint {name!r}"
        if not isinstance(kind, str) or kind not in KINDS:
            near = nearest(str(kind), KINDS) or list(KINDS)
            self._read.faults.append(f"{who}: unknown kind {kind!r}; use one of {', '.join(near)}")
            # The other faults of this call would only be echoes of this one.
            kind, axis, axis2, pitch, mimic = "fixed", None, None, 0.0, None
            lower = upper = velocity_limit = effort_limit = None
            armature = damping = friction = stiffness = rest = 0.0
        type_ = kind_of(kind)
        if mimic is not None and not isinstance(mimic, Mimic):
            mimic = self._read.mimic(who, mimic)
        self._joints.append(
            Joint(
                name=str(name),
                kind=kind,
                parent=str(parent),
                child=str(child),
                rotation=self._read.rotation(who, rotation, rpy),
                translation=self._read.vector(f"{who}: translation", translation, 3),
                axes=self._read.axes(who, kind, axis, axis2),
                pitch=self._read.real(f"{who}: pitch", pitch),
                lower=self._read.limits(f"{who}: lower", lower, type_.nq, -np.inf),
                upper=self._read.limits(f"{who}: upper", upper, type_.nq, np.inf),
                velocity_limit=self._read.limits(f"{who}: velocity_limit", velocity_limit, type_.nv, np.inf),
                effort_limit=self._read.limits(f"{who}: effort_limit", effort_limit, type_.nv, np.inf),
                armature=self._read.vector(f"{who}: armature", armature, type_.nv),
                damping=self._read.vector(f"{who}: damping", damping, type_.nv),
                friction=self._read.vector(f"{who}: friction", friction, type_.nv),
                stiffness=self._read.vector(f"{who}: stiffness", stiffness, type_.nv),
                rest=self._read.vector(f"{who}: rest", rest, type_.nv),
                mimic=mimic,
            )
        )

    def add_frame(
        self,
        name: str,
        *,
        body: str,
        translation: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        rpy: ArrayLike | None = None,
    ) -> None:
        """Name a frame that is fixed to a body, for poses and Jacobians."""
        who = f"frame {name!r}"
        place = self._read.vector(f"{who}: translation", translation, 3)
        self._frames.append(Frame(str(name), str(body), self._read.rotation(who, rotation, rpy), place))

    def add_spring(
        self,
        name: str,
        *,
        body_a: str,
        body_b: str,
        point_a: ArrayLike = (0.0, 0.0, 0.0),
        point_b: ArrayLike = (0.0, 0.0, 0.0),
        stiffness: float = 0.0,
        rest_length: float = 0.0,
        damping: float = 0.0,
    ) -> None:
        """Add a spring and damper along the line between two points.

        Parameters
        ----------
        name : str
        body_a, body_b : str
            Names of bodies, or ``"world"``.
        point_a, point_b : (3,) array_like
            In the axes of the two bodies, m.
        stiffness : float
            N/m.
        rest_length : float
            m.
        damping : float
            N s/m, on the rate of the distance.
        """
        who = f"spring {name!r}"
        self._springs.append(
            PointSpring(
                str(name),
                str(body_a),
                self._read.vector(f"{who}: point_a", point_a, 3),
                str(body_b),
                self._read.vector(f"{who}: point_b", point_b, 3),
                self._read.real(f"{who}: stiffness", stiffness, nonnegative=True),
                self._read.real(f"{who}: rest_length", rest_length, nonnegative=True),
                self._read.real(f"{who}: damping", damping, nonnegative=True),
            )
        )

    def add_loop(
        self,
        name: str,
        kind: Literal["point", "frame"],
        *,
        body_a: str,
        body_b: str,
        translation_a: ArrayLike = (0.0, 0.0, 0.0),
        rotation_a: ArrayLike | None = None,
        translation_b: ArrayLike = (0.0, 0.0, 0.0),
        rotation_b: ArrayLike | None = None,
    ) -> None:
        """Close a loop: two points, or two frames, of two bodies stay together."""
        who = f"loop {name!r}"
        if kind not in ("point", "frame"):
            self._read.faults.append(f"{who}: unknown kind {kind!r}; use 'point' or 'frame'")
        self._loops.append(
            Loop(
                str(name),
                kind,
                str(body_a),
                self._read.rotation(who, rotation_a, None),
                self._read.vector(f"{who}: translation_a", translation_a, 3),
                str(body_b),
                self._read.rotation(who, rotation_b, None),
                self._read.vector(f"{who}: translation_b", translation_b, 3),
            )
        )

    def prescribe(
        self,
        joint: str,
        *,
        offset: float = 0.0,
        rate: float = 0.0,
        amplitude: float = 0.0,
        frequency: float = 0.0,
        phase: float = 0.0,
    ) -> None:
        """Move a one-velocity joint in time: offset + rate t + amplitude sin(frequency t + phase)."""
        names = ("offset", "rate", "amplitude", "frequency", "phase")
        values = (offset, rate, amplitude, frequency, phase)
        numbers = [self._read.real(f"prescribed {joint!r}: {n}", x) for n, x in zip(names, values, strict=True)]
        self._prescribed.append(Prescribed(str(joint), *numbers))

    def note(self, text: str) -> None:
        """Keep a sentence for whoever reads the model."""
        self._notes.append(text)

    def build(self, *, nonphysical: Literal["error", "warn"] = "error", point_masses: bool = True) -> Model:
        """Check everything and return the frozen model.

        Parameters
        ----------
        nonphysical : {"error", "warn"}
            What to do about bodies that no matter can have (an inertia that is
            not positive or violates the triangle inequality, joints that move no
            inertia): raise, or keep them as written and warn.
        point_masses : bool
            Whether a mass without inertia is meant that way.

        Raises
        ------
        ModelError
            With every fault found.
        """
        if nonphysical not in ("error", "warn"):
            raise InputError(f"nonphysical: expected 'error' or 'warn', got {nonphysical!r}")
        faults = list(self._read.faults)
        faults += structure_faults(
            self._bodies, self._joints, self._frames, self._springs, self._loops, self._prescribed
        )
        suspects = [(b.name, why) for b in self._bodies if (why := body_fault(b, point_masses=point_masses))]
        if not faults:
            named = {n for n, _ in suspects}
            model = self._assemble(())
            idle = [(model.joint(n).child, n) for n in idle_joints(model)]
            suspects += [(child, _idle(n)) for child, n in idle if child not in named]
        strict = nonphysical == "error"
        remedy = '; correct it, or take it as written with nonphysical="warn"'
        negative = {b.name for b in self._bodies if b.mass < 0}
        faults += [f"body {n!r}: {why}{remedy}" for n, why in suspects if strict and n not in negative]
        faults += [f"body {n!r}: {why}" for n, why in suspects if n in negative]
        if faults:
            raise ModelError(self._name, faults)
        model = self._assemble(tuple(suspects))
        if suspects:
            told = "; ".join(f"{n!r}: {why}" for n, why in suspects[:5])
            more = f" and {len(suspects) - 5} more" if len(suspects) > 5 else ""
            warnings.warn(
                f"{self._name}: taken as written, though no matter is like this: {told}{more}",
                NonPhysicalWarning,
                stacklevel=2,
            )
        return model

    def _assemble(self, suspects: tuple[tuple[str, str], ...]) -> Model:
        return Model(
            name=self._name,
            gravity=self._gravity,
            bodies=tuple(self._bodies),
            joints=tuple(_resolved(self._joints)),
            frames=tuple(self._frames),
            springs=tuple(self._springs),
            loops=tuple(self._loops),
            prescribed=tuple(self._prescribed),
            notes=tuple(self._notes),
            nonphysical=suspects,
        )


def _idle(joint: str) -> str:
    return f"no mass moves with joint {joint!r}, so M is singular: give mass, inertia or armature"


def _resolved(joints: list[Joint]) -> list[Joint]:
    """Let every mimic joint point at a joint that is free itself."""
    by_name = {j.name: j for j in joints}
    out = []
    for joint in joints:
        mimic = joint.mimic
        while mimic is not None and (leader := by_name[mimic.joint].mimic) is not None:
            mimic = Mimic(leader.joint, mimic.ratio * leader.ratio, mimic.ratio * leader.offset + mimic.offset)
        out.append(joint if mimic == joint.mimic else replace(joint, mimic=mimic))
    return out
