"""Forces given by functions of the time, the state and named constants: at joints, on frames, and between two bodies.

Beside them stands what holds the weight of bodies.

A force has a `formula` of what acts, a `potential` from which a part of it follows, or both. Their arguments are names:
the element's own, such as ``"q"`` and ``"v"`` of a joint; ``"t"``; the constants in `symbols`; and of every coordinate
and velocity of the model that is not the element's own, ``"theta"`` and ``"theta_dot"``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np

from mbkit._check import ROUNDING, Array
from mbkit.errors import did_you_mean
from mbkit.model.elements.formula import Formula
from mbkit.model.parts import ENTRIES, Constants, NumberRule, Place, Rotation, _Frozen, read_only

#: A `mbkit.model.description.Description`, a floor above.
_Model = Any
#: Behind the name of a coordinate, its velocity.
RATE: Final = "_dot"
TIME: Final = "t"
#: Names of positions, and of what belongs to them, in formulas of forces on frames and of bushings.
POINT: Final = ENTRIES[:3]
TWIST: Final = ("vx", "vy", "vz", "wx", "wy", "wz")
DISPLACEMENT: Final = ENTRIES


class Force(_Frozen):
    """A force, with the attributes that all elements share: `formula`, `potential`, `symbols` and `numbers`."""

    section = "forces"
    name: str
    formula: Formula | None
    potential: Formula | None
    symbols: tuple[str, ...]
    numbers: Array

    @property
    def formulas(self) -> tuple[Formula, ...]:
        """The formula and the potential, where they are."""
        return tuple(x for x in (self.formula, self.potential) if x is not None)

    @property
    def arguments(self) -> tuple[str, ...]:
        """The names in the formulas, once each."""
        return tuple(dict.fromkeys(name for x in self.formulas for name in x.arguments))

    @property
    def constants(self) -> tuple[float, ...]:
        """The numbers in the formulas."""
        return tuple(x for formula in self.formulas for x in formula.constants)

    @property
    def acts(self) -> bool:
        """Whether it acts without its formulas."""
        return False

    @property
    def drives(self) -> bool:
        """Whether it may add energy, as a force beside a potential does."""
        return self.formula is not None

    @property
    def of_time(self) -> bool:
        """Whether it depends on the time itself."""
        return TIME in self.arguments

    def positions(self, model: _Model) -> tuple[str, ...]:  # noqa: ARG002  # of a joint they depend on it
        """Return the names of the positions that the element brings."""
        return ()

    def velocities(self, model: _Model) -> tuple[str, ...]:  # noqa: ARG002  # as above
        """Return the names of the velocities that it brings: what its force acts on."""
        return ()

    def own(self, model: _Model) -> tuple[str, ...]:
        """Return both."""
        return self.positions(model) + self.velocities(model)

    def misplaced(self, model: _Model) -> Iterator[str]:
        """Yield the faults of the element's place and of its numbers."""
        raise NotImplementedError


def _numbered(letter: str, n: int) -> tuple[str, ...]:
    return (letter,) if n == 1 else tuple(f"{letter}_{k}" for k in range(n))


class JointElement(Force):
    """An element on the velocities of joints: q and v of one, q_0, q_1, ... and v_0, v_1, ... of all in their order."""

    joints: tuple[str, ...]

    def positions(self, model: _Model) -> tuple[str, ...]:
        """Return q, or q_0, q_1, ..."""
        return _numbered("q", sum(model.joint(name).type.nq for name in self.joints))

    def velocities(self, model: _Model) -> tuple[str, ...]:
        """Return v, or v_0, v_1, ..."""
        return _numbered("v", sum(model.joint(name).type.nv for name in self.joints))

    def misplaced(self, model: _Model) -> Iterator[str]:
        """Yield joints that are not there, and those that do not move."""
        names = [j.name for j in model.joints]
        for name in self.joints:
            if name not in names:
                yield _unknown("joint", name, names)
            elif not model.joint(name).type.nv:
                yield f"joint {name!r} is fixed, so that a force on it does nothing"

    def __str__(self) -> str:
        at = " and ".join(map(repr, self.joints))
        return f"force {self.name!r} at joint {at}, of {_listed(self.arguments)}"


@dataclass(frozen=True, eq=False)
class JointForce(JointElement):
    """A generalized force of a joint, one number per velocity, as a formula of q and v (of several, q_0, q_1, ...).

    Attributes
    ----------
    name, joint : str
    formula, potential : Formula or None
    symbols : tuple of str
    numbers : (k,) array
        The constants of these names.
    """

    name: str
    joint: str
    formula: Formula | None
    potential: Formula | None
    symbols: tuple[str, ...]
    numbers: Constants

    @property
    def joints(self) -> tuple[str, ...]:  # type: ignore[override]  # it follows from the joint
        """The joint."""
        return (self.joint,)


@dataclass(frozen=True, eq=False)
class FrameForce(Force):
    """A force and moment on a frame, as a formula of its place x, y, z in the world and of its velocity.

    Attributes
    ----------
    name : str
    frame : str
        A frame, or a body.
    axes : {"local", "local_world_aligned", "world"}
        Of the wrench and of the velocity ``vx, vy, vz, wx, wy, wz``, as in `Dynamics.generalized_force`.
    formula, potential : Formula or None
    symbols : tuple of str
    numbers : (k,) array
        The constants of these names.
    """

    name: str
    frame: str
    axes: str
    formula: Formula | None
    potential: Formula | None
    symbols: tuple[str, ...]
    numbers: Constants

    def positions(self, model: _Model) -> tuple[str, ...]:  # noqa: ARG002  # the same of every model
        """Return x, y and z."""
        return POINT

    def velocities(self, model: _Model) -> tuple[str, ...]:  # noqa: ARG002  # as above
        """Return vx, vy, vz, wx, wy and wz."""
        return TWIST

    def misplaced(self, model: _Model) -> Iterator[str]:
        """Yield that there is no such frame."""
        names = [x.name for x in (*model.frames, *model.bodies)]
        if self.frame not in names:
            yield _unknown("frame", self.frame, names)

    def __str__(self) -> str:
        return f"force {self.name!r} on {self.frame!r} in {self.axes} axes, of {_listed(self.arguments)}"


@dataclass(frozen=True, eq=False)
class Bushing(Force):
    """A compliant joint between two frames: the force on body b of its displacement x in the axes of frame a.

    x is the position of frame b's origin and the rotation vector of frame b, in frame a: six numbers. On the rates of x
    acts -(stiffness x + damping ẋ) and what `formula` gives; the generalized force follows by virtual work.

    Attributes
    ----------
    name, body_a, body_b : str
        A body may be ``"world"``.
    rotation_a, rotation_b : (3, 3) arrays
        Axes of the frames in body axes.
    translation_a, translation_b : (3,) arrays
        Origins of the frames in body axes, m.
    stiffness, damping : (6, 6) arrays
        N/m and N m/rad; N s/m and N m s/rad.
    formula, potential : Formula or None
        Of x, y, z, rx, ry, rz and their rates ``x_dot`` to ``rz_dot``.
    symbols : tuple of str
    numbers : (k,) array
        The constants of these names.
    """

    name: str
    body_a: str
    rotation_a: Rotation
    translation_a: Place
    body_b: str
    rotation_b: Rotation
    translation_b: Place
    stiffness: Annotated[Array, NumberRule("N/m, N m/rad", (6, 6))]
    damping: Annotated[Array, NumberRule("N s/m, N m s/rad", (6, 6))]
    formula: Formula | None
    potential: Formula | None
    symbols: tuple[str, ...]
    numbers: Constants

    @property
    def acts(self) -> bool:
        """Whether it is a spring or a damper."""
        return bool(self.stiffness.any() or self.damping.any())

    def positions(self, model: _Model) -> tuple[str, ...]:  # noqa: ARG002  # the same of every model
        """Return x, y, z, rx, ry and rz."""
        return DISPLACEMENT

    def velocities(self, model: _Model) -> tuple[str, ...]:  # noqa: ARG002  # as above
        """Return their rates, x_dot to rz_dot."""
        return tuple(name + RATE for name in DISPLACEMENT)

    def misplaced(self, model: _Model) -> Iterator[str]:
        """Yield unknown bodies, a bushing between a body and itself, and matrices that are none of a bushing."""
        names = ["world", *(b.name for b in model.bodies)]
        yield from (_unknown("body", x, names) for x in (self.body_a, self.body_b) if x not in names)
        if self.body_a == self.body_b:
            yield f"both frames on {self.body_a!r}; it would never act"
        for what, matrix in (("stiffness", self.stiffness), ("damping", self.damping)):
            if np.isnan(matrix).any():
                continue
            size = np.abs(matrix).max()
            if what == "stiffness" and np.abs(matrix - matrix.T).max() > ROUNDING * size:
                yield "stiffness: expected a symmetric matrix, which has a potential energy; give the rest as a formula"
            elif np.linalg.eigvalsh((matrix + matrix.T) / 2)[0] < -ROUNDING * size:
                yield f"{what}: expected a matrix without negative eigenvalues, got one that drives the motion"

    def __str__(self) -> str:
        of = f", and a function of {_listed(self.arguments)}" if self.formulas else ""
        return f"bushing {self.name!r} between {self.body_a!r} and {self.body_b!r}{of}"


@dataclass(frozen=True, eq=False)
class GravityCompensation(Force):
    """A force at a body's centre of mass that holds a part of its weight: -fraction m g.

    It has the potential energy fraction m g · p_com, unless joints are left out. MuJoCo calls it ``gravcomp``.

    Attributes
    ----------
    body : str
    fraction : float
        Of the weight; 1 holds all of it.
    without : tuple of str
        Joints at which it does not act, as where actuators take its part.
    """

    body: str
    fraction: Annotated[float, NumberRule()]
    without: tuple[str, ...] = ()

    #: It has no formula.
    formula = potential = None
    symbols = ()
    numbers = read_only(np.zeros(0))

    #: Zero may be a parameter's value.
    acts = True

    @property
    def name(self) -> str:  # type: ignore[override]  # it follows from the body, which has one at most
        """The body's, in words."""
        return self.named(self.body)

    @staticmethod
    def named(body: str) -> str:
        """Return the name of a body's."""
        return f"gravity compensation of {body}"

    def misplaced(self, model: _Model) -> Iterator[str]:
        """Yield that there is no such body."""
        names = [b.name for b in model.bodies]
        if self.body not in names:
            yield _unknown("body", self.body, names)
        joints = [j.name for j in model.joints]
        yield from (_unknown("joint", name, joints) for name in self.without if name not in joints)
        if self.without and any(j.mimic for j in model.joints):
            yield "joints left out beside joints that mimic others; leave none out"

    @property
    def drives(self) -> bool:
        """Whether joints are left out."""
        return bool(self.without)

    def __str__(self) -> str:
        at = f", but not at {', '.join(self.without)}" if self.without else ""
        return f"gravity compensation of {self.body!r}: {self.fraction:g} of its weight{at}"


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(name for name in names if not name.startswith("#")) or "constants"


def _unknown(what: str, name: str, names: list[str]) -> str:
    return f"unknown {what} {name!r}{did_you_mean(name, names)}"


def coordinate_arguments(model: _Model) -> Mapping[str, tuple[bool, int]]:
    """Return the names of a model's coordinates and velocities in formulas: whether a velocity, and which."""
    q = {name: (False, i) for i, name in enumerate(model.coordinate_names)}
    return q | {name + RATE: (True, i) for i, name in enumerate(model.velocity_names)}


def arguments_of(model: _Model, joint: str) -> tuple[str, ...]:
    """Return those of a joint that moves freely."""
    q, v = model.layout.q[joint], model.layout.v[joint]
    return (*model.coordinate_names[q], *(name + RATE for name in model.velocity_names[v]))


def by_functions(model: _Model) -> tuple[Force, ...]:
    """Return the forces given by functions: all but what holds weights."""
    return tuple(f for f in model.forces if not isinstance(f, GravityCompensation))


def force_faults(model: _Model) -> Iterator[str]:
    """Yield one sentence for each fault of the forces of a description."""
    others = coordinate_arguments(model)
    for force in model.forces:
        item = f"bushing {force.name!r}" if isinstance(force, Bushing) else f"force {force.name!r}"
        wrong = [*force.misplaced(model)]
        yield from (f"{item}: {text}" for text in wrong)
        if wrong:
            continue
        own = force.own(model)
        size = len(force.velocities(model))
        if force.formula is not None and len(force.formula.outputs) != size:
            yield f"{item}: expected {size} components, got {len(force.formula.outputs)}"
        yield from (f"{item}: {text}" for text in _symbol_faults(force, own, others))
        moving = {TIME, *force.velocities(model), *(n for n, (rate, _) in others.items() if rate)} - {*force.symbols}
        if force.potential is not None and (bad := [n for n in force.potential.arguments if n in moving]):
            yield f"{item}: potential depends on {bad[0]!r}; expected a function of positions, as an energy V(q) is"
        if not (force.formulas or force.acts):
            yield f"{item}: no force and no potential; it would never act"


def _symbol_faults(force: Force, own: tuple[str, ...], others: Mapping[str, Any]) -> Iterator[str]:
    # Both are the same number of a joint named q.
    same = {*force.joints} & {*own} if isinstance(force, JointElement) else set()
    for name in force.arguments:
        meanings = [
            text
            for text, there in (
                ("one of its own arguments", name in own or name == TIME),
                ("a constant in parameters=", name in force.symbols),
                ("a coordinate or velocity of the model", name in others and name not in same),
            )
            if there
        ]
        if len(meanings) > 1:
            yield f"symbol {name!r} stands for {' and '.join(meanings)}; rename one of them"
        elif not meanings:
            yield (
                f"unknown symbol {name!r}; there are {', '.join((TIME, *own))}, names of coordinates, and with "
                f"{RATE!r} behind it those of velocities{did_you_mean(name, [*own, *force.symbols, *others])}"
                f"; a constant's value is given with parameters={{{name!r}: ...}}"
            )
