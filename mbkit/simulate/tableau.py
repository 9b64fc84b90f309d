"""Butcher tableaus that check themselves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.errors import InputError

__all__ = ["RK4", "Tableau", "rooted_trees"]

Tree = tuple[Any, ...]  # a tree is the tuple of its branches, each a tree


@cache
def rooted_trees(order: int) -> tuple[Tree, ...]:
    """Return the rooted trees of `order` nodes: 1, 1, 2, 4, 9, 20, ... of them."""
    return tuple(tuple(branches) for branches in _forests(order - 1, order - 1))


def _forests(nodes: int, largest: int) -> list[list[Tree]]:
    # Sets of trees with `nodes` nodes together, none above `largest`.
    if nodes == 0:
        return [[]]
    out = []
    for size in range(min(nodes, largest), 0, -1):
        for count in range(1, nodes // size + 1):
            for same in combinations_with_replacement(rooted_trees(size), count):
                out += [[*same, *rest] for rest in _forests(nodes - count * size, size - 1)]
    return out


def _nodes(tree: Tree) -> int:
    return 1 + sum(_nodes(branch) for branch in tree)


def _density(tree: Tree) -> int:
    out = _nodes(tree)
    for branch in tree:
        out *= _density(branch)
    return out


def _stage_weights(A: Array, tree: Tree) -> Array:
    out = np.ones(len(A))
    for branch in tree:
        out = out * (A @ _stage_weights(A, branch))
    return out


@dataclass(frozen=True, eq=False)
class Tableau:
    """An explicit Runge-Kutta method.

    The constructor checks the shape, the row sums c = A 1, and every order
    condition Σ b Φ(tree) = 1 / γ(tree) up to `order`
    (Hairer, Nørsett, Wanner 1993, theorem II.2.13).

    Parameters
    ----------
    name : str
    A : (s, s) array_like
        Strictly lower triangular.
    b : (s,) array_like
    order : int
        The order that the method must have.

    Attributes
    ----------
    c : (s,) array
        Stage times as fractions of the step.

    Raises
    ------
    InputError
        With the condition that fails.
    """

    name: str
    A: Array
    b: Array
    order: int

    def __init__(self, name: str, A: ArrayLike, b: ArrayLike, order: int) -> None:
        matrix, weights = np.array(A, dtype=np.float64), np.array(b, dtype=np.float64)
        s = len(weights) if weights.ndim == 1 else 0
        if not s or matrix.shape != (s, s):
            raise InputError(f"tableau {name!r}: expected A (s, s) and b (s,), got {matrix.shape} and {weights.shape}")
        if not np.isfinite(matrix).all() or not np.isfinite(weights).all():
            raise InputError(f"tableau {name!r}: expected finite numbers")
        if np.any(np.triu(matrix)):
            raise InputError(f"tableau {name!r}: A is not strictly lower triangular, so the method is not explicit")
        for p in range(1, order + 1):
            for tree in rooted_trees(p):
                stages = _stage_weights(matrix, tree)
                got, wanted = float(weights @ stages), 1 / _density(tree)
                if abs(got - wanted) > 16 * s * np.finfo(float).eps * float(np.abs(weights) @ np.abs(stages)):
                    raise InputError(
                        f"tableau {name!r}: order {p} condition of tree {tree}: got {got:.17g}, "
                        f"expected 1/{_density(tree)}; the method has not order {order}"
                    )
        for array in (matrix, weights):
            array.setflags(write=False)
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "A", matrix)
        object.__setattr__(self, "b", weights)
        object.__setattr__(self, "order", order)

    @property
    def c(self) -> Array:
        """Stage times as fractions of the step, shape (s,)."""
        return np.asarray(self.A.sum(axis=1))

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.b)

    def __reduce__(self) -> tuple[type, tuple[str, Array, Array, int]]:
        return type(self), (self.name, self.A, self.b, self.order)


#: Kutta's classical method (1901), MuJoCo's too.
RK4: Final = Tableau(
    "rk4",
    [[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
    [1 / 6, 1 / 3, 1 / 3, 1 / 6],
    order=4,
)
