"""Butcher tableaus that check themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.errors import InputError

__all__ = [
    "RK4",
    "EmbeddedTableau",
    "ImplicitTableau",
    "Tableau",
    "Tree",
    "density",
    "dormand_prince_853",
    "rooted_trees",
]

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


def density(tree: Tree) -> int:
    """Return γ(tree): its nodes, times the densities of its branches."""
    out = _nodes(tree)
    for branch in tree:
        out *= density(branch)
    return out


def _stage_weights(A: Array, tree: Tree) -> Array:
    out = np.ones(len(A))
    for branch in tree:
        out = out * (A @ _stage_weights(A, branch))
    return out


def _require_order(name: str, matrix: Array, weights: Array, order: int) -> None:
    slack = 16 * len(weights) * np.finfo(float).eps
    for p in range(1, order + 1):
        for tree in rooted_trees(p):
            stages = _stage_weights(matrix, tree)
            got, wanted = float(weights @ stages), 1 / density(tree)
            if abs(got - wanted) > slack * float(np.abs(weights) @ np.abs(stages)):
                raise InputError(
                    f"tableau {name!r}: order {p} condition of tree {tree}: got {got:.17g}, "
                    f"expected 1/{density(tree)}; the method has not order {order}"
                )


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
    explicit: ClassVar[bool] = True

    def __init__(self, name: str, A: ArrayLike, b: ArrayLike, order: int) -> None:
        matrix, weights = np.array(A, dtype=np.float64), np.array(b, dtype=np.float64)
        s = len(weights) if weights.ndim == 1 else 0
        if not s or matrix.shape != (s, s):
            raise InputError(f"tableau {name!r}: expected A (s, s) and b (s,), got {matrix.shape} and {weights.shape}")
        if not np.isfinite(matrix).all() or not np.isfinite(weights).all():
            raise InputError(f"tableau {name!r}: expected finite numbers")
        if self.explicit and np.any(np.triu(matrix)):
            raise InputError(f"tableau {name!r}: A is not strictly lower triangular, so the method is not explicit")
        _require_order(name, matrix, weights, order)
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


class ImplicitTableau(Tableau):
    """A Runge-Kutta method whose stages depend on one another: A is any matrix, checked as that of a `Tableau`."""

    explicit: ClassVar[bool] = False


#: Kutta's classical method (1901), MuJoCo's too.
RK4: Final = Tableau(
    "rk4",
    [[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
    [1 / 6, 1 / 3, 1 / 3, 1 / 6],
    order=4,
)


@dataclass(frozen=True, eq=False)
class EmbeddedTableau(Tableau):
    """An explicit method with others of lower order on the same stages, to tell its error by.

    Parameters
    ----------
    name, A, b, order
        As of a `Tableau`.
    lower : sequence of (int, (s,) array_like)
        Of each other method the order, and b minus its weights. Its order conditions
        are checked too.

    Attributes
    ----------
    errors : tuple of (s,) arrays
        b minus the weights of each of the others.
    """

    errors: tuple[Array, ...]

    def __init__(
        self, name: str, A: ArrayLike, b: ArrayLike, order: int, lower: Sequence[tuple[int, ArrayLike]]
    ) -> None:
        super().__init__(name, A, b, order)
        errors = []
        for p, given in lower:
            error = np.array(given, dtype=np.float64)
            if error.shape != self.b.shape:
                raise InputError(f"tableau {name!r}: expected {self.b.shape} errors of order {p}, got {error.shape}")
            _require_order(f"{name}, embedded", self.A, self.b - error, p)
            error.setflags(write=False)
            errors.append(error)
        object.__setattr__(self, "errors", tuple(errors))
        object.__setattr__(self, "_orders", tuple(p for p, _ in lower))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        orders: tuple[int, ...] = self.__dict__["_orders"]
        return type(self), (self.name, self.A, self.b, self.order, tuple(zip(orders, self.errors, strict=True)))


@cache
def dormand_prince_853() -> EmbeddedTableau:
    """Return Dormand and Prince's pair of order 8, with errors told by orders 5 and 3.

    Hairer, Nørsett, Wanner 1993, Solving Ordinary Differential Equations I, II.5 and
    its program DOP853. Made when first asked for: 218 order conditions are checked.
    """
    A = np.zeros((12, 12))
    for i, row in enumerate(_A_853):
        A[i, : len(row)] = row
    b = np.array(_B_853)
    third = b.copy()
    third[[0, 8, 11]] -= _B_3
    return EmbeddedTableau("dormand_prince_853", A, b, 8, [(5, _E_853), (3, third)])


_A_853: Final[tuple[tuple[float, ...], ...]] = (
    (),
    (0.05260015195876773,),
    (0.0197250569845379, 0.0591751709536137),
    (0.02958758547680685, 0.0, 0.08876275643042054),
    (0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792),
    (0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242),
    (0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125),
    (
        0.03709200011850479,
        0.0,
        0.0,
        0.17038392571223998,
        0.10726203044637328,
        -0.015319437748624402,
        0.008273789163814023,
    ),
    (
        0.6241109587160757,
        0.0,
        0.0,
        -3.3608926294469414,
        -0.868219346841726,
        27.59209969944671,
        20.154067550477894,
        -43.48988418106996,
    ),
    (
        0.47766253643826434,
        0.0,
        0.0,
        -2.4881146199716677,
        -0.590290826836843,
        21.230051448181193,
        15.279233632882423,
        -33.28821096898486,
        -0.020331201708508627,
    ),
    (
        -0.9371424300859873,
        0.0,
        0.0,
        5.186372428844064,
        1.0914373489967295,
        -8.149787010746927,
        -18.52006565999696,
        22.739487099350505,
        2.4936055526796523,
        -3.0467644718982196,
    ),
    (
        2.273310147516538,
        0.0,
        0.0,
        -10.53449546673725,
        -2.0008720582248625,
        -17.9589318631188,
        27.94888452941996,
        -2.8589982771350235,
        -8.87285693353063,
        12.360567175794303,
        0.6433927460157636,
    ),
)
_B_853: Final = (
    0.054293734116568765,
    0.0,
    0.0,
    0.0,
    0.0,
    4.450312892752409,
    1.8915178993145003,
    -5.801203960010585,
    0.3111643669578199,
    -0.1521609496625161,
    0.20136540080403034,
    0.04471061572777259,
)
#: b minus the weights of order 5.
_E_853: Final = (
    0.01312004499419488,
    0.0,
    0.0,
    0.0,
    0.0,
    -1.2251564463762044,
    -0.4957589496572502,
    1.6643771824549864,
    -0.35032884874997366,
    0.3341791187130175,
    0.08192320648511571,
    -0.022355307863886294,
)
#: Weights of order 3, of the first, the ninth and the last stage.
_B_3: Final = (0.2440944881889764, 0.7338466882816118, 0.022058823529411766)
