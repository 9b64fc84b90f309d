"""The checks of `lint`: one function each, and one row of `CHECKS`, which its decorator makes.

A check yields findings. How sure one is follows from how many times its number is beyond what is allowed: from
`LIKELY_FROM` and `SURE_FROM` times on it is likely and sure. Limits are of matter and geometry where there are any.

What a link's shapes say of its matter: their hull, their volume, and the inertia of the hull.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from typing import Final

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from mbkit._check import TYPED, Array, by_key
from mbkit.engines import Dynamics
from mbkit.load.shapes import MassProperties
from mbkit.model import Body, Model
from mbkit.model.validation import body_fault, listing
from mbkit.show.meshes import Indices
from mbkit.show.visuals import Shape
from mbkit.spatial import skew
from mbkit.studies.compare.beyond_terms import stiff_joints
from mbkit.studies.compare.terms import Finding
from mbkit.studies.lint.result import LIKELY, LOOK, SURE, LintFinding


@dataclass(frozen=True, eq=False)
class Geometry:
    """All shapes of a link, visual and collision, in the link's axes.

    `hull` is their convex hull with density 1 kg/m³; `vertices` (n, 3) are its corners, and `planes` (m, 4) its faces:
    n x + d is the distance outside. `least` is the smallest volume that one kind of the shapes takes, m³: enclosed
    where its surfaces are closed, else that of its hull.
    """

    hull: MassProperties
    vertices: Array
    planes: Array
    least: float

    @property
    def size(self) -> float:
        """The diagonal of the box around it, m."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    def outside(self, point: Array) -> float:
        """Return how far a point is outside of the hull, m, at least; zero inside."""
        return max(0.0, float((self.planes[:, :3] @ point + self.planes[:, 3]).max()))

    def farthest(self, point: Array) -> float:
        """Return the distance of the corner that is farthest from a point, m."""
        return float(np.linalg.norm(self.vertices - point, axis=1).max())


def geometry_of(kinds: Iterable[list[Shape]]) -> Geometry | None:
    """Return the geometry of shapes, kind by kind; None where they span no volume."""
    parts = [[_placed(shape) for shape in shapes] for shapes in kinds if shapes]
    if not parts or (whole := _hull(np.concatenate([V for part in parts for V, _ in part]))) is None:
        return None
    volumes = []
    for part in parts:
        hull = _hull(np.concatenate([V for V, _ in part]))
        closed = all(_closed(V, T) for V, T in part)
        enclosed = sum(abs(solid_of(V, T).mass) for V, T in part) if closed else np.inf
        volumes += [min(enclosed, float(hull.volume))] if hull is not None else []
    least = min(volumes, default=float(whole.volume))
    return Geometry(_outward(whole), whole.points[whole.vertices], whole.equations, least)


def _placed(shape: Shape) -> tuple[Array, Indices]:
    """Return the surface of a shape in the link's axes."""
    firsts = np.cumsum([0, *(len(s.vertices) for s in shape.surfaces)])
    T = np.concatenate([s.triangles + k for s, k in zip(shape.surfaces, firsts, strict=False)])
    V = np.concatenate([s.vertices for s in shape.surfaces])
    return V @ shape.rotation.T + shape.translation, T


def _hull(V: Array) -> ConvexHull | None:
    extent = float(np.ptp(V, axis=0).max())
    try:
        hull = ConvexHull(V)
    except (QhullError, ValueError):
        return None
    return hull if hull.volume > TYPED * extent**3 else None


def _outward(hull: ConvexHull) -> MassProperties:
    """Return the mass properties of a hull, whose triangles Qhull does not turn outwards."""
    T = hull.simplices.astype(np.int64)
    a, b, c = (hull.points[T[:, k]] for k in range(3))
    inward = np.einsum("ni,ni->n", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    T[inward] = T[inward][:, ::-1]
    return solid_of(hull.points, T)


def solid_of(V: Array, T: Indices) -> MassProperties:
    """Return the mass properties at 1 kg/m³ of what closed triangles enclose.

    A sum over the tetrahedra to one point, by sign (Blow and Binstock 2004, How to find the inertia tensor of a 3D
    solid body).
    """
    o = V[T[:, 0]].mean(axis=0)
    corners = [V[T[:, k]] - o for k in range(3)]
    volumes = np.einsum("ni,ni->n", corners[0], np.cross(corners[1], corners[2])) / 6
    total, mass = sum(corners, np.zeros(3)), float(volumes.sum())
    if not mass:
        return MassProperties(0.0, o, np.zeros((3, 3)))
    com = np.asarray(volumes @ total) / (4 * mass)
    second = sum(np.einsum("n,ni,nj->ij", volumes, x, x) for x in (*corners, total)) / 20 - mass * np.outer(com, com)
    return MassProperties(mass, o + com, np.trace(second) * np.eye(3) - second)


def _closed(V: Array, T: Indices) -> bool:
    """Return whether every edge has two triangles, which run along it in opposite directions."""
    # Files repeat a vertex for each of its triangles.
    _, same = np.unique(V, axis=0, return_inverse=True)
    T = same.reshape(-1)[T]
    edges = np.concatenate([T[:, [0, 1]], T[:, [1, 2]], T[:, [2, 0]]])
    there, back = (edges @ order for order in ([len(V), 1], [1, len(V)]))
    return bool(np.array_equal(np.sort(there), np.sort(back)))


#: Times beyond a limit from which a finding is likely, and sure.
LIKELY_FROM: Final = 3.0
SURE_FROM: Final = 30.0
#: Least and greatest density, kg/m³: a light foam, and lead.
FOAM_DENSITY: Final = 10.0
LEAD_DENSITY: Final = 11_340.0
#: A centre of mass may be outside of the shapes by this part of their size: motors are drawn with the next link.
COM_OUTSIDE_RATIO: Final = 0.1
#: A radius of gyration may be longer than the farthest corner by this factor: shapes are drawn coarsely.
LONGEST_GYRATION_RATIO: Final = 1.2
#: Its square may be less than that of the hull by this factor.
SHORTEST_GYRATION_RATIO: Final = 30.0
#: Inertias are compared with that of the hull where the centres of mass are nearer than this part of its size.
CENTRED_RATIO: Final = 0.15
#: Inertias over their traces differ by less where they are alike, and by more where they are not.
ALIKE_DISTANCE: Final = 0.1
UNLIKE_DISTANCE: Final = 0.25
#: A shell has up to about twice the inertia of a solid body; and this part of its trace is near.
SOLID_INERTIA_RATIO: Final = 2.0
FITTING_DISTANCE: Final = 0.5
#: Lengths of axes that were typed with two digits are off by less.
AXIS_LENGTH_ERROR: Final = 0.01
#: The products' other sign brings an inertia nearer by more than this.
BETTER_DISTANCE_RATIO: Final = 2.5
#: Masses, and distances between joints, of neighbours: a wrong unit makes 1e3 of a ratio that may be a third.
NEIGHBOUR_MASS_RATIO: Final = 300.0
NEIGHBOUR_DISTANCE_RATIO: Final = 100.0
#: Links with one inertia, and the ratio of moments from which their shapes differ.
MIN_COPIES: Final = 3
OTHER_SHAPE_RATIO: Final = 1.5
#: Relative difference of masses and inertias of mirrored links, and of centres of mass by the radius of gyration.
MIRRORED_ERROR: Final = 0.1
#: Coordinates beyond this say that there is no limit.
LEAST_MISSING_LIMIT: Final = 1e3
#: Longest way of a hinge: two turns; joints beyond one are built.
MAX_TURN_RAD: Final = 4 * np.pi
#: Degrees that were computed from radians are whole numbers to this.
WHOLE_DEGREE_ERROR: Final = 1e-3
#: Number of random poses.
N_POSES: Final = 256

_REFLECTIONS: Final = [np.array(signs) for signs in product((1.0, -1.0), repeat=3)]
_UPPER: Final = np.triu_indices(3)


@dataclass(frozen=True)
class Judged:
    """A model, its links as the file has them, their shapes, and an engine, where one takes the model."""

    model: Model
    links: Model
    shapes: Mapping[str, Geometry]
    control_period: float
    engine: Dynamics | None
    #: Lengths of the axes in a URDF, by joint.
    axes: Mapping[str, float]

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """The links with mass."""
        return tuple(body for body in self.links.bodies if body.mass > 0 and body.name not in self.links.rotors)

    def shaped(self) -> Iterator[tuple[Body, Geometry]]:
        """Yield the links with mass and shapes."""
        yield from ((body, self.shapes[body.name]) for body in self.bodies if body.name in self.shapes)

    @cached_property
    def reach(self) -> float:
        """The sum of the distances between joints, m."""
        return float(sum(np.linalg.norm(joint.translation) for joint in self.links.joints))

    @cached_property
    def poses(self) -> Array:
        """Random configurations, the same for the same model."""
        return self.model.random_state(0, N_POSES)[0]


Check = Callable[[Judged], Iterator[LintFinding]]

#: All checks by name; the first line of a check's docstring says what it looks at.
CHECKS: Final[dict[str, Check]] = {}


def check(run: Check) -> Check:
    """Register a check under the name of its function."""
    CHECKS[run.__name__.replace("_", " ")] = run
    return run


def _confidence(times: float) -> str:
    return SURE if times >= SURE_FROM else LIKELY if times >= LIKELY_FROM else LOOK


# Links and their shapes


@check
def density(at: Judged) -> Iterator[LintFinding]:
    """Judge the mass over the volume of the link's shapes."""
    expected = f"{FOAM_DENSITY:g} to {LEAD_DENSITY:g} kg/m³, from foam to lead"
    for body, shape in at.shaped():
        # The hull is the most that shapes can hold.
        heavy, light = body.mass / shape.hull.mass, body.mass / shape.least
        if (times := max(heavy / LEAD_DENSITY, FOAM_DENSITY / light)) > 1:
            rho, volume = (heavy, shape.hull.mass) if heavy > LEAD_DENSITY else (light, shape.least)
            says = f"{body.mass:.3g} kg in the {1e3 * volume:.3g} l of its shapes are {rho:.3g} kg/m³"
            yield LintFinding(body.name, "density", rho, expected, _confidence(times), says)


@check
def centre_of_mass(at: Judged) -> Iterator[LintFinding]:
    """Judge the distance of the centre of mass from the hull of the link's shapes, or from the joint."""
    for body in at.bodies:
        shape = at.shapes.get(body.name)
        off = float(np.linalg.norm(body.com)) if shape is None else shape.outside(body.com)
        allowed = at.reach if shape is None else COM_OUTSIDE_RATIO * shape.size
        if allowed and off > allowed:
            what = "its joint; all joints together reach" if shape is None else "the hull of its shapes, which measures"
            says = f"centre of mass {off:.3g} m from {what} {at.reach if shape is None else shape.size:.3g} m"
            expected = f"up to {allowed:.3g} m"
            yield LintFinding(body.name, "centre of mass", off, expected, _confidence(off / allowed), says)


@check
def radius_of_gyration(at: Judged) -> Iterator[LintFinding]:
    """Judge the radius of gyration against the size of the link."""
    for body in at.bodies:
        if _placeholder(body):
            continue
        shape = at.shapes.get(body.name)
        least, most = _radii(body, shape) if shape else (0.0, at.reach)
        value, times = _radius(body, least, most)
        if most and times > 1:
            expected = f"{least:.3g} to {most:.3g} m, by {'its shapes' if shape else 'the reach of all joints'}"
            says = f"inertia over mass gives a radius of gyration of {value:.3g} m"
            yield LintFinding(body.name, "radius of gyration", value, expected, _confidence(times**2), says)


def _radii(body: Body, shape: Geometry) -> tuple[float, float]:
    """Return the least and the greatest radius of gyration of a link, m; no point is beyond the farthest corner."""
    mean = np.sqrt(np.trace(shape.hull.inertia) / shape.hull.mass / 2 / SHORTEST_GYRATION_RATIO)
    return float(mean), LONGEST_GYRATION_RATIO * shape.farthest(body.com)


def _radius(body: Body, least: float, most: float) -> tuple[float, float]:
    """Return the radius of gyration that is out of bounds, or a mean one, and by how many times it is out of them."""
    moments = np.linalg.eigvalsh(body.inertia)
    widest = float(np.sqrt(max(moments[-1], 0.0) / body.mass))
    mean = float(np.sqrt(max(moments.sum(), 0.0) / body.mass / 2))
    if not mean or not most:
        return mean, 1.0
    return max((widest, widest / most), (mean, least / mean), key=lambda x: x[1])


def _comparable(at: Judged) -> Iterator[tuple[Body, Array, Array]]:
    """Yield links with their inertia and that of their hull, each over its trace, where mass is spread as the hull."""
    for body, shape in at.shaped():
        fits = _radius(body, *_radii(body, shape))[1] <= 1 and not _placeholder(body)
        if fits and np.linalg.norm(body.com - shape.hull.com) < CENTRED_RATIO * shape.size:
            yield body, body.inertia / np.trace(body.inertia), shape.hull.inertia / np.trace(shape.hull.inertia)


@check
def sign_of_products(at: Judged) -> Iterator[LintFinding]:
    """Judge the signs of the products of inertia against the link's shapes."""
    for body, own, hull in _comparable(at):
        apart, other = _distances(own, hull)
        if _sign_is_wrong(apart, other):
            says = (
                f"its inertia is off that of its shapes by {apart:.2g} of its trace, with products negated {other:.2g}"
            )
            yield LintFinding(body.name, "sign of products", apart, f"below {ALIKE_DISTANCE:g}", LIKELY, says)


def _distances(own: Array, hull: Array) -> tuple[float, float]:
    """Return how far an inertia is from another one, as it is and with its products negated."""
    negated = 2 * np.diag(np.diag(own)) - own
    return float(np.linalg.norm(own - hull)), float(np.linalg.norm(negated - hull))


def _sign_is_wrong(apart: float, other: float) -> bool:
    return apart > ALIKE_DISTANCE and other * BETTER_DISTANCE_RATIO < apart


@check
def axes(at: Judged) -> Iterator[LintFinding]:
    """Judge the axes of the inertia against those of the link's shapes."""
    for body, own, hull in _comparable(at):
        apart, other = _distances(own, hull)
        # The distance in the best axes is that of the principal moments (Hoffman and Wielandt 1953).
        best = float(np.linalg.norm(np.linalg.eigvalsh(own) - np.linalg.eigvalsh(hull)))
        if apart > UNLIKE_DISTANCE and best < ALIKE_DISTANCE and not _sign_is_wrong(apart, other):
            says = f"its inertia is off that of its shapes by {apart:.2g} of its trace, in other axes {best:.2g}"
            yield LintFinding(body.name, "axes", apart, f"below {UNLIKE_DISTANCE:g}", LIKELY, says)


def _solids(at: Judged) -> Iterator[tuple[Body, Array, Array, Array]]:
    """Yield links and three inertias over the trace of the last.

    These are the link's, the same if it was written about the link's origin, and that of a solid body of its hull.
    """
    for body, shape in at.shaped():
        if np.trace(body.inertia) > 0 and not _placeholder(body):
            solid = shape.hull.inertia * (body.mass / shape.hull.mass)
            moved = body.inertia + body.mass * skew(body.com) @ skew(body.com)
            yield body, *(x / np.trace(solid) for x in (body.inertia, moved, solid))


@check
def inertia_about_origin(at: Judged) -> Iterator[LintFinding]:
    """Find inertias that fit a solid body only if they are about the link's origin, and not about its centre."""
    for body, own, moved, solid in _solids(at):
        ratio, apart, other = np.trace(own), np.linalg.norm(own - solid), np.linalg.norm(moved - solid)
        if ratio > SOLID_INERTIA_RATIO and other < FITTING_DISTANCE and other * BETTER_DISTANCE_RATIO < apart:
            says = f"its inertia is {ratio:.2g} times that of its shapes, and {np.trace(moved):.2g} if about its origin"
            expected = "about the centre of mass"
            yield LintFinding(body.name, "inertia about origin", float(ratio), expected, LIKELY, says)


@check
def solid_body(at: Judged) -> Iterator[LintFinding]:
    """Judge inertias against those of solid bodies of the same shapes and mass."""
    ratios = {body.name: float(np.trace(own)) for body, own, _, _ in _solids(at)}
    if off := {k: x for k, x in ratios.items() if max(x, 1 / x) > SOLID_INERTIA_RATIO}:
        first, *others = sorted(off, key=lambda k: -abs(np.log(off[k])))
        shown = listing([f"{k} {off[k]:.2g}" for k in (first, *others)])
        says, expected = (
            f"inertia over a solid body's: {shown}",
            f"{1 / SOLID_INERTIA_RATIO:g} to {SOLID_INERTIA_RATIO:g} for what is not hollow",
        )
        yield LintFinding(first, "solid body", off[first], expected, LOOK, says, tuple(others))


# Links alone


@check
def matter(at: Judged) -> Iterator[LintFinding]:
    """Find masses and principal moments that no matter has."""
    for body in at.links.bodies:
        if why := body_fault(body, point_masses=True):
            moments = np.linalg.eigvalsh(body.inertia)
            excess = float(moments[2] - moments[0] - moments[1])
            yield LintFinding(body.name, "matter", excess, "A + B >= C, and mass", SURE, why)


@check
def placeholder(at: Judged) -> Iterator[LintFinding]:
    """Find numbers that stand for unknown ones: no inertia, or a power of ten about all axes."""
    for body in at.bodies:
        moment = float(body.inertia[0, 0])
        # A point mass that somebody builds is meant.
        if _placeholder(body) and (moment or at.links.sources):
            says = f"inertia {moment:g} kg m² about every axis" if moment else "no inertia"
            confidence = SURE if moment and _power_of_ten(body.mass) else LIKELY
            says += f", with {body.mass:g} kg"
            yield LintFinding(body.name, "placeholder", moment, "the link's own inertia", confidence, says)


def _placeholder(body: Body) -> bool:
    moment = float(body.inertia[0, 0])
    same = np.allclose(body.inertia, moment * np.eye(3), rtol=0, atol=1e-9 * abs(moment))
    return bool(same and (not moment or _power_of_ten(moment)))


def _power_of_ten(x: float) -> bool:
    return f"{x:.6e}".startswith("1.000000e")


@check
def copied_inertia(at: Judged) -> Iterator[LintFinding]:
    """Find one inertia on several links of different shape or mass."""
    bodies = (body for body in at.bodies if not _placeholder(body))
    for group in by_key((tuple(f"{x + 0.0:.9g}" for x in b.inertia[_UPPER]), b) for b in bodies).values():
        if len(group) >= MIN_COPIES and any(_differ(a, b, at) for a, b in combinations(group, 2)):
            names = [body.name for body in group]
            says = f"the same inertia on {len(group)} links of different shape or mass: {listing(names)}"
            expected = "an inertia for each shape"
            yield LintFinding(names[0], "copied inertia", len(group), expected, LIKELY, says, tuple(names[1:]))


def _differ(a: Body, b: Body, at: Judged) -> bool:
    if not np.isclose(a.mass, b.mass, rtol=MIRRORED_ERROR):
        return True
    if a.name not in at.shapes or b.name not in at.shapes:
        return False
    one, other = (np.linalg.eigvalsh(at.shapes[x.name].hull.inertia / at.shapes[x.name].hull.mass) for x in (a, b))
    return bool(np.maximum(one / other, other / one).max() > OTHER_SHAPE_RATIO)


# Links and their neighbours


@check
def neighbours(at: Judged) -> Iterator[LintFinding]:
    """Judge the masses of links without shapes, and distances between joints, against their neighbours."""
    masses, near = {b.name: b.mass for b in at.bodies}, defaultdict(set)
    usual = float(np.median([*masses.values()])) if masses else 0.0
    for joint in at.links.joints:
        if joint.parent in masses and joint.child in masses:
            near[joint.child].add(masses[joint.parent])
            near[joint.parent].add(masses[joint.child])
    for name, others in near.items():
        mass, some = masses[name], [*others, usual]
        ratio = max(min(some) / mass, mass / max(some))
        if ratio > NEIGHBOUR_MASS_RATIO and name not in at.shapes:
            says = f"{mass:.3g} kg beside {min(others):.3g} kg, and {usual:.3g} kg as the median link"
            yield LintFinding(
                name,
                "neighbours",
                ratio,
                f"ratios up to {NEIGHBOUR_MASS_RATIO:g}",
                _confidence(ratio / NEIGHBOUR_MASS_RATIO),
                says,
            )
    lengths = {j.name: float(np.linalg.norm(j.translation)) for j in at.links.joints}
    usual = float(np.median([x for x in lengths.values() if x > 0] or [0]))
    for name, length in lengths.items():
        if usual and length > NEIGHBOUR_DISTANCE_RATIO * usual:
            says = f"its joint stands {length:.3g} m away, the median one {usual:.3g} m"
            times = length / usual / NEIGHBOUR_DISTANCE_RATIO
            yield LintFinding(
                name, "neighbours", length, f"up to {NEIGHBOUR_DISTANCE_RATIO * usual:.3g} m", _confidence(times), says
            )


_LEFT: Final = re.compile(
    r"(?i:left|(?<![a-z])([frhb]?l|l[frhb])(?![a-z]))|(?<![A-Za-z])L(?=[A-Z])|(?<=[a-z])L(?![a-z])"
)


def other_side(name: str, known: Container[str]) -> str:
    """Return the name of the right link for that of a left one, if it is known: of all sides in it, or of one."""
    sides = {"left": "right", "Left": "Right", "LEFT": "RIGHT"}
    found = [*_LEFT.finditer(name)]
    for these in (found, *([one] for one in found)):
        out = name
        for m in reversed(these):
            out = out[: m.start()] + (sides.get(m[0]) or m[0].replace("l", "r").replace("L", "R")) + out[m.end() :]
        if out != name and out in known:
            return out
    return ""


@check
def mirror(at: Judged) -> Iterator[LintFinding]:
    """Find left and right links that mirror each other but for one number, or all but one pair."""
    right = {body.name: body for body in at.bodies}
    pairs = [(a, right[name]) for a in at.bodies if (name := other_side(a.name, right))]
    wrong = [(a, b, _unlike(a, b)) for a, b in pairs]
    odd = [x for x in wrong if x[2]]
    # Where nearly every pair mirrors, one that does not at all counts too.
    rule = len(wrong) - len(odd) >= max(3, 3 * len(odd))
    for a, b, names in odd:
        if len(names) <= 2 or rule:
            says = f"mirrors {a.name} but for {', '.join(names)}"
            expected = f"a mirror image, to {MIRRORED_ERROR:.0%}"
            confidence = LIKELY if rule else LOOK
            yield LintFinding(b.name, "mirror", len(names), expected, confidence, says, (a.name,))


def _unlike(a: Body, b: Body) -> list[str]:
    """Return the names of the numbers by which two links are no mirror images, by the best reflection of axes."""
    trace = max(float(np.trace(x.inertia)) for x in (a, b))
    radius = np.sqrt(trace / max(a.mass, b.mass))
    names = ["mass", *(f"{x} of the centre of mass" for x in "xyz"), "ixx", "ixy", "ixz", "iyy", "iyz", "izz"]
    best = None
    for s in _REFLECTIONS:
        com, inertia = s * a.com - b.com, (np.outer(s, s) * a.inertia - b.inertia)[_UPPER]
        off = [abs(a.mass / b.mass - 1), *(np.abs(com) / (2 * radius or 1.0)), *(np.abs(inertia) / (trace or 1.0))]
        these = [name for name, x in zip(names, off, strict=True) if x > MIRRORED_ERROR]
        best = these if best is None or len(these) < len(best) else best
    return best or []


# Joints


@check
def limits_in_degrees(at: Judged) -> Iterator[LintFinding]:
    """Find limits of angles beyond two turns, which may be degrees."""
    for joint in at.model.joints:
        for k in joint.type.angular:
            ends = [float(x) for x in (joint.lower[k], joint.upper[k]) if abs(x) < LEAST_MISSING_LIMIT]
            value = max(map(abs, ends), default=0.0)
            if value > MAX_TURN_RAD:
                whole = all(abs(x - round(x)) < WHOLE_DEGREE_ERROR for x in ends)
                says = f"limits {', '.join(f'{x:g}' for x in ends)} rad" + (
                    ", whole numbers as of degrees" if whole else ""
                )
                confidence = _confidence(value / MAX_TURN_RAD)
                yield LintFinding(joint.name, "limits in degrees", value, "up to two turns", confidence, says)


@check
def unit_axes(at: Judged) -> Iterator[LintFinding]:
    """Find axes that are not of unit length, which parsers take as directions."""
    for name, length in at.axes.items():
        if abs(length - 1) > AXIS_LENGTH_ERROR:
            says = f"axis of length {length:.3g}"
            yield LintFinding(name, "unit axes", length, "length 1", LOOK, says)


@check
def empty_limits(at: Judged) -> Iterator[LintFinding]:
    """Find limits of no width, and actuators of no force or speed."""
    for joint in at.model.joints:
        if any(joint.lower[k] == joint.upper[k] for k in range(len(joint.lower))):
            says = f"lower and upper limit are both {joint.lower[0]:g}"
            yield LintFinding(joint.name, "empty limits", 0.0, "lower < upper", LIKELY, says)
        zero = [x for x in ("effort", "velocity") if (getattr(joint, f"{x}_limit") == 0).any()]
        # A joint that follows has no actuator.
        if zero and joint.mimic is None:
            says = f"its limit of {' and '.join(zero)} is 0"
            yield LintFinding(joint.name, "empty limits", 0.0, "above 0", LOOK, says)


@check
def effort(at: Judged) -> Iterator[LintFinding]:
    """Judge the limits of effort by the forces that hold the robot against gravity at random poses."""
    if at.engine is None or any(j.type.floating for j in at.model.joints):
        return
    rest = np.zeros((len(at.poses), at.model.nv))
    needed = np.abs(at.engine.inverse_dynamics(at.poses, rest, rest)).max(axis=0)
    for joint, force, limit in zip(at.model.velocity_joints, needed, at.model.effort_limits, strict=True):
        if force > limit > 0:
            says = f"holding it against gravity takes {force:.3g}, and its effort is limited to {limit:.3g}"
            expected = f"an effort of {force:.3g} N or Nm"
            yield LintFinding(joint, "effort", float(limit), expected, _confidence(float(force / limit)), says)


@check
def damping(at: Judged) -> Iterator[LintFinding]:
    """Judge the damping over inertia against the period of control."""
    if at.engine is None:
        return
    first: dict[tuple[str, ...], Finding] = {}
    for found in stiff_joints(at.model.without("springs"), at.engine.mass_matrix(at.poses), step=at.control_period):
        # The fastest comes first, of a joint with several velocities too.
        first.setdefault(found.joints, found)
    for found in first.values():
        expected, times = f"a time constant above {1e3 * at.control_period:g} ms", at.control_period / found.size
        says = found.says.partition(": ")[2].partition(";")[0]
        yield LintFinding(found.joints[0], "damping", found.size, expected, _confidence(times), says)
