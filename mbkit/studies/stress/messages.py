"""What a study and its worker processes say to each other."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from mbkit.studies.stress.result import Cell, End

__all__ = ["Answer", "Condition", "Failed", "Hello", "Introduce", "Prepare", "Prepared", "Request", "Run", "Stage"]

#: What a worker is at: whatever ends it there is the fault of the case, of the engine, or of the method.
Doing = Literal["case", "truth", "engine", "method", "run"]


@dataclass(frozen=True)
class Introduce:
    """A case, before anything is asked about it; answered by None.

    Attributes
    ----------
    case : str
        What it is called from now on, fit for a file's name.
    name : str
    pickled : bytes or None
        Of a case of the user's own; None for one of mbkit's.
    main : dict or None
        How to import the user's script, where the case is defined in it.
    """

    case: str
    name: str
    pickled: bytes | None = None
    main: dict[str, Any] | None = None


@dataclass(frozen=True)
class Prepare:
    """Make the problem of one value, and find out its truth, which is kept in the study's folder.

    Attributes
    ----------
    case : str
    index : int
        Of the value.
    value, bar : float
    seconds : float
        What the search for a truth may take.
    """

    case: str
    index: int
    value: float
    bar: float
    seconds: float


@dataclass(frozen=True)
class Prepared:
    """The answer to `Prepare`.

    Attributes
    ----------
    told : str
        How the truth is known, or why it is not.
    facts : dict
    dt : float or None
        Step that the problem prescribes, s.
    """

    told: str
    facts: dict[str, float] = field(default_factory=dict)
    dt: float | None = None


@dataclass(frozen=True)
class Condition:
    """Tell the condition number of the mass matrix at one value; answered by a float."""

    case: str
    index: int
    value: float


@dataclass(frozen=True)
class Run:
    """Run a method, or evaluate a term, at one value; answered by a `Cell`.

    Attributes
    ----------
    case : str
    index : int
    value : float
    engine, method : str
    dt, rtol : float
        Of fixed-step and of adaptive methods.
    seconds, making : float
        What the run may take, and what is derived and compiled for it; of the processor's time.
    """

    case: str
    index: int
    value: float
    engine: str
    method: str
    dt: float
    rtol: float
    seconds: float
    making: float


@dataclass(frozen=True)
class Hello:
    """A worker is ready."""


@dataclass(frozen=True)
class Stage:
    """What a worker begins now; whoever waits counts the time from here."""

    doing: Doing


@dataclass(frozen=True)
class Failed:
    """The answer of a worker that goes on living.

    Attributes
    ----------
    end : str
    note : str
    doing : str
    misuse : bool
        Whether the study as a whole makes no sense, such as a case that cannot be imported.
    """

    end: End
    note: str
    doing: Doing
    misuse: bool = False


Request = Introduce | Prepare | Condition | Run
Answer = Prepared | Cell | Failed | float | None
