"""URDF files of few words, written where a test wants them."""

from __future__ import annotations

from pathlib import Path

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def urdf_joint(name: str, parent: str, child: str, inside: str = LIMIT, kind: str = "revolute") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def links(*names: str, inertial: str = INERTIAL) -> str:
    return "".join(f'<link name="{n}">{inertial}</link>' for n in names)


def robot(*parts: str) -> str:
    return f'<robot name="r">{"".join(parts)}</robot>'


def written(folder: Path, text: str | bytes, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path
