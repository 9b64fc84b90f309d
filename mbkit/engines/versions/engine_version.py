"""An engine of another version: its name, its environment, and the process that evaluates it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from mbkit._check import real
from mbkit.engines.versions import environment
from mbkit.errors import InputError, UnknownNameError

_VERSION: Final = re.compile(r"\d+(\.[0-9A-Za-z]+)*")


class Package(NamedTuple):
    """What pip installs of an engine, the module that is there then, and what an environment takes, as measured."""

    distribution: str
    module: str
    megabytes: float
    seconds: float


#: Engines with a file of their own in `remote`.
PACKAGES: Final[Mapping[str, Package]] = {
    "mujoco": Package("mujoco", "mujoco", 120, 11),
    "pinocchio": Package("pin", "pinocchio", 430, 25),
    "drake": Package("drake", "pydrake.multibody.plant", 440, 20),
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
        return environment.interpreter(self.package.distribution, self.version, self.package.module)

    def __str__(self) -> str:
        return self.name


def engine(name: str, *, seconds: float = 60.0) -> EngineVersion:
    """Return an engine of a version, for `mbkit.dynamics`, in an environment of its own.

    The first `mbkit.dynamics` makes the environment, with uv where it is on the path and else with pip: the engine and
    NumPy, some 100 to 450 MB, below the user's cache folder or ``MBKIT_ENVIRONMENTS``. Later ones need no network. It
    also refuses a version that does not exist, with those that do, as far as pip knows: without a network the error is
    that there is none.

    Parameters
    ----------
    name : str
        Engine and version, such as ``"mujoco==3.12.0"``, ``"pinocchio==2.7.0"`` or ``"drake==1.35.0"``.
    seconds : float
        That one evaluation may take before its process is ended.

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
    if not isinstance(name, str) or "==" not in name:
        raise InputError(
            f"name: {form}, got {name!r}; without a version it is the installed one, which needs no engine()"
        )
    head, _, version = (part.strip() for part in name.partition("=="))
    if head not in PACKAGES:
        raise UnknownNameError("engine with versions", head, PACKAGES)
    if not _VERSION.fullmatch(version):
        raise InputError(f"name: {form}, got {name!r}")
    return EngineVersion(head, version, real("seconds", seconds, positive=True))


def order_of(version: str) -> tuple[int, ...]:
    """Return the numbers of a version, by which versions are in order."""
    return tuple(int(x) for x in re.findall(r"\d+", version))


def versions_of(name: str) -> tuple[str, ...]:
    """Return the versions of an engine that can be installed here, oldest first."""
    return environment.available(PACKAGES[name].distribution)


def made_of(name: str) -> tuple[str, ...]:
    """Return the versions of an engine that have an environment, oldest first."""
    return tuple(sorted(environment.made(PACKAGES[name].distribution), key=order_of))
