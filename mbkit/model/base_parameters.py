"""Base inertial parameters: the combinations of masses, first moments and inertias that motion can tell.

T, and V up to a constant, are linear in the ten standard parameters of each body: the inertia about the origin of the
body's frame, the first moment h = m c, and the mass m. They stand in a pseudo-inertia matrix (Wensing, Kim and Slotine
2018, Linear matrix inequalities for physically consistent inertial parameter identification)::

    J = [[Σ, h], [hᵀ, m]],    Σ = ½ tr(I) 1 - I,    T = ½ tr(V J Vᵀ),    V = [ω×, v]

with the body's velocities ω and v in its axes. Two linear maps lead from them to a smallest set:

1. **Regrouping**, from the leaves to the root. Let ξ be the velocities of a joint's child relative to its parent, as V
   above. A J with ξ J = 0 at every pose is matter on points that the joint leaves at rest; it may as well be the
   parent's. Such points are the axis of a turn, the centre of a ball joint, the infinitely far ones of a slide, and
   all points of a fixed joint. So behind a turn the mass, the first moment along the axis and one transverse moment
   move to the parent, behind a slide the whole inertia, behind a ball joint the mass (Gautier and Khalil 1990, Direct
   calculation of minimum set of inertial parameters of serial robots; Mayeda, Yoshida and Osuka 1990, Base parameters
   of manipulator dynamic models).
2. **Rank.** Near the root more combinations are lost, because the first links do not move in all ways. They are the
   null space of T and V at random states (Gautier 1991, Numerical calculation of the base inertial parameters).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np

from mbkit._check import PROBES, TYPED, Array, real, shown
from mbkit._escape import html, terminal
from mbkit.errors import InputError, NumericalError
from mbkit.model import manifold
from mbkit.model.description import Description, frame_of, pose_of
from mbkit.model.elements.paths import Path
from mbkit.model.parts import Body, Joint, Numbers, _Frozen, rules_of
from mbkit.spatial import skew

#: The ten standard parameters of a body, in the order of Khalil and Dombre, and the places of its inertia.
STANDARD: Final = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "hx", "hy", "hz", "m")
PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
#: Sets of parameters in which `Dynamics.regressor` may be linear.
PARAMETER_SETS: Final = ("standard", "base")
#: Power of a length in the energy of each.
POWERS: Final = np.array([0] * 6 + [1] * 3 + [2])
#: Fields of joints in which the torque is linear too: those that lose energy, and those of rotors.
OF_JOINTS: Final = (Joint.adding_to("loss") + Joint.adding_to("jump"), Joint.adding_to("T"))
#: Size, beside the largest, below which a number is taken as not there, where nobody says otherwise.
TOLERANCE: Final = 1e-7
#: Rounding of a coefficient, and of right angles in a file: π is often written with eleven digits.
_COEFFICIENT_ROUNDING: Final = 1e-10
#: How much smaller than the least kept singular value the largest dropped one has to be.
_SINGULAR_VALUE_GAP: Final = 100.0
#: A column whose independent part is this part of the largest one may be eliminated.
_PIVOT_RATIO: Final = 0.1


def _units() -> tuple[Array, Array]:
    """Return J of a unit of each parameter, (10, 4, 4), and the matrices F with parameter = tr(F J)."""
    J, F = np.zeros((2, 10, 4, 4))
    for k, (i, j) in enumerate(PAIRS):
        if i == j:
            J[k, :3, :3], F[k, :3, :3] = 0.5 * np.eye(3), np.eye(3)
            J[k, i, i], F[k, i, i] = -0.5, 0.0
        else:
            J[k, i, j] = J[k, j, i] = -1.0
            F[k, i, j] = F[k, j, i] = -0.5
    for i in range(3):
        J[6 + i, i, 3] = J[6 + i, 3, i] = 1.0
        F[6 + i, i, 3] = F[6 + i, 3, i] = 0.5
    J[9, 3, 3] = F[9, 3, 3] = 1.0
    return J, F


_J, _F = _units()


@dataclass(frozen=True, eq=False)
class BaseParameters(_Frozen):
    """The base inertial parameters of a model: ``values == matrix @ standard``.

    Each is one standard parameter, after which it is named, plus multiples of others that have no name here. Bodies
    stand from the root to the leaves. The standard parameters of a body are, in this order, the inertia Ixx, Ixy, Ixz,
    Iyy, Iyz, Izz about the origin of its frame, in its axes, kg m²; the first moment hx, hy, hz (mass times centre of
    mass), kg m; and the mass m, kg. Ixy is the entry of the inertia matrix, with its sign.

    Attributes
    ----------
    model : str
        The model's name.
    names : tuple of str
        The standard parameter that leads each base parameter, such as ``"link3.Ixx"``.
    standard_names : tuple of str
        Names of the standard parameters of all nb bodies.
    standard : (10 nb,) array
        Their values in the model.
    matrix : (count, 10 nb) array
        Its columns of `names` are an identity matrix.
    """

    model: str
    names: tuple[str, ...]
    standard_names: tuple[str, ...]
    standard: Numbers
    matrix: Numbers

    @property
    def count(self) -> int:
        """Number of base parameters."""
        return len(self.names)

    @property
    def values(self) -> Array:
        """The base parameters of the model, (count,)."""
        return self.matrix @ self.standard

    @property
    def combinations(self) -> tuple[str, ...]:
        """Each base parameter as a sum of standard parameters, such as ``"link3.Ixx - link3.Iyy"``."""
        return tuple(self._combination(name, row) for name, row in zip(self.names, self.matrix, strict=True))

    def _combination(self, name: str, row: Array) -> str:
        out = name
        for k in np.flatnonzero(row):
            if self.standard_names[k] != name:
                size = f"{abs(row[k]):.6g}"
                factor = "" if size == "1" else f"{size} "
                out += f" {'-' if row[k] < 0 else '+'} {factor}{self.standard_names[k]}"
        return out

    @property
    def text(self) -> str:
        """One line for each base parameter, with its value and its combination."""
        lines = [self._title]
        lines += [f"{x:12.6g}  {sum_}" for x, sum_ in zip(self.values, self.combinations, strict=True)]
        return terminal("\n".join(lines))

    @property
    def _title(self) -> str:
        return f"{self.model}: {self.count} base parameters of {self.standard.size} standard ones"

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return terminal(f"<BaseParameters of {self._title}>")

    def _repr_html_(self) -> str:
        rows = zip(self.names, self.values, self.combinations, strict=True)
        cells = "".join(f"<tr><td>{html(n)}</td><td>{x:.6g}</td><td>{html(c)}</td></tr>" for n, x, c in rows)
        head = "<tr><th>name</th><th>value, SI</th><th>combination</th></tr>"
        return f"<p>{html(self._title)}</p><table>{head}{cells}</table>"

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data, which `json.dumps` takes."""
        return {
            "model": self.model,
            "count": self.count,
            "names": list(self.names),
            "values": self.values.tolist(),
            "combinations": list(self.combinations),
            "standard_names": list(self.standard_names),
            "standard": self.standard.tolist(),
            "matrix": self.matrix.tolist(),
        }


def standard_names(model: Description) -> tuple[str, ...]:
    """Return the names of the standard parameters, body by body in the order of the tree."""
    return tuple(f"{joint.child}.{kind}" for joint in model.tree for kind in STANDARD)


@dataclass(frozen=True)
class RegressorColumns:
    """The columns of a regressor: indices of standard parameters, then fields of joints with those of velocities."""

    bodies: tuple[int, ...]
    along: tuple[tuple[str, tuple[int, ...]], ...] = ()

    def names(self, model: Description) -> tuple[str, ...]:
        """Return the names of the columns."""
        standard, velocities = standard_names(model), model.velocity_names
        return (
            *(standard[k] for k in self.bodies),
            *(f"{velocities[k]}.{field}" for field, which in self.along for k in which),
        )

    def of_rates(self, **by_effect: Any) -> Iterator[tuple[Any, list[int]]]:
        """Yield for each field what the effect of its numbers is linear in, (nv,), and the velocities with columns."""
        for field, which in self.along:
            yield by_effect[rules_of(Joint)[field].does], list(which)


@lru_cache(maxsize=64)
def regressor_columns(model: Description, parameters: str, losses: bool, rotors: bool) -> RegressorColumns:
    """Return the columns for a set of parameters; see `Model.regressor_columns`."""
    if parameters not in PARAMETER_SETS:
        raise InputError(f"parameters: expected 'standard' or 'base', got {shown(parameters)}")
    bodies = tuple(range(len(STANDARD) * len(model.tree)))
    if parameters == PARAMETER_SETS[1]:
        index = {name: k for k, name in enumerate(standard_names(model))}
        bodies = tuple(index[name] for name in base_parameters(model, TOLERANCE).names)
    single = tuple(model.layout.v[j.name].start for j in model.independent_joints if j.type.nv == 1)
    asked = (losses, tuple(range(model.nv))), (rotors, single)
    pairs = zip(OF_JOINTS, asked, strict=True)
    return RegressorColumns(bodies, tuple((f, which) for names, (on, which) in pairs if on for f in names))


def standard_parameters(body: Body) -> Array:
    """Return the ten standard parameters of a body."""
    c = skew(body.com)
    about_origin = body.inertia - body.mass * c @ c
    return np.array([*(about_origin[i, j] for i, j in PAIRS), *(body.mass * body.com), body.mass])


def body_of(before: Body, parameters: Array, length: float) -> Body | None:
    """Return a body with these standard parameters; None where it has no mass but a moment or an inertia.

    Of a body without extent, beside the length of its mechanism, what rounding takes from its inertia is put back.
    """
    mass, moment = float(parameters[-1]), parameters[-4:-1]
    if not mass:
        return replace(before, mass=0.0, inertia=np.zeros((3, 3))) if not parameters.any() else None
    about_origin, com = np.empty((3, 3)), moment / mass
    for x, (i, j) in zip(parameters, PAIRS, strict=False):
        about_origin[i, j] = about_origin[j, i] = x
    c = skew(com)
    inertia = about_origin + mass * c @ c
    spread, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    if -TYPED * mass * length**2 < spread[0] < 0:
        spread = np.maximum(spread, 0.0)
        inertia = np.sum(spread) * np.eye(3) - (axes * spread) @ axes.T
    return replace(before, mass=mass, com=com, inertia=inertia)


def energy_regressor(model: Description, q: Array, v: Array, gravity: Array) -> tuple[Array, Array]:
    """Return the matrices Y with T = Y p and V = Y p, for the standard parameters p in the order of the tree.

    Parameters
    ----------
    model : Description
    q, v : (N, nq) and (N, nv) arrays
    gravity : (3,) array
        m/s², in world axes.

    Returns
    -------
    kinetic, potential : (N, 10 nb) arrays
        V is zero at the world's origin.
    """
    layout, n = model.layout, len(q)
    q_full, v_full = layout.expand_q(q), layout.expand_v(v)
    poses = {"world": np.broadcast_to(np.eye(4), (n, 4, 4))}
    rates = {"world": np.zeros((n, 4, 4))}
    kinetic, potential = [np.zeros((n, 0))], [np.zeros((n, 0))]
    for joint in model.tree:
        at, moving = list(q_full[:, layout.full_q[joint.name]].T), list(v_full[:, layout.full_v[joint.name]].T)
        step = frame_of(joint) @ pose_of(joint, at, n)
        turned = step[:, :3, :3].transpose(0, 2, 1)
        back = np.zeros((n, 4, 4))
        back[:, :3, :3], back[:, :3, 3:], back[:, 3, 3] = turned, -turned @ step[:, :3, 3:], 1.0
        pose, rate = poses[joint.parent] @ step, back @ rates[joint.parent] @ step + _rate(joint, at, moving, n)
        poses[joint.child], rates[joint.child] = pose, rate
        kinetic.append(0.5 * np.einsum("kij,nij->nk", _J, rate.transpose(0, 2, 1) @ rate))
        potential.append(-np.einsum("i,nij,kj->nk", gravity, pose[:, :3], _J[:, :, 3]))
    return np.hstack(kinetic), np.hstack(potential)


#: Forces are known, and do not count.
BASE_PARAMETERS: Final = Path(
    "base parameters",
    "base parameters: expected a tree of free joints, got of",
    frozenset(["q", "T", "V", "loss", "jump", "stop", "force", "bound", "t"]),
)


def base_parameters(model: Description, tolerance: float) -> BaseParameters:
    """Return the base parameters of a model with bodies; see `Model.base_parameters`."""
    tolerance = real("tolerance", tolerance, positive=True)
    if tolerance >= 1:
        raise InputError(f"tolerance: expected a number below 1, got {tolerance:g}")
    BASE_PARAMETERS.admit(model)
    model.require_values("base parameters")
    bodies = [model.body(joint.child) for joint in model.tree]
    names = standard_names(model)
    standard = np.concatenate([np.zeros(0), *map(standard_parameters, bodies)])
    length = length_of(model)
    matrix, kept = _regrouped(model, length, tolerance)
    if kept:
        matrix, kept = _reduced(model, length, tolerance, matrix, kept)
    scale = np.tile(length**POWERS, len(bodies))
    matrix[np.abs(matrix) * scale[kept, None] < _COEFFICIENT_ROUNDING * scale] = 0.0
    return BaseParameters(model.name, tuple(names[k] for k in kept), names, standard, matrix)


def length_of(model: Description) -> float:
    """Return a length of the mechanism, in which its numbers are comparable."""
    offsets = [float(np.linalg.norm(j.translation)) for j in model.joints if j.parent != "world"]
    return max([*offsets, *(abs(j.pitch) for j in model.joints)], default=0.0) or 1.0


def _regrouped(model: Description, length: float, tolerance: float) -> tuple[Array, list[int]]:
    """Return the parameters that regrouping leaves, as rows of standard ones, and which standard one leads each.

    From the leaves to the root; what reaches the world is gone.
    """
    index = {joint.child: k for k, joint in enumerate(model.tree)}
    left = np.eye(10 * len(index)).reshape(len(index), 10, -1)
    kept: list[int] = []
    for joint in reversed(model.tree):
        k = index[joint.child]
        points, place = _points_at_rest(joint, length, tolerance)
        pairs = [np.outer(a, b) + np.outer(b, a) for i, a in enumerate(points) for b in points[i:]]
        movable = parameters_of(np.array(pairs).reshape(-1, 4, 4))
        gone, unit = eliminated(movable)
        moved = left[k, gone]
        left[k] -= unit.T @ moved
        kept += [10 * k + i for i in range(10) if i not in gone]
        if joint.parent != "world":
            J = np.einsum("ki,iab->kab", unit, _J)
            left[index[joint.parent]] += parameters_of(place @ J @ place.T).T @ moved
    kept.sort()
    return left.reshape(10 * len(index), -1)[kept], kept


def _points_at_rest(joint: Joint, length: float, tolerance: float) -> tuple[Array, Array]:
    """Return the points of the child that a joint leaves at rest, (k, 4), and the child's pose in the parent.

    Points are homogeneous: (x, 1) at x, and (x, 0) infinitely far in the direction x.
    """
    kind, rng = joint.type, np.random.default_rng(0)
    q = np.zeros((PROBES, kind.nq))
    if kind.quaternion is not None:
        q[:, kind.quaternion + 3] = 1.0
    place = frame_of(joint) @ pose_of(joint, list(q[:1].T), 1)[0]
    at = list(kind.integrate(q, rng.standard_normal((PROBES, kind.nv))).T)
    units = np.diag([length if k in kind.lengths else 1.0 for k in range(kind.nv)])
    motions = np.concatenate([np.zeros((1, 4)), *(_rate(joint, at, list(v), PROBES).reshape(-1, 4) for v in units)])
    motions[:, 3] /= length
    _, sizes, axes = np.linalg.svd(motions)
    moving = int(np.sum(sizes > tolerance * sizes[0]))
    return axes[moving:] * [length, length, length, 1.0], place


def _reduced(
    model: Description, length: float, tolerance: float, matrix: Array, kept: list[int]
) -> tuple[Array, list[int]]:
    """Return the rows that are left when combinations of no energy are taken off, and what leads each."""
    rng = np.random.default_rng(0)
    size = 2 * len(kept) + 10
    rates = np.ones(model.nv)
    for joint in model.independent_joints:
        rates[[model.layout.v[joint.name].start + k for k in joint.type.lengths]] = length
    moves = rates * rng.uniform(-np.pi, np.pi, (size, model.nv))
    q = manifold.integrate(model, np.tile(manifold.neutral(model), (size, 1)), moves)
    v = rates * rng.standard_normal((size, model.nv))
    # Gravity of one length a second squared makes V as large as T.
    weight = float(np.linalg.norm(model.gravity)) / length or 1.0
    kinetic, potential = energy_regressor(model, q, v, model.gravity / weight)
    Y = np.concatenate([kinetic, potential - potential.mean(axis=0)])[:, kept] / np.sqrt(size)
    scale = (length ** np.tile(POWERS, len(model.tree)))[kept]
    columns = np.linalg.norm(Y / scale, axis=0)
    # A column of nothing but rounding stays as small as it is.
    scale = scale * np.where(columns > tolerance, columns, 1.0)
    _, sizes, axes = np.linalg.svd(np.linalg.qr(Y / scale, mode="r"))
    count = int(np.sum(sizes > tolerance * sizes[0]))
    if 0 < count < len(sizes) and sizes[count] * _SINGULAR_VALUE_GAP > sizes[count - 1]:
        raise NumericalError(
            f"base parameters: {model.name}: no clear gap between what motion can tell and what it cannot: "
            f"expected singular values far from the tolerance, got {sizes[count - 1] / sizes[0]:.1e} above and "
            f"{sizes[count] / sizes[0]:.1e} below {tolerance:g}; choose another tolerance, "
            "or look for axes that are almost parallel"
        )
    gone, unit = eliminated(axes[count:])
    matrix = matrix - (unit * scale[gone, None] / scale).T @ matrix[gone]
    stays = [k for k in range(len(kept)) if k not in gone]
    return matrix[stays], [kept[k] for k in stays]


def eliminated(null: Array) -> tuple[list[int], Array]:
    """Return as many columns as a null space (k, n) has rows, and its basis with an identity matrix there.

    The columns are as far behind as they can be where their independent part is not much smaller than others'.
    """
    gone: list[int] = []
    left = np.linalg.qr(null.T)[0].T
    for _ in null:
        sizes = np.linalg.norm(left, axis=0)
        k = int(np.flatnonzero(sizes >= _PIVOT_RATIO * sizes.max())[-1])
        gone.append(k)
        across = left[:, k] / sizes[k]
        left = left - np.outer(across, across @ left)
    gone.sort()
    return gone, np.asarray(np.linalg.solve(null[:, gone], null), dtype=np.float64)


# Poses and velocities as 4 x 4 matrices.


def pseudo_inertia(parameters: Array) -> Array:
    """Return J, (..., 4, 4), of ten standard parameters."""
    return np.asarray(np.einsum("...k,kij->...ij", parameters, _J))


def parameters_of(J: Array) -> Array:
    """Return the ten parameters, (..., 10), of pseudo-inertias."""
    return np.asarray(np.einsum("kij,...ij->...k", _F, J))


def _rate(joint: Joint, q: list[Array], v: list[Any], n: int) -> Array:
    """Return the child's velocity relative to the joint's frame, in the child's axes, (n, 4, 4)."""
    (vx, vy, vz), (wx, wy, wz) = joint.type.twist(np, joint, q, v)
    out = np.zeros((n, 4, 4))
    for i, row in enumerate(((0.0, -wz, wy, vx), (wz, 0.0, -wx, vy), (-wy, wx, 0.0, vz))):
        for j, x in enumerate(row):
            out[:, i, j] = x
    return out
