"""`convert`: a description in another format, checked by reading it back."""

from __future__ import annotations

import os
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from mbkit import _process as _interrupt
from mbkit._check import ITERATED, PROBES
from mbkit._escape import xml_holds
from mbkit._version import __version__
from mbkit.engines import dynamics
from mbkit.engines.registry import DERIVED
from mbkit.errors import MbkitError, MbkitWarning, UnsupportedError, require_known, writing
from mbkit.load import load
from mbkit.load.urdf import URDF, urdf_text
from mbkit.model import Model
from mbkit.model.builder import expect_model
from mbkit.model.elements.references import KINDS_OF_PARTS
from mbkit.model.validation import listing
from mbkit.studies._targets import with_values
from mbkit.studies.explain.study import explain
from mbkit.studies.explain.terms import Gap, evaluated, gaps, model_terms, states_of, worst

FORMATS: Final = ("mjcf", "urdf")


@dataclass(frozen=True)
class Converted:
    """A description in another format, and how far each term is off after reading it back."""

    model: str
    format: str
    text: str
    gaps: tuple[Gap, ...]
    notes: tuple[str, ...]

    @property
    def worst(self) -> float:
        """The largest relative difference of a term after reading back."""
        return max((g.relative for g in self.gaps), default=0.0)

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the text to a file, and return its path."""
        out = Path(path)
        with writing(out, "the text itself is kept"), _interrupt.uninterrupted:
            out.write_text(self.text, encoding="utf-8")
        return out

    def __repr__(self) -> str:
        return (
            f"<Converted {self.model!r} to {self.format}: {len(self.text)} characters, read back to {self.worst:.1e}>"
        )


def convert(model: Model, to: str) -> Converted:
    """Write a description as MJCF or URDF, and read it back to see that it says the same.

    The motion alone is written, each kind of part that the format has, and frames; no geometry. MJCF is the MuJoCo
    model that mbkit itself builds, with all digits, read back with MuJoCo's own parser; URDF is read back with
    Pinocchio's.

    Parameters
    ----------
    model : Model
        Parameters take their values.
    to : {"mjcf", "urdf"}

    Returns
    -------
    Converted
        With ``text``, ``notes`` and the differences of terms after reading back.

    Raises
    ------
    UnsupportedError
        The format cannot say what moves it; everything that it cannot say is named. Limits of velocity and effort,
        which act in no term, are notes where MJCF lacks them.
    MbkitError
        What was read back differs, with the reason.

    Examples
    --------
    >>> import mbkit as mb
    >>> mjcf = mb.convert(mb.catalog.pendulum(), "mjcf")
    >>> mjcf.worst < 1e-12
    True
    """
    expect_model(model)
    require_known("format", FORMATS, to)
    _check_names(model, to)
    model = with_values(model, "convert")
    return _to_mjcf(model) if to == "mjcf" else _to_urdf(model)


def _check_names(model: Model, to: str) -> None:
    """Raise for names that XML 1.0 cannot hold, not even escaped."""
    parts = (p for section in KINDS_OF_PARTS for p in getattr(model, section))
    bad = [name for name in dict.fromkeys([model.name, *(p.name for p in parts)]) if not xml_holds(name)]
    if bad:
        names = listing([*map(repr, bad)], 10)
        raise UnsupportedError(f"convert: {to} is XML, which cannot hold the characters of {names}; rename these parts")


def _head(model: Model, check: str) -> str:
    return (
        f"{model.name}, written by mbkit {__version__} from its own description (digest {model.digest[:12]}): the "
        "motion alone, without geometry, contacts, sensors or actuators. Read back when it was written: M, g, nle and "
        f"passive forces {check}."
    )


def _to_mjcf(model: Model) -> Converted:
    from mbkit.engines.mujoco.mjcf_writer import MJCF, mjcf_text, read_back

    notes = MJCF.admit(model)
    text = mjcf_text(model, _head(model, "agreed with the description by MuJoCo's parser and terms"))
    at = states_of(model, PROBES, 0)
    back = read_back(model, text)
    # MuJoCo refuses by name the accelerations that it cannot give: loops beside mimic joints.
    back.mass_matrix(at.q)
    values = evaluated(back, at)
    if model.needs.loops:
        own = dynamics(model, DERIVED, compile=False).constraint_residual(at.q)
        if not np.abs(back.constraint_residual(at.q) - own).max() < ITERATED * max(1.0, np.abs(own).max()):
            raise MbkitError(f"convert: loops of {model.name} read back otherwise; please report this model")
    difference = gaps(model_terms(model, at), values, at, model)
    if worst(difference) > ITERATED:
        why = next((n for n in notes if n.startswith("principal moments")), "please report this model")
        off = ", ".join(f"{g.term} by {g.relative:.1e} at {g.joint}" for g in difference if g.relative > ITERATED)
        off = off or "in its coordinates"
        raise MbkitError(f"convert: what was written of {model.name} reads back otherwise: {off}; {why}")
    return Converted(model.name, "mjcf", text, difference, notes)


def _to_urdf(model: Model) -> Converted:
    notes = [*URDF.admit(model)]
    text = urdf_text(model, _head(model, "agreed with the description by Pinocchio's parser"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(text, encoding="utf-8")
        with warnings.catch_warnings(action="ignore", category=MbkitWarning):
            back = load(path, gravity=model.gravity, nonphysical="warn")
    own = model.without("stops")
    explanation = explain(own, back, samples=PROBES, tolerance=ITERATED, names=("description", "URDF"))
    if explanation.acting or not (explanation.agree or explanation.massless):
        reasons = "; ".join(map(str, explanation.acting)) or explanation.verdict
        raise MbkitError(
            f"convert: what was written of {model.name} reads back otherwise: {reasons}; please report this model"
        )
    if explanation.massless:
        notes.append("no body has mass, so that reading back compares no forces, but bodies and joints alone")
    order = [c.says for c in explanation.causes if c.kind == "joint order"]
    return Converted(model.name, "urdf", text, explanation.gaps, (*notes, *order))
