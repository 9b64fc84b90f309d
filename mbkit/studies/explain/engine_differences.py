"""Why two engines differ on one description: a convention, a left-out quantity or a known defect.

Only the answers of the engines are known. So each usual mistake is put into the questions to the first engine or its
answers, one at a time, until it answers as the second does. Gravity, rotors, damping and the ten inertial numbers of
a body enter the terms linearly; these are fitted, and what has another origin leaves a residual.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import chain, combinations, product
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit import spatial
from mbkit._check import TINY, Array
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.remote.dynamics import VersionDynamics
from mbkit.errors import KnownDefectWarning, MbkitError, UnsupportedError
from mbkit.load.shapes import NOTHING, MassProperties
from mbkit.model import JointCoupling, Model
from mbkit.model.description import CONSTRAINT_FEATURES
from mbkit.model.elements.kinds import PART_KINDS, that_do
from mbkit.studies.explain import terms
from mbkit.studies.explain.hypotheses import absences, body_mistakes, joint_mistakes
from mbkit.studies.explain.merged_model import MergedModel, merge, number_text
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.terms import TERM, Gaps, Values, evaluated, gaps, larger, model_terms, worst

#: The field that adds to T along a rate.
_ROTOR: Final = JointCoupling.adding_to("T")[0]
#: Quantities beside the terms of every explanation, in which known defects show.
_FURTHER_TERMS: Final = ("C v", "kinetic energy")
#: Terms mixed up: kind, sentence, and each term's parts with their factors.
_MIXED_TERMS: Final[tuple[tuple[str, str, dict[str, dict[str, float]]], ...]] = (
    (
        "gravity",
        "has the gravity forces with the other sign",
        {"g": {"g": -1.0}, "nle": {"nle": 1.0, "g": -2.0}},
    ),
    ("gravity", "leaves gravity out of nle", {"nle": {"nle": 1.0, "g": -1.0}}),
    ("passive forces", "has springs and dampers in nle", {"nle": {"nle": 1.0, "passive": -1.0}}),
    ("passive forces", "has passive forces with the other sign", {"passive": {"passive": -1.0}}),
)
#: Unit inertias xx, xy, xz, yy, yz, zz.
_UNIT_INERTIAS: Final = [
    np.maximum(x := np.outer(np.eye(3)[i], np.eye(3)[j]), x.T) for i in range(3) for j in range(i, 3)
]
#: Bodies whose terms span those of any matter: a mass at the origin and at a distance of one each way, and inertias.
_PROBE_BODIES: Final = (
    *(MassProperties(1.0, x, np.zeros((3, 3))) for x in (np.zeros(3), *np.eye(3))),
    *(MassProperties(0.0, np.zeros(3), I) for I in _UNIT_INERTIAS),
)


def engine_causes(a: Model | Dynamics, b: Model | Dynamics, out: Explanation) -> Explanation:
    """Return the explanation with the differences of two engines on the second description, and their causes."""
    model = b.model if isinstance(b, Dynamics) else b
    study = _Engines(_engine_on(a, model), _engine_on(b, model), out)
    defects, causes = study.defects(), study.causes()
    before, after = study.before, study.after
    # A term that only some engines have differs for no other cause than a known defect.
    named = {term for c in defects for term in c.effects}
    left = larger(after, tuple(g for g in study.further_gaps if g.term not in named))
    explained = max((g.relative for g in left), default=np.inf) <= out.tolerance
    return replace(
        out,
        agree=out.agree and max(worst(before), *(g.relative for g in study.further_gaps), 0.0) <= out.tolerance,
        gaps=larger(out.gaps, (*before, *study.further_gaps)),
        causes=(*out.causes, *defects, *causes),
        explained=out.explained and explained,
        left=larger(out.left, left),
        subtree=out.subtree or (study.subtree() if not worst(after) <= out.tolerance else ()),
    )


def _engine_on(x: Model | Dynamics, model: Model) -> Dynamics:
    if not isinstance(x, Dynamics):
        return dynamics(model)
    return x if x.model is model or x.model == model else x._of_model(model, model.form_digest)


class _Trial(NamedTuple):
    """A mistake of the second engine, and the terms that it would then return."""

    kind: str
    subject: str
    says: str
    values: Values


#: A convention's kind and sentence, and how `_Engines._answers` asks in it.
_Convention = tuple[str, str, dict[str, Any]]


class _Engines:
    """Two engines on one description."""

    def __init__(self, a: Dynamics, b: Dynamics, out: Explanation) -> None:
        self.a, self.b, self.tolerance, self.name = a, b, out.tolerance, out.b
        self.model = b.model
        self.at = terms.states_of(self.model, out.samples, out.seed)
        self.joints = self.model.velocity_joints
        self.values = {dyn: evaluated(dyn, self.at) for dyn in (a, b)}
        for dyn, values in self.values.items():
            if "M" not in values:
                raise UnsupportedError(
                    f"explain: {dyn.engine}: expected the mass matrix of {self.model.name}, by which differences are "
                    f"scaled, got only {', '.join(values) or 'no term'}; compare another engine"
                )
        self.target = self.values[b]
        self.before = self.after = self._gaps(self.values[a])
        self.further_gaps: Gaps = ()
        # Pinocchio is fast: it answers for the first engine where both say the same.
        described = gaps(self.values[a], model_terms(self.model, self.at), self.at, self.model)
        self.pinocchio_agrees = worst(described) <= self.tolerance
        self.own = self._terms(self.model)

    def _terms(self, model: Model, **states: Any) -> Values:
        """Return the first engine's terms of another description or at other states; none where it refuses."""
        at = replace(self.at, **states)
        try:
            return (
                model_terms(model, at)
                if self.pinocchio_agrees
                else evaluated(self.a._of_model(model, model.form_digest), at)
            )
        except MbkitError:
            return {}

    def _gaps(self, values: Values, other: Values | None = None) -> Gaps:
        return gaps(values, self.target if other is None else other, self.at, self.model)

    def defects(self) -> list[Cause]:
        """Return the known defects that show: the engine's other computation of the value is right."""
        out, sides = [], [(dyn, *self._further_terms(dyn)) for dyn in (self.a, self.b)]
        self.further_gaps = tuple(g for g in self._gaps(sides[0][1], sides[1][1]) if g.term != "M")
        for gap in (x for x in self.further_gaps if x.relative > self.tolerance):
            for (dyn, _, known), (_, other, _) in (sides, sides[::-1]):
                own = self.values[dyn]
                right = {"M": own["M"]}
                if gap.term != "C v":
                    right[gap.term] = np.asarray(0.5 * np.einsum("ni,nij,nj->n", self.at.v, own["M"], self.at.v))
                elif {"nle", "g"} <= own.keys():
                    right[gap.term] = own["nle"] - own["g"]
                same = [x for x in self._gaps(right, other) if x.term == gap.term]
                if gap.term in known and same and same[0].relative <= self.tolerance:
                    says = f"{gap.term}: {known[gap.term].split('; returned as it is')[0]}"
                    effects = {gap.term: gap.relative}
                    out.append(Cause("engine defect", dyn.engine, says, None, None, effects, acts=True))
        return out

    def _further_terms(self, dyn: Dynamics) -> tuple[Values, dict[str, str]]:
        """Return M and further terms as far as the engine has them, and the known defects of which it warns."""
        values, known = {"M": self.values[dyn]["M"]}, dict[str, str]()
        for term in _FURTHER_TERMS:
            with warnings.catch_warnings(record=True, action="always") as caught, suppress(MbkitError):
                values[term] = TERM[term].call(dyn, self.at)
            for warning in caught:
                if issubclass(warning.category, KnownDefectWarning):
                    known.setdefault(term, str(warning.message))
        return values, known

    def causes(self) -> list[Cause]:
        """Return the first mistake after which the first engine answers as the second does."""
        if worst(self.before) <= self.tolerance:
            return []
        for x in chain(self._conventions(), self._linear(), self._parts()):
            left = self._gaps(x.values)
            if worst(left) <= self.tolerance:
                self.after = left
                says = f"{x.subject}{': ' * bool(x.subject)}{self.name} {x.says}"
                effects = {g.term: g.relative for g in self.before}
                return [Cause(x.kind, x.subject, says, None, None, effects, acts=True)]
        return []

    # Conventions of questions and answers, the likely ones first.

    def _conventions(self) -> Iterator[_Trial]:
        for kind, says, mix in _MIXED_TERMS:
            known = {term: parts for term, parts in mix.items() if {term, *parts} <= self.own.keys()}
            mixed = {t: np.asarray(sum(x * self.own[n] for n, x in parts.items())) for t, parts in known.items()}
            yield _Trial(kind, "", says, self.own | mixed)
        for kind, says, asked in chain(self._velocity_frames(), self._orders()):
            yield _Trial(kind, "", says, self._answers(**asked))

    def _answers(
        self,
        order: np.ndarray | None = None,
        T: Array | None = None,
        slip: Callable[[Array], Array] | None = None,
    ) -> Values:
        """Return the terms in other coordinates, of which entry i is entry ``order[i]`` of the first engine's.

        T v is the velocity for the first engine, (N, nv, nv); `slip` returns from velocities the accelerations that nle
        must hold in addition.
        """
        q, v = self.at.q.copy(), self.at.v
        if order is not None:
            q[:, order] = self.at.q
        if T is not None:
            v = np.einsum("nij,nj->ni", T, v)
        values = self._terms(self.model, q=q, v=v)
        if slip is not None and {"nle", "M"} <= values.keys():
            values["nle"] = values["nle"] + np.einsum("nij,nj->ni", values["M"], slip(v))
        if T is None:
            return values
        return {
            name: np.asarray(np.swapaxes(T, 1, 2) @ x @ T if x.ndim == 3 else np.einsum("nji,nj->ni", T, x))
            for name, x in values.items()
        }

    def _permutation(self, order: np.ndarray) -> Array:
        return np.tile(np.eye(len(order))[:, order], (len(self.at.q), 1, 1))

    def _velocity_frames(self) -> Iterator[_Convention]:
        """Yield velocities of free joints in other axes or in the other order."""
        layout, kind, order = self.model.layout, "velocity frame", np.arange(self.model.nv)
        free = [(layout.q[j.name], layout.v[j.name]) for j in self.model.independent_joints if j.type.floating]
        if not free:
            return

        def slip(v: Array) -> Array:
            """Return -ω × v in the linear rows: how a velocity that stays changes in the body's axes."""
            out = np.zeros_like(v)
            for _, rows in free:
                linear, angular = np.split(v[:, rows], 2, axis=1)
                out[:, rows.start : rows.start + 3] = -np.cross(angular, linear)
            return out

        yield kind, "turns accelerations of free joints out of the world's axes without ω × v", {"slip": slip}
        for parts, which in (((0,), "linear velocity"), ((3,), "angular velocity"), ((0, 3), "velocity")):
            T = self._permutation(order)
            for (q, v), k in product(free, parts):
                rows = slice(v.start + k, v.start + k + 3)
                R = spatial.matrix_from_quaternion(self.at.q[:, q.stop - 4 : q.stop])
                T[:, rows, rows] = np.swapaxes(R, 1, 2)
            says = f"has the {which} of free joints in the world's axes"
            # v = T w, so that v̇ = T ẇ + Ṫ w: the linear part turns away under the body.
            yield kind, says, {"T": T, "slip": slip if 0 in parts else None}
            yield kind, f"{says}, turned without the term of the turning axes", {"T": T}
        for _, v in free:
            order[v] = np.roll(order[v], 3)
        says = "has the angular velocity of free joints before the linear one"
        yield kind, says, {"T": self._permutation(order)}

    def _orders(self) -> Iterator[_Convention]:
        """Yield orders of a quaternion's numbers, and of joints."""
        model, layout, names = self.model, self.model.layout, [*self.model.joint_names]
        for shift, one, other in ((1, "first", "last"), (-1, "last", "first")) if model.quaternions else ():
            order = np.arange(model.nq)
            for start, _ in model.quaternions:
                order[start : start + 4] = start + np.roll(np.arange(4), shift)
            yield "quaternion order", f"reads quaternions w {one}, which are written w {other}", {"order": order}
        orders = [
            *(("has the joints in the order of their names", sorted(names, key=key)) for key in (str, str.lower)),
            ("has the joints depth first", [j.name for j in model.tree if j.name in names]),
            ("has the joints generation by generation", sorted(names, key=lambda name: len(model.chains[name]))),
            ("has the joints from last to first", names[::-1]),
        ]
        for a, b in combinations(names, 2):
            swapped = [{a: b, b: a}.get(name, name) for name in names]
            orders.append((f"has joints {a!r} and {b!r} in each other's place", swapped))
        for says, some in orders:
            q, v = (np.concatenate([np.r_[rows[n]] for n in some]) for rows in (layout.q, layout.v))
            yield "joint order", says, {"order": q, "T": self._permutation(v)}

    # Quantities that enter the terms linearly.

    def _linear(self) -> Iterator[_Trial]:
        """Yield quantities left out of the whole robot, and fits of gravity, rotors and damping."""
        own, wanted = self.own, self.target
        kinds = [
            k for name, k in PART_KINDS.items() if name in self.model.acts and k.does <= {"T", "V", "loss", "force"}
        ]
        for feature in dict.fromkeys(x for k in kinds for x in k.features):
            yield _Trial(feature.removesuffix("s"), "", f"has no {feature}", self._terms(self.model.without(feature)))
        units = [self._terms(replace(self.model, gravity=e)) for e in np.eye(3)]
        if all("g" in x for x in (*units, wanted)):
            A = np.array([x["g"].ravel() for x in units]).T
            fitted = np.linalg.lstsq(A, wanted["g"].ravel(), rcond=1e-9)[0]
            # The fit cannot tell smaller numbers from zero.
            small = np.abs(fitted) < 1e-9 * np.abs(fitted).max(initial=1.0)
            gravity: Array = np.where(small, 0.0, fitted).astype(np.float64)
            says = f"has the gravity {number_text(gravity)} m/s² for {number_text(self.model.gravity)}"
            yield _Trial("gravity", "", says, self._terms(replace(self.model, gravity=gravity)))
        yield from self._couplings(own)
        if "M" in own:
            added = np.mean(np.einsum("nii->ni", wanted["M"] - own["M"]), axis=0)
            yield from self._fit(_ROTOR, added, own | {"M": own["M"] + np.diag(added)})
        if "passive" in own and "passive" in wanted:
            v = self.at.v
            damping = np.sum((own["passive"] - wanted["passive"]) * v, axis=0) / np.sum(v**2, axis=0)
            yield from self._fit("damping", damping, own | {"passive": own["passive"] - damping * v})

    def _fit(self, kind: str, amounts: Array, values: Values) -> Iterator[_Trial]:
        least = 1e-6 * max(1e-12, float(np.abs(amounts).max()))
        some = [k for k in range(self.model.nv) if abs(amounts[k]) > least]
        if some:
            more = ", ".join(f"{number_text(float(amounts[k]))} more at {self.joints[k]!r}" for k in some)
            subject = f"joint {self.joints[some[0]]!r}" if len(some) == 1 else "several joints"
            yield _Trial(kind, subject, f"has {kind} {more}", values)

    def _couplings(self, own: Values) -> Iterator[_Trial]:
        """Yield the loss of each coupling, and that of all their rotors between branches, as in MuJoCo."""
        couplings = self.model.couplings
        for c in couplings:
            left = replace(self.model, couplings=tuple(x for x in couplings if x is not c))
            yield _Trial("joint coupling", f"coupling {c.name!r}", "lacks it", self._terms(left))
        turning = ", ".join(repr(c.name) for c in couplings if c.rotors)
        if turning and "M" in own:
            chains = [self.model.chains[name] for name in self.joints]
            related = np.array([[a <= b or b <= a for a in chains] for b in chains])
            says = f"has no {_ROTOR} between branches"
            yield _Trial("joint coupling", f"coupling {turning}", says, own | {"M": own["M"] * related})

    def _parts(self) -> Iterator[_Trial]:
        """Yield the usual mistakes with each body whose ten numbers can explain M, and with each joint."""
        whole = merge(self.model)
        own = self._terms(whole.model)
        for joint in whole.model.joints:
            if fitted := self._fitted_matter(whole, joint.child, own):
                where, subject = ("bodies", joint.child), f"body {joint.child!r}"
                for x in body_mistakes(whole.links[joint.child], joint.rotation):
                    yield _Trial(x.kind, subject, x.says, self._terms(whole.put(where, x.fields).model))
                more, values = fitted
                mass = number_text(whole.model.body(joint.child).mass)
                says = f"has other matter in it: {number_text(more)} kg more than {mass}"
                yield _Trial("inertia", subject, says, values)
        for joint in whole.model.joints:
            for x in (*absences(joint), *joint_mistakes(joint)):
                # A mimic joint that is free has other coordinates, and could not have been compared.
                if x.fields.get("mimic", joint) is not None:
                    values = self._terms(whole.put(("joints", joint.name), x.fields).model)
                    yield _Trial(x.kind, f"joint {joint.name!r}", x.says, values)

    def _fitted_matter(self, whole: MergedModel, name: str, own: Values) -> tuple[float, Values] | None:
        """Return the added mass and the terms with the body's ten numbers fitted, if these explain M."""
        bodies = tuple(replace(b, **vars(NOTHING)) for b in whole.model.bodies)
        empty = replace(whole.model, bodies=bodies).without(*that_do("T"), "damping", "springs")
        alone = replace(whole, model=empty)
        columns = [self._terms(alone.put(("bodies", name), vars(matter)).model) for matter in _PROBE_BODIES]
        common = set(own).intersection(*columns)
        if "M" not in common:
            # The engine refuses bodies without matter.
            return None
        off = (self.target["M"] - own["M"]).ravel()
        A = np.array([c["M"].ravel() for c in columns]).T
        root = np.sqrt(np.einsum("nii->ni", own["M"]))
        weight = 1 / np.maximum(root[:, :, None] * root[:, None, :], TINY).ravel()
        x = np.linalg.lstsq(A * weight[:, None], off * weight, rcond=1e-10)[0]
        if np.abs((A @ x - off) * weight).max() > self.tolerance:
            return None
        moved = {t: own[t] + sum(w * c[t] for w, c in zip(x, columns, strict=True)) for t in common - {"passive"}}
        return float(x @ [mass_properties.mass for mass_properties in _PROBE_BODIES]), own | moved

    def subtree(self) -> tuple[str, ...]:
        """Return the smallest part on which the two engines still differ; of engines in this process alone."""
        whole = merge(self.model).model
        if any(isinstance(x, VersionDynamics) for x in (self.a, self.b)):
            # Each part of the robot would start a process of its own.
            return ()

        def differs(names: set[str]) -> bool:
            some = terms.restricted(whole, names).without(*CONSTRAINT_FEATURES)
            at = terms.states_of(some, len(self.at.q), 0)
            try:
                one, other = (evaluated(x._of_model(some, some.form_digest), at) for x in (self.a, self.b))
            except MbkitError:
                return False
            return worst(gaps(one, other, at, some)) > self.tolerance

        return terms.minimal_differing_subtree(whole, differs)
