"""Energies of a model as SymPy expressions: the derivation's kinematics on exact sums of cosines and sines."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import cached_property
from itertools import product
from math import atan2, pi
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import sympy as sp

from mbkit._check import EPS, TYPED, Array
from mbkit._reproducible import DEPENDENT, pivoted
from mbkit.derivation.kinematics import Kinematics, compensation_energies, gravity_energy, kinetic_energy
from mbkit.derivation.model_values import Values
from mbkit.errors import InputError
from mbkit.lagrangian.energies.charts import angle_rates, quaternion, turning
from mbkit.lagrangian.energies.energy_form import QuasiVelocities
from mbkit.lagrangian.energies.kinetic_energy import inverse
from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.trig.shortest_form import Key, TrigPolynomial, TrigRing, number, shortest_form
from mbkit.lagrangian.trig.simplify import tidy
from mbkit.model import Joint, Model, NoSlip
from mbkit.model.joint_types import cross3
from mbkit.model.loops import CROSSED, LOOP_ROWS, TURNING, WELDED, LoopEnds, contact
from mbkit.model.parts import Coupler, Loop, PointSpring

Vector = list[Any]
#: The joints from a body down to one that carries it.
_Way = list[Joint]
#: Relative size of a zero term that rounded rotations leave.
_ROUNDED_ANGLE_ERROR: Final = Fraction(1, 10**15)


#: The advice of a message for a model that is too large to be written out.
INSTEAD_OF_WRITING: Final = 'mbkit.dynamics(model, "lagrangian") computes the same without writing it'


class _Numbers(Values):
    """Every number of a model that enters its equations, as an arithmetic has it: `bound` ones, and `read` others."""

    def __init__(self, model: Model, bound: dict[Any, Any], read: Callable[[float], Any]) -> None:
        # Parts are read where they are asked for: a motion need not be one of the model.
        self._bound, self._number, self._of = bound, read, {}
        self.gravity = self._entries(("gravity", "", "gravity"), (), model.gravity)

    def _scalar(self, value: float, direction: bool = False) -> Any:  # noqa: ARG002
        return self._number(value)


class SymbolicKinematics(Kinematics):
    """A model's kinematics in exact sums, with loops open and moved coordinates free; its energies in SymPy."""

    values: _Numbers

    def __init__(
        self,
        model: Model,
        coordinates: list[sp.Symbol],
        velocities: list[sp.Symbol],
        parameters: dict[str, sp.Symbol],
        progress: Callable[[float, str], None],
    ) -> None:
        self.model, self.symbols, self.rates, self._progress = model, coordinates, velocities, progress
        bound = {
            # The exponent one half is the only float that comes this way.
            (b.where, b.part, b.field, b.index): sp.nsimplify(
                b.expression.evaluate(lambda p: parameters[p.name], exact), rational=True
            )
            for b in model.bindings
        }
        opaque = {x for x in bound.values() if not _is_polynomial(x)}
        self._opaque = {x: sp.Dummy(f"n{i}") for i, x in enumerate(sorted(opaque, key=sp.default_sort_key))}
        self.bound = {place: self._opaque.get(x, x) for place, x in bound.items()}
        # A chart has as many coordinates as velocities.
        self.symbols_of = {j.name: self._own(j, coordinates, model.layout.v) for j in model.joints}
        self.rates_of = {j.name: self._own(j, velocities, model.layout.v, still=True) for j in model.joints}
        turns = [_turn(self.symbols_of[j.name][i]) for j in model.joints for i in j.type.angular]
        halves = [x / 2 for j in self._charted for x in self.symbols_of[j.name][j.type.quaternion :]]
        lengths = {
            s
            for j in model.joints
            for i, x in enumerate(self.symbols_of[j.name])
            if _advances(j, i)
            for s in x.free_symbols
        }
        generators = [*parameters.values(), *self._opaque.values(), *(s for s in coordinates if s in lengths)]
        self._lengths = [i for i, g in enumerate(generators) if g in lengths]
        self.formulas = space = TrigRing(
            model.name, [*halves, *dict.fromkeys(turns)], [*generators, *velocities], instead=INSTEAD_OF_WRITING
        )
        self._halved = len(halves)
        self._written_in = TrigRing(
            model.name, [*(2 * x for x in halves), *space.angles[len(halves) :]], space.generators
        )
        self.zero = space.number(0)
        numbers = {place: space.of(x) for place, x in self.bound.items()}
        self.values = _Numbers(model, numbers, lambda x: space.number(Fraction(repr(x))) if x else 0.0)
        self._q_of = {j.name: self._exact_coordinates(j) for j in model.joints}
        self._v_of = {name: [space.of(x) for x in v] for name, v in self.rates_of.items()}
        self._carrier = {j.child: j for j in model.joints}

    def _own(self, joint: Joint, symbols: list[sp.Symbol], layout: Any, *, still: bool = False) -> list[sp.Expr]:
        """Return a joint's coordinates or velocities; those of a mimic joint from its leader's."""
        if not joint.mimic:
            return symbols[layout[joint.name]] if joint.type.nv else []
        ratio, offset = (
            self.bound.get(("joints", joint.name, f, ()), exact(getattr(joint.mimic, f))) for f in ("ratio", "offset")
        )
        return [ratio * leader + (0 if still else offset) for leader in symbols[layout[joint.mimic.joint]]]

    @property
    def _charted(self) -> list[Joint]:
        """Joints with a quaternion, which stands as three angles on paper."""
        return [j for j in self.model.independent_joints if j.type.quaternion is not None]

    def _exact_coordinates(self, joint: Joint) -> Vector:
        q, k, space = self.symbols_of[joint.name], joint.type.quaternion, self.formulas
        plain = [space.of(x) if _advances(joint, i) else SimpleNamespace(expression=x) for i, x in enumerate(q[:k])]
        return (
            plain if k is None else plain + quaternion(*([space.turned(f, {x / 2: 1}) for f in (0, 1)] for x in q[k:]))
        )

    def described(self, joint: Joint) -> list[sp.Expr]:
        """Return a joint's coordinates as its description has them, a quaternion by its angles."""
        q, k = self.symbols_of[joint.name], joint.type.quaternion
        return q if k is None else [*q[:k], *quaternion(*((sp.cos(x / 2), sp.sin(x / 2)) for x in q[k:]))]

    @cached_property
    def velocity_matrix(self) -> sp.Matrix:
        """D of q̇ = D v, (n, n): a unit matrix but for ball and free joints."""
        D, first = sp.eye(self.model.nv), len(self.formulas.generators) - self.model.nv
        for joint in self._charted:
            k, own, q = joint.type.quaternion, self.model.layout.v[joint.name], self._q_of[joint.name]
            rate = [self.zero + x for x in joint.type.qdot(q, self._v_of[joint.name])]
            sums = [*rate[:k], *turning(q[k:], rate[k:])]
            for j in range(own.start, own.stop):
                *column, a, b, c = (self.shown(x.coefficient(first + j)) for x in sums)
                D[own, j] = sp.Matrix([*column, *angle_rates(self.symbols_of[joint.name][k:], (a, b, c))])
        return D

    @cached_property
    def qdot(self) -> list[sp.Expr]:  # type: ignore[override]
        """D v, the coordinates' rates in the velocities."""
        return list(self.velocity_matrix * sp.Matrix(self.rates))

    def quasi_velocities(self, independent: list[int]) -> QuasiVelocities | None:
        """Return how the velocities of these coordinates give their rates; None where they are the rates."""
        if not self._charted:
            return None
        D, n = sp.ImmutableMatrix(self.velocity_matrix.extract(independent, independent)), len(independent)
        gamma = sp.MutableDenseNDimArray.zeros(n, n, n)
        for joint in self._charted:
            units = np.eye(joint.type.nv, dtype=int).tolist()
            first = independent.index(self.model.layout.v[joint.name].start)
            for (j, v), (k, p) in product(enumerate(units), repeat=2):
                for i, x in enumerate(joint.type.hamel(v, p)):
                    gamma[first + k, first + i, first + j] = sp.nsimplify(x)
        q = tuple(self.symbols[i] for i in independent)
        none = sp.ImmutableMatrix.zeros(n, 1)
        out = QuasiVelocities(D, inverse(D, "D"), q, tuple(map(velocity_of, q)), none, none)
        # Joint types know theirs, which brackets of D's columns would give again.
        out.__dict__["hamel_coefficients"] = sp.ImmutableDenseNDimArray(gamma)
        return out

    def carried(self, way: _Way, x: Vector, weight: int) -> Vector:
        """Return a point (weight 1) or a direction (0) of a way's first body in the axes of its last."""
        for joint in way:
            x = self.to_parent(joint, x, weight)
        return x

    def way(self, body: str) -> _Way:
        """Return the joints from a body down to the ground."""
        out: _Way = []
        while body != "world":
            out.append(self._carrier[body])
            body = out[-1].parent
        return out

    # Energies

    @cached_property
    def kinetic_energy(self) -> sp.Expr:
        """½ vᵀ M v, entry by entry of M."""
        n, space, v = self.model.nv, self.formulas, self.rates
        self._progress(0.0, "kinetic energy")
        M = {(i, j): space.number(0) for i in range(n) for j in range(i, n)}
        first = len(space.generators) - n
        for (kind, turns, powers), value in kinetic_energy(self).terms.items():
            i, j = (k for k, power in enumerate(powers[first:]) for _ in range(power))
            M[i, j].terms[kind, turns, (*powers[:first], *(0,) * n)] = 2 * value if i == j else value
        self.drop_dust(list(M.values()))
        total = []
        for (i, j), entry in M.items():
            self._progress(0.5 + 0.5 * i / n, f"mass matrix, row {i + 1} of {n}")
            half = sp.Rational(1, 2) if i == j else sp.Integer(1)
            total.append(sp.Mul(half, self.shown(entry), v[i], v[j]))
        return sp.Add(*total)

    @cached_property
    def gravity_energy(self) -> sp.Expr:
        """-Σ m g · p_com."""
        return self._by_heights(gravity_energy(self))

    @cached_property
    def compensation_energy(self) -> sp.Expr:
        """Σ fraction m g · p_com."""
        return self._by_heights(compensation_energies(self).get((), self.zero))

    def _by_heights(self, total: Any) -> sp.Expr:
        self.drop_dust([total])
        # Height by height rather than with g before them all, so that forces read term by term.
        return self.back(shortest_form(self._in_angles(total), whole=False))

    def turns(self, joint: Joint) -> list[sp.Expr]:
        """Return a joint's coordinates that turn, those of a mimic joint by its leader's."""
        return [self.back(self.symbols_of[joint.name][i]) for i in joint.type.angular]

    @cached_property
    def written(self) -> WrittenKinematics:
        """The same model's springs, dampers and motions, as the equations show them."""
        return WrittenKinematics(self)

    def shown(self, x: Any) -> sp.Expr:
        """Return a sum as it is shown."""
        return self.back(shortest_form(self._in_angles(x)))

    def _in_angles(self, x: Any) -> Any:
        """Return a sum that holds whole multiples of a chart's angles alone in these, and not in their halves."""
        k = self._halved
        if not k or any(n % 2 for _, multiples, _ in x.terms for n in multiples[:k]):
            return x
        halved = {(f, (*(n // 2 for n in m[:k]), *m[k:]), powers): value for (f, m, powers), value in x.terms.items()}
        return TrigPolynomial(self._written_in, halved)

    def moves(self, key: Key) -> bool:
        """Return whether a term of a sum depends on a coordinate."""
        _, multiples, powers = key
        return any(multiples) or any(powers[i] for i in self._lengths)

    def back(self, x: sp.Expr) -> sp.Expr:
        """Return an expression with what its placeholders stand for."""
        return x.subs({dummy: e for e, dummy in self._opaque.items()}) if self._opaque else x

    def drop_dust(self, sums: list[Any]) -> None:
        """Drop the terms that only rounding of the model's rotations has left, of those with the same unit."""
        largest: dict[Any, Fraction] = {}
        for x in sums:
            for (_, _, powers), value in x.terms.items():
                largest[powers] = max(largest.get(powers, Fraction(0)), abs(value))
        for x in sums:
            for key in [k for k, value in x.terms.items() if abs(value) < _ROUNDED_ANGLE_ERROR * largest[k[2]]]:
                del x.terms[key]


class WrittenKinematics(Kinematics):
    """Coordinates, velocities and numbers of a model in SymPy, as the equations show them."""

    values: _Numbers
    zero, half = sp.Integer(0), sp.Rational(1, 2)

    def __init__(self, exact: SymbolicKinematics) -> None:
        self._exact, self.model = exact, exact.model
        self._q_of, self._v_of = (
            {name: [exact.back(x) for x in own] for name, own in symbols.items()}
            for symbols in (exact.symbols_of, exact.rates_of)
        )
        bound = {place: _shown_number(x) if x.is_Rational else exact.back(x) for place, x in exact.bound.items()}
        self.values = _Numbers(self.model, bound, _shown_number)

    def squared_length(self, spring: PointSpring) -> sp.Expr:
        """Return |p_AB|² of the points that a spring joins."""
        return self._exact.shown(self._exact.squared_length(spring))

    def length(self, square: sp.Expr) -> sp.Expr:
        """Return the root of a squared length."""
        return sp.sqrt(square)

    def length_rate(self, square: sp.Expr) -> sp.Expr:
        """Return the rate of a length from its square."""
        pairs = zip(self._exact.symbols, self._exact.qdot, strict=True)
        return sum((sp.diff(square, q) * v for q, v in pairs), sp.Integer(0)) / sp.sqrt(square) / 2


def _shown_number(x: Any) -> sp.Expr:
    """Return a number as the equations show it: the decimal that was written."""
    return number(Fraction(repr(x)) if isinstance(x, float) else Fraction(int(x.p), int(x.q)))


def exact(x: float) -> sp.Rational:
    """Return the decimal that was written: 0.1 is 1/10, which rounds to the same double."""
    top, bottom = Fraction(repr(float(x))).as_integer_ratio()
    return sp.Rational(top, bottom)


def _is_polynomial(x: sp.Expr) -> bool:
    """Return whether an expression is a sum of rational multiples of products of whole powers of symbols."""
    for term in sp.Add.make_args(sp.expand(x)):
        value, rest = term.as_coeff_Mul()
        factors = () if rest == 1 else sp.Mul.make_args(rest)
        powers = [f.as_base_exp() for f in factors]
        if not value.is_Rational or any(not b.is_Symbol or not e.is_Integer for b, e in powers):
            return False
    return True


def _advances(joint: Joint, i: int) -> bool:
    """Return whether a coordinate moves something by its own length; others only turn."""
    return i in joint.type.lengths or i in joint.type.screws


def _turn(angle: sp.Expr) -> sp.Expr:
    """Return an angle to take cosines of: a coordinate where the angle is a whole multiple of it."""
    value, rest = sp.expand(angle).as_coeff_Mul()
    return rest if value.is_Integer and rest.is_Symbol else sp.expand(angle)


# Coordinates that are moved in time, as expressions of it.


def coupled(kin: SymbolicKinematics, coupler: Coupler) -> sp.Expr:
    """Return q less what its leaders give it."""
    x = kin.written.values.of(coupler)
    at, *leading = (kin.symbols_of[name][0] for name in (coupler.joint, *coupler.leaders))
    offset = read_angle(x.offset) if kin.model.joint(coupler.joint).type.angular and x.offset else x.offset
    higher = sum((c * leading[0] ** (k + 2) for k, c in enumerate(x.curve)), sp.Integer(0))
    return at - sum(r * y for r, y in zip(x.ratios, leading, strict=True)) - offset - higher


def angle(x: float) -> sp.Expr:
    """Return an angle, as a multiple of π/12 where it is one to rounding."""
    twelfths = round(12 * x / pi)
    if abs(x - twelfths * pi / 12) <= 2 * EPS * abs(x):
        return sp.Rational(twelfths, 12) * sp.pi
    return number(Fraction(repr(x)))


def read_angle(x: sp.Expr) -> sp.Expr:
    """Return a number as an angle, and anything else as it is."""
    return angle(float(x)) if x.is_Number else x


# Blades, and discs and spheres that roll.


def rolling(kin: SymbolicKinematics, part: NoSlip) -> tuple[list[sp.Expr], list[sp.Expr]]:
    """Return the rows of a part without slip that hold positions, and those that hold velocities, in world axes."""
    exact, x = kin.values.of(part), kin.written.values.of(part)
    ways = kin.way(part.body_a), kin.way(part.body_b)

    def vector(way: _Way, entries: Any, weight: int) -> Vector:
        sums = [kin.zero + e for e in kin.carried(way, list(entries), weight)]
        kin.drop_dust(sums)
        return [kin.shown(e) for e in sums]

    def rate(u: Vector) -> Vector:
        pairs = list(zip(kin.symbols, kin.qdot, strict=True))
        return [sum((sp.diff(e, q) * v for q, v in pairs), sp.Integer(0)) for e in u]

    def material(way: _Way, point: Vector, at: Vector) -> Vector:
        """Return the velocity of what a body carries at a place, from one of its own points."""
        turned = [sp.Integer(0)] * 3
        for axis in np.eye(3):
            e = vector(way, axis, 0)
            turned = [a + b / 2 for a, b in zip(turned, cross3(e, rate(e)), strict=True)]
        arm = [a - b for a, b in zip(at, point, strict=True)]
        return [a + b for a, b in zip(rate(point), cross3([tidy(w) for w in turned], arm), strict=True)]

    a, b = (vector(way, axis, 0) for way, axis in zip(ways, (exact.axis_a, exact.axis_b), strict=True))
    along = [vector(ways[1], row, 0) for row in exact.tangents]
    place = contact(part.kind, a, b, along, x.radius, lambda square: sp.sqrt(tidy(square)))
    centre, ground = (
        vector(way, e, 1) for way, e in zip(ways, (exact.translation_a, exact.translation_b), strict=True)
    )
    at = [c + o for c, o in zip(centre, place.offset, strict=True)]
    speeds = [material(way, point, at) for way, point in zip(ways, (centre, ground), strict=True)]
    gap, velocity = ([c - d for c, d in zip(*two, strict=True)] for two in ((centre, ground), speeds))
    both = [[tidy(row) for row in rows] for rows in place.rows(gap, velocity, x.speed)]
    position_rows, velocity_rows = ([x for x in rows if not (x.is_number and abs(x) < TYPED)] for rows in both)
    still = [row for row in (*position_rows, *velocity_rows) if not row.free_symbols & {*kin.symbols, *kin.rates}]
    if still or not (position_rows or velocity_rows):
        raise InputError(
            f"{kin.model.name}: no slip {part.name!r}: "
            + (f"{still[0]} is left, whatever the joints do" if still else "no joint moves it; leave it out")
        )
    return position_rows, velocity_rows


def written_rows(kin: SymbolicKinematics, part: Any) -> tuple[list[sp.Expr], list[sp.Expr]]:
    """Return the rows of a loop, coupler or contact that hold positions, and those that hold velocities."""
    if isinstance(part, NoSlip):
        return rolling(kin, part)
    return closure(kin, part) if isinstance(part, Loop) else [coupled(kin, part)], []


# Loop closures of a model as holonomic constraints, in SymPy.
#
# Both ends are written in the axes of the last body that their ways to the ground share. So the rows hold the joints of
# the loop only, and a plane mechanism has no row across its plane. Dependent rows are left out.


def closure(kin: SymbolicKinematics, loop: Loop) -> list[sp.Expr]:
    """Return expressions that are zero where a loop is closed; InputError if its ends never meet or never move.

    They are the rows of `mbkit.model.loops.LOOP_ROWS`: of points and frames' origins r_a - r_b, with the force on body
    a as multipliers, and of frames that do not turn ½ Σ b_k x a_k of their axes, the sine of their angle; it is zero at
    half a turn too, where its rows depend on each other. Where all axes in the loop are parallel, 2 sin(φ/2) of the
    angle φ from frame b to frame a stands for these, zero at whole turns only; its multiplier is the torque on body a
    (its negative after an odd number of turns).
    """
    a, b = ends = kin.way(loop.body_a), kin.way(loop.body_b)
    # Both ways end at the last body that they share.
    while a and b and a[-1] is b[-1]:
        a.pop()
        b.pop()
    values, (names, rows_of) = kin.values.of(loop), LOOP_ROWS[loop.kind]
    points = (kin.carried(a, values.translation_a, 1), kin.carried(b, values.translation_b, 1))
    turned = any(name in TURNING for name in names)
    frame_a, frame_b = (
        [kin.carried(way, [row[k] for row in R], 0) for k in range(3)] if turned else []
        for way, R in zip(ends, (values.rotation_a, values.rotation_b), strict=True)
    )
    loop_ends = LoopEnds([x - y for x, y in zip(*points, strict=True)], frame_a, frame_b, values.length)
    apart = "its axes never cross at a right angle" if loop.kind == CROSSED else "its frames are never parallel"
    reasons = ("its points never meet", apart)
    messages = [f"loop {loop.name!r}: {reasons[name in TURNING]}" for name in names]
    axes = [axis for way in ends for axis in _axes(way)] if loop.kind in WELDED else []
    if loop.kind in WELDED and all(np.linalg.norm(np.cross(axis, axes[0])) < DEPENDENT for axis in axes):
        rows = _independent(kin, rows_of(loop_ends)[: -len(loop_ends.turn())], messages)
        rows += _in_plane(kin, loop, ends, axes[0] if axes else None, messages[-1])
    elif names == LOOP_ROWS["distance"][0]:
        # A sum of cosines has no quotients.
        length = kin.written.values.of(loop).length
        rows = [x / (2 * length) for x in _independent(kin, [loop_ends.excess()], messages)]
    else:
        rows = _independent(kin, rows_of(loop_ends), messages)
    if not rows:
        raise InputError(
            f"{kin.model.name}: loop {loop.name!r} closes nothing: no joint moves its ends against each other; "
            "leave it out"
        )
    return rows


def _in_plane(
    kin: SymbolicKinematics, loop: Loop, ends: tuple[_Way, _Way], axis: Array | None, message: str
) -> list[sp.Expr]:
    """Return the row of the angle about the axis that all joints share."""
    a, b = (_at_rest(way) @ R for way, R in zip(ends, (loop.rotation_a, loop.rotation_b), strict=True))
    E = a @ b.T
    axis = np.zeros(3) if axis is None else axis
    turn = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
    about = float(turn @ axis)
    start = atan2(about, (np.trace(E) - 1) / 2)
    # Whatever turns about the axis leaves the rest as it is.
    if np.abs(E @ axis - axis).max() > TYPED or (not axis.any() and np.abs(E - np.eye(3)).max() > TYPED):
        raise InputError(f"{kin.model.name}: {message}, whatever the joints do; turn one of them by rotation_a")
    total = angle(start)
    for sign, way in zip((1, -1), ends, strict=True):
        # An axis that points the other way turns back.
        signs = [int(np.sign(x @ axis)) for x in _axes(way)]
        angles = [x for joint in way for x in kin.turns(joint)]
        total += sp.Add(*(sign * s * x for s, x in zip(signs, angles, strict=True)))
    total = sp.expand(total)
    if not total.free_symbols & set(kin.symbols):
        if abs(sp.sin(total / 2).evalf()) < TYPED:
            return []
        raise InputError(f"{kin.model.name}: {message}: between them stays an angle of {total}")
    return [2 * sp.sin(total / 2)]


def _axes(way: _Way) -> list[Array]:
    """Return what a way's joints turn about, each in the axes of the body at its end while no other has moved."""
    out = []
    for k, joint in enumerate(way):
        out += [_at_rest(way[k:]) @ x for x in joint.type.hinge_axes(joint)]
    return out


def _at_rest(way: _Way) -> Array:
    R = np.eye(3)
    for joint in way:
        R = joint.rotation @ R
    return R


def _independent(kin: SymbolicKinematics, sums: list[TrigPolynomial], messages: list[str]) -> list[sp.Expr]:
    """Return those of some sums that the others do not imply."""
    sums = [kin.zero + x for x in sums]
    # Beside directions, a number of rounding's size is none.
    kin.drop_dust([*sums, kin.zero + 1])
    keys = list(dict.fromkeys(key for x in sums for key in x.terms))
    moving = np.array([kin.moves(key) for key in keys], dtype=bool)
    A = np.array([[float(x.terms.get(key, 0)) for key in keys] for x in sums]).reshape(len(sums), len(keys))
    largest = float(np.abs(A).max(initial=0.0))
    pivots: list[int] = []
    if moving.any():
        sizes = np.linalg.norm(A[:, moving], axis=1)
        # Metres and radians do not compare.
        scale = np.where(sizes > DEPENDENT * sizes.max(), sizes, np.inf)[:, None]
        pivots = sorted(pivoted(A[:, moving] / scale)[0])
    for i in sorted({*range(len(sums))} - {*pivots}):
        weights = np.linalg.lstsq(A[pivots][:, moving].T, A[i, moving], rcond=None)[0]
        left = A[i] - weights @ A[pivots]
        if np.abs(left[~moving]).max(initial=0.0) > TYPED * largest:
            rest = kin.shown(TrigPolynomial(kin.formulas, {k: x for k, x in sums[i].terms.items() if not kin.moves(k)}))
            why = f": {f'{float(rest):.6g}' if rest.is_number else rest} is left between them"
            raise InputError(f"{kin.model.name}: {messages[i]}, whatever the joints do{'' if weights.any() else why}")
    return [kin.shown(sums[i]) for i in pivots]
