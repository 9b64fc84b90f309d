"""`load`: a robot's name or a file in, a `Model` out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final, Literal

from numpy.typing import ArrayLike

from mbkit.errors import InputError, LoadError
from mbkit.load import names, xml
from mbkit.load.includes import expanded
from mbkit.load.urdf_file import examine
from mbkit.model import Model

__all__ = ["load"]

_GRAVITY: Final = (0.0, 0.0, -9.81)


def load(
    source: str | os.PathLike[str],
    *,
    floating_base: bool = False,
    mimic: Literal["reduce", "free"] = "reduce",
    nonphysical: Literal["error", "warn"] | None = None,
    gravity: ArrayLike | None = None,
) -> Model:
    """Load a robot by name, or a URDF or MJCF file.

    No mesh is opened, and no other file but those that an MJCF includes. What was decided on the way
    (mimic joints, parts left out, rounded zeros) stands in the model's ``notes``. Tendons and actuators of an
    MJCF act as springs, dampers and rotors where their forces at zero control are linear.

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
        What to do about bodies that no matter is like: refuse them, or take them as
        written with a warning. By default robots by name warn, and files are refused.
        A negative mass is always refused.
    gravity : (3,) array_like, optional
        m/s², in world axes; by default the file's own (MJCF), else (0, 0, -9.81).

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
        Some bodies can be of no matter, and were taken as written.

    Examples
    --------
    >>> import mbkit as mb
    >>> mb.load("panda").nv
    8
    >>> mb.load("panda", mimic="free").nv
    9
    """
    if mimic not in ("reduce", "free"):
        raise InputError(f"mimic: expected 'reduce' or 'free', got {mimic!r}")
    if nonphysical not in ("error", "warn", None):
        raise InputError(f"nonphysical: expected 'error', 'warn' or None, got {nonphysical!r}")
    path, by_name = _resolved(source)
    policy = nonphysical or ("warn" if by_name else "error")
    root = xml.read(path)
    if root.tag == "robot":
        # Pinocchio is loaded by whoever needs it.
        from mbkit.load.urdf import model_of

        urdf = examine(
            root, str(path), floating_base=floating_base, mimic_matters=mimic == "reduce", lenient=policy == "warn"
        )
        return model_of(
            urdf,
            str(path),
            floating_base=floating_base,
            mimic=mimic,
            nonphysical=policy,
            gravity=_GRAVITY if gravity is None else gravity,
        )
    if root.tag == "mujoco":
        from mbkit.load.mjcf import model_of_mjcf

        whole = expanded(root, path)
        return model_of_mjcf(whole, path, floating_base=floating_base, nonphysical=policy, gravity=gravity)
    raise LoadError(f"{path}: the root element is <{root.tag[:60]}>; expected <robot> (URDF) or <mujoco> (MJCF)")


def _resolved(source: str | os.PathLike[str]) -> tuple[Path, bool]:
    """Return the file, and whether it was asked for by a robot's name."""
    if not isinstance(source, (str, os.PathLike)):
        raise InputError(f"source: expected a robot's name or a path, got {source!r}")
    text = os.fspath(source)
    if not isinstance(text, str):
        raise InputError(f"source: expected a path of characters, got bytes {text!r}")
    if not text:
        raise InputError("source: expected a robot's name or a path, got an empty text")
    if isinstance(source, str):
        looks_like_path = text.lower().endswith((".urdf", ".xml", ".mjcf"))
        robot = None if looks_like_path else names.find(text)
        if robot is not None:
            return robot.path, True
        separated = "/" in text or os.sep in text
        if not looks_like_path and not separated and not os.path.isfile(text):
            raise names.unknown(text)
        if separated and not looks_like_path and not os.path.exists(text):
            raise names.unknown(text)
    return Path(text), False
