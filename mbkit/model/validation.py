"""Checks of a description: names, tree, mimic joints, inertias, and joints that move no mass."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from mbkit._check import EPS, PRINTED, Array, by_key
from mbkit.errors import MAX_LISTED, InputError, ModelError, Suggestions, did_you_mean
from mbkit.model import manifold
from mbkit.model.description import Description
from mbkit.model.elements.forces import force_faults
from mbkit.model.elements.motion_laws import motion_faults
from mbkit.model.elements.references import KINDS_OF_PARTS, called
from mbkit.model.loops import LIES_FLAT, ROLLING_KINDS, held_directions
from mbkit.model.parts import (
    RESTING,
    Body,
    Joint,
    JointCoupling,
    Loop,
    NoSlip,
    numbers,
    rest_faults,
)
from mbkit.model.stops import stop_faults
from mbkit.spatial import skew

# Fields that add to T along a joint's velocity.
_TURNING: Final = " or ".join(Joint.adding_to("T"))
# M of so many velocities has 200 MB.
_MAX_VELOCITIES: Final = 5000


def repeated_names(what: str, names: Iterable[str]) -> list[str]:
    """Return one sentence for each name that stands more than once."""
    return [f"{what} {n!r}: declared {k} times; names must differ" for n, k in Counter(names).items() if k > 1]


def listing(texts: Sequence[str], most: int = 6) -> str:
    """Return the first texts, and how many more there are."""
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "")


def structure_faults(description: Description) -> Iterator[str]:
    """Yield one sentence per fault: names, the tree, mimics, and the values of joints."""
    bodies, joints = description.bodies, description.joints
    if not bodies:
        yield "no bodies; add at least one"
    velocities = sum(j.type.nv for j in joints)
    if velocities > _MAX_VELOCITIES:
        yield f"{velocities} velocities; expected up to {_MAX_VELOCITIES}, because M has their square"
    for one, parts in ((called(section), getattr(description, section)) for section in KINDS_OF_PARTS):
        names = [p.name for p in parts]
        # One motion for each joint is asked below, in words of its own.
        yield from repeated_names(one, names) if one != "prescribed" else ()
        yield from (fault for part in parts for fault in _negative(one, part))
        if one in ("body", "frame") and "world" in names:
            yield f"{one} 'world': that name is the ground's; choose another"
    known, suggestions = {b.name for b in bodies} | {"world"}, Suggestions()

    def unknown(item: str, names: Iterable[str], known: Set[str] = known, what: str = "body") -> Iterator[str]:
        for name in names:
            if name not in known:
                near = suggestions.near(name, known)
                few = f"; there are: {', '.join(sorted(known))}" if len(known) <= MAX_LISTED else "; declare it"
                yield f"{item}: unknown {what} {name!r}" + (f"; did you mean {near!r}?" if near else few)

    for joint in joints:
        yield from unknown(f"joint {joint.name!r}", (joint.parent, joint.child))
        yield from _joint_faults(joint)
    for frame in description.frames:
        yield from unknown(f"frame {frame.name!r}", (frame.body,), known - {"world"})
        if frame.name in known - {frame.body}:
            yield f"frame {frame.name!r} on body {frame.body!r} has the name of another body; rename it"
    for spring in description.springs:
        item = f"spring {spring.name!r}"
        yield from unknown(item, (spring.body_a, spring.body_b))
        if spring.body_a == spring.body_b:
            yield f"{item}: both ends on {spring.body_a!r}; it would never act"
    for coupling in description.couplings:
        yield from _coupling_faults(coupling, joints)
    for loop in description.loops:
        yield from unknown(f"loop {loop.name!r}", (loop.body_a, loop.body_b))
        if loop.body_a == loop.body_b:
            yield f"loop {loop.name!r}: both ends on {loop.body_a!r}; it would close nothing"
        if loop.kind == "distance" and not loop.length > 0 and not np.isnan(loop.length):
            yield f"loop {loop.name!r}: expected a rod with a length above 0, got {loop.length:g}; use kind 'point'"
        if loop.kind != "distance" and loop.length:
            yield f"loop {loop.name!r}: length {loop.length:g} on a loop of kind {loop.kind!r}; only a rod has one"
    for part in description.no_slip:
        yield from unknown(f"no slip {part.name!r}", (part.body_a, part.body_b))
        yield from _no_slip_faults(part)
    yield from _tree_faults(bodies, joints)
    yield from _mimic_faults(joints)
    single, sizes = {j.name for j in joints if j.type.nv == 1 and not j.mimic}, {j.name: j.type.nv for j in joints}
    for coupler in description.couplers:
        item = f"coupler {coupler.name!r}"
        yield from unknown(item, (coupler.joint, *coupler.leaders), sizes.keys(), "joint")
        for name, count in Counter((coupler.joint, *coupler.leaders)).items():
            if name in sizes and name not in single:
                yield f"{item}: expected joints of one velocity that mimic none, got {name!r}"
            if count > 1 and name == coupler.joint:
                yield f"{item}: joint {name!r} against itself; name another leader"
            elif count > 1:
                yield f"{item}: leader {name!r} stands {count} times; give one ratio, the sum"
        if not coupler.leaders:
            yield f"{item}: leader: expected a joint or several, got none"
        if len(coupler.leaders) > 1 and coupler.curve.any():
            yield f"{item}: curve with {len(coupler.leaders)} leaders; a curve is of one leader"
        if len(coupler.leaders) > 1 and not coupler.ratios.any():
            yield f"{item}: ratio is zero for all leaders; expected one that leads"
    for name, count in Counter(p.joint for p in description.prescribed).items():
        if name not in single:
            there = ", ".join(sorted(single)) or "none"
            yield f"prescribed {name!r}: expected a joint of one velocity that mimics none; there are: {there}"
        if count > 1:
            yield f"prescribed {name!r}: moved {count} times; give one motion"
    yield from motion_faults(description.prescribed)
    yield from force_faults(description)


def _negative(what: str, part: Any) -> Iterator[str]:
    for name, rule, value in numbers(part):
        # Numbers above zero have rules of their own, of the kinds of parts that have them.
        if not rule.positive and np.any(value < rule.least):
            yield f"{what} {part.name!r}: {name} {value if np.ndim(value) else format(value, 'g')} is negative"


def _joint_faults(joint: Joint) -> Iterator[str]:
    item, type_ = f"joint {joint.name!r}", joint.type
    if joint.child == "world":
        yield f"{item}: the world cannot be a child; swap parent and child"
    if np.any(joint.lower > joint.upper):
        yield f"{item}: lower limit {joint.lower} above upper limit {joint.upper}"
    yield from rest_faults(item, joint)
    if type_.quaternion is not None and np.isfinite([x[type_.quaternion :] for x in (joint.lower, joint.upper)]).any():
        yield f"{item}: limits on the quaternion of a {joint.kind} joint bound no angle; leave them infinite"
    # The same about three axes is a sphere's, which has no gyroscopic term; neither has what rests.
    sphere = type_.quaternion == 0 and not np.ptp(joint.rotors) > 0
    if not np.isin(joint.rotors, (0.0, RESTING)).all() and type_.nv != 1 and not sphere:
        yield (
            f"{item}: {_TURNING} on a {joint.kind} joint; expected a joint of one velocity, or one number for the "
            "three of a ball joint (engines leave out the gyroscopic term otherwise): add a rotor as a body"
        )
    if np.any(joint.stiffness) and not type_.coordinate_velocities:
        yield f"{item}: joint spring on a {joint.kind} joint, which has no angle to act on; use add_spring"
    if joint.pitch and not type_.pitched:
        yield f"{item}: pitch {joint.pitch} on a {joint.kind} joint; only types such as helical have one"


def _coupling_faults(coupling: JointCoupling, joints: Sequence[Joint]) -> Iterator[str]:
    item, sizes = f"coupling {coupling.name!r}", {j.name: j.type.nv for j in joints}
    for name in coupling.joints:
        if name not in sizes:
            yield f"{item}: unknown joint {name!r}{did_you_mean(name, sizes)}"
        elif sizes[name] != 1:
            yield f"{item}: expected joints of one velocity, joint {name!r} has {sizes[name]}"
    if not np.any(coupling.factors):
        yield f"{item}: no joint has a factor other than zero; it would never act"


def _no_slip_faults(part: NoSlip) -> Iterator[str]:
    item, rolls = f"no slip {part.name!r}", part.kind in ROLLING_KINDS
    a, b = part.axis_a.any(), part.axis_b.any()
    if part.body_a == part.body_b:
        yield f"{item}: both points on {part.body_a!r}; it would hold nothing"
    if not rolls and bool(a) == bool(b):
        yield f"{item}: expected the direction as axis_a or as axis_b, got {'both' if a else 'neither'}; give one"
    if rolls and not b:
        yield f"{item}: axis_b is missing; expected the normal of the plane"
    if rolls and not part.radius > 0 and not np.isnan(part.radius):
        yield f"{item}: expected a radius above 0, got {part.radius:g}"
    if rolls and bool(a) != (part.kind in LIES_FLAT):
        has = "has an axis; give axis_a" if not a else "has no axis; leave axis_a out"
        yield f"{item}: a {part.kind} {has}"


def _tree_faults(bodies: Sequence[Body], joints: Sequence[Joint]) -> Iterator[str]:
    carriers, carried = by_key((j.child, j) for j in joints), by_key((j.parent, j) for j in joints)
    for name, several in carriers.items():
        if len(several) > 1 and name != "world":
            names = ", ".join(repr(j.name) for j in several)
            yield (
                f"body {name!r}: carried by {len(several)} joints ({names}); keep one and close the loop with add_loop"
            )
    reached = _connected_bodies(carried)
    for body in bodies:
        if body.name not in reached and body.name in carriers:
            yield f"body {body.name!r}: not connected to the world; its joints form a cycle or hang in the air"
        elif body.name not in reached:
            yield f"body {body.name!r}: no joint carries it; add a joint with child={body.name!r}"


def _connected_bodies(carried: Mapping[str, Sequence[Joint]]) -> set[str]:
    """Return the world and all bodies that joints connect to it, by the joints of each parent."""
    out, stack = {"world"}, ["world"]
    while stack:
        new = {j.child for j in carried.get(stack.pop(), ())} - out
        out |= new
        stack += new
    return out


def static_bodies(joints: Iterable[Joint]) -> set[str]:
    """Return the bodies that are fixed to the world, whose inertia cannot act."""
    return _connected_bodies(by_key((j.parent, j) for j in joints if not j.type.nv)) - {"world"}


def _mimic_faults(joints: Sequence[Joint]) -> Iterator[str]:
    by_name = {j.name: j for j in joints}
    suggestions = Suggestions()
    # Joints from which following the leaders ends.
    ends: set[str] = set()
    for joint in joints:
        if joint.mimic is None:
            continue
        item = f"joint {joint.name!r}"
        leader = by_name.get(joint.mimic.joint)
        if leader is None:
            near = suggestions.near(joint.mimic.joint, by_name)
            yield f"{item}: mimics unknown joint {joint.mimic.joint!r}" + (f"; near: {near!r}" if near else "")
            continue
        if joint.type.nv != leader.type.nv or (joint.type.nv != 1 and joint.type.built_in):
            yield f"{item}: mimics {leader.name!r}, but both must have one velocity"
        seen, at = {joint.name}, leader
        while at.name not in ends and at.mimic is not None and at.mimic.joint in by_name:
            if at.name in seen:
                yield f"{item}: mimics in a circle through {at.name!r}"
                break
            seen.add(at.name)
            at = by_name[at.mimic.joint]
        ends |= seen


_JOINT = re.compile(r"joint '.*?'(?=, so)")
# Ten times mjMINVAL is left of MuJoCo's smallest numbers, in kg and kg m².
_MIN_MASS_OR_MOMENT = 1e-14
# The sum of two numbers this far apart keeps five digits of the smaller. Real robots stay below 1e8.
_MAX_SIZE_RATIO = 1e11
# The largest coordinate at which M is sampled.
_MAX_SAMPLED_COORDINATE = 1e6


def body_fault(body: Body, *, point_masses: bool) -> str | None:
    """Return why mass and inertia are inconsistent, or None; zero mass with zero inertia is a frame.

    A thin rod and a disc of no thickness are limits of matter; mass without any inertia is one where `point_masses`.
    """
    eigenvalues = np.asarray(np.linalg.eigvalsh(body.inertia), dtype=np.float64)
    largest = float(np.max(np.abs(eigenvalues)))
    if body.mass < 0:
        return f"mass {body.mass:g} is negative"
    if body.mass == 0:
        return f"no mass but inertia: up to {largest:.3g} kg m²" if largest else None
    if largest == 0:
        return None if point_masses else "mass without inertia: give the inertia, however small"
    moments = f"principal moments {', '.join(f'{x:.4g}' for x in eigenvalues)} kg m²"
    if eigenvalues[0] < -1e-12 * largest:
        return f"inertia is not positive: {moments}"
    if eigenvalues[0] + eigenvalues[1] < eigenvalues[2] * (1 - PRINTED):
        return f"inertia violates A + B >= C: {moments}"
    return None


def body_faults(bodies: Iterable[Body], *, point_masses: bool) -> tuple[tuple[str, str], ...]:
    """Return the bodies of known but inconsistent inertia, each with the reason."""
    return tuple(
        (b.name, why)
        for b in bodies
        if np.isfinite([b.mass, *b.inertia.flat]).all() and (why := body_fault(b, point_masses=point_masses))
    )


def suspects(model: Description, *, point_masses: bool) -> tuple[tuple[str, str], ...]:
    """Return the bodies of known numbers that are inconsistent or leave a joint idle, each with the reason."""
    reasons = dict(body_faults(model.bodies, point_masses=point_masses))
    # A negative mass makes M indefinite, and joints look idle that are not.
    if all(x is not None for x in model.parameters.values()) and not any(b.mass < 0 for b in model.bodies):
        idle, alone = idle_joints(model)
        for name in idle:
            others = ", ".join(repr(n) for n in idle if n != name)
            why = f"no mass moves with joint {name!r}" if alone else f"joints {name!r} and {others} move the same mass"
            if not alone and not others:
                why = f"two velocities of joint {name!r} move the same mass"
            reasons.setdefault(model.joint(name).child, f"{why}, so M is singular: give mass, inertia or {_TURNING}")
    return tuple(reasons.items())


def model_faults(model: Description) -> list[str]:
    """Return one sentence per fault of a model that is made of parts: its structure, and bodies that cannot be."""
    faults = [*structure_faults(model)]
    accepted = {name for name, _ in model.nonphysical}
    impossible = body_faults(model.bodies, point_masses=True)
    static = static_bodies(model.joints)
    faults += [
        f"body {n!r}: {why}" for n, why in impossible if not (n in accepted or n in static) or model.body(n).mass < 0
    ]
    # The bounds of joints that follow others are known of a sound structure alone.
    return faults or [*stop_faults(model)]


_D = TypeVar("_D", bound=Description)


def check_substituted(before: _D, after: _D) -> _D:
    """Return a description with other parameter values, or raise `ModelError` for what these make impossible."""
    faults = [*structure_faults(after)]
    # An impossible body that was accepted before stays accepted, but a mass must not become negative.
    accepted = {name for name, _ in before.nonphysical}
    reasons = suspects(after, point_masses=True)
    faults += [f"body {n!r}: {why}" for n, why in reasons if n not in accepted or after.body(n).mass < 0]
    if faults:
        raise ModelError(before.name, faults)
    return after


def fault_sentences(reasons: Iterable[tuple[str, str]], parts: Mapping[str, Sequence[tuple[str, str]]]) -> list[str]:
    """Return one sentence for each kind of fault of bodies, with all their names or those of their faulty `parts`."""
    kinds: dict[str, list[tuple[str, str, str, str]]] = {}
    for body, why in reasons:
        moved = _JOINT.search(why)
        named = [("link", *part) for part in parts.get(body, ())] if not moved else []
        for what, name, reason in named or [("body", body, why)]:
            sentence, _, detail = reason.partition(": ")
            if moved:
                sentence, detail = sentence.replace(moved[0], "their joints"), moved[0]
            if what == "link" and name != body:
                detail = ", ".join(x for x in (detail, f"part of {body!r}") if x)
            kinds.setdefault(sentence, []).append((what, name, reason, detail))
    out = []
    for sentence, members in kinds.items():
        if len(members) == 1:
            what, name, reason, _ = members[0]
            out.append(f"{what} {name!r}: {reason}")
            continue
        plural = "links" if all(what == "link" for what, *_ in members) else "bodies"
        names = [f"{name!r} ({detail})" if detail else repr(name) for _, name, _, detail in members]
        out.append(f"{len(members)} {plural}: {sentence}: {listing(names, 20)}")
    return out


def idle_joints(model: Description) -> tuple[list[str], bool]:
    """Return the joints with motions of no kinetic energy, and whether each alone has one, from M at a random state.

    A null vector of M, scaled to a unit diagonal, names its joints. Motions that loops forbid count as moving mass.
    """
    if not model.nv:
        return [], True
    sample = _sample(model)
    M, diagonal = sample.M, np.diag(sample.M)
    if not np.isfinite(M).all():
        wild = [j.name for j in model.independent_joints if not np.isfinite(diagonal[model.layout.v[j.name]]).all()]
        where = ", ".join(map(repr, wild[:20])) or "all joints together"
        raise InputError(f"{model.name}: the mass matrix overflows at {where}; give smaller masses and lengths")
    rows = [sample.held(loop) @ model.layout.G for loop in model.loops]
    rows += [model.layout.coupler_row(coupler)[None] @ model.layout.G for coupler in model.couplers]
    if rows and (size := float(np.trace(M))):
        held = np.concatenate(rows)
        # M needs an inverse only for motions that the loops allow.
        M = M + size / len(M) * held.T @ held
    diagonal, alone = np.diag(M), True
    # A mass on its own axis leaves the square of a rounded length.
    zero = diagonal <= 1e-28 * float(diagonal.max())
    if not zero.any():
        # One root after the other: the product of two would leave the range of doubles.
        root = np.sqrt(diagonal)
        scaled = M / root[:, None] / root
        values, vectors = np.linalg.eigh(scaled)
        if values[0] > 4 * model.nv * EPS:
            return [], True
        alone = False
        zero = np.abs(vectors[:, 0]) > 0.3 * np.abs(vectors[:, 0]).max()
    return [j.name for j in model.independent_joints if zero[model.layout.v[j.name]].any()], alone


def scale_doubts(model: Description) -> list[str]:
    """Return why engines may lose digits in double precision, a sentence for each cause.

    A hinge's M_ii is a difference of numbers of size m L² in an engine with moments about a common centre (m: the mass
    that it carries, L: the mechanism's extent). MuJoCo takes inertias below 1e-15 (mjMINVAL) for zero.
    """
    if not model.nv or any(x is None for x in model.parameters.values()):
        return []
    sample = _sample(model)
    M, diagonal = sample.M, np.diag(sample.M)
    if not (diagonal > 0).all() or not np.isfinite(M).all():
        return []
    extent = float(np.max(np.ptp(np.array([*sample.places.values()]), axis=0)))
    carried: dict[str, float] = {b.name: b.mass for b in model.bodies}
    small, far = [], []
    for joint in reversed(model.tree):
        if joint.parent != "world":
            carried[joint.parent] += carried[joint.child]
        if joint.mimic is not None or not joint.type.nv:
            continue
        least = float(diagonal[model.layout.v[joint.name]].min())
        if least < _MIN_MASS_OR_MOMENT:
            small.append(f"{joint.name!r} ({least:.1e})")
        elif joint.type.rotates and carried[joint.child] * extent**2 > _MAX_SIZE_RATIO * least:
            far.append(f"{joint.name!r} ({least:.1e} kg m² of {carried[joint.child]:.1e} kg over {extent:.1e} m)")
    root = np.sqrt(diagonal)
    values = np.linalg.eigvalsh(M / root[:, None] / root)
    causes = (
        (f"joints that move less than {_MIN_MASS_OR_MOMENT:g} kg or kg m², which MuJoCo takes for zero", small),
        ("joints whose inertia is lost beside m L² of the whole mechanism", far),
    )
    out = [f"{what}: {listing(joints, 20)}" for what, joints in causes if joints]
    if values[0] * _MAX_SIZE_RATIO * 10 < values[-1]:
        out.append(f"M is nearly singular (eigenvalues {values[0]:.1e} to {values[-1]:.1e}, scaled to a unit diagonal)")
    return out


def sample_mass_matrix(model: Description, q: Array | None = None) -> Array:
    """Return M at a pose, or at one fixed random state, by composite inertias.

    Its diagonal is Σ Jᵀ I J, a sum of squares, which stays small where a mass is on its own axis.
    """
    return _sample(model, q).M


class _Sample(NamedTuple):
    """M and the bodies' poses at one state."""

    M: Array
    #: Centre of mass in the world of each body with mass.
    places: dict[str, Array]
    #: For each body the velocities that move it, and its (6, k) Jacobian for them in its axes, linear above angular.
    jacobians: dict[str, tuple[list[int], Array]]
    #: Rotation from each body's axes to the world's.
    rotations: dict[str, Array]
    #: Number of velocities before reduction.
    size: int

    def held(self, loop: Loop) -> Array:
        """Return the Jacobian of a loop's constraints, as if it were closed, for all velocities."""
        ends = []
        for body, point in ((loop.body_a, loop.translation_a), (loop.body_b, loop.translation_b)):
            moving, own = self.jacobians[body]
            J, R = np.zeros((6, self.size)), self.rotations[body]
            J[:, moving] = own
            ends.append((R @ (J[:3] - skew(np.asarray(point)) @ J[3:]), R @ J[3:]))
        linear, angular = (a - b for a, b in zip(*ends, strict=True))
        A, B = self.rotations[loop.body_a] @ loop.rotation_a, self.rotations[loop.body_b] @ loop.rotation_b
        moved, turned = held_directions(loop.kind, A, B)
        return np.concatenate([moved @ linear, turned @ angular])


@np.errstate(over="ignore", invalid="ignore")
def _sample(model: Description, q: Array | None = None) -> _Sample:
    """Return M and the places of bodies at a pose or the random state."""
    places = {"": np.zeros(3)}
    poses = {"world": (np.eye(3), np.zeros(3))}
    if q is None:
        q, _ = manifold.random_state(model, np.random.default_rng(0))
    # Limits may be as wide as doubles go; the squares of lengths must not overflow.
    q_full = model.layout.expand_q(np.clip(q, -_MAX_SAMPLED_COORDINATE, _MAX_SAMPLED_COORDINATE))
    n = model.layout.sizes[3]
    bodies = {b.name: b for b in model.bodies}
    # Motion of the child's frame for that of the parent's, and for the joint's velocities; linear above angular.
    steps: dict[str, tuple[Array, Array, slice]] = {}
    carried: dict[str, list[str]] = {}
    diagonal = np.zeros(n)
    jacobians: dict[str, tuple[list[int], Array]] = {"world": ([], np.zeros((6, 0)))}
    for joint in model.tree:
        carried.setdefault(joint.parent, []).append(joint.name)
        part = model.layout.full_v[joint.name]
        at = list(q_full[model.layout.full_q[joint.name]])
        R_JC, p_JC = (np.array(x, dtype=float) for x in joint.type.placement(np, joint, at))
        R, p = joint.rotation @ R_JC, joint.translation + joint.rotation @ p_JC
        X = np.block([[R.T, -R.T @ skew(p)], [np.zeros((3, 3)), R.T]])
        S = np.zeros((6, joint.type.nv))
        for k, unit in enumerate(np.eye(joint.type.nv).tolist()):
            S[:, k] = np.array([x for half in joint.type.twist(np, joint, at, unit) for x in half], dtype=float)
        steps[joint.name] = X, S, part
        moving, above = jacobians[joint.parent]
        moving, J = [*moving, *range(part.start, part.stop)], np.hstack([X @ above, S])
        jacobians[joint.child] = moving, J
        body = bodies[joint.child]
        R_W, p_W = poses[joint.parent]
        poses[joint.child] = R_W @ R, p_W + R_W @ p
        if body.mass:
            places[joint.child] = poses[joint.child][1] + poses[joint.child][0] @ body.com
        at_com = J[:3] - skew(body.com) @ J[3:]
        diagonal[moving] += body.mass * (at_com**2).sum(axis=0) + (J[3:] * (body.inertia @ J[3:])).sum(axis=0)
    M = np.zeros((n, n))
    composite: dict[str, Array] = {}
    # Momentum of the bodies beyond a joint for a unit velocity of each joint there, and which velocities those are.
    momenta: dict[str, tuple[list[int], Array]] = {}
    for joint in reversed(model.tree):
        X, S, part = steps[joint.name]
        body = bodies[joint.child]
        c = skew(body.com)
        inertia = np.block([[body.mass * np.eye(3), -body.mass * c], [body.mass * c, body.inertia - body.mass * c @ c]])
        beyond = [momenta.pop(name) for name in carried.get(joint.child, ())]
        inertia = inertia + sum((composite.pop(name) for name in carried.get(joint.child, ())), np.zeros((6, 6)))
        moving = [*range(part.start, part.stop), *(k for several, _ in beyond for k in several)]
        F = np.hstack([inertia @ S, *(f for _, f in beyond)])
        M[part, moving] = S.T @ F
        M[moving, part] = M[part, moving].T
        composite[joint.name] = X.T @ inertia @ X
        momenta[joint.name] = moving, X.T @ F
        diagonal[part] += joint.rotors
    np.fill_diagonal(M, diagonal)
    for coupling in model.couplings:
        row = model.layout.coupling_row(coupling)
        M += coupling.rotors * np.outer(row, row)
    M = np.asarray(model.layout.G.T @ M @ model.layout.G) if model.layout.reduced else M
    return _Sample(M, places, jacobians, {name: R for name, (R, _) in poses.items()}, n)
