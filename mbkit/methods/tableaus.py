"""Butcher tableaus: those of users check themselves, those of mbkit are checked in exact arithmetic by its tests."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cache, cached_property, partial
from itertools import combinations_with_replacement
from math import fsum, prod, sqrt
from typing import Any, ClassVar, Final

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from mbkit._check import EPS, ROUNDING, Array
from mbkit.errors import InputError
from mbkit.methods.one_step import StageRates, Stages
from mbkit.model.integration_space import Space

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


def rounding_of_condition(A: Array, b: Array, tree: Tree) -> float:
    """Return what rounding can leave of an order condition, whatever the order in which its sums are taken.

    Each of the tree's nodes is one sum of s products (Higham 2002, Accuracy and Stability of Numerical Algorithms,
    section 3.1), and its coefficients are rounded themselves: s + 1 roundings for each node, relative to the nested
    product of the magnitudes.
    """
    size = float(np.abs(b) @ _stage_weights(np.abs(A), tree))
    return _nodes(tree) * (len(b) + 1) * EPS * size


def _require_order(name: str, A: Array, b: Array, order: int) -> None:
    """Raise where an order condition fails."""
    for p in range(1, order + 1):
        for tree in rooted_trees(p):
            got, wanted = float(b @ _stage_weights(A, tree)), 1 / density(tree)
            if abs(got - wanted) > rounding_of_condition(A, b, tree):
                raise InputError(
                    f"tableau {name!r}: order {p} condition of tree {tree}: got {got:.17g}, "
                    f"expected 1/{density(tree)}; the method has not order {order}"
                )


def _numbers(tableau: str, name: str, value: ArrayLike) -> Array:
    """Return an argument of a tableau as a read-only array of finite numbers."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"tableau {tableau!r}: {name}: expected an array of numbers, got {value!r}") from None
    if not np.isfinite(array).all():
        raise InputError(f"tableau {tableau!r}: {name}: expected finite numbers, got {array.tolist()}")
    array.setflags(write=False)
    return array


def _times(rows: Array) -> Array:
    sums = np.array([fsum(row) for row in rows])
    # No stage lies behind the end of the step by a rounding.
    return np.where(np.abs(sums - 1.0) < ROUNDING, 1.0, sums)


def extrapolation_weights(times: Sequence[float], at: Iterable[float]) -> Array:
    """Return the weights of values at some times in the values of their polynomial at others, one row for each."""
    return np.array([[prod((x - b) / (a - b) for b in times if b != a) for a in times] for x in at])


def _digest(*arrays: Array) -> str:
    return hashlib.sha256(b"".join(x.tobytes() for x in arrays)).hexdigest()[:8]


def _unchecked(kind: type, **attributes: Any) -> Any:
    """Return a tableau that has been checked already: one of mbkit's own, or one that was pickled."""
    out: Any = object.__new__(kind)
    for name, value in attributes.items():
        if isinstance(value, (np.ndarray, list)):
            value = _numbers(attributes["name"], name, value)
        elif isinstance(value, tuple):
            value = tuple(_numbers(attributes["name"], name, x) for x in value)
        object.__setattr__(out, name, value)
    return out


@dataclass(frozen=True, eq=False)
class Tableau:
    """An explicit Runge-Kutta method.

    The constructor checks the shapes, and every order condition Σ b Φ(tree) = 1 / γ(tree) up to `order` (Hairer,
    Nørsett, Wanner 1993, theorem II.2.13), to what rounding can leave of it on any processor.

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
        matrix, weights = _numbers(name, "A", A), _numbers(name, "b", b)
        s = len(weights) if weights.ndim == 1 else 0
        if not s or matrix.shape != (s, s):
            raise InputError(f"tableau {name!r}: expected A (s, s) and b (s,), got {matrix.shape} and {weights.shape}")
        if self.explicit and np.any(np.triu(matrix)):
            raise InputError(f"tableau {name!r}: A is not strictly lower triangular, so the method is not explicit")
        _require_order(name, matrix, weights, order)
        for attribute, value in (("name", name), ("A", matrix), ("b", weights), ("order", order)):
            object.__setattr__(self, attribute, value)

    @property
    def c(self) -> Array:
        """Stage times as fractions of the step, shape (s,)."""
        return _times(self.A)

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.b)

    @property
    def ends_at_a_stage(self) -> bool:
        """Whether the last stage is at the end of the step, near the state there."""
        return self.stages > 1 and bool(abs(self.c[-1] - 1) < ROUNDING)

    @cached_property
    def _rows(self) -> list[tuple[float, Array]]:
        """Time and weights of each stage, sliced once."""
        return [(float(c), self.A[i, :i]) for i, c in enumerate(self.c)]

    @cached_property
    def digest(self) -> str:
        """Eight digits that tell the coefficients, for the name of compiled code."""
        return _digest(self.A, self.b)

    def step(
        self, space: Space, rates: StageRates, stages: Stages, t: Any, h: Any, q: Any, w: Any
    ) -> tuple[Any, Any, Any]:
        """Take an explicit step on any arithmetic; rotations by Munthe-Kaas (1999).

        Parameters
        ----------
        space : Space
        rates : callable
            (t, q, u, w) -> (u̇, ẇ) at a stage, which q moved by u; u is None where it is zero.
        stages : Stages
            Rates of the stages that are known already, none as a rule.
        t, h : scalars
            Start and length of the step, s.
        q, w : state

        Returns
        -------
        q, w, u
            The new state, which is the old q moved by u.
        """
        known = len(stages)
        if not known:
            stages.append(*rates(t, q, None, w))
        for c, weights in self._rows[max(known, 1) :]:
            u, dw = stages.moved(h, weights)
            stages.append(*rates(t + c * h, space.retract(q, u), u, w + dw))
        u, dw = stages.moved(h, self.b)
        return space.retract(q, u), w + dw, u

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(_unchecked, type(self), **{f.name: getattr(self, f.name) for f in fields(self)}), ()


class ImplicitTableau(Tableau):
    """A Runge-Kutta method whose stages depend on one another: A is any matrix, checked as that of a `Tableau`."""

    explicit: ClassVar[bool] = False


#: Kutta's classical method (1901), MuJoCo's too.
RK4: Final[Tableau] = _unchecked(
    Tableau,
    name="rk4",
    A=[[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
    b=[1 / 6, 1 / 3, 1 / 3, 1 / 6],
    order=4,
)


@cache
def gauss_legendre(stages: int) -> ImplicitTableau:
    """Return Gauss-Legendre collocation, of the highest order for so many stages.

    Hairer, Nørsett, Wanner 1993, Solving Ordinary Differential Equations I, II.7.
    """
    rows: Any
    weights: Any
    if stages == 2:
        r = sqrt(3) / 6
        rows, weights = [[1 / 4, 1 / 4 - r], [1 / 4 + r, 1 / 4]], [1 / 2, 1 / 2]
    elif stages == 3:
        r = sqrt(15)
        rows = [
            [5 / 36, 2 / 9 - r / 15, 5 / 36 - r / 30],
            [5 / 36 + r / 24, 2 / 9, 5 / 36 - r / 24],
            [5 / 36 + r / 30, 2 / 9 + r / 15, 5 / 36],
        ]
        weights = [5 / 18, 4 / 9, 5 / 18]
    else:
        x, weights = legendre.leggauss(stages)
        integrals = legendre.legval(x, legendre.legint(np.eye(stages), lbnd=-1, axis=0)).T
        rows, weights = np.linalg.solve(legendre.legvander(x, stages - 1).T, integrals.T).T / 2, weights / 2
    order = 2 * stages
    out: ImplicitTableau = _unchecked(ImplicitTableau, name=f"gauss{order}", A=rows, b=weights, order=order)
    return out


@dataclass(frozen=True, eq=False)
class EmbeddedTableau(Tableau):
    """An explicit method with others of lower order on the same stages, which estimate its error.

    `errors` are b minus the weights of each other method, (s,) each.
    """

    errors: tuple[Array, ...]

    @property
    def digest(self) -> str:
        """Eight digits that tell the coefficients, for the name of compiled code."""
        return _digest(self.A, self.b, *self.errors)


@cache
def dormand_prince_853() -> EmbeddedTableau:
    """Return Dormand and Prince's pair of order 8, with errors estimated by orders 5 and 3.

    Hairer, Nørsett, Wanner 1993, Solving Ordinary Differential Equations I, II.5 and its program DOP853.
    """
    b = np.array(_B_853)
    third = b.copy()
    third[[0, 8, 11]] -= _B_3
    out: EmbeddedTableau = _unchecked(
        EmbeddedTableau, name="dormand_prince_853", A=_lower(_A_853), b=b, order=8, errors=(np.array(_E_853), third)
    )
    return out


# fmt: off
_A_853: Final[tuple[tuple[float, ...], ...]] = (
    (),
    (0.05260015195876773,),
    (0.0197250569845379, 0.0591751709536137),
    (0.02958758547680685, 0.0, 0.08876275643042054),
    (0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792),
    (0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242),
    (0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125),
    (0.03709200011850479, 0.0, 0.0, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402,
     0.008273789163814023),
    (0.6241109587160757, 0.0, 0.0, -3.3608926294469414, -0.868219346841726, 27.59209969944671, 20.154067550477894,
     -43.48988418106996),
    (0.47766253643826434, 0.0, 0.0, -2.4881146199716677, -0.590290826836843, 21.230051448181193, 15.279233632882423,
     -33.28821096898486, -0.020331201708508627),
    (-0.9371424300859873, 0.0, 0.0, 5.186372428844064, 1.0914373489967295, -8.149787010746927, -18.52006565999696,
     22.739487099350505, 2.4936055526796523, -3.0467644718982196),
    (2.273310147516538, 0.0, 0.0, -10.53449546673725, -2.0008720582248625, -17.9589318631188, 27.94888452941996,
     -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636),
)
_B_853: Final = (
    0.054293734116568765, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003, -5.801203960010585,
    0.3111643669578199, -0.1521609496625161, 0.20136540080403034, 0.04471061572777259,
)
#: b minus the weights of order 5.
_E_853: Final = (
    0.01312004499419488, 0.0, 0.0, 0.0, 0.0, -1.2251564463762044, -0.4957589496572502, 1.6643771824549864,
    -0.35032884874997366, 0.3341791187130175, 0.08192320648511571, -0.022355307863886294,
)
# fmt: on
#: Weights of order 3, of the first, the ninth and the last stage.
_B_3: Final = (0.2440944881889764, 0.7338466882816118, 0.022058823529411766)


# Rosenbrock methods
#
# A stage solves one linear system with the Jacobian J in it (Hairer, Wanner 1996, Solving Ordinary Differential
# Equations II, IV.7)::
#
#     (1/(γ h) - J) k_i = f(t + c_i h, y + Σ a_ij k_j) + Σ (C_ij/h) k_j + d_i h ∂f/∂t      y1 = y + Σ b_i k_i


@dataclass(frozen=True, eq=False)
class RosenbrockTableau:
    """A Rosenbrock method with another of lower order on the same stages.

    `gamma` is γ, the same in all stages; A and C are strictly lower triangular, (s, s); b are the weights, and error
    is b minus those of the other method, (s,). The state within a step, at t + θ h and with D = dense k, dense of shape
    (3, s), is ::

        y(θ) = (1 - θ) y + θ (y1 + (1 - θ) (D₁ + θ (D₂ + θ D₃)))
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

    @property
    def stages(self) -> int:
        """Number of stages."""
        return self.b.size

    @property
    def digest(self) -> str:
        """Eight digits that tell the coefficients, for the name of compiled code."""
        return _digest(np.array(self.gamma), self.A, self.C, self.b, self.error, self.dense)

    @property
    def c(self) -> Array:
        """Stage times as fractions of the step, shape (s,)."""
        return _times(self._alpha)

    @property
    def d(self) -> Array:
        """Factors of ∂f/∂t, shape (s,)."""
        sums = np.array([fsum(row) for row in self._coupling])
        return np.where(np.abs(sums) < ROUNDING, 0.0, sums)

    @property
    def _coupling(self) -> Array:
        """Γ of the form in which stages are h f + h J Σ Γ_ij k_j: C = 1/γ - Γ⁻¹, by forward substitution."""
        out = np.zeros(self.C.shape)
        for i, row in enumerate(self.C):
            for j in range(i + 1):
                out[i, j] = self.gamma * ((i == j) + fsum(row[j:i] * out[j:i, j]))
        return out

    @property
    def _alpha(self) -> Array:
        return np.array([[fsum(row * column) for column in self._coupling.T] for row in self.A])


@cache
def rodas5p() -> RosenbrockTableau:
    """Return Rodas5P, of order 5 with one of order 4 inside: L-stable, and of nearly its order on stiff systems too.

    Steinebach 2023, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks
    within the Julia Differential Equations package, BIT Numerical Mathematics 63:27.
    """
    last = (*_LAST, 1.0, 1.0)
    out: RosenbrockTableau = _unchecked(
        RosenbrockTableau,
        name="rodas5p",
        gamma=0.21193756319429014,
        A=_lower((*_A, _LAST, last[:6], last[:7])),
        C=_lower(_C),
        b=np.array((*last, 1.0)),
        error=np.array((0.0,) * 7 + (1.0,)),
        dense=np.array(_DENSE),
        order=5,
        lower=4,
    )
    return out


def _lower(rows: tuple[tuple[float, ...], ...]) -> Array:
    out = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out


_A: Final[tuple[tuple[float, ...], ...]] = (
    (),
    (3.0,),
    (2.849394379747939, 0.45842242204463923),
    (-6.954028509809101, 2.489845061869568, -10.358996098473584),
    (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
)
#: Weights of the last stages' places and of the step itself, which ends where the method is stiffly accurate.
_LAST: Final = (-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946)
# fmt: off
_C: Final[tuple[tuple[float, ...], ...]] = (
    (),
    (-14.155112264123755,),
    (-17.97296035885952, -2.859693295451294),
    (147.12150275711716, -1.41221402718213, 71.68940251302358),
    (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
    (24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471),
    (30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783, -19.097331116725623,
     -28.087943162872662),
    (37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047, -40.06618937091002,
     -54.66780262877968, -9.48861652309627),
)
_DENSE: Final = (
    (25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204, 0.524948541321073,
     1.1241088310450404, 0.4272876194431874, -0.17202221070155493),
    (-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796, 20.176138334709044,
     15.98066361424651, -6.789040303419874, -6.710236069923372),
    (11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643, -52.072871366152654,
     -59.78993625266729, -0.15582684282751913, 4.883087185713722),
)
# fmt: on
