"""Models that the engines' own importers read from a file, described so that they can be compared."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from mbkit._check import MAX_MAGNITUDE, Array, finite_array
from mbkit.errors import LoadError, ModelError, UnsupportedError
from mbkit.load.xml_reader import Element, Reader, reserved
from mbkit.model import Body, Coupler, Joint, Loop, Model, ModelBuilder
from mbkit.model.parts import numbers


class Importer(NamedTuple):
    """Where an engine's importer is."""

    module: str
    #: Module that it needs.
    library: str
    #: Distribution of which results name the version.
    distribution: str
    #: Package to install.
    package: str


IMPORTERS = {
    "pinocchio": Importer("mbkit.engines.pinocchio.importer", "pinocchio", "pin", "pin"),
    "mujoco": Importer("mbkit.engines.mujoco.importer", "mujoco", "mujoco", "mujoco"),
    "drake": Importer("mbkit.engines.drake.importer", "pydrake", "drake", "mbkit[drake]"),
}
#: Whose importer reads SDF.
_OF_SDF: Final = "drake"
#: How many numbers elements of SDF hold; sdformat takes the first of more, and a default for none. A pose may be empty.
_IN_SDF: Final = {"pose": 6, "xyz": 3} | dict.fromkeys(
    (
        *("mass", "ixx", "iyy", "izz", "ixy", "ixz", "iyz", "damping", "spring_stiffness", "spring_reference"),
        *("thread_pitch", "screw_thread_pitch"),
    ),
    1,
)


class Beside(NamedTuple):
    """Something that may act in an importer's model beside its bodies and joints."""

    #: By which `Imported.terms` leaves it out.
    key: str
    #: Such as ``"tendon"``, ``"actuator"`` or ``"fluid"``.
    kind: str
    #: Its name and its numbers.
    says: str
    #: The description less its part in it; None where it has none.
    without: Model | None = None


@dataclass(frozen=True)
class Imported:
    """A file as one engine's importer holds it."""

    #: The importer's bodies, joints and numbers, described as they are.
    model: Model
    #: (q, v, without) -> M, g, nle and passive of the imported model by the engine itself, at (N, nq) and (N, nv) in
    #: the coordinates of `model`. `without` holds keys of `beside` to leave out.
    terms: Callable[[Array, Array, tuple[str, ...]], dict[str, Array]]
    #: The importer's messages, and parts of its model that are in none of the terms.
    notes: tuple[str, ...]
    beside: tuple[Beside, ...] = ()
    #: Parts that the importer holds by constraints, outside of all terms.
    constraints: tuple[Loop | Coupler, ...] = ()
    #: Why its loops are not among them, where the engine does not give them.
    hidden: str = ""
    holds_mimics: str = ""


class Parts:
    """Bodies and joints as they are read, with names that nothing else has."""

    def __init__(self) -> None:
        self.bodies: list[Body] = []
        self.joints: list[Joint] = []
        self._names: dict[str, set[str]] = {"body": {"world"}}

    def name(self, what: str, name: str) -> str:
        """Return a name that no "body", say, has yet: an importer may take what mbkit's loader refuses."""
        return reserved(name, self._names.setdefault(what, set()))

    def joint(self, *place: Any, **numbers: Any) -> None:
        """Add a joint; arguments as of `Joint._of`."""
        self.joints.append(Joint._of(*place, **numbers))

    def body(self, name: str, mass: float = 0.0, com: Array | None = None, inertia: Array | None = None) -> None:
        """Add a body; without numbers it has none of matter."""
        com, inertia = np.zeros(3) if com is None else com, np.zeros((3, 3)) if inertia is None else inertia
        self.bodies.append(Body(name, mass, com, 0.5 * (inertia + inertia.T)))

    def model(self, name: str, gravity: Array) -> Model:
        """Return the description."""
        return Model(name=name, gravity=gravity, bodies=tuple(self.bodies), joints=tuple(self.joints))


def checked(engine: str, model: Model) -> Model:
    """Return an importer's model; raise `UnsupportedError` where nothing moves in it or a number is not sound."""
    if not model.nv:
        raise UnsupportedError(f"{engine}: nothing moves in the model that it built from the file (nv = 0)")
    part: Any
    for part in (*model.bodies, *model.joints, model):
        for name, rule, value in numbers(part):
            # Not a number, or memory that nobody wrote to.
            if rule.acts and not (np.abs(value) <= MAX_MAGNITUDE).all():
                where = "" if part is model else f"{type(part).__name__.lower()} {part.name!r} with "
                raise UnsupportedError(f"{engine}: built {where}an impossible {name}: {value}")
    return model


def check_installed(engine: str) -> None:
    """Raise `UnsupportedError` if an engine is not installed; nothing is loaded."""
    library, package = IMPORTERS[engine].library, IMPORTERS[engine].package
    try:
        installed = find_spec(library) is not None
    except (ImportError, ValueError):
        # A stand-in for a module that was removed.
        installed = False
    if not installed:
        raise UnsupportedError(f"{engine} is not installed (no module {library!r}); pip install {package}")


def model_of_sdf(
    root: Element, text: str, path: str, floating_base: bool, nonphysical: Literal["error", "warn"], gravity: Any
) -> Model:
    """Return the model of an <sdf> element; for the arguments see `mbkit.load`."""
    models, version = root.all("model"), root.attributes.get("version", "")
    if not re.fullmatch(r"\s*1\.\d+\s*", version):
        raise LoadError(f"{path}: <sdf> has the version {version[:60]!r}; expected one such as 1.9")
    if len(models) != 1 or len(root.children) != 1:
        there = ", ".join(f"<{x.tag[:60]}>" for x in root.children[:10]) or "nothing"
        raise LoadError(f"{path}: expected an SDF of one <model> and nothing beside it, got {there}")
    numbers = Reader()
    for element in models[0].walk():
        if (n := _IN_SDF.get(element.tag)) and (element.text or n != 6):
            n += element.attributes.get("rotation_format") == "quat_xyzw"
            numbers.numbers(replace(element, attributes={"text": element.text}), "text", "model", count=n)
    if numbers.faults:
        raise ModelError(path, numbers.faults)
    try:
        check_installed(_OF_SDF)
        g = finite_array("gravity", (0.0, 0.0, -9.81) if gravity is None else gravity, (3,))
        b: ModelBuilder = import_module(IMPORTERS[_OF_SDF].module).read_sdf(root, text, floating_base, g)
        return b.build(nonphysical=nonphysical, point_masses=False)
    except UnsupportedError as error:
        raise LoadError(f"{path}: an SDF is read by Drake's parser: {error}") from None
    except ModelError as error:
        raise ModelError(path, error.faults) from None


@contextmanager
def written(text: str, files: Mapping[str, bytes]) -> Iterator[Path]:
    """Write an MJCF and the meshes that it names into a folder of their own, and remove it afterwards."""
    with tempfile.TemporaryDirectory(prefix="mbkit-") as folder:
        path = Path(folder) / "model.xml"
        for name, content in {path.name: text.encode(), **files}.items():
            (Path(folder) / name).write_bytes(content)
        yield path


def reader(module: str) -> Callable[[str, str, bool, dict[str, bytes]], Imported]:
    """Return an importer's function (text, format, floating_base, meshes by name) -> Imported.

    It raises `UnsupportedError` where the importer refuses a text.
    """
    read: Callable[[str, str, bool, dict[str, bytes]], Imported] = import_module(module).read
    return read
