"""Models of several kinds, so that each pair of kinds stands together in one: a covering array, by a fixed seed.

A pair is covered for each gate apart: of two kinds that a path carries, a model has both that this path takes, since
a refusal of a third kind would hide them. Kinds of joints stand on one joint too. What cannot stand together is told
by mbkit's own error, on the smallest model. Models, states and truth are those of `tests.kind_examples`.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

import mbkit as mb
from mbkit.errors import MbkitError
from mbkit.model import KINDS as JOINT_TYPES
from mbkit.model.elements.kinds import PART_KINDS, Kind, kind
from mbkit.model.elements.paths import Path as Gate
from tests import kind_examples
from tests.kind_examples import EXAMPLES, LIMBS, NUMBERS, PARTS, STICTION, TOGETHER, TYPES, WEIGHTS, Arm, Example, Site
from tests.kind_paths import COLUMNS, Cell, registered, told

SEED, MOST_KINDS, CANDIDATES, ADDITIONS = 53, 6, 4, 10
#: Paths that the models go along, and the gates of each.
PATHS: dict[str, tuple[str, ...]] = {
    "URDF and back": ("urdf",),
    "MJCF and back": ("mjcf",),
    "mujoco: accelerations": ("mujoco",),
    "drake: accelerations": ("drake",),
    "C": ("c",),
    "rk4": ("runs",),
    "implicit_midpoint": ("runs", "symplectic runs"),
    "pinocchio: accelerations": ("pinocchio",),
    "lagrangian: accelerations": (),
    "oracle: accelerations": ("derivation",),
    "rodas5": ("runs",),
    "step": (),
    "batch": ("runs",),
    "save and load": ("runs",),
    "pickle and digest": (),
    "built anew": (),
}
#: Paths that take long: each model goes along one of them.
IN_TURN = (
    *("sampled control", "wrenches", "energy and power balance", "events", "moreau", "rk853", "gauss4", "radau"),
    *("program text", "function (CasADi)", "join", "lock", "linearize", "impact"),
    *("derivative of a step", "loads of joints", "loads of loops", "forces of actuators", "GPU (its driver replaced)"),
    *("operational space", "mass as a parameter", "lagrangian: derivatives", "pinocchio: derivatives", "baseline"),
    *(f"{engine}: M and inverse dynamics" for engine in ("mujoco", "pinocchio", "drake")),
)
#: And of these one model in so many: a compiler takes a third of the time of all paths.
SELDOM = {"C": 3}
SOUND = ("right", "refused", "left out", "not asked")
#: Kinds of a system that was written as energies, which has no parts beside them.
WRITTEN = ("energies", "written.row", "written.speed", "written.t")
NUMBERS_OF = {f"joint.{k}": x for k, x in NUMBERS.items()} | {"joint.stiction": STICTION}
NUMBERS_OF["joint.stop"] = NUMBERS["limit"] | {"stops": True}
#: What a kind is besides.
IMPLIED = {
    "joint.stiction": "joint.friction",
    "joint.stop": "joint.limit",
    "coupler.curve": "coupler",
    "coupler.several": "coupler",
    "force.of_time": "force.joint",
    "force.compensation.partial": "force.compensation",
}
#: A beam's root is fixed, its points mimic its end, and its numbers are those of joints.
OF_BEAMS = {"joint_type.fixed", "mimic", "joint.spring", "joint.limit", "gravity"}
#: Kinds that do not stand in one model.
APART = (("mimic", "force.compensation.partial"), ("joint_type.beam", "force.compensation.partial"))
SECTIONS = ("prescribed", "couplers", "couplings")
ON_A_JOINT = (
    *NUMBERS_OF,
    *(k for k in PARTS if kind(k).section in SECTIONS or k in ("mimic", "force.joint", "force.of_time")),
)
ONE, SEVERAL = (
    [x for x, t in JOINT_TYPES.items() if t.built_in and size(t.nv)] for size in (lambda n: n == 1, lambda n: n > 1)
)
SPOTS = ["fixed", *ONE, *SEVERAL]
#: Kinds of parts beside those of joints.
OTHERS = ("gravity", *(k for k in PARTS if k not in ON_A_JOINT), *WEIGHTS, *LIMBS, "joint_type.beam")
BINDING = ("mimic", "prescribed", "couplers")


def section(name: str) -> str:
    return name if name == "mimic" else kind(name).section


def binds(name: str) -> bool:
    return name in PARTS and section(name) in BINDING


@dataclass(frozen=True)
class Spot:
    """A joint: its type, and the kinds that stand on it; of the same ones what follows is found once."""

    type: str = "revolute"
    kinds: frozenset[str] = frozenset()

    @property
    @cache  # noqa: B019  # some hundred are different
    def leads(self) -> bool:
        return self.type in ONE and not any(map(binds, self.kinds))

    @property
    @cache  # noqa: B019  # some hundred are different
    def asks(self) -> int:
        """Other joints that its parts ask for."""
        counts = (2 if k == "coupler.several" else 1 for k in self.kinds if k in PARTS)
        return (
            max(counts, default=0) if any(section(k) in ("mimic", "couplers", "couplings") for k in self.kinds) else 0
        )

    @property
    @cache  # noqa: B019  # some hundred are different
    def free(self) -> int:
        held = sum(section(k) in BINDING for k in self.kinds if k in PARTS)
        return int(JOINT_TYPES[self.type].nv) - held

    @property
    @cache  # noqa: B019  # some hundred are different
    def acts(self) -> frozenset[str]:
        """All kinds that act on the joint, finer ones and its type too."""
        kinds = self.kinds - (NUMBERS_OF.keys() if self.type == "fixed" else set())
        out = {f"joint_type.{self.type}", *kinds, *(IMPLIED[k] for k in kinds if k in IMPLIED)}
        finer = (f"{k}.several" for k in [*out] if self.type in SEVERAL)
        return frozenset(out.union(k for k in finer if k in PART_KINDS))


@dataclass(frozen=True)
class Plan:
    """The kinds of a model, by joint; and those that stand elsewhere."""

    spots: tuple[Spot, ...] = ()
    others: tuple[str, ...] = ()
    paper: bool = False

    @property
    def size(self) -> int:
        return len({*self.others, *(f"joint_type.{s.type}" for s in self.spots)}.union(*(s.kinds for s in self.spots)))

    @cached_property
    def whole(self) -> Plan:
        """Return the plan with the hinges that its parts ask for, and one that nothing holds."""
        leads = sum(s.leads for s in self.spots)
        lack = [s.asks - leads + s.leads for s in self.spots]
        # A body's weight is held once.
        lack += [1 - sum(s.free for s in self.spots)]
        lack += [sum("compensation" in k for k in self.others) - sum(s.type != "fixed" for s in self.spots)]
        return replace(self, spots=(*self.spots, *[Spot()] * max(0, *lack)))

    @cached_property
    def acts(self) -> frozenset[str]:
        if self.paper:
            return frozenset(WRITTEN)
        limbs = [k for k in self.others if k in LIMBS]
        out = {*self.others, *(IMPLIED[k] for k in self.others if k in IMPLIED)}
        out |= {"joint_type.revolute"} if limbs else set()
        out |= {"joint_type.prismatic"} if any("loop" in k and k != "loop.distance" for k in limbs) else set()
        out |= {"joint_type.fixed"} if "body.rotor" in out else set()
        out |= OF_BEAMS if "joint_type.beam" in out else set()
        out |= {"gravity"} if out & {*WEIGHTS} else set()
        return frozenset(out).union(*(s.acts for s in self.whole.spots))


#: Equations on paper have terms in the place of parts.
PAPER = Plan((Spot(kinds=frozenset({"force.of_time"})),), ("loop.distance", "no_slip.blade"), paper=True)

# From a plan to a model


def built(name: str, plan: Plan, seed: int) -> Example:
    """Return the example of a plan, in a state in which rows are apart from each other and dry friction slides on."""
    # Where what rests on stops leaves no motion, these are far.
    tries = (_built(name, plan, np.random.default_rng([SEED, seed, k]), rest=k < 30) for k in range(60))
    out = next(x for x in tries if x)
    return kind_examples.on_paper(out) if plan.paper else out


def _built(name: str, plan: Plan, rng: np.random.Generator, *, rest: bool = False) -> Example | None:
    plan = plan.whole
    a, bodies, sites = Arm(name, gravity="gravity" in replace(plan, paper=False).acts, rng=rng), ["world"], []
    for spot in sorted(plan.spots, key=lambda s: "mimic" in s.kinds):
        # A tree now and then.
        parent = bodies[-1] if rng.random() < 0.75 else str(rng.choice(bodies))
        k = len(a.link)
        _add(a, spot, parent, rng, rest=rest)
        bodies.append(f"b{k}")
        sites += [(x, k, spot) for x in sorted(spot.kinds & {*PARTS} - {"mimic"})]
    leads = [j for j, s in zip(a.link, sorted(plan.spots, key=lambda s: "mimic" in s.kinds), strict=True) if s.leads]
    for x, k, _ in sorted(sites, key=lambda x: section(x[0]) != "prescribed"):
        others = [j for j in rng.permutation(leads) if j != f"j{k}"]
        PARTS[x](a, Site(f"{x.replace('.', '_')}_{k}", f"j{k}", tuple(map(str, others))))
    moving = [b for b in bodies[1:] if a.case.G[a.case.way(a.last[b])].any()]
    free = list(rng.permutation(moving))
    for x in sorted(set(plan.others) - {"gravity"}, key=lambda x: (x not in LIMBS, x)):
        # A weight is held once, and apart from a joint that it hangs on.
        body = moving[-1] if x in LIMBS else str(free.pop() if "compensation" in x else rng.choice(moving))
        way = a.case.way(a.last[body])
        at = Site(x.replace(".", "_"), next((j for j, *_ in a.joints if a.link[j] in way), "j0"), body=body)
        (PARTS | WEIGHTS | LIMBS | {"joint_type.beam": kind_examples.beam})[x](a, at)
    return _sliding(a, rng)


def _add(a: Arm, spot: Spot, parent: str, rng: np.random.Generator, *, rest: bool) -> None:
    k, several = len(a.link), spot.type in SEVERAL and spot.type != "ball"
    given = {f: x for name in sorted(spot.kinds) for f, x in NUMBERS_OF.get(name, {}).items()}
    numbers = {f: [x] * int(JOINT_TYPES[spot.type].nv) if several and x is not True else x for f, x in given.items()}
    if rest and "joint.stop" in spot.kinds and spot.type in ONE and not any(map(binds, spot.kinds)):
        numbers["lower"] = Arm.HERE
    if spot.type == "free":
        # A quaternion has no limits.
        numbers |= {
            f: [*numbers[f][:3], *[bound] * 4] for f, bound in (("lower", -np.inf), ("upper", np.inf)) if f in numbers
        }
    axis = rng.standard_normal(3)
    axes = kind_examples.AXES["universal"] if spot.type == "universal" else (axis / np.linalg.norm(axis),)
    one = [j for j, type_, _ in a.joints if type_ in ONE]
    mimic = {"mimic": (str(rng.choice(one)), 0.7, 0.2)} if "mimic" in spot.kinds else {}
    R = kind_examples.rotation(np.array([0.6, 0.0, 0.8]), rng.uniform(-1, 1))
    place = {"place": rng.uniform(-0.4, 0.4, 3), "R": R, "mass": rng.uniform(0.8, 2)}
    a.add(f"j{k}", spot.type, parent, f"b{k}", axes=axes, **place, **mimic, **numbers)


def _sliding(a: Arm, rng: np.random.Generator) -> Example | None:
    x = a.built()
    c = x.plain
    J = np.vstack([c.held(c.t, c.q), c.touched(c.q, 0 * c.v)])
    if len(J) and (len(J) > c.n or np.linalg.svd(J, compute_uv=False)[-1] < 0.1):
        return None
    rub = [k for j in x.model.joints if np.any(j.friction) for k in range(a.link[j.name], a.link[j.name] + j.type.nv)]
    for _ in range(30):
        rates = np.abs(c.G[rub] @ c.v)
        if not rub or (
            (rates > 0.15).all() and (rates > 0.04 * np.abs(c.G[rub] @ c.acceleration(c.t, c.q, c.v, x.tau))).all()
        ):
            return x
        c.v = c.allowed(c.t, c.q, rng.choice([-1.0, 1.0], c.n) * rng.uniform(0.4, 2.0, c.n))
    return None


# What can stand together


@cache
def refused(spot: Spot) -> str:
    """Return why a joint cannot have these kinds; empty if it can."""
    try:
        _built("trial", Plan((spot,)), np.random.default_rng(SEED))
    except MbkitError as error:
        return " ".join(str(error).split()).removeprefix("trial: ")
    return ""


@cache
def fits(spot: Spot) -> bool:
    """Return whether a joint can have these kinds, two by two."""
    binding = [k for k in spot.kinds if binds(k)]
    alone = (Spot(spot.type, frozenset([k])) for k in spot.kinds)
    together = (Spot("revolute", frozenset(two)) for two in combinations(binding, 2))
    return not any(map(refused, (*alone, *together)))


def base(name: str) -> str:
    return name.removesuffix(".several") if name in PART_KINDS and name.startswith("joint.") else name


@cache
def on_one_joint(a: str, b: str) -> tuple[Spot, ...] | str:
    """Return the joints that can have both kinds, or why there is none."""
    kinds = frozenset(base(x) for x in (a, b) if not x.startswith("joint_type."))
    spots = [Spot(t, kinds) for t in SPOTS]
    spots = [s for s in spots if {a, b} <= s.acts]
    out = tuple(s for s in spots if fits(s))
    if out:
        return out
    if not spots:
        return "a joint has one type, of no velocity, of one or of several"
    why = {s: next(filter(None, (refused(Spot(s.type, frozenset([k]))) for k in sorted(s.kinds))), "") for s in spots}
    spot = min(spots, key=lambda s: bool(why[s]))
    return why[spot] or refused(spot)


def reason(a: str, b: str) -> str:
    """Return why two kinds do not stand in one model; empty if they do."""
    if (a in WRITTEN) != (b in WRITTEN):
        return "a system that was written as energies has no parts beside them"
    if (a, b) not in APART and (b, a) not in APART:
        return ""
    try:
        _built(
            "trial",
            Plan((Spot(kinds=frozenset({"mimic"}) & {a, b}),), tuple({a, b} - {"mimic"})),
            np.random.default_rng(SEED),
        )
    except MbkitError as error:
        return " ".join(str(error).split()).removeprefix("trial: ")
    return ""


# The array

#: Kinds of parts and joint types that stand beside others, and those of joints. No path runs stops on paper.
NAMES = tuple(x for x in (*EXAMPLES, *TYPES) if x not in (*WRITTEN, "written.stop"))
JOINT_KINDS = tuple(x for x in NAMES if base(x) in ON_A_JOINT or (x in TYPES and x != "joint_type.beam"))


@dataclass(frozen=True)
class Array:
    """Plans that cover all pairs of kinds, in one model and of kinds of joints on one joint too.

    `apart` has the pairs that do not stand together, by the reason, with the joint's pairs apart; `hidden` has for a
    gate the pairs on one joint that bring a finer kind, which the gate refuses.
    """

    plans: tuple[Plan, ...]
    pairs: int
    on_joints: int
    apart: dict[str, list[tuple[str, str]]]
    apart_on_joints: dict[str, list[tuple[str, str]]]
    hidden: list[tuple[str, str, str]]


def kind_of(name: str) -> Kind:
    return replace(kind("joint_type.fixed"), name=name) if name == "joint_type.beam" else kind(name)


class _Search:
    """A greedy search: each plan begins with a pair that is not covered, and gains kinds while they cover more."""

    def __init__(self) -> None:
        gates = registered()
        self.names = ["", *dict.fromkeys(g for gates_ in PATHS.values() for g in gates_)]
        self.takes = {
            x: sum(1 << i for i, g in enumerate(self.names) if not g or gates[g].takes(kind_of(x))) for x in NAMES
        }
        self.apart = [(i, *two) for i, g in enumerate(self.names) if g for *two, _ in gates[g].apart]
        self.has = {x: {x, *kind_of(x).does} for x in NAMES}
        self.rng = random.Random(SEED)
        self.todo = {(*two, False): x for two in combinations(NAMES, 2) if (x := self.admitted(two))}
        self.joints = {two: on_one_joint(*two) for two in combinations(JOINT_KINDS, 2)}
        self.todo |= {(*two, True): self.admitted({*two}) for two, x in self.joints.items() if not isinstance(x, str)}
        self.order = {x: i for i, x in enumerate(NAMES)}
        #: Pairs that bring a third kind, or a type, that a gate refuses.
        self.hidden: list[tuple[str, str, str]] = []

    def admitted(self, kinds: Iterable[str]) -> int:
        """Return the gates that take all kinds, as bits."""
        out, has = (1 << len(self.names)) - 1, set().union(*(self.has[x] for x in kinds))
        if any({*two} <= has for two in APART):
            return 0
        for x in kinds:
            out &= self.takes[x]
        for i, a, b in self.apart:
            if a in has and b in has:
                out &= ~(1 << i)
        return out

    def covered(self, plan: Plan) -> dict[tuple[str, str, bool], int]:
        """Return what is new of the pairs of a plan."""
        acts = plan.acts
        gates = self.admitted(acts)
        out = {}
        for kinds, there in ((acts, False), *((s.acts, True) for s in plan.whole.spots)):
            for a, b in combinations(sorted(kinds, key=self.order.__getitem__), 2):
                if new := self.todo.get((a, b, there), 0) & gates:
                    out[a, b, there] = new
        return out

    def gain(self, plan: Plan) -> int:
        return sum(x.bit_count() for x in self.covered(plan).values())

    def begun(self, a: str, b: str, there: bool) -> Plan:
        """Return the least plan of a pair."""
        if there:
            return Plan((self.rng.choice([*self.joints[a, b]]),))
        spots = tuple(self.rng.choice(self.spots_of(x)) for x in (a, b) if x not in OTHERS)
        return Plan(spots, tuple(x for x in (a, b) if x in OTHERS))

    def spots_of(self, x: str) -> list[Spot]:
        if x.startswith("joint_type."):
            return [Spot(x.removeprefix("joint_type."))]
        many = x.endswith(".several") and x.startswith("joint.")
        out = [Spot(t, frozenset([base(x)])) for t in (SEVERAL if many else ONE)]
        return [s for s in out if fits(s)]

    @cache  # noqa: B019  # one search lives as long as its process
    def taken(self, gates: int) -> list[str]:
        return [x for x in NAMES if self.takes[x] & gates]

    def more(self, plan: Plan, gates: int) -> Plan:
        """Return the plan with one more kind."""
        x = self.rng.choice(self.taken(gates))
        if x in OTHERS:
            if x in plan.others or (x in LIMBS and any(k in LIMBS for k in plan.others)):
                return plan
            return replace(plan, others=(*plan.others, x))
        k = self.rng.randrange(len(plan.spots) + 1)
        if k == len(plan.spots) or x.startswith("joint_type."):
            return replace(plan, spots=(*plan.spots, self.rng.choice(self.spots_of(x))))
        new = replace(plan.spots[k], kinds=plan.spots[k].kinds | {base(x)})
        return replace(plan, spots=(*plan.spots[:k], new, *plan.spots[k + 1 :])) if fits(new) else plan

    def grown(self, plan: Plan, gate: int) -> Plan:
        best = self.gain(plan)
        while plan.size < MOST_KINDS:
            tries = [self.more(plan, gate) for _ in range(ADDITIONS)]
            gains = [(self.gain(x), -i) for i, x in enumerate(tries) if self.admitted(x.acts) & gate]
            if not gains or max(gains)[0] <= best:
                break
            best, i = max(gains)
            plan = tries[-i]
        return plan

    def plans(self) -> Iterable[Plan]:
        # What few paths take comes first, as it counts for the others too.
        bits = sorted(range(len(self.names)), key=lambda i: sum(x >> i & 1 for x in self.takes.values()))
        for i in bits:
            left = [x for x, gates in self.todo.items() if gates >> i & 1]
            self.rng.shuffle(left)
            for two in left:
                if not self.todo[two] >> i & 1:
                    continue
                begun = [x for _ in range(40) if self.covered(x := self.begun(*two)).get(two, 0) >> i & 1]
                tries = [self.grown(x, 1 << i) for x in begun[:CANDIDATES]]
                if not tries:
                    self.hidden.append((self.names[i], *two[:2]))
                    continue
                gains = [self.gain(x) for x in tries]
                plan = tries[gains.index(max(gains))]
                for x, gates in self.covered(plan).items():
                    self.todo[x] &= ~gates
                yield plan.whole


@cache
def array() -> Array:
    """Return the covering array, the same on every machine."""
    search = _Search()
    asked = len(search.todo)
    plans = (*search.plans(), PAPER)
    here, there = dict[str, list[tuple[str, str]]](), dict[str, list[tuple[str, str]]]()
    for two in combinations((*WRITTEN, *NAMES), 2):
        if why := reason(*two):
            here.setdefault(why, []).append(two)
    for two, spots in search.joints.items():
        if isinstance(spots, str):
            there.setdefault(spots, []).append(two)
    on_joints = len(search.joints) - sum(map(len, there.values()))
    pairs = asked - on_joints + len(WRITTEN) * (len(WRITTEN) - 1) // 2
    return Array(plans, pairs, on_joints, here, there, search.hidden)


def acts(model: mb.Model) -> frozenset[str]:
    """Return the kinds that act in a model, a beam's by one name; coordinates of energies are of no joint."""
    found = {"joint_type.beam" if x.startswith("joint_type.beam_") else x for x in model.acts}
    return frozenset(x for x in found if model.has_bodies or not x.startswith("joint_type."))


# Cells


def names() -> tuple[str, ...]:
    """Return the names of the models, which `kind_examples.example` knows from now on."""
    for k, plan in enumerate(array().plans):
        TOGETHER.setdefault(f"pairs.{k}", lambda name, plan=plan, k=k: built(name, plan, k))
    return tuple(f"pairs.{k}" for k in range(len(array().plans)))


def paths(name: str) -> tuple[str, ...]:
    """Return the paths of a model: those of all models, and one of the others in turn."""
    k = int(name.removeprefix("pairs."))
    return (*(p for p in PATHS if k % SELDOM.get(p, 1) == 0), IN_TURN[k % len(IN_TURN)])


def pair_cell(name: str, path: str, folder: Path) -> Cell:
    """Return what comes of a model on a path; a refusal has to name each part that the gate does not take."""
    out, model, gates = told(name, path, folder), kind_examples.example(name).model, registered()
    # An engine's own gate speaks before that of one of its quantities.
    asked = {*PATHS.get(path, ()), *COLUMNS[path].gates, *({path.partition(":")[0]} & {*gates})}
    refusing = [gates[g] for g in asked if gates[g].refuses(model)]
    if refusing and out.outcome in ("right", "left out"):
        return Cell("silent", out.error, f"the gate {refusing[0].name!r} refuses it")
    unnamed = [_unnamed(g, model, out.text) for g in refusing]
    if out.outcome == "refused" and unnamed and all(unnamed):
        return Cell("unnamed", text=f"{unnamed[0]}: {out.text}")
    return out


def _unnamed(gate: Gate, model: mb.Model, text: str) -> list[str]:
    """Return the parts that a gate does not take and its refusal does not name; none where another gate spoke first."""
    lost = [k for k in map(kind, model.acts) if not gate.takes(k)]
    leaders = {p.name for k in lost if "q" in k.does for p in k.parts(model)}
    parts = [
        (k, p) for k in lost for p in k.parts(model) if not ("q" in k.does and p.mimic and p.mimic.joint in leaders)
    ]
    # Of several kinds of one part the finest is told.
    said = {id(p) for k, p in parts if k.words.format(p=p) in text}
    return [k.words.format(p=p) for k, p in parts if said and id(p) not in said]


def summary(cells: Iterable[tuple[str, str, Cell]]) -> dict[str, Any]:
    """Return what is recorded of the array, and of its cells by (name, path, cell)."""
    cells, found = list(cells), array()
    return {
        "models": len(found.plans),
        "pairs": found.pairs,
        "on_joints": found.on_joints,
        "apart": found.apart,
        "apart_on_joints": found.apart_on_joints,
        "hidden": found.hidden,
        "paths": [*PATHS],
        "in_turn": [*IN_TURN],
        "counts": dict(Counter(c.outcome for *_, c in cells)),
        "cells": dict(Counter(p for _, p, _ in cells)),
        "faults": [
            [sorted(acts(kind_examples.example(n).model)), p, c.outcome, c.text[:160]]
            for n, p, c in cells
            if c.outcome not in SOUND
        ],
    }
