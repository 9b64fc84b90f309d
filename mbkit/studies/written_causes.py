"""The first description with causes taken over, as a file for the user's own simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from mbkit.errors import InputError, MbkitError, OutputError
from mbkit.methods.simulation_settings import Settings
from mbkit.studies.convert import convert
from mbkit.studies.explain.merged_model import MergedModel
from mbkit.studies.explain.result import Explanation
from mbkit.studies.results import write


def write_causes(result: Explanation, path: Path, take: Sequence[int] = ()) -> list[str]:
    """Write the first description with causes taken over, read it back and compare; return notes.

    An MJCF has the settings of the simulation too: options and actuators. It has the motion alone, as
    `mbkit.convert` writes it: no geometry and no contacts.

    Parameters
    ----------
    result : Explanation
        Of `explain` with a motion.
    path : Path
        Ends in .xml for an MJCF, in .urdf for a URDF.
    take : sequence of int
        Numbers of causes, from 1, in the order of ``result.motion.effects``; all where there are none.

    Raises
    ------
    InputError, OutputError
        No such cause; a file that is there already, or cannot be written.
    UnsupportedError
        What the format cannot hold.
    MbkitError
        What was written reads back otherwise.
    """
    if result.motion is None or result.motion.first is None:
        raise InputError("result: expected an explanation with motion=..., whose causes have numbers")
    effects, first = result.motion.effects, result.motion.first
    if bad := [k for k in take if not 1 <= k <= len(effects)]:
        raise InputError(f"take: expected numbers from 1 to {len(effects)}, got {bad}")
    if path.exists():
        raise OutputError(f"{path} is there already; choose another")
    world, notes, chosen = first, list[str](), [effects[k - 1] for k in take] or effects
    for effect in chosen:
        if effect.change is None or not effect.change.changes or effect.kind == "joint order":
            notes.append(f"not taken over, as no file holds it alone: {effect}")
        else:
            world = effect.change.apply(world)
    model, settings = world.system.model, world.settings
    if path.suffix.lower() == ".urdf":
        text = convert(model, "urdf").text
        lost = [x for x in chosen if x.change is not None and {c.where[0] for c in x.change.changes} == {"settings"}]
        notes += [f"a URDF has no settings of a simulation: {x}" for x in lost]
    else:
        text = _mjcf(world.system, settings, notes)
    write(path, text)
    return notes


def _mjcf(system: MergedModel, settings: Settings, notes: list[str]) -> str:
    from mbkit.engines.mujoco.mjcf_writer import mjcf_text
    from mbkit.engines.mujoco.simulation import settings_of

    # Raises where the terms read back otherwise.
    notes += convert(system.model, "mjcf").notes
    text = mjcf_text(system.model, "written by mbkit with causes of another simulation taken over", settings)
    back, _ = settings_of(text, {}, {*system.model.joint_names})
    for f in fields(Settings):
        wanted, there = getattr(settings, f.name), getattr(back, f.name)
        if f.name not in ("engine", "control_period") and wanted != there and (wanted or there):
            raise MbkitError(f"{f.name}: {there} was read back for {wanted}; please report this model")
    return text
