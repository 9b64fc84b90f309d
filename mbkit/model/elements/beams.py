"""Beams of assumed modes: joint types that place the end of a beam on a body, and the points that hold its mass.

An Euler-Bernoulli beam is clamped at its root and does not stretch. Its axis is at (s + u, v, w) in the root's frame,
with v = Σ φ_i(s) a_i, w = Σ φ_i(s) b_i, and the shortening u = -½ ∫₀ˢ (v′² + w′²) ds, of second order in deflections,
which stiffens a beam that turns (Kane, Ryan, Banerjee 1987). So each point is a polynomial of the amplitudes, and these
are the coordinates of a joint. The mass lies at the points of Gauss's quadrature, which is exact to rounding. A string
is a beam without stiffness, whose slope at the root is free.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.polynomial import Legendre, Polynomial

from mbkit._check import EPS, ROUNDING, Array, count, shown
from mbkit.errors import InputError
from mbkit.model.joint_types import KINDS, JointType, Placement, Rows, Scalars, Twist, cross3, register_joint_type

#: Modes of a beam, and degree of a shape: the rule integrates products of eight slopes to rounding.
_MAX_MODES: Final = 10
_MAX_POLYNOMIAL_DEGREE: Final = 20
_RULE: Final = np.polynomial.legendre.leggauss(96)
#: Difference of two exact rules by the fine one's rounding; one point more gains a factor of 20.
_IDENTITY: Final[Rows] = np.eye(3).tolist()
#: The straight line from the root.
_ROOTED: Final = Polynomial((0.0, 1.0))


def _unit_rule(points: Any, weights: Any) -> tuple[Array, Array]:
    """Return a rule on [0, 1] of one on [-1, 1]."""
    return (points + 1) / 2, weights / 2


@dataclass(frozen=True)
class Modes:
    """Normal modes of a uniform clamped beam of the length 1, with ∫ φ_i φ_j dξ = δ_ij.

    Attributes
    ----------
    shapes : callable
        ``shapes(xi, k)`` returns the k-th derivatives of all at places (N,), as (n, N).
    squares : (n,) array
        ∫ φ″² dξ.
    """

    shapes: Callable[[Array, int], Array]
    squares: Array


def clamped_free(n: int) -> Modes:
    """Return the exact first modes of a clamped and free beam, as `mbkit.lagrangian.clamped_free` writes them."""
    roots = (np.arange(n) + 0.5) * np.pi
    for _ in range(8):
        # Newton's iteration for cos λ + 1/cosh λ = 0.
        slope = -np.sin(roots) - np.tanh(roots) / np.cosh(roots)
        roots = roots - (np.cos(roots) + 1 / np.cosh(roots)) / slope
    # cosh - σ sinh is a sum of exponentials, with 1 - σ in a form that cancels nothing.
    rest = (np.exp(-roots) + np.cos(roots) + np.sin(roots)) / (np.cosh(roots) + np.cos(roots))
    lam, grows = roots[:, None], rest[:, None] / 2
    falls, sigma = 1 - grows, 1 - rest[:, None]

    def shapes(xi: Array, k: int) -> Array:
        y, quarter = lam * xi, k * np.pi / 2
        turned = np.round(np.cos(quarter)), np.round(np.sin(quarter))
        cos, sin = np.cos(y) * turned[0] - np.sin(y) * turned[1], np.sin(y) * turned[0] + np.cos(y) * turned[1]
        return np.asarray(lam**k * (grows * np.exp(y) + (-1) ** k * falls * np.exp(-y) - cos + sigma * sin))

    return Modes(shapes, np.asarray(roots**4, dtype=np.float64))


def modes_of(modes: Any, shapes: Any, *, string: bool) -> Modes:
    """Return the first exact modes, or those within the span of given shapes; `InputError` for other arguments.

    Those of a string span the polynomials that vanish at its root, with which one that hangs or turns comes close.
    """
    if (modes is None) == (shapes is None):
        raise InputError("expected modes or shapes, one of them")
    if shapes is None:
        n = count("modes", modes, least=1)
        if n > _MAX_MODES:
            raise InputError(f"modes: expected at most {_MAX_MODES}, got {n}")
        return (
            modes_within([_ROOTED * Legendre.basis(k, (0, 1)).convert(kind=Polynomial) for k in range(n)])
            if string
            else clamped_free(n)
        )
    given = list(shapes) if isinstance(shapes, (list, tuple)) else [shapes]
    if not 0 < len(given) <= _MAX_MODES:
        raise InputError(f"shapes: expected 1 to {_MAX_MODES} shapes, got {len(given)}")
    for i, f in enumerate(given):
        # Only floats of NumPy's kinds: complex numbers and objects are none.
        real = isinstance(f, Polynomial) and f.coef.dtype.kind == "f" and np.isfinite(f.coef).all()
        if not real or f.degree() > _MAX_POLYNOMIAL_DEGREE:
            expected = (
                f"numpy.polynomial.Polynomial of s/length, real and finite, of degree <= {_MAX_POLYNOMIAL_DEGREE}"
            )
            raise InputError(f"shapes[{i}]: expected a {expected}, got {shown(f)}")
        held = abs(f(0.0)) if string else max(abs(f(0.0)), abs(f.deriv()(0.0)))
        if held > ROUNDING * np.abs(f.coef).max() or not f.coef.any():
            where = "at the root" if string else "with its slope at the clamp"
            raise InputError(f"shapes[{i}]: expected zero {where} and not everywhere, got {f}")
    return modes_within(given)


def modes_within(shapes: Sequence[Polynomial]) -> Modes:
    """Return the normal modes within the span of polynomials of ξ, by Ritz's method."""
    xi, weights = _unit_rule(*_RULE)

    def given(at: Array, k: int) -> Array:
        return np.array([f.deriv(k)(at) if k else f(at) for f in shapes])

    M, K = (weights * (x := given(xi, k)) @ x.T for k in (0, 2))
    size = np.sqrt(np.diag(M))
    values, vectors = np.linalg.eigh(M / size / size[:, None])
    if not values[0] > len(shapes) * 100 * EPS * values[-1]:
        raise InputError("shapes: one of them is a sum of the others; leave it out")
    half = vectors / np.sqrt(values) / size[:, None]
    squares, turn = np.linalg.eigh(half.T @ K @ half)
    mix = half @ turn
    # The end of the first half of each mode lies on the positive side.
    mix = mix * np.where(mix.T @ given(np.ones(1), 0)[:, 0] < 0, -1.0, 1.0)
    return Modes(lambda at, k: mix.T @ given(at, k), np.maximum(squares, 0.0))


class OnBeam(JointType):
    """What moves with one point of a beam, without a turn; its coordinates are the amplitudes.

    Attributes
    ----------
    place : float
        s, m.
    across : tuple of tuple of float
        Of v, and in space of w, the shapes' values there.
    along : tuple of tuple of float
        H in u = -½ aᵀ H a.
    """

    instead = "model.segmented(20) has a chain of 20 rigid segments in the place of each beam"

    def __init__(self, place: float, across: Array, along: Array) -> None:
        self.place, self.across, self.along = place, _tuples(across), _tuples(along)
        self.nq = self.nv = n = len(along)
        self.lengths = tuple(range(n))
        planes = "vw" if len(across) > 1 else ("",)
        names = [f"{plane}{k + 1}" for plane in planes for k in range(n // len(planes))]
        self.suffixes = self.velocity_suffixes = tuple(names)
        self.name = self._named()

    def _named(self, *more: Any) -> str:
        """Return a name that is that of the numbers, so that equal beams share their types."""
        return f"beam_{hashlib.sha256(repr((self.place, self.across, self.along, more)).encode()).hexdigest()[:16]}"

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:  # noqa: ARG002  # polynomials alone
        """Return R_JC and p_JC_J."""
        return _IDENTITY, [self.place - 0.5 * _bilinear(self.along, q, q), *_deflection(self.across, q)]

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:  # noqa: ARG002  # as above
        """Return the linear and angular velocity of C's origin relative to J, in C's axes."""
        return [0.0 - _bilinear(self.along, q, v), *_deflection(self.across, v)], [0.0, 0.0, 0.0]


class BeamEnd(OnBeam):
    """What moves with the end of a beam and turns with the slope of its axis.

    Attributes
    ----------
    slopes, torsion : tuple of tuple of float
        v′ and w′ of each amplitude; and Q in the turn aᵀ Q a about the axis, by which the end of a beam turns that is
        bent in two planes and nowhere twisted.
    length, squares, weights : float, tuple of float, tuple of float
        The beam's, ∫ φ″² ds of each coordinate, and the length that each of its points stands for, m.
    """

    def __init__(
        self, place: float, across: Array, along: Array, slopes: Array, torsion: Array, squares: Array, weights: Array
    ) -> None:
        super().__init__(place, across, along)
        self.length, self.slopes, self.torsion = place, _tuples(slopes), _tuples(torsion)
        self.squares, self.weights = tuple(squares.tolist()), tuple(weights.tolist())
        self.name = self._named(self.slopes, self.torsion)

    @property
    def point(self) -> OnBeam:
        """The same place without a turn, for equations of what has none."""
        point: OnBeam = _registered(OnBeam(self.place, np.array(self.across), np.array(self.along)))
        return point

    def _half_turn(self, q: Scalars) -> list[Any]:
        """Return Rodrigues's vector tan(θ/2) of the turn, which is half the rotation vector to second order."""
        v, w = _deflection(self.slopes, q)
        return [0.5 * _bilinear(self.torsion, q, q), -0.5 * w, 0.5 * v]

    def placement(self, m: Any, joint: Any, q: Scalars) -> Placement:
        """Return R_JC and p_JC_J."""
        _, p = super().placement(m, joint, q)
        x, y, z = self._half_turn(q)
        k = 2.0 / (1.0 + (x * x + y * y + z * z))
        return [
            [1.0 - k * (y * y + z * z), k * (x * y - z), k * (x * z + y)],
            [k * (x * y + z), 1.0 - k * (x * x + z * z), k * (y * z - x)],
            [k * (x * z - y), k * (y * z + x), 1.0 - k * (x * x + y * y)],
        ], p

    def twist(self, m: Any, joint: Any, q: Scalars, v: Scalars) -> Twist:
        """Return the linear and angular velocity of C's origin relative to J, in C's axes."""
        R, _ = self.placement(m, joint, q)
        linear, _ = super().twist(m, joint, q, v)
        r, (v1, w1) = self._half_turn(q), _deflection(self.slopes, v)
        rate = [0.5 * (_bilinear(self.torsion, q, v) + _bilinear(self.torsion, v, q)), -0.5 * w1, 0.5 * v1]
        # ω = 2 (ṙ - r × ṙ)/(1 + r²) (Shuster 1993, A survey of attitude representations, eq. 335).
        k = 2.0 / (1.0 + (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]))
        turning = [k * (x - y) for x, y in zip(rate, cross3(r, rate), strict=True)]
        return [sum(R[i][j] * linear[i] for i in range(3)) for j in range(3)], turning


_Rows = tuple[tuple[float, ...], ...]


def _tuples(A: Array) -> _Rows:
    return tuple(tuple(row) for row in A.tolist())


def _deflection(rows: _Rows, q: Scalars) -> list[Any]:
    """Return A q, of y and z; zeros of A cost nothing."""
    out = [sum((c * x for c, x in zip(row, q, strict=True) if c), 0.0) for row in rows]
    return out + [0.0] * (2 - len(out))


def _bilinear(rows: _Rows, q: Scalars, v: Scalars) -> Any:
    """Return qᵀ A v."""
    inner = [sum((c * x for c, x in zip(row, v, strict=True) if c), 0.0) for row in rows]
    return sum((x * y for x, y, row in zip(q, inner, rows, strict=True) if any(row)), 0.0)


def _registered(joint_type: OnBeam) -> Any:
    return KINDS.get(joint_type.name) or register_joint_type(joint_type)


def beam_types(length: float, modes: Modes, planes: int) -> tuple[BeamEnd, tuple[OnBeam, ...]]:
    """Return the registered joint types of a beam's end and of the points with its mass."""
    n = len(modes.squares)
    fine, fine_weights = _unit_rule(*_RULE)

    def shortening(xi: Array) -> Array:
        """Return ∫₀^ξ φ_i′ φ_j′, (N, n, n)."""
        slopes = [(x, modes.shapes(x * fine, 1)) for x in xi]
        return np.array([x * (fine_weights * slope) @ slope.T for x, slope in slopes], dtype=np.float64)

    def moments(xi: Array, weights: Array) -> Array:
        """Return the integrals of all products that stand in the kinetic energy."""
        upper = np.triu_indices(n)
        f = np.vstack([np.ones_like(xi), xi, modes.shapes(xi, 0), shortening(xi)[:, *upper].T])
        return np.asarray((weights * f) @ f.T)

    exact = moments(fine, fine_weights)
    size = np.sqrt(np.diag(exact))
    for points in range(2, len(fine)):
        xi, weights = _unit_rule(*np.polynomial.legendre.leggauss(points))
        # The difference of two exact rules is the fine one's rounding; one point more gains a factor of 20.
        if (np.abs(moments(xi, weights) - exact) / size / size[:, None]).max() < 500 * EPS:
            break

    def blocks(A: Array) -> Array:
        return np.asarray(np.kron(np.eye(planes), A), dtype=np.float64)

    def across(xi: float, k: int) -> Array:
        return blocks(modes.shapes(np.array([xi]), k).T / length**k)

    H = shortening(np.array([*xi, 1.0])) / length
    torsion = np.zeros((planes * n, planes * n))
    if planes > 1:
        # τ′ = ½ (v′ w″ - w′ v″) to second order where nothing is twisted.
        product = (fine_weights * modes.shapes(fine, 1)) @ modes.shapes(fine, 2).T
        torsion[:n, n:] = (product - product.T) / 2 / length**2
    squares = np.tile(modes.squares, planes) / length**3
    end = BeamEnd(length, across(1.0, 0), blocks(H[-1]), across(1.0, 1), torsion, squares, weights * length)
    inner = [OnBeam(x * length, across(x, 0), blocks(h)) for x, h in zip(xi.tolist(), H[:-1], strict=True)]
    return _registered(end), tuple(_registered(point) for point in inner)
