"""Tendons and actuators of an MJCF as linear springs, dampers and rotors (XML reference of MuJoCo 4.0).

A fixed tendon of length l = Σ coef q becomes a `JointCoupling`, or numbers of its only joint. A spatial tendon straight
between two sites becomes a `PointSpring`. The length of an actuator is gear times a joint's coordinate or a tendon's
length; its force at zero control and activation is b0 + b1 l + b2 dl/dt with `biasprm` (b0, b1, b2): a spring of
stiffness -b1 and rest length -b0/b1, and a damper -b2. These act where the file is read with its actuators; without,
a rotor's inertia and the damping of the transmission act alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit._reproducible import length
from mbkit.load.mjcf_attributes import HERE, Pose
from mbkit.load.mjcf_reader import MjcfJoint, Scene
from mbkit.load.xml_reader import LARGEST, Element, Reader, unused
from mbkit.model import Joint, JointCoupling, Model, ModelBuilder, PointSpring
from mbkit.model.description import SERVOS
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
#: Parts that equality constraints bind.
_ENDS: Final = ("joint", "body", "tendon", "site", "flex")
#: Attributes that every actuator inherits from its default classes: most and fewest numbers, and their default.
_INHERITED: Final[Mapping[str, tuple[int, int, tuple[float, ...]]]] = {
    "gear": (6, 1, (1.0,)),
    "armature": (1, 1, (0.0,)),
    "damping": (3, 1, (0.0,)),
    "group": (1, 1, (0.0,)),
    "forcerange": (2, 2, ()),
    "ctrlrange": (2, 2, ()),
}


@dataclass(frozen=True)
class _Actuator:
    """An actuator's settings, with those of its default classes, as in MuJoCo's `mjsActuator`.

    Gain, bias and their types come from a <general> or an element of the same tag only, those of <pid> from a <pid>
    only. `tag` is that of the last element of a class, and `parent` the class that it inherits.
    """

    tag: str = "general"
    parent: _Actuator | None = None
    gain: float = 1.0
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gaintype: str = "fixed"
    biastype: str = "none"
    forcelimited: str = "auto"
    numbers: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: {n: x[2] for n, x in _INHERITED.items()})

    def with_element(self, element: Element, item: str, read: Reader) -> _Actuator:
        """Return these settings, changed by an element's attributes."""
        own, tag = element.attributes, element.tag

        def number(name: str, default: float) -> float:
            return read.number(element, name, item, default)

        base = self
        while tag != "general" and base.tag not in (("pid",) if tag == "pid" else (tag, "general")):
            base = base.parent or _Actuator(tag=tag)
        gain, (b0, b1, b2), gaintype, biastype = base.gain, base.bias, base.gaintype, base.biastype
        if tag == "general":
            gain = read.numbers(element, "gainprm", item, count=10, least=1, default=(gain,))[0]
            bias = read.numbers(element, "biasprm", item, count=10, least=1, default=base.bias)[:3]
            b0, b1, b2 = (*bias, *base.bias[len(bias) :])
            gaintype, biastype = own.get("gaintype", gaintype), own.get("biastype", biastype)
        elif tag in ("position", "intvelocity", "pid"):
            gain = number("kp", gain)
            # MuJoCo keeps a damping ratio as a positive b2.
            b0, b1, b2 = 0.0, -gain, number("dampratio", -number("kv", -b2))
            gaintype, biastype = "pid" if tag == "pid" else "fixed", "affine"
        elif tag == "velocity":
            gain = number("kv", gain)
            b0, b1, b2, gaintype, biastype = 0.0, 0.0, -gain, "fixed", "affine"
        elif tag == "cylinder":
            b0, b1, b2 = read.numbers(element, "bias", item, count=3, default=base.bias)
            gain, biastype = number("area", gain), "affine"
        elif tag in ("motor", "damper", "adhesion"):
            gain, b0, b1, b2 = number("gain", 1.0), 0.0, 0.0, 0.0
            gaintype, biastype = "affine" if tag == "damper" else "fixed", "none"
        else:
            gaintype = biastype = tag
        numbers = {
            name: read.numbers(element, name, item, count=most, least=least, default=self.numbers[name])
            for name, (most, least, _) in _INHERITED.items()
        }
        forcelimited = own.get("forcelimited", self.forcelimited)
        return _Actuator(tag, self.parent, gain, (b0, b1, b2), gaintype, biastype, forcelimited, numbers)


@dataclass(frozen=True)
class _Band:
    """A spring -x (k0 + k1 x + k2 x²), with x from the nearer one of two lengths, between which it rests."""

    stiffness: tuple[float, float, float]
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
class _Acting:
    """The forces of a tendon or an actuator."""

    item: str  # its name, or its number and its line
    name: str  # of the coupling
    factors: dict[str, float] = field(default_factory=dict)  # joint -> dl/dq; empty where l is no sum of coordinates
    stiffness: float = 0.0
    rest_length: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    dampratio: float = 0.0  # of the critical damping at the pose of the file
    ends: tuple[tuple[str, Array], ...] = ()  # bodies and points whose distance is l, if any
    band: _Band | None = None  # a spring that is no line
    measured: bool = False  # whether the rest length is that distance where the springs of joints rest
    control: str = ""  # description of an actuator's control, which is left out
    servo: str = ""  # description of its force at zero control
    left_out: list[str] = field(default_factory=list)

    @property
    def acts(self) -> bool:
        """Whether a part is a spring, damper or rotor."""
        return bool(self.stiffness or self.damping or self.armature or self.dampratio)

    def linear(self) -> None:
        """Move to `left_out` all but springs, dampers and rotors on sums of coordinates, and springs between points."""
        between = ("damping", "stiffness")[: 1 + (self.rest_length >= 0)] if self.ends else ()
        for name in ("stiffness", "damping", "armature", "dampratio"):
            value = getattr(self, name)
            if value < 0 or (value and not self.factors and name not in between):
                self.left_out.append(f"{name} {value:g}" + (", which is negative" if value < 0 else ""))
                setattr(self, name, 0.0)

    def coupling(self) -> JointCoupling:
        """Return it as a coupling of joints; its damping ratio is not in it."""
        numbers = self.stiffness, self.rest_length, self.damping, self.armature
        return JointCoupling(self.name, tuple(self.factors), np.array([*self.factors.values()]), *numbers)

    def point_spring(self) -> PointSpring:
        """Return it as a spring between two points."""
        (a, at_a), (b, at_b) = self.ends
        return PointSpring(self.name, a, at_a, b, at_b, self.stiffness, self.rest_length, self.damping)

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
        self._groups: set[float] = set()
        for option in mujoco.all("option"):
            self._groups |= {
                *self._read.numbers(option, "actuatorgroupdisable", "the file", count=31, least=0, default=())
            }
        self._classes = {"main": _Actuator()}
        for element in mujoco.all("default"):
            self._collect(element, "main")
        self._sites = {site: ("world", X.p) for site, X in scene.sites}
        self._sites |= {site: (body.name, X.p - body.anchor) for body in scene.bodies for site, X in body.sites}

        def inside(section: str) -> list[tuple[Element, str]]:
            elements = (e for s in mujoco.all(section) for e in s.children)
            return [(e, element_label(e, k)) for k, e in enumerate(elements, 1)]

        tendons = inside("tendon")
        self._tendons = [self._tendon(e, label, k) for k, (e, label) in enumerate(tendons, 1)]
        #: dl/dq by joint of each tendon; nothing where its length is no sum of coordinates.
        self.factors = {
            e.attributes.get("name", ""): t.factors for (e, _), t in zip(tendons, self._tendons, strict=True)
        }
        self._actuators = [self._actuator(e, label, k) for k, (e, label) in enumerate(inside("actuator"), 1)]

    def _collect(self, element: Element, name: str) -> None:
        """Read the actuator defaults of a class and of the classes in it."""
        for child in element.children:
            if child.tag in _ACTUATORS:
                self._classes[name] = self._classes[name].with_element(child, f"default class {name!r}", self._read)
        for child in element.all("default"):
            inner = child.attributes.get("class", "")
            self._classes[inner] = replace(self._classes[name], parent=self._classes[name])
            self._collect(child, inner)

    def _acting(self, element: Element, label: str, kind: str, number: int) -> _Acting:
        name = unused(element.attributes.get("name") or f"{kind}{number}", self._names)
        self._names.add(name)
        return _Acting(label, name)

    # Tendons

    def _tendon(self, element: Element, label: str, number: int) -> _Acting:
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
        if [e.tag for e in element.children] == ["site", "site"]:
            sites = (self._sites.get(e.attributes.get("site", "")) for e in element.children)
            ends = tuple(x for x in sites if x is not None)
            out.ends = ends if len({body for body, _ in ends}) == 2 else ()
        curved: dict[str, tuple[float, float, float]] = {}
        for name in ("stiffness", "damping"):
            first, *higher = read.numbers(full, name, item, count=3, least=1, default=(0.0,))
            setattr(out, name, 0.0 if any(higher) else first)
            if any(higher):
                curved[name] = first, higher[0], (*higher, 0.0)[1]
        out.armature = read.number(full, "armature", item, 0.0)
        first, *second = read.numbers(full, "springlength", item, count=2, least=1, default=(-1.0,))
        last = second[0] if second else first
        if first == last == -1.0:
            # The distance of two points is measured once there is a tree.
            out.measured = bool(out.ends)
            first = last = sum(factor * self._spring_reference(joint) for joint, factor in out.factors.items())
        out.rest_length = first
        k0, k1, k2 = curved.get("stiffness", (out.stiffness, 0.0, 0.0))
        if (k1 or k2 or (k0 and first != last)) and not out.measured and (out.ends or len(out.factors) == 1):
            out.band = _Band((k0, k1, k2), first, last)
            curved.pop("stiffness", None)
            out.stiffness = 0.0
        out.left_out += [f"{name} that depends on the length or its rate" for name in curved]
        if out.stiffness and first != last:
            out.left_out.append(f"stiffness {out.stiffness:g} with a range of rest lengths, {first:g} to {last:g}")
            out.stiffness = 0.0
        if "spring" in self._disabled:
            out.stiffness, out.band = 0.0, None
        out.damping *= "damper" not in self._disabled
        out.linear()
        own = full.attributes
        out.left_out += [f"{n} {own[n]}" for n, on in _TENDON_LIMITS.items() if n in own and own.get(on) != "false"]
        return out

    def _spring_reference(self, name: str) -> float:
        joint = self._joints[name]
        angle = self._scene.compiler.angle if joint.kind == "hinge" else 1.0
        return angle * self._read.number(joint.element, "springref", f"joint {name!r}", 0.0)

    # Actuators

    def _actuator(self, element: Element, label: str, number: int) -> _Acting:
        item = f"actuator {label}"
        class_ = self._scene.defaults.known(element.attributes.get("class"), element) or "main"
        settings = self._classes.get(class_, _Actuator()).with_element(element, item, self._read)
        out = self._acting(element, label, "actuator", number)
        (out.armature,), (group,) = settings.numbers["armature"], settings.numbers["group"]
        gear, (damping, *higher) = settings.numbers["gear"][0], settings.numbers["damping"]
        out.factors = {joint: gear * c for joint, c in self._driven(element, item).items() if gear * c}
        if any(higher):
            out.left_out.append("damping that depends on the rate")
        elif "damper" not in self._disabled:
            out.damping = damping
        gain = f"gain {settings.gain:g}" if settings.gaintype == "fixed" else f"{settings.gaintype} gain"
        limits = "".join(f" {x:g}" for x in settings.numbers["ctrlrange"])
        at = out.coupling().length if out.factors else element.attributes.get("tendon", "no sum of coordinates")
        out.control = f"{label} ({element.tag}, {gain}{f', range{limits}' if limits else ''}) on {at}"
        out.linear()
        if "actuation" not in self._disabled and group not in self._groups:
            servo = _Acting(out.item, out.name, out.factors)
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

    def _driven(self, element: Element, item: str) -> dict[str, float]:
        """Return the factors of the length before the gear; empty where it is no sum of coordinates."""
        own = element.attributes
        name, tendon = own.get("joint", own.get("jointinparent", "")), own.get("tendon")
        if name:
            joint = self._joints.get(name)
            if joint is None:
                self._read.fault(f"{item}: joint {name!r} is not in the file", element)
            return {name: 1.0} if joint is not None and joint.scalar else {}
        if tendon is not None and tendon not in self.factors:
            self._read.fault(f"{item}: tendon {tendon!r} is not in the file", element)
        return self.factors.get(tendon, {}) if tendon is not None else {}

    # Their effect on the model

    def add_bands(self, b: ModelBuilder) -> None:
        """Add the springs that are no lines: potentials of a joint's coordinate, or of the way between two points."""
        for x in self._tendons:
            if x.band is None:
                continue
            name, band = f"spring of {x.name}", x.band
            if x.ends:
                (a, at_a), (end, at_b) = x.ends

                def between(way: Any, band: _Band = band) -> Any:
                    return band.energy((way[0] ** 2 + way[1] ** 2 + way[2] ** 2) ** 0.5)

                b.add_bushing(name, body_a=a, translation_a=at_a, body_b=end, translation_b=at_b, potential=between)
            else:
                ((joint, factor),) = x.factors.items()

                def along(q: Any, band: _Band = band, factor: float = factor) -> Any:
                    return band.energy(factor * q)

                b.add_joint_force(name, joint, potential=along)

    def applied(self, model: Model) -> Model:
        """Return the model with these springs, dampers and rotors, and with notes on them and on parts left out."""
        acting = [x for x in (*self._tendons, *self._actuators) if x.acts]
        if measured := [x for x in acting if x.measured]:
            places = self._resting(model)
            for x in measured:
                a, b = (places[body] @ Pose(np.eye(3), point) for body, point in x.ends)
                x.rest_length = length(b.p - a.p)
        springs = tuple(x.point_spring() for x in acting if x.ends)
        out = with_couplings(replace(model, springs=springs), [x.coupling() for x in acting if not x.ends])
        ratios = []
        for x in acting:
            if x.dampratio:
                # Relative to the critical damping of the inertia that the actuator moves in the pose of the file.
                damping = 2 * x.dampratio * float(np.sqrt(x.stiffness * self._reflected(out, x.coupling())))
                ratios.append(replace(x.coupling(), stiffness=0.0, armature=0.0, damping=damping))
        out = with_couplings(out, ratios)
        notes = [*model.notes, *self._notes()]
        if branched := ", ".join(repr(c.name) for c in out.couplings if c.armature and out.branched(c)):
            notes.append(f"the armature of {branched} acts between branches; MuJoCo 4.0 leaves it out of M there")
        return replace(out, notes=tuple(notes))

    def _resting(self, model: Model) -> dict[str, Pose]:
        """Return the poses of the bodies where the springs of all joints rest; MuJoCo's ``qpos_spring``."""
        q = model.neutral()
        for body in self._scene.bodies:
            for joint in body.joints:
                at = model.layout.q[joint.name]
                if joint.scalar:
                    q[at] = self._spring_reference(joint.name)
                elif joint.kind == "free":
                    q[at] = *body.pose.p, *spatial.quaternion_from_matrix(body.pose.R)
        places = {"world": HERE}
        for link in model.tree:
            R, p = link.type.placement(np, link, list(q[model.layout.full_q[link.name]]))
            moved = Pose(np.array(R, dtype=float), np.array(p, dtype=float))
            places[link.child] = places[link.parent] @ Pose(link.rotation, link.translation) @ moved
        return places

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
        for what, at, some in (("tendons", "", self._tendons), ("actuators", ", at zero control", self._actuators)):
            if bands := "; ".join(f"{x.item}: {x.band}" for x in some if x.band):
                yield f"springs of {what} that rest between two lengths, or are polynomials: {bands}"
            if acting := "; ".join(x.description() for x in some if x.acts):
                yield f"{what} that act as springs, dampers and rotors{at}: {acting}"
            if lost := "; ".join(f"{x.item}: {', '.join(x.left_out)}" for x in some if x.left_out):
                yield f"left out of {what}: {lost}"
            if idle := ", ".join(x.item for x in some if not (x.acts or x.band or x.left_out or x.control)):
                yield f"{what} that exert no force of their own: {idle}"
        if self._actuators:
            controls = "; ".join(x.control for x in self._actuators)
            yield f"controls of actuators were left out, give their forces as tau: {controls}"


def with_couplings(model: Model, couplings: Iterable[JointCoupling]) -> Model:
    """Return the model with more couplings; one of a single joint becomes numbers of that joint.

    Dampings of couplings of one name add. Two springs on one joint become one; a constant energy is left out.
    """
    joints: dict[str, Joint] = {j.name: j for j in model.joints}
    kept = {c.name: c for c in model.couplings}
    for c in couplings:
        if len(c.joints) > 1:
            there = kept.get(c.name)
            kept[c.name] = c if there is None else replace(there, damping=there.damping + c.damping)
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
    return replace(model, joints=tuple(joints.values()), couplings=tuple(kept.values()))


def _add_bias(settings: _Actuator, out: _Acting) -> None:
    """Add an actuator's force at zero control and activation."""
    if settings.biastype == "none":
        return
    if settings.biastype != "affine":
        out.left_out.append(f"the force of a {settings.biastype}")
        return
    b0, b1, b2 = settings.bias
    rest = -b0 / b1 if b1 else 0.0
    if abs(rest) <= LARGEST:
        out.stiffness, out.rest_length = -b1, rest
    if b0 and (b1 >= 0 or abs(rest) > LARGEST):
        out.left_out.append(f"the constant force {b0:g}")
    if b2 > 0 and settings.gain == -b1 and settings.gaintype in ("fixed", "pid"):
        out.dampratio = b2
    elif b2 <= 0:
        out.damping -= b2
    else:
        out.left_out.append(f"the force {b2:g} times the rate")
    limits = settings.numbers["forcerange"]
    if limits and settings.forcelimited != "false" and any((b0, b1, b2)):
        out.left_out.append(f"force range {' '.join(f'{x:g}' for x in limits)}")


def bound_parts(element: Element) -> str:
    """Return the parts that an equality constraint binds."""
    ends = (f"{k} {v!r}" for k, v in element.attributes.items() if k.rstrip("12") in _ENDS)
    return ", ".join([element.tag, *ends])


def element_label(element: Element, number: int) -> str:
    """Return its name, or its number and its place."""
    name = element.attributes.get("name", "")
    return repr(name) if name else f"number {number} ({element.tag}, {element.place})"
