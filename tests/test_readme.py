"""The README tells the truth: its code runs, and its commands do what they say."""

from __future__ import annotations

import json
import re
import statistics
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from mbkit.cli import cli

TOP = Path(__file__).parent.parent
TEXT = (TOP / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", TEXT, flags=re.M | re.S)


def test_python_blocks_run_in_their_order(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = [code for language, code in BLOCKS if language == "python"]
    assert blocks
    names: dict[str, object] = {"__name__": "__main__"}
    for code in blocks:
        exec(compile(code, "README.md", "exec"), names)


COMMANDS = [
    line.removeprefix("$ ").split("#")[0].split()
    for language, code in BLOCKS
    if language == "console"
    for line in code.splitlines()
    if line.startswith("$ mbkit")
]


#: Run from a cold start in test_cli, and there looked at more closely.
ELSEWHERE = (["mbkit", "check", "panda"],)


@pytest.mark.parametrize("command", [c for c in COMMANDS if "--all" not in c and c not in ELSEWHERE], ids=" ".join)
def test_commands_end_well(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli, command[1:])
    assert result.exit_code == 0, result.output


def test_the_set_up_names_what_the_package_declares():
    project = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    setup = [line for language, code in BLOCKS if language == "sh" for line in code.splitlines()]
    assert any("mbkit check panda" in line for line in setup)
    extras = {e for line in setup for group in re.findall(r"\[(\w[\w,]*)\]", line) for e in group.split(",")}
    assert extras <= set(project["optional-dependencies"])


def test_every_dependency_is_given_a_reason():
    project = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for requirement in project["dependencies"]:
        name = re.match(r"[\w-]+", requirement)
        assert name
        assert f"`{name.group()}`" in TEXT, requirement


def test_the_cost_of_the_checks_is_the_measured_one():
    cost = json.loads((TOP / "validation" / "checks_cost.json").read_text(encoding="utf-8"))
    ratios = [row["ratio"] - 1 for row in cost["rows"]]
    median, largest = statistics.median(ratios), max(ratios)
    sentence = (
        f"Of {len(ratios)} measured compiled runs these checks take {100 * median:.0f} % in the median "
        f"and {100 * largest:.0f} % at most"
    )
    assert sentence in TEXT


def test_what_auto_reaches_is_the_measured_one():
    auto = json.loads((TOP / "validation" / "auto.json").read_text(encoding="utf-8"))
    ended = [row for row in auto["rows"] if row["auto"]["ratio"] is not None]
    own = [row["auto"]["ratio"] for row in ended if row["engine"] == "lagrangian"]
    error = max(row["auto"]["error"] for row in ended)
    sentence = (
        f"is at most {error:.1e} on each of the {len(ended)} where any method gets there in the time allowed, "
        f"its time within 3 times the best's on {auto['within_3']} of them "
        f"(on the own derivation {sum(x <= 3 for x in own)} of {len(own)}, {max(own):.1f} at the most), "
        f"{auto['median']:.1f} times in the median and {auto['largest']:.1f} times at the most."
    )
    assert sentence in TEXT


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
