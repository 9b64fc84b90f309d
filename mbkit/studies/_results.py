"""Results as plain data and back: null for NaN, numbers as CSV has them, and files."""

from __future__ import annotations

import math
import platform
from dataclasses import dataclass, fields
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from mbkit._version import __version__
from mbkit.errors import OutputError
from mbkit.model import Model

__all__ = ["Refusal", "cell", "facts_of", "plain", "processor", "remade", "versions", "write"]


@dataclass(frozen=True)
class Refusal:
    """Something that an engine could not do, with its reason; `term` is empty for all of it."""

    engine: str
    term: str
    reason: str


def plain(value: Any) -> Any:
    """Return data as JSON can hold it: tuples as lists, and None for what is not finite."""
    if isinstance(value, dict):
        return {k: plain(x) for k, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(x) for x in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def remade(kind: type[Any], told: dict[str, Any]) -> Any:
    """Return a dataclass from plain data; null is NaN, and what it does not have is left out."""
    names = [f.name for f in fields(kind) if f.name in told]
    return kind(**{n: math.nan if told[n] is None else told[n] for n in names})


def cell(x: float) -> str:
    """Return a number with all its digits for CSV, empty for NaN."""
    return "" if math.isnan(x) else repr(x)


def write(path: str | Path, text: str) -> None:
    """Write a text that somebody asked for.

    Raises
    ------
    OutputError
        It cannot be written there.
    """
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}; choose a folder that exists") from error


# What a report says of a model.


def facts_of(model: Model) -> dict[str, Any]:
    """Return size, mass, digest, needs, joints, notes and faults of matter, as plain data."""
    return {
        "nq": model.nq,
        "nv": model.nv,
        # Energies do not tell it.
        **({} if model.written is not None else {"mass": model.mass}),
        "digest": model.digest,
        "needs": model.needs.as_dict(),
        "joints": list(model.joint_names),
        "notes": list(model.notes),
        "nonphysical": [f"{name}: {why}" for name, why in model.nonphysical],
    }


# Versions and processor, for every report.

_PACKAGES = ("pin", "mujoco", "drake", "casadi", "numpy", "scipy", "llvmlite", "heyoka", "mpmath", "example-robot-data")


def versions() -> dict[str, str]:
    """Return the versions of everything that computes."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    # Found among the files of all that is installed, in some 10 ms.
    out = {"mbkit": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            out[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            out[package] = "not installed"
    return out


def processor() -> str:
    """Return the processor's model name and the system."""
    name = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return f"{name}, {platform.system()} {platform.machine()}"
