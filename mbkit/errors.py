"""The errors and warnings that mbkit raises, all in one place.

Every message names the argument or the body, says what was expected and what came, and what to do next.

Warnings that point at the user's line.
"""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

from mbkit import _escape

__all__ = [
    "BaselineError",
    "DeviceError",
    "DoubtfulRunWarning",
    "EngineProcessError",
    "EventError",
    "FunctionError",
    "InputError",
    "KnownDefectWarning",
    "LoadError",
    "MbkitError",
    "MbkitWarning",
    "ModelError",
    "NoCompilerWarning",
    "NonPhysicalWarning",
    "NumericalError",
    "OutputError",
    "Suggestions",
    "TorqueError",
    "UnknownNameError",
    "UnsupportedError",
    "nearest",
]

# A message is for reading: this many faults of a description, and so many characters of each.
_MAX_FAULTS: Final = 100
_MAX_CHARACTERS: Final = 2000
# Names that a message lists whole.
MAX_LISTED: Final = 40
# Longer names are not compared with others: the comparison takes the square of the length.
_LONGEST_NAME: Final = 200


class MbkitError(Exception):
    """Base of every error that mbkit raises on purpose.

    Its message spells out what a terminal would obey, because names in it come from files.
    """

    def __str__(self) -> str:
        return _escape.terminal(super().__str__())


class InputError(MbkitError, ValueError):
    """An argument has the wrong shape, type or value."""


class DeviceError(MbkitError, RuntimeError):
    """A GPU's driver refused a call, or the GPU has no room."""


class FunctionError(InputError):
    """A function that the user gave raised, or returned what cannot be used.

    Attributes
    ----------
    trajectory : mbkit.simulate.Trajectory or None
        The run up to then, or None.
    """

    trajectory: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self.args, {"trajectory": self.trajectory}


class TorqueError(FunctionError):
    """A torque function raised, or returned no valid torque."""


class EventError(FunctionError):
    """An event's function raised, or returned no number.

    Attributes
    ----------
    member : int or None
        Which trajectory of a batch.
    """

    member: int | None = None


class UnknownNameError(MbkitError, LookupError):
    """A name that does not exist; the message suggests near ones.

    Parameters
    ----------
    what, name : str
        The kind of thing, such as ``"robot"``, and the unknown name.
    known : iterable of str
    hint : str
        What else the caller can do.
    every : bool
        Whether to list all known names, however many there are.
    near : iterable of str
        Names that are meant; by default known ones that look like it.
    """

    def __init__(
        self, what: str, name: str, known: Iterable[str], hint: str = "", *, every: bool = False, near: Any = ()
    ) -> None:
        self.what, self.name, self.known, self.hint, self.every = what, name, tuple(known), hint, every
        self.near = near = [*near] or nearest(name, self.known)
        listed = f"there are: {', '.join(self.known) or 'none'}"
        if near:
            advice = f"did you mean {' or '.join(repr(n) for n in near)}?" + (f" {listed}" if every else "")
        elif every or len(self.known) <= MAX_LISTED:
            advice = listed
        else:
            advice = f"none of the {len(self.known)} known names is near"
        super().__init__(f"unknown {what} {_shortened(repr(name), 200)}; {advice}" + (f" {hint}" if hint else ""))

    def __reduce__(self) -> tuple[Callable[..., UnknownNameError], tuple[object, ...]]:
        return partial(type(self), every=self.every, near=self.near), (self.what, self.name, self.known, self.hint)


class ModelError(MbkitError, ValueError):
    """A description has faults; all of them are in ``faults``.

    Parameters
    ----------
    name : str
        Of the model or the file.
    faults : sequence of str
        A sentence each, with its remedy. The message shows the first of very many.
    """

    def __init__(self, name: str, faults: Sequence[str]) -> None:
        self.name, self.faults = name, tuple(faults)
        shown = [_shortened(fault) for fault in self.faults[:_MAX_FAULTS]]
        if more := len(self.faults) - len(shown):
            shown.append(f"and {more} more; the error's .faults holds all")
        listed = "".join(f"\n  - {fault}" for fault in shown)
        super().__init__(f"{name}: {shown[0]}" if len(shown) == 1 else f"{name}: {len(self.faults)} faults{listed}")

    def __reduce__(self) -> tuple[type, tuple[object, ...]]:
        return type(self), (self.name, self.faults)


class LoadError(MbkitError, ValueError):
    """A file cannot be read as a robot."""


class BaselineError(MbkitError, ValueError):
    """A file is no baseline that can be read, or not the one of this model."""


class OutputError(MbkitError, OSError):
    """A result cannot be written; what was computed is kept by the caller."""


class UnsupportedError(MbkitError, NotImplementedError):
    """An engine cannot do this; the message has the reason."""


class NumericalError(MbkitError, ArithmeticError):
    """A computation gave NaN or infinity where a number was due."""


class EngineProcessError(MbkitError, RuntimeError):
    """The process of another version of an engine died, or was ended because it took too long."""


class MbkitWarning(UserWarning):
    """Base of mbkit's warnings; a message spells out what a terminal would obey, as an error's does."""

    def __str__(self) -> str:
        return _escape.terminal(super().__str__())


class DoubtfulRunWarning(MbkitWarning):
    """A run finished with plausible numbers, but a check doubts them."""


class KnownDefectWarning(MbkitWarning):
    """An engine is known to return a wrong value here; it is returned as it is."""


class NoCompilerWarning(MbkitWarning):
    """There is no compiler: functions are interpreted, slower and with the same results."""


class SingularPoseWarning(MbkitWarning):
    """A task is near a singular pose, and its inverse is damped there."""


class NonPhysicalWarning(MbkitWarning):
    """A body with an inconsistent inertia, used as it was written."""


def nearest(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Return up to `count` of the `known` names that look like `name`."""
    if len(name) > _LONGEST_NAME:
        return []
    lower = {k.lower(): k for k in known}
    close = difflib.get_close_matches(name.lower(), lower, n=count, cutoff=0.6)
    inside = [k for k in lower if len(name) >= 3 and name.lower() in k and k not in close]
    return [lower[k] for k in (close + sorted(inside, key=len))[:count]]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of a message that suggests the nearest known name; empty where none is near."""
    return "".join(f"; did you mean {near!r}?" for near in nearest(name, known, 1))


def require_known(what: str, known: Collection[str], *names: object) -> None:
    """Raise `UnknownNameError` for the first name that is none of the known ones."""
    for name in names:
        if name not in known:
            raise UnknownNameError(what, str(name), known)


@contextmanager
def writing(path: Any, advice: str = "choose a folder that exists") -> Iterator[None]:
    """Raise `OutputError` that names a file where the system refuses to write it."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}; {advice}") from error


class Suggestions:
    """Near names for the first unknown names of a description; those after them are not compared.

    Each comparison looks at every known name, so a file of wrong names would take the square of its length.
    """

    def __init__(self, most: int = 5) -> None:
        self._most = most
        self._near: dict[str, str] = {}

    def near(self, name: str, known: Iterable[str]) -> str:
        """Return the nearest known name, or an empty text."""
        if name not in self._near and len(self._near) < self._most:
            self._near[name] = next(iter(nearest(name, known, 1)), "")
        return self._near.get(name, "")


def _shortened(text: str, most: int = _MAX_CHARACTERS) -> str:
    return text if len(text) <= most else text[: most - 4] + " ..."


def warn(message: str, category: type[Warning], unless: tuple[str, ...] = ()) -> None:
    """Warn at the line that called the library, however deep in it this is, unless some of its modules are between."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and (name := frame.f_globals.get("__name__", "")).split(".")[0] == "mbkit":
        if name.startswith(unless):
            return
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
