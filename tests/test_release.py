"""What a release needs: one version everywhere, and every file of results made by a part of `python -m validation`."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import mbkit as mb
from validation.__main__ import PARTS
from validation.stamp import stamp

TOP = Path(__file__).parent.parent
PAGES = sorted((TOP / "notebooks").glob("*/*.md"))


def read(name: str) -> str:
    return (TOP / name).read_text(encoding="utf-8")


def test_the_version_is_the_same_everywhere():
    changes = re.findall(r"^## (\d+\.\d+\.\d+) - (unreleased|\d{4}-\d\d-\d\d)$", read("CHANGELOG.md"), re.MULTILINE)
    assert changes[0][0] == mb.__version__
    assert len({version for version, _ in changes}) == len(changes)
    cited = dict(re.findall(r"^([\w-]+): (.+)$", read("CITATION.cff"), re.MULTILINE))
    assert cited["version"] == mb.__version__
    assert cited["cff-version"] == "1.2.0"
    project = tomllib.loads(read("pyproject.toml"))
    assert cited["license"] == project["project"]["license"]
    packed = project["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert all((TOP / name).exists() for name in packed)
    assert {"CHANGELOG.md", "CITATION.cff"} <= set(packed)


def test_the_top_level_holds_what_a_newcomer_looks_for_and_no_more():
    folders = {"mbkit", "notebooks", "tests", "validation"}
    files = {"CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md", "pyproject.toml"}
    passing = [line.rstrip("/") for line in read(".gitignore").split()]
    found = {path.name for path in TOP.iterdir() if not path.name.startswith(".")}
    assert {name for name in found if not any(map(Path(name).match, passing))} == folders | files


def test_every_file_of_results_is_made_by_a_part():
    written = {name for part in PARTS.values() for name in part.writes}
    kept = {path.name for path in (TOP / "validation").glob("*.json")}
    # What was published elsewhere is measured by nobody here.
    assert written == kept - {"published.json"}
    assert all((TOP / "validation" / f"{name}.py").exists() for name in PARTS)


def test_pages_name_files_and_parts_that_exist():
    text = "\n".join(path.read_text(encoding="utf-8") for path in PAGES)
    assert {f"{name}.json" for name in re.findall(r"(?<!\.)\bload\(\"(\w+)\"\)", text)} <= {
        path.name for path in (TOP / "validation").glob("*.json")
    }
    assert set(re.findall(r"\borigin\(\w+, \"(\w+)\"\)", text)) <= set(PARTS)
    # Each file is shown somewhere with its day, processor and versions.
    assert set(re.findall(r"\borigin\(\w+, \"(\w+)\"\)", text)) == {name for name, part in PARTS.items() if part.writes}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_each_file_that_a_page_shows_has_its_caption_there(page):
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"json\.loads\(.*validation", text), "validation.pages.load reads it"
    shown = dict(re.findall(r"^(\w+) = load\(\"(\w+)\"\)$", text, re.MULTILINE))
    # What was published elsewhere was measured by nobody here.
    bare = {
        name for name in shown if shown[name] != "published" and not re.search(rf"(origin|under)\(.*\b{name}\b", text)
    }
    assert not bare, f"no origin(...) of {bare}"


def test_versions_that_the_page_explains_are_those_of_the_record():
    """Where a span begins or ends, a number of that engine changed, or the record does."""
    engines = json.loads(read("validation/versions.json"))["engines"]
    text = read("notebooks/numbers/versions.md").partition("## Why they changed")[2].partition("\n## ")[0]
    # The longest name first: MuJoCo Warp is an engine of its own.
    names = "|".join(sorted((name.replace("-", " ") for name in engines), key=len, reverse=True))
    rows = re.findall(rf"^\| ({names})\b([^|]*)\|", text, re.MULTILINE | re.IGNORECASE)
    assert {engine.lower().replace(" ", "-") for engine, _ in rows} == set(engines)
    for engine, spans in rows:
        found = engines[engine.lower().replace(" ", "-")]
        ends = {
            found["measured"][0],
            found["measured"][-1],
            *(c[k] for c in found["changes"] for k in ("before", "version")),
        }
        assert set(re.findall(r"\d+\.\d+[.\d]*", spans)) <= ends, (engine, spans)


def test_parts_are_listed_and_chosen_by_name():
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "validation", *arguments]
        return subprocess.run(command, cwd=TOP, capture_output=True, text=True, check=False)

    listed = run("--list")
    assert listed.returncode == 0
    assert [line.split()[0] for line in listed.stdout.splitlines()] == list(PARTS)
    unknown = run("nothing")
    assert unknown.returncode == 2
    assert "accuracy" in unknown.stderr


def test_results_are_stamped():
    told = json.loads(json.dumps(stamp("accuracy.py")))
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", told["date"])
    assert told["versions"]["mbkit"] == mb.__version__
    assert told["processor"]


def test_the_map_leads_somewhere():
    places = re.findall(r"`([\w/]+(?:\.py|/))`", read("notebooks/carry_on/map.md"))
    assert len(places) > 10
    assert [place for place in places if not ((TOP / "mbkit" / place).exists() or (TOP / place).exists())] == []
