"""What an engine's own importer makes of a file, in words that can be compared."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.errors import UnsupportedError
from mbkit.model import Model

__all__ = ["IMPORTERS", "Imported", "Importer", "check_installed", "checked", "reader", "unused"]


class Importer(NamedTuple):
    """Where an engine's importer is.

    Attributes
    ----------
    module : str
        That reads with it.
    library : str
        The module that it needs.
    distribution : str
        Whose version is told.
    package : str
        To install.
    """

    module: str
    library: str
    distribution: str
    package: str


IMPORTERS = {
    "pinocchio": Importer("mbkit.engines.import_pinocchio", "pinocchio", "pin", "pin"),
    "mujoco": Importer("mbkit.engines.import_mujoco", "mujoco", "mujoco", "mujoco"),
    "drake": Importer("mbkit.engines.import_drake", "pydrake", "drake", "mbkit[drake]"),
}
# What mbkit's own loaders take.
_LARGEST: Final = 1e30


@dataclass(frozen=True)
class Imported:
    """A file as one engine's importer holds it.

    Attributes
    ----------
    model : Model
        What the importer made, described: its bodies, joints and numbers, as they are.
    terms : callable
        (q, v) -> M, g and nle of the imported model by the engine itself, at (N, nq) and (N, nv) in
        the coordinates of `model`, as a dict.
    notes : tuple of str
        What the importer said, and what it holds that `model` does not.
    """

    model: Model
    terms: Callable[[Array, Array], dict[str, Array]]
    notes: tuple[str, ...]


def unused(name: str, taken: Container[str]) -> str:
    """Return a name that nothing has yet; an importer may take what mbkit's loader refuses."""
    while name in taken:
        name += "_"
    return name


def checked(engine: str, model: Model) -> Model:
    """Return what an importer made, if something moves in it and all its numbers are numbers.

    Raises
    ------
    UnsupportedError
        With the culprit.
    """
    if not model.nv:
        raise UnsupportedError(f"{engine}: nothing moves in what it made of the file (nv = 0)")
    for what, parts, names in (
        ("body", model.bodies, ("mass", "com", "inertia")),
        ("joint", model.joints, ("rotation", "translation", "axes", "pitch", "armature", "damping", "stiffness")),
    ):
        for part in parts:
            for name in names:
                # Not a number, or memory that nobody wrote to.
                if not (np.abs(getattr(part, name)) <= _LARGEST).all():
                    raise UnsupportedError(
                        f"{engine}: made {what} {part.name!r} with a {name} that nothing has: {getattr(part, name)}"
                    )
    if not (np.abs(model.gravity) <= _LARGEST).all():
        raise UnsupportedError(f"{engine}: made a gravity that nothing has: {model.gravity}")
    return model


def check_installed(engine: str) -> None:
    """Raise `UnsupportedError` if an engine is not installed; nothing is loaded.

    Raises
    ------
    UnsupportedError
    """
    library, package = IMPORTERS[engine].library, IMPORTERS[engine].package
    try:
        found = find_spec(library) is not None
    except (ImportError, ValueError):
        # What stands in for a module that was taken away.
        found = False
    if not found:
        raise UnsupportedError(f"{engine} is not installed (no module {library!r}); pip install {package}")


def reader(module: str) -> Callable[[str, str, bool], Imported]:
    """Return the function (text, format, floating_base) -> Imported of an importer's module.

    It raises `UnsupportedError` where the importer refuses a text.
    """
    made: Callable[[str, str, bool], Imported] = import_module(module).read
    return made
