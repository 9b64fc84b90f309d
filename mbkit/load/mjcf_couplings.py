"""Tendons and actuators of an MJCF as springs, dampers and rotors (XML reference of MuJoCo 4.0).

A fixed tendon of length l = Σ coef q becomes a `JointCoupling`, or numbers of its only joint. A spatial tendon straight
between two sites becomes a `PointSpring`. Springs and dampers over several sites, between two rest lengths, or with
polynomials become forces by functions. A path around geoms that acts, and an inertia on a path, are refused. The length
of an actuator is gear times a joint's coordinate or a tendon's length; its force at zero control and activation is b0 +
b1 l + b2 dl/dt with `biasprm` (b0, b1, b2): a spring of stiffness -b1 and rest length -b0/b1, and a damper -b2. These
act where the file is read with its actuators; without, a rotor's inertia and the damping of the transmission act alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import MAX_MAGNITUDE, Array
from mbkit.load.mjcf_reader import MjcfJoint, Scene
from mbkit.load.xml_reader import Element, element_text, reserved
from mbkit.model import GravityCompensation, Joint, JointCoupling, Model, ModelBuilder, PointSpring
from mbkit.model.description import LEFT_OUT, SERVOS
from mbkit.model.elements.forces import RATE
from mbkit.model.validation import sample_mass_matrix

_ACTUATORS: Final = (
    *("general", "motor", "position", "velocity", "intvelocity", "damper"),
    *("cylinder", "muscle", "adhesion", "dcmotor", "pid", "plugin"),
)
#: Nonlinear limits and losses of a tendon, and the attribute that switches each on.
_TENDON_LIMITS: Final = {
    "range": "limited",
    "frictionloss": "",
    "springyield": "",
    "actuatorfrcrange": "actuatorfrclimited",
}
#: Attributes of up to three numbers: of a damper and of a spring.
_POLYNOMIALS: Final = ("damping", "stiffness")
_Numbers = tuple[float, ...]
_NONE: Final[_Numbers] = (0.0, 0.0, 0.0)
#: Bodies and points on them.
_Points = tuple[tuple[str, Array], ...]
#: Parts that equality constraints bind.
_ENDS: Final = ("joint", "body", "tendon", "site", "flex")
#: Attributes that name something.
_NAMES: Final = frozenset({"name", "class", "joint", "jointinparent", "tendon", "body", "site", "refsite"})


@dataclass(frozen=True)
class _Actuator:
    """An actuator's settings, with those of its default classes, as MuJoCo's parser has them in its `mjsActuator`."""

    gaintype: str
    biastype: str
    gain: float
    bias: _Numbers
    gear: float
    damping: _Numbers
    armature: float
    group: float
    #: By attribute; 0 0 where there is none.
    ranges: Mapping[str, _Numbers]

    @classmethod
    def of(cls, text: str, tag: str) -> _Actuator:
        """Return the only actuator of an MJCF; ValueError where MuJoCo's parser refuses it."""
        # Imported late: few files have actuators.
        import mujoco

        own = mujoco.MjSpec.from_string(text).actuators[0]
        numbers = own.biasprm[:3], own.damping, own.ctrlrange, own.forcerange, own.gainprm[:1], own.gear[:1]
        if not np.isfinite([*np.concatenate(numbers), own.armature]).all():
            raise ValueError("numbers that are not finite")
        bias, damping, control, force, (gain,), (gear,) = (tuple(x.tolist()) for x in numbers)
        gaintype, biastype = (x.name.partition("_")[2].lower() for x in (own.gaintype, own.biastype))
        if tag == "plugin":
            gaintype = biastype = tag
        ranges = {"posrange" if tag == "pid" else "ctrlrange": control}
        if own.forcelimited != mujoco.mjtLimited.mjLIMITED_FALSE:
            ranges["forcerange"] = force
        gain = -bias[1] if gaintype == "pid" else gain
        return cls(gaintype, biastype, gain, bias, gear, damping, own.armature, own.group, ranges)


@dataclass(frozen=True)
class _Band:
    """A spring -x (k0 + k1 x + k2 x²), with x from the nearer one of two lengths, between which it rests."""

    stiffness: _Numbers
    lower: float
    upper: float

    def energy(self, length: Any) -> Any:
        """Return the energy at a length."""
        beyond, short = length - self.upper, self.lower - length
        x = (beyond + abs(beyond)) / 2 - (short + abs(short)) / 2
        k0, k1, k2 = self.stiffness
        return k0 / 2 * x**2 + k1 / 3 * x**3 + k2 / 4 * x**4

    def __str__(self) -> str:
        numbers = " ".join(f"{x:g}" for x in self.stiffness)
        return f"stiffness {numbers}, rest length {self.lower:g} to {self.upper:g}"


@dataclass
class Acting:
    """The forces of a tendon or an actuator."""

    item: str  # its name, or its number and its line
    name: str  # of the coupling
    factors: dict[str, float] = field(default_factory=dict)  # joint -> dl/dq; empty where l is no sum of coordinates
    stiffness: float = 0.0
    rest_length: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    dampratio: float = 0.0  # of the critical damping at the pose of the file
    #: Branches over sites, each with the factor of its length in l.
    path: tuple[tuple[float, _Points], ...] = ()
    band: _Band | None = None  # a spring by a function
    damper: _Numbers | None = None  # by a function: -(c0 + c1 |dl/dt| + c2 (dl/dt)²) dl/dt
    measured: bool = False  # whether the rest length is that of the path where the springs of joints rest
    control: str = ""  # description of an actuator's control, which is left out
    servo: str = ""  # description of its force at zero control
    left_out: list[str] = field(default_factory=list)

    @property
    def acts(self) -> bool:
        """Whether it has a linear spring or damper, or a rotor."""
        return bool(self.stiffness or self.damping or self.armature or self.dampratio)

    @property
    def ends(self) -> _Points:
        """Bodies and points whose distance is l, if any."""
        ((factor, points),) = self.path if len(self.path) == 1 else ((0.0, ()),)
        return points if factor == 1 and len(points) == 2 and points[0][0] != points[1][0] else ()

    def linear(self) -> None:
        """Move to `left_out` all but springs and dampers on sums of coordinates."""
        for name in ("stiffness", "damping", "dampratio"):
            value = getattr(self, name)
            if value < 0 or (value and not self.factors):
                self.left_out.append(f"{name} {value:g}" + (", which is negative" if value < 0 else ""))
                setattr(self, name, 0.0)

    def coupling(self) -> JointCoupling:
        """Return it as a coupling of joints; its damping ratio is not in it."""
        numbers = self.stiffness, self.rest_length, self.damping, self.armature
        return JointCoupling(self.name, tuple(self.factors), np.array([*self.factors.values()]), *numbers)

    def part(self) -> PointSpring | JointCoupling:
        """Return it as a spring between two points, or as a coupling of joints."""
        if not self.ends:
            return self.coupling()
        (a, at_a), (b, at_b) = self.ends
        return PointSpring(self.name, a, at_a, b, at_b, self.stiffness, self.rest_length, self.damping)

    def functions(self) -> str:
        """Return what acts by functions, for a note."""
        damper = self.damper and f"damping {' '.join(f'{c:g}' for c in self.damper)}"
        return ", ".join(str(x) for x in (self.band, damper) if x)

    def description(self) -> str:
        """Return its name and its effect, for a note."""
        if self.ends:
            spring = f"stiffness {self.stiffness:g}, rest length {self.rest_length:g}, " if self.stiffness else ""
            return f"{self.item} between {self.ends[0][0]!r} and {self.ends[1][0]!r}: {spring}damping {self.damping:g}"
        ratio = f", damping ratio {self.dampratio:g}" if self.dampratio else ""
        return f"{self.item}{str(self.coupling()).removeprefix(f'coupling {self.name!r}')}{ratio}"


class Transmissions:
    """Reads the tendons and actuators of a file; its option flags switch `disabled` off.

    `servos` says whether actuators exert their force at zero control.
    """

    def __init__(self, mujoco: Element, scene: Scene, disabled: set[str], *, servos: bool) -> None:
        self._scene, self._read, self._disabled, self._servos = scene, scene.read, disabled, servos
        self._joints: dict[str, MjcfJoint] = {j.name: j for body in scene.bodies for j in body.joints}
        self._names: set[str] = set()
        self._defaults = "".join(map(_defaults, mujoco.all("default")))
        self._groups: set[float] = set()
        for option in mujoco.all("option"):
            self._groups |= {
                *self._read.numbers(option, "actuatorgroupdisable", "the file", count=31, least=0, default=())
            }
        self._sites = {site: ("world", X.p) for site, X in scene.sites}
        self._sites |= {site: (body.name, X.p - body.anchor) for body in scene.bodies for site, X in body.sites}

        def inside(section: str) -> list[tuple[Element, str]]:
            elements = (e for s in mujoco.all(section) for e in s.children)
            return [(e, element_label(e, k)) for k, e in enumerate(elements, 1)]

        tendons = inside("tendon")
        self._tendons = [self._tendon(e, label, k) for k, (e, label) in enumerate(tendons, 1)]
        self._known = {e.attributes.get("name", ""): t for (e, _), t in zip(tendons, self._tendons, strict=True)}
        #: dl/dq by joint of each tendon; nothing where its length is no sum of coordinates.
        self.factors = {name: t.factors for name, t in self._known.items()}
        self._actuators = [self._actuator(e, label, k) for k, (e, label) in enumerate(inside("actuator"), 1)]

    def _acting(self, element: Element, label: str, kind: str, number: int) -> Acting:
        return Acting(label, reserved(element.attributes.get("name") or f"{kind}{number}", self._names))

    # Tendons

    def _tendon(self, element: Element, label: str, number: int) -> Acting:
        read, item = self._read, f"tendon {label}"
        full = replace(self._scene.defaults.filled(replace(element, tag="tendon"), None), tag=element.tag)
        out = self._acting(element, label, "tendon", number)
        factors: dict[str, float] = {}
        for part in element.all("joint") if element.tag == "fixed" else []:
            name = part.attributes.get("joint", "")
            joint = self._joints.get(name)
            if joint is not None and joint.scalar:
                factors[name] = factors.get(name, 0.0) + read.number(part, "coef", item)
                continue
            what = "is not in the file" if joint is None else f"is a {joint.kind} joint"
            read.fault(f"{item}: expected the name of a hinge or slide, joint {name!r} {what}", part)
        out.factors = {joint: factor for joint, factor in factors.items() if factor}
        if element.tag == "spatial":
            out.path = self._path(element, item)
        c, k = ((*read.numbers(full, n, item, count=3, least=1, default=(0.0,)), *_NONE)[:3] for n in _POLYNOMIALS)
        out.armature = read.number(full, "armature", item, 0.0)
        first, *second = read.numbers(full, "springlength", item, count=2, least=1, default=(-1.0,))
        last = second[0] if second else first
        if first == last == -1.0:
            # The length of a path is measured once there is a tree.
            out.measured = any(k) and bool(out.path)
            first = last = sum(factor * self._joints[joint].rest for joint, factor in out.factors.items())
        self._hold(out, element, item, c, k, first, last)
        own = full.attributes
        out.left_out += [f"{n} {own[n]}" for n, on in _TENDON_LIMITS.items() if n in own and own.get(on) != "false"]
        return out

    def _hold(self, out: Acting, element: Element, item: str, c: _Numbers, k: _Numbers, *rest: float) -> None:
        """Give a tendon or actuator its damper and spring, by functions where they are not linear, or keep a fault."""
        linear, has_length = bool(out.factors or out.ends), bool(out.factors or out.path)
        k, c = (_NONE if flag in self._disabled else x for x, flag in ((k, "spring"), (c, "damper")))
        if any(k[1:]) or k[0] < 0 or (k[0] and not (linear and rest[0] == rest[1] and (out.factors or rest[0] >= 0))):
            out.band = _Band(k, *rest)
        else:
            out.stiffness, out.rest_length = k[0], rest[0]
        if any(c[1:]) or c[0] < 0 or (c[0] and not linear):
            out.damper = c
        else:
            out.damping = c[0]
        unheld = {"stiffness": out.band and not has_length, "damping": out.damper and not has_length}
        for what in (n for n, x in (unheld | {"armature": out.armature and not out.factors}).items() if x):
            of = "a path over sites is an inertia that changes with q" if out.path else "what is no sum of coordinates"
            self._read.fault(f"{item}: {what} of {of}; no description holds it, remove it", element)

    def _path(self, element: Element, item: str) -> tuple[tuple[float, _Points], ...]:
        """Return the branches of a path over sites; none where it wraps geoms."""
        branches: list[tuple[float, list[Any]]] = [(1.0, [])]
        for part in element.children:
            if part.tag == "pulley":
                branches.append((1 / (self._read.number(part, "divisor", item) or 1.0), []))
            elif (site := self._sites.get(part.attributes.get("site", ""))) is None:
                return ()
            else:
                branches[-1][1].append(site)
        return tuple((factor, tuple(points)) for factor, points in branches if len(points) > 1)

    # Actuators

    def _actuator(self, element: Element, label: str, number: int) -> Acting:
        item = f"actuator {label}"
        out = self._acting(element, label, "actuator", number)
        if (settings := self._settings(element, item)) is None:
            return out
        out.armature, gear, (c0, c1, c2) = settings.armature, settings.gear, settings.damping
        driven = self._driven(element, item)
        out.factors = {joint: gear * c for joint, c in driven.factors.items() if gear * c}
        out.path = tuple((gear * factor, points) for factor, points in driven.path if gear * factor)
        # MuJoCo's polynomial is of the rate before the gear.
        out.armature *= bool(gear)
        self._hold(out, element, item, (c0, c1 / abs(gear), c2 / gear**2) if gear else _NONE, _NONE, 0.0, 0.0)
        gain = f"gain {settings.gain:g}" if settings.gaintype == "fixed" else f"{settings.gaintype} gain"
        limits = "".join(f" {x:g}" for x in settings.ranges.get("ctrlrange", ()) if any(settings.ranges["ctrlrange"]))
        at = out.coupling().length if out.factors else element.attributes.get("tendon", "no sum of coordinates")
        out.control = f"{label} ({element.tag}, {gain}{f', range{limits}' if limits else ''}) on {at}"
        if "actuation" not in self._disabled and settings.group not in self._groups:
            servo = Acting(out.item, out.name, out.factors)
            _add_bias(settings, servo)
            servo.linear()
            if servo.acts or servo.left_out:
                out.servo = servo.description()
            if self._servos:
                names = ("stiffness", "rest_length", "damping", "dampratio")
                for name in names:
                    setattr(out, name, getattr(out, name) + getattr(servo, name))
                out.left_out += servo.left_out
        return out

    def _settings(self, element: Element, item: str) -> _Actuator | None:
        """Return an actuator's settings, or keep a fault."""
        name = self._scene.defaults.known(element.attributes.get("class"), element)
        own = {k: x for k, x in element.attributes.items() if k != "class"} | ({"class": name} if name else {})
        numbers = [word for k, x in own.items() if k not in _NAMES for word in x.lower().split()]
        try:
            # MuJoCo takes them, with a warning in a file.
            if not {"nan", "inf"}.isdisjoint(word.lstrip("+-") for word in numbers):
                raise ValueError("numbers that are not finite")
            one = element_text(element.tag, own)
            return _Actuator.of(f"<mujoco>{self._defaults}<actuator>{one}</actuator></mujoco>", element.tag)
        except ValueError as error:
            self._read.fault(f"{item}: MuJoCo's parser refuses: {' '.join(str(error).split())}", element)
            return None

    def _driven(self, element: Element, item: str) -> Acting:
        """Return what has the length before the gear."""
        own = element.attributes
        name, tendon = own.get("jointinparent", own.get("joint", "")), own.get("tendon")
        # The last one wins in MuJoCo, in this order: joint, tendon, site or body.
        if any(x in own for x in ("cranksite", "site", "body")):
            return Acting(item, "")
        if tendon is not None and tendon not in self._known:
            self._read.fault(f"{item}: tendon {tendon!r} is not in the file", element)
        if name and name not in self._joints:
            self._read.fault(f"{item}: joint {name!r} is not in the file", element)
        out = Acting(item, name, {name: 1.0} if name in self._joints and self._joints[name].scalar else {})
        return out if tendon is None else self._known.get(tendon, out)

    # Their effect on the model

    @property
    def functions(self) -> list[Acting]:
        """Tendons and actuators that act by functions, or have a rest length to be measured."""
        return [x for x in (*self._tendons, *self._actuators) if x.band or x.damper or x.measured]

    def add_functions(self, b: ModelBuilder, model: Model) -> None:
        """Measure rest lengths, and add springs and dampers by functions of a model's q and v.

        All act along dl/dq: springs as potentials, dampers joint by joint.
        """
        # Imported late: few files need it.
        import casadi as ca

        rates = [name + RATE for name in model.velocity_names]
        q, v = (ca.vertcat(*map(ca.SX.sym, names)) for names in (model.coordinate_names, rates))
        for x in self.functions:
            if x.measured:
                x.rest_length = float(_length(x, model, np, self._resting(model)))
                x.band = x.band and replace(x.band, lower=x.rest_length, upper=x.rest_length)
            if not x.functions():
                continue
            along = _length(x, model, ca, ca.vertsplit(q))
            gradient, rows, rate = ca.gradient(along, q), {}, ca.SX(0)
            for joint in model.joints:
                q_slice, v_slice = model.layout.q[joint.name], model.layout.v[joint.name]
                part = ca.vertsplit(gradient[q_slice]) if joint.type.nv else []
                if any(not entry.is_zero() for entry in part):
                    coordinates = ca.vertsplit(q[q_slice])
                    rows[joint.name] = joint.type.pullback(coordinates, part)
                    qdot = joint.type.qdot(coordinates, ca.vertsplit(v[v_slice]))
                    rate += ca.dot(gradient[q_slice], ca.vertcat(*qdot))
            if x.band and rows:
                b.add_joint_force(f"spring of tendon {x.name}", next(iter(rows)), potential=x.band.energy(along))
            c0, c1, c2 = x.damper or (0.0, 0.0, 0.0)
            for name, row in rows.items() if x.damper else ():
                pull = -(c0 + c1 * abs(rate) + c2 * rate**2) * rate
                b.add_joint_force(f"damper of {x.name} at {name}", name, [pull * entry for entry in row])

    def applied(self, model: Model) -> Model:
        """Return the model with these springs, dampers and rotors, and with notes on them and on parts left out."""
        acting = [x for x in (*self._tendons, *self._actuators) if x.acts]
        out = with_parts(model, [x.part() for x in acting])
        ratios = []
        for x in acting:
            if x.dampratio:
                # Relative to the critical damping of the inertia that the actuator moves in the pose of the file.
                damping = 2 * x.dampratio * float(np.sqrt(x.stiffness * self._reflected(out, x.coupling())))
                ratios.append(replace(x.coupling(), stiffness=0.0, armature=0.0, damping=damping))
        out = with_parts(out, ratios)
        notes = [*model.notes, *self._notes()]
        if branched := ", ".join(repr(c.name) for c in out.couplings if c.armature and out.branched(c)):
            notes.append(f"the armature of {branched} acts between branches; MuJoCo 4.0 leaves it out of M there")
        return replace(out, notes=tuple(notes))

    def _resting(self, model: Model) -> Array:
        """Return q where the springs of all joints rest; MuJoCo's ``qpos_spring``."""
        q = model.neutral()
        for body in self._scene.bodies:
            for joint in body.joints:
                at = model.layout.q[joint.name]
                if joint.scalar:
                    q[at] = joint.rest
                elif joint.kind == "free":
                    q[at] = *body.pose.p, *spatial.quaternion_from_matrix(body.pose.R)
        return q

    def _reflected(self, model: Model, coupling: JointCoupling) -> float:
        """Return the inertia that a coupling's length moves in the pose of the file; 0 where M is singular for it."""
        q = model.neutral()
        for name, joint in self._joints.items():
            if joint.scalar:
                q[model.layout.q[name]] = joint.ref
        row = model.layout.coupling_row(coupling) @ model.layout.G
        M = sample_mass_matrix(model, q)
        root = np.sqrt(np.diag(M))
        if not root.all():
            return 0.0
        # Scaled to a unit diagonal, so that masses of very different sizes keep their digits.
        row = row / root
        mobility = float(row @ np.linalg.lstsq(M / np.outer(root, root), row, rcond=None)[0])
        return 1 / mobility if mobility > 0 else 0.0

    def _notes(self) -> Iterator[str]:
        if (servos := [x for x in self._actuators if x.servo]) and self._servos:
            yield f"{SERVOS} act at zero control: {', '.join(x.item for x in servos)}"
        elif servos:
            forces = "; ".join(x.servo for x in servos)
            yield f"{SERVOS} left out; with actuators=True they act at zero control: {forces}"
        for what, at, group in (("tendons", "", self._tendons), ("actuators", ", at zero control", self._actuators)):
            if bands := "; ".join(f"{x.item}: {x.functions()}" for x in group if x.functions()):
                yield f"springs of {what}, and dampers, by functions: {bands}"
            if acting := "; ".join(x.description() for x in group if x.acts):
                yield f"{what} that act as springs, dampers and rotors{at}: {acting}"
            if left_out := "; ".join(f"{x.item}: {', '.join(x.left_out)}" for x in group if x.left_out):
                yield f"{LEFT_OUT} of {what}: {left_out}"
            if idle := ", ".join(x.item for x in group if not (x.acts or x.functions() or x.left_out or x.control)):
                yield f"{what} that exert no force of their own: {idle}"
        if self._actuators:
            controls = "; ".join(x.control for x in self._actuators)
            yield f"controls of actuators were left out, give their forces as tau: {controls}"


def _length(x: Acting, model: Model, m: Any, q: Any) -> Any:
    """Return the length of a tendon or an actuator, in the arithmetic of `m`."""
    total = sum(factor * q[model.layout.q[name].start] for name, factor in x.factors.items())
    # Joints that move all points along leave distances as they are.
    joints = [model.moving(body) for _, points in x.path for body, _ in points]
    shared = frozenset.intersection(*joints) if joints else frozenset()
    here: tuple[Any, Any] = np.eye(3, dtype=object), np.zeros(3, dtype=object)
    places = {"world": here}
    for link in model.tree:
        R, p = link.type.placement(m, link, list(q[model.layout.q[link.name]]))
        # Products of arrays of objects hold any arithmetic's numbers.
        R_P, p_P = places[link.parent]
        R_J, p_J = R_P @ link.rotation.astype(object), p_P + R_P @ link.translation.astype(object)
        moved = R_J @ np.array(R, dtype=object), p_J + R_J @ np.array(p, dtype=object)
        places[link.child] = here if link.name in shared else moved
    for factor, points in x.path:
        ends = [places[body][1] + places[body][0] @ point.astype(object) for body, point in points]
        total += factor * sum(m.sqrt(((b - a) ** 2).sum()) for a, b in pairwise(ends))
    return total


def with_parts(model: Model, parts: Sequence[PointSpring | JointCoupling | GravityCompensation]) -> Model:
    """Return the model with more parts; a coupling of a single joint becomes numbers of that joint.

    Dampings of couplings of one name add. Two springs on one joint become one; a constant energy is left out.
    """
    joints: dict[str, Joint] = {j.name: j for j in model.joints}
    couplings = {c.name: c for c in model.couplings}
    for c in (x for x in parts if isinstance(x, JointCoupling)):
        if len(c.joints) > 1:
            known = couplings.get(c.name)
            couplings[c.name] = c if known is None else replace(known, damping=known.damping + c.damping)
            continue
        joint, factor = joints[c.joints[0]], float(c.factors[0])
        stiffness = joint.stiffness + factor**2 * c.stiffness
        pull = joint.stiffness * joint.rest + factor * c.stiffness * c.rest_length
        joints[joint.name] = replace(
            joint,
            stiffness=stiffness,
            rest=np.divide(pull, stiffness, out=np.array(joint.rest), where=stiffness > 0),
            damping=joint.damping + factor**2 * c.damping,
            armature=joint.armature + factor**2 * c.armature,
        )
    return replace(
        model,
        joints=tuple(joints.values()),
        couplings=tuple(couplings.values()),
        springs=(*model.springs, *(x for x in parts if isinstance(x, PointSpring))),
        forces=(*model.forces, *(x for x in parts if isinstance(x, GravityCompensation))),
    )


def _add_bias(settings: _Actuator, out: Acting) -> None:
    """Add an actuator's force at zero control and activation."""
    for what, (low, high) in settings.ranges.items():
        acts = low > 0 or high < 0 or (what == "forcerange" and settings.biastype != "none" and any(settings.bias))
        if acts and high > low:
            out.left_out.append(f"{what} {low:g} {high:g}")
    if settings.biastype == "none":
        return
    if settings.biastype != "affine":
        out.left_out.append(f"the force of a {settings.biastype}")
        return
    b0, b1, b2 = settings.bias
    rest = -b0 / b1 if b1 else 0.0
    if abs(rest) <= MAX_MAGNITUDE:
        out.stiffness, out.rest_length = -b1, rest
    if b0 and (b1 >= 0 or abs(rest) > MAX_MAGNITUDE):
        out.left_out.append(f"the constant force {b0:g}")
    if b2 > 0 and settings.gain == -b1 and settings.gaintype in ("fixed", "pid"):
        out.dampratio = b2
    elif b2 <= 0:
        out.damping -= b2
    else:
        out.left_out.append(f"the force {b2:g} times the rate")


def _defaults(element: Element) -> str:
    """Return the default classes of actuators as text."""
    inside = (
        _defaults(e) if e.tag == "default" else element_text(e.tag, e.attributes)
        for e in element.children
        if e.tag in ("default", *_ACTUATORS)
    )
    return element_text("default", element.attributes, "".join(inside))


def bound_parts(element: Element) -> str:
    """Return the parts that an equality constraint binds."""
    ends = (f"{k} {v!r}" for k, v in element.attributes.items() if k.rstrip("12") in _ENDS)
    return ", ".join([element.tag, *ends])


def element_label(element: Element, number: int) -> str:
    """Return its name, or its number and its place."""
    name = element.attributes.get("name", "")
    return repr(name) if name else f"number {number} ({element.tag}, {element.place})"
