"""`explain`: why two descriptions or engines differ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mbkit._check import count, real
from mbkit.engines import Dynamics
from mbkit.errors import InputError, UnsupportedError
from mbkit.load.solids import Lump
from mbkit.model import Joint, Model
from mbkit.spatial import skew
from mbkit.studies.causes import bodies, joints, whole
from mbkit.studies.causes.alignment import aligned, renamed
from mbkit.studies.causes.compact import Compact, Member, compact, composite, with_lump
from mbkit.studies.causes.engines import engine_causes
from mbkit.studies.causes.hypothesis import Hypothesis, told, with_joint
from mbkit.studies.causes.matching import Match, Matching
from mbkit.studies.causes.near import Near
from mbkit.studies.causes.result import Cause, Explanation, plain
from mbkit.studies.causes.structure import settled
from mbkit.studies.causes.subtree import part, smallest
from mbkit.studies.causes.terms import Gaps, gaps, model_terms, states_of

__all__ = ["explain"]

#: Numbers that differ by less are as if written with five digits.
_ROUNDED = 2e-5
#: Above so many causes only the whole is evaluated, not each by itself.
_MOST = 60


def explain(
    a: Model | Dynamics,
    b: Model | Dynamics,
    *,
    samples: int = 3,
    seed: int = 0,
    tolerance: float = 1e-9,
    names: tuple[str, str] | None = None,
) -> Explanation:
    """Say why two descriptions, or two engines, differ.

    The usual causes are applied to the first side, and those are named with which the difference
    vanishes: armature, damping, friction, springs, gravity, a lost, fused or changed body, inertia about
    the wrong point or in the wrong axes, a joint's place, axis, zero or pitch, quaternion and joint order,
    mimic joints, velocity frames, a known defect of an engine. Joints are matched by structure and name,
    and frames that are only drawn elsewhere are no difference.

    Parameters
    ----------
    a, b : Model or Dynamics
        Descriptions, or what an engine makes of one (`mbkit.dynamics`).
    samples, seed : int
        Random states at which terms are compared.
    tolerance : float
        Relative difference that counts, of numbers in the descriptions and of terms.
    names : (str, str), optional
        What the two sides are called; by default by their models' or engines' names.

    Returns
    -------
    Explanation

    Examples
    --------
    >>> import mbkit as mb
    >>> a = mb.catalog.double_pendulum()
    >>> b = mb.catalog.double_pendulum(mass2=1.5)
    >>> [str(c) for c in mb.explain(a, b).causes]
    ["body 'rod2': second has 1.5 times the mass, and the inertia with it"]
    """
    model_a, model_b = _model(a, "a"), _model(b, "b")
    count("samples", samples, least=1)
    count("seed", seed)
    real("tolerance", tolerance, positive=True)
    labels = names or _labels(a, b, model_a, model_b)
    out = _Descriptions(model_a, model_b, labels, samples, seed, tolerance).run()
    if not isinstance(a, Dynamics) and not isinstance(b, Dynamics):
        return out
    return engine_causes(a, b, out)


def _model(x: Model | Dynamics, which: str) -> Model:
    model = x.model if isinstance(x, Dynamics) else x
    if not isinstance(model, Model):
        raise InputError(
            f"{which}: expected a Model or a Dynamics, got {type(x).__name__}; mbkit.load(...) makes a Model"
        )
    if model.written is not None:
        raise UnsupportedError(f"explain: {model.name} was written as energies and has no bodies to compare")
    if not model.nv:
        raise InputError(f"{which}: nothing moves in {model.name} (nv = 0), so there is nothing to explain")
    return model


def _labels(a: Model | Dynamics, b: Model | Dynamics, model_a: Model, model_b: Model) -> tuple[str, str]:
    one, other = (x.engine if isinstance(x, Dynamics) else m.name for x, m in ((a, model_a), (b, model_b)))
    return (one, other) if one != other else ("first", "second")


@dataclass
class _Descriptions:
    """Two descriptions, and the steps of comparing them."""

    a: Model
    b: Model
    names: tuple[str, str]
    samples: int
    seed: int
    tolerance: float

    def run(self) -> Explanation:
        near = Near.of(self.a, self.tolerance)
        one, other = compact(self.a), compact(self.b)
        by_name = self._by_name(one, other)
        one, other, matching, structural = settled(self.a, self.b, near)
        theirs = renamed(other, one.model, matching)
        found = aligned(theirs, one.model, near)
        before = by_name or self._gaps(one.model, theirs.model)
        causes = [self._cause(h, {"M": np.inf}) for h in structural]
        causes += self._name_causes(one, other, matching, by_name)
        hypotheses, allowed = self._hypotheses(one, found.compact, near)
        target = found.compact.model
        made = _applied(one.model, hypotheses)
        after = self._gaps(made, target)
        for k, h in enumerate(hypotheses):
            if h.kind in joints.DATA_ONLY:
                effects: dict[str, float] = {}
            elif len(hypotheses) > _MOST:
                effects = {"M": np.nan}
            else:
                without = _applied(one.model, [x for i, x in enumerate(hypotheses) if i != k])
                effects = _effects(self._gaps(without, target))
            causes.append(self._cause(h, effects))
        causes += self._ground(one, found.compact, near)
        left = () if after.worst <= allowed else after.terms
        return Explanation(
            a=self.names[0],
            b=self.names[1],
            agree=not structural and before.worst <= self.tolerance,
            gaps=before.terms,
            comparable=before.comparable and not structural,
            matches=matching.pairs,
            only_a=matching.only_a,
            only_b=matching.only_b,
            causes=tuple(causes),
            notes=tuple(self._notes(one, found.reframed, matching)),
            explained=after.worst <= allowed,
            left=left,
            subtree=self._subtree(made, target, allowed) if after.worst > allowed else (),
            samples=self.samples,
            seed=self.seed,
            tolerance=self.tolerance,
        )

    def _gaps(self, a: Model, b: Model) -> Gaps:
        if a.velocity_names != b.velocity_names:
            return Gaps((), comparable=False)
        at = states_of(b, self.samples, self.seed)
        owners = [j.name for j in a.independent_joints for _ in range(j.type.nv)]
        return gaps(model_terms(a, at), model_terms(b, at), at.v, owners)

    def _by_name(self, one: Compact, other: Compact) -> Gaps | None:
        """Return how far the terms are apart by name, where the names are the same."""
        ours, theirs = ([j.name for j in x.model.joints] for x in (one, other))
        if sorted(ours) != sorted(theirs):
            return None
        pairs = tuple(Match(n, n, "name") for n in ours)
        return self._gaps(one.model, renamed(other, one.model, Matching(pairs, (), ())).model)

    def _cause(self, h: Hypothesis, effects: dict[str, float]) -> Cause:
        acts = h.kind not in joints.DATA_ONLY and any(not x <= self.tolerance for x in effects.values())
        head = f"{h.subject}: " if h.subject else ""
        return Cause(h.kind, h.subject, f"{head}{self.names[1]} {h.says}", plain(h.a), plain(h.b), effects, acts)

    def _name_causes(self, one: Compact, other: Compact, matching: Matching, by_name: Gaps | None) -> list[Cause]:
        """Return causes in what joints are called and where they stand in q."""
        out = []
        ours = {j.name for j in one.model.joints}
        exchanged = [m for m in matching.pairs if m.how == "structure" and m.b in ours]
        other_names = [m for m in matching.pairs if m.how == "structure" and m.b not in ours]
        if exchanged:
            says = "calls joints by each other's names: " + ", ".join(f"{m.a!r} is {m.b!r}" for m in exchanged)
            h = Hypothesis("names exchanged", "", says, lambda m: m)
            out.append(self._cause(h, _effects(by_name) if by_name else {"M": np.inf}))
        if other_names:
            says = "calls joints otherwise: " + ", ".join(f"{m.a!r} is {m.b!r}" for m in other_names)
            out.append(self._cause(Hypothesis("renamed", "", says, lambda m: m), {}))
        places = {n: k for k, n in enumerate(j.name for j in other.model.independent_joints)}
        order = [m.b for m in matching.pairs if m.b in places]
        there = sorted(order, key=places.__getitem__)
        if order != there:
            moved = [x for x, y in zip(order, there, strict=True) if x != y]
            if len(moved) == 2:
                says = f"has joints {moved[0]!r} and {moved[1]!r} in each other's place in q and v"
            else:
                says = f"has q and v in another order: {', '.join(there)}"
            out.append(self._cause(Hypothesis("joint order", "", says, lambda m: m), {}))
        return out

    def _hypotheses(self, one: Compact, other: Compact, near: Near) -> tuple[list[Hypothesis], float]:
        """Return the mistakes that make one the other, and to what they explain it."""
        fine = _differences(one, other, near)
        if len(fine) > 4:
            coarse = _differences(one, other, replace(near, tolerance=_ROUNDED))
            if len(coarse) <= len(fine) // 2:
                kept = {h.subject for h in coarse}
                small = [h for h in fine if h.subject not in kept]
                says = f"has rounded numbers: {len(small)} of them differ, by less than {_ROUNDED:.0e} of their size"
                rounding = Hypothesis("rounding", "", says, lambda m: _applied(m, small))
                return [*coarse, rounding], max(self.tolerance, 10 * _ROUNDED)
        return fine, self.tolerance

    def _ground(self, one: Compact, other: Compact, near: Near) -> list[Cause]:
        """Return what differs in the matter that stands still."""
        a, b = one.ground, other.ground
        if near.lump(a, b):
            return []
        if not b.mass and a.mass:
            says = f"has no mass in what stands still, where {self.names[0]} has {told(a.mass)} kg"
        elif near.number(a.mass, b.mass):
            some = bodies.by_link(one.members["world"], other.members["world"], near)
            links = [f"link {name!r} {g.says}" for name, g in some or ()]
            says = f"has other matter of the same mass standing still{': ' if links else ''}{', '.join(links)}"
        else:
            says = f"has {told(b.mass)} kg standing still for {told(a.mass)} kg"
        return [self._cause(Hypothesis("base mass", "the base", says, lambda m: m, a.mass, b.mass), {})]

    def _notes(self, one: Compact, reframed: Sequence[str], matching: Matching) -> list[str]:
        out = []
        if reframed:
            frames = f"{len(reframed)} of {len(one.model.joints)} frames" if len(reframed) > 3 else ", ".join(reframed)
            out.append(f"frames drawn elsewhere, which moves nothing: {frames}")
        if any(m.how == "structure" for m in matching.pairs):
            by_place = sum(m.how == "structure" for m in matching.pairs)
            out.append(f"{by_place} of {len(matching.pairs)} joints were matched by structure, the others by name")
        return out

    def _subtree(self, a: Model, b: Model, allowed: float) -> tuple[str, ...]:
        def differs(names: set[str]) -> bool:
            return self._gaps(part(a, names), part(b, names)).worst > allowed

        return smallest(a, differs)


def _applied(model: Model, hypotheses: Iterable[Hypothesis]) -> Model:
    for h in hypotheses:
        model = h.apply(model)
    return model


def _effects(found: Gaps) -> dict[str, float]:
    return {g.term: g.relative for g in found.terms} if found.comparable else {"M": np.inf}


def _differences(one: Compact, other: Compact, near: Near) -> list[Hypothesis]:
    """Return what makes `one` `other`, part by part."""
    out = whole.named(one.model, other.model, near)
    theirs = {j.name: j for j in other.model.joints}
    for joint in one.model.joints:
        if joint.name in theirs:
            out += _joint(joint, theirs[joint.name], near)
            out += _body(one, joint, other, near)
    return out


def _joint(a: Joint, b: Joint, near: Near) -> list[Hypothesis]:
    return [
        Hypothesis(
            g.kind,
            f"joint {a.name!r}",
            g.says,
            lambda m, g=g: with_joint(m, a.name, **g.value),  # type: ignore[misc]
            *_numbers(a, b, g.value),
        )
        for g in joints.named(a, b, near)
    ]


def _numbers(a: Joint, b: Joint, fields: dict[str, object]) -> tuple[object, object]:
    if len(fields) != 1 or not isinstance(next(iter(fields.values())), (float, np.ndarray)):
        return None, None
    name = next(iter(fields))
    return getattr(a, name), getattr(b, name)


def _body(one: Compact, joint: Joint, other: Compact, near: Near) -> list[Hypothesis]:
    members = one.members[joint.child]
    there = other.model.body(joint.child)
    b = Lump(there.mass, there.com, there.inertia)
    if near.lump(composite(members), b):
        return []
    links = bodies.by_link(members, other.members[joint.child], near)
    if links:
        return [
            Hypothesis(
                g.kind,
                f"link {name!r}, fixed to {joint.child!r}" if name != joint.child else f"link {name!r}",
                g.says,
                _with_link(members, joint.child, name, g.value),
            )
            for name, g in links
        ]
    return [
        Hypothesis(
            g.kind,
            f"body {joint.child!r}",
            g.says,
            lambda m, g=g: with_lump(m, joint.child, g.value),  # type: ignore[misc]
        )
        for g in bodies.named(members, joint.rotation, b, near, base=_base(joint))
    ]


def _with_link(members: Sequence[Member], body: str, link: str, lump: Lump) -> Callable[[Model], Model]:
    """Return what gives a body other matter in one of its links, and leaves the others as they are then."""
    own = next(m.lump for m in members if m.name == link)
    change = [(1.0, lump), (-1.0, own)]

    def apply(model: Model) -> Model:
        at = model.body(body)
        return with_lump(model, body, _sum([(1.0, Lump(at.mass, at.com, at.inertia)), *change]))

    return apply


def _sum(parts: Sequence[tuple[float, Lump]]) -> Lump:
    """Return matter added and taken away, about the common centre of mass."""
    mass = sum(s * x.mass for s, x in parts)
    moment = sum((s * x.mass * x.com for s, x in parts), np.zeros(3))
    com = moment / mass if abs(mass) > 1e-12 * max(x.mass for _, x in parts) else np.zeros(3)
    inertia = np.zeros((3, 3))
    for s, x in parts:
        d = skew(x.com - com)
        inertia += s * (x.inertia - x.mass * d @ d)
    return Lump(mass, com, inertia)


def _base(joint: Joint) -> bool:
    return joint.kind == "free" and joint.parent == "world"
