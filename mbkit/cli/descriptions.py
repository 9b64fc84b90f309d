"""`mbkit robots`, `mbkit convert` and `mbkit diff`: descriptions by name, in another format, and why two differ."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mbkit.cli import _shared as shared
from mbkit.errors import InputError, MbkitError, ModelError, OutputError

if TYPE_CHECKING:
    from mbkit.model import Model


@shared.command("mbkit diff arm.urdf arm_new.urdf", "mbkit diff panda --engines pinocchio,mujoco")
@click.argument("first")
@click.argument("second", required=False)
@click.option(
    "--engines",
    callback=shared.split,
    default="",
    metavar="A,B",
    help="Two engines, to be compared on FIRST (and SECOND).",
)
@shared.states_options(3)
@click.option(
    "--tolerance", default=1e-9, show_default=True, type=click.FloatRange(min=0, min_open=True), help="What counts."
)
@click.option("--motion", is_flag=True, help="Measure each cause in rad and m, on runs of both under one controller.")
@click.option(
    "--controller",
    metavar="FUNCTION",
    help="With --motion: package.module:function of (t, q, v), CSV of torques, or passive.  [default: a posture]",
)
@click.option("--bound", default=0.05, show_default=True, type=click.FloatRange(min=0, min_open=True), help="rad or m.")
@click.option("--dt", type=click.FloatRange(min=0, min_open=True), help="With --motion: step of both simulations, s.")
@click.option("--rollouts", nargs=2, type=click.Path(), metavar="CSV CSV", help="Two recorded motions to explain.")
@click.option("--write", "path", type=click.Path(path_type=Path), help="File for FIRST with causes taken over.")
@click.option(
    "--take", multiple=True, type=click.IntRange(min=1), help="A cause to write; may be repeated.  [default: all]"
)
@shared.load_options
@shared.json_option
def diff(
    first: str,
    second: str | None,
    engines: tuple[str, ...],
    options: dict[str, Any],
    as_json: bool,
    motion: bool,
    controller: str | None,
    bound: float,
    dt: float | None,
    rollouts: tuple[str, str] | None,
    path: Path | None,
    take: tuple[int, ...],
    **settings: Any,
) -> None:
    """Say why SECOND moves otherwise than FIRST, and name the causes.

    Both are what `mbkit check` takes, with q and v as `mbkit.load` has them. A URDF is compared link by link, so that
    links which are fused wrongly are named. With two engines they are compared on one description, or each on its own.

    With --motion both are simulated from one start, an MJCF with the options and actuators of its file, and each cause
    has its effect in rad and m. With --rollouts the causes are found that turn one recorded motion into the other.
    """
    if engines:
        shared.check_engines(engines, least=2)
        if len(engines) > 2:
            raise click.UsageError("--engines takes two")
    elif second is None:
        raise click.UsageError("give two descriptions, or one and --engines A,B")
    moved = motion or rollouts is not None or path is not None
    if not moved and (controller or dt):
        raise click.UsageError("--controller and --dt go with --motion or --rollouts")
    if (take and path is None) or (rollouts is not None and path is not None):
        raise click.UsageError("--take goes with --write, and --write with --motion: records have no numbered causes")
    if moved and options.get("actuators"):
        raise click.UsageError("--actuators: with --motion the servos of an MJCF act as its simulator has them")
    from mbkit.engines import dynamics
    from mbkit.studies.explain import explain

    targets = [first] if second is None else [first, second]
    sides: list[Any] = [_model(target, options) for target in targets]
    names = None
    if engines:
        sides = [dynamics(sides[k % len(sides)], engine) for k, engine in enumerate(engines)]
    else:
        a, b = (os.path.basename(target) or target for target in targets)
        names = (a, b) if a != b else (targets[0], targets[1])
    if moved:
        settings |= {"motion": _motion(targets, sides, controller, bound, dt), "rollouts": rollouts}
    result = explain(*sides, names=names, **settings)
    if not engines and (beside := _beside_terms(first, str(second))):
        unlike = not beside[0].startswith("not compared")
        head = "beside the terms: " if unlike else ""
        if unlike or not moved:
            # A motion says itself what of the files no run has.
            result = replace(result, beside=(f"{head}{beside[0]}", *beside[1:]), agree=result.agree and not unlike)
    shared.show(result.document(), as_json=as_json)
    if path is not None:
        # Shown before, so that nothing is lost where the file cannot be written.
        _write(result, path, take)
    shared.leave(shared.AGREE if result.agree else shared.DIFFER)


def _motion(
    targets: Sequence[str], sides: Sequence[Any], controller: str | None, bound: float, dt: float | None
) -> Any:
    """Return how both are moved: with what their files say of a simulation, and one controller."""
    import numpy as np

    from mbkit.load.loader import find
    from mbkit.studies._targets import function_of
    from mbkit.studies.explain import Motion, Settings, file_settings

    held, left_out = list[Any](), list[tuple[str, ...]]()
    for k, side in enumerate(sides):
        target, engine = targets[k % len(targets)], getattr(side, "engine", None)
        robot = find(target)
        own, left = file_settings(robot.path if robot else target, getattr(side, "model", side))
        if engine and own is not None:
            own, left = None, ("options, limits and servos", *left)
        held.append(replace(own or Settings(engine=engine), time_step=dt) if dt is not None else own)
        left_out.append(left)
    law: Any = controller or "posture"
    if ":" in law:
        law = function_of(law)
    elif law not in ("posture", "passive"):
        try:
            law = np.loadtxt(law, delimiter=",", ndmin=2)
        except (OSError, ValueError) as error:
            raise InputError(f"--controller: no function, and no CSV of torques alone: {error}") from None
    return Motion(controller=law, bound=bound, settings=(held[0], held[1]), left_out=(left_out[0], left_out[1]))


def _write(result: Any, path: Path, take: Sequence[int]) -> None:
    """Write the first description with causes taken over, and say what was written."""
    from mbkit.studies.written_causes import write_causes

    for note in write_causes(result, path, take):
        shared.say("note", note)
    shared.say("written", f"{path}: read back, it says the same")


def _beside_terms(first: str, second: str) -> tuple[str, ...]:
    """Return what differs in what MuJoCo simulates of two MJCFs, or was not compared of one."""
    from mbkit.engines.mujoco.importer import differences
    from mbkit.load.sanitized_text import strip

    paths = [x for x in (first, second) if x.lower().endswith((".xml", ".mjcf")) and os.path.isfile(x)]
    missing = "not compared: options of simulation, servos, force ranges, contacts, limits"
    if len(paths) < 2:
        return tuple(f"{missing} of {os.path.basename(path)}" for path in paths)
    try:
        files = [strip(Path(path)) for path in paths]
        out = tuple(differences((x.text, x.meshes) for x in files))
    except Exception as error:  # MuJoCo raises errors of many kinds
        return (f"{missing}, which MuJoCo does not read here ({' '.join(str(error).split())[:120]})",)
    pairs = [sorted((x.tag, *x.attributes.items()) for c in f.root.all("contact") for x in c.children) for f in files]
    out += ("pairs and exclusions of contact",) if pairs[0] != pairs[1] else ()
    lost_shapes = any(tag in ("mesh", "hfield") for f in files for tag, _ in f.gone)
    return out or (("not compared: contacts of meshes",) if lost_shapes else ())


def _model(target: str, options: Mapping[str, Any]) -> Model:
    """Return what `mbkit.load` makes of a target; of a URDF link by link, with joints in the order that it loads."""
    from mbkit import catalog
    from mbkit.load.loader import find
    from mbkit.studies._targets import model_of
    from mbkit.studies.importers.study import written

    # `model_of` says which one it takes where a robot is also a catalog system.
    robot = None if target in catalog.systems() else find(target)
    path = target if os.path.isfile(target) else str(robot.path) if robot is not None else ""
    try:
        loaded = model_of(target, options)
    except ModelError:
        if options or not path:
            raise
        # Matter that cannot be is compared as it is written; the loader has the better message.
        with suppress(MbkitError):
            return written(path)
        raise
    if options or not path.lower().endswith(".urdf"):
        return loaded
    with suppress(MbkitError):
        links, places = written(path), {name: k for k, name in enumerate(loaded.joint_names)}
        if places.keys() == {*links.joint_names}:
            order = sorted(links.joints, key=lambda joint: places.get(joint.name, -1))
            return replace(links, joints=tuple(order))
    return loaded


@shared.command("mbkit robots", "mbkit robots --json")
@shared.json_option
def robots(as_json: bool) -> None:
    """List the robots and catalog systems that can be checked by name."""
    from mbkit import catalog
    from mbkit.load import robots as records

    if as_json:
        fields = ("name", "aliases", "nq", "nv", "mass", "reason")
        listed = [{f: getattr(r, f) for f in fields} | {"path": str(r.path)} for r in records()]
        shared.tell(json.dumps(listed, indent=1))
        return
    from mbkit.report import terminal

    shared.console().print(terminal.robots(records(), catalog.systems()))


@shared.command("mbkit convert panda --to mjcf", "mbkit convert arm.urdf --to mjcf --out arm.xml")
@click.argument("target")
@click.option("--to", "to", required=True, type=click.Choice(["mjcf", "urdf"]), help="The format.")
@click.option("--out", type=click.Path(path_type=Path), help="File to write.  [default: print]")
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@shared.load_options
def convert(target: str, to: str, out: Path | None, force: bool, options: dict[str, Any]) -> None:
    """Write TARGET as MJCF or URDF: its motion alone, without geometry.

    TARGET is what `mbkit check` takes. The text is read back with MuJoCo's or Pinocchio's own parser before
    it is written, and what the format cannot say is an error that names it.
    """
    from mbkit.studies._targets import model_of
    from mbkit.studies.convert import convert as converted

    if out is not None and out.exists() and not force:
        raise OutputError(f"{out} is there already; choose another with --out, or replace it with --force")
    result = converted(model_of(target, options), to)
    if out is None:
        shared.tell(result.text.removesuffix("\n"))
    else:
        result.write(out)
    for note in result.notes:
        shared.say("note", note)
    where = "printed" if out is None else f"written to {out}"
    shared.say("checked", f"{result.model} as {to}, {where}: read back, every term agrees to {result.worst:.1e}")
