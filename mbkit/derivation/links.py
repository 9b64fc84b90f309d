"""The tree as links in axes of their own, with as few inertial numbers as its motion can show.

Bodies that a fixed joint holds are one link. A joint of several coordinates becomes links of one coordinate each, most
of them without matter. Each link turns about, or slides along, its own z axis, and where the description allows it,
constant rotations are permutations of axes or two plane rotations (Denavit and Hartenberg 1955). A ball joint, a free
joint and a type of one's own stay whole.

Inertial numbers are mass m, first moment h and inertia I about the link's origin, in its axes, with ::

    T = ½ m v·v + h·(v × ω) + ½ ω·I ω

**Regrouping** (Gautier and Khalil 1990, Direct calculation of minimum set of inertial parameters; Mayeda, Yoshida and
Osuka 1990). Matter whose motion a joint does not change is moved to the parent: behind a turn the mass, the first
moment along z and one transverse moment, behind a slide the whole inertia, behind a ball joint the mass. T is the same
function of q and v, and V up to a constant. Matter that nothing moves vanishes.

Numbers are moved in 120 bits and rounded once. Numbers with parameters stay where they are. The plain links have no
matter moved, and the frames and constants of the description.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import permutations, product
from typing import Any, Final

import casadi as ca
import mpmath

from mbkit.derivation.kinematics import Kinematics, Vector, add
from mbkit.derivation.model_values import cos, is_zero, scalar, sin
from mbkit.derivation.rotations import (
    SYMMETRIC,
    Factor,
    Matrix,
    Permutation,
    PlaneRotation,
    Rotation,
    Rows,
    congruence,
    to_parent,
)
from mbkit.model import Body, Joint
from mbkit.model.joint_types import SingleMotion, cross3, dot3


def _handedness(places: Sequence[int]) -> int:
    """Return 1 for an even permutation of three, -1 for an odd one."""
    a, b, c = places
    return (b - a) * (c - b) * (c - a) // 2


_MP: Final = mpmath.MPContext()
_MP.prec = 120
_IDENTITY: Final = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
_PERMUTATIONS: Final = [
    [[sign if places[i] == j else 0.0 for j, sign in enumerate(signs)] for i in range(3)]
    for places in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if _handedness(places) * signs[0] * signs[1] * signs[2] > 0
]
#: Sine of the angle between axes below which a description in doubles means parallel axes.
_PARALLEL: Final = 1e-15
#: Rounding of numbers of 120 bits, after some operations.
_NOISE: Final = 1e-30


@dataclass
class Inertia:
    """Mass, first moment and inertia about an origin, as numbers of 120 bits or as expressions."""

    mass: Any = 0.0
    moment: Vector = field(default_factory=lambda: [0.0] * 3)
    inertia: Vector = field(default_factory=lambda: [0.0] * 6)

    def __add__(self, other: Inertia) -> Inertia:
        return Inertia(self.mass + other.mass, add(self.moment, other.moment), add(self.inertia, other.inertia))

    def __sub__(self, other: Inertia) -> Inertia:
        moment, inertia = ([-x for x in part] for part in (other.moment, other.inertia))
        return self + Inertia(-other.mass, moment, inertia)

    def rotated(self, R: Rotation) -> Inertia:
        """Return the same in the axes of the parent."""
        return Inertia(self.mass, to_parent(R, self.moment), congruence(R, self.inertia))

    def shifted(self, r: Vector) -> Inertia:
        """Return the inertia about an origin at -r from its own."""
        at = [m + r_i * self.mass for m, r_i in zip(self.moment, r, strict=True)]
        both = add(self.moment, at)
        trace = dot3(both, r)
        out = list(self.inertia)
        for i in range(3):
            for j in range(i, 3):
                k = SYMMETRIC[i][j]
                if i == j:
                    out[k] = out[k] + (trace - both[i] * r[i])
                else:
                    out[k] = out[k] - 0.5 * (both[i] * r[j] + both[j] * r[i])
        return Inertia(self.mass, at, out)

    @property
    def rounded(self) -> Inertia:
        """The matter in doubles; parts that are expressions stay."""
        return Inertia(_rounded(self.mass), [_rounded(x) for x in self.moment], [_rounded(x) for x in self.inertia])


@dataclass
class Link:
    """A link and the motion that carries it.

    Attributes
    ----------
    joint : Joint
    parent : int
        Index of the parent's link, -1 for the world.
    fixed : Rotation
        R_PJ: from the axes before the motion to the parent's.
    translation : list of 3 scalars
        p_PJ, in the parent's axes.
    turn : Rotation
        R_JC of the motion.
    slide : list of 3 scalars
        p_JC, in J's axes.
    columns : list of (int, list of 6 scalars)
        Velocity index, and the linear and angular velocity of C relative to J per unit of that velocity, in C's axes.
    rate, drift : list of 6 scalars
        That relative velocity, and its derivative at constant velocities: zero where the columns stand still in C.
    rotors : list of scalars
        Rotor of each velocity, as the velocity that it follows feels it.
    inertia : Inertia
        The matter that is left to the link, about its origin.
    exact : Inertia
        The same in 120 bits, without expressions.
    motion : SingleMotion or None
        The motion along z, None for a joint that stays whole.
    """

    joint: Joint
    parent: int
    fixed: Rotation
    translation: Vector
    turn: Rotation = ()
    slide: Vector = field(default_factory=lambda: [0.0] * 3)
    columns: list[tuple[int, Vector]] = field(default_factory=list)
    rate: Vector = field(default_factory=lambda: [0.0] * 6)
    drift: Vector = field(default_factory=lambda: [0.0] * 6)
    rotors: list[Any] = field(default_factory=list)
    inertia: Inertia = field(default_factory=Inertia)
    exact: Inertia = field(default_factory=Inertia)
    motion: SingleMotion | None = None

    @property
    def rotation(self) -> Rotation:
        """R_PC."""
        return [*self.fixed, *self.turn]


class Links:
    """The links of a tree, every parent before its children.

    Parameters
    ----------
    kin : Kinematics
    short : bool
        Whether frames lie along common normals and matter is moved towards the root, for the fewest operations. If not,
        links have the description's own constants, exactly: no digit of them is rounded again.

    Attributes
    ----------
    links : list of Link
    """

    def __init__(self, kin: Kinematics, *, short: bool = True) -> None:
        self.kin, self._short = kin, short
        #: Motion of each link's frame: a rotation about z and a translation along z.
        self._turns: dict[int, Any] = {}
        self._slides: dict[int, Any] = {}
        self._place_links()
        if short:
            self._choose_frames()
            self._place_links()
        self._literal = [Inertia() for _ in self.links]
        self._symbolic: list[Inertia | None] = [None for _ in self.links]
        for body in kin.model.bodies:
            self._hold(body)
        if short:
            self._regroup()
        #: Whether all matter is in numbers.
        self.literal = not any(self._symbolic)
        for link, literal, symbolic in zip(self.links, self._literal, self._symbolic, strict=True):
            link.exact = literal
            link.inertia = literal.rounded if symbolic is None else literal.rounded + symbolic

    def _place_links(self) -> None:
        self.links: list[Link] = []
        #: R_PJ and p_PJ of each link in 120 bits.
        self._fixed: list[tuple[Rows, Vector]] = []
        #: Link of each body, and the rotation and translation of the body in it.
        self._places: dict[str, tuple[int, Rows, Vector]] = {"world": (-1, _IDENTITY, [0.0] * 3)}
        for joint in self.kin.model.tree:
            self._places[joint.child] = self._carry(joint)

    def place(self, body: str) -> tuple[int, list[Vector], Vector]:
        """Return the link of a body, -1 for the world, and the body's rotation and translation in it."""
        index, R, p = self._places[body]
        return index, [[_rounded(x) for x in row] for row in R], [_rounded(x) for x in p]

    def _choose_frames(self) -> None:
        """Turn frames about their z axes, and slide them along, so that places of children have more zeros.

        A child's constant turn about this link's z axis becomes part of this link's angle. An offset along an own axis
        is pushed to the children where it meets another one, or none.
        """
        children: list[list[int]] = [[] for _ in self.links]
        for index, link in enumerate(self.links):
            if link.parent >= 0:
                children[link.parent].append(index)
        pushed: dict[int, Any] = {}
        for index, link in enumerate(self.links):
            if link.motion is None or not link.motion.turns:
                continue
            votes: list[tuple[int, Any]] = []
            for child in children[index]:
                R, _ = self._fixed[child]
                if _literal(*(x for row in R for x in row)):
                    votes.append((child, 0 if _is_permutation(R) else _MP.atan2(R[1][0], R[0][0])))
            angles = [angle for _, angle in votes]
            if angles:
                best = max(angles, key=lambda angle: sum(_right_angles_apart(angle, x) for x in angles))
                if best:
                    self._turns[index] = best
            self._slides[index] = self._slide(index, pushed.get(link.parent, 0), children[index])
            pushed[index] = self._slides[index]

    def _slide(self, index: int, pushed: Any, children: list[int]) -> Any:
        """Return how far the frame of a link is moved along its axis."""
        R, p = self._fixed[index]
        if not _literal(*p, *(x for row in R for x in row)):
            return 0
        p = [p[0], p[1], p[2] - pushed]
        along = [k for k in range(3) if abs(R[k][2]) == 1]
        if not along or not p[along[0]]:
            return 0
        offset = -p[along[0]] * R[along[0]][2]
        lost = 0
        for child in children:
            R_child, at = self._fixed[child]
            if not _literal(*at):
                return 0
            # A parallel axis pushes it on.
            if not _literal(R_child[2][2]) or abs(R_child[2][2]) != 1:
                lost += (at[2] - offset != 0) - (at[2] != 0)
        return offset if lost < 1 else 0

    def _carry(self, joint: Joint) -> tuple[int, Rows, Vector]:
        """Add the links of a joint, and return the place of its child."""
        parent, R, p = self._places[joint.parent]
        values, kin = self.kin.values.of(joint), self.kin
        number = _exact if _literal(*(x for row in R for x in row), *p, *values.translation) else _rounded
        own: Rotation = [Matrix([[number(x) for x in row] for row in R])]
        p_J = add([number(x) for x in p], to_parent(own, [number(x) for x in values.translation]))
        R_J = _product(R, values.rotation)
        motions = joint.type.motions(values)
        if motions is None or not all(self._opens(motion) for motion in motions):
            return self._carry_whole(joint, parent, R_J, p_J)
        q, v = kin.coordinates(joint), kin.velocities(joint)
        first = self._velocities(joint)
        ratio = values.ratio if joint.mimic else 1.0
        for k, motion in enumerate(motions):
            R_J = _orthonormal(R_J) if self._short else R_J
            fixed, aligned = _aligned(R_J, motion.axis) if self._short else _permuted(R_J, motion.axis)
            index = len(self.links)
            slide = self._slides.get(index, 0)
            if slide:
                p_J = [_exact(x) + row[2] * slide for x, row in zip(p_J, fixed, strict=True)]
            link = Link(joint, parent, _factors(fixed, self._short), [_rounded(x) for x in p_J], motion=motion)
            angle = q[k]
            if index in self._turns:
                c, s = _MP.cos(self._turns[index]), _MP.sin(self._turns[index])
                aligned = _product(aligned, [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
                angle = angle + float(self._turns[index])
            link.turn = [PlaneRotation(2, cos(angle), sin(angle))] if motion.turns else []
            link.slide = [0.0, 0.0, motion.advance * q[k]]
            unit = [0.0, 0.0, motion.advance, 0.0, 0.0, 1.0 if motion.turns else 0.0]
            link.columns = [(first + k, [ratio * x for x in unit])]
            link.rate = [x * v[k] for x in unit]
            link.rotors = [values.rotors[k] * ratio * ratio]
            self.links.append(link)
            self._fixed.append((fixed, p_J))
            parent, R_J, p_J = index, _transposed(aligned), [0.0, 0.0, -slide if slide else 0.0]
        return parent, R_J, p_J

    def _opens(self, motion: SingleMotion) -> bool:
        """Return whether a motion becomes a link along z; the description's own frames have axes of x, y and z only."""
        if not _literal(*motion.axis):
            return False
        return self._short or sorted(abs(float(x)) for x in motion.axis) == [0.0, 0.0, 1.0]

    def _velocities(self, joint: Joint) -> int:
        return int(self.kin.model.layout.v[joint.mimic.joint if joint.mimic else joint.name].start)

    def _carry_whole(self, joint: Joint, parent: int, R_J: Rows, p_J: Vector) -> tuple[int, Rows, Vector]:
        """Add a joint that is no chain of single motions as one link."""
        kin, values = self.kin, self.kin.values.of(joint)
        q, v = kin.coordinates(joint), kin.velocities(joint)
        R, p = joint.type.placement(kin.formulas, values, q)
        link = Link(joint, parent, _factors(R_J, self._short), [_rounded(x) for x in p_J])
        link.turn, link.slide = [Matrix([[_rounded(x) for x in row] for row in R])], [_rounded(x) for x in p]
        first, ratio = self._velocities(joint), values.ratio if joint.mimic else 1.0
        for k in range(joint.type.nv):
            unit = [1.0 if i == k else 0.0 for i in range(joint.type.nv)]
            linear, angular = joint.type.twist(kin.formulas, values, q, unit)
            link.columns.append((first + k, [ratio * _rounded(x) for x in (*linear, *angular)]))
        linear, angular = joint.type.twist(kin.formulas, values, q, v)
        link.rate = [_rounded(x) for x in (*linear, *angular)]
        link.drift = _drift(link.rate, kin)
        link.rotors = [x * ratio * ratio for x in values.rotors]
        self.links.append(link)
        self._fixed.append((R_J, p_J))
        return len(self.links) - 1, _IDENTITY, [0.0] * 3

    def _hold(self, body: Body) -> None:
        """Add a body's matter to its link; what the world holds moves nothing."""
        index, R, p = self._places[body.name]
        if index < 0:
            return
        own = self.kin.values.of(body)
        entries = [own.inertia[i][j] for i in range(3) for j in range(i, 3)]
        literal = _literal(own.mass, *own.com, *entries, *(x for row in R for x in row), *p)
        number = _exact if literal else _rounded
        rotation: Rotation = [Matrix([[number(x) for x in row] for row in R])]
        at = add([number(x) for x in p], to_parent(rotation, [number(x) for x in own.com]))
        turned = congruence(rotation, [number(x) for x in entries])
        point = Inertia(number(own.mass)).shifted(at)
        matter = Inertia(point.mass, point.moment, add(point.inertia, turned))
        if literal:
            self._literal[index] = self._literal[index] + matter
        else:
            known = self._symbolic[index]
            self._symbolic[index] = matter if known is None else known + matter

    def _regroup(self) -> None:
        """Move what no motion tells from the parent's matter, from the leaves to the root."""
        for index in reversed(range(len(self.links))):
            link, own = self.links[index], self._literal[index]
            place = [x for factor in link.fixed for x in factor.numbers]
            if not _literal(*place, *link.translation):
                continue
            moved = _movable(link, own)
            self._literal[index] = own - moved
            if link.parent >= 0:
                above = moved.rotated(link.fixed).shifted(link.translation)
                self._literal[link.parent] = self._literal[link.parent] + above


def _movable(link: Link, own: Inertia) -> Inertia:
    """Return the matter of a link whose energy is the same function if it stands still in J."""
    motion = link.motion
    if motion is None:
        # A point at the centre of a joint with three free turns and no other motion.
        turns = [[*[0.0] * 3, *row] for row in _IDENTITY]
        centred = all(is_zero(x) for x in link.slide) and [column for _, column in link.columns] == turns
        return Inertia(own.mass) if centred else Inertia()
    if not motion.turns:
        return Inertia(inertia=own.inertia)
    transverse = own.inertia[3]
    around = [transverse, 0.0, 0.0, transverse, 0.0, 0.0]
    if is_zero(motion.advance):
        return Inertia(own.mass, [0.0, 0.0, own.moment[2]], around)
    return Inertia(inertia=around)


# Rows of numbers, floats or of 120 bits, and of expressions.


def _rounded(x: Any) -> Any:
    return x if isinstance(x, ca.SX) else float(x)


def _literal(*numbers: Any) -> bool:
    return not any(isinstance(x, ca.SX) for x in numbers)


def _exact(x: Any) -> Any:
    return x if isinstance(x, ca.SX) else _MP.mpf(x)


def _transposed(A: Rows) -> Rows:
    return [list(column) for column in zip(*A, strict=True)]


def _product(A: Rows, B: Rows) -> Rows:
    """Return A B, in 120 bits where both are numbers."""
    entries = [x for M in (A, B) for row in M for x in row]
    number = _exact if _literal(*entries) else _rounded
    left, right = ([[number(x) for x in row] for row in M] for M in (A, B))
    return [[dot3(row, column) for column in zip(*right, strict=True)] for row in left]


def _aligned(R_J: Rows, axis: Any) -> tuple[Rows, Rows]:
    """Return R_J A and A, a rotation whose third column is the axis.

    The other two are free. If permutations of axes do, they are taken; else R_J A is a turn about the parent's z axis
    and one about the x axis after it.
    """
    z = _unit([_exact(x) for x in axis])
    if sorted(abs(x) for x in z) == [0, 0, 1]:
        fixed, A = _permuted(R_J, axis)
        if not _literal(*(x for row in fixed for x in row)) or _is_permutation(fixed):
            return fixed, A
    if not _literal(*(x for row in R_J for x in row)):
        return _product(R_J, (A := _frame(z))), A
    up = [dot3(row, z) for row in R_J]
    across = _MP.sqrt(up[0] ** 2 + up[1] ** 2)
    # Axes that are parallel to the last digit have no normal.
    x = [-up[1] / across, up[0] / across, _MP.mpf(0)] if across > _PARALLEL else [_MP.mpf(1), _MP.mpf(0), _MP.mpf(0)]
    if across <= _PARALLEL:
        up = [_MP.mpf(0), _MP.mpf(0), _MP.mpf(1 if up[2] > 0 else -1)]
    fixed = [[_snapped(c) for c in row] for row in _transposed([x, cross3(up, x), up])]
    return fixed, _product(_transposed(R_J), fixed)


def _permuted(R_J: Rows, axis: Any) -> tuple[Rows, Rows]:
    """Return R_J A and A, a permutation of axes whose third column is the axis; R_J A is one too, if possible."""
    fitting = [A for A in _PERMUTATIONS if all(row[2] == x for row, x in zip(A, axis, strict=True))]
    for A in fitting:
        fixed = _product(R_J, A)
        if _literal(*(x for row in fixed for x in row)):
            fixed = [[_snapped(x) for x in row] for row in fixed]
            if _is_permutation(fixed):
                break
    return fixed, [[_exact(x) for x in row] for row in A]


def _unit(x: Vector) -> Vector:
    size = _MP.sqrt(dot3(x, x))
    return [c / size for c in x]


def _orthonormal(R: Rows) -> Rows:
    """Return a rotation, orthonormal to all bits from 16 digits: its defects would double from link to link."""
    if not _literal(*(x for row in R for x in row)) or _is_permutation(R):
        return R
    A = [[_exact(x) for x in row] for row in R]
    # Two steps of Newton's iteration for the polar factor.
    for _ in range(2):
        cube = _product(A, _product(_transposed(A), A))
        A = [[1.5 * a - 0.5 * b for a, b in zip(*rows, strict=True)] for rows in zip(A, cube, strict=True)]
    return A


def _frame(z: Vector) -> Rows:
    """Return a rotation with this third column."""
    least = min(range(3), key=lambda i: abs(z[i]))
    x = cross3([1.0 if i == least else 0.0 for i in range(3)], z)
    x = _unit(x)
    return _transposed([x, cross3(z, x), z])


def _right_angles_apart(a: Any, b: Any) -> bool:
    turns = (a - b) / (_MP.pi / 2)
    return bool(abs(turns - _MP.nint(turns)) < _NOISE)


def _snapped(x: Any) -> Any:
    """Return a whole number for one that differs by the rounding of 120 bits."""
    nearest = _MP.nint(x)
    return nearest if abs(x - nearest) < _NOISE else x


def _is_permutation(R: Rows) -> bool:
    return all(x in (0, 1, -1) for row in R for x in row)


def _factors(R: Rows, short: bool) -> list[Factor]:
    """Return a rotation as factors, numbers rounded."""
    if not _literal(*(x for row in R for x in row)):
        return [Matrix([[_rounded(x) for x in row] for row in R])]
    if _is_permutation(R):
        places = [next(j for j in range(3) if row[j]) for row in R]
        signs = [float(row[j]) for row, j in zip(R, places, strict=True)]
        return [] if R == _IDENTITY else [Permutation(places, signs)]
    if short and R[2][0] == 0:
        turns = PlaneRotation(2, float(R[0][0]), float(R[1][0])), PlaneRotation(0, float(R[2][2]), float(R[2][1]))
        return [turn for turn in turns if turn.s != 0.0 or turn.c != 1.0]
    return [Matrix([[float(x) for x in row] for row in R])]


def _drift(rate: Vector, kin: Kinematics) -> Vector:
    """Return the derivative of expressions of q and v along q̇, at constant v."""
    out = ca.jtimes(ca.vertcat(*rate), kin.q, kin.qdot)
    return [0.0 if out[i].is_zero() else scalar(out[i]) for i in range(len(rate))]
