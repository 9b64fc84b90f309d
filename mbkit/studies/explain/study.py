"""`explain`: why two descriptions or engines differ."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from mbkit._check import count, real
from mbkit.engines import Dynamics
from mbkit.errors import InputError, MbkitWarning
from mbkit.model import GravityCompensation, Model
from mbkit.model.description import CONSTRAINT_FEATURES
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.elements.paths import Path
from mbkit.model.model import unchecked
from mbkit.studies.explain import terms
from mbkit.studies.explain.controlled_runs import Motion, with_engines
from mbkit.studies.explain.engine_differences import engine_causes
from mbkit.studies.explain.hypotheses import (
    CONSTRAINTS,
    Hypothesis,
    ground_differences,
    links_in_common_axes,
    summarized_differences,
)
from mbkit.studies.explain.joint_matching import (
    Match,
    Matching,
    align_bases,
    align_frames,
    reconcile_joint_sets,
    rename_joints,
)
from mbkit.studies.explain.merged_model import MergedModel, Tolerances, merge, number_text, with_common_frames
from mbkit.studies.explain.motion import MOTIONS, Compared, compare_motions
from mbkit.studies.explain.records import compare_records
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.terms import WHOLE, Gap, Gaps, effects, larger, model_terms, states_of, worst
from mbkit.studies.results import to_plain

#: Parts of any kind are compared by their fields.
EXPLAIN: Final = Path("explain", "explain compares bodies and joints of", frozenset(EFFECTS))


def explain(
    a: Model | Dynamics,
    b: Model | Dynamics,
    *,
    samples: int = 3,
    seed: int = 0,
    tolerance: float = 1e-9,
    names: tuple[str, str] | None = None,
    motion: bool | Motion = False,
    rollouts: tuple[Any, Any] | None = None,
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
    motion : bool or Motion
        Whether both are moved by one controller, and each cause is measured by what it does to the motion, in rad and
        m; a `Motion` says how. Settings of the two simulators are causes then too.
    rollouts : (record, record), optional
        Two recorded motions of any simulators from one start; see `mbkit.studies.explain.record_of`. The first
        description is run with each known cause and each pair of them, to find what turns one record into the other.

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
        own = [x.engine if isinstance(x, Dynamics) else x.name for x in (a, b)]
        names = names or ((own[0], own[1]) if own[0] != own[1] else ("first", "second"))
        study = _Descriptions(one, other, names, samples, seed, tolerance, model_a.time)
        out = study.explain()
        out = engine_causes(a, b, out) if isinstance(a, Dynamics) or isinstance(b, Dynamics) else out
        if motion or rollouts is not None:
            MOTIONS.admit(model_a)
            MOTIONS.admit(model_b)
        if rollouts is not None:
            how = with_engines(motion if isinstance(motion, Motion) else Motion(), a, b)
            return replace(out, records=compare_records(study.compared, how, rollouts, names))
        if not motion:
            return out
        how = with_engines(motion if isinstance(motion, Motion) else Motion(), a, b)
        found = compare_motions(study.compared, how, names)
        return replace(out, motion=found, agree=out.agree and found.alike(tolerance))


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
    intervals = [(0.37, 0.37), *(x.interval for x in models)]
    return min(max(first for first, _ in intervals), *(last for _, last in intervals))


@dataclass
class _Descriptions:
    """Two descriptions, and the steps of their comparison."""

    a: Model
    b: Model
    names: tuple[str, str]
    samples: int
    seed: int
    tolerance: float
    time: float
    compared: Compared = field(init=False)

    def explain(self) -> Explanation:
        near = Tolerances.of(self.a, self.tolerance)
        wholes = merge(self.a), merge(self.b)
        by_name = self._gaps_by_name(*wholes)
        one, other, matching, structural = reconcile_joint_sets(self.a, self.b, near)
        theirs = rename_joints(other, one.model, matching)
        target, moved_frames = align_frames(theirs, one.model, near)
        target, bases = align_bases(one, target, near)
        before = by_name or self._gaps(one.model, theirs.model)
        whole = self._whole(one.model, theirs.model) if (alike := worst(before) <= self.tolerance) else ()
        one, target = with_common_frames(*links_in_common_axes(one, target, near))
        changed, hypotheses = one, summarized_differences(one, target, near) if one.model.nv else []
        for h in hypotheses:
            changed = h.apply(changed)
        after = self._gaps(changed.model, target.model)
        held = [*self._weights_held(near)]
        causes = (
            *(self._cause(h, {"M": np.inf}) for h in structural),
            *self._naming_causes(one, other, matching, by_name),
            *(self._measured_cause(h, one, target) for h in (*bases, *hypotheses)),
            # Joints that one side alone has are locked here; a body behind one of them does not stand still.
            *(
                self._cause(h, {})
                for h in ground_differences(*links_in_common_axes(*wholes, near), near, self.names[0])
                if not near.same(one.ground, target.ground)
            ),
            *(self._cause(h, effects(found)) for h, found in held),
        )
        read = wholes[0], rename_joints(wholes[1], one.model, matching)
        order = tuple(j.name for j in other.model.independent_joints)
        self.compared = Compared(
            (one, target), read, (*hypotheses,), (*bases,), (*structural,), matching, order, self.time
        )
        acting = [c.kind for c in causes if c.acts]
        massless = bool(one.model.nv) and self._is_massless(one.model) and self._is_massless(target.model)
        found = larger(before, self._large(whole), *(more for _, more in held)) if before else ()
        agree = worst(found) <= self.tolerance and not (structural or massless or CONSTRAINTS.intersection(acting))
        explained = worst(after) <= self.tolerance and (agree or massless or bool(acting))
        if explained and not agree and not massless:
            left = self._whole(changed.model, target.model)
            explained, after = not self._large(left), (*after, *left)

        def differs(joints: set[str]) -> bool:
            some = (terms.restricted(x.model, joints).without(*CONSTRAINT_FEATURES) for x in (changed, target))
            return worst(self._gaps(*some)) > self.tolerance

        return Explanation(
            a=self.names[0],
            b=self.names[1],
            agree=agree,
            gaps=found,
            comparable=bool(before) and not structural,
            matches=matching.pairs,
            only_a=matching.only_a,
            only_b=matching.only_b,
            causes=causes,
            notes=tuple(_notes(self.a, self.b, near, len(one.model.joints), moved_frames, matching)),
            explained=explained,
            left=after,
            subtree=() if explained else terms.minimal_differing_subtree(changed.model, differs),
            samples=self.samples,
            seed=self.seed,
            tolerance=self.tolerance,
            massless=massless,
            compared=massless or bool(whole) or not alike,
        )

    def _weights_held(self, near: Tolerances) -> Iterator[tuple[Hypothesis, Gaps]]:
        """Yield differences in the weights that the whole descriptions hold, body by body: `merge` joins bodies."""
        ours, theirs = ({f.body: f for f in x.forces if isinstance(f, GravityCompensation)} for x in (self.a, self.b))
        for body in dict.fromkeys([*ours, *theirs]):
            one, other = (side.get(body) or GravityCompensation(body, 0.0) for side in (ours, theirs))
            if changed := near.differing(one, other):
                model = self.a if body in ours else self.b
                known = {j.name for j in model.joints}
                held = (replace(x, without=tuple(j for j in x.without if j in known)) for x in (one, other))
                says = f"holds {number_text(other.fraction)} of its weight for {number_text(one.fraction)}"
                says = says if "fraction" in changed else "holds its weight at other joints"
                h = Hypothesis("gravity compensation", f"body {body!r}", says, a=one.fraction, b=other.fraction)
                yield h, self._gaps(*(replace(model, forces=(x,)) for x in held))

    def _is_massless(self, model: Model) -> bool:
        M = model_terms(model, states_of(model, self.samples, self.seed)).get("M")
        return M is not None and not M.any()

    def _large(self, gaps: Gaps) -> Gaps:
        return tuple(g for g in gaps if not g.relative <= self.tolerance)

    def _gaps(self, a: Model, b: Model) -> Gaps:
        if a.velocity_names != b.velocity_names or not a.nv:
            return ()
        at = states_of(b, self.samples, self.seed)
        out = terms.gaps(model_terms(a, at), model_terms(b, at), at, a)
        return (*out, *terms.jump_gap(a, b)) if out else ()

    def _gaps_by_name(self, one: MergedModel, other: MergedModel) -> Gaps:
        """Return the differences of terms with joints matched by name, where the names are the same."""
        ours, theirs = ([j.name for j in x.model.joints] for x in (one, other))
        if sorted(ours) != sorted(theirs):
            return ()
        pairs = tuple(Match(n, n, "name") for n in ours)
        return self._gaps(one.model, rename_joints(other, one.model, Matching(pairs, (), ())).model)

    def _whole(self, a: Model, b: Model) -> Gaps:
        """Return the difference between the accelerations of two whole systems; none where nothing can be compared."""
        if a.velocity_names != b.velocity_names or not a.nv:
            return ()
        # A state of one may be off the other's constraints, which is what is asked.
        with warnings.catch_warnings(action="ignore", category=MbkitWarning):
            apart = terms.whole_gap(a, b, self.samples, self.seed)
        return () if np.isnan(apart) else (Gap(WHOLE, apart, ""),)

    def _cause(self, h: Hypothesis, by_term: dict[str, float]) -> Cause:
        acts = any(not x <= self.tolerance for x in by_term.values())
        numbers = to_plain(h.a), to_plain(h.b)
        return Cause(h.kind, h.subject, h.sentence(self.names[1]), *numbers, by_term, acts, h)

    def _measured_cause(self, h: Hypothesis, one: MergedModel, target: MergedModel) -> Cause:
        """Return a difference with the larger of its two effects, added alone to one side or removed from the other."""
        sides = ((one, h.apply(one)), (target, h.revert(target))) if h.changes else ()
        if h.kind in CONSTRAINTS:
            found = [self._whole(x.model, y.model) or (Gap(WHOLE, np.inf, ""),) for x, y in sides]
        else:
            found = [self._gaps(x.model, y.model) or (Gap("M", np.inf, ""),) for x, y in sides]
        return self._cause(h, {g.term: g.relative for g in larger(*found)})

    def _naming_causes(
        self, one: MergedModel, other: MergedModel, matching: Matching, by_name: Gaps
    ) -> Iterator[Cause]:
        """Yield differences in the names of joints and in their order in q."""
        ours = {j.name for j in one.model.joints}
        by_structure = [m for m in matching.pairs if m.how == "structure"]
        exchanged, others = (
            ", ".join(f"{m.a!r} is {m.b!r}" for m in by_structure if (m.b in ours) is own) for own in (True, False)
        )
        if exchanged:
            h = Hypothesis("names exchanged", "", f"calls joints by each other's names: {exchanged}")
            yield self._cause(h, effects(by_name))
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


def _notes(
    a: Model, b: Model, near: Tolerances, many: int, moved_frames: Sequence[str], matching: Matching
) -> Iterator[str]:
    if moved_frames:
        frames = f"{len(moved_frames)} of {many} frames" if len(moved_frames) > 3 else ", ".join(moved_frames)
        yield f"frames drawn elsewhere, which changes no term: {frames}"
    if by_structure := sum(m.how == "structure" for m in matching.pairs):
        yield f"{by_structure} of {len(matching.pairs)} joints were matched by structure, the others by name"
    # Descriptions are compared without frames.
    there = {(f.name, f.body): f for f in b.frames}
    if moved := [f.name for f in a.frames if not near.same(f, there.get((f.name, f.body), f))]:
        yield f"named frames that stand elsewhere, which changes no term: {', '.join(moved)}"
