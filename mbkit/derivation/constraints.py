"""Constraints f(q, t) = 0 of loops and of motions prescribed in time, as CasADi expressions.

One form for all of them, with the multipliers λ::

    M v̇ + C v + g = τ + τ_passive + Jᵀ λ        J v̇ + γ = 0

J is the Jacobian of f on the velocities: ḟ = J v + ∂f/∂t, and f̈ = J v̇ + γ (Featherstone 2008, Rigid Body Dynamics
Algorithms, ch. 8). By Gauss's principle v̇ is the least change, in the metric of M, of the free acceleration.

Rows of a loop stand in the axes of the body that carries both its ends. A row that follows from the others at every
configuration, such as the third of a point loop in a plane, says nothing and is left out. A row that follows from the
others only where the loops are closed, as in Bricard's mechanism, is redundant: it is kept among the multipliers, of
which those with the least norm are given, and left out of the equation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.derivation.elements.arithmetic import casadi_arithmetic
from mbkit.derivation.kinematics import Kinematics, Vector
from mbkit.derivation.least_constraint import hard_poses
from mbkit.derivation.mass_matrix_solve import Factors
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.model.elements.motion_laws import MOTION_LAWS
from mbkit.model.loops import LOOP_ROWS, LoopEnds
from mbkit.model.manifold import random_state
from mbkit.model.parts import Loop
from mbkit.model.validation import sample_mass_matrix

#: Mass of a coordinate that has none, in terms of the mean one.
_MASSLESS: Final = 1e-20
_TINY: Final = 1e-300
#: Times that a solution is refined by careful factors, and by those of a mass matrix that loses digits where a joint
#: locks. Each time leaves what the factors lose of the error before.
_REFINED_CAREFUL: Final = 2
_REFINED: Final = 1
#: Part of a row that is left of it, once the others are taken away, up to which it follows from them.
DEPENDENT: Final = 1e-7
#: Of a mechanism's size: what a few typed digits leave where ends can meet.
_MEETS: Final = 1e-9
#: Configurations at which rows are looked at, and random starts from which a closed one is searched.
_LOOKS: Final = 6
_STARTS: Final = 12
_STEPS: Final = 60
#: Smallest eigenvalue of a mass matrix with a unit diagonal that still has an inverse of some digits.
_SINGULAR: Final = 1e-9
#: Eigenvalue up to which elimination loses more than some five digits, and how many times as large it has to be with
#: constraints in the matrix for these to be worth their operations.
_LOSES: Final = 1e-5
_BETTER: Final = 1e3
#: Residual of a closed configuration, m or rad.
_CLOSED: Final = 1e-10


class ConstraintTerms:
    """f(q, t) and its derivatives J, ∂f/∂t, rate ḟ = J v + ∂f/∂t and γ, with f̈ = J v̇ + γ.

    `names` has one text for each row, and `qdot` is D(q) v where velocities are not the coordinates' rates.
    """

    def __init__(
        self, value: ca.SX, q: ca.SX, v: ca.SX, time: Any, names: tuple[str, ...], qdot: ca.SX | None = None
    ) -> None:
        self.value, self.names = value, names
        self._q, self._v, self._qdot = q, v, qdot
        by_q = ca.jacobian(value, q)
        self.jacobian = by_q if qdot is None else ca.mtimes(by_q, ca.jacobian(qdot, v))
        self.by_time = ca.SX(value.shape[0], 1) if time is None else ca.jacobian(value, time)
        self.rate = ca.mtimes(self.jacobian, v) + self.by_time
        self.gamma = ca.jtimes(self.rate, q, v if qdot is None else qdot)
        if time is not None:
            self.gamma = self.gamma + ca.jacobian(self.rate, time)

    def rate_along(self, by: Any) -> Any:
        """Return the derivative of ḟ along a move of the configuration, (nv,), with v and the time held."""
        move = by if self._qdot is None else ca.substitute(self._qdot, self._v, by)
        return ca.jtimes(self.rate, self._q, move)

    def stiffening(self, M: Any) -> Any:
        """Return s > 0, (m, 1), so that W = M + Jᵀ diag(s) J has an inverse where M has it on J's null space.

        With J v̇ prescribed, the term changes neither v̇ nor λ. s is the geometric mean of the sum's and the lightest
        coordinate's mass along a row: W keeps the digits of both, of a light rod in a loop as of a heavy body.
        """
        masses = ca.diag(M)
        masses = masses + _MASSLESS / masses.shape[0] * ca.sum1(masses)
        squares = self.jacobian**2
        heavy, light = ca.mtimes(squares, masses), ca.mtimes(squares, 1 / masses)
        # Of a row without slope the term is zero.
        return ca.sqrt((heavy + _TINY) / (light + _TINY)) / (ca.sum2(squares) + _TINY)

    def weight(self, M: Any) -> Any:
        """Return W = M + Jᵀ diag(s) J of `stiffening`."""
        return M + ca.mtimes(self.jacobian.T, self.stiffening(M) * self.jacobian)


class ConstraintFactors:
    """Factors of M and of S = J M⁻¹ Jᵀ, which give v̇ and λ, and how often the solution is `refined`.

    Where M itself would lose digits or has no inverse, as with links without mass in a loop, `careful` ones are those
    of W = M + Jᵀ diag(s) J. Near a singular pose, and with masses that differ by decades, factors lose the square of
    the digits that the equations lose.
    """

    def __init__(self, c: ConstraintTerms, M: Any, order: tuple[int, ...], *, careful: bool, refined: int) -> None:
        self._c, self._M, self.careful, self._refined = c, M, careful, refined
        self._stiffening = c.stiffening(M) if careful else None
        self._W = Factors(c.weight(M) if careful else M, order)
        #: W⁻¹ Jᵀ, (n, m), and J W⁻¹ Jᵀ with its factors.
        self.Y = self._W.solve(c.jacobian.T)
        self.matrix = ca.mtimes(c.jacobian, self.Y)
        self.S = Factors(self.matrix, range(c.value.shape[0]))

    def solved(self, force: Any, rate: Any) -> tuple[Any, Any]:
        """Return x and λ of M x - Jᵀ λ = force, J x = rate."""
        J = self._c.jacobian
        given = force + ca.mtimes(J.T, self._stiffening * rate) if self.careful else force
        free = self._W.solve(given)
        multipliers = self.S.solve(rate - ca.mtimes(J, free))
        return free + ca.mtimes(self.Y, multipliers), multipliers

    def motion(self, force: Any) -> tuple[Any, Any]:
        """Return v̇ and λ of M v̇ - Jᵀ λ = force, J v̇ = -γ.

        Only f̈ = 0 holds: integrators project drifted states (`mbkit.derivation.steps.onto_constraints`).
        """
        c, M = self._c, self._M
        a, multipliers = self.solved(force, -c.gamma)
        for _ in range(self._refined):
            left = force - ca.mtimes(M, a) + ca.mtimes(c.jacobian.T, multipliers)
            da, more = self.solved(left, -c.gamma - ca.mtimes(c.jacobian, a))
            a, multipliers = a + da, multipliers + more
        return a, multipliers


# Rows of loops and of prescribed motions


def _carried(kin: Kinematics, body: str, to: str, x: Vector, weight: float) -> Vector:
    while body != to:
        joint = kin.carrier(body)
        x, body = kin.to_parent(joint, x, weight), joint.parent
    return x


def _ends(kin: Kinematics, loop: Loop) -> LoopEnds:
    values = kin.values.loops[loop.name]
    both = kin.model.carrier(loop)
    sides = (
        (loop.body_a, values.translation_a, values.rotation_a),
        (loop.body_b, values.translation_b, values.rotation_b),
    )
    p, q = (_carried(kin, body, both, list(point), 1.0) for body, point, _ in sides)
    a, b = ([_carried(kin, body, both, [row[k] for row in R], 0.0) for k in range(3)] for body, _, R in sides)
    return LoopEnds([x - y for x, y in zip(p, q, strict=True)], a, b, values.length)


def _rows(kin: Kinematics, time: Any) -> Iterator[tuple[str, str, Any]]:
    """Yield the part, the name and the expression of every row, those that say nothing among them."""
    model = kin.model
    for loop in model.loops:
        names, rows = LOOP_ROWS[loop.kind]
        for name, row in zip(names, rows(_ends(kin, loop)), strict=True):
            yield loop.name, f"loop {loop.name!r} {name}", row
    for motion in model.prescribed:
        (at,) = kin.coordinates(model.joint(motion.joint))
        numbers = casadi_arithmetic(kin.values.number)
        path = MOTION_LAWS[type(motion)].path(motion, kin.values.prescribed[motion.joint], time, numbers)
        yield motion.joint, f"motion of {motion.joint!r}", at - path


def _ways(kin: Kinematics) -> Any:
    """Return for each loop a number that is negative where its frames point opposite ways."""
    return ca.vertcat(ca.SX(0, 1), *(ca.SX(_ends(kin, loop).way(loop.kind)) for loop in kin.model.loops))


class Constraints:
    """The constraints of a model with loops or prescribed motions, from its kinematics.

    Attributes
    ----------
    names : tuple of str
        Of the rows that say something, such as ``"loop 'pin' x"``.
    independent : tuple of int
        Which of these rows the equation is made of; the others follow from them where all loops are closed.
    closed : (nq,) array or None
        A configuration at which all loops are closed, if one was found.
    ways : casadi.SX
        One number for each loop, negative where its frames point opposite ways, though its rows are zero there.
    """

    def __init__(self, kin: Kinematics, time: Any) -> None:
        rows = list(_rows(kin, time))
        choice = choose_rows(kin.model)
        kept = [rows[i] for i in choice.kept]
        self.names = tuple(name for _, name, _ in kept)
        self.independent, self.closed = choice.independent, choice.closed
        value = ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for *_, x in kept))
        self.ways = _ways(kin)
        turned = kin.qdot if kin.model.quaternions else None
        #: All rows that say something, and those of the equation.
        self.all = ConstraintTerms(value, kin.q, kin.v, time, self.names, turned)
        if len(self.independent) == len(self.names):
            self.terms = self.all
        else:
            which = list(self.independent)
            named = tuple(self.names[i] for i in which)
            self.terms = ConstraintTerms(value[which], kin.q, kin.v, time, named, turned)

    def spread(self, multipliers: Any) -> Any:
        """Return the multipliers of all rows with the least norm whose force is that of the independent ones.

        J_all = C J, so that Jᵀ λ = J_allᵀ μ for every μ with Cᵀ μ = λ.
        """
        if self.terms is self.all:
            return multipliers
        J, m = self.terms.jacobian, len(self.independent)
        C = ca.mtimes(self.all.jacobian, Factors(ca.mtimes(J, J.T), range(m)).solve(J).T)
        return ca.mtimes(C, Factors(ca.mtimes(C.T, C), range(m)).solve(multipliers))


# Which rows say something, and which of those are independent: from numbers


@dataclass(frozen=True)
class RowChoice:
    """Which of all rows say something, and which of those are independent where the loops are closed.

    `closed` is a configuration at which they are, or None where none was found.
    """

    kept: tuple[int, ...]
    independent: tuple[int, ...]
    closed: Array | None = field(default=None, compare=False)


class _Numbers:
    """f and J of all rows at the model's nominal numbers, and whether the frames of loops point the same way."""

    def __init__(self, model: Model) -> None:
        self.model = model
        kin = Kinematics(model)
        time = kin.values.named[model.time_parameter] if model.time_parameter else None
        rows = list(_rows(kin, time))
        self.parts = [part for part, *_ in rows]
        self.names = [name for _, name, _ in rows]
        value = ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for *_, x in rows))
        J = ca.mtimes(ca.jacobian(value, kin.q), ca.jacobian(kin.qdot, kin.v))
        outs = [ca.densify(x) for x in (value, J, _ways(kin))]
        self._call = ca.Function("rows", [kin.q, kin.values.parameters], outs)
        # A parameter without a value has one that is as good as another.
        self._parameters = [1.0 if x is None else x for x in model.parameters.values()]

    def __call__(self, q: Array) -> tuple[Array, Array]:
        f, J, _ = self._call(q, self._parameters)
        return np.array(f)[:, 0], np.array(J)

    def closed(self, q: Array, kept: list[int]) -> Array | None:
        """Return a configuration near q where these rows are zero, by damped Gauss-Newton; None where it ends else."""
        f, J = (x[kept] for x in self(q))
        for _ in range(_STEPS):
            size = float(np.linalg.norm(f))
            if size < _CLOSED * 1e-3:
                break
            step, length = np.linalg.lstsq(J, -f, rcond=1e-10)[0], 1.0
            while length > 1e-6:
                beyond = self.model.integrate(q, length * step)
                f1, J1 = (x[kept] for x in self(beyond))
                if np.linalg.norm(f1) < size:
                    break
                length *= 0.5
            else:
                break
            q, f, J = beyond, f1, J1
        # Half a turn away the sine of a frame's angle is zero too, and its rows depend on each other.
        turned = np.array(self._call(q, self._parameters)[2])
        return q if np.linalg.norm(f) < _CLOSED and (turned >= 0).all() else None


#: The name under which a model keeps its own.
_CHOICE: Final = "_row_choice"


def choose_rows(model: Model) -> RowChoice:
    """Return which rows of a model say something, and which of those are independent where its loops are closed.

    Raises
    ------
    InputError
        A loop whose ends never meet, or that no joint moves.
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
    tried = [model.neutral(), *anywhere, *(_wide(model, rng) for _ in range(_STARTS))]
    closed = [x for x in (numbers.closed(q, kept) for q in tried) if x is not None]
    if not closed:
        # The state that a user gives tells more: it is refused there, with what is left of each row.
        return RowChoice(tuple(kept), tuple(range(len(kept))))
    found = [(*independent_rows(numbers(q)[1][kept]), q) for q in closed]
    rows, _, q = max(found, key=lambda x: (len(x[0]), x[1]))
    return RowChoice(tuple(kept), rows, q)


def _wide(model: Model, rng: np.random.Generator) -> Array:
    return model.integrate(model.neutral(), rng.uniform(-3, 3, model.nv))


def _with_something_to_say(numbers: _Numbers, poses: list[Array]) -> list[int]:
    """Return the rows that do not follow from others of their loop at every configuration, by constant weights."""
    kept: list[int] = []
    values = [numbers(q) for q in poses]
    slopes, sizes = np.concatenate([J for _, J in values], axis=1), np.array([f for f, _ in values])
    for part in dict.fromkeys(numbers.parts):
        own = np.array([i for i, x in enumerate(numbers.parts) if x == part])
        chosen, _ = independent_rows(slopes[own]) if slopes[own].any() else ((), 0.0)
        rest = [k for k in range(len(own)) if k not in chosen]
        weights = np.linalg.lstsq(slopes[own[list(chosen)]].T, slopes[own[rest]].T, rcond=None)[0].T
        left = sizes[0][own[rest]] - weights @ sizes[0][own[list(chosen)]]
        if (bad := np.flatnonzero(np.abs(left) > _MEETS * max(1.0, float(np.abs(sizes).max())))).size:
            row = numbers.names[own[rest[int(bad[0])]]]
            raise InputError(
                f"{numbers.model.name}: {row}: the ends never meet, whatever the joints do: "
                f"{float(left[bad[0]]):.6g} is left between them; move or turn one end"
            )
        if not chosen:
            raise InputError(
                f"{numbers.model.name}: loop {part!r} closes nothing: no joint moves its ends against each other; "
                "leave it out"
            )
        kept += sorted(int(own[k]) for k in chosen)
    return kept


def independent_rows(J: Array) -> tuple[tuple[int, ...], float]:
    """Return the largest set of rows that are independent, and what is left of the last one, by pivoting."""
    from scipy.linalg import qr

    size = np.linalg.norm(J, axis=1)
    scale = np.where(size > DEPENDENT * size.max(initial=0.0), size, np.inf)
    _, R, order = qr((J / scale[:, None]).T, mode="economic", pivoting=True)
    left = np.abs(np.diag(R))
    rank = int(np.count_nonzero(left > DEPENDENT))
    return tuple(sorted(order[:rank].tolist())), float(left[rank - 1]) if rank else 0.0


#: Name of each quantity of constraints -> the arguments of its function.
CONSTRAINT_FUNCTIONS: Final = {
    "constraint_residual": ("q",),
    "constraint_jacobian": ("q",),
    "constraint_rate": ("q", "v"),
    "constraint_bias": ("q", "v"),
    "constraint_forces": ("q", "v", "tau"),
    "generalized_constraint_force": ("q", "v", "tau"),
}


def singular_mass_matrix(model: Model) -> bool:
    """Return whether M of the tree has no inverse, or is not known, at the model's nominal numbers."""
    if any(x is None for x in model.parameters.values()):
        return True
    return _least_part(sample_mass_matrix(model)) < _SINGULAR


def _least_part(M: Array) -> float:
    """Return the smallest eigenvalue of a mass matrix once its diagonal is scaled to one; 0 where that is not done."""
    diagonal = np.diag(M)
    if not (np.isfinite(M).all() and (diagonal > 0).all()):
        return 0.0
    root = np.sqrt(diagonal)
    return max(float(np.linalg.eigvalsh(M / root[:, None] / root)[0]), 0.0)


class ConstraintQuantities:
    """f, J, ḟ and γ of all rows, redundant ones among them; a mixin for equations that have `constraint_forces` too."""

    constraints: Any
    all_constraints: Any
    #: One number for each loop, negative where its frames point opposite ways.
    loop_ways: Any = ca.SX(0, 1)
    #: A configuration at which all loops are closed, if one is known.
    closed_configuration: Array | None = None
    _constrained: Any

    @property
    def generalized_constraint_force(self) -> Any:
        """Jᵀ λ."""
        return ca.mtimes(self.constraints.jacobian.T, self._constrained[1])

    @property
    def constraint_residual(self) -> Any:
        """f(q, t)."""
        return self.all_constraints.value

    @property
    def constraint_jacobian(self) -> Any:
        """J."""
        return self.all_constraints.jacobian

    @property
    def constraint_rate(self) -> Any:
        """J v + ∂f/∂t."""
        return self.all_constraints.rate

    @property
    def constraint_bias(self) -> Any:
        """γ, with f̈ = J v̇ + γ."""
        return self.all_constraints.gamma


class ConstrainedMotion(ConstraintQuantities):
    """What loops and prescribed motions make of the equations of a tree; a mixin for `Equations`.

    Every term but the accelerations is that of the tree.
    """

    model: Model
    kin: Kinematics
    q: ca.SX
    v: ca.SX
    tau: ca.SX
    mass_matrix: Any
    passive: Any
    nle: Any
    elimination: Any
    elimination_order: tuple[int, ...]
    extra_arguments: dict[str, ca.SX]

    @property
    def time(self) -> Any:
        """The symbol of the time; None where it does not enter."""
        return self.kin.values.named[self.model.time_parameter] if self.model.time_parameter else None

    @cached_property
    def constraint_rows(self) -> Constraints:
        """All rows, and which of them are independent."""
        return Constraints(self.kin, self.time)

    @property
    def constraints(self) -> ConstraintTerms:
        """The independent rows."""
        return self.constraint_rows.terms

    @property
    def all_constraints(self) -> ConstraintTerms:
        """All rows."""
        return self.constraint_rows.all

    @property
    def loop_ways(self) -> Any:
        """One number for each loop, negative where its frames point opposite ways."""
        return self.constraint_rows.ways

    @property
    def closed_configuration(self) -> Array | None:  # type: ignore[override]  # read only
        """A configuration at which all loops are closed, if one was found."""
        return self.constraint_rows.closed

    @property
    def independent_constraints(self) -> tuple[int, ...]:
        """Which of all rows are independent."""
        return self.constraint_rows.independent

    @cached_property
    def constraint_factors(self) -> ConstraintFactors:
        """Factors of M, or more careful ones where M would lose digits, and of J M⁻¹ Jᵀ."""
        doubtful = self.elimination == "least constraint"
        careful = singular_mass_matrix(self.model) or (doubtful and self._constraints_hold_what_mass_does_not())
        times = _REFINED_CAREFUL if careful else _REFINED if doubtful else 0
        return ConstraintFactors(
            self.constraints, self.mass_matrix, self.elimination_order, careful=careful, refined=times
        )

    def _constraints_hold_what_mass_does_not(self) -> bool:
        """Return whether W = M + Jᵀ diag(s) J of `ConstraintTerms` keeps digits that M loses at some hard pose.

        Not where a joint locks, or a thin rod turns about its line: loops do not see that motion either.
        """
        given = [np.array(list(self.model.parameters.values()), dtype=np.float64)] if self.extra_arguments else []
        weights = [ca.densify(x) for x in (self.mass_matrix, self.constraints.weight(self.mass_matrix))]
        matrices = ca.Function("weights", [self.q, *self.extra_arguments.values()], weights)
        for q in hard_poses(self.model, np.random.default_rng(0)):
            mass, held = (_least_part(np.array(x)) for x in matrices(q, *given))
            if mass < _LOSES and held > max(_BETTER * mass, _SINGULAR):
                return True
        return False

    @cached_property
    def _constrained(self) -> tuple[Any, Any]:
        return self.constraint_factors.motion(self.tau + self.passive - self.nle)

    @property
    def forward_dynamics(self) -> Any:
        """v̇ of the tree under its constraints."""
        return self._constrained[0]

    @cached_property
    def constraint_forces(self) -> Any:
        """λ of all rows; of redundant ones those with the least norm."""
        return self.constraint_rows.spread(self._constrained[1])

    @cached_property
    def forward_dynamics_derivatives(self) -> tuple[Any, Any, Any]:
        """∂FD/∂q along the manifold, ∂FD/∂v and ∂FD/∂τ; the last is M⁻¹ on what the constraints leave free."""
        a = self.forward_dynamics
        by_q = ca.mtimes(ca.jacobian(a, self.q), ca.jacobian(self.kin.qdot, self.v))
        return by_q, ca.jacobian(a, self.v), ca.jacobian(a, self.tau)
