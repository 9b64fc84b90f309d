"""Records of the robots of example-robot-data, with their size or why they do not load."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

from mbkit.errors import MbkitError, MbkitWarning, ModelError
from mbkit.load.loader import load
from mbkit.load.names import entries

__all__ = ["Robot", "robots"]


@dataclass(frozen=True)
class Robot:
    """A URDF of example-robot-data; its size is read when first asked for.

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
        ``reason`` why it does not load; the last four are found when first asked for.

    Raises
    ------
    LoadError
        example-robot-data is not installed.
    """
    return _records()


@lru_cache(maxsize=1)
def _records() -> tuple[Robot, ...]:
    return tuple(Robot(*entry) for entry in entries())
