"""Joint types: sizes, placement, twist and velocities of each, and the registry for types of one's own.

Formulas use only ``+ - * /`` and ``m.sin`` and ``m.cos`` of single coordinates, where `m` is NumPy, CasADi, SymPy's
trigonometric ring or mpmath. Coordinates are sequences of scalars; a rotation is a list of three rows.

Conventions (Featherstone 2008, ch. 4.4, with the choices below): the child frame C moves relative to the joint frame J,
which is fixed in the parent.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from functools import cached_property
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit import spatial
from mbkit._check import COMPLEX_STEP, ITERATED, Array
from mbkit.errors import InputError, UnsupportedError
from mbkit.model.quaternions import cross

Scalars = Sequence[Any]
Rows = list[list[Any]]
#: R_JC and p_JC_J.
Placement = tuple[Rows, list[Any]]
#: Linear and angular velocity.
Twist = tuple[list[Any], list[Any]]
_IDENTITY: Final[Rows] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
_ZERO: Final = [0.0, 0.0, 0.0]


class SingleMotion(NamedTuple):
    """A turn about an axis, by a coordinate, with this advance per radian; or, without a turn, a slide along it."""

    axis: Scalars
    turns: bool = True
    advance: Any = 0.0


cross3: Final = cross


def dot3(a: Scalars, b: Scalars) -> Any:
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _about(m: Any, axis: Scalars, angle: Any) -> Rows:
    # Rodrigues with the diagonal as a² + (1 - a²) c: exact zeros and ones of an
    # axis along x, y or z stay exact and vanish from a symbolic graph.
    c, s = m.cos(angle), m.sin(angle)
    x, y, z = axis
    xy, yz, zx = x * y * (1 - c), y * z * (1 - c), z * x * (1 - c)
    return [
        [x * x + (1 - x * x) * c, xy - z * s, zx + y * s],
        [xy + z * s, y * y + (1 - y * y) * c, yz - x * s],
        [zx - y * s, yz + x * s, z * z + (1 - z * z) * c],
    ]


def _matmul(A: Rows, B: Rows) -> Rows:
    return [[sum(A[i][k] * B[k][j] for k in range(3)) for j in range(3)] for i in range(3)]


def _times(R: Rows, x: Scalars, transposed: bool = False) -> list[Any]:
    return [sum((R[k][i] if transposed else R[i][k]) * x[k] for k in range(3)) for i in range(3)]


def _from_quaternion(q: Scalars) -> Rows:
    x, y, z, w = q
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _quaternion_rate(q: Scalars, w: Scalars) -> list[Any]:
    # q̇ = ½ q ∘ (w, 0), w in body axes
    x, y, z, s = q
    a, b, c = w
    return [
        0.5 * (s * a + y * c - z * b),
        0.5 * (s * b + z * a - x * c),
        0.5 * (s * c + x * b - y * a),
        -0.5 * (x * a + y * b + z * c),
    ]


def _quaternion_pullback(q: Scalars, g: Scalars) -> list[Any]:
    x, y, z, s = q
    return [
        0.5 * (s * g[0] + z * g[1] - y * g[2] - x * g[3]),
        0.5 * (s * g[1] - z * g[0] + x * g[2] - y * g[3]),
        0.5 * (s * g[2] + y * g[0] - x * g[1] - z * g[3]),
    ]


class JointType:
    """A type of joint. A subclass gives the attributes and formulas, `register_joint_type` makes an instance known.

    Attributes
    ----------
    name : str
    nq, nv : int
        Coordinates and velocities.
    n_axes : int
        Unit axes that a joint of this type takes from its description, ``joint.axes``.
    quaternion : int or None
        Index of the first coordinate of a quaternion (x, y, z, w), which comes last.
    suffixes, velocity_suffixes : tuple of str
        Names of the coordinates and velocities, behind the joint's own.
    angular, lengths : tuple of int
        Coordinates that are angles, and that are lengths.
    pitched : bool
        Whether it takes an advance per radian from its description, ``joint.pitch``.
    screws : tuple of int
        Angles that the formulas also use outside of sine and cosine.
    gimbal : int or None
        Angle at whose odd quarter turns the velocities become dependent.
    floating : bool
        Whether q is position and quaternion, and v linear and angular velocity in the child's axes.
    axial : bool
        Whether the joint's frame may turn about its axis and slide along it without a change of the motion.
    like : str
        Name of a joint type of the same motion, which differs in its limits alone.
    instead : str
        What users of other engines may take, for messages.
    """

    name: str
    nq: int
    nv: int
    n_axes: int = 0
    quaternion: int | None = None
    suffixes: tuple[str, ...] = ("",)
    velocity_suffixes: tuple[str, ...] = ("",)
    angular: tuple[int, ...] = ()
    lengths: tuple[int, ...] = ()
    pitched: bool = False
    screws: tuple[int, ...] = ()
    gimbal: int | None = None
    floating: bool = False
    axial: bool = False
    like: str = ""
    # Without an annotation: no formula depends on it, and it stands in no digest.
    instead = ""

    def __repr__(self) -> str:
        return f"<joint type {self.name!r}: nq={self.nq}, nv={self.nv}>"

    @property
    def coordinate_velocities(self) -> bool:
        """Whether v = q̇, so that D = 1; then the joint can have springs."""
        return self.quaternion is None

    @property
    def rotates(self) -> bool:
        """Whether the child can turn."""
        return bool(self.angular) or self.quaternion is not None

    @property
    def motion(self) -> str:
        """The same text for types of the same motion."""
        return self.like or self.name

    @property
    def built_in(self) -> bool:
        """Whether mbkit defines this type."""
        return type(self).__module__ == __name__

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the attributes and of what the formulas compute at fixed random states."""
        total = hashlib.sha256(repr([getattr(self, name) for name in _ATTRIBUTES]).encode())
        for seed in range(3):
            joint, q, v = _sample(self, seed)
            R, p = self.placement(_REAL, joint, q)
            rates = self.qdot(q, v), self.pullback(q, q), self.hamel(v, v[::-1])
            for x in (*R, p, *self.twist(_REAL, joint, q, v), *rates):
                total.update(np.array(x, dtype=np.float64).tobytes())
        return total.hexdigest()

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        """Return R_JC and p_JC_J."""
        raise NotImplementedError

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        """Return the linear and angular velocity of C's origin relative to J, in C's axes."""
        raise NotImplementedError

    def motions(self, joint: Any) -> list[SingleMotion] | None:
        """Return the joint as motions of one coordinate each, one after the other; None where it is no such chain.

        Each axis stands in the frame that the motions before it have moved; v are the rates of the coordinates.
        """
        return None

    def qdot(self, q: Scalars, v: Scalars) -> list[Any]:
        """Return D(q) v."""
        k = self.quaternion
        return list(v) if k is None else [*v[:k], *_quaternion_rate(q[k:], v[k:])]

    def pullback(self, q: Scalars, g: Scalars) -> list[Any]:
        """Return D(q)ᵀ g."""
        k = self.quaternion
        return list(g) if k is None else [*g[:k], *_quaternion_pullback(q[k:], g[k:])]

    def hamel(self, v: Scalars, p: Scalars) -> list[Any]:
        """Return what the Boltzmann–Hamel equation adds to d/dt p, for momenta p = ∂T/∂v.

        Zero where v = q̇ (Greenwood 2003, Advanced Dynamics, eq. 4.77).
        """
        k = self.quaternion
        return [0.0] * self.nv if k is None else [0.0] * k + cross3(v[k:], p[k:])

    def integrate(self, q: Array, dq: Array) -> Array:
        """Return q ⊕ dq, (..., nq), of coordinates (..., nq) and tangents (..., nv)."""
        k = self.quaternion
        if k is None:
            return np.asarray(q + dq)
        turned = spatial.multiply(q[..., k:], spatial.exp_quaternion(dq[..., k:]))
        return np.concatenate([q[..., :k] + dq[..., :k], spatial.normalized(turned)], axis=-1)

    def difference(self, q0: Array, q1: Array) -> Array:
        """Return the dq with integrate(q0, dq) = q1, (..., nv)."""
        k = self.quaternion
        if k is None:
            return np.asarray(q1 - q0)
        turn = spatial.log_quaternion(spatial.multiply(spatial.conjugate(q0[..., k:]), q1[..., k:]))
        return np.concatenate([q1[..., :k] - q0[..., :k], turn], axis=-1)

    def hinge_axes(self, joint: Any) -> list[Array]:
        """Return the axes that the angles turn about at q = 0, in the child's frame."""
        q, unit = [0.0] * self.nq, np.eye(self.nv).tolist()
        return [np.array(self.twist(_REAL, joint, q, unit[i])[1], dtype=np.float64) for i in self.angular]


class _Fixed(JointType):
    name, nq, nv, suffixes, velocity_suffixes = "fixed", 0, 0, (), ()

    def motions(self, joint: Any) -> list[SingleMotion] | None:
        return []

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        return _IDENTITY, _ZERO

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        return _ZERO, _ZERO


class _Revolute(JointType):
    name, nq, nv, n_axes, angular, axial = "revolute", 1, 1, 1, (0,), True

    def motions(self, joint: Any) -> list[SingleMotion] | None:
        return [SingleMotion(joint.axes[0])]

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        return _about(m, joint.axes[0], q[0]), _ZERO

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        return _ZERO, [a * v[0] for a in joint.axes[0]]


class _Continuous(_Revolute):
    name, like = "continuous", "revolute"


class _Prismatic(JointType):
    name, nq, nv, n_axes, lengths, axial = "prismatic", 1, 1, 1, (0,), True

    def motions(self, joint: Any) -> list[SingleMotion] | None:
        return [SingleMotion(joint.axes[0], turns=False, advance=1.0)]

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        return _IDENTITY, [a * q[0] for a in joint.axes[0]]

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        return [a * v[0] for a in joint.axes[0]], _ZERO


class _Helical(_Revolute):
    # The axis is an eigenvector of the rotation, so the advance has the same
    # components in J and in C.
    name, pitched, screws = "helical", True, (0,)

    def motions(self, joint: Any) -> list[SingleMotion] | None:
        return [SingleMotion(joint.axes[0], advance=joint.pitch)]

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        return _about(m, joint.axes[0], q[0]), [joint.pitch * a * q[0] for a in joint.axes[0]]

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        return [joint.pitch * a * v[0] for a in joint.axes[0]], [a * v[0] for a in joint.axes[0]]


class _Universal(JointType):
    name, nq, nv, n_axes, angular = "universal", 2, 2, 2, (0, 1)
    suffixes = velocity_suffixes = ("1", "2")

    def motions(self, joint: Any) -> list[SingleMotion] | None:
        return [SingleMotion(joint.axes[0]), SingleMotion(joint.axes[1])]

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        return _matmul(_about(m, joint.axes[0], q[0]), _about(m, joint.axes[1], q[1])), _ZERO

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        first = _times(_about(m, joint.axes[1], q[1]), joint.axes[0], transposed=True)
        return _ZERO, [first[i] * v[0] + joint.axes[1][i] * v[1] for i in range(3)]


class _SphericalZYX(JointType):
    name, nq, nv, angular, gimbal = "spherical_zyx", 3, 3, (0, 1, 2), 1
    suffixes = velocity_suffixes = ("z", "y", "x")

    def motions(self, joint: Any) -> list[SingleMotion] | None:
        return [SingleMotion((0.0, 0.0, 1.0)), SingleMotion((0.0, 1.0, 0.0)), SingleMotion((1.0, 0.0, 0.0))]

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        zy = _matmul(_about(m, (0, 0, 1), q[0]), _about(m, (0, 1, 0), q[1]))
        return _matmul(zy, _about(m, (1, 0, 0), q[2])), _ZERO

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        s1, c1, s2, c2 = m.sin(q[1]), m.cos(q[1]), m.sin(q[2]), m.cos(q[2])
        return _ZERO, [v[2] - s1 * v[0], c1 * s2 * v[0] + c2 * v[1], c1 * c2 * v[0] - s2 * v[1]]


class _Ball(JointType):
    name, nq, nv, quaternion = "ball", 4, 3, 0
    suffixes, velocity_suffixes = ("qx", "qy", "qz", "qw"), ("wx", "wy", "wz")

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        return _from_quaternion(q), _ZERO

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        return _ZERO, list(v)


class _Planar(JointType):
    name, nq, nv, lengths, angular = "planar", 3, 3, (0, 1), (2,)
    suffixes = velocity_suffixes = ("x", "y", "theta")

    def motions(self, joint: Any) -> list[SingleMotion] | None:
        x, y = (SingleMotion(axis, turns=False, advance=1.0) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        return [x, y, SingleMotion((0.0, 0.0, 1.0))]

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        return _about(m, (0, 0, 1), q[2]), [q[0], q[1], 0.0]

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        c, s = m.cos(q[2]), m.sin(q[2])
        return [c * v[0] + s * v[1], c * v[1] - s * v[0], 0.0], [0.0, 0.0, v[2]]


class _Free(JointType):
    name, nq, nv, quaternion, lengths, floating = "free", 7, 6, 3, (0, 1, 2), True
    suffixes = ("x", "y", "z", "qx", "qy", "qz", "qw")
    velocity_suffixes = ("vx", "vy", "vz", "wx", "wy", "wz")

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        return _from_quaternion(q[3:]), list(q[:3])

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        return list(v[:3]), list(v[3:])

    def qdot(self, q: Scalars, v: Scalars) -> list[Any]:
        return _times(_from_quaternion(q[3:]), v[:3]) + _quaternion_rate(q[3:], v[3:])

    def pullback(self, q: Scalars, g: Scalars) -> list[Any]:
        return _times(_from_quaternion(q[3:]), g[:3], transposed=True) + _quaternion_pullback(q[3:], g[3:])

    def hamel(self, v: Scalars, p: Scalars) -> list[Any]:
        # Kirchhoff's equations (Lamb 1932, art. 124): the coadjoint action on (p, l).
        spin = cross3(v[3:], p[3:])
        slip = cross3(v[:3], p[:3])
        return cross3(v[3:], p[:3]) + [spin[i] + slip[i] for i in range(3)]

    def integrate(self, q: Array, dq: Array) -> Array:
        p, turn = spatial.exp_se3(dq)
        there = spatial.normalized(spatial.multiply(q[..., 3:], turn))
        return np.concatenate([q[..., :3] + spatial.rotate(q[..., 3:], p), there], axis=-1)

    def difference(self, q0: Array, q1: Array) -> Array:
        back = spatial.conjugate(q0[..., 3:])
        w = spatial.log_quaternion(spatial.multiply(back, q1[..., 3:]))
        p = spatial.rotate(back, q1[..., :3] - q0[..., :3])
        return np.concatenate([np.einsum("...ij,...j->...i", spatial.left_jacobian_inverse(w), p), w], axis=-1)


FIXED: Final = _Fixed()
REVOLUTE: Final = _Revolute()
UNIVERSAL: Final = _Universal()
PRISMATIC: Final = _Prismatic()
FREE: Final = _Free()

#: Joint type by name: the built-in ones, then those of `register_joint_type`.
KINDS: Final[dict[str, JointType]] = {
    joint_type.name: joint_type
    for joint_type in (
        *(FIXED, REVOLUTE, _Continuous(), PRISMATIC, _Helical()),
        *(UNIVERSAL, _SphericalZYX(), _Ball(), _Planar(), FREE),
    )
}


def kind_of(name: str) -> JointType:
    """Return the joint type of this name; `UnsupportedError` where none is registered in this process."""
    try:
        return KINDS[name]
    except KeyError:
        call = "call mbkit.model.register_joint_type first"
        raise UnsupportedError(f"joint type {name!r} is not registered in this process; {call}") from None


# Joint types of one's own

_ATTRIBUTES: Final = tuple(JointType.__annotations__)
_REAL: Final = SimpleNamespace(sin=np.sin, cos=np.cos)


def register_joint_type(joint_type: JointType) -> JointType:
    """Make an instance of a subclass of `JointType` known by its name, and return it.

    `ModelBuilder.add_joint`, the lagrangian engine, the oracle, `mbkit.lagrangian.from_model` (where v = q̇), simulation
    and studies take it; other engines and file formats refuse it by name. A process that unpickles a model with such
    joints imports the class, so the class has to stand in an importable module. It is not to change afterwards.

    Raises
    ------
    InputError
        Attributes that do not fit together; formulas that are no rigid motion, contradict each other, or cannot be
        evaluated with ``+ - * /``, sine and cosine alone; or a name that another type has.

    Examples
    --------
    >>> from mbkit.model import JointType, register_joint_type
    >>> class Cylindrical(JointType):
    ...     name, nq, nv, n_axes, lengths, angular = "doc_cylindrical", 2, 2, 1, (0,), (1,)
    ...     suffixes = velocity_suffixes = ("d", "angle")
    ...
    ...     def placement(self, m, joint, q):
    ...         R, _ = KINDS["revolute"].placement(m, joint, q[1:])
    ...         return R, [a * q[0] for a in joint.axes[0]]
    ...
    ...     def twist(self, m, joint, q, v):
    ...         return [a * v[0] for a in joint.axes[0]], [a * v[1] for a in joint.axes[0]]
    >>> register_joint_type(Cylindrical())
    <joint type 'doc_cylindrical': nq=2, nv=2>
    >>> _ = KINDS.pop("doc_cylindrical")  # a script keeps it
    """
    if not isinstance(joint_type, JointType):
        raise InputError(f"joint_type: expected an instance of a subclass of JointType, got {joint_type!r}")
    faults = list(_attribute_faults(joint_type)) or list(_formula_faults(joint_type))
    if faults:
        raise InputError(f"joint type {getattr(joint_type, 'name', '')!r}: {'; '.join(faults)}")
    known = KINDS.setdefault(joint_type.name, joint_type)
    if known is not joint_type and (known.built_in or known.digest != joint_type.digest):
        raise InputError(f"joint type {known.name!r}: the name is registered with other formulas; use another name")
    return known


def _attribute_faults(joint_type: JointType) -> Iterator[str]:
    missing = [name for name in _ATTRIBUTES if not hasattr(joint_type, name)]
    if missing:
        yield f"no {', '.join(missing)}; set them in the class"
        return
    name, nq, nv, k = joint_type.name, joint_type.nq, joint_type.nv, joint_type.quaternion
    if not isinstance(name, str) or not name.isidentifier():
        yield f"name: expected a word of letters, digits and underscores, got {name!r}"
    sizes = (("nq", nq, 1, 40), ("nv", nv, 1, 40), ("n_axes", joint_type.n_axes, 0, 2))
    wrong = [x for x in sizes if type(x[1]) is not int or not x[2] <= x[1] <= x[3]]
    yield from (f"{n}: expected an integer of {a} to {b}, got {x!r}" for n, x, a, b in wrong)
    if wrong:
        return
    if nq != nv + (k is not None) or (k is not None and k != nq - 4):
        expected = "expected nq = nv, or nq = nv + 1 and a quaternion that starts at nq - 4"
        yield f"nq {nq}, nv {nv}, quaternion {k}: {expected}"
    for n, size in (("suffixes", nq), ("velocity_suffixes", nv)):
        texts = getattr(joint_type, n)
        if not isinstance(texts, tuple) or len(texts) != size or len({x for x in texts if isinstance(x, str)}) != size:
            yield f"{n}: expected {size} different texts, got {texts!r}"
    plain = nq if k is None else k
    for n in ("angular", "lengths", "screws"):
        if not isinstance(getattr(joint_type, n), tuple) or not {*getattr(joint_type, n)} <= {*range(plain)}:
            yield f"{n}: expected a tuple of indices below {plain}, got {getattr(joint_type, n)!r}"
    angles, lengths = {*joint_type.angular}, {*joint_type.lengths}
    if angles | lengths != {*range(plain)} or angles & lengths:
        yield "angular and lengths: expected each coordinate outside a quaternion in one of them"
    if joint_type.gimbal is not None and joint_type.gimbal not in joint_type.angular:
        yield f"gimbal: expected one of the angles {joint_type.angular}, got {joint_type.gimbal!r}"
    if joint_type.floating and not isinstance(joint_type, _Free):
        yield "floating: only for subclasses of the type 'free'"
    if joint_type.like and joint_type.like not in KINDS:
        yield f"like: expected the name of a joint type, got {joint_type.like!r}"


def _sample(joint_type: JointType, seed: int) -> tuple[SimpleNamespace, list[float], list[float]]:
    rng = np.random.default_rng(seed)
    axes = spatial.normalized(rng.standard_normal((joint_type.n_axes, 3))) if joint_type.n_axes else np.zeros((0, 3))
    joint = SimpleNamespace(axes=axes.tolist(), pitch=0.3 if joint_type.pitched else 0.0)
    q, v = rng.standard_normal(joint_type.nq), rng.standard_normal(joint_type.nv)
    if (k := joint_type.quaternion) is not None:
        q[k:] = spatial.normalized(q[k:])
    return joint, q.tolist(), v.tolist()


class _Angle:
    """A coordinate that knows only its sine and cosine."""

    def __init__(self, value: float) -> None:
        self.value = value


_OF_ANGLES: Final = SimpleNamespace(
    sin=lambda x: np.sin(x.value if isinstance(x, _Angle) else x),
    cos=lambda x: np.cos(x.value if isinstance(x, _Angle) else x),
)


def _formula_faults(joint_type: JointType) -> Iterator[str]:
    """Yield the faults of the formulas at one random state."""
    joint, q, v = _sample(joint_type, 7)
    nq, nv, k = joint_type.nq, joint_type.nv, joint_type.quaternion
    try:
        D = np.array([joint_type.qdot(q, e) for e in np.eye(nv).tolist()], dtype=float).T
        moved = [x + 1j * COMPLEX_STEP * r for x, r in zip(q, joint_type.qdot(q, v), strict=True)]
        R, p = (np.array(x, dtype=complex) for x in joint_type.placement(_REAL, joint, moved))
        linear, angular = (np.array(x, dtype=float) for x in joint_type.twist(_REAL, joint, q, v))
        g, momentum = np.arange(1.0, nq + 1), np.arange(1.0, nv + 1)
        pulled = np.array(joint_type.pullback(q, g.tolist()), dtype=float)
        hamel = np.array(joint_type.hamel(v, momentum.tolist()), dtype=float)
        shapes = D.shape, R.shape, p.shape, linear.shape, angular.shape, pulled.shape, hamel.shape
    except Exception as error:  # a user's code may raise anything
        yield f"a formula fails: {type(error).__name__}: {error}; use + - * / and m.sin and m.cos alone"
        return
    if shapes != ((nq, nv), (3, 3), (3,), (3,), (3,), (nv,), (nv,)):
        expected = f"expected qdot, R, p, linear, angular, pullback and hamel of nq = {nq} and nv = {nv}"
        yield f"a formula returns another size: {expected}, got shapes {shapes}"
        return
    if not np.abs(R.real @ R.real.T - np.eye(3)).max() < ITERATED or not np.linalg.det(R.real) > 0:
        yield "placement: R is not a rotation matrix"
    rate, spin = R.real.T @ p.imag / COMPLEX_STEP, R.real.T @ R.imag / COMPLEX_STEP
    turning = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
    if not np.abs([linear - rate, angular - turning]).max() < ITERATED * max(1.0, np.abs(rate).max()):
        x = [np.round(y, 6).tolist() for y in (rate, turning, q, linear, angular)]
        expected = f"expected the rate of the placement, linear {x[0]} and angular {x[1]} at q = {x[2]}"
        yield f"twist: {expected}, got {x[3]} and {x[4]}"
    if k is None and not np.array_equal(D, np.eye(nv)):
        yield "qdot: expected v, for a type without a quaternion"
    if not np.abs(pulled - D.T @ g).max() < ITERATED * nq:
        yield "pullback: expected D(q)ᵀ g, with D of qdot"
    brackets = np.einsum("ijk,j,k->i", _structure(joint_type, q, D), v, momentum)
    if not np.abs(hamel - brackets).max() < ITERATED * nq:
        x = [y.round(6).tolist() for y in (brackets, hamel)]
        yield f"hamel: expected {x[0]}, by the brackets of D's columns, got {x[1]}"
    opaque = {i for i in joint_type.angular if i not in joint_type.screws}
    angles = [_Angle(x) if i in opaque else x for i, x in enumerate(q)]
    try:
        joint_type.placement(_OF_ANGLES, joint, angles)
        joint_type.twist(_OF_ANGLES, joint, angles, v)
    except (TypeError, AttributeError) as error:
        yield f"an angle enters other than by m.sin(q[i]) and m.cos(q[i]) ({error}); list it in screws"


def _structure(joint_type: JointType, q: list[float], D: Array) -> Array:
    """Return c of [D_i, D_j] = Σ c_ijk D_k."""
    nv, units = joint_type.nv, np.eye(joint_type.nv).tolist()

    def slope(direction: Array, unit: list[float]) -> Array:
        """Return the derivative of a column along a direction."""
        moved = [x + 1j * COMPLEX_STEP * r for x, r in zip(q, direction, strict=True)]
        return np.asarray(np.imag(joint_type.qdot(moved, unit)) / COMPLEX_STEP)

    slopes = np.array([[slope(D[:, i], e) for e in units] for i in range(nv)])
    brackets = slopes - slopes.transpose(1, 0, 2)
    return np.asarray((brackets.reshape(nv * nv, -1) @ np.linalg.pinv(D).T).reshape(nv, nv, nv))
