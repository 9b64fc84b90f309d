"""`load`: a robot's name or a file in, a `Model` out."""

from __future__ import annotations

import os
import re
import warnings
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from types import NoneType
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import shown
from mbkit._warn import warn
from mbkit.errors import InputError, LoadError, MbkitError, MbkitWarning, ModelError
from mbkit.load import robot_data, xml_reader
from mbkit.load.robot_data import entries
from mbkit.load.urdf_check import examine
from mbkit.load.xml_reader import expanded
from mbkit.model import Model
from mbkit.model.validation import scale_doubts

# `Path` drops one of the two slashes.
_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/[^\\]")
_GRAVITY: Final = (0.0, 0.0, -9.81)


def load(
    source: str | os.PathLike[str],
    *,
    floating_base: bool = False,
    mimic: Literal["reduce", "free"] = "reduce",
    nonphysical: Literal["error", "warn"] | None = None,
    gravity: ArrayLike | None = None,
    meshes: Literal["auto", "never"] = "auto",
) -> Model:
    """Load a robot by name, or a URDF or MJCF file.

    The only other files that are opened are those that an MJCF includes, and the meshes that give a body of an
    MJCF its inertia. The model's ``notes`` name all decisions (mimic joints, parts left out, rounded zeros, opened
    files). Tendons and actuators of an MJCF act as springs, dampers and
    rotors where their forces at zero control are linear.

    Parameters
    ----------
    source : str or path
        A robot of example-robot-data, such as ``"panda"`` or
        ``"ur_description/ur5_gripper"`` (`robots` lists them), or a path.
    floating_base : bool
        Whether the base link moves freely, on a joint named ``"root_joint"``.
    mimic : {"reduce", "free"}
        What a URDF's mimic joints become: functions of the joints they follow,
        without coordinates of their own, or independent joints. MJCF has none: its
        equality constraints are left out, and noted.
    nonphysical : {"error", "warn"}, optional
        What to do about inconsistent inertias: refuse them, or use them as
        written with a warning. By default robots by name warn, and files are refused.
        A negative mass is always refused.
    gravity : (3,) array_like, optional
        m/s², in world axes; by default the file's own (MJCF), else (0, 0, -9.81).
    meshes : {"auto", "never"}
        Whether an MJCF's meshes are read where a body has no other inertia. MuJoCo's compiler infers it.
        With "never" such bodies are refused.

    Returns
    -------
    Model
        With one body for every moving joint of a URDF (links fixed to each other are
        merged and stay as frames), joints in Pinocchio's order; for an MJCF with its
        bodies and joints in the file's order.

    Raises
    ------
    UnknownNameError
        No robot has this name.
    LoadError
        The file, or one that it includes, is missing, or is not readable as a URDF or MJCF.
    ModelError
        The file has faults; all of them are listed.

    Warns
    -----
    NonPhysicalWarning
        Some inertias are inconsistent and were used as written.
    MbkitWarning
        Masses or lengths are so far apart that engines lose digits in double precision.

    Examples
    --------
    >>> import mbkit as mb
    >>> mb.load("panda").nv
    8
    >>> mb.load("panda", mimic="free").nv
    9
    """
    for name, value, allowed, expected in (
        ("mimic", mimic, ("reduce", "free"), "'reduce' or 'free'"),
        ("nonphysical", nonphysical, ("error", "warn", None), "'error', 'warn' or None"),
        ("floating_base", floating_base, (True, False), "True or False"),
        ("meshes", meshes, ("auto", "never"), "'auto' or 'never'"),
    ):
        if not isinstance(value, (str, bool, np.bool_, NoneType)) or value not in allowed:
            raise InputError(f"{name}: expected {expected}, got {shown(value)}")
    path, by_name = _resolved(source)
    policy = nonphysical or ("warn" if by_name else "error")
    root = xml_reader.read(path)
    if root.tag == "robot":
        # Pinocchio is imported only for a URDF.
        from mbkit.load.urdf import model_of

        urdf = examine(
            root, str(path), floating_base=floating_base, mimic_matters=mimic == "reduce", lenient=policy == "warn"
        )
        model = model_of(
            urdf,
            str(path),
            floating_base=floating_base,
            mimic=mimic,
            nonphysical=policy,
            gravity=_GRAVITY if gravity is None else gravity,
        )
    elif root.tag == "mujoco":
        from mbkit.load.mjcf import model_of_mjcf

        root_with_includes = expanded(root, path)
        model = model_of_mjcf(
            root_with_includes, path, floating_base=floating_base, nonphysical=policy, gravity=gravity, meshes=meshes
        )
    else:
        raise LoadError(f"{path}: the root element is <{root.tag[:60]}>; expected <robot> (URDF) or <mujoco> (MJCF)")
    doubts = scale_doubts(model)
    if doubts:
        warn(f"{path}: engines may lose digits: {'; '.join(doubts)}", MbkitWarning)
    return replace(model, notes=(*root.notes, *model.notes)) if root.notes else model


def _resolved(source: str | os.PathLike[str]) -> tuple[Path, bool]:
    """Return the file, and whether the source is a robot's name."""
    if not isinstance(source, (str, os.PathLike)):
        raise InputError(f"source: expected a robot's name or a path, got {shown(source)}")
    text = os.fspath(source)
    if not isinstance(text, str):
        raise InputError(f"source: expected a path of characters, got bytes {shown(text)}")
    if not text:
        raise InputError("source: expected a robot's name or a path, got an empty text")
    if _URL.match(text) and not os.path.exists(text):
        raise LoadError(f"{text}: this is a URL, and mbkit reads local files; download it and give its path")
    if isinstance(source, str):
        looks_like_path = text.lower().endswith((".urdf", ".xml", ".mjcf"))
        robot = None if looks_like_path else robot_data.find(text)
        if robot is not None:
            return robot.path, True
        if not looks_like_path and not os.path.exists(text):
            raise robot_data.unknown(text)
    return Path(text), False


@dataclass(frozen=True)
class Robot:
    """A URDF of example-robot-data; the file is read at the first use of its size.

    Attributes
    ----------
    name : str
        Folder and file, such as ``"panda_description/panda"``.
    aliases : tuple of str
        Shorter names, the usual one first.
    path : pathlib.Path
    """

    name: str
    aliases: tuple[str, ...]
    path: Path

    @cached_property
    def _facts(self) -> tuple[int | None, int | None, float | None, str | None]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", MbkitWarning)
                model = load(self.name)
        except ModelError as error:
            return None, None, None, "; ".join(error.faults)
        except MbkitError as error:
            return None, None, None, str(error)
        return model.nq, model.nv, model.mass, None

    @property
    def nq(self) -> int | None:
        """Number of coordinates, mimic joints reduced; None if it does not load."""
        return self._facts[0]

    @property
    def nv(self) -> int | None:
        """Number of velocities; None if it does not load."""
        return self._facts[1]

    @property
    def mass(self) -> float | None:
        """Total mass in kg; None if it does not load."""
        return self._facts[2]

    @property
    def reason(self) -> str | None:
        """Why it does not load; None if it does."""
        return self._facts[3]


def robots() -> tuple[Robot, ...]:
    """Return a record of every robot of example-robot-data, by name.

    Returns
    -------
    tuple of Robot
        Each with ``name``, ``aliases``, ``path``, and ``nq``, ``nv``, ``mass`` or the
        ``reason`` why it does not load; the last four load the file at their first use.

    Raises
    ------
    LoadError
        example-robot-data is not installed.
    """
    return _records()


@lru_cache(maxsize=1)
def _records() -> tuple[Robot, ...]:
    return tuple(Robot(*entry) for entry in entries())
