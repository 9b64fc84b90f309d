"""`lint`: the links, shapes and joints of a description, and what is odd about them."""

from __future__ import annotations

import os
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from mbkit._check import real, shown
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.registry import PINOCCHIO
from mbkit.errors import InputError, LoadError, MbkitError, MbkitWarning, UnsupportedError
from mbkit.load.shapes import MassProperties, together
from mbkit.load.urdf_reader import read_links
from mbkit.model import Body, Model
from mbkit.model.validation import listing
from mbkit.show.scene import SHAPES
from mbkit.show.visuals import read_visuals
from mbkit.studies._targets import model_of, with_values
from mbkit.studies.lint.checks import CHECKS, Judged
from mbkit.studies.lint.geometry import Geometry, geometry_of
from mbkit.studies.lint.result import SURENESS, LintFinding, LintResult
from mbkit.studies.results import provenance

#: What the links of a body may differ by, as a whole, from the body itself.
_SAME = 1e-6


def lint(
    model: Model | str | os.PathLike[str], *, control_period: float = 1e-3, shapes: bool = True
) -> LintResult:
    """Say what is not plausible in a description, by what it knows of itself.
    """
    begun = time.perf_counter()
    real("control_period", control_period, positive=True)
    if not isinstance(model, Model):
        if not isinstance(model, (str, os.PathLike)):
            raise InputError(f"model: expected a Model, a robot's name or a path, got {shown(model)}")
        with warnings.catch_warnings(action="ignore", category=MbkitWarning):
            model = model_of(os.fspath(model), {"nonphysical": "warn"})
    if not model.has_bodies:
        raise UnsupportedError(f"lint: {model.name} was written as energies and has no bodies to judge")
    model = with_values(model, "lint")
    skipped: list[str] = []
    links = _links(model)
    geometry = _geometry(links, skipped) if shapes else {}
    if not shapes:
        skipped.append("shapes were not read")
    at = Judged(model, links, geometry, control_period, _engine(model, skipped))
    found = [finding for check in CHECKS.values() for finding in check.run(at)]
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


def _links(model: Model) -> Model:
    """Return the links of a URDF, which the model merged; the model itself where its file says something else."""
    if model.source.lower().endswith(".urdf"):
        with suppress(MbkitError), warnings.catch_warnings(action="ignore", category=MbkitWarning):
            links = replace(read_links(Path(model.source)), source=model.source)
            if all(_is(body, model, links) for body in model.bodies):
                return links
    return model


def _is(body: Body, model: Model, links: Model) -> bool:
    """Return whether a body is its links together."""
    parts = []
    for link in links.bodies:
        frame = model.frame(link.name)
        if frame.body == body.name and link.mass:
            parts.append(MassProperties(link.mass, link.com, link.inertia).moved(frame.rotation, frame.translation))
    whole = together(parts) if parts else MassProperties(0.0, body.com, np.zeros((3, 3)))
    pairs = (whole.mass, body.mass), (whole.com, body.com), (whole.inertia, body.inertia)
    return all(np.allclose(a, b, rtol=_SAME, atol=_SAME * np.abs(b).max()) for a, b in pairs)


def _geometry(links: Model, skipped: list[str]) -> dict[str, Geometry]:
    kinds: dict[str, list[list[object]]] = defaultdict(list)
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
        if model.constrained:
            raise UnsupportedError("constraints share the forces")
        return dynamics(model, PINOCCHIO)
    except MbkitError as error:
        skipped.append(f"effort and damping: {error}")
        return None
