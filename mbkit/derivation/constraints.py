"""Constraints of loops, of motions in time and of contacts without slip, as CasADi expressions.

Rows that hold positions, f(q, t) = 0, come first; behind them rows that hold velocities alone, A(q) v = b, which have
no integral (non-holonomic). One form for all of them, with the multipliers λ::

    M v̇ + C v + g = τ + τ_passive + Jᵀ λ        J v̇ + γ = 0

J has the Jacobian of f on the velocities, and A below it. The rate J v + c is zero: ḟ = J v + ∂f/∂t of the first rows,
A v - b of the others; its derivative is J v̇ + γ (Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 8). By Gauss's
principle, which asks nothing of a row but that it is linear in v̇, v̇ is the least change, in the metric of M, of the
free acceleration.

Rows of a loop stand in the axes of the body that carries both its ends. A row that follows from the others at every
configuration, such as the third of a point loop in a plane, says nothing and is left out. A row that follows from the
others only where the loops are closed, as in Bricard's mechanism, is redundant: it is kept among the multipliers, of
which those with the least norm are given, and left out of the equation.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np

from mbkit._attributes import forwarded
from mbkit._check import TYPED, Array
from mbkit._reproducible import DEPENDENT, independent_rows
from mbkit.derivation.body_motion import BodyMotion
from mbkit.derivation.forces import casadi_arithmetic
from mbkit.derivation.kinematics import Kinematics, Vector, add, column, constant_transposed_times, follower
from mbkit.derivation.link_mechanics import LinkMechanics, Motion
from mbkit.derivation.mass_matrix_solve import ConstraintFactors, ConstraintTerms, Factors, OrthogonalColumns
from mbkit.errors import InputError
from mbkit.model import Model, NoSlip
from mbkit.model.elements.motion_laws import MOTION_LAWS
from mbkit.model.elements.references import called
from mbkit.model.joint_types import cross3, dot3
from mbkit.model.loops import LOOP_ROWS, NO_SLIP_ROWS, Contact, LoopEnds, contact, discs_of
from mbkit.model.manifold import closest_configuration, integrate, random_state
from mbkit.model.parts import RESTING, Coupler, Loop
from mbkit.model.quantities import of_groups
from mbkit.model.validation import sample_mass_matrix

#: Of the accelerations along a redundant row: what a stage of a long step leaves on its branch, and no other
#: branch does.
OFF_BRANCH: Final = 1e-2
#: Height of a disc's centre over its radius below which it lies flat: there its height has a kink, where searches for a
#: configuration end, and accelerations that grow with its inverse squared have lost 12 digits.
_LIES: Final = 1e-6
#: Configurations at which rows are looked at, and random starts from which a closed one is searched.
_LOOKS: Final = 6
_STARTS: Final = 12
#: Smallest eigenvalue of a mass matrix with a unit diagonal that still has an inverse of some digits.
_SINGULAR: Final = 1e-9
#: Residual of a closed configuration, in terms of its rows' size; what is open by more closes elsewhere, or nowhere.
_CLOSED: Final = 1e-13
#: Poses beside a closed one, and how far they are away, rad or m.
BESIDE: Final = 3
ASIDE: Final = 0.2


# Rows of loops, of motions in time and of contacts without slip


def _ends(kin: Kinematics, loop: Loop) -> LoopEnds:
    (p, a), (q, b) = kin.ends(loop)
    return LoopEnds([x - y for x, y in zip(p, q, strict=True)], a, b, kin.values.of(loop).length)


class _Row(NamedTuple):
    """A row: its part, its name and its expression, which is of f or, where it `moves`, of A v - b."""

    part: str
    name: str
    value: Any
    moves: bool = False


def _contact(kin: Kinematics, part: NoSlip) -> Contact:
    """Return the contact of a part in the axes of the body that carries both its bodies."""
    values, both = kin.values.of(part), kin.model.carrier(part)
    a, b = kin.carried_to(part.body_a, both, values.axis_a, 0.0), kin.carried_to(part.body_b, both, values.axis_b, 0.0)
    along = [kin.carried_to(part.body_b, both, row, 0.0) for row in values.tangents]
    return contact(part.kind, a, b, along, values.radius, lambda x: kin.length(ca.SX(x)))


def _contact_rows(kin: Kinematics, part: NoSlip) -> tuple[list[Any], list[Any]]:
    """Return the expressions of the rows that hold positions and of those that hold velocities."""
    values, both, place = kin.values.of(part), kin.model.carrier(part), _contact(kin, part)
    centre = kin.carried_to(part.body_a, both, values.translation_a, 1.0)
    ground = kin.carried_to(part.body_b, both, values.translation_b, 1.0)
    at = add(centre, place.offset)
    ends = (kin.velocity_at(body, both, at) for body in (part.body_a, part.body_b))
    velocity, gap = ([x - y for x, y in zip(*two, strict=True)] for two in (ends, (centre, ground)))
    return place.rows(gap, velocity, values.speed)


def _rows(kin: Kinematics, time: Any) -> list[_Row]:
    """Return every row, those that say nothing among them, with those that hold velocities alone behind the others."""
    return sorted(_every_row(kin, time), key=lambda row: row.moves)


def _every_row(kin: Kinematics, time: Any) -> Iterator[_Row]:
    for part in kin.model.constraints:
        item, values = f"{called(part.section)} {part.name!r}", kin.values.of(part)
        if isinstance(part, Loop):
            names, rows = LOOP_ROWS[part.kind]
            named = zip(names, rows(_ends(kin, part)), strict=True)
            yield from (_Row(part.name, f"{item} {name}", row) for name, row in named)
        elif isinstance(part, NoSlip):
            texts = NO_SLIP_ROWS[part.kind]
            for moves, *both in zip((False, True), texts, _contact_rows(kin, part), strict=True):
                yield from (_Row(part.name, f"{item} {name}", row, moves) for name, row in zip(*both, strict=True))
        else:
            leaders = part.leaders if isinstance(part, Coupler) else ()
            at, *leading = (kin.coordinates(kin.model.joint(name))[0] for name in (part.joint, *leaders))
            if isinstance(part, Coupler):
                yield _Row(part.name, item, at - follower(values, leading))
            else:
                path = MOTION_LAWS[type(part)](part, values, time, casadi_arithmetic(kin.values.number))
                yield _Row(part.name, f"motion of {part.name!r}", at - path)


def loop_drifts(kin: Kinematics, mechanics: LinkMechanics) -> dict[str, Any]:
    """Return γ by the names of rows of loops whose ends the world carries: f̈ at v̇ = 0, from the motion of the links.

    The ends' accelerations are those of the links, whose products inverse dynamics has too, and the second derivatives
    of a frame's axes are (ω̇ × + ω × ω ×) of them.
    """
    out: dict[str, Any] = {}
    for loop in kin.model.loops:
        if kin.model.carrier(loop) != "world":
            continue
        ends, values = _ends(kin, loop), kin.values.of(loop)
        places, turns, bends = [], [], []
        for body, point, rotation, axes in (
            (loop.body_a, values.translation_a, values.rotation_a, ends.a),
            (loop.body_b, values.translation_b, values.rotation_b, ends.b),
        ):
            linear, spin, turning = mechanics.drift_at(body, list(point), rotation)
            motion = Motion.of(spin)
            columns = [linear, *(add(cross3(turning, e), motion.centripetal(e)) for e in np.eye(3).tolist())]
            place, *bent = ([dot3(row, x) for row in zip(*axes, strict=True)] for x in columns)
            places.append(place)
            bends += bent
            turns += [[dot3(row, cross3(spin, e)) for row in zip(*axes, strict=True)] for e in np.eye(3).tolist()]
        gap = [x - y for x, y in zip(*places, strict=True)]
        speed = ca.vertsplit(ca.jtimes(column(ends.gap), kin.q, kin.qdot))
        names, rows = LOOP_ROWS[loop.kind]
        x, dx, ddx = (ca.SX.sym(name, 21) for name in ("x", "dx", "ddx"))
        g, *frames = (ca.vertsplit(x[3 * k : 3 * k + 3]) for k in range(7))
        f = column(rows(LoopEnds(g, frames[:3], frames[3:], ends.length)))
        f = ca.jtimes(ca.jtimes(f, x, dx), ca.vertcat(x, dx), ca.vertcat(dx, ddx))
        actual = (*ends.gap, *chain(*ends.a, *ends.b)), (*speed, *chain(*turns)), (*gap, *chain(*bends))
        f = ca.substitute(f, ca.vertcat(x, dx, ddx), column(chain(*actual)))
        out |= {f"{called(loop.section)} {loop.name!r} {name}": f[i] for i, name in enumerate(names)}
    return out


def _terms(
    kin: Kinematics, time: Any, rows: list[_Row], known: Callable[[], dict[str, Any]] | None = None
) -> ConstraintTerms:
    turned = kin.qdot if kin.model.quaternions else None
    value, speeds = (column(row.value for row in rows if row.moves is moves) for moves in (False, True))
    return ConstraintTerms(value, kin.q, kin.v, time, tuple(row.name for row in rows), turned, speeds, known)


def _ways(kin: Kinematics) -> Any:
    """Return numbers that are negative where a loop's frames point opposite ways, then where a disc lies flat."""
    loops = (_ends(kin, loop).way(loop.kind) for loop in kin.model.loops)
    discs = (_contact(kin, x).reach / kin.values.of(x).radius - _LIES for x in discs_of(kin.model))
    return column((*loops, *discs))


class Constraints:
    """The constraints of a model, from its kinematics.

    Attributes
    ----------
    names : tuple of str
        Of the rows that say something, such as ``"loop 'pin' x"``.
    independent : tuple of int
        Which of these rows the equation is made of; the others follow from them where all loops are closed.
    ways : casadi.SX
        One number for each loop, negative where its frames point opposite ways, though its rows are zero there; then
        one for each disc, negative where it lies flat.
    every : casadi.SX
        The Jacobian of all rows, those that say nothing among them.
    """

    def __init__(self, kin: Kinematics, time: Any, known: Callable[[], dict[str, Any]] | None = None) -> None:
        self._kin = kin
        rows = _rows(kin, time)
        choice = self.choice = choose_rows(kin.model)
        kept = [rows[i] for i in choice.kept]
        self.names = tuple(row.name for row in kept)
        self.independent = choice.independent
        self._independent_of_every = tuple(choice.kept[i] for i in choice.independent)
        self.ways = _ways(kin)
        self.every = _terms(kin, time, rows).jacobian
        #: All rows that say something, and those of the equation.
        self.all = self.terms = _terms(kin, time, kept, known)
        if choice.redundant:
            self.terms = _terms(kin, time, [kept[i] for i in self.independent], known)

    def spread(self, multipliers: Any) -> Any:
        """Return the multipliers of all rows with the least norm whose force is that of the independent ones."""
        return self._spread(multipliers, self.all.jacobian, self.independent)

    def _spread(self, multipliers: Any, rows: Any, independent: tuple[int, ...]) -> Any:
        # Dependent rows are W J, and the force of all is Jᵀ (μ + Wᵀ μ_dependent).
        J, m = self.terms.jacobian, len(independent)
        dependent = [i for i in range(rows.shape[0]) if i not in independent]
        if not dependent:
            return multipliers
        W = -OrthogonalColumns(J.T).held(rows[dependent, :].T, ca.SX(m, len(dependent)))[1].T
        own = Factors(ca.SX.eye(m) + ca.mtimes(W.T, W), range(m)).solve(multipliers)
        out: Any = ca.SX(rows.shape[0], 1)
        out[list(independent)], out[dependent] = own, ca.mtimes(W, own)
        return out

    def loop_wrenches(self, multipliers: Any) -> list[tuple[Vector, Vector]]:
        """Return force and moment that each loop exerts on body a about the origin of its frame, in the carrier's axes.

        `multipliers` are those of the independent rows. All rows carry the load, with the least norm, those that say
        nothing among them: the load of a loop in a plane is in the plane.
        """
        shares = ca.vertsplit(self._spread(multipliers, self.every, self._independent_of_every))
        out, first = [], 0
        for loop in self._kin.model.loops:
            names, rows = LOOP_ROWS[loop.kind]
            ends = _ends(self._kin, loop)
            symbols = ca.SX.sym("ends", 12)
            gap, *axes = (ca.vertsplit(symbols[3 * k : 3 * k + 3]) for k in range(4))
            # By virtual work: what the rows change by as end a moves.
            shifted = LoopEnds(gap, axes, ends.b, ends.length)
            work = sum(x * y for x, y in zip(shares[first:], rows(shifted), strict=False))
            actual = ca.vertcat(*(ca.SX(x) for part in (ends.gap, *ends.a) for x in part))
            slopes = ca.vertsplit(ca.substitute(ca.gradient(ca.SX(work), symbols), symbols, actual))
            turns = (cross3(ends.a[k], slopes[3 * k + 3 : 3 * k + 6]) for k in range(3))
            out.append((slopes[:3], [sum(x, 0.0) for x in zip(*turns, strict=True)]))
            first += len(names)
        return out

    def gap(self, loop: Loop) -> Vector:
        """Return the way from end b to end a, in the axes of the body that carries both."""
        return _ends(self._kin, loop).gap


def off_branch(J: Any, gamma: Any, a: Any, force: Any, M: Any) -> Any:
    """Return NaN where accelerations under a force break rows that are redundant where it moves, and else 0."""
    doubt, rest = 0.0, ca.mtimes(J, a) + gamma
    # Rows that hold the mechanism still leave the rounding of the free acceleration, in any direction.
    # A mechanism that rests accelerates by none of it.
    masses = ca.diag(M) * (ca.diag(M) < RESTING)
    masses = ca.fmax(ca.sumsqr(masses), float(np.finfo(float).tiny))
    size, rounding = ca.sumsqr(a), DEPENDENT**2 * ca.sumsqr(force) / masses
    for i in range(J.shape[0]):
        slope = ca.sumsqr(J[i, :])
        most = OFF_BRANCH**2 * (slope * size + gamma[i] ** 2) + slope * rounding
        doubt = ca.if_else(rest[i] ** 2 <= most, doubt, np.nan)
    return doubt


# Rows that say something, and those of them that are independent, from numbers


@dataclass(frozen=True)
class RowChoice:
    """Which of all rows say something, and which of those are independent where the loops are closed.

    `closed` is a configuration at which they are, or None where none was found. The first `positions` of the kept rows
    hold positions; `names` are those of the kept rows.
    """

    kept: tuple[int, ...]
    positions: int
    independent: tuple[int, ...]
    names: tuple[str, ...]
    closed: Array | None = field(default=None, compare=False)

    @property
    def independent_names(self) -> tuple[str, ...]:
        """Names of the independent rows."""
        return tuple(self.names[i] for i in self.independent)

    @property
    def redundant(self) -> tuple[int, ...]:
        """The kept rows that follow from the independent ones where the loops are closed."""
        return tuple(i for i in range(len(self.kept)) if i not in self.independent)


class _Numbers:
    """f, J and the rate at v = 0 of all rows at the nominal numbers, and whether the frames of loops point alike."""

    def __init__(self, model: Model) -> None:
        self.model = model
        kin = Kinematics(model)
        time = kin.values.named[model.time_parameter] if model.time_parameter else None
        rows = _rows(kin, time)
        self.parts = [row.part for row in rows]
        self.names = [row.name for row in rows]
        #: How many rows hold positions: the first ones.
        self.positions = sum(not row.moves for row in rows)
        c = _terms(kin, time, rows)
        outs = [ca.densify(x) for x in (c.value, c.jacobian, c.by_time, _ways(kin))]
        self._call = ca.Function("rows", [kin.q, kin.values.parameters], outs)
        # A parameter without a value has one that is as good as another.
        self._parameters = [1.0 if x is None else x for x in model.parameters.values()]

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Return f, then the rates at v = 0 of the rows that hold velocities alone, and J."""
        f, J, still, _ = self._call(q, self._parameters)
        return np.concatenate([np.array(f)[:, 0], np.array(still)[self.positions :, 0]]), np.array(J)

    def closed(self, q: Array, kept: list[int], still: Collection[int] = ()) -> Array | None:
        """Return a configuration near q where these rows are zero; None where the search ends elsewhere."""

        def rows(x: Array) -> tuple[Array, Array]:
            f, J = self(x)
            return f[kept], J[kept]

        q, size, _ = closest_configuration(self.model, q, np.eye(self.model.nv), rows, still)
        # Half a turn away the sine of a frame's angle is zero too, and its rows depend on each other.
        turned = np.array(self._call(q, self._parameters)[3])
        return q if size < _CLOSED * (1 + np.abs(q).max()) and (turned >= 0).all() else None

    def around(self, q: Array, kept: list[int], held: list[int]) -> Iterator[_Pose]:
        """Yield what the rows are at a closed pose, and at some beside it.

        Beside it one coordinate is held, for the search would end at q again where this is a singular pose.
        """
        J, free = self._slopes(q, kept, held)
        yield _Pose(*independent_rows(J, len(held)), q)
        moving = np.argsort(-np.linalg.norm(free, axis=0).round(6), kind="stable")[:BESIDE] if len(free) else ()
        for i in moving:
            yield from self._beside(q, ASIDE * np.eye(len(J.T))[i], kept, held, [i])

    def moved(self, q: Array, kept: list[int], held: list[int], rng: np.random.Generator) -> Iterator[_Pose]:
        """Yield what the rows are at poses beside a closed one to which random motions of all coordinates lead."""
        J, free = self._slopes(q, kept, held)
        for x in rng.uniform(-ASIDE, ASIDE, (BESIDE, len(J.T))):
            yield from self._beside(q, free.T @ (free @ x), kept, held)

    def _slopes(self, q: Array, kept: list[int], held: list[int]) -> tuple[Array, Array]:
        """Return J of the kept rows at q, and a basis of the velocities that they leave free, one a row."""
        J = self(q)[1][kept]
        return J, np.linalg.svd(J)[2][len(independent_rows(J, len(held))[0]) :]

    def _beside(
        self, q: Array, step: Array, kept: list[int], held: list[int], still: Collection[int] = ()
    ) -> Iterator[_Pose]:
        x = self.closed(integrate(self.model, q, step), held, still)
        if x is not None and np.isfinite(self(x)[1]).all():
            yield _Pose(*independent_rows(self(x)[1][kept], len(held)), x)


class _Pose(NamedTuple):
    """The independent rows at a pose, and the remainder of the last one."""

    rows: tuple[int, ...]
    least: float
    q: Array


#: The name under which a model keeps its own.
_CHOICE: Final = "_row_choice"


def choose_rows(model: Model) -> RowChoice:
    """Return which rows of a model say something, and which of those are independent where its loops are closed.

    Raises
    ------
    InputError
        A loop whose ends never meet, or that no joint moves; a disc that lies flat wherever the joints lead.
    """
    # Each engine asks, and the search for closed configurations takes seconds of a tree with free joints.
    kept = vars(model)
    if _CHOICE not in kept:
        kept[_CHOICE] = _chosen_rows(model)
    choice: RowChoice = kept[_CHOICE]
    return choice


def _chosen_rows(model: Model) -> RowChoice:
    numbers, rng = _Numbers(model), np.random.default_rng(0)
    anywhere = [random_state(model, rng, None)[0] for _ in range(_LOOKS)]
    kept = _with_something_to_say(numbers, anywhere)
    held, names = [i for i in kept if i < numbers.positions], tuple(numbers.names[i] for i in kept)
    for start in starts(model, rng, anywhere):
        q = numbers.closed(start, held)
        if q is not None and np.isfinite(numbers(q)[1]).all():
            # On a branch rows may depend on each other at every pose: the rank is that of the poses around.
            best = max(numbers.around(q, kept, held), key=lambda x: (len(x.rows), x.least))
            if len(best.rows) < len(kept):
                # One coordinate moves its own loop off a singular pose, and leaves other loops at theirs.
                best = max([best, *numbers.moved(best.q, kept, held, rng)], key=lambda x: len(x.rows))
            return RowChoice(tuple(kept), len(held), best.rows, names, best.q)
    # The state that a user gives tells more: it is refused there, with the residual of each row.
    return RowChoice(tuple(kept), len(held), tuple(range(len(kept))), names)


def starts(model: Model, rng: np.random.Generator, first: Iterable[Array] = ()) -> list[Array]:
    """Return configurations from which closed ones are searched: the neutral one, the first ones, and random ones."""
    far = (integrate(model, model.neutral(), rng.uniform(-3, 3, model.nv)) for _ in range(_STARTS))
    return [model.neutral(), *first, *far]


def _with_something_to_say(numbers: _Numbers, poses: list[Array]) -> list[int]:
    """Return the rows that do not follow from others of their part at every configuration, by constant weights."""
    kept: list[int] = []
    values = [numbers(q) for q in poses]
    slopes, sizes = np.concatenate([J for _, J in values], axis=1), np.array([f for f, _ in values])
    for part in dict.fromkeys(numbers.parts):
        own = np.array([i for i, x in enumerate(numbers.parts) if x == part])
        if not np.isfinite(slopes[own]).all():
            raise InputError(
                f"{numbers.model.name}: no slip {part!r}: the disc lies flat on its plane, whatever the joints do, and "
                "touches it in no single point; turn its axis or the plane"
            )
        first = int(np.count_nonzero(own < numbers.positions))
        chosen, _ = independent_rows(slopes[own], first) if slopes[own].any() else ((), 0.0)
        rest = [k for k in range(len(own)) if k not in chosen]
        weights = np.linalg.lstsq(slopes[own[list(chosen)]].T, slopes[own[rest]].T, rcond=None)[0].T
        # A position says nothing of a velocity that is not zero, and the other way round.
        alike = (np.array(rest, dtype=int)[:, None] < first) == (np.array(chosen, dtype=int) < first)
        left = sizes[0][own[rest]] - np.where(alike, weights, 0.0) @ sizes[0][own[list(chosen)]]
        if (bad := np.flatnonzero(np.abs(left) > TYPED * max(1.0, float(np.abs(sizes).max())))).size:
            row = numbers.names[own[rest[int(bad[0])]]]
            what, way = ("the ends never meet", "between them; move or turn one end")
            if rest[int(bad[0])] >= first:
                what, way = ("no velocity has this speed", "of it, m/s; turn its direction, or give speed=0")
            raise InputError(
                f"{numbers.model.name}: {row}: {what}, whatever the joints do: {float(left[bad[0]]):.6g} is left {way}"
            )
        if not chosen:
            raise InputError(
                f"{numbers.model.name}: {numbers.names[own[0]].rpartition(repr(part))[0]}{part!r} closes nothing: no "
                "joint moves its ends against each other; leave it out"
            )
        kept += sorted(int(own[k]) for k in chosen)
    return sorted(kept)


#: Name of each quantity of constraints -> the arguments of its function.
CONSTRAINT_FUNCTIONS: Final = of_groups("row")


def singular_mass_matrix(model: Model) -> bool:
    """Return whether M of the tree has no inverse, or is not known, at the model's nominal numbers."""
    if any(x is None for x in model.parameters.values()):
        return True
    M = sample_mass_matrix(model)
    if not (np.isfinite(M).all() and (np.diag(M) > 0).all()):
        return True
    root = np.sqrt(np.diag(M))
    return bool(np.linalg.eigvalsh(M / root[:, None] / root)[0] < _SINGULAR)


class ConstraintQuantities:
    """f, J, rate and γ of all rows, redundant ones among them; a mixin for equations with `constraint_forces`."""

    constraints: Any
    all_constraints: Any
    #: Numbers that are negative where the frames of a loop point opposite ways, or a disc lies flat.
    loop_ways: Any = ca.SX(0, 1)
    model: Model
    q: ca.SX
    v: ca.SX
    a: ca.SX
    inverse_dynamics: Any
    named: Callable[..., ca.Function]
    _constrained: Any

    @property
    def generalized_constraint_force(self) -> Any:
        """Jᵀ λ."""
        return ca.mtimes(self.constraints.jacobian.T, self._constrained[1])

    @property
    def independent_multipliers(self) -> Any:
        """λ of the independent rows."""
        return self._constrained[1]

    @property
    def row_choice(self) -> RowChoice:
        """Which of all rows are independent: each."""
        c = self.constraints
        return RowChoice((every := tuple(range(len(c.names)))), c.positions, every, c.names)

    def _spread(self, multipliers: Any) -> Any:
        """Return the multipliers of all rows; none is redundant."""
        return multipliers

    def actuator_forces(self, actuators: tuple[int, ...]) -> ca.Function:
        """Return (q, v, a) -> the forces of the actuated velocities, with the least norm, that make a motion.

        One column: τ, λ of all rows, J a + γ, and of its rows the sizes; last the remainder of the worst row of J once
        the others are taken away, or of a velocity without an actuator in J's rows, as a square.

        With f = M a + h - τ_passive, τ = f - Jᵀ λ is zero where nothing acts.
        """
        c, n = self.constraints, self.model.nv
        J, f = c.jacobian, self.inverse_dynamics
        others = [i for i in range(n) if i not in actuators]
        rows = OrthogonalColumns(J.T)
        tau, multipliers, parts = rows.balanced(f, others)
        left: Any = ca.SX(1.0)
        for part in (*(x / y for x, y in zip(rows.remainders, rows.squares, strict=True)), *parts):
            left = ca.fmin(left, part)
        rates = ca.mtimes(J, self.a) + c.gamma
        out = ca.vertcat(tau, self._spread(multipliers), rates, ca.sqrt(ca.sum2(J**2)), left)
        return self.named("actuator_forces", ("q", "v", "a"), [self.q, self.v, self.a], out)

    constraint_residual = forwarded("all_constraints.value", "f(q, t) of the rows that hold positions.")
    constraint_jacobian = forwarded("all_constraints.jacobian", "J of all rows.")
    constraint_rate = forwarded("all_constraints.rate", "J v + ∂f/∂t, then A v - b.")

    @property
    def constraint_rate_gradient(self) -> Any:
        """Derivative of the rates by q, along the manifold."""
        q = self.q
        return ca.mtimes(ca.jacobian(self.constraint_rate, q), self.tangent)

    @property
    def tangent(self) -> Any:
        """D of q̇ = D(q) v."""
        return ca.jacobian(self.kin.qdot, self.v)  # type: ignore[attr-defined]  # of the equations

    constraint_bias = forwarded("all_constraints.gamma", "γ, with the rate's derivative J v̇ + γ.")


class ConstrainedMotion(ConstraintQuantities):
    """What constraints make of the equations of a tree; a mixin for `Equations`.

    Every term but the accelerations is that of the tree.
    """

    kin: Kinematics
    motion: BodyMotion
    tau: ca.SX
    extra_arguments: dict[str, ca.SX]
    mass_matrix: Any
    passive: Any
    nle: Any
    elimination: Any
    elimination_order: tuple[int, ...]

    @property
    def time(self) -> Any:
        """The symbol of the time; None where it does not enter."""
        return self.kin.values.named[self.model.time_parameter] if self.model.time_parameter else None

    @cached_property
    def constraint_rows(self) -> Constraints:
        """All rows, and which of them are independent."""
        return Constraints(self.kin, self.time)

    constraints: ConstraintTerms = forwarded("constraint_rows.terms", "The independent rows.")
    all_constraints: ConstraintTerms = forwarded("constraint_rows.all", "All rows.")
    loop_ways = forwarded(
        "constraint_rows.ways",
        "Numbers that are negative where the frames of a loop point opposite ways, or a disc lies flat.",
    )
    row_choice: RowChoice = forwarded("constraint_rows.choice", "Which of all rows are independent.")

    @cached_property
    def constraint_factors(self) -> ConstraintFactors:
        """Factors of M, or more careful ones where M would lose digits, and of J's rows in its metric."""
        careful = singular_mass_matrix(self.model)
        return ConstraintFactors(self.constraints, self.mass_matrix, self.elimination_order, careful=careful)

    @cached_property
    def _constrained(self) -> tuple[Any, Any]:
        force = self.tau + self.passive - self.nle
        a, multipliers = self.constraint_factors.motion(force)
        rows = self.constraint_rows
        lost, every = list(rows.choice.redundant), rows.all
        doubt = off_branch(every.jacobian[lost, :], every.gamma[lost, :], a, force, self.mass_matrix)
        return a + doubt, multipliers + doubt

    @property
    def forward_dynamics(self) -> Any:
        """v̇ of the tree under its constraints."""
        return self._constrained[0]

    @cached_property
    def constraint_forces(self) -> Any:
        """λ of all rows; of redundant ones those with the least norm."""
        return self._spread(self._constrained[1])

    def _spread(self, multipliers: Any) -> Any:
        return self.constraint_rows.spread(multipliers)

    every_jacobian = forwarded("constraint_rows.every", "J of all rows, those that say nothing among them.")

    def loads(self, joints: Sequence[str], frames: Sequence[str], axes: str, moved: bool) -> ca.Function:
        """Return (q, v, a, τ, wrenches) -> loads of joints, then of loops, (n, 6), and a last row of two forces.

        Where the motion is that of τ (`moved`) there is no argument a. The last row has the part of M a + h - τ that no
        force of the constraints makes up for, and the size of both forces.
        """
        motion, rows = self.motion, self.constraint_rows
        wrenches = ca.SX.sym("wrenches", 6 * len(frames))
        pushed = self.tau + motion.generalized_force(frames, axes, wrenches) if frames else self.tau
        acting = self.inverse_dynamics - pushed
        J = self.constraints.jacobian
        left, multipliers, _ = OrthogonalColumns(J.T).balanced(acting, [])
        loops = rows.loop_wrenches(multipliers)
        outside, own = [], []
        for loop, (force, moment) in zip(self.model.loops, loops, strict=True):
            both, at = self.model.carrier(loop), self.kin.values.of(loop)
            # At the same point on body b, which is a gap away from its frame.
            back = [-x for x in force], [-x - y for x, y in zip(moment, cross3(rows.gap(loop), force), strict=True)]
            for body, point, pair in (
                (loop.body_a, at.translation_a, (force, moment)),
                (loop.body_b, at.translation_b, back),
            ):
                F, N = (motion.in_body(body, x, both) for x in pair)
                if body == loop.body_a:
                    R = at.rotation_a
                    own.append(ca.horzcat(*(ca.SX(y) for x in (F, N) for y in constant_transposed_times(R, x))))
                outside.append((body, F, add(N, cross3(point, F))))
        table = motion.joint_wrenches(joints, frames, axes, wrenches, outside)
        sizes = ca.horzcat(ca.norm_2(left), ca.norm_2(self.inverse_dynamics) + ca.norm_2(pushed), ca.SX(1, 4))
        out = ca.vertcat(table, ca.SX(0, 6), *own, sizes)
        given = {"q": self.q, "v": self.v, "a": self.a, "tau": self.tau, "wrenches": wrenches}
        if moved:
            out = ca.substitute(out, self.a, ca.substitute(self.forward_dynamics, self.tau, pushed))
            del given["a"]
        if not frames:
            del given["wrenches"]
        return self.named("loads", tuple(given), [*given.values()], out)

    @cached_property
    def forward_dynamics_derivatives(self) -> tuple[Any, Any, Any]:
        """∂FD/∂q along the manifold, ∂FD/∂v and ∂FD/∂τ; the last is M⁻¹ on what the constraints leave free.

        From M v̇ + h - Jᵀ λ = τ and J v̇ + γ = 0 at v̇ = FD: neither is differentiated through its factors.
        """
        c, n = self.constraints, self.model.nv
        a, multipliers = self._constrained
        symbols = ca.SX.sym("multipliers", c.jacobian.shape[0])
        force = self.inverse_dynamics - ca.mtimes(c.jacobian.T, symbols)
        rate = ca.mtimes(c.jacobian, self.a) + c.gamma
        both = ca.vertcat(force, rate)
        slopes = ca.horzcat(ca.jtimes(both, self.q, self.tangent), ca.jacobian(both, self.v))
        slopes = ca.substitute(slopes, ca.vertcat(self.a, symbols), ca.vertcat(a, multipliers))
        right = ca.horzcat(-slopes, ca.vertcat(ca.SX.eye(n), ca.SX(len(c.names), n)))
        out, _ = self.constraint_factors.motion(right[:n, :], right[n:, :])
        by_q, by_v, by_tau = ca.horzsplit(out, [0, n, 2 * n, 3 * n])
        return by_q, by_v, by_tau
