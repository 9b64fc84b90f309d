"""What each kind of joint is, once: its sizes, placement, twist and velocities.

The formulas use only ``+ - * /`` and the functions `sin` and `cos` of the module
passed as `m`, so the same lines serve NumPy batches, CasADi graphs, SymPy and
mpmath. Coordinates are sequences of scalars; a rotation is a list of three rows.

Conventions (Featherstone 2008, ch. 4.4, with the choices below)
    The child frame moves relative to the joint frame J, which is fixed in the
    parent. ``placement`` gives (R_JC, p_JC_J). ``twist`` gives the velocity of C
    relative to J as (linear, angular) of C's origin, both in C's axes.
    ``qdot`` is D(q) v, ``pullback`` is D(q)ᵀ x, and ``hamel`` is the term that the
    Boltzmann–Hamel equation adds to d/dt ∂T/∂v for quasi-velocities
    (Greenwood 2003, Advanced Dynamics, eq. 4.77; zero where v = q̇).
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any, Final

from mbkit.model.quaternions import Components, cross, rotate, rotate_back

__all__ = [
    "KINDS",
    "JointKind",
    "Scalars",
    "acceleration_in_parent",
    "cross3",
    "kind_of",
    "velocity_in_body",
    "velocity_in_parent",
]


Scalars = Sequence[Any]
Rows = list[list[Any]]
_IDENTITY: Final[Rows] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def cross3(a: Scalars, b: Scalars) -> list[Any]:
    """Return a × b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _about(m: ModuleType, axis: Scalars, angle: Any) -> Rows:
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


def _times(R: Rows, x: Scalars) -> list[Any]:
    return [sum(R[i][k] * x[k] for k in range(3)) for i in range(3)]


def _times_transposed(R: Rows, x: Scalars) -> list[Any]:
    return [sum(R[k][i] * x[k] for k in range(3)) for i in range(3)]


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


class JointKind:
    """A kind of joint; the subclasses below are all there are.

    Attributes
    ----------
    name : str
    nq, nv : int
        Coordinates and velocities.
    n_axes : int
        How many unit axes a joint of this kind is given.
    quaternion : int or None
        Where the quaternion starts among the coordinates.
    suffixes, velocity_suffixes : tuple of str
        Names of the coordinates and velocities, behind the joint's own.
    angular, lengths : tuple of int
        Which coordinates are angles and which are lengths.
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

    @property
    def coordinate_velocities(self) -> bool:
        """Whether v = q̇, so that D = 1."""
        return self.quaternion is None

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        """Return R_JC and p_JC_J."""
        raise NotImplementedError

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        """Return the linear and angular velocity of C in J, in C's axes."""
        raise NotImplementedError

    def qdot(self, q: Scalars, v: Scalars) -> list[Any]:
        """Return D(q) v."""
        return list(v)

    def pullback(self, q: Scalars, g: Scalars) -> list[Any]:
        """Return D(q)ᵀ g."""
        return list(g)

    def hamel(self, v: Scalars, p: Scalars) -> list[Any]:
        """Return what is added to d/dt p, for momenta p = ∂T/∂v."""
        return [0.0] * self.nv


class _Fixed(JointKind):
    name, nq, nv, suffixes, velocity_suffixes = "fixed", 0, 0, (), ()

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        return _IDENTITY, [0.0, 0.0, 0.0]

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        return [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]


class _Revolute(JointKind):
    name, nq, nv, n_axes, angular = "revolute", 1, 1, 1, (0,)

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        return _about(m, joint.axes[0], q[0]), [0.0, 0.0, 0.0]

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        return [0.0, 0.0, 0.0], [a * v[0] for a in joint.axes[0]]


class _Continuous(_Revolute):
    name = "continuous"


class _Prismatic(JointKind):
    name, nq, nv, n_axes, lengths = "prismatic", 1, 1, 1, (0,)

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        return _IDENTITY, [a * q[0] for a in joint.axes[0]]

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        return [a * v[0] for a in joint.axes[0]], [0.0, 0.0, 0.0]


class _Helical(_Revolute):
    # The axis is an eigenvector of the rotation, so the advance has the same
    # components in J and in C.
    name = "helical"

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        return _about(m, joint.axes[0], q[0]), [joint.pitch * a * q[0] for a in joint.axes[0]]

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        return [joint.pitch * a * v[0] for a in joint.axes[0]], [a * v[0] for a in joint.axes[0]]


class _Universal(JointKind):
    name, nq, nv, n_axes, angular = "universal", 2, 2, 2, (0, 1)
    suffixes = velocity_suffixes = ("1", "2")

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        return _matmul(_about(m, joint.axes[0], q[0]), _about(m, joint.axes[1], q[1])), [0.0, 0.0, 0.0]

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        first = _times_transposed(_about(m, joint.axes[1], q[1]), joint.axes[0])
        return [0.0, 0.0, 0.0], [first[i] * v[0] + joint.axes[1][i] * v[1] for i in range(3)]


class _SphericalZYX(JointKind):
    name, nq, nv, angular = "spherical_zyx", 3, 3, (0, 1, 2)
    suffixes = velocity_suffixes = ("z", "y", "x")

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        zy = _matmul(_about(m, (0, 0, 1), q[0]), _about(m, (0, 1, 0), q[1]))
        return _matmul(zy, _about(m, (1, 0, 0), q[2])), [0.0, 0.0, 0.0]

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        s1, c1, s2, c2 = m.sin(q[1]), m.cos(q[1]), m.sin(q[2]), m.cos(q[2])
        return [0.0, 0.0, 0.0], [
            v[2] - s1 * v[0],
            c1 * s2 * v[0] + c2 * v[1],
            c1 * c2 * v[0] - s2 * v[1],
        ]


class _Ball(JointKind):
    name, nq, nv, quaternion = "ball", 4, 3, 0
    suffixes, velocity_suffixes = ("qx", "qy", "qz", "qw"), ("wx", "wy", "wz")

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        return _from_quaternion(q), [0.0, 0.0, 0.0]

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        return [0.0, 0.0, 0.0], list(v)

    def qdot(self, q: Scalars, v: Scalars) -> list[Any]:
        return _quaternion_rate(q, v)

    def pullback(self, q: Scalars, g: Scalars) -> list[Any]:
        return _quaternion_pullback(q, g)

    def hamel(self, v: Scalars, p: Scalars) -> list[Any]:
        return cross3(v, p)


class _Planar(JointKind):
    name, nq, nv, lengths, angular = "planar", 3, 3, (0, 1), (2,)
    suffixes = velocity_suffixes = ("x", "y", "theta")

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        return _about(m, (0, 0, 1), q[2]), [q[0], q[1], 0.0]

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        c, s = m.cos(q[2]), m.sin(q[2])
        return [c * v[0] + s * v[1], c * v[1] - s * v[0], 0.0], [0.0, 0.0, v[2]]


class _Free(JointKind):
    name, nq, nv, quaternion, lengths = "free", 7, 6, 3, (0, 1, 2)
    suffixes = ("x", "y", "z", "qx", "qy", "qz", "qw")
    velocity_suffixes = ("vx", "vy", "vz", "wx", "wy", "wz")

    def placement(self, m: ModuleType, joint: Any, q: Scalars) -> tuple[Rows, list[Any]]:
        return _from_quaternion(q[3:]), list(q[:3])

    def twist(self, m: ModuleType, joint: Any, q: Scalars, v: Scalars) -> tuple[list[Any], list[Any]]:
        return list(v[:3]), list(v[3:])

    def qdot(self, q: Scalars, v: Scalars) -> list[Any]:
        return _times(_from_quaternion(q[3:]), v[:3]) + _quaternion_rate(q[3:], v[3:])

    def pullback(self, q: Scalars, g: Scalars) -> list[Any]:
        return _times_transposed(_from_quaternion(q[3:]), g[:3]) + _quaternion_pullback(q[3:], g[3:])

    def hamel(self, v: Scalars, p: Scalars) -> list[Any]:
        # Kirchhoff's equations (Lamb 1932, art. 124): the coadjoint action on (p, l).
        spin = cross3(v[3:], p[3:])
        slip = cross3(v[:3], p[:3])
        return cross3(v[3:], p[:3]) + [spin[i] + slip[i] for i in range(3)]


KINDS: Final[dict[str, JointKind]] = {
    kind.name: kind
    for kind in (
        _Fixed(),
        _Revolute(),
        _Continuous(),
        _Prismatic(),
        _Helical(),
        _Universal(),
        _SphericalZYX(),
        _Ball(),
        _Planar(),
        _Free(),
    )
}


def kind_of(name: str) -> JointKind:
    """Return the kind of this name."""
    return KINDS[name]


# A free joint's velocity in the axes that the integrators use.
#
# mbkit's is linear then angular, both in body axes. Inside the integrators the
# linear part is in the axes of the joint's fixed frame J (world axes for a
# floating base), as in MuJoCo: ṗ is then the velocity itself, positions add up,
# and a body that spins without forces keeps its linear velocity to the bit.
#
# With R = R_JB and body-axes velocity (v, w)::
#
#     v_J = R v                 a_J = R (a + w × v)
#
# Quaternion, linear and angular parts are sequences of components, as in
# `mbkit.model.quaternions`.


def velocity_in_parent(quaternion: Components, linear: Components) -> list[Any]:
    """Return R v."""
    return rotate(quaternion, linear)


def velocity_in_body(quaternion: Components, linear: Components) -> list[Any]:
    """Return Rᵀ v_J."""
    return rotate_back(quaternion, linear)


def acceleration_in_parent(
    quaternion: Components, linear: Components, angular: Components, rate: Components
) -> list[Any]:
    """Return R (a + w × v), from the body-axes velocity and its rate a."""
    turn = cross(angular, linear)
    return rotate(quaternion, [rate[i] + turn[i] for i in range(3)])
