"""The parts of a description: bodies, joints, springs, loops. Frozen data.

All lengths are metres, masses kilograms, angles radians. Arrays are read-only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array, shown
from mbkit.errors import ModelError
from mbkit.model.joint_types import JointType, kind_of, register_joint_type

#: Armature of a joint that rests, kg m² or kg: what accelerates it is smaller than any rounding, and articulated
#: inertias beside it are those of a fixed joint to the last bit.
RESTING: Final = 1e30
_ONE: Final = np.eye(3)
#: Of a matrix: what digits of a file leave of its orthogonality and symmetry.
_TURNED: Final = 1e-6


def _turns(R: Array) -> bool:
    """Return whether a matrix is a rotation; one of unknown numbers may be."""
    return not np.isfinite(R).all() or bool(np.abs(R @ R.T - _ONE).max() <= _TURNED and np.linalg.det(R) > 0)


def read_only(array: Array) -> Array:
    """Return an array that refuses to be written to: itself."""
    array.setflags(write=False)
    return array


class _Frozen:
    """Read-only arrays, equality by content, and pickling that keeps both."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]  # every subclass is a dataclass
            value = getattr(self, f.name)
            if f.type not in ("Array", "float", "float | Array") and (f.type != "Array | None" or value is None):
                continue
            try:
                # + 0.0 makes one of the two zeros, which are equal and hash apart.
                number = np.array(value, dtype=np.float64) + 0.0
            except (TypeError, ValueError):
                raise self._fault(f"{f.name}: expected numbers, got {shown(value)}") from None
            wanted = () if f.type == "float" else self._shape(f.name)
            if wanted is not None and number.shape != wanted:
                raise self._fault(f"{f.name}: expected shape {wanted}, got {number.shape}")
            if f.name.startswith("rotation") and not _turns(number):
                raise self._fault(f"{f.name} is not a rotation matrix; expected R Rᵀ = 1 and det R = 1")
            if f.name == "inertia" and np.abs(number - number.T).max() > _TURNED * np.abs(number).max():
                raise self._fault("inertia is not symmetric; expected I = Iᵀ")
            object.__setattr__(self, f.name, float(number) if wanted == () else read_only(number))

    def _fault(self, text: str) -> ModelError:
        what = type(self).__name__.lower()
        return ModelError(f"{what} {getattr(self, 'name', '')!r}" if hasattr(self, "name") else what, [text])

    def _shape(self, name: str) -> tuple[int, ...] | None:
        """Return the shape of an array; None where any will do."""
        if name.startswith("rotation") or name == "inertia":
            return 3, 3
        return (3,) if name == "com" or name.startswith(("translation", "point_", "axis_")) else None

    def _values(self) -> tuple[Any, ...]:
        return tuple(getattr(self, f.name) for f in fields(self))  # type: ignore[arg-type]

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        pairs = zip(self._values(), other._values(), strict=True)
        return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)

    def __hash__(self) -> int:
        return hash(tuple(v.tobytes() if isinstance(v, np.ndarray) else v for v in self._values()))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), self._values()


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

    name: str
    mass: float
    com: Array
    inertia: Array

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
    ratio: float = 1.0
    offset: float = 0.0


_PER_VELOCITY: Final = (
    *("velocity_limit", "effort_limit", "armature", "damping", "friction", "stiffness", "rest"),
    *("stiction", "stribeck_velocity"),
)


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
        Limits of the coordinates, infinite where there are none.
    velocity_limit, effort_limit, armature, damping, friction, stiffness, rest : (nv,) arrays
        Per velocity. `stiffness` acts on q - `rest`, `damping` on v, dry `friction` against v at any speed; the limits
        are data only.
    mimic : Mimic or None
        The joint that this one follows; its coordinate is then not free.
    stiction, stribeck_velocity : (nv,) arrays or None
        The largest dry friction at rest, that of motion without; and the velocity at which it falls to that.
    """

    name: str
    kind: str
    parent: str
    child: str
    rotation: Array
    translation: Array
    axes: Array
    pitch: float
    lower: Array
    upper: Array
    velocity_limit: Array
    effort_limit: Array
    armature: Array
    damping: Array
    friction: Array
    stiffness: Array
    rest: Array
    mimic: Mimic | None = None
    stiction: Array | None = None
    stribeck_velocity: Array | None = None

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

    def _shape(self, name: str) -> tuple[int, ...] | None:
        type_ = self.type
        if name == "axes":
            return type_.n_axes, 3
        if name in ("lower", "upper"):
            return (type_.nq,)
        return (type_.nv,) if name in _PER_VELOCITY else super()._shape(name)

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        # Another process may not have registered the type.
        return (type(self), self._values()) if self.type.built_in else (_of_type, (self.type, self._values()))


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

    name: str
    body: str
    rotation: Array
    translation: Array

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

    name: str
    body_a: str
    point_a: Array
    body_b: str
    point_b: Array
    stiffness: float
    rest_length: float
    damping: float

    @property
    def needs_direction(self) -> bool:
        """Whether the force is undefined where the two points meet."""
        return self.damping != 0 or (self.stiffness != 0 and self.rest_length != 0)


_OF_COUPLING: Final = ("stiffness", "rest_length", "damping", "armature")


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

    name: str
    joints: tuple[str, ...]
    factors: Array
    stiffness: float
    rest_length: float
    damping: float
    armature: float

    @property
    def length(self) -> str:
        """The sum as text, such as ``"j1 - 2 j2"``."""
        terms = [joint if c == 1 else f"{c:g} {joint}" for c, joint in zip(self.factors, self.joints, strict=True)]
        return " + ".join(terms).replace("+ -", "- ")

    def __str__(self) -> str:
        numbers = [f"{n.replace('_', ' ')} {x:g}" for n in _OF_COUPLING if (x := getattr(self, n))]
        return f"coupling {self.name!r} on {self.length or 'no joint'}: {', '.join(numbers) or 'it exerts no force'}"


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

    name: str
    kind: str
    body_a: str
    rotation_a: Array
    translation_a: Array
    body_b: str
    rotation_b: Array
    translation_b: Array
    length: float = 0.0


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

    name: str
    joint: str
    leader: str | tuple[str, ...]
    ratio: float | Array = 1.0
    offset: float = 0.0
    curve: Array = field(default_factory=lambda: np.zeros(3))

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

    def _shape(self, name: str) -> tuple[int, ...] | None:
        if name == "ratio":
            return () if isinstance(self.leader, str) else (len(self.leader),)
        return (3,) if name == "curve" else super()._shape(name)


@dataclass(frozen=True, eq=False)
class Prescribed(_Frozen):
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
    offset: float = 0.0
    rate: float = 0.0
    amplitude: float = 0.0
    frequency: float = 0.0
    phase: float = 0.0

    #: Of a formula; numbers that are attributes do not count.
    constants = ()

    @property
    def name(self) -> str:
        """The joint's, which has one motion."""
        return self.joint


@dataclass(frozen=True, eq=False)
class NoSlip(_Frozen):
    """A point of body a that does not slip past body b: of a blade, or where a disc or sphere touches a plane.

    The velocity of a blade's point, as body b sees it, has the component `speed` along one direction. A disc or sphere
    stays on the plane, and its point of contact has no velocity there (`mbkit.model.rolling`).

    Attributes
    ----------
    name, kind, body_a, body_b : str
        A `kind` is one of `mbkit.model.rolling.NO_SLIP_ROWS`.
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

    name: str
    kind: str
    body_a: str
    translation_a: Array
    axis_a: Array
    body_b: str
    translation_b: Array
    axis_b: Array
    radius: float = 0.0
    speed: float = 0.0

    def __str__(self) -> str:
        size = f" of radius {self.radius:g} m" if self.radius else f" at {self.speed:g} m/s" if self.speed else ""
        return f"no slip {self.name!r}: {self.kind}{size}, {self.body_a!r} on {self.body_b!r}"
