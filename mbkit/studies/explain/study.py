"""`explain`: why two descriptions or engines differ."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from mbkit._check import count, real
from mbkit.engines import Dynamics
from mbkit.errors import InputError, MbkitWarning
from mbkit.model import GravityCompensation, Model
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.elements.paths import Path
from mbkit.model.model import unchecked
from mbkit.studies.explain import terms
from mbkit.studies.explain.engine_differences import engine_causes
from mbkit.studies.explain.hypotheses import (
    CONSTRAINTS,
    Hypothesis,
    ground_differences,
    links_in_common_axes,
    summarized_differences,
)
from mbkit.studies.explain.joint_matching import Match, Matching, align_frames, reconcile_joint_sets, rename_joints
from mbkit.studies.explain.merged_model import MergedModel, Tolerances, merge, number_text, with_common_frames
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.terms import WHOLE, Gaps, model_terms, states_of
from mbkit.studies.results import to_plain

#: Parts of any kind are compared by their fields.
EXPLAIN: Final = Path("explain", "explain compares bodies and joints of", frozenset(EFFECTS))
#: Time at which forces of the time are compared, s.
_MOMENT_S: Final = 0.37


def explain(
    a: Model | Dynamics,
    b: Model | Dynamics,
    *,
    samples: int = 3,
    seed: int = 0,
    tolerance: float = 1e-9,
    names: tuple[str, str] | None = None,
) -> Explanation:
    """Explain why two descriptions, or two engines, differ.

    Every difference between the descriptions is named, in each number of each kind of part of `Model.acts`, also of
    forces by functions: a lost, fused or changed body, inertia about the wrong point or in the wrong axes, a joint's
    place, axis, zero or pitch, quaternion and joint order, velocity frames, a known defect of an engine.
    Joints are matched by structure and name, and a mere choice of frames is no difference.

    The effect of each difference is measured: it is added alone to the first description, and removed alone from
    the second. The remainder with all of them put into the first is measured too.

    Parameters
    ----------
    a, b : Model or Dynamics
        Descriptions, or engines on a description (`mbkit.dynamics`).
    samples, seed, tolerance : int, int, float
        Random states at which terms are compared, and the relative difference that counts, of numbers in the
        descriptions and of terms.
    names : (str, str), optional
        Names of the two sides; by default those of their models or engines.

    Raises
    ------
    InputError
        An unusable argument, a parameter without a value, or a model in which nothing moves.
    UnsupportedError
        A model that was written as energies, or an engine without the mass matrix.

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
    # Mistakes that are tried on a description may leave one that cannot be.
    with unchecked():
        one, other = (replace(x, time=_moment(model_a, model_b)) for x in (model_a, model_b))
        sides = _Descriptions(one, other, names or _names(a, b), samples, seed, tolerance)
        out = sides.with_weights_held(sides.explain(), model_a, model_b)
        if not isinstance(a, Dynamics) and not isinstance(b, Dynamics):
            return out
        return engine_causes(a, b, out)


def _model(x: Model | Dynamics, which: str) -> Model:
    model = x.model if isinstance(x, Dynamics) else x
    if not isinstance(model, Model):
        raise InputError(
            f"{which}: expected a Model or a Dynamics, got {type(x).__name__}; mbkit.load(...) returns a Model"
        )
    EXPLAIN.admit(model)
    if not model.nv:
        raise InputError(f"{which}: nothing moves in {model.name} (nv = 0), so there is nothing to explain")
    return model


def _moment(*models: Model) -> float:
    """Return a time at which nothing begins, and which the tables of motions have."""
    intervals = [(_MOMENT_S, _MOMENT_S), *(x.interval for x in models)]
    return min(max(first for first, _ in intervals), *(last for _, last in intervals))


def _names(a: Model | Dynamics, b: Model | Dynamics) -> tuple[str, str]:
    one, other = (x.engine if isinstance(x, Dynamics) else x.name for x in (a, b))
    return (one, other) if one != other else ("first", "second")


@dataclass
class _Descriptions:
    """Two descriptions, and the steps of their comparison."""

    a: Model
    b: Model
    names: tuple[str, str]
    samples: int
    seed: int
    tolerance: float

    def explain(self) -> Explanation:
        near = Tolerances.of(self.a, self.tolerance)
        wholes = merge(self.a), merge(self.b)
        by_name = self._gaps_by_name(*wholes)
        one, other, matching, structural = reconcile_joint_sets(self.a, self.b, near)
        theirs = rename_joints(other, one.model, matching)
        target, moved_frames = align_frames(theirs, one.model, near)
        if moved_frames and self._gaps(theirs.model, target.model).worst > self.tolerance:
            target, moved_frames = theirs, ()
        before = by_name or self._gaps(one.model, theirs.model)
        whole = self._acceleration_gap(one.model, theirs.model) if before.worst <= self.tolerance else 0.0
        one, target = with_common_frames(*links_in_common_axes(one, target, near))
        changed, hypotheses = one, summarized_differences(one, target, near) if one.model.nv else []
        for h in hypotheses:
            changed = h.apply(changed)
        after = self._gaps(changed.model, target.model)
        causes = (
            *(self._cause(h, {"M": np.inf}) for h in structural),
            *self._naming_causes(one, other, matching, by_name),
            *(self._measured_cause(h, one, target) for h in hypotheses),
            # Joints that one side alone has are locked here; a body behind one of them does not stand still.
            *(
                self._cause(h, {})
                for h in ground_differences(*links_in_common_axes(*wholes, near), near, self.names[0])
                if not near.same(one.ground, target.ground)
            ),
        )
        acting = [c.kind for c in causes if c.acts]
        massless = bool(one.model.nv) and self._is_massless(one.model) and self._is_massless(target.model)
        alike = before.worst <= self.tolerance and not whole > self.tolerance
        agree = alike and not (structural or massless or CONSTRAINTS.intersection(acting))
        explained = after.worst <= self.tolerance and (agree or massless or bool(acting))
        if explained and not agree and not massless:
            left = self._acceleration_gap(changed.model, target.model)
            explained, after = not left > self.tolerance, after.with_whole(left)
        found = before.with_whole(whole if whole > self.tolerance else np.nan)

        def differs(joints: set[str]) -> bool:
            return self._gaps(*(terms.part(x.model, joints) for x in (changed, target))).worst > self.tolerance

        return Explanation(
            a=self.names[0],
            b=self.names[1],
            agree=agree,
            gaps=found.terms,
            comparable=before.comparable and not structural,
            matches=matching.pairs,
            only_a=matching.only_a,
            only_b=matching.only_b,
            causes=causes,
            notes=(*_notes(one, moved_frames, matching), *_named_frames(self.a, self.b, near)),
            explained=explained,
            left=after.terms,
            subtree=() if explained else terms.minimal_differing_subtree(changed.model, differs),
            samples=self.samples,
            seed=self.seed,
            tolerance=self.tolerance,
            massless=massless,
            compared=massless or not np.isnan(whole),
        )

    def with_weights_held(self, out: Explanation, a: Model, b: Model) -> Explanation:
        """Return the explanation with what differs in the weights that the two whole descriptions hold, body by body.

        `explain` merges bodies, and such a force acts on each of them.
        """
        ours, theirs = ({f.body: f for f in x.forces if isinstance(f, GravityCompensation)} for x in (a, b))
        near, causes, found = Tolerances.of(a, self.tolerance), list[Cause](), out.gaps
        for body in dict.fromkeys([*ours, *theirs]):
            one, other = (side.get(body) or GravityCompensation(body, 0.0) for side in (ours, theirs))
            if not (changed := near.differing(one, other)):
                continue
            model = a if body in ours else b
            known = {j.name for j in model.joints}
            held = (replace(x, without=tuple(j for j in x.without if j in known)) for x in (one, other))
            gaps = self._gaps(*(replace(model, forces=(x,)) for x in held))
            says = f"holds {number_text(other.fraction)} of its weight for {number_text(one.fraction)}"
            says = says if "fraction" in changed else "holds its weight at other joints"
            h = Hypothesis("gravity compensation", f"body {body!r}", says, a=one.fraction, b=other.fraction)
            causes.append(self._cause(h, gaps.effects))
            found = terms.larger(found, gaps.terms) if out.comparable else found
        acts = any(c.acts for c in causes)
        return replace(out, agree=out.agree and not acts, causes=(*out.causes, *causes), gaps=found)

    def _is_massless(self, model: Model) -> bool:
        M = model_terms(model, states_of(model, self.samples, self.seed)).get("M")
        return M is not None and not M.any()

    def _gaps(self, a: Model, b: Model) -> Gaps:
        if a.velocity_names != b.velocity_names or not a.nv:
            return Gaps(comparable=False)
        at = states_of(b, self.samples, self.seed)
        out = terms.gaps(model_terms(a, at), model_terms(b, at), at.v, a.velocity_joints)
        return replace(out, terms=(*out.terms, *terms.jump_gap(a, b, a.velocity_joints)))

    def _gaps_by_name(self, one: MergedModel, other: MergedModel) -> Gaps | None:
        """Return the differences of terms with joints matched by name, where the names are the same."""
        ours, theirs = ([j.name for j in x.model.joints] for x in (one, other))
        if sorted(ours) != sorted(theirs):
            return None
        pairs = tuple(Match(n, n, "name") for n in ours)
        return self._gaps(one.model, rename_joints(other, one.model, Matching(pairs, (), ())).model)

    def _acceleration_gap(self, a: Model, b: Model) -> float:
        """Return the difference between the accelerations of two whole systems; NaN where nothing can be compared."""
        if a.velocity_names != b.velocity_names or not a.nv:
            return np.nan
        # A state of one may be off the other's constraints, which is what is asked.
        with warnings.catch_warnings(action="ignore", category=MbkitWarning):
            return terms.whole_gap(a, b, self.samples, self.seed)

    def _cause(self, h: Hypothesis, effects: dict[str, float]) -> Cause:
        acts = any(not x <= self.tolerance for x in effects.values())
        head = f"{h.subject}: " if h.subject else ""
        return Cause(h.kind, h.subject, f"{head}{self.names[1]} {h.says}", to_plain(h.a), to_plain(h.b), effects, acts)

    def _measured_cause(self, h: Hypothesis, one: MergedModel, target: MergedModel) -> Cause:
        """Return a difference with the larger of its two effects, added alone to one side or removed from the other."""
        effects: dict[str, float] = {}
        for model, changed in ((one, h.apply(one)), (target, h.revert(target))) if h.changes else ():
            if h.kind in CONSTRAINTS:
                apart = self._acceleration_gap(model.model, changed.model)
                found = {WHOLE: np.inf if np.isnan(apart) else apart}
            else:
                found = self._gaps(model.model, changed.model).effects
            effects |= {term: max(x, effects.get(term, 0.0)) for term, x in found.items()}
        return self._cause(h, effects)

    def _naming_causes(
        self, one: MergedModel, other: MergedModel, matching: Matching, by_name: Gaps | None
    ) -> Iterator[Cause]:
        """Yield differences in the names of joints and in their order in q."""
        ours = {j.name for j in one.model.joints}
        by_structure = [m for m in matching.pairs if m.how == "structure"]
        exchanged, others = (
            ", ".join(f"{m.a!r} is {m.b!r}" for m in by_structure if (m.b in ours) is own) for own in (True, False)
        )
        if exchanged:
            h = Hypothesis("names exchanged", "", f"calls joints by each other's names: {exchanged}")
            yield self._cause(h, by_name.effects if by_name else {"M": np.inf})
        if others:
            yield self._cause(Hypothesis("renamed", "", f"calls joints otherwise: {others}"), {})
        there = [j.name for j in other.model.independent_joints if j.name in matching.to_b.values()]
        order = [m.b for m in matching.pairs if m.b in there]
        moved = [x for x, y in zip(order, there, strict=True) if x != y]
        if moved:
            says = f"has q and v in another order: {', '.join(there)}"
            if len(moved) == 2:
                says = f"has joints {moved[0]!r} and {moved[1]!r} in each other's place in q and v"
            yield self._cause(Hypothesis("joint order", "", says), {})


def _notes(one: MergedModel, moved_frames: Sequence[str], matching: Matching) -> Iterator[str]:
    if moved_frames:
        many = f"{len(moved_frames)} of {len(one.model.joints)} frames"
        frames = many if len(moved_frames) > 3 else ", ".join(moved_frames)
        yield f"frames drawn elsewhere, which changes no term: {frames}"
    if by_structure := sum(m.how == "structure" for m in matching.pairs):
        yield f"{by_structure} of {len(matching.pairs)} joints were matched by structure, the others by name"


def _named_frames(a: Model, b: Model, near: Tolerances) -> Iterator[str]:
    """Yield the frames of one name and body that stand elsewhere on it; descriptions are compared without frames."""
    there = {(f.name, f.body): f for f in b.frames}
    moved = [f.name for f in a.frames if not near.same(f, there.get((f.name, f.body), f))]
    if moved:
        yield f"named frames that stand elsewhere, which changes no term: {', '.join(moved)}"
