"""Lock joints: the reduced model has the rows and columns of M that are left, and the bias with these velocities zero.

A locked joint is a fixed one with the placement that its coordinates give, so that bodies, frames and all that hangs on
them stay. Springs at locked joints alone stay as springs between bodies that these hold together: they push nothing,
and keep their energy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import CONSISTENT, Array, batch_of, finite_array, hint_at_degrees, rows, shown
from mbkit.errors import InputError, UnknownNameError
from mbkit.model.builder import shape_of
from mbkit.model.description import body_poses, expect_name
from mbkit.model.elements.forces import (
    RATE,
    Force,
    FrameForce,
    GravityCompensation,
    JointElement,
    JointForce,
    coordinate_arguments,
)
from mbkit.model.elements.formula import Formula, Operation
from mbkit.model.elements.motion_laws import motions_of
from mbkit.model.elements.paths import OF_BODIES, Path
from mbkit.model.elements.references import called, entries, moved_by, with_fields
from mbkit.model.joint_types import FIXED
from mbkit.model.loops import LOOP_ROWS, LoopEnds
from mbkit.model.model import Model
from mbkit.model.parameters import Binding, Expression, nominal
from mbkit.model.parts import Coupler, Joint, JointCoupling, Loop, NoSlip, PointSpring

#: The energies, losses, forces and rows of what moves no more are written on what still does.
LOCK: Final = Path("lock", "lock: not known of", OF_BODIES)

#: Coordinates of the locked joints by name, of those that follow too.
Values = dict[str, Array]


def lock(model: Model, joints: Mapping[str, Any] | Sequence[str], q: ArrayLike | None) -> Model:
    """Return a model with joints fixed, as `Model.lock` says."""
    LOCK.admit(model)
    given = _given(model, joints, q)
    values = _with_followers(model, given)
    _require_limits(model, values)
    _refuse_driven(model, values)
    bindings = list(model.bindings)
    parts: dict[str, Any] = {"joints": tuple(_fixed(j, values, bindings) for j in model.joints)}
    parts["springs"] = (*model.springs, *_still_springs(model, parts["joints"], values, bindings))
    parts["couplers"] = tuple(y for x in model.couplers if (y := _left(x, values, bindings)) is not None)
    couplings = [_shortened(x, values, bindings) for x in model.couplings]
    parts["couplings"] = tuple(x for x in couplings if x is not None)
    parts["forces"] = tuple(x for force in model.forces for x in _acting(model, force, values))
    there = {(x.section, x.name) for own in parts.values() for x in own}
    gone = [x for kind in parts for x in getattr(model, kind) if (kind, x.name) not in there]
    notes = [f"{called(x.section)} {x.name!r} acts on locked joints alone, and is gone" for x in gone]
    followers = ", ".join(name for name in values if name not in given)
    listed = ", ".join(f"{name} at {_short(x)}" for name, x in given.items())
    notes.insert(0, f"locked: {listed}" + (f"; with them {followers}" if followers else ""))
    pairs = [(model.joint(name), x) for name, x in values.items()]
    out = replace(
        model,
        **parts,
        bindings=tuple(b for b in bindings if b.where not in parts or (b.where, b.part) in there),
        source="",
        drawn_from=model.sources,
        locked=(*model.locked, *((j.name, tuple(x.tolist()), j.type.nv) for j, x in pairs if not j.mimic)),
    )
    closed, more = _closed_for_good(out)
    kept = tuple(x for x in out.loops if x not in closed)
    return replace(out, loops=kept, notes=(*out.notes, *notes, *more))


def _short(x: Array) -> str:
    return f"{x[0]:g}" if len(x) == 1 else str(np.round(x, 6).tolist())


def _given(model: Model, joints: Mapping[str, Any] | Sequence[str], q: ArrayLike | None) -> Values:
    """Return the coordinates of the joints that the caller locks."""
    if isinstance(joints, (str, bytes)) or not isinstance(joints, (Mapping, Sequence)) or not len(joints):
        raise InputError(f"joints: expected a mapping from names to values or a list of names, got {shown(joints)}")
    if isinstance(joints, Mapping) and q is not None:
        raise InputError("q: values stand in the mapping; give names alone with a whole configuration")
    for name in joints:
        expect_name("joint", name)
        if name not in {j.name for j in model.joints}:
            raise UnknownNameError("joint", name, model.joint_names)
        joint = model.joint(name)
        if joint.mimic:
            raise InputError(f"joints: {name!r} follows {joint.mimic.joint!r}; lock that one, and it is locked too")
        if not joint.type.nv:
            raise InputError(f"joints: {name!r} is fixed already")
    if isinstance(joints, Mapping):
        given = {name: _coordinates(model.joint(name), x) for name, x in joints.items()}
        for name, x in given.items():
            hint_at_degrees(f"joints: {name!r}", *x[list(model.joint(name).type.angular)])
    else:
        whole = model.neutral() if q is None else model.check_q(q)
        if whole.ndim > 1:
            raise InputError(f"q: expected one configuration, got shape {whole.shape}")
        given = {name: whole[model.layout.q[name]] for name in joints}
    return given


def _require_limits(model: Model, values: Values) -> None:
    for name, x in values.items():
        joint = model.joint(name)
        room = CONSISTENT * np.maximum(1.0, np.abs(x))
        if (x < joint.lower - room).any() or (x > joint.upper + room).any():
            raise InputError(
                f"joints: {name!r} at {_short(x)} is beyond its limits, {_short(joint.lower)} to {_short(joint.upper)}"
            )


def _coordinates(joint: Joint, value: Any) -> Array:
    item, n = f"joints: {joint.name!r}", joint.type.nq
    if n == 1 and shape_of(value) == ():
        value = [value]
    x = finite_array(item, value, (n,))
    k = joint.type.quaternion
    if k is not None and abs(float(np.linalg.norm(x[k:])) - 1.0) > CONSISTENT:
        raise InputError(f"{item}: expected a quaternion x, y, z, w of length 1, got {x[k:].tolist()}")
    return x


def _with_followers(model: Model, given: Values) -> Values:
    """Return the locked coordinates with those that mimic joints and couplers follow from them."""
    values = dict(given)
    ties = list(model.couplers)
    while True:
        tied = next((c for c in ties if sum(name not in values for name in (c.joint, *c.leaders)) < 2), None)
        if tied is None:
            break
        ties.remove(tied)
        item = f"joints: coupler {tied.name!r}"
        _require_numbers(model, tied, item)
        name = next((x for x in tied.leaders if x not in values), tied.joint)
        # Where the leader that is sought has no part in it.
        value, slopes = tied.follow([values[x][0] if x in values else 0.0 for x in tied.leaders])
        if name != tied.joint:
            slope = slopes[tied.leaders.index(name)]
            if tied.curve.any() or not slope:
                raise InputError(f"{item} does not tell {name!r} from {tied.joint!r}; lock {name!r} instead")
            value = (values[tied.joint][0] - value) / slope
        follows = np.array([value])
        there = values.setdefault(name, follows)
        if abs(there[0] - follows[0]) > CONSISTENT * max(1.0, abs(follows[0])):
            raise InputError(f"{item} asks for {name!r} at {follows[0]:g}, and it is locked at {there[0]:g}")
    for joint in model.joints:
        if joint.mimic and joint.mimic.joint in values:
            values[joint.name] = joint.mimic.ratio * values[joint.mimic.joint] + joint.mimic.offset
    return values


def _require_numbers(model: Model, part: Any, item: str) -> None:
    """Refuse a part with parameters, on whose values locked places or a closed loop would depend (InputError)."""
    if free := [b for b in model.bindings if (b.where, b.part) == (part.section, part.name)]:
        raise InputError(
            f"{item} has a parameter, {free[0].expression}, on which the locked places would depend; give it with "
            "with_parameters first"
        )


def _refuse_driven(model: Model, values: Values) -> None:
    if driven := [x for x in motions_of(model) if x.joint in values]:
        raise InputError(f"joints: {driven[0].joint!r} is moved in time; without({driven[0].section!r}) removes that")
    for b in model.bindings:
        if b.where == "joints" and b.part in values and b.field in ("pitch", "ratio", "offset"):
            raise InputError(
                f"joints: {b.part!r} has a parameter as its {b.field}, on which its locked place would depend; give it "
                "with with_parameters first"
            )


def _fixed(joint: Joint, values: Values, bindings: list[Binding]) -> Joint:
    if joint.name not in values:
        return joint
    R, p = (np.array(x, dtype=float) for x in joint.type.placement(np, joint, list(values[joint.name])))
    place = moved_by(np.eye(3), joint.rotation @ p, entries(joint, "translation", bindings))
    bindings[:] = [b for b in bindings if (b.where, b.part) != ("joints", joint.name)]
    still = Joint._of(joint.name, FIXED.name, joint.parent, joint.child, joint.rotation @ R, joint.translation)
    return with_fields(still, {"translation": place}, bindings)  # type: ignore[no-any-return]  # a Joint


def _still_springs(
    model: Model, joints: Sequence[Joint], values: Values, bindings: list[Binding]
) -> Iterator[PointSpring]:
    """Yield springs with the energies of those at locked joints alone, between bodies that these hold together."""
    held = list[tuple[str, Any, Any]]()
    for joint in (x for x in model.joints if x.name in values):
        stiffness, rest = (entries(joint, name, model.bindings) for name in ("stiffness", "rest"))
        # Stiff joints have a coordinate for each velocity.
        held += [(joint.name, k, float(x) - r) for k, x, r in zip(stiffness, values[joint.name], rest, strict=False)]
    for part in (x for x in model.couplings if {*x.joints} <= {*values}):
        fields = ("factors", "stiffness", "rest_length")
        factors, stiffness, stretch = (entries(part, name, model.bindings) for name in fields)
        for name, factor in zip(part.joints, factors, strict=True):
            stretch = stretch - factor * float(values[name][0])
        held.append((part.joints[0], stiffness, stretch))
    fixed = {j.name: j for j in joints}
    for k, (name, stiffness, stretch) in enumerate(held):
        if isinstance(stiffness, Expression) or isinstance(stretch, Expression) or stiffness * stretch:
            joint, none = fixed[name], np.zeros(3)
            spring = PointSpring(f"spring {k} of {name}", joint.parent, none, joint.child, none, 0.0, 0.0, 0.0)
            ends = entries(joint, "translation", bindings), np.array([stretch, 0.0, 0.0], dtype=object)
            numbers = {"point_a": ends[0], "point_b": ends[1], "stiffness": stiffness}
            yield with_fields(spring, numbers, bindings)


def _shortened(coupling: JointCoupling, values: Values, bindings: list[Binding]) -> JointCoupling | None:
    """Return a coupling with the locked part of its length in its rest length; None where nothing is left."""
    moving = [k for k, name in enumerate(coupling.joints) if name not in values]
    if len(moving) == len(coupling.joints):
        return coupling
    if not moving:
        return None
    factors = entries(coupling, "factors", bindings)
    rest = entries(coupling, "rest_length", bindings)
    for k, name in enumerate(coupling.joints):
        if name in values and values[name][0]:
            rest = rest - factors[k] * float(values[name][0])
    fields = {"factors": factors[moving], "rest_length": rest}
    shorter = replace(coupling, joints=tuple(coupling.joints[k] for k in moving), factors=np.ones(len(moving)))
    return with_fields(shorter, fields, bindings)  # type: ignore[no-any-return]  # a coupling


def _left(coupler: Coupler, values: Values, bindings: list[Binding]) -> Coupler | None:
    """Return a coupler with the locked part of its sum in its offset; None where nothing is left."""
    moving = [x for x in coupler.leaders if x not in values]
    if not moving or (len(moving) == len(coupler.leaders) and coupler.joint not in values):
        return coupler if moving else None
    ratios = dict(zip(coupler.leaders, np.atleast_1d(entries(coupler, "ratio", bindings)), strict=True))
    offset, joint = entries(coupler, "offset", bindings), coupler.joint
    for name in coupler.leaders:
        if name in values:
            offset = offset + ratios[name] * float(values[name][0])
    if joint in values:
        # The largest term of a locked sum follows the others.
        joint = max(moving, key=lambda x: abs(nominal(ratios[x])))
        if not nominal(ratios[joint]):
            raise InputError(f"joints: coupler {coupler.name!r} does not tell {joint!r} from {coupler.joint!r}")
        moving.remove(joint)
        offset = (float(values[coupler.joint][0]) - offset) / ratios[joint]
        ratios = {x: -ratios[x] / ratios[joint] for x in moving}
    left = np.array([ratios[x] for x in moving])
    fields = {"ratio": left if len(left) > 1 else left[0], "offset": offset}
    shorter = replace(coupler, joint=joint, leader=tuple(moving), ratio=1.0)
    return with_fields(shorter, fields, bindings)  # type: ignore[no-any-return]  # a coupler


def _acting(model: Model, force: Force, values: Values) -> Iterator[Force]:
    """Yield a force with numbers for locked coordinates, unless it acts on these alone."""
    if isinstance(force, GravityCompensation):
        yield replace(force, without=tuple(name for name in force.without if name not in values))
        return
    own = {*force.own(model), *force.symbols}
    others = coordinate_arguments(model)
    numbers = _locked_arguments(model, values)
    numbers = {name: x for name, x in numbers.items() if name not in own}
    formulas = {n: _filled(x, numbers) for n in ("formula", "potential") if (x := getattr(force, n)) is not None}
    if isinstance(force, JointElement) and not {*force.joints}.isdisjoint(values):
        left = [name for name in force.joints if name not in values]
        more = [x for x in force.potential.arguments if x in others and x not in own] if force.potential else []
        if more or len(left) > 1:
            what = f"the potential of force {force.name!r} at {force.joints[0]!r}" if more else str(force)
            raise InputError(f"joints: {what} acts on {(more or left)[0]!r} too; remove it or write it as a force")
        yield from _on_one(model, force, left, values, formulas)
        return
    changed = {n: x for n, x in formulas.items() if x is not getattr(force, n)}
    yield replace(force, **changed)  # type: ignore[type-var]  # every force is a dataclass


def _on_one(
    model: Model, force: JointElement, left: list[str], values: Values, formulas: Mapping[str, Formula]
) -> Iterator[Force]:
    """Yield what is left of an element on joints: a force on the one that moves, or the energy where none does."""
    q, v = iter(force.positions(model)), iter(force.velocities(model))
    still, own, outputs = dict[str, float](), list[str](), list[int]()
    for joint in map(model.joint, force.joints):
        at, rates = [next(q) for _ in range(joint.type.nq)], [next(v) for _ in range(joint.type.nv)]
        if joint.name in values:
            still |= dict(zip(at, values[joint.name].tolist(), strict=True)) | dict.fromkeys(rates, 0.0)
        else:
            own, outputs = [*at, *rates], [force.velocities(model).index(x) for x in rates]
    filled = {n: _filled(x, still) for n, x in formulas.items()}
    if left:
        alone = JointForce(force.name, left[0], None, None, force.symbols, force.numbers)
        new = dict(zip(own, alone.own(model), strict=True))
        for n, x in filled.items():
            kept = tuple(x.outputs[k] for k in outputs) if n == "formula" else x.outputs
            filled[n] = Formula(tuple(new.get(a, a) for a in x.arguments), x.operations, kept)
        yield replace(alone, formula=filled.get("formula"), potential=filled.get("potential"))
    elif "potential" in filled:
        # A constant energy, on a body that it does not push.
        body = model.joint(force.joints[0]).child
        yield FrameForce(force.name, body, "local", None, filled["potential"], force.symbols, force.numbers)


def _locked_arguments(model: Model, values: Values) -> dict[str, float]:
    out: dict[str, float] = {}
    for name, x in values.items():
        # A joint that mimics has no names of its own.
        out |= dict(zip(model.coordinate_names[model.layout.q[name]], x.tolist(), strict=False))
        out |= {rate + RATE: 0.0 for rate in model.velocity_names[model.layout.v[name]]}
    return out


def _filled(formula: Formula, numbers: Mapping[str, float]) -> Formula:
    """Return a formula with numbers in the place of some arguments."""
    kept = tuple(name for name in formula.arguments if name not in numbers)
    if len(kept) == len(formula.arguments):
        return formula
    operations: list[Operation] = []
    for name, operands, value in formula.operations:
        argument = formula.arguments[operands[0]] if name == "input" else ""
        if name == "input" and argument in numbers:
            operations.append(("const", (), numbers[argument]))
        else:
            operations.append((name, (kept.index(argument),) if name == "input" else operands, value))
    return Formula(kept, tuple(operations), formula.outputs)


def _closed_for_good(model: Model) -> tuple[list[Loop], list[str]]:
    """Return the loops whose ends nothing moves any more, and what to say of them; `InputError` where one is open."""
    closed, notes = [], []
    moves = {j.name for j in model.joints if j.type.nv}
    for loop in model.loops:
        if (model.moving(loop.body_a) ^ model.moving(loop.body_b)) & moves:
            continue
        size = max(map(abs, _residual(model, loop)))
        if not size <= CONSISTENT:
            raise InputError(
                f"joints: locked there, loop {loop.name!r} is open by {size:.3g} and nothing moves it; take the values "
                "of a state that project returns"
            )
        _require_numbers(model, loop, f"joints: loop {loop.name!r}, which nothing moves then,")
        closed.append(loop)
        notes.append(f"loop {loop.name!r} is closed by the locked joints, and is gone")
    for part in (x for x in model.constraints if isinstance(x, NoSlip)):
        if not (model.moving(part.body_a) ^ model.moving(part.body_b)) & moves:
            raise InputError(f"joints: with them locked, nothing moves no slip {part.name!r}; remove it, or lock fewer")
    return closed, notes


def _residual(model: Model, loop: Loop) -> list[float]:
    poses = body_poses(model, model.neutral()[None])
    carrier = poses[model.carrier(loop)][0][0]
    ends = []
    for body, R, p in (
        (loop.body_a, loop.rotation_a, loop.translation_a),
        (loop.body_b, loop.rotation_b, loop.translation_b),
    ):
        R_WB, p_WB = poses[body][0][0], poses[body][1][0]
        ends.append((carrier.T @ (p_WB + R_WB @ p), (carrier.T @ R_WB @ R).T.tolist()))
    (p_a, a), (p_b, b) = ends
    return [float(x) for x in LOOP_ROWS[loop.kind][1](LoopEnds((p_a - p_b).tolist(), a, b, loop.length))]


# States of both


def _before(model: Model) -> tuple[Array, Any, Any]:
    """Return the locked coordinates, and where the numbers of joints that still move are in q and v of before."""
    if not model.locked:
        raise InputError(f"{model.name} has no locked joints; lock makes a model that has")
    sizes = {j.name: (j.type.nq, j.type.nv) for j in model.independent_joints}
    locked = {name: x for name, x, _ in model.locked}
    sizes |= {name: (len(x), nv) for name, x, nv in model.locked}
    names = [j.name for j in model.joints if j.name in sizes]
    moves = [name not in locked for name in names]
    of_q, of_v = (np.repeat(moves, [sizes[name][k] for name in names]) for k in (0, 1))
    return np.array([x for name in names for x in locked.get(name, ())]), of_q, of_v


def full_state(model: Model, q: ArrayLike, v: ArrayLike | None) -> tuple[Array, Array]:
    """Return q and v of the model that was locked, as `Model.full_state` says."""
    locked, of_q, of_v = _before(model)
    q, v = model.check_q(q), model.check_v(np.zeros(model.nv) if v is None else v)
    batch_of(q=q, v=v)
    lead = np.broadcast_shapes(q.shape[:-1], v.shape[:-1])
    whole_q, whole_v = (np.zeros((*lead, len(x))) for x in (of_q, of_v))
    whole_q[..., of_q], whole_q[..., ~of_q], whole_v[..., of_v] = q, locked, v
    return whole_q, whole_v


def reduced_state(model: Model, q: ArrayLike, v: ArrayLike | None) -> tuple[Array, Array]:
    """Return q and v of the locked model, as `Model.reduced_state` says."""
    _, of_q, of_v = _before(model)
    q = rows("q", q, len(of_q), f"{model.name} before lock", "nq")
    v = rows("v", np.zeros(len(of_v)) if v is None else v, len(of_v), f"{model.name} before lock", "nv")
    batch_of(q=q, v=v)
    return model.check_q(q[..., of_q]), model.check_v(v[..., of_v])
