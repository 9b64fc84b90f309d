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

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import KnownDefectWarning, MbkitError
from mbkit.load.solids import Lump
from mbkit.model import Model
from mbkit.studies.causes import bodies, joints
from mbkit.studies.causes.compact import Compact, compact, composite, with_lump
from mbkit.studies.causes.conventions import conventions
from mbkit.studies.causes.hypothesis import told, with_joint
from mbkit.studies.causes.result import Cause, Explanation
from mbkit.studies.causes.subtree import part, smallest
from mbkit.studies.causes.terms import Gap, Gaps, States, Values, evaluated, gaps, model_terms, states_of
from mbkit.studies.causes.whole import with_gravity

__all__ = ["engine_causes"]

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
        return dynamics(model, "pinocchio")
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
            for guess in bodies.blind(whole.members[joint.child], joint.rotation):
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
            for guess in joints.blind(joint):
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
