"""Two engines that should say the same of one description: what was misunderstood, left out or is wrong.

Nothing is known but their answers. So every usual mistake is made in what the first engine is
asked or told, one after the other, until it answers as the second does. Gravity, armature,
damping and the ten inertial numbers of a body enter the terms linearly: those are fitted, and
what is not of their making leaves a residue.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import KnownDefectWarning, MbkitError
from mbkit.load.shapes import Lump
from mbkit.model import Model
from mbkit.studies.explain import hypotheses
from mbkit.studies.explain.hypotheses import told, with_gravity, with_joint
from mbkit.studies.explain.merged_links import Compact, compact, composite, with_lump
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.terms import (
    Gap,
    Gaps,
    States,
    Values,
    evaluated,
    gaps,
    model_terms,
    part,
    smallest,
    states_of,
)

__all__ = ["Convention", "conventions", "engine_causes"]


# Usual misunderstandings about how an engine is asked and how it answers.
#
# Each is a way to ask the first engine as if it were the second: its answers are what the second
# would say if the two differed in that convention alone.

_SWAPS = 400


@dataclass(frozen=True)
class Convention:
    """A misunderstanding.

    Attributes
    ----------
    kind, says : str
    ask : callable
        The states at which the first engine is asked instead.
    answer : callable
        (its values there, the states asked for) -> what the second would say.
    """

    kind: str
    says: str
    ask: Callable[[States], States]
    answer: Callable[[Values, States], Values]


def conventions(model: Model) -> Iterator[Convention]:
    """Yield the misunderstandings that this model's joints allow, the likely ones first."""
    if any(j.type.floating for j in model.independent_joints):
        yield from _velocity_frames(model)
    if model.quaternions:
        for back, says in (
            (1, "reads quaternions w first, which are written w last"),
            (-1, "reads quaternions w last, which are written w first"),
        ):
            yield Convention("quaternion order", says, _shuffled(model, back), _same)
    if model.gravity.any():
        yield Convention("gravity", "has the gravity forces with the other sign", lambda at: at, _with(gravity=-1.0))
        yield Convention("gravity", "leaves gravity out of nle", lambda at: at, _with(left_out=True))
    if model.needs.damping or model.needs.springs:
        yield Convention("passive forces", "has springs and dampers in nle", lambda at: at, _with(passive=-1.0))
        yield Convention("passive forces", "has passive forces with the other sign", lambda at: at, _with(signed=True))
    yield from _orders(model)


def _same(values: Values, _at: States) -> Values:
    return values


def _with(
    *, gravity: float = 1.0, left_out: bool = False, passive: float = 0.0, signed: bool = False
) -> Callable[[Values, States], Values]:
    def answer(values: Values, _at: States) -> Values:
        out = dict(values)
        if "g" in values and "nle" in values:
            out["g"] = gravity * values["g"]
            out["nle"] = values["nle"] + (gravity - 1.0 - left_out) * values["g"]
        if "passive" in values and "nle" in values:
            out["nle"] = out["nle"] + passive * values["passive"]
            out["passive"] = -values["passive"] if signed else values["passive"]
        return out

    return answer


def _shuffled(model: Model, places: int) -> Callable[[States], States]:
    def ask(at: States) -> States:
        q = at.q.copy()
        for start, _ in model.quaternions:
            q[:, start : start + 4] = np.roll(at.q[:, start : start + 4], -places, axis=1)
        return States(q, at.v)

    return ask


def _velocity_frames(model: Model) -> Iterator[Convention]:
    """Yield velocities of free joints in other axes or in the other order."""
    free = [(model.layout.q[j.name], model.layout.v[j.name]) for j in model.independent_joints if j.type.floating]

    def turns(at: States, *, linear: bool, angular: bool) -> Array:
        T = np.tile(np.eye(model.nv), (len(at.q), 1, 1))
        for q, v in free:
            R = np.swapaxes(spatial.matrix_from_quaternion(at.q[:, q.stop - 4 : q.stop]), 1, 2)
            if linear:
                T[:, v.start : v.start + 3, v.start : v.start + 3] = R
            if angular:
                T[:, v.start + 3 : v.stop, v.start + 3 : v.stop] = R
        return T

    def slip(v: Array) -> Array:
        """Return -ω × v in the linear rows: how a velocity that stays changes in the body's axes."""
        out = np.zeros_like(v)
        for _, rows in free:
            linear, angular = v[:, rows.start : rows.start + 3], v[:, rows.start + 3 : rows.stop]
            out[:, rows.start : rows.start + 3] = -np.cross(angular, linear)
        return out

    def unturned(values: Values, at: States) -> Values:
        if "nle" not in values or "M" not in values:
            return values
        return values | {"nle": values["nle"] + np.einsum("nij,nj->ni", values["M"], slip(at.v))}

    says = "turns accelerations of free joints out of the world's axes without ω × v"
    yield Convention("velocity frame", says, lambda at: at, unturned)
    for which, says in (
        ({"linear": True, "angular": False}, "has the linear velocity of free joints in the world's axes"),
        ({"linear": False, "angular": True}, "has the angular velocity of free joints in the world's axes"),
        ({"linear": True, "angular": True}, "has the velocity of free joints in the world's axes"),
    ):
        for whole in (True, False):

            def ask(at: States, which: dict[str, bool] = which) -> States:
                return States(at.q, np.einsum("nij,nj->ni", turns(at, **which), at.v))

            def answer(values: Values, at: States, which: dict[str, bool] = which, whole: bool = whole) -> Values:
                T = turns(at, **which)
                out = {k: _pulled(T, x) for k, x in values.items()}
                if whole and which["linear"] and "nle" in values:
                    # v = T w, so that v̇ = T ẇ + Ṫ w: the linear part turns away under the body.
                    v = np.einsum("nij,nj->ni", T, at.v)
                    out["nle"] = out["nle"] + _pulled(T, np.einsum("nij,nj->ni", values["M"], slip(v)))
                return out

            told = says if whole else f"{says}, turned without the term of the turning axes"
            yield Convention("velocity frame", told, ask, answer)
    order = np.arange(model.nv)
    for _, v in free:
        order[v] = np.r_[v.start + 3 : v.stop, v.start : v.start + 3]
    same = np.arange(model.nq)
    yield _permuted("velocity frame", "has the angular velocity of free joints before the linear one", same, order)


def _pulled(T: Array, x: Array) -> Array:
    """Return Tᵀ x or Tᵀ x T."""
    if x.ndim == 3:
        return np.asarray(np.swapaxes(T, 1, 2) @ x @ T)
    return np.asarray(np.einsum("nji,nj->ni", T, x))


def _permuted(kind: str, says: str, q_order: np.ndarray, v_order: np.ndarray) -> Convention:
    """Return the convention in which entry i of a vector is entry ``order[i]`` of ours."""

    def ask(at: States) -> States:
        q, v = np.empty_like(at.q), np.empty_like(at.v)
        q[:, q_order], v[:, v_order] = at.q, at.v
        return States(q, v)

    def answer(values: Values, _at: States) -> Values:
        return {k: x[:, v_order][:, :, v_order] if x.ndim == 3 else x[:, v_order] for k, x in values.items()}

    return Convention(kind, says, ask, answer)


def _orders(model: Model) -> Iterator[Convention]:
    names = list(model.joint_names)
    tried = [tuple(names)]
    deep = [j.name for j in model.tree if j.name in names]
    for says, order in (
        ("has the joints in the order of their names", sorted(names)),
        ("has the joints in the order of their names", sorted(names, key=str.lower)),
        ("has the joints depth first", deep),
        ("has the joints generation by generation", _wide(model, names)),
        ("has the joints from last to first", names[::-1]),
    ):
        if tuple(order) not in tried:
            tried.append(tuple(order))
            yield _ordered(model, order, says)
    pairs = [(i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    for i, j in pairs[:_SWAPS]:
        order = list(names)
        order[i], order[j] = order[j], order[i]
        if tuple(order) not in tried:
            yield _ordered(model, order, f"has joints {names[i]!r} and {names[j]!r} in each other's place")


def _wide(model: Model, names: list[str]) -> list[str]:
    depth = {"world": 0}
    for joint in model.tree:
        depth[joint.child] = depth[joint.parent] + 1
    level = {j.name: depth[j.child] for j in model.joints}
    return sorted(names, key=level.__getitem__)


def _ordered(model: Model, order: list[str], says: str) -> Convention:
    q, v = (
        np.concatenate([np.arange(ranges[n].start, ranges[n].stop) for n in order])
        for ranges in (model.layout.q, model.layout.v)
    )
    return _permuted("joint order", says, q, v)


#: Terms beyond those of every explanation, in which defects show.
_BESIDE = (("C v", "coriolis_force", "qv"), ("kinetic energy", "kinetic_energy", "qv"))


@dataclass(frozen=True)
class _Found:
    kind: str
    subject: str
    says: str


def engine_causes(a: Model | Dynamics, b: Model | Dynamics, out: Explanation) -> Explanation:
    """Return the explanation with what two engines make of the second description, and why they differ."""
    model = b.model if isinstance(b, Dynamics) else b
    one, other = (_on(x, model) for x in (a, b))
    study = _Engines(one, other, out)
    causes = [*study.defects(), *study.causes()]
    before, after = study.before, study.after
    known = [c for c in causes if c.kind == "engine defect"]
    # Terms that only some engines give have no other explanation than a known defect.
    named = {term for c in known for term in c.effects}
    beside = [g for g in study.beside if g.term not in named]
    left = _larger(after.terms, beside)
    explained = max((g.relative for g in left), default=np.inf) <= out.tolerance
    return replace(
        out,
        agree=out.agree and max(before.worst, *(g.relative for g in study.beside), 0.0) <= out.tolerance,
        gaps=_larger(out.gaps, (*before.terms, *study.beside)),
        causes=(*out.causes, *causes),
        explained=out.explained and explained,
        left=_larger(out.left, left),
        subtree=out.subtree or (study.subtree() if not after.worst <= out.tolerance else ()),
    )


def _on(x: Model | Dynamics, model: Model) -> Dynamics:
    from mbkit.engines import dynamics

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


class _Engines:
    """Two engines on one description."""

    def __init__(self, a: Dynamics, b: Dynamics, out: Explanation) -> None:
        self.a, self.b, self.names, self.tolerance = a, b, (out.a, out.b), out.tolerance
        self.model = b.model
        self.at = states_of(self.model, out.samples, out.seed)
        self.owners = [j.name for j in self.model.independent_joints for _ in range(j.type.nv)]
        self.said = evaluated(b, self.at)
        self.before = self._gaps(evaluated(a, self.at))
        self.after = self.before
        self.beside: list[Gap] = []
        # Where the first engine says what Pinocchio says, Pinocchio is asked, which is quick.
        quick = self._apart(evaluated(a, self.at), model_terms(self.model, self.at)) <= self.tolerance
        self.terms: Callable[[Model, States], Values] = model_terms if quick else self._asked

    def _asked(self, model: Model, at: States) -> Values:
        return evaluated(type(self.a)(model), at)

    def _gaps(self, values: Values) -> Gaps:
        return gaps(values, self.said, self.at.v, self.owners)

    def _apart(self, a: Values, b: Values) -> float:
        return gaps(a, b, self.at.v, self.owners).worst

    # Known wrong values.

    def defects(self) -> list[Cause]:
        """Return known defects that show: the engine's own other way to the value is right."""
        out = []
        for term, quantity, _ in _BESIDE:
            values, heard = {}, {}
            for dyn in (self.a, self.b):
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    try:
                        values[dyn] = np.asarray(getattr(dyn, quantity)(self.at.q, self.at.v))
                    except MbkitError:
                        continue
                heard[dyn] = [str(w.message) for w in caught if issubclass(w.category, KnownDefectWarning)]
            if len(values) < 2:
                continue
            gap = self._beside(term, *values.values())
            self.beside.append(gap)
            if gap.relative <= self.tolerance:
                continue
            for dyn in (self.a, self.b):
                right = self._instead(term, dyn)
                other = values[self.b if dyn is self.a else self.a]
                if heard.get(dyn) and right is not None and self._beside(term, right, other).relative <= self.tolerance:
                    says = f"{term}: {heard[dyn][0].split('; returned as it is')[0]}"
                    out.append(Cause("engine defect", dyn.engine, says, None, None, {term: gap.relative}, acts=True))
        return out

    def _beside(self, term: str, a: Array, b: Array) -> Gap:
        scale = max(float(np.abs(a).max()), float(np.abs(b).max()), 1e-300)
        off = np.abs(a - b)
        joint = self.owners[int(np.argmax(off.max(axis=0)))] if off.ndim == 2 and off.any() else ""
        return Gap(term, float(off.max()) / scale, joint)

    def _instead(self, term: str, dyn: Dynamics) -> Array | None:
        """Return a term formed from others of the same engine."""
        values = evaluated(dyn, self.at)
        if term == "C v":
            return values["nle"] - values["g"] if {"nle", "g"} <= values.keys() else None
        return np.asarray(0.5 * np.einsum("ni,nij,nj->n", self.at.v, values["M"], self.at.v))

    # Everything else, by trying.

    def causes(self) -> list[Cause]:
        """Return the mistake after which the first engine says what the second says, or several fitted ones."""
        if self.before.worst <= self.tolerance:
            return []
        for made in (self._conventions, self._linear, self._bodies, self._joints):
            for found, values in made():
                left = self._gaps(values)
                if left.worst <= self.tolerance:
                    self.after = left
                    return [self._cause(found)]
        return []

    def _cause(self, found: _Found) -> Cause:
        head = f"{found.subject}: " if found.subject else ""
        effects = {g.term: g.relative for g in self.before.terms}
        return Cause(found.kind, found.subject, f"{head}{self.names[1]} {found.says}", None, None, effects, acts=True)

    def _conventions(self) -> Iterator[tuple[_Found, Values]]:
        for c in conventions(self.model):
            asked = c.ask(self.at)
            yield _Found(c.kind, "", c.says), c.answer(self.terms(self.model, asked), self.at)

    def _linear(self) -> Iterator[tuple[_Found, Values]]:
        """Yield what the whole robot may lack, and what is fitted: gravity, armature, damping."""
        own = self.terms(self.model, self.at)
        for feature, kind in (("armature", "armature"), ("damping", "damping"), ("springs", "spring")):
            if getattr(self.model.needs, feature):
                yield _Found(kind, "", f"has no {feature}"), self.terms(self.model.without(feature), self.at)
        yield from self._gravity(own)
        yield from self._couplings(own)
        nv = range(self.model.nv)
        off = self.said["M"] - own["M"]
        armature = np.mean(np.einsum("nii->ni", off), axis=0)
        for kind, amounts, unit in (("armature", armature, ""), ("damping", self._damping(own), "")):
            some = [k for k in nv if abs(amounts[k]) > 1e-6 * max(1e-12, float(np.abs(amounts).max()))]
            if not some:
                continue
            values = dict(own)
            if kind == "armature":
                values["M"] = own["M"] + np.diag(amounts)
            else:
                values["passive"] = own["passive"] - amounts * self.at.v
            told_ = [f"{told(float(amounts[k]))}{unit} more at {self.owners[k]!r}" for k in some]
            subject = f"joint {self.owners[some[0]]!r}" if len(some) == 1 else "several joints"
            yield _Found(kind, subject, f"has {kind} {', '.join(told_)}"), values

    def _couplings(self, own: Values) -> Iterator[tuple[_Found, Values]]:
        """Yield the loss of each coupling, and that of all their rotors between branches, as MuJoCo has it."""
        for c in self.model.couplings:
            left = replace(self.model, couplings=tuple(x for x in self.model.couplings if x is not c))
            yield _Found("joint coupling", f"coupling {c.name!r}", "lacks it"), self.terms(left, self.at)
        rotors = ", ".join(repr(c.name) for c in self.model.couplings if c.armature)
        if rotors:
            chains = [self.model.chains[name] for name in self.owners]
            related = np.array([[a <= b or b <= a for a in chains] for b in chains])
            found = _Found("joint coupling", f"coupling {rotors}", "has no armature between branches")
            yield found, {**own, "M": own["M"] * related}

    def _damping(self, own: Values) -> Array:
        if "passive" not in own or "passive" not in self.said:
            return np.zeros(self.model.nv)
        off = own["passive"] - self.said["passive"]
        return np.asarray(np.sum(off * self.at.v, axis=0) / np.sum(self.at.v**2, axis=0))

    def _gravity(self, own: Values) -> Iterator[tuple[_Found, Values]]:
        if "g" not in own or "g" not in self.said:
            return
        units = [self.terms(with_gravity(self.model, e), self.at)["g"].ravel() for e in np.eye(3)]
        fitted = np.linalg.lstsq(np.array(units).T, self.said["g"].ravel(), rcond=1e-9)[0]
        # What the fit cannot tell from zero is zero.
        small = np.abs(fitted) < 1e-9 * np.abs(fitted).max(initial=1.0)
        gravity: Array = np.where(small, 0.0, fitted).astype(np.float64)
        moved = self.terms(with_gravity(self.model, gravity), self.at)
        yield _Found("gravity", "", f"has the gravity {told(gravity)} m/s² for {told(self.model.gravity)}"), moved

    def _bodies(self) -> Iterator[tuple[_Found, Values]]:
        whole = compact(self.model)
        own = self.terms(whole.model, self.at)
        for joint in whole.model.joints:
            fitted = self._fitted(whole, joint.child, own)
            if fitted is None:
                continue
            subject = f"body {joint.child!r}"
            for guess in hypotheses.blind(whole.members[joint.child], joint.rotation):
                yield (
                    _Found(guess.kind, subject, guess.says),
                    self.terms(with_lump(whole.model, joint.child, guess.value), self.at),
                )
            values, says = fitted
            yield _Found("inertia", subject, says), values

    def _fitted(self, whole: Compact, name: str, own: Values) -> tuple[Values, str] | None:
        """Return the terms with the body's ten numbers fitted, if these explain M."""
        columns = [self.terms(_probe(whole.model, name, lump), self.at) for lump in _probes()]
        off = self.said["M"] - own["M"]
        A = np.array([c["M"].ravel() for c in columns]).T
        root = np.sqrt(np.einsum("nii->ni", own["M"]))
        weight = 1 / np.maximum(root[:, :, None] * root[:, None, :], 1e-300).ravel()
        x = np.linalg.lstsq(A * weight[:, None], off.ravel() * weight, rcond=1e-10)[0]
        residue = np.abs((A @ x - off.ravel()) * weight).max()
        if residue > self.tolerance:
            return None
        values = {
            term: own[term] + sum(w * c[term] for w, c in zip(x, columns, strict=True))
            if term != "passive"
            else own[term]
            for term in own
        }
        lump = composite(whole.members[name])
        says = f"has other matter in it: {told(float(x @ _MASSES))} kg more than {told(lump.mass)}"
        return values, says

    def _joints(self) -> Iterator[tuple[_Found, Values]]:
        whole = compact(self.model).model
        for joint in whole.joints:
            for guess in hypotheses.blind_joints(joint):
                if guess.kind == "mimic" and guess.value.get("mimic") is None:
                    # It would have other coordinates, and could not have been compared.
                    continue
                values = self.terms(with_joint(whole, joint.name, **guess.value), self.at)
                yield _Found(guess.kind, f"joint {joint.name!r}", guess.says), values

    def subtree(self) -> tuple[str, ...]:
        """Return the smallest part on which the two engines still differ."""
        whole = compact(self.model).model

        def differs(names: set[str]) -> bool:
            some = part(whole, names)
            at = states_of(some, len(self.at.q), 0)
            owners = [j.name for j in some.independent_joints for _ in range(j.type.nv)]
            try:
                one, other = (evaluated(type(x)(some), at) for x in (self.a, self.b))
            except MbkitError:
                return False
            return gaps(one, other, at.v, owners).worst > self.tolerance

        return smallest(whole, differs)


def _probes() -> list[Lump]:
    """Return ten lumps whose terms span those of any matter in a body."""
    out = [Lump(1.0, np.zeros(3), np.zeros((3, 3)))]
    # A mass of one at a distance of one each way, and inertias alone.
    out += [Lump(1.0, e, np.zeros((3, 3))) for e in np.eye(3)]
    for i in range(3):
        for j in range(i, 3):
            I = np.zeros((3, 3))
            I[i, j] = I[j, i] = 1.0
            out.append(Lump(0.0, np.zeros(3), I))
    return out


_MASSES = np.array([p.mass for p in _probes()])


def _probe(model: Model, name: str, lump: Lump) -> Model:
    """Return the description with nothing but this lump in it."""
    nothing = np.zeros(3), np.zeros((3, 3))
    bodies_ = tuple(
        replace(b, mass=lump.mass, com=lump.com, inertia=lump.inertia)
        if b.name == name
        else replace(b, mass=0.0, com=nothing[0], inertia=nothing[1])
        for b in model.bodies
    )
    return replace(model, bodies=bodies_).without("armature", "damping", "springs")
