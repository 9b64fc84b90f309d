"""Robots of the package robot_descriptions, by name, from its cache; a stand-in for the package that never clones."""

import socket
import sys

import pytest

import mbkit as mb
from mbkit.errors import LoadError, UnknownNameError

URDF = """<robot name="wheel"><link name="base"/><link name="wheel"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="axle" type="continuous">
<parent link="base"/><child link="wheel"/><axis xyz="0 1 0"/></joint></robot>"""
MJCF = """<mujoco><worldbody><body name="arm"><joint name="hinge"/><geom size="0.1"/></body></worldbody></mujoco>"""
#: A module of robot_descriptions, as its version 3.3.0 writes them.
MODULE = '''"""A robot."""

from os import getenv as _getenv
from os import path as _path

from ._cache import clone_to_cache as _clone_to_cache

REPOSITORY_PATH: str = _clone_to_cache("wheels", commit=_getenv("ROBOT_DESCRIPTION_COMMIT", None))

PACKAGE_PATH: str = _path.join(REPOSITORY_PATH, "wheel")

{kind}_PATH: str = _path.join(PACKAGE_PATH, "{file}")
'''
REPOSITORIES = """from types import SimpleNamespace
REPOSITORIES = {"wheels": SimpleNamespace(cache_path="wheels_here", commit="1", url="https://nowhere.invalid/w.git")}
"""


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Install the package and return its empty cache."""
    package = tmp_path / "packages" / "robot_descriptions"
    package.mkdir(parents=True)
    files = {
        "__init__": "",
        "_repositories": REPOSITORIES,
        "_cache": "raise AssertionError('the module that clones was imported')",
        "_empty_description": "",
        "wheel_description": MODULE.format(kind="URDF", file="wheel.urdf"),
        "arm_mj_description": MODULE.format(kind="MJCF", file="arm.xml"),
        "made_description": MODULE.format(kind="XACRO", file="made.urdf.xacro"),
        "mended_description": MODULE.format(kind="URDF", file="wheel.urdf") + "open(URDF_PATH).close()\n",
    }
    for name, text in files.items():
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(package.parent)
    for name in [x for x in sys.modules if x.startswith("robot_descriptions")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("ROBOT_DESCRIPTION_COMMIT", raising=False)

    def no_network(*_args, **_kwargs):
        raise AssertionError("the network was used")

    monkeypatch.setattr(socket.socket, "connect", no_network)
    yield tmp_path / "cache"
    for name in [x for x in sys.modules if x.startswith("robot_descriptions")]:
        del sys.modules[name]


def fill(cache, folder="wheels_here"):
    there = cache / folder / "wheel"
    there.mkdir(parents=True)
    for name, text in (("wheel.urdf", URDF), ("arm.xml", MJCF), ("made.urdf.xacro", URDF)):
        (there / name).write_text(text)
    return there


def test_a_robot_is_read_from_the_cache(cache, monkeypatch):
    there = fill(cache)
    robot = mb.load("wheel_description")
    assert robot == mb.load(there / "wheel.urdf")
    assert robot.source == str(there / "wheel.urdf")
    assert mb.load("Wheel-Description") == robot
    assert mb.load("mended_description") == robot
    assert mb.load("arm_mj_description").joint_names == ("hinge",)
    monkeypatch.setenv("ROBOT_DESCRIPTION_COMMIT", "abc")
    other = fill(cache, "wheels_here-abc/wheels_here")
    assert mb.load("wheel_description").source == str(other / "wheel.urdf")


@pytest.mark.parametrize("name", ["wheel_description", "arm_mj_description", "mended_description", "made_description"])
def test_what_is_not_in_the_cache_is_said_with_the_command_that_fetches_it(cache, name):
    with pytest.raises(LoadError) as told:
        mb.load(name)
    assert str(cache) in str(told.value)
    assert f"`python -m robot_descriptions pull {name}`" in str(told.value)


def test_a_robot_made_by_xacro_is_told(cache):
    fill(cache)
    with pytest.raises(LoadError, match="by xacro; `python -m robot_descriptions pull made_description` prints"):
        mb.load("made_description")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("whel_description", "did you mean 'wheel_description'"),
        ("../wheel_description", "unknown robot"),
        ("_empty_description", "unknown robot"),
    ],
)
@pytest.mark.usefixtures("cache")
def test_other_names_are_unknown(name, words):
    with pytest.raises(UnknownNameError, match=words):
        mb.load(name)


def test_without_the_package_it_is_named(monkeypatch):
    monkeypatch.setattr(sys, "path", [x for x in sys.path if "robot_descriptions" not in x])
    with pytest.raises(UnknownNameError, match="names of robot_descriptions need that package"):
        mb.load("wheel_description")
