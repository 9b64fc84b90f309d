"""Accelerations from Gauss's principle of least constraint: forward dynamics that forms no mass matrix.

With the kinetic energy as ½ Σ w ẋ², ẋ = J v, the mass matrix is M = Jᵀ W J, and the accelerations solve ::

    min ½ (J v̇ + c)ᵀ W (J v̇ + c) - fᵀ v̇        c: drifts, f: forces of joints

J's columns are made orthogonal from the leaves to the root, in W's measure, and c with them (modified Gram-Schmidt,
which is backward stable so: Björck 1996, Numerical Methods for Least Squares Problems, ch. 2.4 and 4.1). That gives M's
LᵀDL with D as sums of squares. Elimination of a formed M loses eps M_kk/D_k where a light part moves with a heavy one,
and so does the formed Jᵀ W c, a sum of forces that mostly cancel. Here neither
is formed. A leaf's column has entries in the rows of what it moves alone, and that stays so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np

from mbkit.derivation.kinematics import Kinematics, Vector, add, constant_times, dot3
from mbkit.derivation.model_values import is_zero, scalar
from mbkit.model import Body, Model
from mbkit.model.joint_types import cross3

# An inertia as a sum of squares of rates, in rational numbers.
#
# What the description's doubles say is rounded once, however thin the body: LᵀDL in doubles, or principal axes, would
# lose an inertia about the long axis of a rod as it loses what is left of a mass matrix.

_PAIRS: Final = tuple(combinations_with_replacement(range(3), 2))


class InertiaSquare(NamedTuple):
    """One of the rates u · ω with Σ weight u uᵀ = I; forms c in ω have Σ weight u c = ω × I ω."""

    #: kg m²; below zero by rounding, where the doubles' matrix is so.
    weight: float
    direction: tuple[float, ...]
    turning: tuple[tuple[tuple[int, int], float], ...]


_Form = dict[tuple[int, int], Fraction]


@lru_cache(maxsize=1024)
def inertia_squares(inertia: tuple[float, ...]) -> tuple[InertiaSquare, ...] | None:
    """Return the squares of an inertia given row by row; None if inconsistent."""
    exact = [Fraction(x) for x in inertia]
    I = [exact[3 * i : 3 * i + 3] for i in range(3)]
    torque = _torque(I)
    left, out = [0, 1, 2], []
    while any(I[i][j] for i in left for j in left):
        pivot = max(left, key=lambda i: abs(I[i][i]))
        weight, form = I[pivot][pivot], torque[pivot]
        if not weight:
            return None
        u = [I[pivot][j] / weight if j in left else Fraction(0) for j in range(3)]
        left.remove(pivot)
        for i in left:
            torque[i] = {pair: torque[i][pair] - u[i] * form[pair] for pair in _PAIRS}
        I = [[I[i][j] - weight * u[i] * u[j] for j in range(3)] for i in range(3)]
        try:
            turning = tuple((pair, float(x / weight)) for pair, x in form.items() if x)
            out.append(InertiaSquare(float(weight), tuple(float(x) for x in u), turning))
        except OverflowError:
            return None
    # A torque that no motion of the body resists.
    if any(x for i in left for x in torque[i].values()):
        return None
    return tuple(out)


def _torque(I: list[list[Fraction]]) -> list[_Form]:
    """Return ω × I ω as three forms in ω."""
    out: list[_Form] = []
    for i in range(3):
        form = dict.fromkeys(_PAIRS, Fraction(0))
        for a, b, sign in (((i + 1) % 3, (i + 2) % 3, 1), ((i + 2) % 3, (i + 1) % 3, -1)):
            for j in range(3):
                form[min(a, j), max(a, j)] += sign * I[b][j]
        out.append(form)
    return out


# The kinetic energy as a sum of squares, and what Gauss's principle makes of them.
#
# ::
#
#     T = ½ Σ w ẋ²        ẋ linear in v
#
# The rates ẋ are those of the bodies' centres of mass and their angular velocities, in their own axes, where a tree's
# zeros are exact, and those of rotors. Of all accelerations that the joints allow a motion takes those that make
# Z = ½ Σ w (ẍ - ẍ_free)² least (Gauss 1829; Lanczos 1970, The Variational Principles of Mechanics, ch. IV.8): a linear
# least-squares problem in v̇, for ẍ = J v̇ + what v makes of it.


@dataclass(frozen=True)
class Squares:
    """The rows of the sum, those that move."""

    weights: list[Any]
    #: J = ∂ẋ/∂v, (rows, nv).
    jacobian: Any
    #: ẍ - ẍ_free at v̇ = 0.
    drifts: list[Any]
    #: (nv,), of the turning of bodies whose inertia is a parameter, which may become zero: on the left, like nle.
    force: Any


def has_squares(model: Model) -> bool:
    """Return whether the kinetic energy is such a sum: no parameter off an inertia's diagonal, nor a mere product."""
    bound = {(b.part, b.index) for b in model.bindings if b.where == "bodies" and b.field == "inertia"}
    return all(_has_squares(body, {index for part, index in bound if part == body.name}) for body in model.bodies)


def _has_squares(body: Body, bound: set[tuple[int, ...]]) -> bool:
    if bound:
        off = [(i, j) for i in range(3) for j in range(3) if i != j]
        return not any(index in bound or body.inertia[index] for index in off)
    diagonal = not (body.inertia - np.diag(np.diagonal(body.inertia))).any()
    return diagonal or inertia_squares(tuple(body.inertia.ravel().tolist())) is not None


def squares(kin: Kinematics) -> Squares:
    """Return the sum, of a model that `has_squares`."""
    if not has_squares(kin.model):
        raise ValueError(f"{kin.model.name}: an inertia is no sum of squares")
    rows = _Rows(kin)
    for body in kin.model.bodies:
        rows.body(body.name)
    for joint in kin.model.joints:
        for rotor, rate in zip(kin.values.joints[joint.name].armature, kin.velocities(joint), strict=True):
            rows.row(rotor, rate, 0.0)
    for coupling in kin.model.couplings:
        rows.row(kin.values.couplings[coupling.name].armature, kin.coupled_rate(coupling), 0.0)
    return rows.finished()


class _Rows:
    def __init__(self, kin: Kinematics) -> None:
        self._kin = kin
        self._gravity: dict[str, Vector] = {"world": kin.values.gravity}
        for joint in kin.model.tree:
            self._gravity[joint.child] = kin.from_parent(joint, self._gravity[joint.parent])
        self._weights: list[Any] = []
        self._rates: list[Any] = []
        self._drifts: list[Any] = []
        self._turned: list[tuple[Any, Any]] = []

    def row(self, weight: Any, rate: Any, drift: Any) -> None:
        """Add a square; drift is what its acceleration is beside the derivative of the rate."""
        # What nothing moves is a zero.
        if not is_zero(weight) and isinstance(rate, ca.SX):
            self._weights.append(weight)
            self._rates.append(rate)
            self._drifts.append(drift)

    def body(self, name: str) -> None:
        """Add the squares of a body."""
        linear, angular = self._kin.twists[name]
        values = self._kin.values.bodies[name]
        at_com = add(linear, cross3(angular, values.com))
        # The axes turn below the vector.
        for rate, turned, g in zip(at_com, cross3(angular, at_com), self._gravity[name], strict=True):
            self.row(values.mass, rate, turned - g)
        entries = [x for row in values.inertia for x in row]
        found = inertia_squares(tuple(entries)) if all(isinstance(x, float) for x in entries) else None
        if found is not None:
            for square in found:
                turning = (c * (angular[i] * angular[j]) for (i, j), c in square.turning)
                self.row(square.weight, dot3(square.direction, angular), sum(turning, 0.0))
        elif not all(is_zero(values.inertia[i][j]) for i in range(3) for j in range(3) if i != j):
            raise ValueError(
                f"{name}: an inertia with numbers off its diagonal that are not known, or no sum of squares"
            )
        else:
            # Of parameters, which may become zero; or flat, turning where nothing resists.
            torque = cross3(angular, constant_times(values.inertia, angular))
            for k in range(3):
                self.row(values.inertia[k][k], angular[k], 0.0)
                self._turned.append((angular[k], torque[k]))

    def finished(self) -> Squares:
        v, q = self._kin.v, self._kin.q
        rates = ca.vertcat(ca.SX(0, 1), *self._rates)
        own = ca.jtimes(rates, q, self._kin.qdot)
        drifts = [scalar(own[i]) + drift for i, drift in enumerate(self._drifts)]
        force: Any = ca.SX(v.shape[0], 1)
        turned = [(rate, torque) for rate, torque in self._turned if not is_zero(torque)]
        if turned:
            angular, torque = (ca.vertcat(*(ca.SX(x) for x in column)) for column in zip(*turned, strict=True))
            force = ca.jtimes(angular, v, torque, True)
        return Squares(self._weights, ca.jacobian(rates, v), drifts, force)


class LeastConstraint:
    """The orthogonal elimination of a system's squares.

    Parameters
    ----------
    squares : Squares
    order : sequence of int
        The velocities' indices with every parent before its children.

    Attributes
    ----------
    diagonal : list of casadi.SX
        D_k, by the velocities' indices.
    factors : list of dict of int to casadi.SX
        L_ki of M = Lᵀ D L, whose diagonal is one: of each k those i that come before it.
    """

    def __init__(self, squares: Squares, order: Sequence[int]) -> None:
        self._order, n = tuple(order), len(order)
        self._force = squares.force
        weights = squares.weights
        columns: list[dict[int, Any]] = [{} for _ in range(n)]
        for row, i in zip(*squares.jacobian.sparsity().get_triplet(), strict=True):
            columns[i][row] = scalar(squares.jacobian[row, i])
        drifts = dict(enumerate(squares.drifts))
        self.diagonal: list[Any] = [0.0] * n
        self.factors: list[dict[int, Any]] = [{} for _ in range(n)]
        #: What the drifts weigh along each column.
        self._pulls: list[Any] = [0.0] * n
        for place in reversed(range(n)):
            k = self._order[place]
            column = columns[k]
            weighted = {row: x * weights[row] for row, x in column.items()}
            # A joint that moves nothing has no entry at all: the quotient is then infinite, and the
            # evaluation reports it.
            diagonal = self.diagonal[k] = _dot(weighted, column)
            for i in self._order[:place]:
                other = columns[i]
                if not weighted.keys().isdisjoint(other):
                    factor = self.factors[k][i] = _dot(weighted, other) / diagonal
                    _subtract(other, factor, column)
            pull = self._pulls[k] = _dot(weighted, drifts)
            if column:
                _subtract(drifts, pull / diagonal, column)

    def accelerations(self, f: ca.SX) -> ca.SX:
        """Return v̇ under forces f of the joints, (n,), which hold neither gravity nor what v makes."""
        return self._solved(f - self._force, self._pulls)

    def over_mass(self, f: ca.SX) -> ca.SX:
        """Return M⁻¹ f for right-hand sides f, (n,) or (n, k)."""
        return self._solved(f, [0.0] * len(self._order))

    def _solved(self, f: ca.SX, pulls: Sequence[Any]) -> ca.SX:
        x = [scalar(f[k, :]) for k in range(len(self._order))]
        for k in reversed(self._order):
            for i, factor in self.factors[k].items():
                x[i] = x[i] - factor * x[k]
        for k in self._order:
            moved = sum((factor * x[i] for i, factor in self.factors[k].items()), 0.0)
            x[k] = (x[k] - pulls[k]) / self.diagonal[k] - moved
        return ca.vertcat(ca.SX(0, f.shape[1]), *x)


def _dot(weighted: dict[int, Any], x: dict[int, Any]) -> Any:
    return sum((w * x[row] for row, w in weighted.items() if row in x), 0.0)


def _subtract(x: dict[int, Any], factor: Any, y: dict[int, Any]) -> None:
    for row, entry in y.items():
        x[row] = x.get(row, 0.0) - factor * entry
