"""The engines of a baseline, made; one that is not installed is told apart from one that refuses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.errors import InputError, MbkitError, UnknownNameError, UnsupportedError
from mbkit.model import Model
from mbkit.model.expected import expect_model
from mbkit.studies.compare import COMPARABLE
from mbkit.studies.result import Refusal

__all__ = ["checked_model", "checked_names", "made", "with_values"]

# A few states are no reason to compile.
_OPTIONS: Final[dict[str, dict[str, Any]]] = {"lagrangian": {"compile": False}}


def checked_model(given: object) -> Model:
    """Return a model that has something to record."""
    model = expect_model(given)
    if not model.nv:
        raise InputError(f"model: nothing moves in {model.name} (nv = 0), so there is nothing to record; add a joint")
    model.require_values("a baseline")
    return model


def checked_names(engines: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of engines, all that there are where none were given."""
    if engines is None:
        return COMPARABLE
    if isinstance(engines, str):
        raise InputError(f"engines: expected several names, got the string {engines!r}; write [{engines!r}]")
    for name in engines:
        if name not in COMPARABLE:
            raise UnknownNameError("engine", str(name), COMPARABLE)
    if not engines:
        raise InputError(f"engines: expected at least one of {', '.join(COMPARABLE)}")
    return tuple(dict.fromkeys(engines))


def with_values(model: Model) -> Model:
    """Return the model with numbers for its named parameters, which not every engine takes."""
    values = {name: x for name, x in model.parameters.items() if x is not None}
    return model.with_parameters(**values) if values else model


def made(model: Model, names: Iterable[str]) -> tuple[dict[str, Dynamics], list[Refusal], list[Refusal]]:
    """Return the engines that hold a model, those that refuse it, and those that are not installed."""
    found: dict[str, Dynamics] = {}
    refused: list[Refusal] = []
    missing: list[Refusal] = []
    for name in names:
        try:
            found[name] = dynamics(model, name, **_OPTIONS.get(name, {}))
        except UnsupportedError as error:
            absent = isinstance(error.__cause__, ModuleNotFoundError)
            told = f"not installed; pip install {ENGINES[name][2]}" if absent else _plain(name, error)
            (missing if absent else refused).append(Refusal(name, "", told))
        except MbkitError as error:
            refused.append(Refusal(name, "", _plain(name, error)))
    return found, refused, missing


def _plain(name: str, error: MbkitError) -> str:
    return str(error).removeprefix(f"{name}: ")
