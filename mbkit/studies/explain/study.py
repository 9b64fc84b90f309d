"""`explain`: why two descriptions or engines differ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from mbkit._check import count, real
from mbkit.engines import Dynamics
from mbkit.errors import InputError, UnsupportedError
from mbkit.load.shapes import Lump
from mbkit.model import Joint, Model
from mbkit.studies.explain import hypotheses as bodies
from mbkit.studies.explain import hypotheses as joints
from mbkit.studies.explain import hypotheses as whole
from mbkit.studies.explain.engine_differences import engine_causes
from mbkit.studies.explain.hypotheses import Guess, Hypothesis, told, with_joint
from mbkit.studies.explain.joint_matching import Aligned, Match, Matching, aligned, renamed, settled
from mbkit.studies.explain.merged_links import Compact, compact, with_link, with_matter
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.terms import Gaps, gaps, model_terms, part, smallest, states_of
from mbkit.studies.explain.tolerance import Near
from mbkit.studies.results import to_plain

__all__ = ["explain"]

#: Numbers that differ by less are as if written with five digits.
_ROUNDED = 2e-5


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

    Every difference between the descriptions is named: armature, damping, friction, springs, gravity, a
    lost, fused or changed body, inertia about the wrong point or in the wrong axes, a joint's place, axis,
    zero or pitch, quaternion and joint order, mimic joints, velocity frames, a known defect of an engine.
    Joints are matched by structure and name, and frames that are only drawn elsewhere are no difference.

    What each difference does is measured: it is put alone into the first description, and taken alone out of
    the second. What remains with all of them put into the first is measured too.

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
    if not model.has_bodies:
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
        found = self._aligned(theirs, one.model, near)
        before = by_name or self._gaps(one.model, theirs.model)
        one, target = bodies.paired(one, found.compact, near)
        hypotheses = _hypotheses(one, target, near) if one.model.nv else []
        made = _applied(one, hypotheses)
        after = self._gaps(made.model, target.model)
        causes = [self._cause(h, {"M": np.inf}) for h in structural]
        causes += self._name_causes(one, other, matching, by_name)
        causes += [self._measured(h, one, target) for h in hypotheses]
        causes += self._ground(one, target, near)
        constrained = any(c.kind in whole.CONSTRAINTS for c in causes)
        massless = bool(one.model.nv) and self._massless(one.model) and self._massless(target.model)
        agree = not (structural or constrained or massless) and before.worst <= self.tolerance
        explained = after.worst <= self.tolerance and (agree or massless or any(c.acts for c in causes))
        return Explanation(
            a=self.names[0],
            b=self.names[1],
            agree=agree,
            gaps=before.terms,
            comparable=before.comparable and not structural,
            matches=matching.pairs,
            only_a=matching.only_a,
            only_b=matching.only_b,
            causes=tuple(causes),
            notes=tuple(self._notes(one, found.reframed, matching)),
            explained=explained,
            left=after.terms,
            subtree=() if explained else self._subtree(made.model, target.model),
            samples=self.samples,
            seed=self.seed,
            tolerance=self.tolerance,
            massless=massless,
        )

    def _massless(self, model: Model) -> bool:
        M = model_terms(model, states_of(model, self.samples, self.seed)).get("M")
        return M is not None and not M.any()

    def _aligned(self, theirs: Compact, like: Model, near: Near) -> Aligned:
        """Return a description with its frames where the other has them, if no term changes with that."""
        found = aligned(theirs, like, near)
        if not found.reframed or self._gaps(theirs.model, found.compact.model).worst <= self.tolerance:
            return found
        return Aligned(theirs, ())

    def _measured(self, h: Hypothesis, one: Compact, target: Compact) -> Cause:
        """Return a difference as a cause, with the larger of its effects on the two descriptions.

        It is put alone into the first description, and taken alone out of the second.
        """
        if h.kind in whole.CONSTRAINTS:
            return self._cause(h, {})
        effects: dict[str, float] = {}
        for model, changed in ((one.model, h.apply(one).model), (target.model, h.revert(target).model)):
            for term, relative in _effects(self._gaps(model, changed)).items():
                effects[term] = max(relative, effects.get(term, 0.0))
        return self._cause(h, effects)

    def _gaps(self, a: Model, b: Model) -> Gaps:
        if a.velocity_names != b.velocity_names or not a.nv:
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
        acts = h.kind in whole.CONSTRAINTS or any(not x <= self.tolerance for x in effects.values())
        head = f"{h.subject}: " if h.subject else ""
        return Cause(h.kind, h.subject, f"{head}{self.names[1]} {h.says}", to_plain(h.a), to_plain(h.b), effects, acts)

    def _name_causes(self, one: Compact, other: Compact, matching: Matching, by_name: Gaps | None) -> list[Cause]:
        """Return causes in what joints are called and where they stand in q."""
        out = []
        ours = {j.name for j in one.model.joints}
        exchanged = [m for m in matching.pairs if m.how == "structure" and m.b in ours]
        other_names = [m for m in matching.pairs if m.how == "structure" and m.b not in ours]
        if exchanged:
            says = "calls joints by each other's names: " + ", ".join(f"{m.a!r} is {m.b!r}" for m in exchanged)
            h = Hypothesis("names exchanged", "", says)
            out.append(self._cause(h, _effects(by_name) if by_name else {"M": np.inf}))
        if other_names:
            says = "calls joints otherwise: " + ", ".join(f"{m.a!r} is {m.b!r}" for m in other_names)
            out.append(self._cause(Hypothesis("renamed", "", says), {}))
        places = {n: k for k, n in enumerate(j.name for j in other.model.independent_joints)}
        order = [m.b for m in matching.pairs if m.b in places]
        there = sorted(order, key=places.__getitem__)
        if order != there:
            moved = [x for x, y in zip(order, there, strict=True) if x != y]
            if len(moved) == 2:
                says = f"has joints {moved[0]!r} and {moved[1]!r} in each other's place in q and v"
            else:
                says = f"has q and v in another order: {', '.join(there)}"
            out.append(self._cause(Hypothesis("joint order", "", says), {}))
        return out

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
        return [self._cause(Hypothesis("base mass", "the base", says, a=a.mass, b=b.mass), {})]

    def _notes(self, one: Compact, reframed: Sequence[str], matching: Matching) -> list[str]:
        out = []
        if reframed:
            frames = f"{len(reframed)} of {len(one.model.joints)} frames" if len(reframed) > 3 else ", ".join(reframed)
            out.append(f"frames drawn elsewhere, which changes no term: {frames}")
        if any(m.how == "structure" for m in matching.pairs):
            by_place = sum(m.how == "structure" for m in matching.pairs)
            out.append(f"{by_place} of {len(matching.pairs)} joints were matched by structure, the others by name")
        return out

    def _subtree(self, a: Model, b: Model) -> tuple[str, ...]:
        def differs(names: set[str]) -> bool:
            return self._gaps(part(a, names), part(b, names)).worst > self.tolerance

        return smallest(a, differs)


def _applied(x: Compact, hypotheses: Iterable[Hypothesis]) -> Compact:
    for h in hypotheses:
        x = h.apply(x)
    return x


def _effects(found: Gaps) -> dict[str, float]:
    return {g.term: g.relative for g in found.terms} if found.comparable else {"M": np.inf}


def _hypotheses(one: Compact, other: Compact, near: Near) -> list[Hypothesis]:
    """Return the differences that make one description the other; many small ones are one, called rounding."""
    fine = _differences(one, other, near)
    if len(fine) <= 4:
        return fine
    coarse = _differences(one, other, replace(near, tolerance=max(_ROUNDED, near.tolerance)))
    if len(coarse) > len(fine) // 2:
        return fine
    large = {(h.subject, field) for h in coarse for field in h.theirs}
    less = [h.without({field for subject, field in large if subject == h.subject}) for h in fine]
    small = [h for h in less if h.theirs]
    says = f"has rounded numbers: {len(small)} of them differ, by less than {_ROUNDED:.0e} of their size"

    def put(x: Compact, sides: Mapping[str, Sequence[Hypothesis]]) -> Compact:
        for h in sides.get("in", ()):
            x = h.apply(x)
        for h in sides.get("out", ()):
            x = h.revert(x)
        return x

    return [*coarse, Hypothesis("rounding", "", says, put, {"out": small}, {"in": small})]


def _differences(one: Compact, other: Compact, near: Near) -> list[Hypothesis]:
    """Return what makes `one` `other`, part by part."""
    out = whole.named_whole(one.model, other.model, near)
    theirs = {j.name: j for j in other.model.joints}
    for joint in one.model.joints:
        if joint.name in theirs:
            out += _joint(joint, theirs[joint.name], near)
            out += _body(one, joint, other, near)
    return out


def _joint(a: Joint, b: Joint, near: Near) -> list[Hypothesis]:
    def put(x: Compact, fields: Mapping[str, Any]) -> Compact:
        return replace(x, model=with_joint(x.model, a.name, **fields))

    out = []
    for g in joints.named_joints(a, b, near):
        ours = {field: getattr(a, field) for field in g.value}
        theirs = {field: getattr(b, field) for field in g.value}
        out.append(Hypothesis(g.kind, f"joint {a.name!r}", g.says, put, ours, theirs, *_numbers(ours, theirs)))
    return out


def _numbers(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the numbers of the two sides, where a difference is in one field of numbers."""
    if len(ours) != 1:
        return None, None
    sides = next(iter(ours.values())), next(iter(theirs.values()))
    return sides if all(isinstance(x, (float, np.ndarray)) for x in sides) else (None, None)


def _body(one: Compact, joint: Joint, other: Compact, near: Near) -> list[Hypothesis]:
    body = joint.child
    members, (a, b) = one.members[body], (_lump(x.model, body) for x in (one, other))
    if near.lump(a, b):
        return []
    links = bodies.by_link(members, other.members[body], near)
    if links:
        own = {m.name: m.matter for m in members}
        there = {m.name: m.matter for m in other.members[body]}
        return [
            _matter(
                g,
                f"link {name!r}, fixed to {body!r}" if name != body else f"link {name!r}",
                partial(_put_link, body, name),
                own[name],
                there[name],
            )
            for name, g in links
        ]
    guesses = bodies.named(members, joint.rotation, b, near, base=_base(joint))
    return [_matter(g, f"body {body!r}", lambda x, fields: with_matter(x, body, fields), a, b) for g in guesses]


def _put_link(body: str, link: str, x: Compact, fields: Mapping[str, Any]) -> Compact:
    return with_link(x, body, link, fields)


def _matter(g: Guess, subject: str, put: Callable[[Compact, Any], Compact], a: Lump, b: Lump) -> Hypothesis:
    ours, theirs = ({field: getattr(x, field) for field in g.value} for x in (a, b))
    return Hypothesis(g.kind, subject, g.says, put, ours, theirs, *_numbers(ours, theirs))


def _lump(model: Model, name: str) -> Lump:
    body = model.body(name)
    return Lump(body.mass, body.com, body.inertia)


def _base(joint: Joint) -> bool:
    return joint.type.floating and joint.parent == "world"
