"""`lint`: the links, shapes and joints of a description, and what is odd about them."""

from __future__ import annotations

import os
import time
import warnings
from collections import defaultdict
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit._check import PRINTED, real, shown
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.registry import PINOCCHIO
from mbkit.errors import (
    InputError,
    LoadError,
    MbkitError,
    MbkitWarning,
    ModelError,
    NonPhysicalWarning,
)
from mbkit.load import xml_reader
from mbkit.load.shapes import NOTHING, MassProperties, together
from mbkit.load.urdf_reader import read_links
from mbkit.model import Model
from mbkit.model.elements import paths
from mbkit.model.validation import listing
from mbkit.show.scene import SHAPES
from mbkit.show.visuals import Shape, read_visuals
from mbkit.studies._targets import model_of, with_values
from mbkit.studies.explain.merged_model import Tolerances
from mbkit.studies.lint.checks import CHECKS, Geometry, Judged, geometry_of
from mbkit.studies.lint.result import SURENESS, LintResult
from mbkit.studies.results import provenance

LINT: Final = paths.Path(
    "lint",
    "lint cannot judge",
    paths.OF_BODIES,
    notes=dict.fromkeys(("row", "speed"), "effort and damping: constraints share the forces"),
)


def lint(
    model: Model | str | os.PathLike[str], *, control_period: float = 1e-3, shapes: bool = True, **load: Any
) -> LintResult:
    r"""Say what is not plausible in a description, by what it knows of itself; engines agree on a file in grams too.

    Judged are the links of a URDF as the file has them, also those that the model merges, and the bodies of every other
    model: their masses, centres of mass and inertias against each other, their names and their shapes, and the limits,
    actuators and dampers of joints. `mbkit.studies.lint.checks.CHECKS` has all checks with what each looks at. Nothing
    is refused: links that no matter has are findings.

    Parameters
    ----------
    model : Model, str or path
        Or what `mbkit check` takes: a robot's name, a path, ``"package.module:function"``.
    control_period : float
        Of the controller or of the steps, s: a damper should not be faster.
    shapes : bool
        Whether the shapes and meshes of the file are read. What needs them is not judged without.
    **load
        Arguments of `mbkit.load` for a name or a path, such as ``floating_base=True``.

    Returns
    -------
    LintResult

    Raises
    ------
    UnsupportedError
        A model written as energies.
    LoadError, ModelError, UnknownNameError
        The model cannot be read.
    InputError
        A parameter of the model has no value, or another argument is wrong.

    Examples
    --------
    >>> import mbkit as mb
    >>> b = mb.ModelBuilder("in_grams")
    >>> b.add_body("arm", mass=1200.0, com=(0, 0, 0.2), inertia=(1.0, 1.0, 1.0))
    >>> b.add_joint("shoulder", "revolute", parent="world", child="arm", axis=(0, 1, 0), upper=90, effort_limit=50)
    >>> print(*mb.lint(b.build()).rows, sep="\n")
    shoulder: holding it against gravity takes 2.35e+03, and its effort is limited to 50 (effort, sure)
    arm: inertia 1 kg m² about every axis, with 1200 kg (placeholder, likely)
    shoulder: limits 90 rad, whole numbers as of degrees (limits in degrees, likely)
    """
    begun = time.perf_counter()
    control_period = real("control_period", control_period, positive=True)
    if not isinstance(shapes, (bool, np.bool_)):
        raise InputError(f"shapes: expected True or False, got {shown(shapes)}")
    if not isinstance(model, Model):
        model = _read(model, load)
    elif load:
        raise InputError(f"{', '.join(load)}: only for a name or a path; the model is loaded already")
    skipped = [*LINT.admit(model)]
    model = with_values(model, "lint")
    links = _links(model)
    geometry = _geometry(links, skipped) if shapes else {}
    if not shapes:
        skipped.append("shapes were not read")
    at = Judged(model, links, geometry, control_period, _engine(model, skipped), _axes(links))
    found = [finding for run in CHECKS.values() for finding in run(at)]
    return LintResult(
        model=model.name,
        rows=tuple(sorted(found, key=lambda row: SURENESS.index(row.confidence))),
        links=len(at.bodies),
        joints=sum(joint.type.nv > 0 for joint in model.joints),
        shaped=sum(1 for _ in at.shaped()),
        skipped=tuple(skipped),
        control_period=control_period,
        **provenance(begun),
    )


def _read(target: object, options: dict[str, Any]) -> Model:
    if not isinstance(target, (str, os.PathLike)):
        raise InputError(f"model: expected a Model, a robot's name or a path, got {shown(target)}")
    path = os.fspath(target)
    with warnings.catch_warnings(action="ignore", category=NonPhysicalWarning):
        try:
            return model_of(path, options)
        except ModelError:
            if "nonphysical" in options:
                raise
            return model_of(path, {**options, "nonphysical": "warn"})


def _links(model: Model) -> Model:
    """Return the links of a URDF, which the model merged; the model itself where its file says something else."""
    if model.source.lower().endswith(".urdf"):
        with suppress(MbkitError), warnings.catch_warnings(action="ignore", category=MbkitWarning):
            links = replace(read_links(Path(model.source)), source=model.source)
            near, parts = Tolerances.of(model, PRINTED), defaultdict[str, list[MassProperties]](list)
            for link in links.bodies:
                frame, own = model.frame(link.name), MassProperties(link.mass, link.com, link.inertia)
                parts[frame.body] += [own.moved(frame.rotation, frame.translation)] if link.mass else []
            wholes = {body: together(some) for body, some in parts.items() if some}
            if all(near.same(wholes.get(body.name, NOTHING), body) for body in model.bodies):
                return links
    return model


def _axes(links: Model) -> dict[str, float]:
    """Return the lengths of the axes of a URDF, which loaded; the axes of a fixed joint say nothing."""
    moving = {j.name for j in links.joints if j.type.nv}
    joints = xml_reader.read(Path(links.source)).all("joint") if links.source.lower().endswith(".urdf") else []
    axes = {e.attributes["name"]: e.first("axis") for e in joints if e.attributes["name"] in moving}
    return {k: float(np.linalg.norm([*map(float, e.attributes["xyz"].split())])) for k, e in axes.items() if e}


def _geometry(links: Model, skipped: list[str]) -> dict[str, Geometry]:
    kinds: dict[str, list[list[Shape]]] = defaultdict(list)
    missing: dict[str, str] = {}
    try:
        for kind in SHAPES[:2]:
            found = read_visuals(links, kind)
            missing |= found.missing
            for name in {shape.body for shape in found.shapes}:
                kinds[name].append([shape for shape in found.shapes if shape.body == name])
    except LoadError as error:
        skipped.append(f"shapes are not read: {error}")
    if missing:
        skipped.append(f"shapes that cannot be read: {listing([f'{k} ({why})' for k, why in missing.items()], 3)}")
    return {name: shape for name, some in kinds.items() if (shape := geometry_of(some)) is not None}


def _engine(model: Model, skipped: list[str]) -> Dynamics | None:
    try:
        return None if model.constrained else dynamics(model, PINOCCHIO)
    except MbkitError as error:
        skipped.append(f"effort and damping: {error}")
        return None
