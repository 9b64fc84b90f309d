"""Which package computes for which engine, and which of them have moved."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from mbkit.studies import stamp

__all__ = ["VersionChange", "moved", "of_engine", "relevant"]

#: What an engine's numbers come from. The own derivation is interpreted by CasADi here.
_PACKAGES: Final = {"pinocchio": "pin", "lagrangian": "casadi", "mujoco": "mujoco", "drake": "drake"}
# The description and the states come from these, whatever the engine.
_SHARED: Final = ("mbkit", "pin", "numpy")


@dataclass(frozen=True)
class VersionChange:
    """A package whose version differs."""

    package: str
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.package} {self.old} → {self.new}"


_ABSENT: Final = "not installed"


def relevant(engines: Iterable[str]) -> dict[str, str]:
    """Return the versions that can move numbers of these engines."""
    packages = dict.fromkeys([*_SHARED, *(_PACKAGES[e] for e in engines if e in _PACKAGES)])
    now = stamp.versions()
    return {p: now[p] for p in packages}


def moved(old: Mapping[str, str], new: Mapping[str, str]) -> tuple[VersionChange, ...]:
    """Return what differs among the packages of both; what is not installed has no version."""
    return tuple(VersionChange(p, x, new[p]) for p, x in old.items() if new.get(p, _ABSENT) not in (x, _ABSENT))


def of_engine(engine: str, old: Mapping[str, str], changed: Iterable[VersionChange]) -> str:
    """Return which version of an engine moved, or that none did, for a failure."""
    changed = tuple(changed)
    package = _PACKAGES.get(engine, "mbkit")
    own = [str(m) for m in changed if m.package == package]
    others = [str(m) for m in changed if m.package in _SHARED and m.package != package]
    told = own or [f"{package} {old.get(package, '?')}, as recorded"]
    return "; ".join([*told, *others])
