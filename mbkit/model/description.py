"""The data of a multibody system: parts, names and index ranges, without motion.

Places of all bodies at many configurations, and the box that a body's inertia is, from the description alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from itertools import chain, count, pairwise
from types import MappingProxyType
from typing import Annotated, Any, Final, NamedTuple, Self, TypeVar

import numpy as np

from mbkit._check import Array, by_key, shown
from mbkit.errors import InputError, ModelError, UnknownNameError
from mbkit.model.elements.forces import Bushing, Force, GravityCompensation
from mbkit.model.elements.kinds import PART_KINDS, Needs, acts, has, kind
from mbkit.model.elements.motion_laws import Motion, beyond, interval
from mbkit.model.elements.references import KINDS_OF_PARTS
from mbkit.model.joint_types import KINDS
from mbkit.model.parameters import Binding, Expression, Parameter, with_numbers
from mbkit.model.parts import (
    Body,
    Coupler,
    Frame,
    Joint,
    JointCoupling,
    Loop,
    NoSlip,
    NumberRule,
    PointSpring,
    read_only,
    rules_of,
)

#: Attributes of a description that bind its coordinates or velocities to each other.
CONSTRAINT_FEATURES: Final = tuple(
    dict.fromkeys(k.section for k in PART_KINDS.values() if k.section and k.does & {"row", "speed"})
)


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        given = {f.name: getattr(value, f.name) for f in fields(value)}
        return {name: _plain(x) for name, x in given.items() if name not in getattr(value, "_not_given", ())}
    if isinstance(value, np.ndarray):
        return [_plain(x) for x in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [_plain(x) for x in value]
    if isinstance(value, float):
        # + 0.0 makes one of the two zeros: they describe the same system.
        return (value + 0.0).hex()
    return value


def digest(*parts: Any) -> str:
    """Return the SHA-256, as 64 hexadecimal digits, of the parts' content."""
    text = json.dumps([_plain(p) for p in parts], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


#: How the notes of a model on the servos of its file begin; the repr says which choice holds.
SERVOS: Final = "servos"
#: How notes begin on what would act, and does not here.
LEFT_OUT: Final = "left out of the motion"


@dataclass(frozen=True)
class Layout:
    """Index ranges of the coordinates, full and reduced.

    The *full* coordinates have every joint; the model's q and v leave the mimic joints out, with
    q_full = G_q q + c and v_full = G v.
    """

    joints: tuple[Joint, ...]  # in the order of the coordinates

    def __repr__(self) -> str:
        nq, nv, full_nq, full_nv = self.sizes
        full = f" of {full_nq} and {full_nv} with mimic joints" if self.reduced else ""
        return f"<Layout of {len(self.joints)} joint{'s' * (len(self.joints) != 1)}: nq={nq}, nv={nv}{full}>"

    @cached_property
    def full_q(self) -> dict[str, slice]:
        """Range of each joint in the full coordinates."""
        return self._ranges([j.type.nq for j in self.joints])

    @cached_property
    def full_v(self) -> dict[str, slice]:
        """Range of each joint in the full velocities."""
        return self._ranges([j.type.nv for j in self.joints])

    @cached_property
    def q(self) -> dict[str, slice]:
        """Range of each joint in q; a mimic joint's is empty."""
        return self._ranges([0 if j.mimic else j.type.nq for j in self.joints])

    @cached_property
    def v(self) -> dict[str, slice]:
        """Range of each joint in v; a mimic joint's is empty."""
        return self._ranges([0 if j.mimic else j.type.nv for j in self.joints])

    def _ranges(self, sizes: Sequence[int]) -> dict[str, slice]:
        ends = np.cumsum([0, *sizes])
        return {j.name: slice(int(a), int(b)) for j, a, b in zip(self.joints, ends, ends[1:], strict=False)}

    @cached_property
    def sizes(self) -> tuple[int, int, int, int]:
        """(nq, nv, full nq, full nv)."""
        free = [j.type for j in self.joints if not j.mimic]
        every = [j.type for j in self.joints]
        return sum(t.nq for t in free), sum(t.nv for t in free), sum(t.nq for t in every), sum(t.nv for t in every)

    @cached_property
    def reduced(self) -> bool:
        """Whether any joint mimics another."""
        return any(j.mimic for j in self.joints)

    @cached_property
    def offsets(self) -> Array:
        """The constant c of q_full = G_q q + c."""
        c = np.zeros(self.sizes[2])
        for j in self.joints:
            if j.mimic:
                c[self.full_q[j.name]] = j.mimic.offset
        return read_only(c)

    @cached_property
    def G_q(self) -> Array:
        """Matrix of q_full = G_q q + c, shape (full nq, nq)."""
        return self._matrix(self.full_q, self.q, self.sizes[2], self.sizes[0])

    @cached_property
    def G(self) -> Array:
        """Matrix of v_full = G v, shape (full nv, nv)."""
        return self._matrix(self.full_v, self.v, self.sizes[3], self.sizes[1])

    def _matrix(self, rows: dict[str, slice], columns: dict[str, slice], n: int, k: int) -> Array:
        G = np.zeros((n, k))
        for j in self.joints:
            part = rows[j.name]
            if j.mimic:
                G[part, columns[j.mimic.joint]] = j.mimic.ratio * np.eye(part.stop - part.start)
            else:
                G[part, columns[j.name]] = np.eye(part.stop - part.start)
        return read_only(G)

    def coupling_row(self, coupling: JointCoupling) -> Array:
        """Return the row c of a coupling's rate dl/dt = c v_full, shape (full nv,)."""
        row = np.zeros(self.sizes[3])
        for joint, factor in zip(coupling.joints, coupling.factors, strict=True):
            row[self.full_v[joint]] += factor
        return row

    def coupler_row(self, coupler: Coupler, slopes: Array | None = None) -> Array:
        """Return the row of a coupler on the full velocities, (full nv,), of given slopes or those at zero."""
        row = np.zeros(self.sizes[3])
        row[self.full_v[coupler.joint]] = 1.0
        for name, slope in zip(coupler.leaders, coupler.ratios if slopes is None else slopes, strict=True):
            row[self.full_v[name]] = -slope
        return row

    def expand_q(self, q: Array) -> Array:
        """Return the full coordinates, mimic joints included."""
        return np.asarray(q @ self.G_q.T + self.offsets) if self.reduced else q

    def expand_v(self, v: Array) -> Array:
        """Return the full velocities (or accelerations), mimic joints included."""
        return np.asarray(v @ self.G.T) if self.reduced else v


class ShapeFile(NamedTuple):
    """A file with shapes: the prefix of its bodies' names, its path, and the body and pose of its ground."""

    prefix: str
    path: str
    body: str = "world"
    rotation: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)

    def renamed(self, prefix: str) -> ShapeFile:
        """Return the same with a prefix before all names."""
        body = self.body if self.body == "world" else prefix + self.body
        return self._replace(prefix=prefix + self.prefix, body=body)

    def hung_on(self, body: str, R: Array, p: Array) -> ShapeFile:
        """Return the same where the world has the pose R, p on a body."""
        if self.body != "world":
            return self
        turned, moved = R @ np.array(self.rotation), p + R @ np.array(self.translation)
        return self._replace(body=body, rotation=tuple(map(tuple, turned.tolist())), translation=tuple(moved.tolist()))


@dataclass(frozen=True, eq=False)
class Description:
    """The parts of a multibody system: a tree of bodies and what acts on it.

    Attributes
    ----------
    name : str
    gravity : (3,) array
        m/s², in world axes.
    bodies : tuple of Body
    joints : tuple of Joint
        In the order of their coordinates; fixed joints are among them.
    frames : tuple of Frame
    springs : tuple of PointSpring
    couplings : tuple of JointCoupling
    loops : tuple of Loop
    prescribed : tuple of Prescribed, FormulaMotion or SplineMotion
    couplers : tuple of Coupler
    no_slip : tuple of NoSlip
        Blades, and discs and spheres that roll.
    notes : tuple of str
        Decisions of the loader, for the user.
    nonphysical : tuple of (str, str)
        Bodies with an inconsistent inertia, each with the reason.
    bindings : tuple of Binding
        The numbers that are expressions of parameters. The parts hold their nominal values, and NaN without one.
    source : str
        Path of the file that the loader read, with the shapes to draw; empty without one. Like the notes, it does not
        count for equality.
    time : float
        At which motions prescribed in time are taken, s; neither does it count.
    forces : tuple of JointForce, FrameForce, Bushing or GravityCompensation
        Given by functions of the time and the state, and what holds the weight of bodies.
    drawn_from : tuple of ShapeFile
        Of a model that was edited, locked, mounted or joined: files with shapes to draw. No file describes such a
        model, and its `source` is empty.
    locked : tuple of (str, tuple of float, int)
        Joints that `lock` fixed, their coordinates, and how many velocities each had. Neither of both counts for
        equality.
    """

    name: str
    gravity: Annotated[Array, NumberRule("m/s²", (3,), added=True)]
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    frames: tuple[Frame, ...] = ()
    springs: tuple[PointSpring, ...] = ()
    couplings: tuple[JointCoupling, ...] = ()
    loops: tuple[Loop, ...] = ()
    prescribed: tuple[Motion, ...] = ()
    notes: tuple[str, ...] = ()
    nonphysical: tuple[tuple[str, str], ...] = ()
    bindings: tuple[Binding, ...] = ()
    source: str = ""
    time: Annotated[float, NumberRule("s", fixed="it is a parameter already, where the motion depends on it")] = 0.0
    couplers: tuple[Coupler, ...] = ()
    forces: tuple[Force, ...] = ()
    no_slip: tuple[NoSlip, ...] = ()
    drawn_from: tuple[ShapeFile, ...] = ()
    locked: tuple[tuple[str, tuple[float, ...], int], ...] = ()
    layout: Layout = field(init=False, repr=False)

    def __post_init__(self) -> None:
        gravity = np.array(self.gravity, dtype=np.float64)
        # A parameter without a value is NaN.
        if gravity.shape != (3,) or not (np.isfinite(gravity) | (np.isnan(gravity) & bool(self.bindings))).all():
            raise ModelError(self.name, [f"gravity: expected three finite numbers, got {shown(self.gravity)}"])
        object.__setattr__(self, "gravity", read_only(gravity))
        object.__setattr__(self, "layout", Layout(self.joints))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), tuple(getattr(self, f.name) for f in fields(self) if f.init)

    def __eq__(self, other: object) -> bool:
        return self.digest == other.digest if isinstance(other, Description) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def sources(self) -> tuple[ShapeFile, ...]:
        """Files with shapes to draw."""
        return (ShapeFile("", self.source),) if self.source else self.drawn_from

    # Sizes and names

    @property
    def nq(self) -> int:
        """Number of coordinates."""
        return self.layout.sizes[0]

    @property
    def nv(self) -> int:
        """Number of velocities."""
        return self.layout.sizes[1]

    @cached_property
    def independent_joints(self) -> tuple[Joint, ...]:
        """The joints that have coordinates of their own."""
        return tuple(j for j in self.joints if j.type.nv and not j.mimic)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints that have coordinates of their own, in their order."""
        return tuple(j.name for j in self.independent_joints)

    @cached_property
    def coordinate_names(self) -> tuple[str, ...]:
        """One name per coordinate of q."""
        return tuple(_named(j.name, s) for j in self.independent_joints for s in j.type.suffixes)

    @cached_property
    def velocity_names(self) -> tuple[str, ...]:
        """One name per entry of v."""
        return tuple(_named(j.name, s) for j in self.independent_joints for s in j.type.velocity_suffixes)

    @cached_property
    def velocity_joints(self) -> tuple[str, ...]:
        """The joint of each entry of v."""
        return tuple(j.name for j in self.independent_joints for _ in range(j.type.nv))

    def per_velocity(self, name: str) -> Array:
        """Return a number along velocities, such as ``"damping"``, of all joints, as each entry of v has it, (nv,).

        That of a mimic joint counts by the square of its ratio, as a force grows with the ratio too; the size of a
        force that jumps by the ratio alone. Other names raise `UnknownNameError`, which lists these.
        """
        if name not in (known := [k for k, rule in rules_of(Joint).items() if rule.does]):
            raise UnknownNameError("number of a joint's velocity", name, known)
        full, G = _joined([getattr(j, name) for j in self.joints]), self.layout.G
        ratios = np.abs(G) if name in Joint.adding_to("jump") else np.square(G)
        return np.asarray(ratios.T @ full if self.layout.reduced else full)

    @property
    def mass(self) -> float:
        """Total mass, kg; `InputError` where it depends on a parameter without a value."""
        if any(np.isnan(b.mass) for b in self.bodies):
            self.require_values("mass")
        return float(sum(b.mass for b in self.bodies if b.name not in self.rotors))

    @cached_property
    def rotors(self) -> frozenset[str]:
        """Names of the bodies that stand for the rotors of free joints, without weight and equal along all axes.

        They have inertia alone, and count neither as mass nor in the centre of mass.
        """
        weightless = {f.body for f in self.forces if isinstance(f, GravityCompensation) and f.fraction == 1}
        same = (b for b in self.bodies if b.name in weightless and np.array_equal(b.inertia, b.mass * np.eye(3)))
        return frozenset(b.name for b in same if not b.com.any())

    @cached_property
    def parameters(self) -> Mapping[str, float | None]:
        """Nominal value of each named parameter, None where it has none; the time, where it enters, is the last."""
        values = {p.name: p.value for b in self.bindings for p in b.expression.parameters()}
        return MappingProxyType(values | ({self.time_parameter: self.time} if self.time_parameter else {}))

    @cached_property
    def time_parameter(self) -> str | None:
        """Name of the parameter that is the time; None where the equations do not depend on it."""
        if not (self.prescribed or any(f.of_time for f in self.forces)):
            return None
        taken = {p.name for b in self.bindings for p in b.expression.parameters()}
        return next(name for name in chain(("t", "time"), (f"t_{k}" for k in count())) if name not in taken)

    def require_values(self, what: str) -> None:
        """Raise `InputError` that names the parameters without a value, if there are any."""
        missing = [name for name, value in self.parameters.items() if value is None]
        if missing:
            give = f"give it with model.with_parameters({', '.join(f'{n}=...' for n in missing)})"
            names = ", ".join(map(repr, missing))
            raise InputError(f"{what}: {self.name}: no value for parameter {names}; {give}")

    @cached_property
    def driven_by_forces(self) -> bool:
        """Whether a force of the model may add energy, as one that is given by more than a potential does."""
        return any(f.drives for f in self.forces)

    @cached_property
    def loses_energy(self) -> bool:
        """Whether dampers, forces that jump, or those without a potential do work that no energy accounts for."""
        damped = has("forces", "damping")
        lost = self.driven_by_forces or any(isinstance(f, Bushing) and damped(self, f) for f in self.forces)
        return self.needs.damping or "jump" in self.effects or lost

    @cached_property
    def constraints(self) -> tuple[Any, ...]:
        """Loops, couplers, motions in time and contacts without slip, the parts that bind coordinates or velocities."""
        return tuple(x for section in CONSTRAINT_FEATURES for x in getattr(self, section))

    @cached_property
    def interval(self) -> tuple[float, float]:
        """The times from and to which all prescribed motions are known, s; infinite without tables."""
        ends = [interval(p) for p in self.prescribed]
        return max((a for a, _ in ends), default=-np.inf), min((b for _, b in ends), default=np.inf)

    def require_times(self, what: str, *times: float) -> None:
        """Raise `InputError` for times at which a prescribed motion is not known, with the joint and the time."""
        if fault := beyond(self.prescribed, *times):
            raise InputError(f"{what}: {self.name}: {fault}; give a table that covers it, or other times")

    @cached_property
    def acts(self) -> Mapping[str, tuple[str, ...]]:
        """The kinds of parts that act, such as ``"joint.stiction"``, each with the names of its parts."""
        return acts(self)

    @cached_property
    def effects(self) -> frozenset[str]:
        """All that the kinds that act do, such as ``"T"``, ``"jump"`` and ``"row"``."""
        return frozenset[str]().union(*(kind(name).effects for name in self.acts))

    @cached_property
    def needs(self) -> Needs:
        """Features that this description needs from an engine."""
        words = {x for name in self.acts for k in (kind(name),) for x in (k.name, *k.features, *k.does)}
        flags = {f.name: f.name in words for f in fields(Needs)}
        flags |= {"limits": "joint.limit" in words, "time": "t" in words}
        flags["effort_limits"] = not words.isdisjoint({"joint.velocity_limit", "joint.effort_limit"})
        flags["quaternions"] = any(j.type.quaternion is not None for j in self.joints)
        return Needs(**flags)

    @cached_property
    def digest(self) -> str:
        """SHA-256 over every name, number and parameter of the description (not the notes)."""
        names = ("name", "gravity", "bodies", "joints", "frames", "springs", "loops", "prescribed")
        parts = [getattr(self, name) for name in names]
        types = [KINDS[kind] for kind in sorted({j.kind for j in self.joints})]
        own = (t.digest for t in types if not t.built_in)
        more = (*self.couplings, *self.couplers, *self.no_slip, *self.bindings, *own)
        return digest(*parts, *more, *((type(f).__name__, f) for f in self.forces))

    @cached_property
    def form_digest(self) -> str:
        """The digest without the parameters' values, which a derivation for all values has."""
        return self._substituted(lambda p: Parameter(p.name)).digest if self.parameters else self.digest

    # Structure

    @cached_property
    def tree(self) -> tuple[Joint, ...]:
        """All joints with every parent before its children, siblings as declared, depth first."""
        by_parent = by_key((joint.parent, joint) for joint in self.joints)
        out: list[Joint] = []
        stack = list(reversed(by_parent.get("world", [])))
        while stack:
            joint = stack.pop()
            out.append(joint)
            stack.extend(reversed(by_parent.get(joint.child, [])))
        return tuple(out)

    @cached_property
    def chains(self) -> Mapping[str, frozenset[str]]:
        """Of each joint the names of the joints from the ground to it, itself included."""
        below: dict[str, frozenset[str]] = {"world": frozenset()}
        out = {}
        for joint in self.tree:
            out[joint.name] = below[joint.child] = below[joint.parent] | {joint.name}
        return MappingProxyType(out)

    def way(self, body: str) -> tuple[str, ...]:
        """Return the bodies from one down to the world, both included."""
        out = [body]
        while out[-1] != "world":
            out.append(self._parents[out[-1]])
        return tuple(out)

    def moving(self, body: str) -> frozenset[str]:
        """Return the names of the joints from the ground to a body."""
        return frozenset().union(*(self.chains[j.name] for j in self.joints if j.child == body))

    @cached_property
    def _parents(self) -> Mapping[str, str]:
        return MappingProxyType({joint.child: joint.parent for joint in self.joints})

    def carrier(self, loop: Loop | Bushing | NoSlip) -> str:
        """Return the last body that carries both bodies of a loop, whose axes its rows have; ``"world"`` for most."""
        below = set(self.way(loop.body_b))
        return next(body for body in self.way(loop.body_a) if body in below)

    def branched(self, coupling: JointCoupling) -> bool:
        """Return whether two joints of a coupling are on different branches of the tree."""
        chains = sorted((self.chains[name] for name in coupling.joints), key=len)
        return not all(a <= b for a, b in pairwise(chains))

    @cached_property
    def quaternions(self) -> tuple[tuple[int, str], ...]:
        """(start in q, joint name) of every quaternion."""
        return tuple(
            (self.layout.q[j.name].start + j.type.quaternion, j.name)
            for j in self.independent_joints
            if j.type.quaternion is not None
        )

    @cached_property
    def lower(self) -> Array:
        """Lower limits, shape (nq,)."""
        return _joined([j.lower for j in self.independent_joints])

    @cached_property
    def upper(self) -> Array:
        """Upper limits, shape (nq,)."""
        return _joined([j.upper for j in self.independent_joints])

    @cached_property
    def velocity_limits(self) -> Array:
        """Largest velocities by amount, shape (nv,), m/s or rad/s; infinite where there is no limit."""
        return _joined([j.velocity_limit for j in self.independent_joints])

    @cached_property
    def effort_limits(self) -> Array:
        """Largest forces of the actuators by amount, shape (nv,), N or Nm; infinite where there is no limit.

        They act in runs with ``saturate=True`` alone.

        Examples
        --------
        >>> import mbkit as mb
        >>> mb.load("ur5").effort_limits
        array([150., 150., 150.,  28.,  28.,  28.])
        """
        return _joined([j.effort_limit for j in self.independent_joints])

    def body(self, name: str) -> Body:
        """Return the body of this name."""
        return _by_name("body", self.bodies, name)

    def joint(self, name: str) -> Joint:
        """Return the joint of this name."""
        return _by_name("joint", self.joints, name)

    def frame(self, name: str) -> Frame:
        """Return the frame of this name: a declared one, else a body's own, or ``"world"``, the ground's."""
        expect_name("frame", name)
        for frame in self.frames:
            if frame.name == name:
                return frame
        if name == "world" or any(b.name == name for b in self.bodies):
            return Frame(name, name, np.eye(3), np.zeros(3))
        names = [f.name for f in self.frames] + [b.name for b in self.bodies]
        raise UnknownNameError("frame", name, names)

    def _substituted(self, replacement: Callable[[Parameter], Parameter | float]) -> Self:
        """Return the description with another parameter, or a number, for each parameter; unchecked."""
        bindings = [(b, b.expression.evaluate(replacement, float)) for b in self.bindings]

        def filled(where: str, part: Any, name: str) -> Any:
            return with_numbers(
                part, [(b.field, b.index, x) for b, x in bindings if (b.where, b.part) == (where, name)]
            )

        changes: dict[str, Any] = {k: tuple(filled(k, p, p.name) for p in getattr(self, k)) for k in KINDS_OF_PARTS}
        expressions = tuple(replace(b, expression=x) for b, x in bindings if isinstance(x, Expression))
        out: Self = replace(filled("gravity", self, ""), **changes, bindings=expressions)
        return out


_Part = TypeVar("_Part", Body, Joint)


def _by_name(what: str, parts: tuple[_Part, ...], name: str) -> _Part:
    expect_name(what, name)
    for part in parts:
        if part.name == name:
            return part
    raise UnknownNameError(what, name, [p.name for p in parts])


def expect_name(what: str, name: object) -> None:
    """Raise `InputError` for a name that is no text."""
    if not isinstance(name, str):
        raise InputError(f"{what}: expected a name, got {shown(name)}")


def _joined(parts: list[Array]) -> Array:
    return read_only(np.concatenate([np.empty(0), *parts]))


def _named(joint: str, suffix: str) -> str:
    return f"{joint}.{suffix}" if suffix else joint


def body_poses(model: Description, q: Array) -> dict[str, tuple[Array, Array]]:
    """Return R_WB (n, 3, 3) and p_WB (n, 3) in m of every body and of ``"world"`` at configurations (n, nq)."""
    n, full = len(q), model.layout.expand_q(q)
    X = {"world": np.broadcast_to(np.eye(4), (n, 4, 4))}
    for joint in model.tree:
        own = list(full[:, model.layout.full_q[joint.name]].T)
        X[joint.child] = X[joint.parent] @ frame_of(joint) @ pose_of(joint, own, n)
    return {name: (x[:, :3, :3], x[:, :3, 3]) for name, x in X.items()}


def frame_of(part: Joint | Frame) -> Array:
    """Return the pose (4, 4) of a frame, or of a joint's fixed frame, in its body."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = part.rotation, part.translation
    return out


def pose_of(joint: Joint, q: list[Array], n: int) -> Array:
    """Return the child's pose in the joint's frame, (n, 4, 4)."""
    R, p = joint.type.placement(np, joint, q)
    out = np.zeros((n, 4, 4))
    for i, row in enumerate(R):
        for j, x in enumerate((*row, p[i])):
            out[:, i, j] = x
    out[:, 3, 3] = 1.0
    return out


def inertia_box(body: Body) -> tuple[Array, Array]:
    """Return axes (3, 3) and half lengths (3,) in m of the uniform box with a body's mass and inertia, about its com.

    ∫ x² dm along a principal axis is half the sum of the moments less that axis's own; of a box it is m/3 times the
    half length squared.
    """
    moments, axes = np.linalg.eigh(body.inertia)
    squares = np.maximum(moments.sum() / 2 - moments, 0.0)
    return np.asarray(axes), np.sqrt(3 * squares / body.mass) if body.mass else np.zeros(3)
