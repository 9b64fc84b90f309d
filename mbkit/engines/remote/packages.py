"""An engine of another version: its name, its environment, and the process that evaluates it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from mbkit._check import WORLD, real
from mbkit.engines.frames_and_momenta import TREE
from mbkit.engines.known_defects import OF_MUJOCO, OF_PINOCCHIO
from mbkit.engines.remote import environment
from mbkit.engines.remote.description import NEWTON, ONE_BY_ONE, SENT, SENT_TO_DRAKE, STACKED, Convention, Steps
from mbkit.errors import InputError, require_known
from mbkit.model.elements import paths
from mbkit.model.elements.kinds import joint_types

_NAME: Final = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_VERSION: Final = re.compile(r"\d+(\.[0-9A-Za-z]+)*")


class Package(NamedTuple):
    """What pip installs of an engine, how it takes a description, and in which precision it computes.

    Attributes
    ----------
    distribution, module : str
        What pip installs, and what can be imported then.
    convention : Convention
    steps : mapping, optional
        The engine's joints in the place of each joint type. None: it reads the MJCF that mbkit writes.
    path : paths.Path
        The kinds of parts that it carries; by default all that travels.
    bits : int
        Significand bits of its arithmetic: 53, or 24 in single precision.
    inertias_about : mapping
        The point about which it writes composite inertias, as `Dynamics._inertias_about`.
    tested : tuple of str
        Versions that were judged, the newest last: that one is meant where none is named. Empty where the name alone
        is an engine that needs no environment.
    extra : str
        Of the distribution, such as ``"[sim]"``, which pip installs too.
    file : str
        What follows ``on_`` in the name of the engine's file in `remote`, by default the engine; or a file's path.
    variables : mapping
        Environment variables of its process; ``{environment}`` in one stands for the environment's folder.
    limit : float
        Seconds that one evaluation may take, compiling included.
    defects : mapping
        Its known defects by the begin of the quantity, ``"coriolis"`` or ``"kinetic_"``; announced where a model shows
        them.
    importer : str
        Its file in `remote` that describes what its own importer reads; empty where there is none.
    """

    distribution: str
    module: str
    convention: Convention
    steps: Steps | None = None
    path: paths.Path = SENT
    bits: int = 53
    inertias_about: Mapping[str, str] = {}
    tested: tuple[str, ...] = ()
    extra: str = ""
    file: str = ""
    variables: Mapping[str, str] = {}
    limit: float = 60.0
    defects: Mapping[str, str] = {}
    importer: str = ""


_MUJOCO: Final = Convention((0, 1, 2, 6, 3, 4, 5), ball_q=(3, 0, 1, 2), turned={"free": (0,)})
_JAX: Final = {
    "JAX_PLATFORMS": "cpu",
    "JAX_COMPILATION_CACHE_DIR": "{environment}/kernels",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    # With its newer fusion XLA computes the poses of a chain again for each body behind them: 2 s of a Panda in
    # place of 0.4 ms (jaxlib 0.10.2).
    "XLA_FLAGS": "--xla_cpu_use_fusion_emitters=false",
}
#: Limit of a call where the first one of each function compiles it.
_COMPILING_SECONDS: Final = 600.0
_WARP: Final = {"WARP_CACHE_PATH": "{environment}/kernels"}
_MJX: Final = Package(
    "mujoco-mjx",
    "mujoco.mjx",
    _MUJOCO,
    inertias_about={"": TREE},
    tested=("3.17.0",),
    file="mjx",
    variables={**_JAX, "JAX_ENABLE_X64": "1"},
    limit=_COMPILING_SECONDS,
    importer="mujoco_importer",
)
#: Engines with a file of their own in `remote`.
PACKAGES: Final[dict[str, Package]] = {
    "mujoco": Package("mujoco", "mujoco", _MUJOCO, defects=OF_MUJOCO),
    "pinocchio": Package("pin", "pinocchio", Convention(), ONE_BY_ONE, defects=OF_PINOCCHIO),
    "drake": Package(
        *("drake", "pydrake.multibody.plant"),
        Convention((6, 3, 4, 5, 0, 1, 2), (3, 4, 5, 0, 1, 2), (), {"free": (0, 3), "ball": (0,)}, 3),
        STACKED,
        SENT_TO_DRAKE,
    ),
    "newton": Package(
        *("newton", "newton"),
        Convention(turned={"free": (0, 3), "ball": (0,)}),
        STACKED,
        NEWTON,
        bits=24,
        # Those of its own mass matrix are about each centre of mass, by Jacobians; its solver's are about the world's
        # origin.
        inertias_about={"forward_dynamics": WORLD},
        tested=("1.8.0",),
        extra="[sim]",
        variables=_WARP,
        limit=_COMPILING_SECONDS,
        importer="newton_importer",
    ),
    "mujoco-warp": Package(
        *("mujoco-warp", "mujoco_warp", _MUJOCO),
        bits=24,
        inertias_about={"": TREE},
        tested=("4.0.0",),
        file="mujoco_warp",
        variables=_WARP,
        limit=_COMPILING_SECONDS,
        importer="mujoco_importer",
    ),
    "mjx": _MJX,
    "mjx-single": _MJX._replace(bits=24, variables=_JAX),
}


@dataclass(frozen=True)
class EngineVersion:
    """A version of an engine, which `mbkit.dynamics` takes; `mbkit.engine` makes one.

    Attributes
    ----------
    engine, version : str
    seconds : float
        That one evaluation may take.
    """

    engine: str
    version: str
    seconds: float = field(default=60.0, compare=False)

    @property
    def name(self) -> str:
        """Such as ``"mujoco==3.12.0"``."""
        return f"{self.engine}=={self.version}"

    @property
    def package(self) -> Package:
        """The package of the engine."""
        return PACKAGES[self.engine]

    @property
    def installed(self) -> bool:
        """Whether its environment is there, so that no network is needed."""
        return environment.exists(self.package.distribution, self.version)

    def interpreter(self) -> Path:
        """Return the interpreter of its environment; make the environment first if it is missing."""
        package = self.package
        return environment.interpreter(package.distribution, self.version, package.module, extra=package.extra)

    def variables(self) -> dict[str, str]:
        """Return the environment variables of its process."""
        place = environment.place(self.package.distribution, self.version)
        return {key: value.format(environment=place) for key, value in self.package.variables.items()}

    def __str__(self) -> str:
        return self.name


def engine(name: str, *, seconds: float | None = None) -> EngineVersion:
    """Return an engine of a version, for `mbkit.dynamics`, in an environment of its own.

    The first `mbkit.dynamics` makes the environment, with uv where it is on the path and else with pip: the engine and
    NumPy, some 100 to 730 MB, below the user's cache folder or ``MBKIT_ENVIRONMENTS``. Later ones need no network. It
    also refuses a version that does not exist, with those that do, as far as pip knows: without a network the error is
    that there is none.

    Parameters
    ----------
    name : str
        Engine and version, such as ``"mujoco==3.12.0"``, ``"pinocchio==2.7.0"`` or ``"drake==1.35.0"``; or
        ``"newton"``, ``"mujoco-warp"``, ``"mjx"`` (double precision) and ``"mjx-single"``, which are the newest
        tested versions where none is named.
    seconds : float, optional
        That one evaluation may take before its process is ended: a minute, or ten where the engine compiles first.

    Returns
    -------
    EngineVersion

    Raises
    ------
    InputError
        No name of this form.
    UnknownNameError
        An engine of which there are no other versions.

    Examples
    --------
    >>> import mbkit as mb
    >>> mb.engine("mujoco==3.12.0")
    EngineVersion(engine='mujoco', version='3.12.0', seconds=60.0)
    """
    form = "expected an engine and its version, such as 'mujoco==3.12.0'"
    if isinstance(name, str) and name in PACKAGES and PACKAGES[name].tested:
        name = f"{name}=={PACKAGES[name].tested[-1]}"
    if not isinstance(name, str) or "==" not in name:
        raise InputError(
            f"name: {form}, got {name!r}; without a version it is the installed one, which needs no engine()"
        )
    head, _, version = (part.strip() for part in name.partition("=="))
    require_known("engine with versions", PACKAGES, head)
    if not (_VERSION.fullmatch(version) and environment.is_version(version)):
        raise InputError(f"name: {form}, got {name!r}")
    limit = PACKAGES[head].limit if seconds is None else real("seconds", seconds, positive=True)
    return EngineVersion(head, version, limit)


def register_remote_engine(name: str, package: Package) -> None:
    """Make an engine known that has an environment of its own, by its file: `mbkit.dynamics` and studies take its name.

    A worker process and the command know it where a package names a module that calls this function in the entry
    point group ``"mbkit.engines"``.

    Raises `InputError` for a name that another engine has, a file that is not there, no tested version, or a
    `path` with joint types that have no steps.
    """
    if not isinstance(package, Package):
        raise InputError(f"package: expected a Package, got {type(package).__name__}")
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name in PACKAGES:
        raise InputError(f"name: expected a word of letters, digits and hyphens that is not in use, got {name!r}")
    if not Path(package.file).is_file():
        raise InputError(f"package.file: expected the path of the engine's file, got {package.file!r}")
    if not package.tested:
        raise InputError("package.tested: expected at least one version, got none")
    if lost := joint_types(*STACKED) & package.path.carries - joint_types(*package.steps or STACKED):
        raise InputError(f"package.path: expected steps of each type that it carries, got none of {sorted(lost)}")
    PACKAGES[name] = package


def names_version(name: object) -> bool:
    """Return whether `engine` is to read a name: one with a version, or of an engine that has an environment always."""
    return isinstance(name, str) and ("==" in name or (name in PACKAGES and bool(PACKAGES[name].tested)))


def remote_engines() -> tuple[str, ...]:
    """Return the engines that always have an environment of their own."""
    return tuple(name for name, package in PACKAGES.items() if package.tested)
