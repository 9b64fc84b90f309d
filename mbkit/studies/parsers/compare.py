"""`compare_parsers`: does every engine's own importer read the same robot out of a file."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from mbkit._check import count, real
from mbkit.engines.imported import IMPORTERS, Imported, check_installed
from mbkit.errors import InputError, MbkitError, MbkitWarning, UnknownNameError, UnsupportedError
from mbkit.load import names
from mbkit.load.mjcf import model_of_mjcf
from mbkit.load.stripped import Stripped, strip
from mbkit.load.urdf_links import urdf_links
from mbkit.model import Model
from mbkit.studies import stamp
from mbkit.studies.causes.explaining import explain
from mbkit.studies.parsers.process import ImporterError, Reading, one_at_a_time
from mbkit.studies.parsers.result import Parsed, ParserComparison
from mbkit.studies.parsers.stages import OwnTerms, measured, own_terms, stages

__all__ = ["compare_parsers", "written"]


def compare_parsers(
    source: str | os.PathLike[str],
    importers: Sequence[str] = tuple(IMPORTERS),
    *,
    floating_base: bool = False,
    samples: int = 3,
    seed: int = 0,
    tolerance: float = 1e-9,
    seconds: float = 60.0,
) -> ParserComparison:
    """Read a file with each engine's own importer, and compare what comes out with the file as written.

    The importers are given the file without meshes and textures, so that nothing else is opened but what
    an MJCF includes and the meshes from which its bodies take their inertia; boxes, cylinders and spheres
    stay. Each runs in a process of its own, kept until this one ends: a crash or an endless loop there is
    told like any other refusal.

    What each made is compared stage by stage: joints, kinds, parents, places, axes, mimic joints, masses,
    centres of mass, inertias, armature, damping, friction, limits, and M, g, nle and passive by joint name,
    by the engine itself on its own model, with all that it holds beside bodies and joints: flags, tendons,
    actuators at zero control, fluid, gravity compensation. Links that an importer fuses are fused on the
    other side too. Why one differs is in its ``explanation``.

    Where mbkit does not read the file, an MJCF is compared with MuJoCo's own reading, and any other file
    with nothing: the importers that read it are only listed.

    Parameters
    ----------
    source : str or path
        A URDF or MJCF file, or a robot of example-robot-data.
    importers : sequence of str
        Of pinocchio, mujoco and drake. One that is not installed is told as refusing.
    floating_base : bool
        Whether the base moves freely, in the file's reading and in every importer's.
    samples, seed : int
        Random states for the terms.
    tolerance : float
        Relative difference that counts.
    seconds : float
        That an importer may take over the file, of the processor's time.

    Returns
    -------
    ParserComparison

    Raises
    ------
    LoadError
        The file, or one that it includes, is missing or unreadable; or it is neither URDF nor MJCF.
    ModelError
        The base of an MJCF is to float, and no single body stands still in its world.
    """
    begun = time.perf_counter()
    for name in importers:
        if name not in IMPORTERS:
            raise UnknownNameError("importer", str(name), IMPORTERS)
    if isinstance(importers, str) or not importers:
        raise InputError(f"importers: expected some of {', '.join(IMPORTERS)}, got {importers!r}")
    count("samples", samples, least=1)
    count("seed", seed)
    real("tolerance", tolerance, positive=True)
    real("seconds", seconds, positive=True)
    stripped = strip(_path(source), floating_base=floating_base)
    engines = tuple(dict.fromkeys(importers))
    parsed: dict[str, Parsed] = {}
    with one_at_a_time():
        read, refused = _read(stripped, engines, floating_base, seconds)
        reference, label, faults = _reference(stripped, read, floating_base)
        for engine, made in read.items():
            if reference is None or engine == label:
                parsed[engine] = Parsed(engine, _version(engine), notes=_alone(made))
                continue
            try:
                parsed[engine] = _compared(engine, made, reference, label, samples, seed, tolerance)
            except ImporterError as error:
                refused[engine] = str(error)
    parsed |= {engine: Parsed(engine, _version(engine), why) for engine, why in refused.items()}
    return ParserComparison(
        source=os.fspath(source),
        format=stripped.format,
        floating_base=floating_base,
        reference=label,
        faults=faults,
        importers=tuple(parsed[engine] for engine in engines),
        notes=tuple(_notes(stripped)),
        samples=samples,
        seed=seed,
        tolerance=tolerance,
        versions=stamp.versions(),
        processor=stamp.processor(),
        seconds=time.perf_counter() - begun,
    )


def _read(
    stripped: Stripped, engines: Sequence[str], floating_base: bool, seconds: float
) -> tuple[dict[str, Imported], dict[str, str]]:
    """Return what each importer made of a file, and why the others did not; all read at the same time."""
    begun: dict[str, Reading] = {}
    read: dict[str, Imported] = {}
    refused: dict[str, str] = {}

    for engine in engines:
        try:
            check_installed(engine)
            begun[engine] = Reading(engine, stripped.text, stripped.format, floating_base, stripped.meshes, seconds)
        except (UnsupportedError, ImporterError) as error:
            refused[engine] = str(error)
    for engine, reading in begun.items():
        try:
            reading.send()
        except ImporterError as error:
            refused[engine] = str(error)
    for engine in [e for e in begun if e not in refused]:
        try:
            read[engine] = begun[engine].made()
        except ImporterError as error:
            refused[engine] = str(error)
    return read, refused


def _compared(
    engine: str, made: Imported, reference: Model | Imported, label: str, samples: int, seed: int, tolerance: float
) -> Parsed:
    """Return what an importer made, against the reference."""
    described = reference.model if isinstance(reference, Imported) else reference
    found = explain(described, made.model, samples=samples, seed=seed, tolerance=tolerance, names=(label, engine))
    compared = stages(reference, made, samples, seed, tolerance)
    own = own_terms(engine, made, samples, seed, tolerance)
    if isinstance(reference, Imported):
        theirs = own_terms(label, reference, samples, seed, tolerance)
        own = OwnTerms((*theirs.causes, *own.causes), own.idle, own.held and theirs.held)
    notes = (*found.notes, *made.notes, *own.notes)
    return Parsed(engine, _version(engine), "", compared, measured(found, compared, own), notes)


def _alone(made: Imported) -> tuple[str, ...]:
    """Return the notes on an importer that is compared with nothing."""
    return (*made.notes, *(x.says for x in made.beside))


def written(source: str | os.PathLike[str]) -> Model:
    """Return a file as it is written: nothing fused and no engine's parser between, a URDF link by link."""
    return _written(strip(_path(source)), floating_base=False)


def _path(source: str | os.PathLike[str]) -> Path:
    if isinstance(source, str) and not source.lower().endswith((".urdf", ".xml", ".mjcf")):
        robot = names.find(source)
        if robot is not None:
            return robot.path
        if not os.path.exists(source) and os.sep not in source:
            raise names.unknown(source)
    if not isinstance(source, (str, os.PathLike)):
        raise InputError(f"source: expected a path or a robot's name, got {source!r}")
    return Path(os.fspath(source))


def _written(stripped: Stripped, floating_base: bool) -> Model:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        if stripped.format == "urdf":
            return urdf_links(stripped.root, str(stripped.path), floating_base=floating_base)
        return model_of_mjcf(
            stripped.root, stripped.path, floating_base=False, nonphysical="warn", gravity=None, meshes="auto"
        )


def _reference(
    stripped: Stripped, read: dict[str, Imported], floating_base: bool
) -> tuple[Model | Imported | None, str, str]:
    """Return what the importers are compared with, what it is called, and why it is not the file itself.

    MJCF means what MuJoCo makes of it. For a URDF no importer has that standing.
    """
    try:
        return _written(stripped, floating_base), "file", ""
    except MbkitError as error:
        faults = f"mbkit does not read it: {error}"
    if stripped.format == "mjcf" and "mujoco" in read:
        return read["mujoco"], "mujoco", faults
    return None, "", faults


def _notes(stripped: Stripped) -> list[str]:
    out = []
    if stripped.gone:
        told = ", ".join(f"{n} {tag}" for tag, n in stripped.gone)
        out.append(f"taken out before, because they name other files or say nothing of the motion: {told}")
    if stripped.meshes:
        out.append(f"opened, because bodies take their inertia from them: {', '.join(stripped.meshes)}")
    out += stripped.unread
    if stripped.renamed:
        out.append(f"the base link 'world' is called {stripped.renamed!r}: importers take that name for the ground")
    if stripped.shapeless:
        some = ", ".join(stripped.shapeless[:6]) + (", ..." if len(stripped.shapeless) > 6 else "")
        out.append(f"bodies without <inertial>, whose meshes MuJoCo would have given a mass: {some}")
    return out


def _version(engine: str) -> str:
    try:
        return metadata.version(IMPORTERS[engine].distribution)
    except metadata.PackageNotFoundError:
        return "not installed"
