"""Constraints in numbers: the states that they allow, and whether they are independent there.

A state is consistent where f(q, t) = 0 and the rates J v + c of all rows are zero; rows that hold velocities alone, as
those of a wheel that rolls, have no f, and let a configuration be whatever the others allow. Independence belongs to a
pose: a set may have full rank on one branch of a mechanism only (a row of equal four-bars).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mbkit._attributes import forwarded
from mbkit._check import CONSISTENT, ROUNDING, Array
from mbkit._reproducible import independent_rows, pivoted, singular_values, under_rows, unit_rows
from mbkit.derivation.constraints import ASIDE, BESIDE, starts
from mbkit.derivation.steps.onto_constraints import dependence, nears_singular, projection
from mbkit.engines.base import Dynamics, at_time
from mbkit.engines.constrained import AT_POSE, ROWS, singular_pose
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, UnknownNameError
from mbkit.model import Model
from mbkit.model.loops import discs_of
from mbkit.model.manifold import closest_configuration, least_change

#: Rounds of the projection's iterations.
_ROUNDS: Final = 8
#: Steps of the search for a foot.
_MOST: Final = 200
_TWIN: Final = "_constrained_twin"


def _function(eq: Any, name: str) -> ca.Function:
    """Return a compiled function of (q), (q, v) or (q, v, τ), and the parameters."""
    if name in (projection.__name__, dependence.__name__):
        return {"projection": projection, "dependence": dependence}[name](eq)
    c = eq.constraints
    inputs = {"q": eq.q, "v": eq.v}
    if name == "constraint_rows":
        del inputs["v"]
        outputs = {"f": c.value, "J": c.jacobian}
    elif name == "constraint":
        outputs = {"f": c.value, "J": c.jacobian, "rate": c.rate, "M": eq.mass_matrix}
    elif name == "all_rows":
        del inputs["v"]
        every = eq.all_constraints
        outputs = {"f": every.value, "J": every.jacobian, "ways": eq.loop_ways, "by_time": every.by_time}
    elif name == "multipliers":
        inputs["tau"] = eq.tau
        outputs = {"lambda": eq.constraint_forces}
    elif name == "embedded":
        outputs = {
            "J": c.jacobian,
            "by_time": c.by_time,
            "gamma": c.gamma,
            "M": eq.mass_matrix,
            "force": eq.passive - eq.nle,
        }
    else:
        # curvature: ∂(Jᵀ λ)/∂q; λ takes the place of v's first entries.
        outputs = {"H": ca.jacobian(ca.mtimes(c.jacobian.T, eq.v[: len(c.names)]), eq.q)}
    inputs |= eq.extra_arguments
    dense = [ca.densify(x) for x in outputs.values()]
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs), {"cse": True})


def _scale(J: Array) -> Array:
    sizes = np.abs(J).sum(axis=-1)
    # Of a row that has no slope at a singular pose the rounding of the others is left.
    sizes = np.maximum(sizes, AT_POSE * sizes.max(axis=-1, keepdims=True, initial=0.0))
    return np.asarray(np.where(sizes > 0, sizes, 1.0))


class Manifold:
    """The consistent states of dynamics with constraints, in numbers."""

    def __init__(self, dyn: LagrangianDynamics) -> None:
        self.dyn = dyn

    def at(self, t: float) -> Manifold:
        """Return the states at a time."""
        return Manifold(at_time(self.dyn, t)) if self.dyn.model.time_parameter else self

    equations = forwarded("dyn.equations", "The equations, with their `constraints`.")

    @property
    def names(self) -> tuple[str, ...]:
        """A text for each row."""
        names: tuple[str, ...] = self.equations.constraints.names
        return names

    def call(self, name: str, *arguments: Array) -> list[Array]:
        """Return the outputs of a compiled function, with its parameters behind."""
        code = self.dyn._code(name, make=lambda: _function(self.equations, name))
        if self.dyn.model.parameters:
            p, lead = self.dyn._parameter_values, arguments[0].shape[:-1]
            if p.ndim > 1 and not lead:
                # One of a batch is a batch of one.
                (p,) = p
            arguments = (*arguments, np.broadcast_to(p, (*lead, p.shape[-1])))
        return list(code(*arguments))

    def all_rows(self, q: Array) -> Array:
        """Return J of all rows, redundant ones among them."""
        return self.call("all_rows", q)[1]

    def still_open(self, q: Array, v: Array | None = None) -> str:
        """Return the rows that are not zero, with v those too whose rates are not; empty where all is closed.

        A dependent row is named with those that it contradicts; a loop may be half a turn off where its rows are zero.
        """
        sides, J, ways = self._left(q, v)
        every, kept = self.equations.all_constraints.names, np.array(self.equations.row_choice.independent, dtype=int)
        rows = []
        for unit, (left, is_open) in zip(("", " per second"), sides, strict=False):
            for k in np.flatnonzero(is_open).tolist():
                against = ", ".join(every[i] for i in needed(J, kept, [k])) if k not in kept else ""
                rows.append(f"{every[k]} by {left[k]:.3g}{unit}{against and f' against {against}'}")
        model = self.dyn.model
        turned = [f"loop {x.name!r} half a turn off" for x in model.loops]
        turned += [f"no slip {x.name!r}, whose disc lies flat" for x in discs_of(model)]
        return ", ".join(rows or [text for text, way in zip(turned, ways, strict=True) if way < 0])

    def _left(self, q: Array, v: Array | None) -> tuple[list[tuple[Array, NDArray[np.bool_]]], Array, Array]:
        """Return f and, with v, the rates of all rows, each with which of them are open; J; and the ways of loops.

        Of one state or each of a batch.
        """
        f, J, ways, by_time = self.call("all_rows", q)
        sides = [(f[..., 0], q)] if v is None else [(f[..., 0], q), ((J @ v[..., None] + by_time)[..., 0], v)]
        out = []
        for left, x in sides:
            size = np.maximum(1.0, np.abs(x).max(axis=-1, keepdims=True, initial=0.0))
            out.append((left, ~(np.abs(left) <= CONSISTENT * _scale(J)[..., : left.shape[-1]] * size)))
        return out, J, ways[..., 0]

    def value(self, q: Array) -> Array:
        """Return f of the rows that hold positions, (k,) or (N, k)."""
        return np.asarray(self.call("constraint_rows", q)[0][..., 0])

    def jacobian(self, q: Array) -> Array:
        """Return J, (m, n) or (N, m, n)."""
        return self.call("constraint_rows", q)[1]

    def multipliers(self, q: Array, v: Array, tau: Array) -> Array:
        """Return λ, (m,) or (N, m)."""
        return np.asarray(self.call("multipliers", q, v, tau)[0][..., 0])

    def terms(self, q: Array, v: Array) -> tuple[Array, Array, Array, Array]:
        """Return f of the rows that hold positions, then J and the rates of the independent rows, and M."""
        f, J, rate, M = self.call("constraint", q, v)
        return f[:, 0], J, rate[:, 0], M

    # Consistency

    def check(self, q: Array, v: Array) -> None:
        """Refuse an inconsistent state, of one or a batch, with what is left of its rows (InputError)."""
        places, rates = np.atleast_2d(q), np.atleast_2d(v)
        ((_, off), (_, fast)), _, ways = self._left(places, rates)
        off_place = np.asarray(off.any(axis=1) | (ways < 0).any(axis=1))
        for k in np.flatnonzero(off_place | fast.any(axis=1)).tolist()[:1]:
            own, where = self.member(k), "" if q.ndim == 1 else f" in state {k}"
            raise InputError(
                f"{'q0' if off_place[k] else 'v0'}: {self.dyn.model.name} is open there{where}: "
                f"{own.still_open(places[k], rates[k])}; project(q0, v0) returns the nearest consistent state; "
                f"{closed_near(own.dyn, places[k])}"
            )

    def member(self, k: int) -> Manifold:
        """Return the states of one sample of a batch of parameters; the same where there is none."""
        if self.dyn._samples is None:
            return self
        one = self.dyn._of_samples([k])
        return Manifold(one.at(**dict(zip(one.model.parameters, one._parameter_values[0].tolist(), strict=True))))

    def pulled(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the consistent state beside one that has drifted a little, or of each of a batch.

        The formula is that of `mbkit.derivation.steps.onto_constraints`. A state that is far from the constraints or
        not finite comes back as it is or as NaN.
        """
        q1, v1, moved = q, v, np.zeros(v.shape)
        for _ in range(_ROUNDS):
            q1, v1, moved, far = (x[..., 0] for x in self.call("projection", q, v1, moved))
            if not far.any():
                break
        # At a singular pose rounding would move it by any amount.
        if not np.abs(v1 - v).max(initial=0.0) <= CONSISTENT * np.abs(v).max(initial=0.0):
            stays = self.at_pose(q)[..., None]
            q1, v1 = np.where(stays, q, q1), np.where(stays, v, v1)
        return q1, v1

    def dependence(self, q: Array) -> Array:
        """Return how nearly rows of J depend on each other, of one state or each of a batch."""
        return self.call("dependence", q)[0][..., 0, 0]

    def nears_pose(self, t: float, q: Array, h: float, end: Array) -> NDArray[np.bool_]:
        """Return whether a step, or each of a batch, would meet a singular pose within a few more of its kind.

        The states at its start, end and middle alone decide, so that one step is the same wherever it is taken; the
        start and the end may be as far from a pose between them.
        """
        model = self.dyn.model
        middle = model.integrate(q, 0.5 * model.difference(q, end))
        places = ((0.0, q), (0.5, middle), (1.0, end))
        near: NDArray[np.bool_] = nears_singular(*(self.at(t + c * h).dependence(x) for c, x in places))
        return near

    def at_pose(self, q: Array) -> NDArray[np.bool_]:
        """Return whether a configuration, or each of a batch, is a singular pose up to rounding."""
        sizes = singular_values(self.jacobian(q))
        return np.asarray(sizes[..., -1] <= AT_POSE * sizes[..., 0])

    def project(self, q: Array, v: Array, held: Collection[int] = ()) -> tuple[Array, Array]:
        """Return the nearest consistent state, in the metric of the mass matrix; `InputError` if none is consistent.

        The velocities `held`, and what they move, stay as they are.
        """
        free, x, model = self._free(held), self.restored(q, held), self.dyn.model
        M = self.terms(q, v)[3][np.ix_(free, free)]
        # Stationary: M (x - q) + Jᵀ μ = 0 with f(x) = 0.
        last, length, step = np.inf, 1.0, np.zeros(model.nv)
        for _ in range(_MOST):
            f, J, *_ = self.terms(x, v)
            step[free] = under_rows(M, J[: len(f), free], M @ model.difference(x, q)[free], -f)[0]
            size = float(np.linalg.norm(step))
            if size <= ROUNDING * (1 + float(np.linalg.norm(x))):
                break
            # Where the constraints bend strongly, whole steps go to and fro about the foot.
            length = min(1.0, 1.1 * length) if size < last else 0.5 * length
            x, last = model.integrate(x, length * step), size
        x = self.restored(x, held)
        _, J, rate, M = self.terms(x, v)
        v = v + least_change(M, J, -rate, held)
        if not held and (still := self.still_open(x, v)):
            raise InputError(f"v: {model.name}: no velocity satisfies all constraints: open stay {still}")
        return x, v

    def apartness(self, q: Array) -> float:
        """Return the smallest singular value of J with rows of unit size over the largest one."""
        return float(np.divide(*singular_values(unit_rows(self.jacobian(q)))[[-1, 0]]))

    def acceleration(self, q: Array, v: Array, a: Array, held: Collection[int] = ()) -> Array:
        """Return the nearest a with J a + γ = 0, in the metric of the mass matrix."""
        J, _, gamma, M, _ = self.call("embedded", q, v)
        return np.asarray(a + least_change(M, J, -gamma[:, 0] - J @ a, held))

    def _free(self, held: Collection[int]) -> list[int]:
        return [k for k in range(self.dyn.model.nv) if k not in held]

    def require_followed(self, q: Array, v: Array, held: Collection[int], names: str) -> None:
        """Refuse held coordinates that break the constraints at a state, or leave the others undetermined there."""
        model = self.dyn.model
        if still := self.still_open(q, v):
            raise InputError(
                f"hold: {names} held, the constraints of {model.name} cannot be met: open stay {still}; hold fewer "
                "coordinates, or other values"
            )
        free, J = self._free(held), self.jacobian(q)
        J = (J / np.linalg.norm(J, axis=1, keepdims=True))[:, free]
        # A row of held coordinates alone, such as a drive's, says nothing of the others at any pose.
        slopes = [np.abs(self.jacobian(x)[:, free]).max(axis=1, initial=0.0) for x in _around(model, q)]
        moving = np.flatnonzero(np.max(slopes, axis=0) > 0)
        if len(lost := _lost(J[moving])):
            raise InputError(
                f"hold: {names} held, the other coordinates of {model.name} are not determined at this pose: "
                f"{_named(moving[lost], self)} has no slope or depends on other rows; hold other coordinates"
            )

    def closest(self, q: Array, held: Collection[int] = ()) -> tuple[Array, float, Array]:
        """Return where the search for f = 0 from q ends, the size of what is left in terms of the rows, and f there."""

        def rows(x: Array) -> tuple[Array, Array]:
            f, J = self.call("constraint_rows", x)
            return f[:, 0], J[: len(f)]

        M = self.terms(q, np.zeros(self.dyn.model.nv))[3]
        return closest_configuration(self.dyn.model, q, M, rows, held)

    def restored(self, q: Array, held: Collection[int] = ()) -> Array:
        """Return a configuration with f = 0, by steps that are the least in the mass matrix's metric."""
        x, size, f = self.closest(q, held)
        if not size <= CONSISTENT * (1 + float(np.abs(x).max())):
            if not held:
                refuse_unreachable(self.dyn, q)
            raise InputError(
                f"q: {self.dyn.model.name} has no consistent state near it; f = {_residuals(f)} is the least reached"
            )
        if still := self.still_open(x):
            raise InputError(
                f"q: {self.dyn.model.name}: near it the other rows close where these are open: {still}; "
                "start nearer to a closed configuration"
            )
        return x


def _residuals(x: Array) -> str:
    return f"[{', '.join(f'{e:.3g}' for e in x)}]"


def manifold_of(dyn: Dynamics) -> Manifold:
    """Return the consistent states of dynamics; those of another engine by the own derivation."""
    if not dyn.model.constrained:
        ROWS.admit(dyn.model, "consistent states: not known of")
    if isinstance(dyn, LagrangianDynamics):
        return Manifold(dyn)
    # Deriving costs more than most runs: once for each engine's object.
    if _TWIN not in vars(dyn):
        vars(dyn)[_TWIN] = LagrangianDynamics(dyn.model)
    return Manifold(vars(dyn)[_TWIN])


def projected(dyn: Dynamics, q: Array, v: Array, hold: Sequence[str] = ()) -> tuple[Array, Array]:
    """Return the nearest consistent state; `InputError` where no state is, or where the constraints are redundant."""
    manifold, (coordinates, held) = manifold_of(dyn), held_parts(dyn.model, hold)
    names = ", ".join(hold)
    try:
        state = manifold.project(q, v, held)
    except InputError as error:
        refuse_unreachable(manifold.dyn, q)
        if not held:
            raise
        raise InputError(
            f"hold: with {names} held, {str(error).removeprefix('q: ')}; hold fewer coordinates, or other values"
        ) from None
    if held:
        # The exponential of zero rounds a quaternion.
        state = state[0].copy(), state[1]
        state[0][coordinates] = q[coordinates]
        manifold.require_followed(*state, held, names)
    require_independent(manifold.dyn, state[0], everywhere=True)
    return state


def accelerated(dyn: Dynamics, q: Array, v: Array, a: Array, hold: Sequence[str] = ()) -> Array:
    """Return the nearest consistent acceleration; an `InputError` where held numbers break the constraints."""
    manifold, (_, held) = manifold_of(dyn), held_parts(dyn.model, hold)
    out = manifold.acceleration(q, v, a, held)
    J, _, gamma, *_ = manifold.call("embedded", q, v)
    left = J @ out + gamma[:, 0]
    most = CONSISTENT * np.maximum(np.abs(J).sum(axis=1), 1.0) * max(1.0, float(np.abs(out).max(initial=0.0)))
    if len(bad := np.flatnonzero(~(np.abs(left) <= most))):
        raise InputError(
            f"hold: {', '.join(hold) or 'nothing'} held, J a + γ = 0 of {dyn.model.name} cannot be met: "
            f"{_residuals(left[bad])} is left of {_named(bad, manifold)}; hold fewer coordinates, or other values"
        )
    return out


def held_parts(model: Model, hold: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the entries of q and of v of coordinates and joints by name."""
    if isinstance(hold, str) or not isinstance(hold, Sequence) or not all(isinstance(x, str) for x in hold):
        raise InputError(f"hold: expected a list of names of coordinates or joints, got {hold!r}")
    coordinates: set[int] = set()
    velocities: set[int] = set()
    for name in hold:
        if name in model.joint_names:
            coordinates |= {*range(model.nq)[model.layout.q[name]]}
            velocities |= {*range(model.nv)[model.layout.v[name]]}
            continue
        if name not in model.coordinate_names:
            raise UnknownNameError("coordinate", name, (*model.coordinate_names, *model.joint_names))
        k = model.coordinate_names.index(name)
        joint = next(j for j in model.independent_joints if k in range(model.nq)[model.layout.q[j.name]])
        if not joint.type.coordinate_velocities:
            raise InputError(
                f"hold: {name!r} is a coordinate of {joint.name!r}, whose velocities are not the rates of its "
                f"coordinates; hold the joint {joint.name!r}"
            )
        coordinates.add(k)
        velocities.add(model.layout.v[joint.name].start + k - model.layout.q[joint.name].start)
    return sorted(coordinates), sorted(velocities)


def names_of(dyn: Dynamics, *, moving: bool = False) -> tuple[str, ...]:
    """Return the names of all rows, redundant ones among them, or of those that hold velocities alone."""
    every = manifold_of(dyn).equations.all_constraints
    names: tuple[str, ...] = every.names[every.positions if moving else 0 :]
    return names


@dataclass(frozen=True)
class Mobility:
    """How many degrees of freedom constraints leave, and which of their rows are redundant.

    Attributes
    ----------
    model : str
    degrees_of_freedom : int
        Velocities less the rank of J: the dimension of the velocities that a configuration allows.
    rows, redundant : tuple of str
        Names of all rows, and of those that follow from the others: with any, multipliers are not unique.
    configuration_freedoms : int
        Velocities less the rank of the rows that hold positions: the dimension of the configurations. With rows that
        hold velocities alone it is the larger one: a car moves sideways, if not at once.
    gap : tuple of float
        The smallest singular value that counts for the rank, of J with rows of unit size, and the largest that does
        not, 0 without one. Accelerations keep their digits less those of the first.
    """

    model: str
    degrees_of_freedom: int
    rows: tuple[str, ...]
    redundant: tuple[str, ...]
    configuration_freedoms: int
    gap: tuple[float, float] = (1.0, 0.0)

    def __str__(self) -> str:
        n = len(self.redundant)
        which = f"{n or 'none'} {'are' if n > 1 else 'is'} redundant{': ' if n else ''}{', '.join(self.redundant)}"
        which += "; multipliers are not unique" if n else ""
        freedoms = f"{self.degrees_of_freedom}"
        if self.configuration_freedoms != self.degrees_of_freedom:
            freedoms += f" of velocity and {self.configuration_freedoms} of configuration"
        rows = f"{len(self.rows)} row{'s' if len(self.rows) != 1 else ''}"
        return f"{self.model}: degrees of freedom {freedoms}, of {rows} {which}"


def mobility(dyn: Dynamics, q: Array | None) -> Mobility:
    """Return the mobility at a configuration, or at some one where the loops are closed."""
    model = dyn.model
    if not model.constrained:
        return Mobility(model.name, model.nv, (), (), model.nv)
    manifold = manifold_of(dyn)
    names, equations = manifold.equations.all_constraints.names, manifold.equations
    held = equations.all_constraints.positions
    if q is None:
        q = equations.row_choice.closed
        if q is None and model.has_bodies:
            # No rank is that of a mechanism whose loops never close.
            refuse_unreachable(dyn)
        q = manifold.dyn.model.neutral() if q is None else q
        independent: Collection[int] = equations.row_choice.independent
    else:
        if still := manifold.still_open(q):
            raise InputError(f"q: {model.name} is open there: {still}; {closed_near(manifold.dyn, q)}")
        # The digits that rounding left out of a closed pose tell dependent rows from nearly dependent ones.
        q = manifold.restored(q)
        J, chosen = manifold.all_rows(q), equations.row_choice.independent
        independent, _ = independent_rows(J, held)
        if len(chosen) == len(independent) == len(independent_rows(J[list(chosen)])[0]):
            independent = chosen
    redundant = tuple(name for i, name in enumerate(names) if i not in independent)
    freedoms = model.nv - sum(i < held for i in independent)
    rank, sizes = len(independent), np.append(singular_values(unit_rows(manifold.all_rows(q))), 0.0)
    gap = (float(sizes[rank - 1]) if rank else 1.0, float(sizes[rank]))
    return Mobility(model.name, model.nv - rank, names, redundant, freedoms, gap)


# Independence

#: Slope of a row, relative to its size beside the pose, below which it is one of a square that is nearly zero: a
#: consistent state leaves some 20 `CONSISTENT` of it.
_FLAT: Final = 1e-6
#: A slope that is rounding alone.
_ROUNDED: Final = 1e-14


def require_few(manifold: Manifold) -> None:
    """Refuse more constraints than coordinates."""
    rows, n = len(manifold.names), manifold.dyn.model.nv
    if rows > n:
        raise InputError(f"constraints: {rows} of them for {n} coordinates; at most {n} can be independent")


def require_independent(dyn: Dynamics, q: Array, *, everywhere: bool = False) -> None:
    """Refuse constraints whose Jacobian has dependent rows around q (InputError) or at q alone (NumericalError).

    With `everywhere` a singular pose is allowed: only a set that is redundant around q is refused.
    """
    manifold = manifold_of(dyn)
    require_few(manifold)
    around = _around(dyn.model, q)
    sizes = np.max([np.linalg.norm(manifold.jacobian(x), axis=1) for x in around], axis=0)
    scale = np.where(sizes > _ROUNDED, sizes, 1.0)[:, None]

    def flat(J: Array) -> NDArray[np.bool_]:
        return np.asarray((sizes > _ROUNDED) & (np.linalg.norm(J, axis=1) < _FLAT))

    J = manifold.jacobian(q) / scale
    if not len(_lost(J)) and not flat(J).any():
        return
    closed = [manifold.jacobian(x) / scale for x, size, _ in map(manifold.closest, around) if size < CONSISTENT]
    if not closed:
        refuse_unreachable(dyn, q)
    elif len(rows := np.flatnonzero(np.all([flat(x) for x in closed], axis=0))):
        raise InputError(
            f"constraints: {_named(rows, manifold)} has no slope where it holds, here and at the poses around, so "
            "that no force can hold it; write a square as f = 0 instead of f**2 = 0, or start from another pose"
        )
    elif len(rows := _lost(best := min(closed, key=lambda x: len(_lost(x))))):
        others = needed(best, np.setdiff1d(np.arange(len(J)), rows), rows)
        raise InputError(
            f"constraints: the set is redundant, here and at poses around; {_named(rows, manifold)} "
            f"{f'follows from {_named(others, manifold)}' if len(others) else 'holds by itself'}; leave it out, as its "
            "multiplier is not determined, or start from another pose"
        )
    if len(_lost(J)) and not everywhere:
        raise singular_pose("q", dyn.model.name, manifold.names, J)


def _lost(J: Array) -> NDArray[np.intp]:
    """Return the rows that the others imply."""
    return np.setdiff1d(np.arange(len(J)), pivoted(J)[0])


def _around(model: Model, q: Array) -> list[Array]:
    """Return a pose, and some beside it."""
    rng = np.random.default_rng(0)
    return [q, *(model.integrate(q, ASIDE * rng.standard_normal(model.nv)) for _ in range(BESIDE))]


def closed_near(dyn: Dynamics, q: Array) -> str:
    """Return the nearest closed configuration found, for a message; an `InputError` where `refuse_unreachable` does."""
    return f"closed is q = {np.array2string(refuse_unreachable(dyn, q), precision=8, separator=', ', threshold=20)}"


def refuse_unreachable(dyn: Dynamics, q: Array | None = None) -> Array:
    """Refuse constraints that no configuration satisfies, or that are redundant where one does (InputError).

    The search starts at q, then at random configurations; the first closed one is returned.
    """
    states, model = manifold_of(dyn), dyn.model
    tried = [*([] if q is None else [q]), *starts(model, np.random.default_rng(0))]
    least, left = np.inf, np.zeros(states.equations.constraints.positions)
    for start in tried:
        end, size, f = states.closest(start)
        still = states.still_open(end) if size < CONSISTENT else ""
        if size < CONSISTENT and not still:
            require_independent(dyn, end, everywhere=True)
            return end
        if size < least:
            least, left = size, f
    if least < CONSISTENT:
        raise InputError(
            f"q: {model.name}: from {len(tried)} starts its loops close only with something open: "
            f"{still or 'rows that are redundant elsewhere'}; start nearer to a closed configuration"
        )
    against = np.flatnonzero(np.abs(left) > 1e-6 * np.abs(left).max())
    raise InputError(
        f"constraints: no configuration satisfies them all, from {len(tried)} starts; it seems that "
        f"{_named(against, states)} {'contradict each other' if len(against) > 1 else 'cannot hold'}: the least "
        f"that is left of them is {_residuals(left[against])}"
    )


def needed(J: Array, kept: NDArray[np.intp], rows: Sequence[int] | NDArray[np.intp]) -> NDArray[np.intp]:
    """Return which of the kept rows take part in the combinations of them that are nearest to others."""
    J = unit_rows(J)
    weights = np.linalg.lstsq(J[kept].T, J[rows].T, rcond=None)[0]
    return np.sort(kept[np.abs(weights).max(axis=1) > 1e-6])


def _named(which: Iterable[int], manifold: Manifold) -> str:
    return ", ".join(manifold.names[k] for k in which)
