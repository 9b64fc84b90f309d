"""The values of a model's named parameters during evaluation: one each, or one per sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError, UnknownNameError
from mbkit.model import Model

__all__ = ["ParameterValues"]


class ParameterValues:
    """What a compiled function of a parametrised model gets as its argument ``"parameters"``.

    Parameters
    ----------
    model : Model
        Whose nominal values are those that all samples share.
    batched : mapping of str to (N,) array, optional
        Values that differ from sample to sample.
    """

    def __init__(self, model: Model, batched: Mapping[str, Array] | None = None) -> None:
        self.model, self.batched = model, dict(batched or {})

    def at(self, values: Mapping[str, ArrayLike]) -> ParameterValues:
        """Return these values with some replaced.

        Raises
        ------
        UnknownNameError, InputError, ModelError
            No such parameter; not a finite number or (N,) of them; no such system
            can exist (a batch is checked for finite numbers only).
        """
        for name in values:
            if name not in self.model.parameters:
                raise UnknownNameError("parameter", name, self.model.parameters)
        many = {name: _column(name, x) for name, x in values.items() if np.ndim(x)}
        kept = {name: x for name, x in self.batched.items() if name not in values}
        batched = {**kept, **many}
        if len({len(x) for x in batched.values()}) > 1:
            told = ", ".join(f"{name} has {len(x)}" for name, x in batched.items())
            raise InputError(f"parameters: batches of different sizes: {told}")
        single: dict[str, Any] = {name: x for name, x in values.items() if name not in many}
        return ParameterValues(self.model.with_nominal(single) if single else self.model, batched)

    @property
    def samples(self) -> int | None:
        """Size of the batch that the values make, None where every sample has the same."""
        return next((len(x) for x in self.batched.values()), None)

    def of_samples(self, which: ArrayLike) -> ParameterValues:
        """Return the values of these samples, by index; one of them may stand many times."""
        index = np.asarray(which)
        # A mask would be taken for the samples 0 and 1.
        if index.ndim != 1 or (index.size and index.dtype.kind not in "iu"):
            raise InputError(
                f"samples: expected a list of indices, got {which!r}; numpy.flatnonzero makes one of a mask"
            )
        index = index.astype(int)
        return ParameterValues(self.model, {name: x[index] for name, x in self.batched.items()})

    def bound(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that passes these values on, behind its own arguments."""
        return (lambda *given: function(*given, *self.behind(given[0]))) if self.model.parameters else function

    def behind(self, first: Any) -> tuple[Array, ...]:
        """Return what a function takes behind its own arguments, of which the first is given: nothing, or one array.

        Raises
        ------
        InputError
            A parameter has no value.
        """
        if not self.model.parameters:
            return ()
        values = self.array
        if values.ndim == 1 and np.ndim(first) == 2:
            return (np.broadcast_to(values, (len(first), len(values))),)
        return (values,)

    @cached_property
    def array(self) -> Array:
        """The values in the order of `model.parameters`, shape (p,) or (N, p)."""
        parameters = self.model.parameters
        missing = [name for name, x in parameters.items() if x is None and name not in self.batched]
        if missing:
            told = ", ".join(f"{name}=..." for name in missing)
            raise InputError(
                f"{self.model.name}: no value for parameter {', '.join(map(repr, missing))}; "
                f"give it with dynamics.at({told})"
            )
        columns = np.broadcast_arrays(*(np.asarray(self.batched.get(name, x)) for name, x in parameters.items()))
        return np.stack(columns, axis=-1).astype(np.float64)

    def spread(self, arguments: dict[str, ArrayLike]) -> dict[str, ArrayLike]:
        """Return arguments of which at least one has a row per sample, if values differ between samples."""
        n = self.samples
        if n is None:
            return arguments
        out: dict[str, ArrayLike] = {}
        for name, x in arguments.items():
            if np.ndim(x) == 2 and len(np.asarray(x)) != n:
                raise InputError(f"{name}: a batch of {len(np.asarray(x))}, but the parameters' values are {n}")
            out[name] = np.broadcast_to(np.asarray(x), (n, *np.shape(x))) if np.ndim(x) == 1 else x
        return out


def _column(name: str, value: ArrayLike) -> Array:
    if np.ndim(value) != 1:
        raise InputError(f"parameter {name!r}: expected a number or shape (N,), got {np.shape(value)}")
    return finite_array(f"parameter {name!r}", value, (len(np.asarray(value)),))
