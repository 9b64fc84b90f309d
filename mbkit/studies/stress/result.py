"""What `stress` returns: for each engine and method, how far it held and how it failed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final, Literal

__all__ = ["Break", "CaseResult", "Cell", "End", "Outcome", "Row", "StressResult"]

#: How a run or an evaluation ended, before anybody looks at its error.
End = Literal["finished", "diverged", "nan", "refused", "slow", "died", "not run"]
#: With its error: held; wrong with a word of warning or without one; or how it ended.
Outcome = Literal["held", "warned", "silent", "diverged", "nan", "refused", "slow", "died", "not run"]

#: The default bar: a relative error that plots cannot hide and papers accept.
BAR: Final = 1e-6


@dataclass(frozen=True)
class Cell:
    """One engine and method at one value.

    Attributes
    ----------
    value : float
        Of the case's parameter.
    end : str
        ``"finished"``; ``"diverged"`` where the run said so itself; ``"nan"`` where numbers are
        not finite and nothing was said; ``"refused"``, an error of its own; ``"slow"``, stopped at the time
        allowed; ``"died"``, the process ended or took too much memory; ``"not run"``.
    error : float
        Relative to the problem's scale (motion, terms), or of the energy; NaN where there is none.
    energy : float
        Largest relative energy error, NaN where forces do work or nothing was integrated.
    seconds : float
        Run time without what is compiled once.
    steps : int
    warnings : tuple of str
        What the library said about it.
    note : str
        Why it ended, what was chosen.
    """

    value: float
    end: End
    error: float = math.nan
    energy: float = math.nan
    seconds: float = math.nan
    steps: int = 0
    warnings: tuple[str, ...] = ()
    note: str = ""

    def outcome(self, bar: float) -> Outcome:
        """Return how it went, by this bar on the error."""
        if self.end != "finished":
            return self.end
        if self.error <= bar:
            return "held"
        return "warned" if self.warnings else "silent"


@dataclass(frozen=True)
class Break:
    """Where an engine and method breaks.

    Attributes
    ----------
    held : float or None
        The last value up to which all milder ones held, too; None where the mildest did not.
    failed : float or None
        The first that did not; None where all held.
    how : str
        The outcome there; empty where all held.
    cell : Cell or None
        What was seen there.
    """

    held: float | None
    failed: float | None
    how: Outcome | Literal[""]
    cell: Cell | None


@dataclass(frozen=True)
class Row:
    """One engine and method over all values of a case.

    Attributes
    ----------
    engine, method : str
        For terms, the method is the term.
    cells : tuple of Cell
        In the order of the case's values.
    setting : str
        The step or tolerance.
    theory : float or None
        Where linear theory lets it break.
    """

    engine: str
    method: str
    cells: tuple[Cell, ...]
    setting: str = ""
    theory: float | None = None

    def breaking(self, bar: float) -> Break:
        """Return the last value that held and the first that did not."""
        held: float | None = None
        for cell in self.cells:
            how = cell.outcome(bar)
            if how == "not run":
                break
            if how != "held":
                return Break(held, cell.value, how, cell)
            held = cell.value
        return Break(held, None, "", None)


@dataclass(frozen=True)
class CaseResult:
    """All engines and methods on one case.

    Attributes
    ----------
    name, about, family, parameter, unit, measure, why : str
        As of the `Case`.
    bar : float
        The one that counts here.
    values : tuple of float
    truths : tuple of str
        How each value's truth is known, and to which floor.
    facts : tuple of dict
        Numbers worth telling of each value.
    rows : tuple of Row
    """

    name: str
    about: str
    family: str
    parameter: str
    unit: str
    measure: str
    bar: float
    why: str
    values: tuple[float, ...]
    truths: tuple[str, ...]
    facts: tuple[dict[str, float], ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class StressResult:
    """What held to where, of every case.

    Attributes
    ----------
    cases : tuple of CaseResult
    complete : bool
        False for a study that was interrupted.
    versions : dict
    processor : str
    seconds : float
        Of the whole study.
    settings : dict
        Steps, tolerances, bounds of time and memory.
    """

    cases: tuple[CaseResult, ...]
    complete: bool
    versions: dict[str, str]
    processor: str
    seconds: float
    settings: dict[str, Any] = field(default_factory=dict)
