"""Why two engines differ on one description: a convention, a left-out quantity or a known defect.

Only the answers of the engines are known. So each usual mistake is put into the questions to the first engine or its
answers, one at a time, until it answers as the second does. Gravity, armature, damping and the ten inertial numbers of
a body enter the terms linearly; these are fitted, and what has another origin leaves a residual.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, islice
from typing import Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import KnownDefectWarning, MbkitError, UnsupportedError
from mbkit.load.shapes import NOTHING, Lump
from mbkit.model import Model
from mbkit.studies.explain.hypotheses import body_mistakes, joint_mistakes, number_text
from mbkit.studies.explain.merged_model import MergedModel, merge, with_lump
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.terms import (
    Gap,
    Gaps,
    States,
    Values,
    evaluated,
    gaps,
    minimal_differing_subtree,
    model_terms,
    part,
    states_of,
    velocity_joints,
)

#: Pairs of joints tried in each other's place.
_MAX_SWAPS: Final = 400
#: Quantities beside the terms of every explanation, in which known defects show.
_MORE_TERMS: Final = (("C v", "coriolis_force"), ("kinetic energy", "kinetic_energy"))


def _unit_inertia(i: int, j: int) -> Array:
    I = np.zeros((3, 3))
    I[i, j] = I[j, i] = 1.0
    return I


#: Bodies whose terms span those of any matter: a mass at the origin and at a distance of one each way, and inertias.
_PROBES: Final = (
    *(Lump(1.0, x, np.zeros((3, 3))) for x in (np.zeros(3), *np.eye(3))),
    *(Lump(0.0, np.zeros(3), _unit_inertia(i, j)) for i in range(3) for j in range(i, 3)),
)
_MASSES: Final = np.array([x.mass for x in _PROBES])


def engine_causes(a: Model | Dynamics, b: Model | Dynamics, out: Explanation) -> Explanation:
    """Return the explanation with the differences of two engines on the second description, and their causes."""
    model = b.model if isinstance(b, Dynamics) else b
    study = _Engines(_engine_on(a, model), _engine_on(b, model), out)
    defects, causes = study.defects(), study.causes()
    before, after = study.before, study.after
    # A term that only some engines have differs for no other cause than a known defect.
    named = {term for c in defects for term in c.effects}
    left = _larger(after.terms, [g for g in study.more if g.term not in named])
    explained = max((g.relative for g in left), default=np.inf) <= out.tolerance
    return replace(
        out,
        agree=out.agree and max(before.worst, *(g.relative for g in study.more), 0.0) <= out.tolerance,
        gaps=_larger(out.gaps, (*before.terms, *study.more)),
        causes=(*out.causes, *defects, *causes),
        explained=out.explained and explained,
        left=_larger(out.left, left),
        subtree=out.subtree or (study.subtree() if not after.worst <= out.tolerance else ()),
    )


def _engine_on(x: Model | Dynamics, model: Model) -> Dynamics:
    if not isinstance(x, Dynamics):
        return dynamics(model)
    return x if x.model is model or x.model == model else type(x)(model)


def _larger(one: Iterable[Gap], other: Iterable[Gap]) -> tuple[Gap, ...]:
    """Return every term once, with the larger of two gaps."""
    out: dict[str, Gap] = {}
    for gap in (*one, *other):
        if gap.term not in out or gap.relative > out[gap.term].relative:
            out[gap.term] = gap
    return tuple(out.values())


# Conventions of questions and answers.


@dataclass(frozen=True)
class _Convention:
    """A convention in which a second engine would differ from the first."""

    kind: str
    says: str
    #: Entry i of the second engine's q is entry ``coordinates[i]`` of the first's.
    coordinates: np.ndarray | None = None
    #: From states to T, (N, nv, nv), with T v the velocity for the first engine.
    velocities: Callable[[States], Array] | None = None
    #: From velocities to the accelerations that nle must hold in addition.
    slip: Callable[[Array], Array] | None = None
    #: Term -> the terms, with factors, that the second engine returns for it.
    terms: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def answer(self, ask: Callable[[States], Values], at: States) -> Values:
        """Return the second engine's answer, from those of the first."""
        q = at.q.copy()
        if self.coordinates is not None:
            q[:, self.coordinates] = at.q
        T = None if self.velocities is None else self.velocities(at)
        v = at.v if T is None else np.einsum("nij,nj->ni", T, at.v)
        values = ask(States(q, v))
        out = dict(values)
        for term, mix in self.terms.items():
            if term in values and mix.keys() <= values.keys():
                out[term] = np.asarray(sum(factor * values[name] for name, factor in mix.items()))
        if self.slip is not None and {"nle", "M"} <= values.keys():
            out["nle"] = out["nle"] + np.einsum("nij,nj->ni", values["M"], self.slip(v))
        return out if T is None else {name: _pulled_back(T, x) for name, x in out.items()}


def _pulled_back(T: Array, x: Array) -> Array:
    """Return Tᵀ x or Tᵀ x T."""
    if x.ndim == 3:
        return np.asarray(np.swapaxes(T, 1, 2) @ x @ T)
    return np.asarray(np.einsum("nji,nj->ni", T, x))


def _conventions(model: Model) -> Iterator[_Convention]:
    """Yield the conventions that matter for this model's joints, the likely ones first."""
    if any(j.type.floating for j in model.independent_joints):
        yield from _velocity_frames(model)
    if model.quaternions:
        for shift, says in (
            (1, "reads quaternions w first, which are written w last"),
            (-1, "reads quaternions w last, which are written w first"),
        ):
            order = np.arange(model.nq)
            for start, _ in model.quaternions:
                order[start : start + 4] = start + np.roll(np.arange(4), shift)
            yield _Convention("quaternion order", says, order)
    mixes: list[tuple[str, str, dict[str, dict[str, float]]]] = []
    if model.gravity.any():
        other_sign = {"g": {"g": -1.0}, "nle": {"nle": 1.0, "g": -2.0}}
        mixes.append(("gravity", "has the gravity forces with the other sign", other_sign))
        mixes.append(("gravity", "leaves gravity out of nle", {"nle": {"nle": 1.0, "g": -1.0}}))
    if model.needs.damping or model.needs.springs:
        kind = "passive forces"
        mixes.append((kind, "has springs and dampers in nle", {"nle": {"nle": 1.0, "passive": -1.0}}))
        mixes.append((kind, "has passive forces with the other sign", {"passive": {"passive": -1.0}}))
    yield from (_Convention(kind, says, terms=mix) for kind, says, mix in mixes)
    yield from _joint_orders(model)


def _velocity_frames(model: Model) -> Iterator[_Convention]:
    """Yield velocities of free joints in other axes or in the other order."""
    kind = "velocity frame"
    free = [(model.layout.q[j.name], model.layout.v[j.name]) for j in model.independent_joints if j.type.floating]

    def slip(v: Array) -> Array:
        """Return -ω × v in the linear rows: how a velocity that stays changes in the body's axes."""
        out = np.zeros_like(v)
        for _, rows in free:
            linear, angular = v[:, rows.start : rows.start + 3], v[:, rows.start + 3 : rows.stop]
            out[:, rows.start : rows.start + 3] = -np.cross(angular, linear)
        return out

    def turned(parts: Sequence[int]) -> Callable[[States], Array]:
        def velocities(at: States) -> Array:
            T = np.tile(np.eye(model.nv), (len(at.q), 1, 1))
            for q, v in free:
                R = np.swapaxes(spatial.matrix_from_quaternion(at.q[:, q.stop - 4 : q.stop]), 1, 2)
                for k in parts:
                    rows = slice(v.start + k, v.start + k + 3)
                    T[:, rows, rows] = R
            return T

        return velocities

    says = "turns accelerations of free joints out of the world's axes without ω × v"
    yield _Convention(kind, says, slip=slip)
    for parts, which in (((0,), "linear velocity"), ((3,), "angular velocity"), ((0, 3), "velocity")):
        says = f"has the {which} of free joints in the world's axes"
        # v = T w, so that v̇ = T ẇ + Ṫ w: the linear part turns away under the body.
        yield _Convention(kind, says, velocities=turned(parts), slip=slip if 0 in parts else None)
        yield _Convention(kind, f"{says}, turned without the term of the turning axes", velocities=turned(parts))
    order = np.arange(model.nv)
    for _, v in free:
        order[v] = np.r_[v.start + 3 : v.stop, v.start : v.start + 3]
    says = "has the angular velocity of free joints before the linear one"
    yield _Convention(kind, says, velocities=_permutation(order))


def _permutation(order: np.ndarray) -> Callable[[States], Array]:
    T = np.zeros((len(order), len(order)))
    T[order, np.arange(len(order))] = 1.0
    return lambda at: np.tile(T, (len(at.q), 1, 1))


def _joint_orders(model: Model) -> Iterator[_Convention]:
    names = list(model.joint_names)
    depth = {"world": 0}
    for joint in model.tree:
        depth[joint.child] = depth[joint.parent] + 1
    level = {j.name: depth[j.child] for j in model.joints}
    orders = [
        ("has the joints in the order of their names", sorted(names)),
        ("has the joints in the order of their names", sorted(names, key=str.lower)),
        ("has the joints depth first", [j.name for j in model.tree if j.name in names]),
        ("has the joints generation by generation", sorted(names, key=level.__getitem__)),
        ("has the joints from last to first", names[::-1]),
    ]
    for a, b in islice(combinations(names, 2), _MAX_SWAPS):
        swapped = [{a: b, b: a}.get(name, name) for name in names]
        orders.append((f"has joints {a!r} and {b!r} in each other's place", swapped))
    tried = [names]
    for says, order in orders:
        if order not in tried:
            tried.append(order)
            q, v = (np.concatenate([np.r_[at[n]] for n in order]) for at in (model.layout.q, model.layout.v))
            yield _Convention("joint order", says, q, _permutation(v))


@dataclass(frozen=True)
class _Finding:
    kind: str
    subject: str
    says: str


_Trials = Iterator[tuple[_Finding, Values]]


class _Engines:
    """Two engines on one description."""

    def __init__(self, a: Dynamics, b: Dynamics, out: Explanation) -> None:
        self.a, self.b, self.names, self.tolerance = a, b, (out.a, out.b), out.tolerance
        self.model = b.model
        self.at = states_of(self.model, out.samples, out.seed)
        self.owners = velocity_joints(self.model)
        own, self.wanted = evaluated(a, self.at), evaluated(b, self.at)
        for dyn, values in ((a, own), (b, self.wanted)):
            if "M" not in values:
                raise UnsupportedError(
                    f"explain: {dyn.engine}: expected the mass matrix of {self.model.name}, by which differences are "
                    f"scaled, got only {', '.join(values) or 'no term'}; compare another engine"
                )
        self.before = self.after = self._gaps(own)
        self.more: list[Gap] = []
        # Pinocchio is fast: it answers for the first engine where both say the same.
        described = gaps(own, model_terms(self.model, self.at), self.at.v, self.owners)
        self.fast = described.worst <= self.tolerance

    def _terms(self, model: Model, at: States | None = None) -> Values:
        """Return the first engine's terms of another description or at other states."""
        at = self.at if at is None else at
        return model_terms(model, at) if self.fast else evaluated(type(self.a)(model), at)

    def _gaps(self, values: Values) -> Gaps:
        return gaps(values, self.wanted, self.at.v, self.owners)

    def defects(self) -> list[Cause]:
        """Return the known defects that show: the engine's other computation of the value is right."""
        out = []
        for term, quantity in _MORE_TERMS:
            values: dict[Dynamics, Array] = {}
            known: dict[Dynamics, list[str]] = {}
            for dyn in (self.a, self.b):
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    try:
                        values[dyn] = np.asarray(getattr(dyn, quantity)(self.at.q, self.at.v))
                    except MbkitError:
                        continue
                known[dyn] = [str(w.message) for w in caught if issubclass(w.category, KnownDefectWarning)]
            if len(values) < 2:
                continue
            gap = self._gap(term, values[self.a], values[self.b])
            self.more.append(gap)
            if gap.relative <= self.tolerance:
                continue
            for dyn, other in ((self.a, self.b), (self.b, self.a)):
                right = self._from_terms(term, dyn)
                if not known[dyn] or right is None:
                    continue
                if self._gap(term, right, values[other]).relative <= self.tolerance:
                    says = f"{term}: {known[dyn][0].split('; returned as it is')[0]}"
                    effects = {term: gap.relative}
                    out.append(Cause("engine defect", dyn.engine, says, None, None, effects, acts=True))
        return out

    def _gap(self, term: str, a: Array, b: Array) -> Gap:
        scale = max(float(np.abs(a).max()), float(np.abs(b).max()), 1e-300)
        off = np.abs(a - b)
        joint = self.owners[int(np.argmax(off.max(axis=0)))] if off.ndim == 2 and off.any() else ""
        return Gap(term, float(off.max()) / scale, joint)

    def _from_terms(self, term: str, dyn: Dynamics) -> Array | None:
        values = evaluated(dyn, self.at)
        if term == "C v":
            return values["nle"] - values["g"] if {"nle", "g"} <= values.keys() else None
        return np.asarray(0.5 * np.einsum("ni,nij,nj->n", self.at.v, values["M"], self.at.v))

    def causes(self) -> list[Cause]:
        """Return the first mistake after which the first engine answers as the second does."""
        if self.before.worst <= self.tolerance:
            return []
        for trials in (self._conventions, self._linear, self._bodies, self._joints):
            for x, values in trials():
                left = self._gaps(values)
                if left.worst <= self.tolerance:
                    self.after = left
                    says = f"{x.subject}{': ' * bool(x.subject)}{self.names[1]} {x.says}"
                    effects = {g.term: g.relative for g in self.before.terms}
                    return [Cause(x.kind, x.subject, says, None, None, effects, acts=True)]
        return []

    def _conventions(self) -> _Trials:
        for c in _conventions(self.model):
            yield _Finding(c.kind, "", c.says), c.answer(lambda at: self._terms(self.model, at), self.at)

    def _linear(self) -> _Trials:
        """Yield quantities left out of the whole robot, and fits of gravity, armature and damping."""
        own = self._terms(self.model)
        for feature, kind in (("armature", "armature"), ("damping", "damping"), ("springs", "spring")):
            if getattr(self.model.needs, feature):
                yield _Finding(kind, "", f"has no {feature}"), self._terms(self.model.without(feature))
        if "g" in own and "g" in self.wanted:
            units = [self._terms(replace(self.model, gravity=e))["g"].ravel() for e in np.eye(3)]
            fitted = np.linalg.lstsq(np.array(units).T, self.wanted["g"].ravel(), rcond=1e-9)[0]
            # The fit cannot tell smaller numbers from zero.
            small = np.abs(fitted) < 1e-9 * np.abs(fitted).max(initial=1.0)
            gravity: Array = np.where(small, 0.0, fitted).astype(np.float64)
            says = f"has the gravity {number_text(gravity)} m/s² for {number_text(self.model.gravity)}"
            yield _Finding("gravity", "", says), self._terms(replace(self.model, gravity=gravity))
        yield from self._couplings(own)
        armature = np.mean(np.einsum("nii->ni", self.wanted["M"] - own["M"]), axis=0)
        yield from self._fit("armature", armature, {**own, "M": own["M"] + np.diag(armature)})
        if "passive" in own and "passive" in self.wanted:
            off, v = own["passive"] - self.wanted["passive"], self.at.v
            damping = np.sum(off * v, axis=0) / np.sum(v**2, axis=0)
            yield from self._fit("damping", damping, {**own, "passive": own["passive"] - damping * v})

    def _fit(self, kind: str, amounts: Array, values: Values) -> _Trials:
        least = 1e-6 * max(1e-12, float(np.abs(amounts).max()))
        some = [k for k in range(self.model.nv) if abs(amounts[k]) > least]
        if some:
            more = ", ".join(f"{number_text(float(amounts[k]))} more at {self.owners[k]!r}" for k in some)
            subject = f"joint {self.owners[some[0]]!r}" if len(some) == 1 else "several joints"
            yield _Finding(kind, subject, f"has {kind} {more}"), values

    def _couplings(self, own: Values) -> _Trials:
        """Yield the loss of each coupling, and that of all their rotors between branches, as in MuJoCo."""
        couplings = self.model.couplings
        for c in couplings:
            left = replace(self.model, couplings=tuple(x for x in couplings if x is not c))
            yield _Finding("joint coupling", f"coupling {c.name!r}", "lacks it"), self._terms(left)
        rotors = ", ".join(repr(c.name) for c in couplings if c.armature)
        if rotors:
            chains = [self.model.chains[name] for name in self.owners]
            related = np.array([[a <= b or b <= a for a in chains] for b in chains])
            x = _Finding("joint coupling", f"coupling {rotors}", "has no armature between branches")
            yield x, {**own, "M": own["M"] * related}

    def _bodies(self) -> _Trials:
        whole = merge(self.model)
        own = self._terms(whole.model)
        for joint in whole.model.joints:
            fitted = self._fitted_matter(whole, joint.child, own)
            if fitted is None:
                continue
            subject, a = f"body {joint.child!r}", whole.lump(joint.child)
            for x in body_mistakes(whole.links[joint.child], joint.rotation):
                changed = with_lump(whole.model, joint.child, replace(a, **x.fields))
                yield _Finding(x.kind, subject, x.says), self._terms(changed)
            more, values = fitted
            says = f"has other matter in it: {number_text(more)} kg more than {number_text(a.mass)}"
            yield _Finding("inertia", subject, says), values

    def _fitted_matter(self, whole: MergedModel, name: str, own: Values) -> tuple[float, Values] | None:
        """Return the added mass and the terms with the body's ten numbers fitted, if these explain M."""
        bodies = tuple(replace(b, **vars(NOTHING)) for b in whole.model.bodies)
        empty = replace(whole.model, bodies=bodies).without("armature", "damping", "springs")
        columns = [self._terms(with_lump(empty, name, lump)) for lump in _PROBES]
        off = (self.wanted["M"] - own["M"]).ravel()
        A = np.array([c["M"].ravel() for c in columns]).T
        root = np.sqrt(np.einsum("nii->ni", own["M"]))
        weight = 1 / np.maximum(root[:, :, None] * root[:, None, :], 1e-300).ravel()
        x = np.linalg.lstsq(A * weight[:, None], off * weight, rcond=1e-10)[0]
        if np.abs((A @ x - off) * weight).max() > self.tolerance:
            return None
        moved = {t: own[t] + sum(w * c[t] for w, c in zip(x, columns, strict=True)) for t in own if t != "passive"}
        return float(x @ _MASSES), own | moved

    def _joints(self) -> _Trials:
        whole = merge(self.model)
        for joint in whole.model.joints:
            for x in joint_mistakes(joint):
                # A mimic joint that is free has other coordinates, and could not have been compared.
                if x.fields.get("mimic", joint) is not None:
                    values = self._terms(whole.with_joint(joint.name, x.fields).model)
                    yield _Finding(x.kind, f"joint {joint.name!r}", x.says), values

    def subtree(self) -> tuple[str, ...]:
        """Return the smallest part on which the two engines still differ."""
        whole = merge(self.model).model

        def differs(names: set[str]) -> bool:
            some = part(whole, names)
            at = states_of(some, len(self.at.q), 0)
            try:
                one, other = (evaluated(type(x)(some), at) for x in (self.a, self.b))
            except MbkitError:
                return False
            return gaps(one, other, at.v, velocity_joints(some)).worst > self.tolerance

        return minimal_differing_subtree(whole, differs)
