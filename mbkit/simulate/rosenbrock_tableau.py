"""Tableaus of Rosenbrock's methods that check themselves.

A stage solves one linear system with the Jacobian J in it (Hairer, Wanner 1996, Solving Ordinary Differential
Equations II, IV.7)::

    (1/(γ h) - J) k_i = f(t + c_i h, y + Σ a_ij k_j) + Σ (C_ij/h) k_j + d_i h ∂f/∂t      y1 = y + Σ b_i k_i
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import InputError
from mbkit.simulate.tableau import Tree, density, rooted_trees

__all__ = ["RosenbrockTableau", "rodas5p"]

#: What the coefficients' sixteen digits leave of a sum.
_DIGITS: Final = 1e-12


@dataclass(frozen=True, eq=False)
class RosenbrockTableau:
    """A Rosenbrock method with another of lower order on the same stages.

    The constructor checks the shapes and, for both methods, all order conditions
    (Hairer, Wanner 1996, theorem IV.7.4).

    Parameters
    ----------
    name : str
    gamma : float
        γ, the same in all stages.
    A, C : (s, s) array_like
        Strictly lower triangular.
    b, error : (s,) array_like
        Weights, and b minus those of the other method.
    dense : (3, s) array_like
        Of the state within a step, at t + θ h and with D = dense k::

            y(θ) = (1 - θ) y + θ (y1 + (1 - θ) (D₁ + θ (D₂ + θ D₃)))
    order, lower : int
        The orders that both must have.

    Attributes
    ----------
    c, d : (s,) arrays
        Stage times, and factors of ∂f/∂t, that make a method of y' = f(t, y) out of it.

    Raises
    ------
    InputError
        With the condition that fails.
    """

    name: str
    gamma: float
    A: Array
    C: Array
    b: Array
    error: Array
    dense: Array
    order: int
    lower: int

    def __post_init__(self) -> None:
        for name in ("A", "C", "b", "error", "dense"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        s = self.stages
        if self.A.shape != (s, s) or self.C.shape != (s, s) or self.error.shape != (s,) or self.dense.shape != (3, s):
            raise InputError(f"tableau {self.name!r}: expected A, C ({s}, {s}), error ({s},) and dense (3, {s})")
        if np.any(np.triu(self.A)) or np.any(np.triu(self.C)):
            raise InputError(f"tableau {self.name!r}: A and C are not strictly lower triangular")
        self._require(self.b, self.order)
        self._require(self.b - self.error, self.lower)

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.b)

    @property
    def c(self) -> Array:
        """Stage times as fractions of the step, shape (s,)."""
        found = np.asarray(self._alpha.sum(axis=1))
        # No stage lies behind the end of the step by a rounding.
        return np.where(np.abs(found - 1.0) < _DIGITS, 1.0, found)

    @property
    def d(self) -> Array:
        """Factors of ∂f/∂t, shape (s,)."""
        found = np.asarray(self._coupling.sum(axis=1))
        return np.where(np.abs(found) < _DIGITS, 0.0, found)

    @property
    def _coupling(self) -> Array:
        """Γ of the form in which stages are h f + h J Σ Γ_ij k_j: C = 1/γ - Γ⁻¹."""
        return np.asarray(np.linalg.inv(np.eye(self.stages) / self.gamma - self.C))

    @property
    def _alpha(self) -> Array:
        return np.asarray(self.A @ self._coupling)

    def _require(self, weights: Array, order: int) -> None:
        alpha, coupling = self._alpha, self._coupling
        b = weights @ coupling
        for p in range(1, order + 1):
            for tree in rooted_trees(p):
                got, wanted = float(b @ _weights(alpha, alpha + coupling, tree)), 1 / density(tree)
                if abs(got - wanted) > _DIGITS:
                    raise InputError(
                        f"tableau {self.name!r}: order {p} condition of tree {tree}: got {got:.17g}, "
                        f"expected {wanted:.17g}; the method has not order {order}"
                    )


def _weights(alpha: Array, beta: Array, tree: Tree) -> Array:
    # Where a node has one branch alone, the Jacobian's part is added.
    matrix = beta if len(tree) == 1 else alpha
    out = np.ones(len(alpha))
    for branch in tree:
        out = out * (matrix @ _weights(alpha, beta, branch))
    return out


@cache
def rodas5p() -> RosenbrockTableau:
    """Return Rodas5P, of order 5 with one of order 4 inside: L-stable, and of nearly its order on stiff systems too.

    Steinebach 2023, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks
    within the Julia Differential Equations package, BIT Numerical Mathematics 63:27.
    """
    last = (*_LAST, 1.0, 1.0)
    return RosenbrockTableau(
        "rodas5p",
        _GAMMA,
        _lower((*_A, _LAST, last[:6], last[:7])),
        _lower(_C),
        np.array((*last, 1.0)),
        np.array((0.0,) * 7 + (1.0,)),
        np.array(_DENSE),
        order=5,
        lower=4,
    )


def _lower(rows: tuple[tuple[float, ...], ...]) -> Array:
    out = np.zeros((8, 8))
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out


_GAMMA: Final = 0.21193756319429014
_A: Final[tuple[tuple[float, ...], ...]] = (
    (),
    (3.0,),
    (2.849394379747939, 0.45842242204463923),
    (-6.954028509809101, 2.489845061869568, -10.358996098473584),
    (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
)
#: Weights of the last stages' places and of the step itself, which ends where the method is stiffly accurate.
_LAST: Final = (-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946)
_C: Final[tuple[tuple[float, ...], ...]] = (
    (),
    (-14.155112264123755,),
    (-17.97296035885952, -2.859693295451294),
    (147.12150275711716, -1.41221402718213, 71.68940251302358),
    (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
    (24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471),
    (
        30.91273214028599,
        -3.1208243349937974,
        77.79954646070892,
        34.28646028294783,
        -19.097331116725623,
        -28.087943162872662,
    ),
    (
        37.80277123390563,
        -3.2571969029072276,
        112.26918849496327,
        66.9347231244047,
        -40.06618937091002,
        -54.66780262877968,
        -9.48861652309627,
    ),
)
_DENSE: Final = (
    (
        25.948786856663858,
        -2.5579724845846235,
        10.433815404888879,
        -2.3679251022685204,
        0.524948541321073,
        1.1241088310450404,
        0.4272876194431874,
        -0.17202221070155493,
    ),
    (
        -9.91568850695171,
        -0.9689944594115154,
        3.0438037242978453,
        -24.495224566215796,
        20.176138334709044,
        15.98066361424651,
        -6.789040303419874,
        -6.710236069923372,
    ),
    (
        11.419903575922262,
        2.8879645146136994,
        72.92137995996029,
        80.12511834622643,
        -52.072871366152654,
        -59.78993625266729,
        -0.15582684282751913,
        4.883087185713722,
    ),
)
