"""Plausible files have no findings, one mistake has its own, and each limit is where it says."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.errors import InputError, LoadError, UnknownNameError, UnsupportedError
from mbkit.load.shapes import solid as matter_of
from mbkit.show.meshes import solid
from mbkit.show.visuals import Shape
from mbkit.spatial import matrix_from_rpy
from mbkit.studies.lint import CHECKS, LintResult, checks
from mbkit.studies.lint.checks import geometry_of, solid_of
from mbkit.testing import assert_plausible


@dataclass(frozen=True)
class Link:
    """A link of a URDF: a solid of uniform density, by default a box, placed in the link, and its joint."""

    name: str
    parent: str = "base"
    size: tuple[float, ...] = (0.1, 0.06, 0.4)
    kind: str = "box"
    density: float = 1500.0
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.2)
    joint: str = "continuous"
    origin: tuple[float, float, float] = (0.0, 0.0, 0.4)
    inside: str = ""
    #: What the file says instead.
    mass: float | None = None
    com: tuple[float, ...] | None = None
    inertia: np.ndarray | None = None
    shapes: str | None = None

    @property
    def truth(self) -> tuple[float, np.ndarray]:
        """Mass and inertia about the centre of mass in the link's axes."""
        half = self.size if self.kind == "sphere" else tuple(x / 2 for x in self.size)
        if self.kind == "cylinder":
            half = (self.size[0], self.size[1] / 2)
        own, R = matter_of(self.kind, half), matrix_from_rpy(*self.rpy)
        return float(self.density * own.mass), self.density * R @ own.inertia @ R.T

    def text(self) -> str:
        mass, inertia = self.truth
        mass = mass if self.mass is None else self.mass
        inertia = inertia if self.inertia is None else self.inertia
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        moments = " ".join(f'{n}="{x!r}"' for n, x in zip(names, inertia[np.triu_indices(3)].tolist(), strict=True))
        size = {
            "box": f'size="{words(self.size)}"',
            "sphere": f'radius="{self.size[0]}"',
            "cylinder": f'radius="{self.size[0]}" length="{self.size[-1]}"',
        }[self.kind]
        place = f'<origin xyz="{words(self.xyz)}" rpy="{words(self.rpy)}"/>'
        visual = f"<visual>{place}<geometry><{self.kind} {size}/></geometry></visual>"
        com = self.xyz if self.com is None else self.com
        inertial = (
            f'<inertial><origin xyz="{words(com)}"/><mass value="{float(mass)!r}"/><inertia {moments}/></inertial>'
        )
        return (
            f'<link name="{self.name}">{inertial}{visual if self.shapes is None else self.shapes}</link>'
            f'<joint name="{self.name}_joint" type="{self.joint}"><origin xyz="{words(self.origin)}"/>'
            f'<parent link="{self.parent}"/><child link="{self.name}"/><axis xyz="0 1 0"/>{self.inside}</joint>'
        )


def words(numbers: Any) -> str:
    return " ".join(repr(float(x)) for x in numbers)


def write(folder: Path, *links: Link) -> Path:
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="robot"><link name="base"/>{"".join(x.text() for x in links)}</robot>')
    return path


@pytest.fixture
def found(tmp_path: Path) -> Callable[..., dict[tuple[str, str], Any]]:
    """Findings of a file by check and part."""

    def find(*links: Link, **settings: Any) -> dict[tuple[str, str], Any]:
        return {(r.check, r.part): r for r in mb.lint(write(tmp_path, *links), **settings).rows}

    return find


def random_links(seed: int, n: int = 6) -> list[Link]:
    rng, out = np.random.default_rng(seed), [Link("l0")]
    for k in range(1, n):
        kind = str(rng.choice(["box", "cylinder", "sphere"]))
        size = {"box": rng.uniform(0.05, 0.3, 3), "sphere": rng.uniform(0.05, 0.1, 1)}.get(
            kind, rng.uniform(0.05, 0.2, 2)
        )
        parent, rpy, xyz = f"l{rng.integers(k)}", rng.uniform(-1, 1, 3), rng.uniform(-0.1, 0.1, 3)
        fixed = "fixed" if k == 2 else "continuous"
        density = float(rng.uniform(200, 8000))
        out.append(Link(f"l{k}", parent, tuple(size), kind, density, tuple(rpy), tuple(xyz), fixed))
    return out


# Plausible files, and one mistake in each


@pytest.mark.parametrize("seed", range(3))
def test_solids_with_their_own_mass_and_inertia_have_no_findings(tmp_path, seed):
    result = mb.lint(write(tmp_path, *random_links(seed)))
    assert result.rows == ()
    assert result.passed
    assert (result.links, result.shaped, result.joints) == (6, 6, 5)
    assert result.verdict.startswith("nothing found on 6 links (6 with shapes)")


def steiner(p: Any) -> np.ndarray:
    """Return p² 1 - p pᵀ."""
    return np.dot(p, p) * np.eye(3) - np.outer(p, p)


def flipped(inertia: np.ndarray) -> np.ndarray:
    """Return an inertia with the products' other sign."""
    return 2 * np.diag(np.diag(inertia)) - inertia


#: A mistake, as a change of a link, and its check.
MISTAKES: Mapping[str, tuple[Callable[[Link], dict[str, Any]], str]] = {
    "grams": (lambda x: {"mass": 1e3 * x.truth[0], "inertia": 1e3 * x.truth[1]}, "density"),
    "tonnes": (lambda x: {"mass": 1e-3 * x.truth[0], "inertia": 1e-3 * x.truth[1]}, "density"),
    "millimetres": (lambda x: {"com": [1e3 * a for a in x.xyz]}, "centre of mass"),
    "g mm²": (lambda x: {"inertia": 1e9 * x.truth[1]}, "radius of gyration"),
    "exchanged": (lambda x: {"inertia": x.truth[1][::-1, ::-1]}, "axes"),
    "sign": (lambda x: {"inertia": flipped(x.truth[1])}, "sign of products"),
    # About the link's origin: the parallel axis theorem with the centre at x.xyz.
    "origin": (lambda x: {"inertia": x.truth[1] + x.truth[0] * steiner(x.xyz)}, "inertia about origin"),
    "triangle": (lambda x: {"inertia": np.diag([1, 1, 3.0]) * x.truth[1][0, 0]}, "matter"),
    "identity": (lambda _: {"mass": 1.0, "inertia": np.eye(3)}, "placeholder"),
}


@pytest.mark.parametrize(("mistake", "fixed"), [*((x, False) for x in MISTAKES), ("grams", True), ("origin", True)])
def test_a_mistake_is_found_on_its_link(found, mistake, fixed):
    """Also on a link that is fixed to another one, which the model merges."""
    links = [Link("first"), Link("second", "first", rpy=(0.3, 0.2, 0.1), joint="fixed" if fixed else "continuous")]
    change, check = MISTAKES[mistake]
    rows = found(links[0], replace(links[1], **change(links[1])))
    assert (check, "second") in rows
    assert {part for _, part in rows} <= {"second", "first_joint", "second_joint"}


def test_every_check_has_a_test_of_its_limit():
    text = Path(__file__).read_text(encoding="utf-8")
    assert [name for name in CHECKS if f'"{name}"' not in text] == []
    assert all((run.__doc__ or "").startswith(("Judge", "Find")) for run in CHECKS.values())


# Where the limits are


def test_density_from_foam_to_lead(found):
    volume = Link("a").truth[0] / 1500
    lead = {0.99: "", 1.01: "look", 2.9: "look", 3.1: "likely", 29: "likely", 31: "sure"}
    foam = {1.01: "", 0.99: "look", 1 / 3.1: "likely"}
    expected = {x * checks.LEAD_DENSITY: told for x, told in lead.items()}
    for rho, confidence in (expected | {x * checks.FOAM_DENSITY: told for x, told in foam.items()}).items():
        rows = found(Link("a", density=rho))
        row = rows.get(("density", "a"))
        assert (row.confidence if row else "") == confidence
        if row:
            assert row.value == pytest.approx(rho, rel=1e-9)
            assert f"{1e3 * volume:.3g} l" in row.message


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_centre_of_mass_may_be_a_tenth_of_the_size_outside(found, share):
    a, size = Link("a"), float(np.linalg.norm(Link("a").size))
    out = 0.05 + share * checks.COM_OUTSIDE_RATIO * size
    row = found(replace(a, com=(out, 0, 0.2))).get(("centre of mass", "a"))
    assert (row is not None) == (share > 1)
    assert row is None or row.value == pytest.approx(out - 0.05, rel=1e-9)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_without_shapes_it_may_be_as_far_as_the_joints_reach(found, share):
    links = Link("a", shapes=""), Link("b", "a", shapes="", com=(0, 0, share * 0.8))
    assert (("centre of mass", "b") in found(*links)) == (share > 1)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_the_radius_of_gyration_is_within_the_shapes(found, share):
    a = Link("a")
    mass, own = a.truth
    corner = float(np.linalg.norm(a.size)) / 2
    wide = mass * (share * checks.LONGEST_GYRATION_RATIO * corner) ** 2
    assert (("radius of gyration", "a") in found(replace(a, inertia=wide * np.eye(3)))) == (share > 1)
    compact = np.trace(own) / 3 / checks.SHORTEST_GYRATION_RATIO / share
    assert (("radius of gyration", "a") in found(replace(a, inertia=compact * np.eye(3)))) == (share > 1)
    # From the centre of mass at one end the other end is farther.
    end = mass * (share * checks.LONGEST_GYRATION_RATIO * float(np.hypot(0.4, np.hypot(0.05, 0.03)))) ** 2
    assert (("radius of gyration", "a") in found(replace(a, com=(0, 0, 0.4), inertia=end * np.eye(3)))) == (share > 1)
    far = mass * (share * 0.4) ** 2 * np.eye(3)
    assert (("radius of gyration", "a") in found(replace(a, inertia=far, shapes=""))) == (share > 1)


def aspect(apart: float) -> float:
    """Return the length of a box of width 0.1 whose inertia over its trace has this distance from its turned one."""

    def distance(c: float) -> float:
        own = Link("a", size=(0.1, 0.1, c)).truth[1]
        own = own / np.trace(own)
        return float(np.linalg.norm(own - own[::-1, ::-1]))

    low, high = 0.1, 2.0
    for _ in range(60):
        low, high = (low, (low + high) / 2) if distance((low + high) / 2) > apart else ((low + high) / 2, high)
    return low


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_axes_that_are_far_off_and_fit_when_turned(found, share):
    a = Link("a", size=(0.1, 0.1, aspect(share * checks.UNLIKE_DISTANCE)))
    assert (("axes", "a") in found(replace(a, inertia=a.truth[1][::-1, ::-1]))) == (share > 1)
    long = Link("a", size=(0.05, 0.05, 0.5))
    _, own = long.truth
    # The nearer it comes to a sphere's, the less it is that of the shapes in other axes.
    sphere = np.trace(own) / 3 * np.eye(3)
    t = share * checks.ALIKE_DISTANCE / float(np.linalg.norm(own - sphere) / np.trace(own))
    blurred = ((1 - t) * own + t * sphere)[::-1, ::-1]
    assert (("axes", "a") in found(replace(long, inertia=blurred))) == (share < 1)


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_axes_are_judged_where_the_mass_is_spread_as_the_shapes(found, share):
    a = Link("a", size=(0.1, 0.06, 0.6), xyz=(0, 0, 0.3))
    off = share * checks.CENTRED_RATIO * float(np.linalg.norm(a.size))
    rows = found(replace(a, inertia=a.truth[1][::-1, ::-1], com=(0, 0, 0.3 + off)))
    assert (("axes", "a") in rows) == (share < 1)


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_an_inertia_about_the_origin_fits_only_there(found, share):
    long = Link("a", size=(0.05, 0.05, 0.4))
    mass, own = long.truth
    # A centre so far from the origin that the inertia about this is `SOLID` times that about the centre.
    off = float(np.sqrt(share * (checks.SOLID_INERTIA_RATIO - 1) * np.trace(own) / (2 * mass)))
    row = found(replace(long, xyz=(0, 0, off), inertia=own + mass * steiner((0, 0, off)))).get(
        ("inertia about origin", "a")
    )
    assert (row is not None) == (share > 1)
    assert row is None or row.confidence == "likely"
    assert row is None or row.value == pytest.approx(1 + share * (checks.SOLID_INERTIA_RATIO - 1), rel=1e-9)
    # A solid body that is also heavy elsewhere fits at neither point.
    far = own + mass * steiner((0, 0, 0.2)) + share * checks.FITTING_DISTANCE * np.trace(own) / np.sqrt(3) * np.eye(3)
    assert (("inertia about origin", "a") in found(replace(long, inertia=far))) == (share < 1)
    # With a part s of the theorem's term the distances are as s to 1 - s.
    p = (0, 0, float(np.sqrt(1.2 * np.trace(own) / (np.sqrt(2) * mass))))
    part = share * checks.BETTER_DISTANCE_RATIO / (1 + checks.BETTER_DISTANCE_RATIO)
    row = found(replace(long, xyz=p, inertia=own + part * mass * steiner(p)))
    assert (("inertia about origin", "a") in row) == (share > 1)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_inertias_off_from_a_solid_body_share_one_finding(found, share):
    a, b = Link("a"), Link("b", "a")
    for factor in (share * checks.SOLID_INERTIA_RATIO, 1 / (share * checks.SOLID_INERTIA_RATIO)):
        row = found(replace(a, inertia=factor * a.truth[1]), b).get(("solid body", "a"))
        assert (row is not None) == (share > 1)
        assert row is None or (row.confidence, row.others) == ("look", ())
        assert row is None or row.value == pytest.approx(factor, rel=1e-9)
    rows = found(replace(a, inertia=2.5 * a.truth[1]), replace(b, inertia=a.truth[1] / 5))
    assert rows["solid body", "b"].others == ("a",)
    assert "b 0.2, a 2.5" in rows["solid body", "b"].message


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_axes_of_unit_length(tmp_path, share):
    path = write(tmp_path, Link("a"), Link("b", "a", joint="fixed"))
    length = 1 + share * checks.AXIS_LENGTH_ERROR
    path.write_text(path.read_text().replace('axis xyz="0 1 0"', f'axis xyz="0 {length!r} 0"'))
    rows = [row for row in mb.lint(path).rows if row.check == "unit axes"]
    assert [row.part for row in rows] == ["a_joint"] * (share > 1)
    assert all(row.value == pytest.approx(length) and row.confidence == "look" for row in rows)


def leaning(product: float) -> Link:
    """Return a box that leans so that ixz is this part of the trace, times √2 with both of its places."""
    a = Link("a", size=(0.05, 0.05, 0.4))
    own = a.truth[1]
    angle = 0.5 * np.arcsin(2 * product * np.trace(own) / (own[0, 0] - own[2, 2]))
    return replace(a, rpy=(0, float(angle), 0))


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_signs_of_products_that_matter(found, share):
    a = leaning(share * checks.ALIKE_DISTANCE / (2 * np.sqrt(2)))
    assert (("sign of products", "a") in found(replace(a, inertia=flipped(a.truth[1])))) == (share > 1)
    # Products of s times the size: the distances are as 1 + s to 1 - s.
    b, ratio = leaning(0.15), checks.BETTER_DISTANCE_RATIO * share
    s, own = (ratio - 1) / (ratio + 1), b.truth[1]
    smaller = np.diag(np.diag(own)) - s * (own - np.diag(np.diag(own)))
    assert (("sign of products", "a") in found(replace(b, inertia=smaller))) == (share > 1)


def test_placeholders_are_powers_of_ten_about_every_axis(found):
    for moment, mass, confidence in ((1e-3, 1.0, "sure"), (1e-3, 0.7, "likely"), (2e-3, 1.0, ""), (0.0, 0.7, "likely")):
        row = found(Link("a", mass=mass, inertia=moment * np.eye(3)), Link("b", "a")).get(("placeholder", "a"))
        assert (row.confidence if row else "") == confidence


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_copied_inertias_are_on_several_links_that_differ(found, share):
    a, b = Link("a"), Link("b", "a")
    own = a.truth[1]
    # All lengths by f: moments over mass by f².
    f = float(np.sqrt(share * checks.OTHER_SHAPE_RATIO))
    same = {"mass": a.truth[0], "inertia": own}
    c = Link("c", "a", size=tuple(f * x for x in a.size), **same)
    assert (("copied inertia", "a") in found(a, b, c)) == (share > 1)
    heavier = Link("c", "a", mass=a.truth[0] / (1 - share * checks.MIRRORED_ERROR), inertia=own)
    assert (("copied inertia", "a") in found(a, b, heavier)) == (share > 1)
    assert ("copied inertia", "a") not in found(a, replace(c, mass=2 * a.truth[0]))


def bare(names: str, **changes: Any) -> list[Link]:
    """Return a chain of links of 1 kg without shapes."""
    out, parent = [], "base"
    for name in names.split():
        out.append(Link(name, parent, shapes="", mass=1.0, inertia=np.diag([0.011, 0.012, 0.013]), com=(0, 0, 0.1)))
        parent = name
    return [replace(x, **changes.get(x.name, {})) for x in out]


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_neighbours_without_shapes(found, share):
    for mass in (share * checks.NEIGHBOUR_MASS_RATIO, 1 / (share * checks.NEIGHBOUR_MASS_RATIO)):
        rows = found(*bare("a b c d", c={"mass": mass, "inertia": mass * np.diag([0.011, 0.012, 0.013])}))
        assert (("neighbours", "c") in rows) == (share > 1)
        assert not {part for check, part in rows if check == "neighbours"} - {"c"}
    rows = found(*bare("a b c d", c={"origin": (0, 0, share * checks.NEIGHBOUR_DISTANCE_RATIO * 0.4)}))
    assert (("neighbours", "c_joint") in rows) == (share > 1)
    # A light link beside a heavy one is none that differs from its robot.
    assert not found(*bare("a b", b={"mass": 1e-2, "inertia": np.diag([1.1, 1.2, 1.3]) * 1e-4}))


#: Of a left leg; its product has the other sign in a right one.
LEG = np.array([[0.011, 0.002, 0], [0.002, 0.012, 0], [0, 0, 0.013]])


def pairs(count: int, *wrong: tuple[str, np.ndarray]) -> list[Link]:
    """Return pairs of legs that mirror each other in y, and one more whose right one differs as given."""
    out = []
    inertia, com, mirror = LEG, np.array([0.01, 0.02, 0.1]), np.array([1, -1, 1])
    for k in range(count + 1):
        own = {"mass": 1.0, "com": com, "inertia": inertia}
        other = (
            own
            | {"com": com * mirror, "inertia": np.outer(mirror, mirror) * inertia}
            | (dict(wrong) if k == count else {})
        )
        out += [
            replace(Link("x", shapes=""), name=f"{side}_leg{k}", **x) for side, x in (("left", own), ("right", other))
        ]
    return out


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_links_that_mirror_but_for_one_number(found, share):
    part = share * checks.MIRRORED_ERROR
    inertia, com = flipped(LEG), np.array([0.01, -0.02, 0.1])
    radius = np.sqrt(0.036)
    for wrong in (
        ("mass", 1 / (1 + part)),
        ("com", com + np.array([2 * part * radius, 0, 0])),
        ("inertia", inertia - np.diag([0, part * 0.036, 0])),
    ):
        row = found(*pairs(3, wrong)).get(("mirror", "right_leg3"))
        assert (row is not None) == (share > 1)
        assert row is None or (row.confidence, row.others) == ("likely", ("left_leg3",))


def test_pairs_that_do_not_mirror_at_all_count_beside_three_that_do(found):
    other = np.diag([0.002, 0.018, 0.019])
    assert ("mirror", "right_leg3") in found(*pairs(3, ("inertia", other)))
    assert ("mirror", "right_leg2") not in found(*pairs(2, ("inertia", other)))
    assert found(*pairs(2, ("mass", 2.0)))["mirror", "right_leg2"].confidence == "look"
    assert not found(*pairs(3))


@pytest.mark.parametrize(
    ("left", "right"),
    [
        *(("left_hip", "right_hip"), ("LeftElbow", "RightElbow"), ("FL_calf", "FR_calf"), ("hand_l", "hand_r")),
        *(("l_gripper_l_finger", "r_gripper_r_finger"), ("LARM_LINK3", "RARM_LINK3"), ("handL", "handR")),
    ],
)
def test_names_of_the_other_side(left, right):
    known = {left, right, "r_gripper_l_finger"}
    assert checks.other_side(left, known) == right
    assert checks.other_side(right, known - {"r_gripper_l_finger"}) == ""
    assert checks.other_side(left, known - {right} - {"r_gripper_l_finger"}) == ""
    assert checks.other_side("pelvis", {"pelvis", "pervis"}) == ""


def limited(**limit: float) -> Link:
    numbers = {"lower": -1.0, "upper": 1.0, "effort": 1e3, "velocity": 1.0} | limit
    return Link("a", joint="revolute", inside=f"<limit {' '.join(f'{k}={str(x)!r}' for k, x in numbers.items())}/>")


@pytest.mark.parametrize("share", [0.999, 1.001])
def test_limits_beyond_two_turns_and_those_that_stand_for_none(found, share):
    key = "limits in degrees", "a_joint"
    assert (key in found(limited(upper=share * checks.MAX_TURN_RAD))) == (share > 1)
    assert (key in found(limited(upper=share * checks.LEAST_MISSING_LIMIT))) == (share < 1)
    message = found(limited(lower=-90, upper=90 + checks.WHOLE_DEGREE_ERROR / share * 0.999))[key].message
    assert ("whole numbers" in message) == (share > 1)


def test_limits_of_no_width_and_actuators_of_no_force(found):
    key = "empty limits", "a_joint"
    assert found(limited(lower=0.3, upper=0.3))[key].confidence == "likely"
    assert found(limited(effort=0.0))[key].message == "its limit of effort is 0"
    assert not found(limited(lower=0.3, upper=0.4))
    follows = replace(limited(effort=0.0, velocity=0.0), name="b")
    follows = replace(follows, inside=follows.inside + '<mimic joint="a_joint"/>')
    assert not found(limited(), follows)


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_effort_holds_the_worst_pose(found, share):
    mass, _ = Link("a").truth
    held = mass * 9.81 * 0.2
    link = replace(limited(effort=held / share, lower=-3, upper=3), origin=(0, 0, 0))
    row = found(link).get(("effort", "a_joint"))
    assert (row is not None) == (share > 1)
    assert row is None or f"takes {held:.3g}" in row.message


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_damping_slower_than_the_period(found, share):
    mass, own = Link("a").truth
    about = own[1, 1] + mass * 0.2**2
    link = Link("a", inside=f'<dynamics damping="{float(share * about / 0.004)!r}"/>')
    row = found(link, control_period=0.004).get(("damping", "a_joint"))
    assert (row is not None) == (share > 1)
    assert row is None or row.value == pytest.approx(0.004 / share, rel=1e-9)


def test_a_joint_of_several_velocities_has_one_finding():
    b = mb.ModelBuilder("ball")
    b.add_body("bob", mass=1.0, com=(0, 0, -0.5), inertia=(0.01, 0.02, 0.025))
    b.add_joint("socket", "ball", parent="world", child="bob", damping=(300, 200, 100))
    (row,) = mb.lint(b.build()).rows
    assert (row.part, row.check) == ("socket", "damping")
    # About x and y the bob swings, and about z it turns.
    assert row.value == pytest.approx(min(0.26 / 300, 0.27 / 200, 0.025 / 100), rel=1e-9)


# Shapes


@pytest.mark.parametrize(("kind", "size"), [("box", (0.1, 0.2, 0.3)), ("cylinder", (0.1, 0.3)), ("sphere", (0.2,))])
def test_volumes_and_inertias_of_triangles_are_those_of_the_solid(kind, size):
    surface, exact = solid(kind, size), matter_of(kind, size)
    R, p = matrix_from_rpy(0.3, -0.4, 0.5), np.array([0.4, -2.0, 1.0])
    own = solid_of(surface.vertices @ R.T + p, surface.triangles)
    # 32 sides take 0.6 % of a circle, and a sphere twice that.
    rtol = 1e-12 if kind == "box" else 0.03
    assert own.mass == pytest.approx(exact.mass, rel=rtol)
    np.testing.assert_allclose(own.com, p, atol=1e-12)
    np.testing.assert_allclose(R.T @ own.inertia @ R, exact.inertia, atol=2 * rtol * exact.inertia.max())
    hull = geometry_of([[Shape("a", "a", R, p, kind, size)]])
    assert hull.hull.mass == pytest.approx(own.mass, rel=1e-9)
    assert hull.least == pytest.approx(own.mass, rel=1e-9)


def test_an_open_mesh_has_the_volume_of_its_hull(tmp_path):
    """Of a frame made of two boxes, a closed mesh has their volume, and one without a triangle that of the hull."""
    parts = [solid("box", (0.01, 0.01, 0.2)), solid("box", (0.2, 0.01, 0.01))]
    V = np.concatenate([parts[0].vertices, parts[1].vertices + np.array([0.21, 0, -0.19])])
    T = np.concatenate([parts[0].triangles, parts[1].triangles + len(parts[0].vertices)])
    lines = [f"v {words(v)}" for v in V], [f"f {' '.join(str(i + 1) for i in t)}" for t in T.tolist()]
    visual = '<visual><geometry><mesh filename="part.obj"/></geometry></visual>'
    link = Link("a", mass=1e-3, inertia=np.diag([1.1, 1.2, 1.3]) * 1e-5, com=(0, 0, 0), shapes=visual)
    values = []
    for faces in (lines[1], lines[1][:-1]):
        (tmp_path / "part.obj").write_text("\n".join([*lines[0], *faces]))
        values += [r.value for r in mb.lint(write(tmp_path, link)).rows if r.check == "density"]
    closed = sum(8 * np.prod(x) for x in ((0.01, 0.01, 0.2), (0.2, 0.01, 0.01)))
    assert values[0] == pytest.approx(1e-3 / closed, rel=1e-9)
    assert values[1] < values[0] / 5


def test_shapes_that_cannot_be_read_or_span_nothing_are_not_judged(tmp_path):
    flat = '<visual><geometry><mesh filename="flat.obj"/></geometry></visual>'
    lost = '<visual><geometry><mesh filename="lost.obj"/></geometry></visual>'
    # Flat to rounding.
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1e-9\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4")
    result = mb.lint(write(tmp_path, Link("a", shapes=flat), Link("b", "a", shapes=lost)))
    assert (result.shaped, result.rows) == (0, ())
    assert "b (no such file: lost.obj)" in result.skipped[0]
    assert mb.lint(write(tmp_path, Link("a")), shapes=False).skipped == ("shapes were not read",)


# What is judged


def test_a_changed_model_is_judged_by_its_own_bodies(tmp_path):
    """Its file says something else; to rounding of the file's digits it may."""
    links = Link("a"), Link("b", "a", joint="fixed"), Link("c", "b")
    model = mb.load(write(tmp_path, *links))
    assert mb.lint(model).links == 3
    for share, judged in ((1 + 1e-8, 3), (1 + 1e-5, 2)):
        first, *others = model.bodies
        bodies = (first, *(replace(x, mass=share * x.mass) for x in others))
        assert mb.lint(replace(model, bodies=bodies)).links == judged
    b = mb.ModelBuilder.of(model)
    b.set_body("c", mass=1e3 * model.body("c").mass, inertia=1e3 * model.body("c").inertia)
    assert {r.part for r in mb.lint(b.build()).rows if r.check == "density"} == {"c"}


def test_mechanisms_are_judged_but_for_their_forces():
    result = mb.lint(mb.catalog.four_bar())
    assert result.skipped == ("effort and damping: constraints share the forces",)


def test_results_are_the_same_again_and_survive(tmp_path):
    path = write(tmp_path, replace(Link("a"), mass=500.0), Link("b", "a", mass=1.0, inertia=np.eye(3)))
    result = mb.lint(path)
    assert result.rows == mb.lint(mb.load(path, nonphysical="warn")).rows
    assert [r.confidence for r in result.rows] == sorted(
        (r.confidence for r in result.rows), key=["sure", "likely", "look"].index
    )
    again = LintResult.from_json(result.to_json())
    assert again == pickle.loads(pickle.dumps(result)) == result
    assert json.loads(result.to_json())["verdict"] == result.verdict
    assert len(result.to_csv().splitlines()) == 1 + len(result.rows)
    assert "density" in result.to_markdown()
    assert "<table>" in result._repr_html_()


# Doors


def call(*arguments: Any) -> Any:
    return CliRunner(env={"COLUMNS": "140"}).invoke(cli, ["lint", *map(str, arguments)])


def test_the_command_ends_by_what_it_found(tmp_path):
    good = call(write(tmp_path, Link("a")))
    assert (good.exit_code, good.stdout.split(":")[0]) == (0, "✓ robot")
    look = call(write(tmp_path, Link("a", density=1.5 * checks.LEAD_DENSITY)))
    assert look.exit_code == 0
    assert "look" in look.stdout
    impossible = Link("a", inertia=np.diag([1, 1, 3.0]))
    bad = call(write(tmp_path, impossible, replace(impossible, name="b"), replace(impossible, name="c")), "--json")
    assert bad.exit_code == 1
    assert json.loads(bad.stdout)["rows"][0]["confidence"] == "sure"
    assert "a, b, c" in call(tmp_path / "robot.urdf", "--no-shapes").stdout
    assert call(tmp_path / "robot.urdf", "--nonphysical", "error").exit_code == 2
    assert call(tmp_path / "none.urdf").exit_code == 2
    assert call(tmp_path / "robot.urdf", "--control-period", "0").exit_code == 2
    assert call("pendulum").exit_code == 0


def test_the_assert_names_the_number_and_can_ignore(tmp_path):
    heavy, odd = (Link(*x, density=f * checks.LEAD_DENSITY) for x, f in ((("a",), 1e3), (("b", "a"), 1.5)))
    path = write(tmp_path, heavy, odd)
    with pytest.raises(AssertionError, match=r"1 finding on .*: 1 sure\n  link or joint a, check density, sure"):
        assert_plausible(path)
    for ignore in (["density"], ["a"], ["a: *"], ["?"]):
        assert len(assert_plausible(mb.load(path), ignore=ignore).rows) == 2
    with pytest.raises(AssertionError):
        assert_plausible(path, ignore=["b", "b: density", "effort"])
    with pytest.raises(InputError, match="ignore: expected several names"):
        assert_plausible(path, ignore="a")


def test_bad_input_is_refused(tmp_path):
    path = write(tmp_path, Link("a"))
    for wrong in (3, None, b"arm.urdf"):
        with pytest.raises(InputError):
            mb.lint(wrong)
    for settings in ({"control_period": 0}, {"control_period": np.nan}, {"control_period": "1"}, {"shapes": "yes"}):
        with pytest.raises(InputError, match=next(iter(settings))):
            mb.lint(path, **settings)
    with pytest.raises(InputError, match="floating_base"):
        mb.lint(mb.load(path), floating_base=True)
    assert mb.lint(path, floating_base=True).rows == ()
    with pytest.raises(UnsupportedError, match="energies"):
        mb.lint("mbkit.lagrangian.systems:heavy_top")
    with pytest.raises(InputError, match="value"):
        mb.lint(mb.catalog.pendulum(mass=mb.Parameter("m")))
    with pytest.raises(LoadError):
        mb.lint(tmp_path / "none.urdf")
    with pytest.raises(UnknownNameError):
        mb.lint("no_such_robot")
