"""A robot written over several MJCF files is the one that MuJoCo reads, and nothing else is opened."""

# ruff: noqa: E501 -- a description is easier to read on one line
from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

import mbkit as mb
from mbkit.errors import LoadError, MbkitError, ModelError
from mbkit.load.sanitized_text import strip

DEFAULTS = '<default><joint damping="0.2" armature="0.01"/><geom density="700"/><default class="light"><geom density="300"/></default></default>'
ASSETS = (
    '<asset><texture name="t" type="2d" builtin="flat" width="4" height="4"/><material name="m" texture="t"/></asset>'
)
HAND = '<body name="hand" pos="0.2 0 0.01"><joint name="wrist" axis="1 0 0"/><geom class="light" type="sphere" size="0.04" pos="0 0.02 0" material="m"/></body>'
FOREARM = '<body name="forearm" pos="0.3 0 0" quat="0.9 0.1 0.2 0.3"><joint name="elbow" axis="0 0 1" pos="0.01 0 0" ref="20"/><geom type="box" size="0.1 0.02 0.03" pos="0.1 0 0"/>{}</body>'
UPPER = '<body name="upper" euler="0 30 0"><joint name="shoulder" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>{}</body>'
HEAD = '<compiler angle="degree"/><option gravity="0 0.1 -9.8"/>'


def files(folder: Path, **content: str) -> Path:
    """Write files, `_` for a dot and `__` for a folder, and return main.xml."""
    for name, text in content.items():
        path = folder / (name.replace("__", "/") + ".xml")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder / "main.xml"


def inside(text: str) -> str:
    return f"<mujocoinclude>{text}</mujocoinclude>"


def include(name: str) -> str:
    return f'<include file="{name}"/>'


def body(name: str) -> str:
    return f'<body name="{name}"><joint name="j{name}"/><geom size="0.1"/></body>'


def world(text: str) -> str:
    return f"<mujoco><worldbody>{text}</worldbody></mujoco>"


@pytest.fixture
def split(tmp_path: Path) -> Path:
    # The defaults are read from below, the assets from beside, the hand by the forearm's own folder.
    return files(
        tmp_path,
        main=f'<mujoco model="arm">{HEAD}{include("common/settings.xml")}<worldbody>{UPPER.format(include("parts/forearm.xml"))}</worldbody></mujoco>',
        common__settings=f'<mujoco model="another">{DEFAULTS}{include("common/assets.xml")}</mujoco>',
        common__assets=inside(ASSETS),
        parts__forearm=inside("\n\n" + FOREARM.format(include("more\\hand.xml"))),
        parts__more__hand=inside(HAND),
    )


def test_importers_are_given_what_is_included(split: Path) -> None:
    result = mb.compare_parsers(split, importers=("mujoco",))
    assert result.importers[0].agrees
    assert "<include" not in strip(split).text


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ({"main": world(include("s/a.xml")), "s__a": inside(include("b.xml")), "b": inside(body("near_main")), "s__b": inside(body("near_a"))}, ["near_main"]),
        ({"main": world(include("s/x.xml") + include("t/x.xml")), "s__x": inside(include("y.xml")), "t__x": inside(include("y.xml")), "s__y": inside(body("s")), "t__y": inside(body("t"))}, ["s", "t"]),
        ({"main": f"<mujoco><worldbody>{body('z')}</worldbody>{include('a.xml')}</mujoco>", "a": f"<mujoco><default><geom mass='7'/></default><worldbody>{body('a')}</worldbody></mujoco>"}, ["z", "a"]),
        ({"main": world(include("../a.xml")), "../a": inside(body("above"))}, ["above"]),
    ],
    ids=["beside_main_first", "same_name_elsewhere", "sections_again", "above"],
)  # fmt: skip
def test_files_are_found_and_placed_as_mujoco_does(content: dict[str, str], names: list[str], tmp_path: Path) -> None:
    path = files(tmp_path / "here", **content)
    m = mujoco.MjModel.from_xml_path(str(path))
    model = mb.load(path)
    assert [b.name for b in model.bodies] == names == [m.body(i).name for i in range(1, m.nbody)]
    assert [b.mass for b in model.bodies] == pytest.approx(list(m.body_mass[1:]), rel=1e-14)
    # Only what stands above the file's folder is said to be outside.
    assert any("outside" in note for note in model.notes) == any(name.startswith("..") for name in content)


@pytest.mark.parametrize(
    "text",
    ["hunter2: x\n", "<hunter2/>", "<vault><key>hunter2 & more</key></vault>", "<vault>\n  <key>hunter2</vault>"],
)
def test_text_of_a_file_that_is_no_description_is_not_quoted(text: str, tmp_path: Path) -> None:
    main = files(tmp_path / "here", main=world(include("../kept.txt")))
    (tmp_path / "kept.txt").write_text(text, encoding="utf-8")
    with pytest.raises(MbkitError) as error:
        mb.load(main)
    assert "kept.txt" in str(error.value)
    assert "hunter2" not in str(error.value)


WRONG = {
    "missing": ({"main": world(include("s/a.xml")), "s__a": inside("\n\n" + include("b.xml"))}, "s/a.xml, line 3: <include file=\"b.xml\">: no such file in .* or .*s"),
    "twice": ({"main": world(include("a.xml") + include("./a.xml")), "a": inside("<geom size='1'/>")}, "line 1: <include file=\"./a.xml\">: was included before"),
    "itself": ({"main": world(include("main.xml"))}, "includes itself"),
    "cycle": ({"main": world(include("s/a.xml")), "s__a": inside(include("b.xml")), "s__b": inside(include("s/a.xml"))}, "s/b.xml, line 1: .*included before"),
    "empty": ({"main": world(include("a.xml")), "a": "<x/>"}, "its root element is empty"),
    "doctype": ({"main": world(include("a.xml")), "a": "<!DOCTYPE x []><x/>"}, "DOCTYPE"),
    "no_name": ({"main": world("<include/>")}, "line 1: <include>: no file"),
    "not_empty": ({"main": world('<include file="a.xml"><geom/></include>'), "a": inside(body("a"))}, "elements of its own"),
    "too_long": ({"main": world(include("a" * 5000))}, "cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_included_is_told(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content, told = WRONG[case]
    # MuJoCo writes its log into the working folder.
    monkeypatch.chdir(tmp_path)
    path = files(tmp_path, **content)
    for read in (mb.load, strip):
        with pytest.raises(LoadError, match=told) as caught:
            read(path)
        assert str(caught.value).startswith(str(path))
    # MuJoCo does not read any of them either.
    with pytest.raises(ValueError, match="XML"):
        mujoco.MjModel.from_xml_path(str(path))


def test_an_absolute_path_is_refused_and_nothing_of_it_told(tmp_path: Path) -> None:
    (tmp_path / "secret.xml").write_text(inside(body("secret")), encoding="utf-8")
    path = files(tmp_path / "r", main=world(include(str(tmp_path / "secret.xml"))))
    with pytest.raises(LoadError, match="an absolute path is not followed"):
        mb.load(path)


def test_faults_name_the_file_that_they_are_in(tmp_path: Path) -> None:
    bad = inside('\n<body name="a"><joint name="j" axis="0 0 0"/>\n<geom size="many"/></body>')
    path = files(tmp_path, main=world(include("s/a.xml") + "\n" + '<body childclass="none"/>'), s__a=bad)
    with pytest.raises(ModelError) as caught:
        mb.load(path)
    told = " ".join(caught.value.faults)
    assert "axis is zero; expected a direction, such as 0 0 1 (s/a.xml, line 2)" in told
    assert "(s/a.xml, line 3)" in told
    assert "unknown default class 'none'; there are: main (line 2)" in told


def test_levels_and_bytes_are_bounded_over_all_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = {f"f{k}": inside("<body>" * 100 + include(f"f{k + 1}.xml") + "</body>" * 100) for k in range(3)}
    path = files(tmp_path, main=world(include("f0.xml")), **deep, f3=inside(body("a")))
    with pytest.raises(LoadError, match=r"f2\.xml, line 1: .*nested more than 250 deep"):
        mb.load(path)
    chain = {f"c{k}": inside(include(f"c{k + 1}.xml")) for k in range(300)}
    with pytest.raises(LoadError, match="nested more than 250 deep"):
        mb.load(files(tmp_path, main=world(include("c0.xml")), **chain))
    path = files(tmp_path, main=world(include("f0.xml")))
    monkeypatch.setattr("mbkit.load.xml_reader.MAX_FILE_BYTES", 3000)
    with pytest.raises(MbkitError, match="up to 3000 bytes of included files"):
        mb.load(path)
