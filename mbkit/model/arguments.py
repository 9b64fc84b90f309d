"""Reading what a builder's caller wrote: a fault is noted, and a harmless value goes on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import spatial
from mbkit._check import Array, _as_float, finite_array, real, shown
from mbkit.errors import InputError
from mbkit.model.kinds import kind_of
from mbkit.model.parameter import Expression, Number, nominal
from mbkit.model.parts import Mimic

__all__ = ["ArgumentReader", "shape_of"]

# The squares of sums of such lengths still fit a double.
_LONGEST: Final = 1e150
_LONGEST_NAME: Final = 1000


class ArgumentReader:
    """Turns arguments into arrays and numbers, and collects their faults.

    Attributes
    ----------
    faults : list of str
        One sentence per fault, so that the next ones are found too.
    """

    def __init__(self) -> None:
        self.faults: list[str] = []

    def name(self, what: str, value: Any, longest: int = _LONGEST_NAME) -> str:
        """Return a name: text that UTF-8 can hold, short enough for a message."""
        if not isinstance(value, str):
            self.faults.append(f"{what}: expected a name, got {shown(value)}")
            return shown(value)
        text = value.encode("utf-8", "backslashreplace").decode()
        if text != value:
            self.faults.append(f"{what}: expected text, got lone surrogates, which UTF-8 cannot hold: {text[:60]!r}")
        if len(text) > longest:
            self.faults.append(f"{what}: expected up to {longest} characters, got {len(text)}")
        return text[:longest]

    def vector(self, name: str, value: ArrayLike, n: int) -> Array:
        """Return n finite numbers; a single one is repeated."""
        try:
            if shape_of(value) == ():
                value = np.full(n, real(name, value))
            return finite_array(name, value, (n,))
        except InputError as error:
            self._refuse(error, value)
            return np.zeros(n)

    def matrix(self, name: str, value: ArrayLike) -> Array:
        """Return a finite 3 by 3 matrix."""
        try:
            return finite_array(name, value, (3, 3))
        except InputError as error:
            self._refuse(error, value)
            return np.eye(3)

    def real(self, name: str, value: Any, *, nonnegative: bool = False) -> float:
        """Return a finite number."""
        try:
            return real(name, value, nonnegative=nonnegative)
        except InputError as error:
            self._refuse(error, value)
            return 0.0

    def _refuse(self, error: InputError, value: Any) -> None:
        hint = "; no parameter can stand here, give a number" if _has_expressions(value) else ""
        self.faults.append(f"{error}{hint}")

    def quantity(self, name: str, value: Any, *, nonnegative: bool = False) -> Number:
        """Return a finite number, or an expression of parameters."""
        if not isinstance(value, Expression):
            return self.real(name, value, nonnegative=nonnegative)
        try:
            nominal(value)
        except InputError as error:
            self.faults.append(f"{name}: {error}")
            return 0.0
        return value

    def quantities(self, name: str, value: Any, n: int) -> Array:
        """Return n finite numbers or expressions, of dtype object where there are any; a single one is repeated."""
        if not _has_expressions(value):
            return self.vector(name, value, n)
        array = np.array(value, dtype=object)
        if array.ndim == 0:
            array = np.full(n, value, dtype=object)
        if array.shape != (n,):
            self.faults.append(f"{name}: expected shape ({n},), got {array.shape}")
            return np.zeros(n)
        return np.array([self.quantity(f"{name}[{i}]", x) for i, x in enumerate(array)], dtype=object)

    def place(self, name: str, value: Any) -> Array:
        """Return three lengths, or expressions, whose squares do not overflow."""
        lengths = self.quantities(name, value, 3)
        largest = max(abs(nominal(x)) for x in lengths)
        if largest > _LONGEST:
            self.faults.append(f"{name}: expected lengths up to {_LONGEST:g} m, got {largest:g}")
            return np.zeros(3)
        return lengths

    def inertia(self, name: str, value: Any) -> Array:
        """Return a symmetric 3 by 3 matrix, given as such or by its diagonal, or zeros for None."""
        if value is None:
            return np.zeros((3, 3))
        if shape_of(value) == (3,):
            return np.diag(self.quantities(name, value, 3))
        if not _has_expressions(value):
            matrix = self.matrix(name, value)
            if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
                self.faults.append(f"{name} is not symmetric; expected I = Iᵀ")
            return np.asarray((matrix + matrix.T) / 2)
        if shape_of(value) != (3, 3):
            self.faults.append(f"{name}: expected shape (3, 3), got {shape_of(value)}")
            return np.eye(3)
        matrix = np.array([self.quantities(name, row, 3) for row in np.array(value, dtype=object)], dtype=object)
        if any(matrix[i, j] != matrix[j, i] for i, j in ((0, 1), (0, 2), (1, 2))):
            self.faults.append(f"{name} is not symmetric; expected the same expression on both sides of the diagonal")
        return matrix

    def limits(self, name: str, value: ArrayLike | None, n: int, default: float) -> Array:
        """Return n numbers, infinite ones among them; `default` where nothing is given."""
        if value is None:
            return np.full(n, default)
        try:
            array = _as_float(name, value)
        except InputError:
            array = np.full(n, np.nan)
        if array.ndim == 0:
            array = np.full(n, float(array))
        if array.shape != (n,) or np.isnan(array).any():
            self.faults.append(f"{name}: expected {n} numbers (infinite where there is no limit), got {shown(value)}")
            return np.full(n, default)
        return array

    def rotation(self, who: str, rotation: ArrayLike | None, rpy: ArrayLike | None, name: str = "rotation") -> Array:
        """Return a rotation matrix, given as such or as roll, pitch, yaw."""
        if rotation is not None and rpy is not None:
            self.faults.append(f"{who}: both rotation and rpy given; give one")
        if rpy is not None:
            return spatial.matrix_from_rpy(*self.vector(f"{who}: rpy", rpy, 3))
        if rotation is None:
            return np.eye(3)
        R = self.matrix(f"{who}: {name}", rotation)
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-9 or np.linalg.det(R) < 0:
            self.faults.append(f"{who}: {name} is not a rotation matrix; expected R Rᵀ = 1 and det R = 1")
            return np.eye(3)
        return R

    def axes(self, who: str, kind: str, axis: ArrayLike | None, axis2: ArrayLike | None) -> Array:
        """Return the unit axes that a joint of this kind takes."""
        wanted = kind_of(kind).n_axes
        given: list[ArrayLike] = [a for a in (axis, axis2) if a is not None]
        if len(given) != wanted:
            names = ("no axis", "axis", "axis and axis2")[wanted]
            self.faults.append(f"{who}: a {kind} joint takes {names}; {len(given)} given")
            given = list(np.eye(3)[:wanted])
        out = np.zeros((wanted, 3))
        for i, a in enumerate(given):
            vector = self.vector(f"{who}: axis", a, 3)
            # The square of a component may overflow, or vanish.
            largest = float(np.abs(vector).max())
            if largest and not 1e-100 < largest < 1e100:
                vector = vector / largest
            length = float(np.linalg.norm(vector))
            if not length:
                self.faults.append(f"{who}: axis is zero; expected a direction")
                vector, length = np.array([1.0, 0.0, 0.0]), 1.0
            # An axis that is a unit vector to rounding is kept to the bit.
            out[i] = vector if abs(length - 1) < 1e-15 else vector / length
        return out

    def mimic(self, who: str, value: Mimic | Iterable[Any]) -> tuple[str, Number, Number] | None:
        """Return whom a joint follows, with ratio and offset, or None where that is not said rightly."""
        if isinstance(value, Mimic):
            value = (value.joint, value.ratio, value.offset)
        try:
            joint, ratio, offset = value
        except Exception:
            # Any: iterating over an object may raise what it likes.
            self.faults.append(f"{who}: mimic: expected (joint, ratio, offset), got {shown(value)}")
            return None
        return (
            self.name(f"{who}: mimic joint", joint),
            self.quantity(f"{who}: mimic ratio", ratio),
            self.quantity(f"{who}: mimic offset", offset),
        )


def _has_expressions(value: Any, depth: int = 3) -> bool:
    """Return whether any entry of a number, array or nested sequence is an expression; matrices are the deepest."""
    if isinstance(value, np.ndarray):
        return value.dtype == object and any(_has_expressions(x, 0) for x in value.flat)
    if isinstance(value, (list, tuple)):
        return depth > 0 and any(_has_expressions(x, depth - 1) for x in value)
    return isinstance(value, Expression)


def shape_of(value: Any) -> tuple[int, ...] | None:
    """Return the shape, or None of what has none, such as a ragged list."""
    try:
        return tuple(np.shape(value))
    except Exception:
        # Any: objects may bring conversions of their own.
        return None
