"""What was expected to be a description, and is not: told with the way to one."""

from __future__ import annotations

from typing import Any

from mbkit.errors import InputError
from mbkit.model.model import Model

__all__ = ["expect_model"]


def expect_model(given: Any, name: str = "model") -> Model:
    """Return an argument that is a `Model`.

    Parameters
    ----------
    given : object
    name : str
        The argument's.

    Raises
    ------
    InputError
        With what makes one: what was given may hold it, as a `Lagrangian` on paper and a `Dynamics` do.

    Examples
    --------
    >>> expect_model("panda")
    Traceback (most recent call last):
    mbkit.errors.InputError: model: expected a Model, got str; mbkit.load(...) makes one
    """
    if isinstance(given, Model):
        return given
    holds = not isinstance(given, type) and isinstance(getattr(given, "model", None), Model)
    way = "its .model is one" if holds else "mbkit.load(...) makes one"
    raise InputError(f"{name}: expected a Model, got {type(given).__name__}; {way}")
