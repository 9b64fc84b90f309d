"""The robots of example-robot-data, by their usual short names and by folder and file."""

from __future__ import annotations

import importlib.metadata
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

from mbkit.errors import LoadError, UnknownNameError

_PACKAGE: Final = "example-robot-data"

# Common names of files with another stem: folder and stem.
_SHORT: Final = {
    "alexander": "alexander_description/alexander_v1.lowerBodyOnly",
    "anymal": "anymal_b_simple_description/anymal",
    "anymal_b": "anymal_b_simple_description/anymal",
    "anymal_b_kinova": "anymal_b_simple_description/anymal-kinova",
    "anymal_c": "anymal_c_simple_description/anymal",
    "asr_twodof": "asr_twodof_description/TwoDofs",
    "borinot": "borinot_description/borinot_flying_arm_2",
    "g1": "g1_description/g1_29dof_rev_1_0",
    "g1_with_hand": "g1_description/g1_29dof_with_hand_rev_1_0",
    "hector": "hector_description/quadrotor_base",
    "hextilt": "hextilt_description/hextilt_flying_arm_5",
    "hyq": "hyq_description/hyq_no_sensors",
    "solo8": "solo_description/solo",
    "talos": "talos_data/talos_reduced",
    "talos_arm": "talos_data/talos_left_arm",
    "talos_box": "talos_data/talos_reduced_box",
    "talos_full": "talos_data/talos_full_v2",
    "talos_full_box": "talos_data/talos_full_v2_box",
    "ur10": "ur_description/ur10_robot",
    "ur10_limited": "ur_description/ur10_joint_limited_robot",
    "ur3": "ur_description/ur3_robot",
    "ur3_limited": "ur_description/ur3_joint_limited_robot",
    "ur5": "ur_description/ur5_robot",
    "ur5_limited": "ur_description/ur5_joint_limited_robot",
}


class Entry(NamedTuple):
    """A URDF of example-robot-data: its folder and file, shorter names, and path."""

    name: str
    aliases: tuple[str, ...]
    path: Path


def entries() -> tuple[Entry, ...]:
    """Return every URDF, by name; `LoadError` where example-robot-data is not installed."""
    return _table()[0]


def find(name: str) -> Entry | None:
    """Return the robot of this name, or None; case and ``-`` or ``_`` do not matter."""
    return _table()[1].get(_key(name))


def canonical(name: str) -> str | None:
    """Return a robot's name as it is listed, whatever its case here; None for any other text."""
    robot = find(name)
    if robot is None:
        return None
    folder, _, stem = robot.name.partition("/")
    spellings = (*robot.aliases, robot.name, f"{_short_folder(folder)}/{stem}")
    return next(s for s in spellings if _key(s) == _key(name))


def unknown(name: str) -> UnknownNameError:
    """Return the error for a name that is neither a robot nor a path."""
    known = sorted({(r.aliases or (r.name,))[0] for r in entries()} | _SHORT.keys() | {r.name for r in entries()})
    return UnknownNameError(
        "robot", name, known, "(a path to a file ends in .urdf or .xml; mbkit robots lists all names)"
    )


def _key(name: str) -> str:
    return name.lower().replace("-", "_")


def _short_folder(folder: str) -> str:
    return folder.removesuffix("_description").removesuffix("_data")


def _files() -> list[tuple[str, str, Path]]:
    """Return folder, stem and path of every URDF, read off the package's file list."""
    try:
        listed = importlib.metadata.files(_PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        listed = None
    if listed is None:
        raise LoadError(f"robots by name come from {_PACKAGE}, which is not installed; pip install {_PACKAGE}")
    out = []
    for file in listed:
        if file.suffix == ".urdf" and "robots" in file.parts[:-2]:
            folder = file.parts[file.parts.index("robots") + 1]
            out.append((folder, file.stem, Path(str(file.locate()))))
    return sorted(out)


@lru_cache(maxsize=1)
def _table() -> tuple[tuple[Entry, ...], dict[str, Entry]]:
    files = _files()
    stems = Counter(_key(stem) for _, stem, _ in files)
    short = {_key(alias) for alias in _SHORT}
    robots = []
    for folder, stem, path in files:
        name = f"{folder}/{stem}"
        aliases = [a for a, full in _SHORT.items() if full == name]
        if stems[_key(stem)] == 1 and _key(stem) not in short:
            aliases.append(stem)
        robots.append(Entry(name, tuple(aliases), path))
    by_key: dict[str, Entry] = {}
    for robot in robots:
        folder, stem = robot.name.split("/")
        for name in (robot.name, f"{_short_folder(folder)}/{stem}", *robot.aliases):
            by_key.setdefault(_key(name), robot)
    return tuple(robots), by_key
