"""Versions of MuJoCo, Pinocchio and Drake against the oracle: which changed which number, and when.

Run ``python -m validation.versions``; it writes ``validation/versions.json``. Environments are made below the user's
cache folder, or below ``MBKIT_ENVIRONMENTS``: 7 GB, and an hour where none is there yet.

The arm is one description written in seven ways that say the same; a parser that reads one of them otherwise is wrong.
That all say the same is checked with mbkit's own reader and the oracle before anything is measured.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mbkit as mb
from mbkit.engines.versions import process
from mbkit.engines.versions.engine_version import versions_of
from mbkit.engines.versions.importer import VersionImport
from mbkit.spatial import matrix_from_rpy, rpy_from_matrix
from mbkit.studies.results import to_plain
from tests.random_trees import random_tree
from validation.stamp import stamp

HERE = Path(__file__).parent
#: Engine -> its versions.
VERSIONS: dict[str, tuple[str, ...]] = {
    "mujoco": (
        *(f"3.1.{k}" for k in range(7)),
        *("3.2.0", "3.2.7"),
        *(f"3.3.{k}" for k in range(8)),
        *(f"3.{k}.0" for k in (4, 5, 6, 7, 9, *range(10, 18))),
        "4.0.0",
    ),
    "pinocchio": (
        *("2.6.18", "2.6.20", "2.6.21", "2.7.0", "3.3.1", "3.4.0", "3.7.0", "3.8.0", "3.9.0", "4.0.0", "4.1.0"),
    ),
    "drake": ("1.35.0", "1.36.0", "1.38.0", "1.41.0", "1.44.0", "1.47.0", "1.50.0", "1.51.1"),
}
ROBOTS = ("ur5", "panda")
BARE = {"springs": False, "damping": False}
TREES = {
    "turning": lambda: random_tree(5, 6, ("revolute", "free", "ball", "planar"), armature=False, **BARE),
    "universal": lambda: random_tree(2, 5, ("revolute", "universal"), armature=False, **BARE),
    "spherical_zyx": lambda: random_tree(3, 5, ("revolute", "spherical_zyx"), armature=False, **BARE),
    "rotors": lambda: random_tree(6, 5, ("revolute", "prismatic"), armature=True, **BARE),
}

# Seven ways to write one arm.

#: Link -> mass, kg; centre of mass, m; Ixx, Iyy, Izz, Ixy, Ixz, Iyz about it, kg m².
LINKS = {
    "base": (3.0, (0.0, 0.1, 0.2), (0.3, 0.4, 0.5, 0.0, 0.0, 0.0)),
    "upper": (2.0, (0.1, -0.2, 0.3), (0.2, 0.3, 0.25, 0.02, -0.03, 0.04)),
    "lower": (1.5, (0.05, 0.1, 0.4), (0.1, 0.12, 0.15, -0.01, 0.02, 0.03)),
    "side": (1.0, (-0.1, 0.0, 0.2), (0.1, 0.08, 0.09, 0.01, 0.01, -0.02)),
}
#: Joint -> parent, child, place and axis.
JOINTS = {
    "shoulder": ("base", "upper", (0.0, 0.0, 0.4), (0.2, -0.1, 0.3), (0, 0, 1)),
    "elbow": ("upper", "lower", (0.3, 0.0, 0.5), (0.0, 0.4, 0.1), (0, 1, 0)),
    "wing": ("upper", "side", (-0.2, 0.1, 0.1), (0.5, 0.0, 0.0), (0.6, 0, 0.8)),
}


def tensor(moments: tuple[float, ...]) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = moments
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def numbers(values: Any) -> str:
    return " ".join(repr(float(x)) for x in values)


def link(name: str, mass: float, com: Any, I: np.ndarray, rpy: Any = (0.0, 0.0, 0.0)) -> str:
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    moments = " ".join(f'{key}="{I[at]!r}"' for key, at in names.items()).replace("np.float64(", "").replace(")", "")
    return (
        f'<link name="{name}"><inertial><origin xyz="{numbers(com)}" rpy="{numbers(rpy)}"/><mass value="{mass!r}"/>'
        f"<inertia {moments}/></inertial></link>"
    )


def joint(name: str, kind: str, parent: str, child: str, xyz: Any, rpy: Any, axis: Any = (0, 0, 1)) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{numbers(xyz)}" rpy="{numbers(rpy)}"/>'
        f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{numbers(axis)}"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
    )


def arms() -> dict[str, list[str]]:
    """Return the elements of each way to write the arm."""
    links = [link(name, m, com, tensor(I)) for name, (m, com, I) in LINKS.items()]
    joints = [joint(name, "revolute", *of) for name, of in JOINTS.items()]
    R = matrix_from_rpy(0.3, -0.5, 0.7)
    turned = [link(n, m, com, R.T @ tensor(I) @ R, rpy_from_matrix(R)) for n, (m, com, I) in LINKS.items()]
    principal = []
    for name, (m, com, I) in LINKS.items():
        moments, axes = np.linalg.eigh(tensor(I))
        axes = axes * np.sign(np.linalg.det(axes))
        principal.append(link(name, m, com, np.diag(moments), rpy_from_matrix(axes)))
    mass, com, I = LINKS["upper"][0] / 2, np.array(LINKS["upper"][1]), tensor(LINKS["upper"][2]) / 2
    p = np.array([0.2, 0.3, -0.1])
    halves = [link("upper", mass, com, I), link("upper_half", mass, R.T @ (com - p), R.T @ I @ R)]
    split = [*links[:1], *halves, *links[2:], joint("weld", "fixed", "upper", "upper_half", p, rpy_from_matrix(R))]
    other = {"base": "z", "upper": "y", "lower": "a", "side": "b"}
    renamed = [link(other[n], m, com, tensor(I)) for n, (m, com, I) in LINKS.items()]
    renamed += [joint(n, "revolute", other[a], other[b], *of) for n, (a, b, *of) in JOINTS.items()]
    tool = ['<link name="tool"/>', joint("mount", "fixed", "lower", "tool", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3))]
    return {
        "arm_as_written": links + joints,
        "arm_inertial_turned": turned + joints,
        "arm_principal_axes": principal + joints,
        "arm_link_split": split + joints,
        "arm_order_reversed": [*reversed(joints), *reversed(links)],
        "arm_links_renamed": renamed,
        "arm_frame_added": links + joints + tool,
    }


def written(folder: Path) -> list[mb.Model]:
    """Write the arms, and return them as mbkit reads them; raises where they do not say the same."""
    out = []
    for name, elements in arms().items():
        path = folder / f"{name}.urdf"
        path.write_text(f'<robot name="{name}">\n' + "\n".join(elements) + "\n</robot>\n", encoding="utf-8")
        out.append(mb.load(path))
    rng = np.random.default_rng(0)
    angles = dict(zip(JOINTS, rng.standard_normal(len(JOINTS)), strict=True))
    truth = None
    for model in out:
        order = [model.joint_names.index(name) for name in JOINTS]
        M = mb.dynamics(model, "oracle").mass_matrix([angles[name] for name in model.joint_names])[np.ix_(order, order)]
        truth = M if truth is None else truth
        if not np.abs(M - truth).max() < 1e-14 * np.abs(truth).max():
            raise AssertionError(f"{model.name} does not say what the others say")
    return out


def study(engine: str, targets: list[Any]) -> dict[str, Any]:
    result = mb.versions(targets, engine, VERSIONS[engine], most=100, samples=2)
    data, known = result.to_dict(), versions_of(engine)
    for change in data["changes"]:
        # Whether none of those that pip has lies between.
        change["next_to_it"] = known.index(change["version"]) == known.index(change["before"]) + 1
    digits: dict[str, dict[str, list[Any]]] = {}
    ratios: dict[str, dict[str, float]] = {}
    for r in result.rows:
        digits.setdefault(r.robot, {}).setdefault(r.term, []).append(None if np.isnan(r.digits) else round(r.digits, 1))
        ratios.setdefault(r.robot, {})[r.version] = r.time_ratio
    reasons = sorted({(r.robot, r.term, r.version, r.reason) for r in result.rows if r.reason})
    kept = {k: data[k] for k in ("engine", "measured", "changes", "missing", "settings", "seconds", "verdict")}
    return kept | {"digits": digits, "time_ratios": ratios, "reasons": reasons}


#: The smallest files that a version reads wrongly: one hinge about x, whose M is a number.
SMALLEST = {
    "inertial_turned": (
        link("arm", 1.0, (0, 0, 0), np.diag([1.0, 1.5, 2.0]), (0.0, np.pi / 2, 0.0)),
        joint("hinge", "continuous", "base", "arm", (0, 0, 0), (0, 0, 0), (1, 0, 0)),
    ),
    "weld_turned": (
        link("arm", 1.0, (0, 0, 0), np.eye(3)),
        link("weight", 1.0, (0, 1, 0), np.eye(3)),
        joint("hinge", "continuous", "base", "arm", (0, 0, 0), (0, 0, 0), (1, 0, 0)),
        joint("weld", "fixed", "arm", "weight", (0, 0, 0), (0.0, 0.0, np.pi / 2)),
    ),
}


def smallest(engine: str) -> dict[str, Any]:
    """Return M of each smallest file as each version reads it, and as the oracle says."""
    out: dict[str, Any] = {}
    for name, elements in SMALLEST.items():
        text = f'<robot name="{name}">\n<link name="base"/>\n' + "\n".join(elements) + "\n</robot>\n"
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(text, encoding="utf-8")
            model = mb.load(path)
        right = float(mb.dynamics(model, "oracle").mass_matrix([0.0])[0, 0])
        values = {}
        for version in VERSIONS[engine]:
            read = VersionImport(mb.engine(f"{engine}=={version}"), text, "urdf", model)
            values[version] = float(read.term("mass_matrix", np.zeros((1, 1)), np.zeros((1, 1)))[0, 0, 0])
        out[name] = {"urdf": text, "right": right, "M": values}
    for version in VERSIONS[engine]:
        process.end(mb.engine(f"{engine}=={version}"))
    return out


def main() -> None:
    path = HERE / "versions.json"
    names = sys.argv[1:] or list(VERSIONS)
    out: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if sys.argv[1:] and path.exists() else {}
    out |= stamp()
    with tempfile.TemporaryDirectory() as folder:
        trees = [replace(make(), name=name) for name, make in TREES.items()]
        models = [*written(Path(folder)), *trees]
        for engine in names:
            out.setdefault("engines", {})[engine] = study(engine, [*ROBOTS, *models])
            out.setdefault("smallest", {})[engine] = smallest(engine)
            print(out["engines"][engine]["verdict"])
    path.write_text(json.dumps(to_plain(out), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
