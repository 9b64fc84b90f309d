"""Kinds of parts: all that acts or binds in a model, each declared once.

`Model.acts`, `needs` and `without` read this registry, and so do the gates of paths (`mbkit.model.elements.paths`).
Joint types are kinds by themselves, such as ``"joint_type.revolute"``; so are those of `register_joint_type`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from mbkit.errors import InputError, UnknownNameError
from mbkit.model.elements.forces import Bushing, FrameForce, GravityCompensation, JointForce
from mbkit.model.elements.motion_laws import MOTION_LAWS
from mbkit.model.elements.references import KINDS_OF_PARTS
from mbkit.model.joint_types import kind_of
from mbkit.model.loops import LOOP_KINDS, NO_SLIP_ROWS
from mbkit.model.parts import rules_of

#: A `mbkit.model.description.Description`, a floor above.
_Model = Any
_Test = Callable[[_Model, Any], bool]
#: Effects of a kind, each with a word: coordinates, kinetic and potential energy, dissipation of a rate, a force that
#: jumps with a velocity's sign, another force, a row of positions or of velocities, a limit that is data or that acts,
#: the time.
EFFECTS: Final[Mapping[str, str]] = MappingProxyType(
    {"q": "coordinates", "T": "rotors", "V": "springs and weights", "loss": "damping", "jump": "dry friction"}
    | {"force": "forces", "row": "constraints", "speed": "velocity constraints", "bound": "limits"}
    | {"stop": "joint stops"}
    | {"t": "terms that depend on the time"}
)
#: Note on files.
AS_LIMITS: Final = "joint stops come back as limits: load the file with stops=True; set_joint gives restitution"
_OF_TYPES: Final = "joint_type."


@dataclass(frozen=True)
class Needs:
    """One flag per feature; True where the description has it.

    Limits are data, off in every engine, unless they are `stops`. `forces` are those given by functions and what holds
    weights; their parts do not count as springs and dampers.
    """

    gravity: bool
    springs: bool
    damping: bool
    armature: bool
    friction: bool
    limits: bool
    effort_limits: bool
    mimic: bool
    loops: bool
    quaternions: bool
    time: bool
    forces: bool = False
    no_slip: bool = False
    stops: bool = False

    def as_dict(self) -> dict[str, bool]:
        """Return the flags by name."""
        return asdict(self)

    def __str__(self) -> str:
        there, absent = ([k for k, x in self.as_dict().items() if x is on] for on in (True, False))
        there = [EFFECTS["jump"] if name == "friction" else name for name in there]
        return f"has {', '.join(there) or 'nothing'}; without {', '.join(absent) or 'nothing'}"


@dataclass(frozen=True)
class Kind:
    """A kind of part, as `register_kind` takes it; `does`, `numbers` and `features` are sets of words."""

    name: str
    section: str
    words: str
    does: frozenset[str]
    numbers: frozenset[str]
    features: tuple[str, ...]
    at: _Test

    @property
    def effects(self) -> frozenset[str]:
        """All that it does, also by what another kind does."""
        return frozenset(y for x in self.does for y in ((x,) if x in EFFECTS else PART_KINDS[x].effects))

    def parts(self, model: _Model) -> tuple[Any, ...]:
        """Return the parts of a model that are of this kind."""
        parts = getattr(model, self.section) if self.section else (model,)
        return tuple(p for p in parts if self.at(model, p))

    def removed(self, model: _Model) -> Any:
        """Return a model without this kind, and without the parameters of its numbers."""
        gone = self.parts(model)
        if not self.section:
            left = tuple(b for b in model.bindings if b.where not in self.numbers)
            return replace(model, bindings=left, **self._nothing(model)) if gone else model
        kinds = [k.numbers for k in PART_KINDS.values() if k.section == self.section]
        # Parts that are nothing but numbers go with the last of them.
        stays = has(self.section, *(frozenset().union(*kinds) - self.numbers if all(kinds) else ()))
        new = {p.name: replace(p, **self._nothing(p)) if self.numbers and stays(model, p) else None for p in gone}
        left = tuple(
            b
            for b in model.bindings
            if b.where != self.section or b.part not in new or (new[b.part] and b.field not in self.numbers)
        )
        parts = tuple(p for p in (new.get(x.name, x) for x in getattr(model, self.section)) if p)
        return replace(model, bindings=left, **{self.section: parts}) if gone else model

    def _nothing(self, part: Any) -> dict[str, Any]:
        rules = [(f, rules_of(type(part))[f], getattr(part, f)) for f in self.numbers]
        return {f: None if rule.absent is not None else np.full(np.shape(x), rule.nothing) for f, rule, x in rules}


#: Kinds by name, in the order of registration; `kind` also knows those of joint types.
PART_KINDS: Final[dict[str, Kind]] = {}


def register_kind(
    section: str, name: str, words: str, does: str = "", numbers: str = "", features: str = "", at: _Test | None = None
) -> Kind:
    """Make a kind of part known, and return it: a path that does not carry it refuses it by its words.

    Parameters
    ----------
    section : str
        Attribute of a description with its parts; empty for the description itself.
    name : str
        Such as ``"joint.stiction"``; ``"a.b"`` is a finer kind of ``"a"``.
    words : str
        A clause on one part ``p``, such as ``"joint {p.name!r} has armature"``.
    does : str
        Some of `EFFECTS`, or names of kinds, such as ``"force.joint"`` for an element with formulas. A path that
        carries all of them carries the kind: give them where the laws of energies, forces and rows have its formula.
        With none, only paths that name the kind carry it.
    numbers : str
        Fields that come to nothing when it is taken out; without any the part goes.
    features : str
        Words by which `Model.without` takes it out, beside its name; without any it stays.
    at : callable, optional
        ``at(model, part)``: whether the part is of this kind. By default each is, or each with such a number.

    Raises
    ------
    InputError
        A name that is taken, or a section or an effect that does not exist.
    """
    if name in PART_KINDS or name.startswith(_OF_TYPES):
        raise InputError(f"kind {name!r}: expected a name that no other kind has")
    if section not in ("", *KINDS_OF_PARTS) or not {*does.split()} <= {*EFFECTS, *PART_KINDS}:
        expected = f"a section of {KINDS_OF_PARTS} and effects of {tuple(EFFECTS)}, or kinds"
        raise InputError(f"kind {name!r}: expected {expected}, got {section!r} and {does!r}")
    sets = frozenset(does.split()), frozenset(numbers.split()), tuple(features.split())
    PART_KINDS[name] = Kind(name, section, words, *sets, at or has(section, *numbers.split()))
    return PART_KINDS[name]


@cache
def _of_joint_type(name: str) -> Kind:
    type_ = kind_of(name)
    words = f"is a {name.replace('_', '-')} joint" if type_.built_in else f"is {name}"
    words = f"joint {{p.name!r}} {words}" + (f" ({type_.instead})" if type_.instead else "")
    return Kind(_OF_TYPES + name, "joints", words, frozenset("q"), frozenset(), (), lambda _, j: bool(j.kind == name))


def joint_types(*names: str) -> frozenset[str]:
    """Return the names of the kinds of joint types."""
    return frozenset(_OF_TYPES + name for name in names)


def kind(name: str) -> Kind:
    """Return the kind of this name, also that of a joint type."""
    if name not in PART_KINDS and not name.startswith(_OF_TYPES):
        raise UnknownNameError("kind", name, PART_KINDS)
    return PART_KINDS.get(name) or _of_joint_type(name.removeprefix(_OF_TYPES))


def acts(model: _Model) -> Mapping[str, tuple[str, ...]]:
    """Return the kinds that act in a model by name, each with the names of its parts."""
    kinds = (*PART_KINDS.values(), *map(_of_joint_type, dict.fromkeys(j.kind for j in model.joints)))
    return MappingProxyType({k.name: names for k in kinds if (names := tuple(p.name for p in k.parts(model)))})


def that_do(effect: str, *sections: str) -> tuple[str, ...]:
    """Return the names of the kinds that have an effect, of some sections or of all, as `Model.without` takes them."""
    kinds = (k for k in PART_KINDS.values() if k.features and (k.section in sections or not sections))
    return tuple(k.name for k in kinds if effect in k.effects)


def unregistered(model: _Model) -> Iterator[str]:
    """Yield forces and motions of a class that no kind has: no path carries them."""
    for section in (x for x in ("forces", "prescribed") if getattr(model, x)):
        kinds = [k for k in PART_KINDS.values() if k.section == section and k.does != {"t"}]
        for p in getattr(model, section):
            if not (type(p) is GravityCompensation or any(k.at(model, p) for k in kinds)):
                yield f"{p} is a {type(p).__name__}, which no kind has; register_kind makes it known"


def has(section: str, *fields: str) -> _Test:
    """Return the test for a number among these fields that does something, or that a parameter may make do so."""

    def at(model: _Model, part: Any) -> bool:
        given = ((rules_of(type(part))[f].nothing, getattr(part, f)) for f in fields)
        if not fields or any(x is not None and np.any(x != nothing) for nothing, x in given):
            return True
        own = (section, part.name) if section else (fields[0], "")
        return any((b.where, b.part) == own and b.field in fields for b in model.bindings)

    return at


def _named(kind: str) -> _Test:
    return lambda _, part: bool(part.kind == kind)


def _of_class(cls: type) -> _Test:
    return lambda _, part: type(part) is cls


def _several(at: _Test) -> _Test:
    return lambda model, joint: joint.type.nv > 1 and at(model, joint)


def _written_with(need: str, model: _Model, _: Any) -> bool:
    return not model.has_bodies and bool(getattr(model.needs, need))


def _holds_weight(model: _Model, force: Any) -> bool:
    return type(force) is GravityCompensation and force.body not in model.rotors


register_kind("", "energies", "{p.name} was written as energies and has no bodies", at=lambda m, _: not m.has_bodies)
_WRITTEN = (
    ("row", "loops", "constraints: constraints[0] is {p.form.constraints[0]!s:.80}"),
    ("speed", "no_slip", "velocity constraints: velocity_constraints[0] is {p.form.velocity_constraints[0]!s:.80}"),
    ("t", "time", EFFECTS["t"]),
)
for _does, _need, _what in _WRITTEN:
    register_kind("", f"written.{_does}", f"{{p.name}} has {_what}", _does, at=partial(_written_with, _need))
# Only paper writes them out.
_WORDS = "{p.name} has stops on paper, where engines run those of joints: stops[0] is {p.form.stops[0]!s:.80} >= 0"
register_kind("", "written.stop", _WORDS, at=lambda m, _: not m.has_bodies and bool(m.form.stops))
register_kind("", "gravity", "gravity", "V", "gravity", "gravity")
# Armature of a free joint is a body, whose weight a compensation holds.
_WORDS, _AT = "body {p.name!r} is armature of a free joint", lambda m, b: b.name in m.rotors and b.mass > 0
register_kind("bodies", "body.rotor", _WORDS, "T", "mass inertia", "armature", _AT)
_AT, _FRICTION = lambda _, j: j.mimic is not None, "friction stiction stribeck_velocity"
register_kind("joints", "mimic", "joint {p.name!r} follows {p.mimic.joint!r}", "q", at=_AT)
_stop = partial(register_kind, "joints", "joint.stop", "joint {p.name!r} has stops", "jump stop", "restitution")
_stop("limits stops", lambda _, j: j.stops)
for _name, _what, _does, _numbers, _feature in (
    ("armature", "armature", "T", "armature", "armature"),
    ("spring", "a spring", "V", "stiffness", "springs"),
    ("damping", "damping", "loss", "damping", "damping"),
    ("friction", "dry friction", "jump", _FRICTION, "friction"),
    ("limit", "limits", "bound", "lower upper restitution", "limits"),
    ("velocity_limit", "limits of velocity", "bound", "velocity_limit", "limits"),
    ("effort_limit", "limits of effort", "bound", "effort_limit", "limits"),
):
    _of_joints = partial(register_kind, "joints", does=_does, numbers=_numbers, features=_feature)
    _at = _of_joints(f"joint.{_name}", f"joint {{p.name!r}} has {_what}").at
    _of_joints(f"joint.{_name}.several", f"joint {{p.name!r}} is {{p.kind}} and has {_what}", at=_several(_at))
_WORDS = "joint {p.name!r} has stiction above its friction"
register_kind("joints", "joint.stiction", _WORDS, "jump", _FRICTION, "friction", lambda _, j: j.sticks)
for _section, _name, _words in (
    ("springs", "point", " {p.name!r} between two points"),
    ("couplings", "coupling", " on coupling {p.name!r} of joints"),
):
    register_kind(_section, f"{_name}.spring", "spring" + _words, "V", "stiffness", "springs")
    register_kind(_section, f"{_name}.damper", "damper" + _words, "loss", "damping", "damping")
register_kind("couplings", "coupling.armature", "armature" + _words, "T", "armature", "armature")
for _name in LOOP_KINDS:
    register_kind("loops", f"loop.{_name}", f"{_name} loop {{p.name!r}}", "row", "", "loops", _named(_name))
_coupler = partial(register_kind, "couplers", does="row", features="loops couplers")
_coupler("coupler", "coupler {p.name!r}")
_coupler("coupler.curve", "coupler {p.name!r} is a curve", at=has("couplers", "curve"))
_coupler("coupler.several", "coupler {p.name!r} has several leaders", at=lambda _, c: len(c.leaders) > 1)
_motion = partial(register_kind, "prescribed", does="row t", features="prescribed")
for _law in MOTION_LAWS:
    _name = _law.__name__.removesuffix("Motion").lower()
    _motion(f"motion.{_name}", "joint {p.joint!r} is moved in time", at=_of_class(_law))
for _name, (_rows, _) in NO_SLIP_ROWS.items():
    _WORDS, _does = "no slip {p.name!r} ({p.kind}) holds velocities", "row speed" if _rows else "speed"
    register_kind("no_slip", f"no_slip.{_name}", _WORDS, _does, "", "no_slip", _named(_name))
_force = partial(register_kind, "forces", words="{p}", features="forces")
_force("force.joint", does="V force", at=_of_class(JointForce))
_force("force.frame", does="V force", at=_of_class(FrameForce))
_force("force.bushing", does="V loss force", at=_of_class(Bushing))
_force("force.compensation", does="V", at=_holds_weight)
_force("force.compensation.partial", does="force", at=lambda m, f: _holds_weight(m, f) and bool(f.without))
_force("force.of_time", does="t", at=lambda _, f: f.of_time)
