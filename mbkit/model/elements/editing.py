"""The part of `ModelBuilder` that changes a description which is already there: a loaded robot."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import EllipsisType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, shown
from mbkit.errors import InputError, did_you_mean
from mbkit.model.elements.beams import OnBeam
from mbkit.model.elements.forces import arguments_of
from mbkit.model.elements.paths import OF_BODIES, Path
from mbkit.model.elements.references import (
    _OF_BODIES,
    KINDS_OF_PARTS,
    called,
    entries,
    hung_on,
    moved_by,
    names_in,
    renamed,
)
from mbkit.model.parameters import Binding, Number, split
from mbkit.model.parts import OF_Q, OF_V, Frame, Joint, Mimic, rules_of

_Vector = ArrayLike | Sequence[Number]
_Numbers = ArrayLike | Sequence[Number] | Number
EDITED: Final = Path("editing", "ModelBuilder.of: not known of", OF_BODIES)
#: Numbers up to which a note says them all.
_MAX_NOTED_NUMBERS: Final = 3
#: Arguments of joints with a number for each coordinate or velocity.
NUMBERS_OF_JOINTS: Final = tuple(n for n, rule in rules_of(Joint).items() if rule.shape in (OF_Q, OF_V))


def restitution_of(read: Any, name: str, stops: object, restitution: Any) -> Any:
    """Return the restitution of a joint's stops, None without; arguments that do not go together are faults."""
    if not isinstance(stops, (bool, np.bool_)):
        read.faults.append(f"joint {name!r}: stops: expected True or False, got {shown(stops)}")
        return None
    if restitution is not None and not stops:
        read.faults.append(f"joint {name!r}: restitution without stops; give stops=True too")
    return (0.0 if restitution is None else restitution) if stops else None


class EditingBuilder:
    """Changes parts by name; `ModelBuilder` inherits it.

    Like the methods that add parts, these remember a fault, and `build` reports all of them. None stands for "as it
    is", but of `mimic`.
    """

    _read: Any
    _name: str
    _gravity: Array
    _bindings: list[Binding]
    _parts: dict[str, list[Any]]
    _notes: list[str]
    _odd: set[str]
    _sources: list[Any]
    _locked: list[tuple[Any, ...]]
    _time: float
    _read_fields: Callable[..., dict[str, Any]]
    _joint_fields: Callable[..., dict[str, Any]]
    _ratio: Callable[..., Any]
    add_body: Callable[..., None]
    add_joint: Callable[..., None]
    note: Callable[[str], None]

    @classmethod
    def of(cls, model: Any) -> Self:
        """Return a builder that holds everything of a model, to change it; the model stays as it is.

        Parameters
        ----------
        model : Model
            Such as `mbkit.load` returns.

        Examples
        --------
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder.of(mb.load("ur5"))
        >>> b.set_body("wrist_3_link", mass=0.5)
        >>> b.add_payload("load", at="tool0", mass=2.0, com=(0, 0, 0.1))
        >>> robot = b.build()
        >>> round(robot.mass - mb.load("ur5").mass, 4)
        2.3121
        >>> robot.notes[-1]
        "added payload 'load' of 2 kg at 'tool0'"
        """
        if not hasattr(model, "acts"):
            raise InputError(f"model: expected a Model, got {type(model).__name__}; mbkit.load(...) makes one")
        EDITED.admit(model)
        out = cls(model.name)  # type: ignore[call-arg]  # the whole builder's
        out._gravity = model.gravity
        out._bindings = list(model.bindings)
        out._parts = {kind: list(getattr(model, kind)) for kind in KINDS_OF_PARTS}
        out._notes, out._odd, out._sources = (
            list(model.notes),
            {name for name, _ in model.nonphysical},
            [*model.sources],
        )
        out._locked, out._time = [*model.locked], model.time
        return out

    # Change

    def set_gravity(self, gravity: _Vector) -> None:
        """Set the acceleration of gravity, (3,), m/s², in world axes."""
        value = self._read.quantities("gravity", gravity, 3)
        numbers, new = split("gravity", "", {"gravity": value})
        self._bindings = [b for b in self._bindings if b.where != "gravity"] + [*new]
        self._notes.append(f"changed gravity from {_short(self._gravity)} to {_short(numbers['gravity'])}")
        self._gravity = numbers["gravity"]

    def set_body(
        self,
        name: str,
        *,
        mass: Number | None = None,
        com: _Vector | None = None,
        inertia: ArrayLike | Sequence[Any] | None = None,
    ) -> None:
        """Set numbers of a body; the arguments are those of `add_body`. With `com` the inertia about it stays.

        A link that a URDF's loader merged with another one is a frame, and its body holds its inertia.
        """
        self._set("bodies", name, {"mass": mass, "com": com, "inertia": inertia})

    def set_joint(
        self,
        name: str,
        *,
        translation: _Vector | None = None,
        rotation: ArrayLike | None = None,
        rpy: ArrayLike | None = None,
        axis: ArrayLike | None = None,
        axis2: ArrayLike | None = None,
        pitch: Number | None = None,
        mimic: Mimic | tuple[str, Number, Number] | EllipsisType | None = ...,
        stops: bool | None = None,
        **numbers: _Numbers | ArrayLike | None,
    ) -> None:
        """Set a joint; the arguments, `numbers` among them, are those of `add_joint`. An infinite limit is no limit.

        With ``mimic=None`` a mimic joint has its own coordinate again. Joints that a file let follow it follow its
        leader, as before.
        """
        joint = self._named("joints", name)
        if joint is None:
            return
        if isinstance(joint.type, OnBeam) and joint.mimic:
            self._read.faults.append(
                f"joint {name!r} is a point of beam {joint.mimic.joint!r}; set that joint, or its root"
            )
            return
        given = self._known(f"joint {joint.name!r}", numbers, NUMBERS_OF_JOINTS)
        if stops is not None or "restitution" in given:
            there = joint.stops if stops is None else stops
            given["restitution"] = restitution_of(self._read, name, there, given.get("restitution"))
        given |= {"axes": None if axis is None and axis2 is None else (axis, axis2)}
        given |= {} if mimic is ... else {"mimic": mimic}
        ready = self._joint_fields(joint.name, joint.type, {n: x for n, x in given.items() if x is not None})
        ready |= {"mimic": None} if mimic is None else {}
        ready |= {} if stops is None or stops else {"restitution": None}
        if rotation is not None or rpy is not None:
            ready["rotation"] = self._read.orientation(f"joint {joint.name!r}", rotation, rpy)
        self._set("joints", name, {"translation": translation, "pitch": pitch}, ready)

    def set_frame(
        self,
        name: str,
        *,
        body: str | None = None,
        translation: _Vector | None = None,
        rotation: ArrayLike | None = None,
        rpy: ArrayLike | None = None,
    ) -> None:
        """Set the body or the pose of a frame; the arguments are those of `add_frame`."""
        turned = rotation is not None or rpy is not None
        ready = {"rotation": self._read.orientation(f"frame {shown(name)}", rotation, rpy)} if turned else {}
        ready |= {} if body is None else self._read_fields(Frame, f"frame {shown(name)}", {"body": body})
        self._set("frames", name, {"translation": translation}, ready)

    def set_spring(self, name: str, **numbers: Number | _Vector | None) -> None:
        """Set points or numbers of a spring between points; the arguments are those of `add_spring`."""
        self._set("springs", name, numbers)

    def set_coupling(self, name: str, **numbers: _Numbers | None) -> None:
        """Set numbers of a coupling of joints, those of `add_coupling`, or its factors, one for each joint."""
        self._set("couplings", name, numbers)

    def set_loop(
        self,
        name: str,
        *,
        translation_a: _Vector | None = None,
        rotation_a: ArrayLike | None = None,
        translation_b: _Vector | None = None,
        rotation_b: ArrayLike | None = None,
        length: Number | None = None,
    ) -> None:
        """Set the places of a loop's ends, and the length of a rod; the arguments are those of `add_loop`."""
        a = {"translation_a": translation_a, "rotation_a": rotation_a}
        self._set("loops", name, a | {"translation_b": translation_b, "rotation_b": rotation_b, "length": length})

    def set_coupler(
        self, name: str, *, ratio: _Numbers | None = None, offset: Number | None = None, curve: _Vector | None = None
    ) -> None:
        """Set the ratios, the offset or the curve of a coupler; the arguments are those of `add_coupler`."""
        ready = {}
        if ratio is not None and (there := [x for x in self._parts["couplers"] if x.name == name]):
            ready["ratio"] = self._ratio(f"coupler {shown(name)}", there[0].leader, ratio)
        self._set("couplers", name, {"offset": offset, "curve": curve}, ready)

    # Add, remove, rename

    def add_payload(
        self,
        name: str,
        *,
        at: str,
        mass: Number,
        com: _Vector = (0.0, 0.0, 0.0),
        inertia: ArrayLike | Sequence[Any] | None = None,
        translation: _Vector = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        rpy: ArrayLike | None = None,
    ) -> None:
        """Add a body that is fixed to a frame, such as a tool or what a gripper holds.

        The joint that fixes it has the name ``"<name>_mount"``.

        Parameters
        ----------
        name, mass, com, inertia
            Those of `add_body`, in the payload's axes.
        at : str
            A frame or a body.
        translation, rotation, rpy
            Those of `add_frame` on it: where the payload's axes stand.
        """
        item = f"payload {shown(name)}"
        frame = self._frame(item, at)
        if frame is None:
            return
        R = self._read.orientation(item, rotation, rpy)
        place = self._read.place(f"{item}: translation", translation)
        self.add_body(name, mass=mass, com=com, inertia=inertia)
        self.add_joint(
            f"{name}_mount",
            "fixed",
            parent=frame.body,
            child=name,
            translation=moved_by(frame.rotation, entries(frame, "translation", self._bindings), place),
            rotation=frame.rotation @ R,
        )
        size = f" of {mass:g} kg" if isinstance(mass, (int, float)) else ""
        self._notes.append(f"added payload {shown(name)}{size} at {at!r}")

    def remove_joint(self, name: str) -> None:
        """Remove a joint with all that it carries: bodies, joints, frames, and what acts on them.

        Springs, loops, couplings and forces between the removed parts and others go too, which the notes name. A joint
        that mimics a removed one is a fault.
        """
        joint = self._named("joints", name)
        if joint is None:
            return
        if isinstance(joint.type, OnBeam):
            whole = f"remove_joint({joint.parent!r}) removes it whole"
            self._read.faults.append(f"joint {name!r} is a part of a beam; {whole}")
            return
        bodies, joints = {joint.child}, {joint.name}
        # Parts may stand in any order.
        while more := [j for j in self._parts["joints"] if j.parent in bodies and j.name not in joints]:
            bodies |= {j.child for j in more}
            joints |= {j.name for j in more}
        frames = {f.name for f in self._parts["frames"] if f.body in bodies}
        self._locked = [x for x in self._locked if x[0] not in joints]
        holding = self._holding()
        gone = {x for j in joints for x in arguments_of(holding, j)}
        lost = []
        for kind, parts in self._parts.items():
            for part in [*parts]:
                own = part.name in joints if kind == "joints" else part.name in bodies and kind == "bodies"
                refers = kind not in ("bodies", "joints") and _touches(part, bodies, joints, frames)
                refers = refers or bool(gone & {*getattr(part, "arguments", ())} - {*getattr(part, "symbols", ())})
                if own or refers:
                    parts.remove(part)
                    self._bindings = [b for b in self._bindings if (b.where, b.part) != (kind, part.name)]
                    lost += [] if own or kind == "frames" else [f"{called(kind)} {part.name!r}"]
        self._parts["forces"] = [_without(x, joints) for x in self._parts["forces"]]
        also = f"; with it {', '.join(lost)}" if lost else ""
        self._notes.append(f"removed joint {name!r} and the bodies {', '.join(sorted(bodies))}{also}")

    def remove(self, name: str, kind: str | None = None) -> None:
        """Remove a frame, or what acts: a spring, coupling, loop, coupler, prescribed motion, force or no-slip row.

        A joint goes with `remove_joint`, and a body with the joint that carries it.

        Parameters
        ----------
        name : str
            A prescribed motion has the name of its joint.
        kind : {"frame", "spring", "coupling", "loop", "coupler", "prescribed", "force", "no slip"}, optional
            Needed where parts of several kinds have the name.
        """
        name, kinds = self._read.name("remove: name", name), {called(k): k for k in KINDS_OF_PARTS[2:]}
        if kind is not None and self._read.choice("remove", "kind", kind, kinds) != kind:
            return
        having = {k: [x.name for x in self._parts[k]] for word, k in kinds.items() if kind in (None, word)}
        found = [k for k, names in having.items() if name in names]
        if len(found) != 1:
            hint = f"there is none of this name{self._remedy(name, {n for names in having.values() for n in names})}"
            if found:
                hint = f"expected kind= one of {', '.join(repr(called(k)) for k in found)}, which all have this name"
            self._read.faults.append(f"remove: {name!r}: {hint}")
            return
        (where,) = found
        if where == "frames" and (users := [x.name for x in self._parts["forces"] if getattr(x, "frame", "") == name]):
            self._read.faults.append(f"remove: frame {name!r}: force {users[0]!r} acts there; remove that one first")
            return
        self._parts[where] = [x for x in self._parts[where] if x.name != name]
        self._bindings = [b for b in self._bindings if (b.where, b.part) != (where, name)]
        self._notes.append(f"removed {called(where)} {name!r}")

    def _remedy(self, name: str, names: Iterable[str]) -> str:
        for joint in self._parts["joints"]:
            if name in (joint.name, joint.child):
                return f"; remove_joint({joint.name!r}) removes a joint and what it carries"
        return did_you_mean(name, names)

    def add_prefix(self, prefix: str) -> None:
        """Put a prefix before the names of all bodies, joints, frames and other parts; parameters keep theirs."""
        prefix = self._read.name("prefix", prefix)

        def new(name: str) -> str:
            return name if name == "world" else prefix + name

        self._parts, self._bindings = renamed(self._holding(), new, new, new)
        self._odd = {prefix + body for body in self._odd}
        self._sources = [x.renamed(prefix) for x in self._sources]
        self._locked = [(prefix + joint, *rest) for joint, *rest in self._locked]
        if prefix:
            self._notes.append(f"all names begin with {prefix!r}")

    # How

    def _take(self, other: EditingBuilder, body: str, R: Array, p: Any, nominal: Array) -> None:
        """Take the parts of another builder, with its ground at R, p on a body; `nominal` is p without parameters."""
        bindings = other._bindings
        for kind, parts in other._parts.items():
            self._parts[kind] += [hung_on(x, {"world": (body, R, p)}, bindings) for x in parts]
        # There is one gravity.
        self._bindings += [b for b in bindings if b.where != "gravity"]
        self._odd |= other._odd
        self._locked += other._locked
        self._notes += other._notes
        self._sources += [x.hung_on(body, R, nominal) for x in other._sources]
        self._read.faults += other._read.faults

    def _holding(self) -> Any:
        """Return the parts as an unchecked description."""
        raise NotImplementedError

    def _set(self, kind: str, name: str, values: Mapping[str, Any], ready: Mapping[str, Any] | None = None) -> None:
        part = self._named(kind, name)
        if part is None:
            return
        item = f"{called(kind)} {part.name!r}"
        given = self._known(item, values, rules_of(type(part)))
        self._change(kind, part, self._read_fields(type(part), item, given) | dict(ready or {}))

    def _known(self, item: str, values: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
        """Return what is given of these names; others are faults."""
        for name in (n for n in values if n not in names):
            self._read.faults.append(f"{item}: {name!r}: there is no such number{did_you_mean(name, names)}")
        return {n: x for n, x in values.items() if x is not None and n in names}

    def _change(self, kind: str, part: Any, fields: dict[str, Any]) -> None:
        bound = {*fields}
        new: Sequence[Binding] = ()
        if "mimic" in fields:
            bound |= {"ratio", "offset"}
            if fields["mimic"] is not None:
                leader, ratio_and_offset = fields["mimic"]
                numbers, new = split(kind, part.name, ratio_and_offset)
                fields["mimic"] = Mimic(leader, **numbers)
        numbers, more = split(kind, part.name, fields)
        known = len(self._read.faults)
        old = {b.field for b in self._bindings if (b.where, b.part) == (kind, part.name)}
        changed = [*_changes(part, numbers, old, {b.field for b in (*new, *more)})]
        if kind == "bodies":
            # Bodies that were used as written are judged again.
            self._odd.discard(part.name)
        self._bindings = [
            b for b in self._bindings if (b.where, b.part) != (kind, part.name) or b.field not in bound
        ] + [*new, *more]
        parts = self._parts[kind]
        parts[next(i for i, x in enumerate(parts) if x is part)] = replace(part, **numbers)
        if changed and len(self._read.faults) == known:
            self._notes.append(f"changed {called(kind)} {part.name!r}: {', '.join(changed)}")

    def _named(self, kind: str, name: Any) -> Any:
        """Return a part by name; None after a fault."""
        what = called(kind)
        name = self._read.name(f"{what} name", name)
        names = [x.name for x in self._parts[kind]]
        if name in names:
            return self._parts[kind][names.index(name)]
        if kind == "bodies" and (frame := next((f for f in self._parts["frames"] if f.name == name), None)):
            hint = (
                f"; it is a frame on body {frame.body!r}, which holds its inertia: change that one, or hang something "
                "on the frame with add_payload"
            )
        else:
            hint = did_you_mean(name, names) if names else "; the model has none"
        self._read.faults.append(f"{what} {name!r}: there is none of this name{hint}")
        return None

    def _frame(self, item: str, at: Any) -> Frame | None:
        """Return a frame, or that of a body; None after a fault."""
        for frame in self._parts["frames"] if isinstance(at, str) else ():
            if frame.name == at:
                return frame  # type: ignore[no-any-return]  # parts of all kinds
        bodies = [b.name for b in self._parts["bodies"]]
        if isinstance(at, str) and at in (*bodies, "world"):
            return Frame(at, at, np.eye(3), np.zeros(3))
        known = [f.name for f in self._parts["frames"]] + bodies
        hint = did_you_mean(at, known) if isinstance(at, str) else ""
        self._read.faults.append(f"{item}: at: unknown frame {shown(at)}{hint}")
        return None


def _without(force: Any, joints: set[str]) -> Any:
    """Return a gravity compensation that does not name removed joints; other forces as they are."""
    if not joints & {*getattr(force, "without", ())}:
        return force
    return replace(force, without=tuple(name for name in force.without if name not in joints))


def _touches(part: Any, bodies: set[str], joints: set[str], frames: set[str]) -> bool:
    """Return whether a part that is no body and no joint hangs on removed ones."""
    return bool(
        names_in(part, _OF_BODIES) & (bodies | frames) or names_in(part, ("joint", "leader", "joints")) & joints
    )


def _changes(part: Any, numbers: Mapping[str, Any], were_free: set[str], free: set[str]) -> Iterator[str]:
    """Yield what of a part becomes another number."""
    for name, new in numbers.items():
        old = getattr(part, name)
        if name in free or (name == "mimic" and free & {"ratio", "offset"}):
            yield f"{name} has a parameter"
        elif name in were_free or (name == "mimic" and were_free & {"ratio", "offset"}):
            yield f"{name} has no parameter any more"
        elif isinstance(old, Mimic) or isinstance(new, Mimic) or np.size(new) > _MAX_NOTED_NUMBERS:
            yield from () if np.array_equal(old, new) else (name,)
        elif not np.array_equal(old, new):
            yield f"{name} {_short(old)} to {_short(new)}" if isinstance(new, (float, np.ndarray)) else name


def _short(x: Any) -> str:
    if x is None:
        return "none"
    # The shortest text that is the number.
    texts = [f"{v:g}" if float(f"{v:g}") == v else repr(v) for v in np.ravel(x).tolist()]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"
