"""What is drawn is where the engines say it is, on a page that loads nothing and changes no number."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import os
import re
import struct
import threading
import zlib
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from PIL import Image

import mbkit as mb
from mbkit.errors import InputError, MbkitWarning, OutputError, UnsupportedError
from mbkit.load import shapes as solids
from mbkit.model.description import body_poses
from mbkit.show import Scene, meshes, shapes_of, view
from mbkit.show.meshes import _by_coal, read_surfaces, solid, thinned
from tests.random_trees import IN_MUJOCO, random_tree

EPS = np.finfo(float).eps
DAE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.01"/></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="c"><phong><diffuse><color>1 0.5 0 1</color></diffuse>
</phong></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh><source id="s"><float_array id="f" count="12">
0 0 0 1 0 0 0 1 0 0 0 1</float_array>
<technique_common><accessor source="#f" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
<polylist count="2" material="k"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#s" offset="1"/>
<vcount>3 4</vcount><p>0 0 1 0 2 0 0 0 1 0 3 0 2 0</p></polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node><translate>100 0 0</translate><scale>2 2 2</scale>
<instance_geometry url="#g"><bind_material><instance_material symbol="k" target="#m"/></bind_material>
</instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#w"/></scene></COLLADA>"""
OBJ = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl red\nf 1 2 3\nusemtl none\nf 1/1 2/2 -1/3 3\n"
ARM = """<robot name="arm"><material name="blue"><color rgba="0 0 1 1"/></material><link name="base"><visual>
<geometry><box size="0.2 0.2 0.1"/></geometry><material name="blue"/></visual></link><link name="link">
<inertial><origin xyz="0 0 0.2"/><mass value="1"/><inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/>
</inertial>{visual}</link><joint name="j" type="revolute"><parent link="base"/><child link="link"/>
<origin xyz="0 0 0.05"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""
MESH = '<visual><origin xyz="0.1 0 0" rpy="0 0.3 0"/><geometry><mesh filename="{}" scale="1 -1 1"/></geometry></visual>'
MJCF = """<mujoco model="m"><compiler angle="radian"/><asset>
<mesh name="tet" vertex="0 0 0 1 0 0 0 1 0 0 0 1" scale=".2 .2 .2"/><material name="green" rgba="0 1 0 1"/></asset>
<default><default class="look"><geom group="2" rgba="1 0 0 .5"/></default></default>
<worldbody><geom type="plane" size="1 1 1"/><body pos=".1 .2 .3" euler=".3 0 0">
<joint axis="0 1 0" pos="0 0 .1" ref=".2"/><joint type="slide" axis="1 0 0"/>
<geom class="look" type="capsule" fromto="0 0 0 .1 .2 .3" size=".02"/><frame pos="0 .1 0" euler="0 0 1">
<geom type="ellipsoid" size=".1 .2 .3" pos=".1 0 0" quat="1 2 3 4"/><body name="b"><joint type="ball" pos=".1 0 0"/>
<geom type="mesh" mesh="tet" pos="0 0 .2" euler=".1 .2 .3" material="green"/>
<geom type="box" size=".1 .1 .1" group="3"/></body></frame></body></worldbody></mujoco>"""


def volume(surface) -> float:
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6)


def urdf(folder: Path, visual: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(ARM.format(visual=visual))
    return path


def unpacked(page: str) -> tuple[dict, bytes]:
    (text,) = re.findall(r'<script type="application/json" id="scene">(.*?)</script>', page, flags=re.DOTALL)
    scene = json.loads(text)
    return scene, zlib.decompress(base64.b64decode(scene["data"]))


# Places


@pytest.mark.parametrize("seed", range(4))
def test_bodies_and_their_shapes_are_where_an_engine_has_them(seed: int) -> None:
    model = random_tree(seed, mimic=seed % 2 == 1)
    q, _ = model.random_state(seed, 3)
    dyn, t = mb.dynamics(model, "pinocchio"), np.arange(3.0)
    poses, scene = body_poses(model, q), Scene.of(model, q, t, "sticks", 10_000)
    up = -model.gravity / np.linalg.norm(model.gravity)
    turn = scene.rotations[:, 0]
    np.testing.assert_allclose(turn @ up, np.tile([0, 0, 1], (3, 1)), atol=20 * EPS)
    # Rounding grows with the joints between, and with the distance.
    reach = 1 + max(np.abs(p).max() for _, p in poses.values())
    for k in range(3):
        R_WS, p_WS = scene.placements(k)
        for body in model.bodies:
            X = dyn.pose(q[k], body.name)
            np.testing.assert_allclose(poses[body.name][0][k], X[:3, :3], atol=200 * EPS)
            np.testing.assert_allclose(poses[body.name][1][k], X[:3, 3], atol=200 * EPS * reach)
        for shape, R, p in zip(scene.shapes, R_WS, p_WS, strict=True):
            X = dyn.pose(q[k], shape.body)
            np.testing.assert_allclose(R, turn[k] @ X[:3, :3] @ shape.rotation, atol=200 * EPS)
            at = X[:3, :3] @ shape.translation + X[:3, 3]
            np.testing.assert_allclose(p, turn[k] @ at, atol=200 * EPS * reach)
    assert {body.name for body in model.bodies} == {shape.body for shape in scene.shapes}


def test_the_visuals_of_a_urdf_are_where_pinocchio_places_them() -> None:
    model = mb.load("bolt", floating_base=True)
    shapes, parts = shapes_of(model), Path(model.source).parts
    folders = str(Path(*parts[: parts.index("example-robot-data")]))
    m = pin.buildModelFromUrdf(model.source, pin.JointModelFreeFlyer())
    theirs = pin.buildGeomFromUrdf(m, model.source, pin.VISUAL, package_dirs=folders)
    places = theirs.createData()
    q, _ = model.random_state(0)
    pin.updateGeometryPlacements(m, m.createData(), theirs, places, q)
    R, p = Scene.of(model, q[None], np.zeros(1), "visual", 10_000).placements(0)
    assert theirs.ngeoms == len(shapes) == 9
    for shape, R_WS, p_WS in zip(shapes, R, p, strict=True):
        place = places.oMg[theirs.getGeometryId(f"{shape.name}_0")]
        np.testing.assert_allclose(R_WS, place.rotation, atol=50 * EPS)
        np.testing.assert_allclose(p_WS, place.translation, atol=50 * EPS)


def test_the_geoms_of_an_mjcf_are_where_mujoco_has_them(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(MJCF)
    model, raw = mb.load(path), mujoco.MjModel.from_xml_string(MJCF)
    q, _ = model.random_state(3)
    data = mujoco.MjData(raw)
    data.qpos[:] = q[[0, 1, 5, 2, 3, 4]]
    mujoco.mj_kinematics(raw, data)
    scene = Scene.of(model, q[None], np.zeros(1), "visual", 10_000)
    shown = [k for k in range(1, raw.ngeom) if raw.geom_group[k] < 3]
    assert [s.kind for s in scene.shapes] == ["capsule", "ellipsoid", "mesh"]
    R, p = scene.placements(0)
    np.testing.assert_allclose(p, data.geom_xpos[shown], atol=50 * EPS)
    np.testing.assert_allclose(R.reshape(-1, 9), data.geom_xmat[shown], atol=50 * EPS)
    assert scene.shapes[0].color == (1, 0, 0, 0.5)
    np.testing.assert_allclose(volume(scene.shapes[2].surfaces[0]), 0.2**3 / 6, rtol=1e-6)
    # The last box is in a group that is hidden, and collides.
    assert [s.kind for s in shapes_of(model, "collision")] == ["capsule", "ellipsoid", "mesh", "box"]


# Triangles


@pytest.mark.parametrize("kind", solids.SIZES)
def test_a_solid_is_closed_and_has_its_volume(kind: str) -> None:
    size = (0.3, 0.5, 0.7)[: solids.SIZES[kind]]
    surface, exact = solid(kind, size), solids.solid(kind, size).mass
    # 32 sides lose 1 - sin(x)/x with x = 2π/32 of a circle, and about as much along the other way round.
    assert 0 <= 1 - volume(surface) / exact < (1e-12 if kind == "box" else 0.02)
    edges = np.sort(np.concatenate([surface.triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}


def test_fewer_triangles_keep_the_extent() -> None:
    fine = solid("ellipsoid", (0.3, 0.5, 0.7))
    many = [fine, solid("sphere", (0.2,))]
    assert [x is y for x, y in zip(thinned(many, 10_000), many, strict=True)] == [True, True]
    coarse = thinned(many, 500)
    assert sum(len(s.triangles) for s in coarse) <= 500
    for before, after in zip(many, coarse, strict=True):
        gap = np.linalg.norm(before.vertices[:, None] - after.vertices, axis=2).min(axis=1)
        assert gap.max() < 0.35 * np.ptp(before.vertices, axis=0).max()
    # Links that touch are drawn so.
    few = thinned(many, 300)[0]
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(few.vertices, axis=0), end(fine.vertices, axis=0), atol=4 * EPS)


def test_meshes_have_units_places_and_colours(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.dae").write_text(DAE)
    corners = np.eye(4)[:, 1:].astype("<f4")
    faces = [corners[list(f)] for f in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))]
    stl = b"".join(struct.pack("<12fH", *np.zeros(3), *f.ravel(), 0) for f in faces)
    (tmp_path / "a.stl").write_bytes(bytes(80) + struct.pack("<I", 4) + stl)
    red, plain = read_surfaces(tmp_path / "a.obj")
    assert (red.color, plain.color) == ((1, 0, 0, 1), None)
    assert (len(red.triangles), len(plain.triangles)) == (1, 2)
    (orange,) = read_surfaces(tmp_path / "a.dae")
    assert orange.color == (1, 0.5, 0, 1)
    np.testing.assert_allclose(orange.vertices[orange.triangles[0]], [[1, 0, 0], [1.02, 0, 0], [1, 0.02, 0]], atol=EPS)
    (tetrahedron,) = read_surfaces(tmp_path / "a.stl")
    np.testing.assert_allclose(volume(tetrahedron), 1 / 6, rtol=1e-6)


def test_meshes_that_share_a_node_keep_their_vertices(tmp_path: Path) -> None:
    """coal 3.0.3 gives the triangles of a node's second mesh the vertices of the first one."""
    two = DAE.replace("<instance_geometry", '<instance_geometry url="#g2"/><instance_geometry')
    second = re.search(r"<geometry id.*</geometry>", DAE, re.DOTALL)[0].replace(
        "1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0 9"
    )
    second = re.sub(r'(id="|"#)([gsfv])"', r'\g<1>\g<2>2"', second)
    (tmp_path / "a.dae").write_text(two.replace("<library_geometries>", f"<library_geometries>{second}"))
    tall, low = read_surfaces(tmp_path / "a.dae")
    np.testing.assert_allclose([np.ptp(s.vertices[:, 2]) for s in (tall, low)], [0.18, 0.02], rtol=1e-12)
    assert (tall.color, low.color) == (None, (1, 0.5, 0, 1))
    with pytest.raises(ValueError, match="coal mixes up the meshes of a node"):
        _by_coal(tmp_path / "a.dae")


@pytest.mark.parametrize("suffix", ["dae", "obj", "stl"])
def test_a_broken_mesh_is_one_error(suffix: str, tmp_path: Path) -> None:
    text, rng = (
        {"dae": DAE, "obj": OBJ, "stl": "solid a\nfacet normal 0 0 1\nouter loop\n"}[suffix],
        np.random.default_rng(0),
    )
    path = tmp_path / f"a.{suffix}"
    for _ in range(60):
        letters = list(text[: rng.integers(len(text))] if rng.random() < 0.3 else text)
        for k in rng.integers(len(letters), size=4) if letters else ():
            letters[k] = str(rng.choice([*"0-9e</ \n", "1e400", "nan", "99999"]))
        path.write_text("".join(letters))
        try:
            surfaces = read_surfaces(path)
        except ValueError:
            continue
        assert all(np.isfinite(s.vertices).all() and s.triangles.max(initial=-1) < len(s.vertices) for s in surfaces)


#: 41 nodes with two of the node before in each, and a node in itself.
TWICE = "".join(f'<node id="n{k}">{2 * f"""<instance_node url="#n{k - 1}"/>"""}</node>' for k in range(1, 42))


@pytest.mark.parametrize(
    ("was", "now", "why"),
    [
        ("<node>", f'{TWICE}<node id="n0"/><node>', "more than 500000 elements in them"),
        ("<node>", '<node id="n"><instance_node url="#n"/>', "nested more than 250 deep"),
        ("<node>", 100_000 * "<node>", "nested more than 250 deep"),
        ("<p>0", "<p>1000000000", "vertices that are not there"),
        ("<p>0", "<p>99999999999999999999", "vertices that are not there"),
        ("<p>0", "<p>a", "'a'"),
        ("<vcount>3 4", f"<vcount>{2**63 - 1} {2**63 - 1}", "more corners than there are"),
        ("<vcount>3 4", f"<vcount>{2**62} {2**62} {2**62} {2**62}", "more corners than there are"),
        ("0 0 0 1 0 0 0 1", "0 nan 0 1 0 0 0 1", "not finite"),
        ("<scale>2", "<scale>1e400", "not finite"),
        ("0 0 0 1 0 0 0 1 0 0 0 1", " ", "no triangles in it"),
        ("<COLLADA", '<!DOCTYPE x [<!ENTITY a "1">]><COLLADA', "document type declaration"),
    ],
)
def test_a_short_file_takes_neither_time_nor_memory(was: str, now: str, why: str, tmp_path: Path) -> None:
    path = tmp_path / "a.dae"
    assert was in DAE
    path.write_text(DAE.replace(was, now, 1))
    with pytest.raises(ValueError, match=why):
        read_surfaces(path)


def test_colours_are_numbers_from_pictures_that_fit(tmp_path: Path, monkeypatch) -> None:
    """A colour that is not finite would leave an empty page, and a pipe keeps its reader waiting."""
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "a.png")
    os.mkfifo(tmp_path / "pipe.png")
    pipe = os.open(tmp_path / "pipe.png", os.O_RDWR)
    os.write(pipe, (tmp_path / "a.png").read_bytes())
    # Who opens it gets the picture, and fails below, instead of waiting for ever.
    end = threading.Timer(2, os.close, [pipe])
    end.start()
    given = {"Kd 1 0 0": (1, 0, 0, 1), "Kd nan 0 0": None, "map_Kd a.png": (1, 0, 0, 1), "map_Kd pipe.png": None}
    for text, color in given.items():
        (tmp_path / "a.mtl").write_text(f"newmtl red\n{text}\n")
        (tmp_path / "a.obj").write_text(OBJ.replace("f 1 2 3", "f 1 2 \\\n3"))
        assert [s.color for s in read_surfaces(tmp_path / "a.obj")] == ([color, None] if color else [None])
    texture = '<texture texture="i"/></diffuse>'
    for picture, color in (("a.png", (1, 0, 0, 1)), ("pipe.png", None)):
        text = re.sub("<color>.*</diffuse>", texture, DAE).replace(
            "<library_materials>", f'<image id="i"><init_from>{picture}</init_from></image><library_materials>'
        )
        (tmp_path / "a.dae").write_text(text)
        assert read_surfaces(tmp_path / "a.dae")[0].color == color
    end.cancel()
    os.close(pipe)
    (tmp_path / "b.dae").write_text(DAE.replace("<color>1", "<color>inf"))
    assert read_surfaces(tmp_path / "b.dae")[0].color is None
    monkeypatch.setattr(meshes, "_MAX_TEXTURE_PIXELS", 15)
    (tmp_path / "a.dae").write_text(text.replace("pipe.png", "a.png"))
    assert read_surfaces(tmp_path / "a.dae")[0].color is None
    (tmp_path / "a.obj").write_text(OBJ + "".join(f"usemtl {k}\nf 1 2 3\n" for k in range(5000)))
    with pytest.raises(ValueError, match="more than 5000 materials"):
        read_surfaces(tmp_path / "a.obj")


def test_a_missing_mesh_is_told_once_and_drawn_as_sticks_and_boxes(tmp_path: Path) -> None:
    model = mb.load(urdf(tmp_path, MESH.format("package://nowhere/gone.stl") + MESH.format("also_gone.dae")))
    with pytest.warns(
        MbkitWarning, match=r"drawn as capsules and boxes: link \(no such file: package://nowhere"
    ) as told:
        shapes = shapes_of(model)
    assert len(told) == 1
    assert {(s.body, s.kind) for s in shapes} == {
        ("base", "box"),
        ("link", "capsule"),
        ("link", "box"),
        ("link", "sphere"),
    }
    assert shapes[0].color == (0, 0, 1, 1)
    (tmp_path / "arm.urdf").unlink()
    with pytest.warns(MbkitWarning, match="no such file") as told:
        assert {s.body for s in shapes_of(model)} == {"base", "link"}
    assert len(told) == 1


def test_a_mesh_is_found_beside_the_file_and_in_its_package(tmp_path: Path) -> None:
    folder = tmp_path / "bot" / "urdf"
    folder.mkdir(parents=True)
    (tmp_path / "bot" / "a.obj").write_text(OBJ)
    (folder / "a.obj").write_text(OBJ)
    for reference in ("package://bot/a.obj", "a.obj", f"file://{folder}/a.obj"):
        (shape,) = (s for s in shapes_of(mb.load(urdf(folder, MESH.format(reference)))) if s.kind == "mesh")
        assert shape.body == "link"
        np.testing.assert_allclose(shape.translation, [0.1, 0, 0])
        assert min(s.vertices[:, 1].min() for s in shape.surfaces) == -1


# Pages


def test_a_page_loads_nothing_and_holds_the_scene(tmp_path: Path) -> None:
    model = random_tree(7)
    q, _ = model.random_state(1, 4)
    shown = mb.show(model, q, tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text()
    assert page == shown.html == mb.show(model, q, tmp_path / "b.html").html
    assert not re.search(r"https?://|\bsrc=|\bhref=|@import|url\(", page)
    scene, block = unpacked(page)
    (script,) = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in page.partition("<title>")[0]
    own = shown.scene
    assert (scene["bodies"], len(scene["shapes"]), scene["t"]) == (list(own.bodies), len(own.shapes), [0, 1, 2, 3])
    poses = np.frombuffer(block, "<f4", 4 * len(own.bodies) * 7, scene["poses"]).reshape(4, -1, 7)
    np.testing.assert_allclose(poses[..., :3], own.translations, atol=1e-6 * np.abs(own.translations).max())
    for shape, written in zip(own.shapes, scene["shapes"], strict=True):
        g, (surface,) = scene["geometries"][written["geometry"]], shape.surfaces
        steps = np.frombuffer(block, "<u2", 3 * g["vertices"][1], g["vertices"][0]).reshape(-1, 3)
        near = np.ptp(surface.vertices) / 65535
        np.testing.assert_allclose(np.array(g["low"]) + steps * g["step"], surface.vertices, atol=near)
        jumps = np.frombuffer(block, "<i4", 3 * g["triangles"][1], g["triangles"][0])
        assert np.array_equal(np.cumsum(jumps).reshape(-1, 3), surface.triangles)


def test_without_a_display_the_path_is_told(monkeypatch, capsys) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(view.sys, "platform", "linux")
    model = mb.catalog.pendulum()
    shown = mb.show(model)
    assert f"open {shown.path} in a browser" in capsys.readouterr().err
    assert "<canvas" in shown.path.read_text()
    shown.path.unlink()
    monkeypatch.setattr(view, "_in_notebook", lambda: True)
    shown = mb.show(model)
    assert shown.path is None
    assert shown._repr_html_().startswith("<iframe srcdoc=")


def test_a_motion_has_its_states_on_the_page_and_its_frames_in_a_film(tmp_path: Path) -> None:
    model = mb.catalog.double_pendulum()
    dyn = mb.dynamics(model, "pinocchio")
    run = mb.simulate(dyn, [[1.5, 1.0], [0.2, 0.1]], [[0.0, 0.0]] * 2, 0.5, "rk4", dt=1e-3)
    shown = run.animate(tmp_path / "a.html", member=1)
    assert 30 <= len(shown.scene.t) <= 31
    poses = body_poses(model, run.q[1])
    which = np.searchsorted(run.t, shown.scene.t)
    np.testing.assert_array_equal(shown.scene.translations[:, 2], poses[model.bodies[1].name][1][which])
    run.animate(tmp_path / "a.gif", fps=4)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 3
    with pytest.raises(InputError, match="fps: expected a film of at most 20000 frames"):
        run.animate(tmp_path / "a.mp4", fps=1e300)
    run.animate(tmp_path / "a.PNG")
    with Image.open(tmp_path / "a.PNG") as picture:
        assert np.asarray(picture.convert("RGB")).std() > 5
    with pytest.raises(InputError, match="member: expected less than 2"):
        run.animate(member=2)
    broken = np.array(run.q[0])
    broken[100:] = np.nan
    assert (
        view.animate(model, broken, run.t, tmp_path / "b.html", shapes="sticks", triangles=99, fps=1).scene.t[-1] < 0.1
    )
    with pytest.raises(InputError, match="no state with finite numbers"):
        view.animate(model, broken[100:], run.t[100:], None, shapes="sticks", triangles=99, fps=1)


def test_runs_with_loops_are_drawn_with_their_description(tmp_path: Path) -> None:
    model = mb.catalog.slider_crank()
    lag = mb.lagrangian.from_model(model)
    run = mb.simulate(lag.dynamics(), *lag.project([0.5, -0.2, 1.3], [1.0, 0.0, 0.0]), 0.2, "rk4", dt=1e-2)
    with pytest.raises(UnsupportedError, match=r"has no bodies; .*animate\(model=\.\.\.\)"):
        run.animate(tmp_path / "a.html")
    with pytest.raises(UnsupportedError, match="written as energies"):
        mb.show(lag.model)
    scene = run.animate(tmp_path / "a.html", model=model).scene
    (loop,) = model.loops
    a, b = (scene.bodies.index(body) for body in (loop.body_a, loop.body_b))
    ends = [
        scene.translations[:, k] + scene.rotations[:, k] @ p
        for k, p in ((a, loop.translation_a), (b, loop.translation_b))
    ]
    # Closed as far as the run keeps its constraints.
    np.testing.assert_allclose(*ends, atol=1e-9)


def test_prescribed_coordinates_are_those_of_the_time(tmp_path: Path) -> None:
    b = mb.ModelBuilder("driven")
    for name, parent in (("crank", "world"), ("rod", "crank")):
        b.add_body(name, mass=1.0, com=(0, 0, 0.5), inertia=(0.1, 0.1, 0.01))
        b.add_joint(f"{name}_joint", "revolute", parent=parent, child=name, axis=(0, 1, 0), translation=(0, 0, 1))
    b.prescribe("crank_joint", offset=0.1, rate=2.0, amplitude=0.5, frequency=3.0, phase=0.2)
    model, t = b.build(), np.array([0.0, 0.7])
    q = np.column_stack([0.1 + 2.0 * t + 0.5 * np.sin(3.0 * t + 0.2), [0.3, 0.4]])
    given = {"shapes": "sticks", "triangles": 99, "fps": 1.0}
    whole, part = (view.animate(model, x, t, tmp_path / "a.html", **given).scene for x in (q, q[:, 1:]))
    np.testing.assert_array_equal(whole.rotations, part.rotations)
    with pytest.raises(InputError, match="q: expected shape"):
        view.animate(model, q[:, :0], t, tmp_path / "a.html", **given)


def test_bad_input_is_named(tmp_path: Path, monkeypatch) -> None:
    model = mb.catalog.pendulum()
    for wrong, match in (
        ({"path": tmp_path / "a.avi"}, r"path: expected a name that ends in .html, .png, .gif, .mp4, got"),
        ({"path": tmp_path / "a.html", "shapes": "meshes"}, "shapes: expected one of visual, collision, sticks"),
        ({"path": tmp_path / "a.html", "triangles": 0}, "triangles: expected a whole number of at least 1"),
        ({"q": [0.1, 0.2]}, "q: expected shape"),
        ({"q": np.zeros((2001, 1))}, "q: expected at most 2000 configurations, got 2001"),
    ):
        with pytest.raises(InputError, match=match):
            mb.show(model, **wrong)
    with pytest.raises(InputError, match=r"expected a Model or a path, got 3; a trajectory has animate"):
        mb.show(3)
    for name in ("a.html", "a.png"):
        with pytest.raises(OutputError, match="choose a folder that exists"):
            mb.show(model, path=tmp_path / "nowhere" / name)
    with pytest.raises(InputError, match="no value for parameter"):
        mb.show(mb.catalog.pendulum(length=mb.Parameter("l")))
    monkeypatch.setattr("matplotlib.animation.writers.is_available", lambda _: False)
    with pytest.raises(UnsupportedError, match="MP4 needs ffmpeg, which is not installed"):
        mb.show(model, path=tmp_path / "a.mp4")


# What engines hold


@pytest.mark.parametrize("seed", range(3))
def test_frames_of_pinocchio_are_those_of_the_model_and_change_no_bit(seed: int) -> None:
    model = mb.load("panda") if seed == 0 else random_tree(seed)
    dyn = mb.dynamics(model, "pinocchio")
    bare = mb.dynamics(dataclasses.replace(model, frames=()), "pinocchio")
    m, data = dyn.pin_model, dyn.pin_model.createData()
    names = {b.name for b in model.bodies} | {f.name for f in model.frames}
    assert m.nframes == 1 + len(names)
    q, v = model.random_state(seed)
    pin.framesForwardKinematics(m, data, dyn._full_q(q))
    for name in names:
        np.testing.assert_allclose(data.oMf[m.getFrameId(name)].homogeneous, dyn.pose(q, name), atol=50 * EPS)
    assert bare.pin_model.nframes <= m.nframes
    for quantity in ("inverse_dynamics", "forward_dynamics"):
        assert np.array_equal(getattr(dyn, quantity)(q, v, v), getattr(bare, quantity)(q, v, v))
    assert np.array_equal(dyn.mass_matrix(q), bare.mass_matrix(q))


@pytest.mark.parametrize("source", ["tree", "double_pendulum"])
def test_shapes_of_mujoco_change_no_bit(source: str) -> None:
    model = random_tree(2, kinds=IN_MUJOCO, armature=False, damping=False) if source == "tree" else mb.load(source)
    dyn = mb.dynamics(model, "mujoco")
    shown, plain = dyn.visual_model(), dyn.mj_model
    assert (plain.ngeom, plain.nsite) == (0, len(plain.tendon_length0) * 2)
    # Of a mesh there is a geom a colour; none of them weighs anything or meets another.
    assert shown.ngeom >= len({s.body for s in shapes_of(model)})
    assert not shown.geom_contype.any()
    assert not shown.geom_conaffinity.any()
    assert set(shown.geom_group) == {2}
    assert shown.nsite == plain.nsite + len(model.frames)
    rng = np.random.default_rng(0)
    for _ in range(3):
        one, other = mujoco.MjData(plain), mujoco.MjData(shown)
        one.qvel[:] = rng.standard_normal(plain.nv)
        mujoco.mj_integratePos(plain, one.qpos, one.qvel, 0.5)
        other.qpos[:], other.qvel[:] = one.qpos, one.qvel
        mujoco.mj_forward(plain, one)
        mujoco.mj_forward(shown, other)
        for name in ("qacc", "qfrc_bias", "qfrc_passive", "xpos", "cinert"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_pinocchio_places_the_shapes_and_other_engines_say_that_they_have_none() -> None:
    model = mb.load("double_pendulum")
    dyn, shapes = mb.dynamics(model, "pinocchio"), shapes_of(model)
    q, _ = model.random_state(0)
    geometry = dyn.visual_model()
    data, places = dyn.pin_model.createData(), geometry.createData()
    pin.updateGeometryPlacements(dyn.pin_model, data, geometry, places, q)
    owners = [s for s in shapes for _ in s.surfaces]
    assert geometry.ngeoms == len(owners)
    for shape, place in zip(owners, places.oMg, strict=True):
        X = dyn.pose(q, shape.body)
        np.testing.assert_allclose(place.translation, X[:3, :3] @ shape.translation + X[:3, 3], atol=50 * EPS)
    with pytest.raises(UnsupportedError, match=r"lagrangian: no viewer .* mbkit\.show has one"):
        mb.dynamics(mb.catalog.pendulum(), "lagrangian").visual_model()


def test_a_path_or_a_name_is_shown_as_its_model_is(tmp_path):
    file = mb.robots()[0].path
    by_path, by_name = (mb.show(x, path=tmp_path / "page.html").scene for x in (file, mb.robots()[0].name))
    model = mb.load(file, nonphysical="warn")
    assert by_path.bodies == by_name.bodies == mb.show(model, path=tmp_path / "page.html").scene.bodies
