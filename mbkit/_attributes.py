"""Read-only attributes, and `AttributeError`s that name the attribute of the same meaning."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from mbkit.errors import InputError, nearest


class ReadOnly:
    """An object whose methods and public attributes are read-only."""

    #: Attribute by its names in other libraries and in textbooks.
    _elsewhere: ClassVar[Mapping[str, str]] = {}

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_") and (name == "model" or callable(getattr(type(self), name, None))):
            raise InputError(
                f"{name}: a {type(self).__name__} is read-only; describe another model, as by model.without(...), and "
                "ask for its dynamics"
            )
        object.__setattr__(self, name, value)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # Only for names that are not there.
            known = [] if name.startswith("_") else [x for x in dir(type(self)) if not x.startswith("_")]
            meant = self._elsewhere.get(name)
            near = [meant] if meant in known else nearest(name, known)
            advice = f"; did you mean {' or '.join(near)}?" if near else ""
            raise AttributeError(
                f"{type(self).__name__!r} object has no attribute {name!r}{advice}", name=name, obj=self
            )


def forwarded(path: str, doc: str) -> Any:
    """Return a read-only attribute that is one of the object's parts', such as ``"equations.model"``."""
    return property(attrgetter(path), doc=doc)


def single_values(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return values of parameters, one each."""
    for name, value in values.items():
        if np.ndim(value):
            raise InputError(
                f"parameter {name!r}: expected a number, got shape {np.shape(value)}; the lagrangian engine takes one "
                "value for each sample of a batch"
            )
    return values
