"""One arm written as a URDF in eight ways: seven say the same, the eighth says it in other units.

A parser that reads one of them otherwise than the rest is wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import mbkit as mb
from mbkit.spatial import matrix_from_rpy, rpy_from_matrix

#: The units of mass and length over those of the arm as written. A unit of time longer by √LENGTH leaves gravity alone.
MASS, LENGTH = 3.0, 0.25

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
    scaled = [
        link(n, m * MASS, np.multiply(com, LENGTH), tensor(I) * MASS * LENGTH**2) for n, (m, com, I) in LINKS.items()
    ]
    scaled += [joint(n, "revolute", a, b, np.multiply(xyz, LENGTH), *of) for n, (a, b, xyz, *of) in JOINTS.items()]
    tool = ['<link name="tool"/>', joint("mount", "fixed", "lower", "tool", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3))]
    return {
        "arm_as_written": links + joints,
        "arm_inertial_turned": turned + joints,
        "arm_principal_axes": principal + joints,
        "arm_link_split": split + joints,
        "arm_order_reversed": [*reversed(joints), *reversed(links)],
        "arm_links_renamed": renamed,
        "arm_frame_added": links + joints + tool,
        "arm_units_scaled": scaled,
    }


def scales(name: str) -> tuple[float, dict[str, float]]:
    """Return what the units of an arm make of velocities, and of M, gravity and nle."""
    if name != "arm_units_scaled":
        return 1.0, {"mass_matrix": 1.0, "gravity": 1.0, "nle": 1.0}
    return LENGTH**-0.5, {"mass_matrix": MASS * LENGTH**2, "gravity": MASS * LENGTH, "nle": MASS * LENGTH}


def urdf(name: str, elements: list[str]) -> str:
    return f'<robot name="{name}">\n' + "\n".join(elements) + "\n</robot>\n"


def written(folder: Path) -> list[mb.Model]:
    """Write the arms, and return them as mbkit reads them; raises where they do not say the same."""
    out = []
    for name, elements in arms().items():
        path = folder / f"{name}.urdf"
        path.write_text(urdf(name, elements), encoding="utf-8")
        out.append(mb.load(path))
    angles, rates = np.random.default_rng(0).standard_normal((2, len(JOINTS)))
    truth = None
    for model in out:
        faster, factors = scales(model.name)
        order = [model.joint_names.index(name) for name in JOINTS]
        q, v = np.empty((2, len(order)))
        q[order], v[order] = angles, faster * rates
        oracle = mb.dynamics(model, "oracle")
        M, g, nle = oracle.mass_matrix(q)[np.ix_(order, order)], oracle.gravity(q)[order], oracle.nle(q, v)[order]
        values = [x / factors[name] for name, x in zip(factors, (M, g, nle), strict=True)]
        truth = truth or values
        if not all(
            np.abs(x - right).max() < 1e-13 * np.abs(right).max() for x, right in zip(values, truth, strict=True)
        ):
            raise AssertionError(f"{model.name} does not say what the others say")
    return out
