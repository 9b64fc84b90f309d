"""Forward dynamics link by link: Gauss's function, minimized over one acceleration after the other.

The accelerations minimize Gauss's function (Gauss 1829; Lanczos 1970, The Variational Principles of Mechanics,
ch. IV.8) ::

    Z = Σ_links ½ Aᵀ J A + Aᵀ b  +  Σ ½ ρ v̇²  -  f·v̇        A = X A_parent + S v̇ + c

over v̇, where A = (a, ω̇) is the acceleration of a link's origin and its angular acceleration, J the link's inertia
about the origin, b = (ω × (ω × h), ω × I ω), c the drift of the joint, ρ the rotors and f the joints' forces.
Gravity accelerates the world by -g. Nothing but kinematics and the kinetic energy of acceleration enters.

A link's acceleration depends on those above it through A_parent alone. So, from the leaves to the root, v̇ of a joint is
eliminated: the least Z of all that it carries is again a quadratic function of A_parent (dynamic programming, as in
Brandl, Johanni and Otter 1988, An algorithm for the simulation of multibody systems with kinematic loops). From the
root to the leaves the accelerations follow. The work grows with the number of links. The operations are those of the
articulated-body algorithm (Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 7), in axes of the links, where the
zeros of the axes are used.

A velocity that several joints share, by mimicking or by the rotor of a coupling, is carried as a further unknown
until all its joints are below, and eliminated there. A velocity can also be carried to the root on purpose: carrying
all gives M and the forces of v̇ = 0, by composite bodies.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mbkit.derivation.kinematics import Vector, add
from mbkit.derivation.link_mechanics import (
    LinkMechanics,
    dot6,
    negative,
    rigid_times,
    rotated6,
    symmetric_times,
    vanishes,
    with_moment,
)
from mbkit.derivation.links import Inertia, Link
from mbkit.derivation.mass_matrix_solve import reciprocal
from mbkit.derivation.model_values import is_zero
from mbkit.derivation.rotations import SYMMETRIC, Rotation, Rows, congruence, difference, two_sided
from mbkit.model.joint_types import cross3, dot3

#: Accelerations of carried velocities -> those of all, by velocity index.
Unfold = Callable[[dict[int, Any]], list[Any]]


@dataclass
class Pivot:
    """One elimination: v̇_k = (f_k - r_k - U·A - Σ Y_ki v̇_i) / D."""

    velocity: int
    inverse: Any
    row: Vector
    ratio: Vector
    others: dict[int, Any]
    #: The direction in which A drops out, so that the joint's force alone passes.
    free: int | None
    #: Directions of the others whose columns are unit vectors, and whose Y_ki are entries of U.
    units: dict[int, int]

    def acceleration(self, force: Any, A: Vector, done: Mapping[int, Any]) -> Any:
        """Return v̇_k from f_k - r_k, A without the link's own velocities, and the other accelerations."""
        moved = list(A)
        for i, place in self.units.items():
            moved[place] = moved[place] + done[i]
        along = [x for n, x in enumerate(zip(self.row, moved, strict=True)) if n != self.free]
        known = sum((x * a for x, a in along if not is_zero(x)), 0.0)
        known = known + sum((x * done[i] for i, x in self.others.items() if i not in self.units), 0.0)
        out = difference(force, known) * self.inverse
        # In that direction U is the pivot.
        return out if self.free is None else out - A[self.free]


@dataclass
class GaussFunction:
    """½ Aᵀ J A + Σ yᵢ Kᵢ·A + ½ Σ Yᵢⱼ yᵢ yⱼ of a link's A and of carried accelerations y.

    J = [[M, H], [Hᵀ, I]]; as long as `rigid`, M is a mass times one and H = -h×.
    """

    inertia: Inertia
    rigid: bool = True
    M: Vector = field(default_factory=lambda: [0.0] * 6)
    H: Rows = field(default_factory=lambda: [[0.0] * 3 for _ in range(3)])
    I: Vector = field(default_factory=lambda: [0.0] * 6)
    K: dict[int, Vector] = field(default_factory=dict)
    Y: dict[tuple[int, int], Any] = field(default_factory=dict)
    uses: Counter[int] = field(default_factory=Counter)

    def soften(self) -> None:
        """Write the inertia of a rigid body out."""
        if self.rigid:
            m, h, self.I = self.inertia.mass, self.inertia.moment, list(self.inertia.inertia)
            self.M = [m, 0.0, 0.0, m, 0.0, m]
            self.H = [[0.0, h[2], negative(h[1])], [negative(h[2]), 0.0, h[0]], [h[1], negative(h[0]), 0.0]]
            self.rigid = False

    def times(self, x: Vector) -> Vector:
        """Return J x."""
        if self.rigid:
            return rigid_times(self.inertia, x)
        a, w = x[:3], x[3:]
        force = add(symmetric_times(self.M, a), [dot3(row, w) for row in self.H])
        return force + add([dot3(column, a) for column in zip(*self.H, strict=True)], symmetric_times(self.I, w))

    def add(self, other: GaussFunction) -> None:
        """Add another function of the same A."""
        if self.rigid and other.rigid:
            self.inertia = self.inertia + other.inertia
        else:
            self.soften()
            other.soften()
            self.M, self.I = add(self.M, other.M), add(self.I, other.I)
            self.H = [add(a, b) for a, b in zip(self.H, other.H, strict=True)]
        for k, x in other.K.items():
            self.K[k] = add(self.K[k], x) if k in self.K else x
        for (i, j), y in other.Y.items():
            self.raise_coupling(i, j, y)
        self.uses += other.uses

    def introduce(self, k: int, column: Vector, rotor: Any) -> None:
        """Replace A by A + column y_k, and add a rotor."""
        image = self.times(column)
        for i, x in self.K.items():
            through = dot6(column, x)
            self.raise_coupling(i, k, 2.0 * through if i == k else through)
        self.raise_coupling(k, k, dot6(column, image) + rotor)
        self.K[k] = add(self.K[k], image) if k in self.K else image
        self.uses[k] += 1

    def raise_coupling(self, i: int, k: int, x: Any) -> None:
        """Add to Y_ik."""
        key = (i, k) if i <= k else (k, i)
        self.Y[key] = self.Y.get(key, 0.0) + x

    def coupling(self, i: int, k: int) -> Any:
        """Return Y_ik."""
        return self.Y.get((i, k) if i <= k else (k, i), 0.0)

    def eliminate(self, k: int, free: int | None, units: Mapping[int, int]) -> Pivot:
        """Minimize over y_k; `free` is the direction in which A then drops out, if there is one.

        `units` are the directions of velocities whose columns are unit vectors: K and Y of these are entries of J, and
        their products are written alike, so that they are computed once.
        """
        self.soften()
        row, diagonal = self.K.pop(k), self.coupling(k, k)
        others = {i: self.coupling(i, k) for i in self.K}
        inverse = reciprocal(diagonal)
        ratio = [x * inverse for x in row]
        self.Y = {key: x for key, x in self.Y.items() if k not in key}
        for i in range(6):
            for j in range(i, 6):
                self._lower(i, j, None if free in (i, j) else ratio[i] * row[j])
        for i, y in others.items():
            share, place = y * inverse, units.get(i, 5)
            products = [ratio[n] * y if n <= place else share * row[n] for n in range(6)]
            self.K[i] = [0.0 if n == free else difference(x, products[n]) for n, x in enumerate(self.K[i])]
            for j, z in others.items():
                if i <= j:
                    self.Y[i, j] = difference(self.Y.get((i, j), 0.0), share * z)
        units = {i: place for i, place in units.items() if i in others}
        return Pivot(k, inverse, row, ratio, others, free, units)

    def _lower(self, i: int, j: int, x: Any) -> None:
        """Subtract from J_ij; None makes it zero."""
        if i < 3 <= j:
            entries, place = self.H[i], j - 3
        else:
            entries, place = (self.M if j < 3 else self.I), SYMMETRIC[i % 3][j % 3]
        entries[place] = 0.0 if x is None else difference(entries[place], x)

    def rotated(self, R: Rotation) -> None:
        """Write it in the axes to which R turns."""
        if not R:
            return
        if self.rigid:
            self.inertia = self.inertia.rotated(R)
        else:
            self.M, self.H, self.I = congruence(R, self.M), two_sided(R, self.H), congruence(R, self.I)
        self.K = {k: rotated6(R, x) for k, x in self.K.items()}

    def shifted(self, r: Vector) -> None:
        """Replace a by a + ω̇ × r."""
        if all(is_zero(x) for x in r):
            return
        if self.rigid:
            self.inertia = self.inertia.shifted(r)
        else:
            # H' = H - M r×, whose rows are r × M_i; I' = I + r× H' - Hᵀ r×, with Hᵀ r× = -(r× H)ᵀ.
            H = [add(self.H[i], cross3(r, [self.M[SYMMETRIC[i][j]] for j in range(3)])) for i in range(3)]
            turned, back = ([cross3(r, list(column)) for column in zip(*G, strict=True)] for G in (H, self.H))
            change = [turned[j][i] + back[i][j] for i in range(3) for j in range(i, 3)]
            self.H, self.I = H, add(self.I, change)
        self.K = {k: with_moment(x, r) for k, x in self.K.items()}


@dataclass
class Level:
    """What happens on the way from a link to its parent, for forces and accelerations."""

    #: Eliminated in A of the link, before its own velocities enter.
    first: list[Pivot] = field(default_factory=list)
    #: Eliminated in X A_parent + c.
    then: list[Pivot] = field(default_factory=list)
    #: J and K times the drifts, in the axes of C and of the parent.
    drift: tuple[Vector, dict[int, Any]] = field(default_factory=lambda: ([0.0] * 6, {}))
    shift: tuple[Vector, dict[int, Any]] = field(default_factory=lambda: ([0.0] * 6, {}))


class GaussElimination:
    """Gauss's function of a tree, reduced to the velocities in `carried`.

    Parameters
    ----------
    mechanics : LinkMechanics
    carried : collection of int
        Velocities that are not eliminated.

    Attributes
    ----------
    rest : dict of (int, int) to casadi.SX
        The inertia of the carried velocities once the others give way: M, if all are carried.
    """

    def __init__(self, mechanics: LinkMechanics, carried: Collection[int] = ()) -> None:
        self.mechanics, self.links, self._carried = mechanics, mechanics.links, frozenset(carried)
        self._kin = mechanics.kin
        self._uses: Counter[int] = Counter(k for link in self.links for k, _ in link.columns)
        self._couplings: list[tuple[Any, dict[int, Any]]] = []
        for coupling in self._kin.model.couplings:
            row, rotor = mechanics.coupling(coupling)
            if row:
                self._couplings.append((rotor, row))
                self._uses.update(row.keys())
        self._levels = [Level() for _ in self.links]
        self._top = Level()
        self.rest = self._fold()

    def _fold(self) -> dict[tuple[int, int], Any]:
        """Eliminate from the leaves to the root."""
        world = GaussFunction(Inertia())
        below = [GaussFunction(link.inertia) for link in self.links]
        for index in reversed(range(len(self.links))):
            link, function, level = self.links[index], below[index], self._levels[index]
            level.first = self._settled(function)
            for (k, column), rotor in zip(link.columns, link.rotors, strict=True):
                function.introduce(k, column, rotor)
            level.then = self._settled(function, link)
            level.drift = self._images(function, self.mechanics.drifts[index])
            function.rotated(link.turn)
            function.shifted(link.slide)
            function.rotated(link.fixed)
            level.shift = self._images(function, self.mechanics.shifts[index])
            function.shifted(link.translation)
            (below[link.parent] if link.parent >= 0 else world).add(function)
        self._top.first = self._settled(world)
        self._top.drift = self._images(world, self.mechanics.ground)
        return world.Y

    @staticmethod
    def _images(function: GaussFunction, c: Vector) -> tuple[Vector, dict[int, Any]]:
        if vanishes(c):
            return [0.0] * 6, {}
        return function.times(c), {k: dot6(c, x) for k, x in function.K.items()}

    def _settled(self, function: GaussFunction, link: Link | None = None) -> list[Pivot]:
        """Eliminate the velocities of which every joint and coupling is in the function."""
        for rotor, row in list(self._couplings):
            if row.keys() <= function.K.keys():
                self._couplings.remove((rotor, row))
                function.uses.update(row.keys())
                for i, a in row.items():
                    for j, b in row.items():
                        if i <= j:
                            function.raise_coupling(i, j, rotor * a * b)
        ready = [k for k in function.K if function.uses[k] == self._uses[k] and k not in self._carried]
        own = () if link is None else ((k, _unit(column)) for k, column in link.columns if self._uses[k] == 1)
        units = {k: place for k, place in own if place is not None}
        return [
            function.eliminate(k, self._free(k, link), units if self._uses[k] == 1 else {}) for k in reversed(ready)
        ]

    def _free(self, k: int, link: Link | None) -> int | None:
        """Return the direction of a velocity that nothing else couples, along which A drops out."""
        if link is None or self._uses[k] > 1:
            return None
        for (index, column), rotor in zip(link.columns, link.rotors, strict=True):
            if index == k and is_zero(rotor):
                return _unit(column)
        return None

    def accelerations(self, f: Sequence[Any], *, drifts: bool = True) -> tuple[dict[int, Any], Unfold]:
        """Return the rest's force of each carried velocity, and a function of their accelerations that gives all.

        `f` are the forces of the joints, one scalar each, which hold neither gravity nor what v makes. Without drifts
        velocities and gravity are zero.
        """
        nothing = ([0.0] * 6, dict[int, Any]())
        p = [list(self.mechanics.bias(i)) if drifts else [0.0] * 6 for i in range(len(self.links))]
        r: list[dict[int, Any]] = [{} for _ in self.links]
        top_p, top_r = [0.0] * 6, dict[int, Any]()
        forces: dict[int, Any] = {}

        def settle(pivots: list[Pivot], p: Vector, r: dict[int, Any]) -> Vector:
            for pivot in pivots:
                k = pivot.velocity
                force = forces[k] = difference(f[k], r.pop(k, 0.0))
                p = [x + a * force for x, a in zip(p, pivot.ratio, strict=True)]
                if pivot.free is not None:
                    p[pivot.free] = f[k]
                for i, y in pivot.others.items():
                    # Along a unit column r is an entry of p.
                    unit = pivot.units.get(i)
                    share = y * (force * pivot.inverse) if unit is None else pivot.ratio[unit] * force
                    r[i] = r.get(i, 0.0) + share
            return p

        def moved(p: Vector, r: dict[int, Any], images: tuple[Vector, dict[int, Any]]) -> Vector:
            for k, x in images[1].items():
                r[k] = r.get(k, 0.0) + x
            return add(p, images[0])

        for index in reversed(range(len(self.links))):
            link, level, r_i = self.links[index], self._levels[index], r[index]
            x = settle(level.first, p[index], r_i)
            for k, column in link.columns:
                r_i[k] = r_i.get(k, 0.0) + dot6(column, x)
            x = settle(level.then, x, r_i)
            x = moved(x, r_i, level.drift if drifts else nothing)
            x = rotated6(link.fixed, with_moment(rotated6(link.turn, x), link.slide))
            x = with_moment(moved(x, r_i, level.shift if drifts else nothing), link.translation)
            above_p, above_r = (p[link.parent], r[link.parent]) if link.parent >= 0 else (top_p, top_r)
            above_p[:] = add(above_p, x)
            for k, y in r_i.items():
                above_r[k] = above_r.get(k, 0.0) + y
        top = settle(self._top.first, top_p, top_r)
        moved(top, top_r, self._top.drift if drifts else nothing)
        rest = {k: difference(f[k], x) for k, x in top_r.items()}

        def unfold(y: dict[int, Any]) -> list[Any]:
            done = dict(y)

            def resolve(pivots: list[Pivot], A: Vector) -> None:
                for pivot in reversed(pivots):
                    done[pivot.velocity] = pivot.acceleration(forces[pivot.velocity], A, done)

            world = self.mechanics.ground if drifts else [0.0] * 6
            resolve(self._top.first, world)
            A: list[Vector] = []
            for index, (link, level) in enumerate(zip(self.links, self._levels, strict=True)):
                above = A[link.parent] if link.parent >= 0 else world
                x = self.mechanics.carried(index, above, drifts=drifts)
                resolve(level.then, x)
                for k, column in link.columns:
                    x = add(x, [c * done[k] for c in column])
                resolve(level.first, x)
                A.append(x)
            return [done[k] for k in range(self._kin.model.nv)]

        return rest, unfold

    def inverse_factors(self) -> tuple[list[Any], dict[tuple[int, int], Any]]:
        """Return D⁻¹ and L⁻¹ of M = LᵀDL, with no velocity carried.

        L⁻¹_jk is v̇_j where v̇_k is one, what is eliminated before k gives way, and all else stands still.
        """
        inverse: list[Any] = [0.0] * self._kin.model.nv
        factors: dict[tuple[int, int], Any] = {}
        places = [(-1, self._top.first)]
        places += [(i, pivots) for i, level in enumerate(self._levels) for pivots in (level.then, level.first)]
        for index, pivots in places:
            for pivot in pivots:
                k = pivot.velocity
                inverse[k] = pivot.inverse
                factors |= {(j, k): x for j, x in self._released(k, index).items() if not is_zero(x)}
        return inverse, factors

    def _released(self, k: int, start: int) -> dict[int, Any]:
        """Return the accelerations below link `start`, where v̇_k is eliminated, as v̇_k is one and forces are zero."""
        done: dict[int, Any] = {}

        def resolve(pivots: list[Pivot], A: Vector) -> None:
            for pivot in reversed(pivots):
                if pivot.velocity == k:
                    done[k] = 1.0
                elif done:
                    known = sum((x * done.get(i, 0.0) for i, x in pivot.others.items()), 0.0) + dot6(pivot.row, A)
                    done[pivot.velocity] = negative(known * pivot.inverse)

        still = [0.0] * 6
        A: dict[int, Vector] = {}
        if start < 0:
            A[-1] = still
            resolve(self._top.first, still)
        for index, (link, level) in enumerate(zip(self.links, self._levels, strict=True)):
            if index != start and link.parent not in A:
                continue
            x = self.mechanics.carried(index, A.get(link.parent, still), drifts=False)
            resolve(level.then, x)
            for i, column in link.columns:
                x = add(x, [c * done.get(i, 0.0) for c in column])
            resolve(level.first, x)
            A[index] = x
        return done


def _unit(column: Vector) -> int | None:
    """Return the direction of a column that is a unit vector."""
    return column.index(1.0) if [x for x in column if not is_zero(x)] == [1.0] else None
