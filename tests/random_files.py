"""Random MJCFs, what MuJoCo computes of them, and damaged copies of robots' files; the same for the same seed.

Nothing here uses mbkit, so that what it is compared with does not come from it.
"""

from __future__ import annotations

import copy
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass

import mujoco
import numpy as np

EPS = float(np.finfo(float).eps)
SHAPES = ("sphere", "capsule", "cylinder", "box", "ellipsoid")


# Random MJCFs.


class _Author:
    """Writes one MJCF; every attribute is drawn, or left to its default."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng([seed, 31])
        self.degrees = self.chance(0.5)
        self.count = {"body": 0, "joint": 0}
        self.classes: list[str] = []
        #: Whether each body needs an <inertial>, and whether geoms override it.
        self.inferred = str(self.rng.choice(["auto", "auto", "auto", "true", "false"]))

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def numbers(self, n: int, size: float = 1.0) -> str:
        return " ".join(repr(float(x)) for x in size * self.rng.standard_normal(n))

    def positive(self, n: int, low: float = 0.05, high: float = 0.5) -> str:
        return " ".join(repr(float(x)) for x in self.rng.uniform(low, high, n))

    def angle(self, low: float, high: float) -> float:
        x = float(self.rng.uniform(low, high))
        return float(np.degrees(x)) if self.degrees else x

    def pose(self, p: float = 0.7) -> dict[str, str]:
        out = {"pos": self.numbers(3, 0.4)} if self.chance(p) else {}
        if self.chance(p):
            how = str(self.rng.choice(["quat", "axisangle", "euler", "xyaxes", "zaxis"]))
            angles = [self.angle(-3, 3) for _ in range(3)]
            out[how] = {
                "quat": self.numbers(4),
                "axisangle": f"{self.numbers(3)} {angles[0]!r}",
                "euler": " ".join(map(repr, angles)),
                "xyaxes": self.numbers(6),
                "zaxis": self.numbers(3),
            }[how]
        return out

    def named(self, kind: str) -> dict[str, str]:
        self.count[kind] += 1
        return {"name": f"{kind}{self.count[kind]}"} if self.chance(0.8) else {}

    def of_class(self) -> dict[str, str]:
        return {"class": str(self.rng.choice(self.classes))} if self.classes and self.chance(0.3) else {}

    def geom(self, owner: ET.Element, *, heavy: bool) -> None:
        shape = str(self.rng.choice((*SHAPES, "mesh")))
        given = {"type": shape, **self.of_class()}
        if shape == "mesh":
            given |= {"mesh": str(self.rng.choice(["hull", "ball"])), **self.pose()}
        elif shape != "sphere" and self.chance(0.3):
            given |= {"fromto": self.numbers(6, 0.4), "size": self.positive(1)}
        else:
            given |= {"size": self.positive(3 if shape in ("box", "ellipsoid") else 2), **self.pose()}
        if shape == "sphere":
            given["size"] = self.positive(1)
        if heavy:
            given |= {"mass": self.positive(1, 0.1, 3)} if self.chance(0.6) else {"density": self.positive(1, 50, 2000)}
        elif self.chance(0.3):
            given |= {"mass": "0"} if self.chance(0.5) else {"density": "0"}
        if self.chance(0.1) and shape != "mesh":
            given["shellinertia"] = "true"
        if self.chance(0.2):
            given["group"] = str(self.rng.integers(0, 3 if heavy else 6))
        ET.SubElement(owner, "geom", given)

    def inertial(self, owner: ET.Element) -> None:
        given = {"pos": self.numbers(3, 0.2), "mass": self.positive(1, 0.1, 3)}
        d = self.rng.uniform(0.01, 0.1, 3)
        moments = np.array([d[0] + d[1], d[1] + d[2], d[2] + d[0]])
        if self.chance(0.5):
            R = np.linalg.qr(self.rng.standard_normal((3, 3)))[0]
            full = R @ np.diag(moments) @ R.T
            entries = [full[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
            given["fullinertia"] = " ".join(repr(float(x)) for x in entries)
        else:
            given["diaginertia"] = " ".join(repr(float(x)) for x in moments)
            given |= {k: x for k, x in self.pose().items() if k != "pos"}
        ET.SubElement(owner, "inertial", given)

    def joint(self, owner: ET.Element, kind: str) -> None:
        given = {**self.named("joint"), **self.of_class()}
        if kind == "free" and self.chance(0.5):
            given.pop("class", None)
            ET.SubElement(owner, "freejoint", given)
            return
        if kind != "hinge" or self.chance(0.5):
            given["type"] = kind
        if kind != "free" and self.chance(0.5):
            given["pos"] = self.numbers(3, 0.3)
        if kind in ("hinge", "slide"):
            hinge = kind == "hinge"
            drawn = {
                "ref": repr(self.angle(-1, 1) if hinge else float(self.rng.uniform(-1, 1))),
                "stiffness": self.positive(1, 0.5, 9),
                "springref": repr(self.angle(-1, 1) if hinge else float(self.rng.uniform(-1, 1))),
                "armature": self.positive(1, 0.01, 1),
                "range": f"{self.angle(-2, 0)!r} {self.angle(0.1, 2)!r}",
                "springdamper": self.positive(2, 0.1, 1),
            }
            given |= {k: x for k, x in drawn.items() if self.chance(0.4)}
            if owner.find("joint") is not None or self.chance(0.6):
                # Two parallel slides of one body would make M singular.
                given["axis"] = self.numbers(3)
        elif self.chance(0.2):
            given |= {"range": "0 0.5"} if kind == "ball" else {"limited": "false"}
        if "range" in given:
            given["limited"] = "true" if self.chance(0.5) else "false"
        given |= {k: self.positive(1, 0.1, 2) for k in ("damping", "frictionloss") if self.chance(0.3)}
        ET.SubElement(owner, "joint", given)

    def body(self, owner: ET.Element, depth: int) -> None:
        if self.chance(0.15):
            owner = ET.SubElement(owner, "frame", self.pose())
        given = {**self.named("body"), **self.pose()}
        if self.classes and self.chance(0.2):
            given["childclass"] = str(self.rng.choice(self.classes))
        body = ET.SubElement(owner, "body", given)
        free = depth == 0 and self.chance(0.3)
        kinds = ["free"] if free else [str(self.rng.choice(["hinge", "slide"])) for _ in range(self.rng.integers(0, 3))]
        if not free and self.chance(0.15):
            # A hinge beside it would turn the same way in some pose, and M be singular there.
            kinds = [*(k for k in kinds if k == "slide"), "ball"]
        inside = ET.SubElement(body, "frame", self.pose()) if kinds and not free and self.chance(0.1) else body
        for kind in kinds:
            self.joint(inside, kind)
        written = self.inferred == "false" or self.chance(0.3)
        if written:
            self.inertial(body)
        for k in range(self.rng.integers(0 if written else 1, 4)):
            holder = ET.SubElement(body, "frame", self.pose()) if self.chance(0.1) else body
            self.geom(holder, heavy=k == 0 and not written)
        if self.chance(0.2):
            ET.SubElement(body, "site", {"name": f"site{self.count['body']}", **self.pose()})
        for _ in range(self.rng.integers(0, 3 if depth < 2 else 1)):
            self.body(body, depth + 1)

    def default(self, owner: ET.Element) -> None:
        if self.chance(0.6):
            ET.SubElement(owner, "joint", {"damping": self.positive(1), "frictionloss": self.positive(1)})
        if self.chance(0.6):
            ET.SubElement(owner, "geom", {"density": self.positive(1, 100, 900), "rgba": "1 0 0 1"})

    def text(self) -> str:
        root = ET.Element("mujoco", {"model": "random"})
        compiler = {"angle": "degree" if self.degrees else "radian", "inertiafromgeom": self.inferred}
        if self.chance(0.5):
            compiler["eulerseq"] = "".join(self.rng.choice(list("xyzXYZ"), 3))
        if self.chance(0.2):
            compiler["inertiagrouprange"] = "0 2"
        drawn = {
            "settotalmass": self.positive(1, 1, 20),
            "boundmass": self.positive(1, 0.1, 1),
            "boundinertia": self.positive(1, 1e-3, 1e-2),
            "balanceinertia": "true",
            "autolimits": "false",
        }
        compiler |= {k: x for k, x in drawn.items() if self.chance(0.1)}
        ET.SubElement(root, "compiler", compiler)
        option = ET.SubElement(root, "option", {"gravity": self.numbers(3, 6)} if self.chance(0.7) else {})
        flags = {k: "disable" for k in ("gravity", "spring", "damper", "contact") if self.chance(0.07)}
        if flags:
            ET.SubElement(option, "flag", flags)
        if self.chance(0.5):
            main = ET.SubElement(root, "default")
            self.default(main)
            for name in ("one", "two"):
                self.default(ET.SubElement(main, "default", {"class": name}))
                self.classes.append(name)
        asset = ET.SubElement(root, "asset")
        ET.SubElement(asset, "mesh", {"name": "hull", "vertex": self.numbers(24, 0.2)})
        ET.SubElement(
            asset, "mesh", {"name": "ball", "vertex": self.numbers(36, 0.2), "scale": self.positive(3, 0.5, 2)}
        )
        world = ET.SubElement(root, "worldbody")
        ET.SubElement(world, "geom", {"type": "plane", "size": "1 1 1"})
        for _ in range(self.rng.integers(1, 4)):
            self.body(world, 0)
        if not any(e.tag in ("joint", "freejoint") for e in world.iter()):
            self.joint(ET.SubElement(world, "body", {"name": "last"}), "hinge")
            self.geom(world[-1], heavy=True)
            self.inertial(world[-1])
        ET.indent(root)
        return ET.tostring(root, encoding="unicode")


def random_mjcf(seed: int) -> str:
    """Return an MJCF of a few bodies that uses most ways to write poses, joints, inertias and defaults."""
    return _Author(seed).text()


def with_tendons(text: str, seed: int) -> str:
    """Return an MJCF with tendons and actuators of every kind that acts without control, and with held weights."""
    author, root = _Author(seed), ET.fromstring(text)
    rng = author.rng = np.random.default_rng([seed, 32])
    bodies = list(root.find("worldbody").iter("body"))
    for k, body in enumerate(bodies):
        ET.SubElement(body, "site", {"name": f"at{k}", **author.pose()})
        if author.chance(0.3):
            body.set("gravcomp", author.numbers(1))
    ET.SubElement(root.find("worldbody"), "site", {"name": "ground", "pos": author.numbers(3)})
    sites = ["ground", *(f"at{k}" for k in range(len(bodies)))]
    single = [e for e in root.find("worldbody").iter("joint") if e.get("type", "hinge") in ("hinge", "slide")]
    for k, joint in enumerate(single):
        joint.set("name", joint.get("name", f"single{k}"))
    for joint in root.find("worldbody").iter("joint"):
        k, *higher = author.positive(3, 0.5, 3).split()
        # A spring about all axes has no odd power.
        springs = [k, *higher] if joint in single else [k, "0", higher[0]]
        if author.chance(0.4):
            joint.set("stiffness", " ".join(springs[: 1 + 2 * author.chance(0.5)]))
        if author.chance(0.4):
            joint.set("damping", author.positive(int(rng.integers(1, 4))))
    tendons, actuators = ET.SubElement(root, "tendon"), ET.SubElement(root, "actuator")
    for k in range(4):
        spatial = not single or author.chance(0.6)
        given = {"name": f"tendon{k}"}
        stiffness, damping = (author.numbers(int(rng.integers(1, 4))) for _ in range(2))
        lengths = " ".join(repr(float(x)) for x in np.sort(rng.uniform(0.1, 2, 2)))
        drawn = {"stiffness": stiffness, "damping": damping, "springlength": lengths}
        given |= {name: x for name, x in drawn.items() if author.chance(0.6)}
        tendon = ET.SubElement(tendons, "spatial" if spatial else "fixed", given)
        if not spatial:
            for joint in rng.choice(len(single), min(len(single), int(rng.integers(1, 4))), replace=False):
                ET.SubElement(tendon, "joint", {"joint": single[joint].get("name"), "coef": author.numbers(1)})
            continue
        for branch in range(int(rng.integers(1, 3))):
            if branch:
                ET.SubElement(tendon, "pulley", {"divisor": author.positive(1, 1, 3)})
            for site in rng.choice(len(sites), min(len(sites), int(rng.integers(2, 5))), replace=False):
                ET.SubElement(tendon, "site", {"site": sites[site]})
    for k in range(2):
        at = {"tendon": f"tendon{k}"} if not single or author.chance(0.5) else {"joint": single[0].get("name")}
        ET.SubElement(actuators, "general", {**at, "gear": author.numbers(1), "damping": author.numbers(3)})
    return ET.tostring(root, encoding="unicode")


# What MuJoCo computes.


@dataclass(frozen=True)
class Reference:
    """MuJoCo's terms at random states, in mbkit's coordinates.

    Attributes
    ----------
    q, v : (N, nq) and (N, nv) arrays
        Quaternions x, y, z, w; a free joint's velocities in the body's axes.
    M, nle, passive, actuated : arrays
        The last has the forces of actuators at zero control too.
    scale : (N,) array
        |nle|'s largest entry, or what could cancel in it: |M| |v|² and |g| |M| / length.
    rounding : (N,) array
        The sums of absolute values of which MuJoCo makes M's diagonal, over M's largest entry: how many
        eps M is off where they cancel.
    """

    q: np.ndarray
    v: np.ndarray
    M: np.ndarray
    nle: np.ndarray
    passive: np.ndarray
    actuated: np.ndarray
    scale: np.ndarray
    rounding: np.ndarray


def mujoco_terms(text: str, samples: int, seed: int) -> Reference:
    """Compile an MJCF and return MuJoCo's terms; raises ValueError where MuJoCo refuses it."""
    before = mujoco.get_mju_user_warning()
    # MuJoCo would print them and write a file into the working folder.
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        return terms_of(mujoco.MjModel.from_xml_string(text), samples, seed)
    finally:
        mujoco.set_mju_user_warning(before)


_FORCES = ("passive", "actuated")


def terms_of(m: mujoco.MjModel, samples: int, seed: int) -> Reference:
    """Return the terms of a compiled model."""
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT)
    d, rng = mujoco.MjData(m), np.random.default_rng([seed, 7])
    out: dict[str, list[np.ndarray]] = {name: [] for name in ("q", "v", "M", "nle", *_FORCES, "scale", "rounding")}
    for _ in range(samples):
        q, v = rng.uniform(-2, 2, m.nq), rng.standard_normal(m.nv)
        T, slip = np.eye(m.nv), np.zeros(m.nv)
        d.qpos[:] = q
        for j in range(m.njnt):
            kind, at, dof = int(m.jnt_type[j]), int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
            if kind > int(mujoco.mjtJoint.mjJNT_BALL):
                continue
            at += 3 * (kind == int(mujoco.mjtJoint.mjJNT_FREE))
            q[at : at + 4] /= np.linalg.norm(q[at : at + 4])
            d.qpos[at : at + 4] = np.roll(q[at : at + 4], 1)
            if kind == int(mujoco.mjtJoint.mjJNT_FREE):
                R = np.empty(9)
                mujoco.mju_quat2Mat(R, d.qpos[at : at + 4])
                T[dof : dof + 3, dof : dof + 3] = R.reshape(3, 3)
                slip[dof : dof + 3] = R.reshape(3, 3) @ np.cross(v[dof + 3 : dof + 6], v[dof : dof + 3])
        d.qvel[:] = T @ v
        mujoco.mj_forward(m, d)
        M = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, M)
        size = np.abs(M).max()
        scale = max(np.abs(d.qfrc_bias).max(), size * (v @ v), np.linalg.norm(m.opt.gravity) * size)
        lost = np.array(_sums(m, d) / size)
        passive = T.T @ d.qfrc_passive
        forces = T.T @ (d.qfrc_bias + M @ slip), passive, passive + T.T @ d.qfrc_actuator
        for name, x in zip(out, (q, v, T.T @ M @ T, *forces, np.array(scale), lost), strict=True):
            out[name].append(x)
    return Reference(**{name: np.array(x) for name, x in out.items()})


def _sums(m: mujoco.MjModel, d: mujoco.MjData) -> float:
    """Return the largest sum of absolute values, of composite inertias about the tree's centre of mass."""
    worst = 0.0
    for dof in range(m.nv):
        xx, yy, zz, xy, xz, yz, hx, hy, hz, mass = np.abs(d.crb[m.dof_bodyid[dof]])
        w, v = np.abs(d.cdof[dof][:3]), np.abs(d.cdof[dof][3:])
        turning = w @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ w
        mixed = w @ np.array([[0, hz, hy], [hz, 0, hx], [hy, hx, 0]]) @ v
        worst = max(worst, float(turning + 2 * mixed + mass * (v @ v)))
    return worst


def errors(reference: Reference, M: np.ndarray, nle: np.ndarray, passive: np.ndarray) -> dict[str, float]:
    """Return how far terms are from MuJoCo's, in units of eps times the largest entry and the number of joints."""
    n = reference.v.shape[1]
    size = np.abs(reference.M).max(axis=(1, 2))
    forces = np.maximum(np.abs(reference.passive).max(axis=1), 1.0)
    return {
        "M": float((np.abs(M - reference.M).max(axis=(1, 2)) / size).max() / (n * EPS)),
        "nle": float((np.abs(nle - reference.nle).max(axis=1) / reference.scale).max() / (n * EPS)),
        "passive": float((np.abs(passive - reference.passive).max(axis=1) / forces).max() / (n * EPS)),
    }


# Damaged files.

_TOKEN = re.compile(rb"[^\s<>=\"'/]+|\s+|[<>=\"'/]")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_EXTREMES = ("0", "-0", "-1", "1e-320", "1e-30", "1e-9", "1e9", "1e29", "1e308", "1e999", "nan", "inf", "-inf", "")
_EXTREMES += ("1 2", "0x10", "1,5", "١", "1e", "--1", "3.14", "180", "true", "${x}", "2", "-7.5", "0.001")
_BYTES = (b"\x00", b"\xff", b"<", b">", b"&", b'"', b"'", b"]]>", b"<!--", b"-->", b"\xef\xbb\xbf", b"\r", b"<?xml?>")
_NAMES = ("name", "pos", "xyz", "type", "size", "mass", "value", "axis", "range", "class", "joint", "link", "x")


def mutant(original: bytes, seed: int) -> tuple[str, bytes]:
    """Return the kind of damage, and the damaged file: one to three changes of that kind."""
    rng = np.random.default_rng([seed, 61])
    kinds = (_bytes, _tokens, _attributes, _numbers, _structure)
    damage = kinds[seed % len(kinds)]
    text = original
    for _ in range(int(rng.integers(1, 4))):
        text = damage(text, rng)
    kind = damage.__name__.lstrip("_")
    return kind, text


def _bytes(text: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(0, max(len(text), 1)))
    length = int(rng.integers(0, 12))
    piece = rng.choice(len(_BYTES) + 2)
    new = _BYTES[piece] if piece < len(_BYTES) else rng.bytes(int(rng.integers(0, 6)))
    return text[:at] + new + text[at + length :]


def _tokens(text: bytes, rng: np.random.Generator) -> bytes:
    tokens = _TOKEN.findall(text)
    if len(tokens) < 2:
        return text
    i, j = (int(x) for x in rng.integers(0, len(tokens), 2))
    how = int(rng.integers(0, 4))
    if how == 0:
        del tokens[i]
    elif how == 1:
        tokens.insert(j, tokens[i])
    elif how == 2:
        tokens[i], tokens[j] = tokens[j], tokens[i]
    else:
        tokens[i] = tokens[j]
    return b"".join(tokens)


def _parsed(text: bytes) -> ET.Element | None:
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError, LookupError):
        return None


def _attributes(text: bytes, rng: np.random.Generator) -> bytes:
    root = _parsed(text)
    some = [e for e in root.iter() if e.attrib] if root is not None else []
    if root is None or not some:
        return text
    element = some[int(rng.integers(len(some)))]
    key = str(rng.choice(sorted(element.attrib)))
    other = some[int(rng.integers(len(some)))]
    how = int(rng.integers(0, 5))
    if how == 0:
        del element.attrib[key]
    elif how == 1:
        element.attrib[str(rng.choice(_NAMES))] = element.attrib.pop(key)
    elif how == 2:
        element.attrib[key] = str(rng.choice(sorted(other.attrib.values())))
    elif how == 3:
        element.attrib[key[:-1] or "x"] = element.attrib.pop(key)
    else:
        element.attrib[str(rng.choice(_NAMES))] = str(rng.choice(sorted(other.attrib.values())))
    return ET.tostring(root)


def _numbers(text: bytes, rng: np.random.Generator) -> bytes:
    root = _parsed(text)
    if root is None:
        return text
    some = [(e, k) for e in root.iter() for k, x in e.attrib.items() if _NUMBER.search(x)]
    if not some:
        return text
    element, key = some[int(rng.integers(len(some)))]
    words = element.attrib[key].split()
    at = int(rng.integers(len(words))) if words else 0
    if rng.random() < 0.3 and words and _NUMBER.fullmatch(words[at]):
        words[at] = repr(float(words[at]) * float(rng.choice([-1.0, 1e-3, 1e3, 1e-12, 1e12])))
    else:
        words[at : at + 1] = [str(rng.choice(_EXTREMES))]
    element.attrib[key] = " ".join(words)
    return ET.tostring(root)


def _structure(text: bytes, rng: np.random.Generator) -> bytes:
    root = _parsed(text)
    parents = [e for e in root.iter() if len(e)] if root is not None else []
    if root is None or not parents:
        return text
    owner, target = (parents[int(k)] for k in rng.integers(0, len(parents), 2))
    at = int(rng.integers(len(owner)))
    child = owner[at]
    how = int(rng.integers(0, 4))
    if how == 0:
        owner.remove(child)
    elif how == 1:
        owner.insert(at, copy.deepcopy(child))
    elif how == 2:
        # Kept small: a copy of a subtree inside itself may double the file.
        if sum(1 for _ in child.iter()) < 200:
            target.append(copy.deepcopy(child))
    elif target not in list(child.iter()):
        owner.remove(child)
        target.append(child)
    return ET.tostring(root)
