"""The README tells the truth: its code runs, its links lead somewhere, its numbers are the measured ones."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from mbkit.cli import cli

TOP = Path(__file__).parent.parent
TEXT = (TOP / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", TEXT, flags=re.M | re.S)
PROJECT = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))["project"]
#: Names of numbers in `validation/*.json` by the README's name of the engine.
ENGINES = {"The own derivation has": "lagrangian", "Pinocchio": "pinocchio", "MuJoCo": "mujoco"}


def kept(name):
    return json.loads((TOP / "validation" / f"{name}.json").read_text(encoding="utf-8"))


def test_it_is_short():
    assert len(TEXT.split()) <= 900
    tables = re.findall(r"(?:^\|.*\n)+", TEXT, flags=re.M)
    assert tables
    # A head and a line below it, then five rows.
    assert all(len(table.splitlines()) <= 7 for table in tables)


def test_python_blocks_run_in_their_order(tmp_path, monkeypatch):
    monkeypatch.setenv("MBKIT_COMPILE", "1")
    monkeypatch.chdir(tmp_path)
    blocks = [code for language, code in BLOCKS if language == "python"]
    assert len(blocks) == 3
    names: dict[str, object] = {"__name__": "__main__"}
    for code in blocks:
        exec(compile(code, "README.md", "exec"), names)


COMMANDS = re.findall(r"^\|.*\| `mbkit (.*?)` \|", TEXT, flags=re.M)
ARM = """<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0 0 0.15"/><mass value="2.3"/>
      <inertia ixx="0.02" iyy="0.02" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
</robot>
"""


@pytest.mark.thorough("check arm.urdf")
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_end_well(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(ARM)
    arguments = command.split()
    if arguments[0] == "check":
        # Whole in test_cli.
        arguments.append("--no-rollouts")
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output


def test_there_is_a_command_for_each_reader():
    assert [command.split()[0] for command in COMMANDS] == ["check", "derive", "baseline"]


def test_links_and_pictures_lead_to_files():
    links = re.findall(r"\]\((.*?)\)", TEXT) + re.findall(r'(?:src|srcset)="(.*?)"', TEXT)
    assert len(links) > 20
    assert [link for link in links if not (TOP / link).is_file()] == []


def test_every_page_for_beginners_and_every_how_to_is_linked():
    pages = [p for folder in ("start", "howto") for p in (TOP / "notebooks" / folder).glob("*.md")]
    wanted = {p.relative_to(TOP).as_posix() for p in pages if p.stem != "index"}
    assert len(wanted) > 30
    assert wanted <= set(re.findall(r"\]\((.*?)\)", TEXT))


def test_the_set_up_names_what_the_package_declares():
    setup = [line for language, code in BLOCKS if language == "sh" for line in code.splitlines()]
    assert any("mbkit check panda" in line for line in setup)
    extras = {e for line in setup for group in re.findall(r"\[(\w[\w,]*)\]", line) for e in group.split(",")}
    assert {"test", "book"} <= extras <= set(PROJECT["optional-dependencies"])


def test_install_gives_each_dependency_a_reason_and_each_extra_a_line():
    page = (TOP / "notebooks" / "start" / "install.md").read_text(encoding="utf-8")
    for requirement in PROJECT["dependencies"]:
        name = re.match(r"[\w-]+", requirement)
        assert name
        assert f"| `{name.group()}` | " in page, requirement
    for extra in PROJECT["optional-dependencies"]:
        assert f"| `{extra}` | " in page
    assert "```sh\npython3 -m venv .venv && .venv/bin/pip install -e . && .venv/bin/mbkit check panda\n```" in page


def test_the_pictures_numbers_are_the_measured_ones():
    compared = [row["worst"] for row in kept("check_all")["robots"] if "worst" in row]
    assert f"Right digits of {len(compared)} robots" in TEXT
    assert f"for {len(compared)} robots of example-robot-data" in TEXT
    for name, engine in ENGINES.items():
        errors = sorted((worst[engine][0] for worst in compared if engine in worst), reverse=True)
        if engine == "mujoco":
            assert f"MuJoCo takes {len(errors)} of them" in TEXT
            assert f"but for one robot with {-math.log10(errors[0]):.1f}" in TEXT
            assert f"The dot at {-math.log10(errors[0]):.1f}" in TEXT
            del errors[0]
        assert f"{name} {-math.log10(errors[0]):.1f} or more" in TEXT


def test_the_versions_of_the_faults_are_those_that_were_measured():
    versions = {"Pinocchio": kept("check_all")["versions"]["pin"], "MuJoCo": kept("check_all")["versions"]["mujoco"]}
    versions["Drake"] = kept("stress")["versions"]["drake"]
    named = re.findall(r"^\| (\w+) (\d[\d.]*) \|", TEXT, flags=re.M)
    assert len(named) == 5
    assert all(versions[engine] == version for engine, version in named)
    assert f"of {len(kept('importers')['robots'])} files" in TEXT


def test_no_file_for_others_tells_where_it_was_made():
    kinds = {".json", ".md", ".ipynb", ".html", ".svg", ".toml", ".csv"}
    files = [
        TOP / "README.md",
        *(f for part in ("validation", "notebooks", "tests") for f in (TOP / part).rglob("*")),
    ]
    files = [f for f in files if f.suffix in kinds]
    assert len(files) > 20
    place = re.compile(r"(?<![\w.])/(?:work|home|root|tmp|Users|usr|opt|var)/|site-packages")
    found = {f.name: m[0] for f in files if (m := place.search(f.read_text(encoding="utf-8")))}
    assert found == {}
