"""Versions and processor, for every report."""

from __future__ import annotations

import platform
from functools import cache
from importlib import metadata
from pathlib import Path

from mbkit._version import __version__

__all__ = ["processor", "versions"]

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
