"""The parts of a description: bodies, joints, springs, loops. Frozen data.

All lengths are metres, masses kilograms, angles radians. Arrays are read-only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from math import inf
from operator import attrgetter
from types import MappingProxyType
from typing import Annotated, Any, Final, get_args, get_type_hints

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike

from mbkit._check import EPS, PRINTED, Array, finite_array, shown
from mbkit.errors import ModelError
from mbkit.model.joint_types import JointType, kind_of, register_joint_type

#: Armature of a joint that rests, kg m² or kg: what accelerates it is smaller than any rounding, and articulated
#: inertias beside it are those of a fixed joint to the last bit.
RESTING: Final = 1e30
#: A force at rest is above its bound where it is so by more than this part, as rounding of its sums may be.
ROUNDING: Final = 1e-13
#: Velocities that follow from others by rows, relative to these, that are rounding of a pose.
POSE_ROUNDING: Final = 1e-9
#: Speed, m/s or rad/s, of what has stopped: below every rounding, and above what a drive that has ended leaves.
STOPPED: Final = EPS**2
_ONE: Final = np.eye(3)


#: Names of the entries of an axis of three or six numbers.
ENTRIES: Final = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class NumberRule:
    """All that holds for a field with numbers; its annotation says it, as ``Annotated[float, NumberRule("kg")]``."""

    #: For a joint it is that of a turn, and that of a slide.
    unit: str = ""
    #: A text is an attribute of the part: how many, or the names of the entries. None stands for any shape.
    shape: tuple[int | str, ...] | None = ()
    least: float = -inf
    #: Zero is none either, where the kind of part has this number.
    positive: bool = False
    #: The value with which it does nothing.
    nothing: float = 0.0
    #: A spread of variants is added, in its unit: its sign is free, and zero means nothing.
    added: bool = False
    #: Why it cannot be a free parameter; empty where it can.
    fixed: str = ""
    #: Its part along a coordinate x or its rate v: ½ number v² to ``"T"`` or Rayleigh's ``"loss"``, ½ number x² to
    #: ``"V"``, or a force of its size that may ``"jump"`` with the sign of v.
    does: str = ""
    #: The equations have it; other numbers are data.
    acts: bool = True
    #: It is an orientation or an axis.
    direction: bool = False
    #: Number of the part that acts in its place where it is None, or a value; without this it may not be None.
    absent: str | float | None = None

    @property
    def place(self) -> bool:
        """Whether it is a point."""
        return (self.unit, self.shape) == ("m", (3,))

    def entries(self, part: Any) -> tuple[Sequence[str], ...] | None:
        """Return the names of a part's entries along each axis; None for any shape."""
        if self.shape is None:
            return None
        sizes = [_attribute(x)(part) if isinstance(x, str) else x for x in self.shape]
        # A single name, as of one leader, is that of a number.
        return tuple(ENTRIES[:n] if isinstance(n, int) else n for n in sizes if not isinstance(n, str))


_attribute = cache(attrgetter)
_RULES: Final[dict[type, Mapping[str, NumberRule]]] = {}


def rules_of(cls: type) -> Mapping[str, NumberRule]:
    """Return the rules of a part's fields with numbers, by name and in their order.

    Raises
    ------
    TypeError
        A field with numbers that has no rule: no path would know what to do with it.
    """
    if cls not in _RULES:
        hints, out = get_type_hints(cls, include_extras=True), {}
        for name in (f.name for f in fields(cls)):
            rules = [x for x in getattr(hints[name], "__metadata__", ()) if isinstance(x, NumberRule)]
            if not rules and {hints[name], *get_args(hints[name])} & {float, Array}:
                raise TypeError(f"{cls.__name__}.{name}: numbers without a NumberRule; annotate the field with one")
            if rules:
                out[name] = rules[0]
        _RULES[cls] = MappingProxyType(out)
    return _RULES[cls]


def numbers(part: Any) -> Iterator[tuple[str, NumberRule, Any]]:
    """Yield the name, rule and value of each number of a part, also of the joint that it mimics."""
    for name, rule in rules_of(type(part)).items():
        if (value := getattr(part, name)) is not None:
            yield name, rule, value
    if mimic := getattr(part, "mimic", None):
        yield from numbers(mimic)


def acting(part: Any, field: str) -> Any:
    """Return a number of a part as it acts, also where it is not given."""
    value = getattr(part, field)
    rule = None if value is not None else rules_of(type(part)).get(field)
    if rule is None or rule.absent is None:
        return value
    if isinstance(rule.absent, str):
        return getattr(part, rule.absent)
    return np.full(tuple(map(len, rule.entries(part) or ())), rule.absent)


_ORIENTED: Final = "orientations and axes are no parameters"
_IS_DATA: Final = "it is data"
_NEWTONS: Final = "Newton's restitution is a number in every engine, as set_joint sets it"
_CURVE: Final = "Stribeck's curve is a number in every engine, as set_joint sets it"
OF_Q: Final = ("type.suffixes",)
OF_V: Final = ("type.velocity_suffixes",)
Numbers = Annotated[Array, NumberRule(shape=None)]
Rotation = Annotated[Array, NumberRule(shape=(3, 3), fixed=_ORIENTED, direction=True)]
Axis = Annotated[Array, NumberRule(shape=(3,), fixed=_ORIENTED, direction=True)]
Place = Annotated[Array, NumberRule("m", (3,), added=True)]
#: Constants of formulas, whose units these know.
Constants = Annotated[Array, NumberRule(shape=("symbols",))]


def _turns(R: Array) -> bool:
    """Return whether a matrix is a rotation; one of unknown numbers may be."""
    return not np.isfinite(R).all() or bool(np.abs(R @ R.T - _ONE).max() <= PRINTED and np.linalg.det(R) > 0)


def read_only(array: Array) -> Array:
    """Return an array that refuses to be written to: itself."""
    array.setflags(write=False)
    return array


class _Frozen:
    """Read-only arrays, equality by content, and pickling that keeps both."""

    def __post_init__(self) -> None:
        for name, rule in rules_of(type(self)).items():
            value = getattr(self, name)
            if value is None and rule.absent is not None:
                continue
            try:
                # + 0.0 makes one of the two zeros, which are equal and hash apart.
                number = np.array(value, dtype=np.float64) + 0.0
            except (TypeError, ValueError):
                raise self._fault(f"{name}: expected numbers, got {shown(value)}") from None
            entries = rule.entries(self)
            wanted = None if entries is None else tuple(map(len, entries))
            if wanted is not None and number.shape != wanted:
                raise self._fault(f"{name}: expected shape {wanted}, got {number.shape}")
            if name.startswith("rotation") and not _turns(number):
                raise self._fault(f"{name} is not a rotation matrix; expected R Rᵀ = 1 and det R = 1")
            if name == "inertia" and np.abs(number - number.T).max() > PRINTED * np.abs(number).max():
                raise self._fault("inertia is not symmetric; expected I = Iᵀ")
            object.__setattr__(self, name, float(number) if wanted == () else read_only(number))

    def _fault(self, text: str) -> ModelError:
        what = type(self).__name__.lower()
        return ModelError(f"{what} {getattr(self, 'name', '')!r}" if hasattr(self, "name") else what, [text])

    @property
    def _not_given(self) -> set[str]:
        """The optional numbers without a value; a digest lacks them, as those from before they were there do."""
        return {n for n in rules_of(type(self)) if getattr(self, n) is None}

    def _values(self) -> tuple[Any, ...]:
        return tuple(getattr(self, f.name) for f in fields(self))  # type: ignore[arg-type]  # every subclass is a dataclass

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        pairs = zip(self._values(), other._values(), strict=True)
        return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)

    def __hash__(self) -> int:
        return hash(tuple(v.tobytes() if isinstance(v, np.ndarray) else v for v in self._values()))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), self._values()

    @classmethod
    def adding_to(cls, effect: str) -> tuple[str, ...]:
        """Return the fields whose numbers have an effect along a coordinate or its rate."""
        return tuple(name for name, rule in rules_of(cls).items() if rule.does == effect)

    @property
    def rotors(self) -> Any:
        """The inertia beside that of bodies, of a joint on each velocity, (nv,), of a coupling on its rate."""
        return sum(getattr(self, name) for name in self.adding_to("T"))


@dataclass(frozen=True, eq=False)
class Body(_Frozen):
    """A rigid body.

    Attributes
    ----------
    name : str
    mass : float
        kg.
    com : (3,) array
        Centre of mass in body axes, m.
    inertia : (3, 3) array
        About the centre of mass, in body axes, kg m².
    """

    #: Attribute of a description that holds such parts.
    section = "bodies"
    name: str
    mass: Annotated[float, NumberRule("kg", least=0.0, positive=True)]
    com: Place
    inertia: Annotated[Array, NumberRule("kg m²", (3, 3))]

    def __repr__(self) -> str:
        return f"<Body {self.name!r}: {self.mass:.4g} kg>"


@dataclass(frozen=True, eq=False)
class Mimic(_Frozen):
    """A joint that follows another: y = ratio * q + offset.

    Attributes
    ----------
    joint : str
        The joint that leads, with coordinate q.
    ratio, offset : float
    """

    joint: str
    ratio: Annotated[float, NumberRule()] = 1.0
    offset: Annotated[float, NumberRule("rad, m", added=True)] = 0.0


@dataclass(frozen=True, eq=False)
class Joint(_Frozen):
    """A joint between `parent` and `child`; the child's frame is the joint's moving frame.

    Attributes
    ----------
    kind : str
        Name of a joint type: a key of `KINDS`.
    rotation, translation : (3, 3) and (3,) arrays
        R_PJ and p_PJ_P, the joint's fixed frame in the parent's.
    axes : (k, 3) array
        Unit axes in the joint's frame; the second of a universal joint turns with the first.
    pitch : float
        Advance of a helical joint, metres per radian.
    lower, upper : (nq,) arrays
        Limits of the coordinates, infinite where there are none: data, unless there are stops.
    velocity_limit, effort_limit, armature, damping, friction, stiffness, rest : (nv,) arrays
        Per velocity. `stiffness` acts on q - `rest`, `damping` on v, dry `friction` against v at any speed; the limits
        are data only.
    mimic : Mimic or None
        The joint that this one follows; its coordinate is then not free.
    stiction, stribeck_velocity : (nv,) arrays or None
        The largest dry friction at rest, that of motion without; and the velocity at which it falls to that.
    restitution : (nv,) array or None
        Newton's e of the stops at `lower` and `upper`, from 0 to 1; None where the limits are no stops.
    """

    section = "joints"
    name: str
    kind: str
    parent: str
    child: str
    rotation: Rotation
    translation: Place
    axes: Annotated[Array, NumberRule(shape=("type.n_axes", 3), fixed=_ORIENTED, direction=True)]
    pitch: Annotated[float, NumberRule("m/rad")]
    lower: Annotated[Array, NumberRule("rad, m", OF_Q, nothing=-inf, fixed=_IS_DATA, acts=False)]
    upper: Annotated[Array, NumberRule("rad, m", OF_Q, nothing=inf, fixed=_IS_DATA, acts=False)]
    velocity_limit: Annotated[Array, NumberRule("rad/s, m/s", OF_V, least=0.0, nothing=inf, fixed=_IS_DATA, acts=False)]
    effort_limit: Annotated[Array, NumberRule("N m, N", OF_V, least=0.0, nothing=inf, fixed=_IS_DATA, acts=False)]
    armature: Annotated[Array, NumberRule("kg m², kg", OF_V, least=0.0, does="T")]
    damping: Annotated[Array, NumberRule("N m s/rad, N s/m", OF_V, least=0.0, does="loss")]
    friction: Annotated[Array, NumberRule("N m, N", OF_V, least=0.0, does="jump")]
    stiffness: Annotated[Array, NumberRule("N m/rad, N/m", OF_V, least=0.0, does="V")]
    rest: Annotated[Array, NumberRule("rad, m", OF_V, added=True)]
    mimic: Mimic | None = None
    stiction: Annotated[Array | None, NumberRule("N m, N", OF_V, least=0.0, absent="friction")] = None
    stribeck_velocity: Annotated[Array | None, NumberRule("rad/s, m/s", OF_V, least=0.0, fixed=_CURVE, absent=0.0)] = (
        None
    )
    # With -1 a velocity passes.
    restitution: Annotated[Array | None, NumberRule("", OF_V, fixed=_NEWTONS, absent=-1.0)] = None

    def __repr__(self) -> str:
        follows = f", follows {self.mimic.joint!r}" if self.mimic else ""
        return f"<Joint {self.name!r}: {self.kind}, {self.parent!r} to {self.child!r}{follows}>"

    @property
    def type(self) -> JointType:
        """The formulas of this joint's type."""
        return kind_of(self.kind)

    @property
    def sticks(self) -> bool:
        """Whether its friction at rest may be above that of motion."""
        return self.stiction is not None and bool((self.stiction > self.friction).any())

    @property
    def stops(self) -> bool:
        """Whether its limits act as rigid stops."""
        return self.restitution is not None

    @classmethod
    def _of(
        cls, name: str, kind: str, parent: str, child: str, rotation: Array, translation: Array, **own: Any
    ) -> Joint:
        """Return a joint with these numbers; its others do nothing, and without them it has no axes."""
        sizes, values = (
            {OF_Q: kind_of(kind).nq, OF_V: kind_of(kind).nv},
            dict[str, Any](axes=np.empty((0, 3)), pitch=0.0),
        )
        for field_, rule in rules_of(cls).items():
            if rule.shape in sizes and rule.absent is None:
                values[field_] = np.full(sizes[rule.shape], rule.nothing)
        return cls(name, kind, parent, child, rotation, translation, **values | own)

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        # Another process may not have registered the type.
        return (type(self), self._values()) if self.type.built_in else (_of_type, (self.type, self._values()))


def rest_faults(item: str, joint: Joint) -> Iterator[str]:
    """Yield one sentence per fault of what may hold a joint at rest."""
    bound, curve = joint.stiction, joint.stribeck_velocity
    given = [x for x in (joint.friction, bound, curve) if x is not None]
    # A parameter without a value is no number yet.
    if any(np.isinf(x).any() for x in given):
        yield f"{item}: dry friction: expected finite numbers; lock(...) holds a joint that nothing moves"
    elif bound is not None and np.any(bound < joint.friction):
        yield f"{item}: stiction {bound} is below the friction of motion, {joint.friction}; give at least that"
    elif curve is not None and bound is None:
        yield f"{item}: stribeck_velocity without stiction, from which the friction would fall; give stiction too"
    if any(np.any(x) for x in given) and not joint.type.coordinate_velocities:
        yield (
            f"{item}: dry friction on a {joint.kind} joint, whose velocities are along moving axes: friction by axis "
            "is no law of matter there; use joints of one axis, or a force that is a function of the velocity"
        )


def _of_type(joint_type: JointType, values: tuple[Any, ...]) -> Joint:
    register_joint_type(joint_type)
    return Joint(*values)


@dataclass(frozen=True, eq=False)
class Frame(_Frozen):
    """A named frame fixed to a body.

    Attributes
    ----------
    name, body : str
    rotation, translation : (3, 3) and (3,) arrays
        R_BF and p_BF_B, m.
    """

    section = "frames"
    name: str
    body: str
    rotation: Rotation
    translation: Annotated[Array, NumberRule("m", (3,), added=True, fixed="set_frame takes a Parameter for it")]

    def __repr__(self) -> str:
        return f"<Frame {self.name!r} on {self.body!r}>"


@dataclass(frozen=True, eq=False)
class PointSpring(_Frozen):
    """A spring and viscous damper along the line between two points.

    The pull is stiffness * (l - rest_length) + damping * dl/dt, with l the distance. Points are in body axes; a body
    may be ``"world"``. Where l = 0 a spring without damping and rest length has zero force; the force of any other one
    is not defined, and every engine raises `NumericalError` for the quantities that contain it.

    Attributes
    ----------
    name, body_a, body_b : str
    point_a, point_b : (3,) arrays
        m, in the axes of their bodies.
    stiffness, rest_length, damping : float
        N/m, m and N s/m.
    """

    section = "springs"
    name: str
    body_a: str
    point_a: Place
    body_b: str
    point_b: Place
    stiffness: Annotated[float, NumberRule("N/m", least=0.0)]
    rest_length: Annotated[float, NumberRule("m", least=0.0)]
    damping: Annotated[float, NumberRule("N s/m", least=0.0)]

    @property
    def needs_direction(self) -> bool:
        """Whether the force is undefined where the two points meet."""
        return self.damping != 0 or (self.stiffness != 0 and self.rest_length != 0)


@dataclass(frozen=True, eq=False)
class JointCoupling(_Frozen):
    """A spring, a viscous damper and a rotor on a sum of joint coordinates: MuJoCo's fixed tendon.

    With the length l = Σ factor q over `joints` of one velocity it has the potential energy
    ½ stiffness (l - rest_length)², dissipates damping (dl/dt)² and has the kinetic energy ½ armature (dl/dt)².

    Attributes
    ----------
    name : str
    joints : tuple of str
    factors : (k,) array
        One for each joint.
    stiffness, rest_length, damping, armature : float
        SI units of the length l, which may be radians or metres.
    """

    section = "couplings"
    name: str
    joints: tuple[str, ...]
    factors: Annotated[Array, NumberRule(shape=("joints",))]
    stiffness: Annotated[float, NumberRule("N m/rad, N/m", least=0.0, does="V")]
    rest_length: Annotated[float, NumberRule("rad, m")]
    damping: Annotated[float, NumberRule("N m s/rad, N s/m", least=0.0, does="loss")]
    armature: Annotated[float, NumberRule("kg m², kg", least=0.0, does="T")]

    @property
    def length(self) -> str:
        """The sum as text, such as ``"j1 - 2 j2"``."""
        terms = [joint if c == 1 else f"{c:g} {joint}" for c, joint in zip(self.factors, self.joints, strict=True)]
        return " + ".join(terms).replace("+ -", "- ")

    def __str__(self) -> str:
        given = [f"{n.replace('_', ' ')} {x:g}" for n, _, x in numbers(self) if n != "factors" and x]
        return f"coupling {self.name!r} on {self.length or 'no joint'}: {', '.join(given) or 'it exerts no force'}"


@dataclass(frozen=True, eq=False)
class Loop(_Frozen):
    """A loop closure: a joint between two bodies that the tree has already placed.

    Attributes
    ----------
    name, kind, body_a, body_b : str
        A `kind` is one of `mbkit.model.loops.LOOP_KINDS`.
    rotation_a, rotation_b : (3, 3) arrays
        Axes of the frames in body axes, with the joint's axis along z; unused by points and rods.
    translation_a, translation_b : (3,) arrays
        The two points in body axes, m.
    length : float
        Of a rod between the points, m; zero for every other kind.
    """

    section = "loops"
    name: str
    kind: str
    body_a: str
    rotation_a: Rotation
    translation_a: Place
    body_b: str
    rotation_b: Rotation
    translation_b: Place
    length: Annotated[float, NumberRule("m", least=0.0, positive=True)] = 0.0


@dataclass(frozen=True, eq=False)
class Coupler(_Frozen):
    """A coordinate that follows others in fixed ratios, or one by a curve, as a constraint.

    q = offset + Σ ratio leader, and of one leader + curve[0] leader² + curve[1] leader³ + curve[2] leader⁴. All joints
    keep their coordinates. A joint that mimics has none of its own.

    Attributes
    ----------
    name, joint : str
    leader : str or tuple of str
        One joint, or several; each has one velocity, as `joint` has.
    ratio : float or (k,) array
        Of the one leader, or of each: as rad or m of `joint` for rad or m of the leader.
    offset : float
        rad or m.
    curve : (3,) array
        Coefficients of the second, third and fourth power of a single leader.
    """

    section = "couplers"
    name: str
    joint: str
    leader: str | tuple[str, ...]
    ratio: Annotated[float | Array, NumberRule(shape=("leader",))] = 1.0
    offset: Annotated[float, NumberRule("rad, m", added=True)] = 0.0
    curve: Annotated[Array, NumberRule(shape=("_powers",))] = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if not all(isinstance(x, str) for x in (self.leader if isinstance(self.leader, tuple) else (self.leader,))):
            raise self._fault(f"leader: expected the name of a joint or a tuple of several, got {shown(self.leader)}")
        if isinstance(self.leader, tuple) and isinstance(self.ratio, (int, float)):
            object.__setattr__(self, "ratio", np.full(len(self.leader), self.ratio))
        super().__post_init__()
        if isinstance(self.leader, tuple) and len(self.leader) == 1:
            # One leader has one form: equal parts are equal, whoever wrote them.
            object.__setattr__(self, "leader", self.leader[0])
            object.__setattr__(self, "ratio", float(self.ratios[0]))

    #: Power of the leader, which `curve` has.
    _powers = ("2", "3", "4")

    @property
    def leaders(self) -> tuple[str, ...]:
        """The joints that lead, also where it is one."""
        return (self.leader,) if isinstance(self.leader, str) else self.leader

    @property
    def ratios(self) -> Array:
        """The ratio of each leader, (k,)."""
        return np.atleast_1d(self.ratio)

    @property
    def polynomial(self) -> Polynomial:
        """The joint's coordinate as a function of the first leader's, with all others at zero."""
        return Polynomial([self.offset, self.ratios[0], *self.curve])

    def follow(self, leading: ArrayLike) -> tuple[float, Array]:
        """Return the joint's coordinate where the leaders' are `leading`, (k,), and its derivatives by them, (k,)."""
        (first, *others), ratios = finite_array("leading", leading, (len(self.leaders),)), self.ratios[1:]
        curve = self.polynomial
        return float(curve(first) + ratios @ others), np.array([curve.deriv()(first), *ratios])


class OfJoint(_Frozen):
    """A motion of a joint in time, which has the joint's name: there is one."""

    section = "prescribed"
    joint: str

    @property
    def name(self) -> str:
        """The joint's, which has one motion."""
        return self.joint


@dataclass(frozen=True, eq=False)
class Prescribed(OfJoint):
    """A coordinate moved in time: offset + rate t + amplitude sin(frequency t + phase).

    Attributes
    ----------
    joint : str
    offset, rate, amplitude : float
        rad or m, per second for the rate.
    frequency, phase : float
        rad/s and rad.
    """

    joint: str
    offset: Annotated[float, NumberRule("rad, m", added=True)] = 0.0
    rate: Annotated[float, NumberRule("rad/s, m/s", added=True)] = 0.0
    amplitude: Annotated[float, NumberRule("rad, m")] = 0.0
    frequency: Annotated[float, NumberRule("rad/s")] = 0.0
    phase: Annotated[float, NumberRule("rad", added=True)] = 0.0

    #: Constants of a formula; numbers that are attributes do not count.
    constants = ()


@dataclass(frozen=True, eq=False)
class NoSlip(_Frozen):
    """A point of body a that does not slip past body b: of a blade, or where a disc or sphere touches a plane.

    The velocity of a blade's point, as body b sees it, has the component `speed` along one direction. A disc or sphere
    stays on the plane, and its point of contact has no velocity there (`mbkit.model.loops`).

    Attributes
    ----------
    name, kind, body_a, body_b : str
        A `kind` is one of `mbkit.model.loops.NO_SLIP_ROWS`.
    translation_a : (3,) array
        A blade's point, or the centre of a disc or sphere, in the axes of body a, m.
    axis_a : (3,) array
        Unit vector in the axes of body a: a blade's direction or a disc's axis. Zero for a sphere, and for a blade
        whose direction body b carries.
    translation_b : (3,) array
        A point of the plane in the axes of body b, m.
    axis_b : (3,) array
        Unit vector in the axes of body b: the plane's normal, or a blade's direction.
    radius : float
        Of a disc or sphere, m; zero for a blade.
    speed : float
        Of a blade, m/s; zero for the others.
    """

    section = "no_slip"
    name: str
    kind: str
    body_a: str
    translation_a: Place
    axis_a: Axis
    body_b: str
    translation_b: Place
    axis_b: Axis
    radius: Annotated[float, NumberRule("m", least=0.0, positive=True)] = 0.0
    speed: Annotated[float, NumberRule("m/s")] = 0.0

    def __str__(self) -> str:
        size = f" of radius {self.radius:g} m" if self.radius else f" at {self.speed:g} m/s" if self.speed else ""
        return f"no slip {self.name!r}: {self.kind}{size}, {self.body_a!r} on {self.body_b!r}"
