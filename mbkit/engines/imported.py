"""What an engine's own importer makes of a file, in words that can be compared."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.errors import UnsupportedError
from mbkit.model import Model


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
    "pinocchio": Importer("mbkit.engines.pinocchio.importer", "pinocchio", "pin", "pin"),
    "mujoco": Importer("mbkit.engines.mujoco.importer", "mujoco", "mujoco", "mujoco"),
    "drake": Importer("mbkit.engines.drake.importer", "pydrake", "drake", "mbkit[drake]"),
}
# What mbkit's own loaders take.
_LARGEST: Final = 1e30


class Beside(NamedTuple):
    """What may act in an importer's model beside its bodies and joints: described, or not.

    Attributes
    ----------
    key : str
        By which `Imported.terms` leaves it out.
    kind : str
        Such as ``"tendon"``, ``"actuator"`` or ``"fluid"``.
    says : str
        Its name and its numbers.
    without : Model or None
        The description less what it has of this; None where it has nothing of it.
    """

    key: str
    kind: str
    says: str
    without: Model | None = None


@dataclass(frozen=True)
class Imported:
    """A file as one engine's importer holds it.

    Attributes
    ----------
    model : Model
        What the importer made, described: its bodies, joints and numbers, as they are.
    terms : callable
        (q, v, without) -> M, g, nle and passive of the imported model by the engine itself, at (N, nq) and
        (N, nv) in the coordinates of `model`, as a dict. `without` holds keys of `beside` to leave out.
    notes : tuple of str
        What the importer said, and what it holds that is in none of the terms.
    beside : tuple of Beside
        What the terms may hold beside bodies and joints.
    """

    model: Model
    terms: Callable[[Array, Array, tuple[str, ...]], dict[str, Array]]
    notes: tuple[str, ...]
    beside: tuple[Beside, ...] = ()


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


@contextmanager
def written(text: str, files: Mapping[str, bytes]) -> Iterator[Path]:
    """Write an MJCF and the meshes that it names into a folder of their own, and remove it afterwards."""
    with tempfile.TemporaryDirectory(prefix="mbkit-") as folder:
        path = Path(folder) / "model.xml"
        for name, content in {path.name: text.encode(), **files}.items():
            (Path(folder) / name).write_bytes(content)
        yield path


def reader(module: str) -> Callable[[str, str, bool, dict[str, bytes]], Imported]:
    """Return the function (text, format, floating_base, files) -> Imported of an importer's module.

    `files` holds the meshes that the text names, by name.

    It raises `UnsupportedError` where the importer refuses a text.
    """
    made: Callable[[str, str, bool, dict[str, bytes]], Imported] = import_module(module).read
    return made
