"""Descriptions with their simulators, and changes of them: parts of a description, settings, order of joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, TypeVar, cast

from mbkit.errors import InputError, LoadError, UnsupportedError
from mbkit.methods.registry import method_of
from mbkit.methods.simulation_settings import WORDS, Servo, Settings
from mbkit.model import Model
from mbkit.studies.explain.hypotheses import Change, Hypothesis
from mbkit.studies.explain.merged_model import MergedModel, Where, merge
from mbkit.studies.formatting import error_text
from mbkit.studies.results import counted

#: Largest difference of a file's run from that of its description, rad or m, over some tenths of a second.
LIKE_THE_FILE: Final = 1e-7
#: What a cause can change.
Changed = TypeVar("Changed", bound="Model | Settings")


@dataclass(frozen=True, eq=False)
class World:
    """A description with its simulator; `order` has the joints, in the first's names, as a controller counts them."""

    system: MergedModel
    settings: Settings
    order: tuple[str, ...]

    def put(self, where: Where, values: Mapping[str, Any]) -> World:
        """Return the world with other fields in one part: a `Hypothesis` changes worlds as it does descriptions."""
        section, *names = where
        if section == "world":
            return replace(self, **values)
        if section == "settings" and not names:
            return replace(self, settings=replace(self.settings, **values))
        if section != "settings":
            return replace(self, system=self.system.put(where, values))
        servos = {x.joint: x for x in self.settings.servos or ()}
        if "servo" in values:
            servos[names[0]] = values["servo"]
        elif names[0] in servos:
            servos[names[0]] = replace(servos[names[0]], **values)
        return self.put(("settings",), {"servos": tuple(x for x in servos.values() if x is not None)})


def setting_differences(a: Settings, b: Settings) -> Iterator[Hypothesis]:
    """Yield the settings in which two simulations differ, and the numbers of each servo."""
    # An integrator is an engine's own: where the engines differ, they are one difference.
    own = ("engine", "integrator")
    names = [f.name for f in fields(Settings) if f.name != "servos" and not (a.engine != b.engine and f.name in own)]
    if a.engine != b.engine:
        ours, theirs = ({n: getattr(x, n) for n in own} for x in (a, b))
        says = f"runs on {b.engine} with {b.integrator} for {a.engine} with {a.integrator}"
        yield Hypothesis("engine", "", says, (Change(("settings",), ours, theirs),))
    for name in (n for n in names if getattr(a, n) != getattr(b, n)):
        yield _of_setting(("settings",), name, getattr(a, name), getattr(b, name))
    for joint in dict.fromkeys(x.joint for x in (*(a.servos or ()), *(b.servos or ()))):
        one, other = a.servo(joint), b.servo(joint)
        where = ("settings", joint)
        if one is None or other is None or one.kind != other.kind:
            if one != other:
                says = f"has {_servo_text(other)} for {_servo_text(one)}"
                yield Hypothesis("servo", f"joint {joint!r}", says, (Change(where, {"servo": one}, {"servo": other}),))
            continue
        for f in fields(Servo):
            if getattr(one, f.name) != getattr(other, f.name):
                yield _of_setting(where, f.name, getattr(one, f.name), getattr(other, f.name))


def joint_order(first: World, second: World) -> Iterator[Hypothesis]:
    """Yield the difference in the order of joints, which a controller that knows no names feels."""
    ours, theirs = ([x for x in w.order if x in other.order] for w, other in ((first, second), (second, first)))
    if ours != theirs:
        change = Change(("world",), {"order": first.order}, {"order": second.order})
        yield Hypothesis("joint order", "", "has its joints in another order", (change,))


def _of_setting(where: Where, name: str, a: Any, b: Any) -> Hypothesis:
    kind, unit = WORDS[name]
    subject = f"joint {where[1]!r}" if len(where) > 1 else ""
    says = f"has {kind} {_text(b)} for {_text(a)} {unit}".rstrip()
    return Hypothesis(kind, subject, says, (Change(where, {name: a}, {name: b}),), a, b)


def _servo_text(servo: Servo | None) -> str:
    if servo is None:
        return "no servo"
    gains = {"position": f" with kp {servo.kp:g} and kv {servo.kv:g}", "velocity": f" with kv {servo.kv:g}"}
    return "a motor" if servo.kind == "motor" else f"a {servo.kind} servo{gains[servo.kind]}"


def _text(x: Any) -> str:
    if isinstance(x, tuple):
        return f"({', '.join(map(_text, x))})"
    return ("off", "on")[x] if isinstance(x, bool) else f"{x:g}" if isinstance(x, (int, float)) else str(x)


def settings_text(x: Settings) -> str:
    """Return settings in a few words."""
    step = f", step {x.time_step:g} s" if method_of(str(x.integrator)).kind != "adaptive" else ""
    drives = f", {counted(len(x.servos), 'drive')}" if x.servos else ""
    return f"{x.engine}, {x.integrator}{step}{drives}, control every {x.control_period:g} s"


def file_settings(path: str | Path, model: Model) -> tuple[Settings | None, tuple[str, ...]]:
    """Return what a file says of its simulation, and what of that no run has; None for a URDF, which says nothing.

    Parameters
    ----------
    path : str or Path
        Of an MJCF: its options, limits and actuators are read by MuJoCo.
    model : Model
        The file's description, as `mbkit.load` returns it.

    Raises
    ------
    LoadError
        The file cannot be read, by mbkit or by MuJoCo.
    """
    if not str(path).lower().endswith((".xml", ".mjcf")):
        return None, ()
    from mbkit.engines.mujoco.simulation import OwnSimulation, settings_of
    from mbkit.load.sanitized_text import strip

    file = strip(Path(path))
    try:
        held, left = settings_of(file.text, file.meshes, {*model.joint_names})
    except Exception as error:  # MuJoCo raises errors of many kinds
        raise LoadError(f"{path}: MuJoCo does not read it: {' '.join(str(error).split())}") from None
    pairs = [x for part in file.root.all("contact") for x in part.children]
    off = None
    with suppress(UnsupportedError):
        off = OwnSimulation(model, held).off_the_file(file.text, file.meshes)
    if off is None:
        left.append("whether its run is that of mj_step")
    elif not off <= LIKE_THE_FILE:
        left.append(f"what its description lacks: mj_step on the file moves it {error_text(off)} rad or m otherwise")
    return held, (*left, *([counted(len(pairs), "pair or exclusion of contact")] if pairs else []))


def changed(change: Hypothesis | None, says: str, side: Changed, *, back: bool = False) -> Changed:
    """Return a description or settings with a cause's change, or `back` without it."""
    if change is None or not change.changes:
        raise UnsupportedError(f"{says}: no part of a description or of settings holds this cause alone")
    if not isinstance(side, (Model, Settings)):
        raise InputError(f"side: expected a Model or Settings, got {type(side).__name__}")
    if {c.where[0] in ("settings", "world") for c in change.changes} != {isinstance(side, Settings)}:
        raise InputError(f"{says}: expected {'a Model' if isinstance(side, Settings) else 'Settings'}, got {side!r}")
    system = merge(side) if isinstance(side, Model) else cast(Any, None)
    world = World(system, side if isinstance(side, Settings) else Settings(), ())
    out = change.revert(world) if back else change.apply(world)
    return cast(Changed, out.system.model if isinstance(side, Model) else out.settings)
