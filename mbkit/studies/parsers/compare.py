"""`compare_parsers`: does every engine's own importer read the same robot out of a file."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from mbkit._check import count, real
from mbkit.engines.imported import IMPORTERS, Imported, importer
from mbkit.errors import InputError, MbkitError, MbkitWarning, UnknownNameError
from mbkit.load import names
from mbkit.load.mjcf import model_of_mjcf
from mbkit.load.stripped import Stripped, strip
from mbkit.load.urdf_links import urdf_links
from mbkit.model import Model
from mbkit.studies.causes.explaining import explain
from mbkit.studies.causes.terms import gaps, model_terms, states_of
from mbkit.studies.parsers.result import Parsed, ParserComparison
from mbkit.studies.parsers.stages import stages

__all__ = ["compare_parsers", "written"]


def compare_parsers(
    source: str | os.PathLike[str],
    importers: Sequence[str] = tuple(IMPORTERS),
    *,
    samples: int = 3,
    seed: int = 0,
    tolerance: float = 1e-9,
) -> ParserComparison:
    """Read a file with each engine's own importer, and compare what comes out with the file as written.

    The importers are given the file without meshes and textures, so that nothing else is opened; boxes,
    cylinders and spheres stay. What each made is compared stage by stage: joints, kinds, parents,
    places, axes, mimic joints, masses, centres of mass, inertias, armature, damping, friction, limits, and
    M, g and nle by joint name, by the engine itself on its own model. Links that an importer fuses are fused on
    the other side too. Why one differs is in its ``explanation``.

    Parameters
    ----------
    source : str or path
        A URDF or MJCF file, or a robot of example-robot-data.
    importers : sequence of str
        Of pinocchio, mujoco and drake. One that is not installed is told as refusing.
    samples, seed : int
        Random states for the terms.
    tolerance : float
        Relative difference that counts.

    Returns
    -------
    ParserComparison

    Raises
    ------
    LoadError
        The file is missing, is neither URDF nor MJCF, or is written in several files.
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
    stripped = strip(_path(source))
    read: dict[str, Imported] = {}
    refused: dict[str, str] = {}
    for engine in dict.fromkeys(importers):
        try:
            read[engine] = importer(engine)(stripped.text, stripped.format)
        except MbkitError as error:
            refused[engine] = str(error).removeprefix(f"{engine}: ")
    reference, label, faults = _reference(stripped, read)
    parsed = []
    for engine in dict.fromkeys(importers):
        if engine in refused:
            parsed.append(Parsed(engine, _version(engine), refused[engine]))
            continue
        made = read[engine]
        assert reference is not None
        found = explain(reference, made.model, samples=samples, seed=seed, tolerance=tolerance, names=(label, engine))
        compared = stages(reference, made, samples, seed, tolerance)
        notes = (*found.notes, *made.notes, *_unheld(made, samples, seed, tolerance))
        parsed.append(Parsed(engine, _version(engine), "", compared, found, notes))
    return ParserComparison(
        source=str(stripped.path),
        format=stripped.format,
        reference=label,
        faults=faults,
        importers=tuple(parsed),
        notes=tuple(_notes(stripped)),
        samples=samples,
        seed=seed,
        tolerance=tolerance,
        seconds=time.perf_counter() - begun,
    )


def written(source: str | os.PathLike[str]) -> Model:
    """Return a file as it is written: nothing fused and no engine's parser between, a URDF link by link."""
    return _written(strip(_path(source)))


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


def _written(stripped: Stripped) -> Model:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        if stripped.format == "urdf":
            return urdf_links(stripped.root, str(stripped.path))
        return model_of_mjcf(stripped.root, stripped.path, floating_base=False, nonphysical="warn", gravity=None)


def _reference(stripped: Stripped, read: dict[str, Imported]) -> tuple[Model | None, str, str]:
    """Return what the importers are compared with, what it is called, and why it is not the file itself."""
    try:
        return _written(stripped), "file", ""
    except MbkitError as error:
        faults = f"mbkit does not read it: {error}"
    for engine, made in read.items():
        return made.model, engine, faults
    return None, "", faults


def _unheld(made: Imported, samples: int, seed: int, tolerance: float) -> list[str]:
    """Say where an engine's own terms are not those of what was read out of it."""
    at = states_of(made.model, samples, seed)
    owners = [j.name for j in made.model.independent_joints for _ in range(j.type.nv)]
    found = gaps(made.terms(at.q, at.v), model_terms(made.model, at), at.v, owners)
    if found.worst <= tolerance:
        return []
    return [f"its own terms are not those of its bodies and joints: {found.worst:.1e} at {found.joint}"]


def _notes(stripped: Stripped) -> list[str]:
    out = []
    if stripped.gone:
        told = ", ".join(f"{n} {tag}" for tag, n in stripped.gone)
        out.append(f"taken out before, because they name other files or say nothing of the motion: {told}")
    if stripped.shapeless:
        some = ", ".join(stripped.shapeless[:6]) + (", ..." if len(stripped.shapeless) > 6 else "")
        out.append(f"bodies without <inertial>, whose meshes MuJoCo would have given a mass: {some}")
    return out


def _version(engine: str) -> str:
    try:
        return metadata.version(IMPORTERS[engine][1])
    except metadata.PackageNotFoundError:
        return "not installed"
