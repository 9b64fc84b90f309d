"""What a comparison of importers and their processes say to each other."""

from __future__ import annotations

from dataclasses import dataclass

from mbkit._check import Array
from mbkit.engines.imported import Beside
from mbkit.model import Model

__all__ = ["Answer", "Ask", "Hello", "Made", "Read", "Refused", "Request"]


@dataclass(frozen=True)
class Read:
    """Read a text with the importer; answered by `Made` or `Refused`.

    Attributes
    ----------
    module, text, format : str
    floating_base : bool
    files : dict
        The meshes that the text names: name -> content.
    seconds : float
        After which the process ends itself, should nobody be there to end it.
    """

    module: str
    text: str
    format: str
    floating_base: bool
    files: dict[str, bytes]
    seconds: float


@dataclass(frozen=True)
class Ask:
    """Evaluate the terms of what was read last; answered by a dict of arrays or `Refused`.

    Attributes
    ----------
    q, v : (N, nq) and (N, nv) arrays
    without : tuple of str
        Keys of what is left out; see `mbkit.engines.imported.Imported`.
    seconds : float
    """

    q: Array
    v: Array
    without: tuple[str, ...]
    seconds: float


@dataclass(frozen=True)
class Hello:
    """A process is ready."""


@dataclass(frozen=True)
class Made:
    """What an importer made of a text; see `mbkit.engines.imported.Imported`."""

    model: Model
    notes: tuple[str, ...]
    beside: tuple[Beside, ...]


@dataclass(frozen=True)
class Refused:
    """Why a process that goes on living has no better answer."""

    why: str


Request = Read | Ask
Answer = Made | dict[str, Array] | Refused
