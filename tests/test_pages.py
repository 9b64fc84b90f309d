"""Pages as a browser, a screen reader, a phone and a printer have them."""

import base64
import hashlib
import html
import json
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest

from mbkit.report import page as pages
from mbkit.studies.compare.all_robots import drawn_robots
from mbkit.studies.importers.result import Parsed, ParserComparison, Stage
from mbkit.studies.work_precision.result import error_against_time
from tests import test_report as examples
from tests import test_stress_report as stress

STAGES = (Stage("joints", True, 0.0, "", ""), Stage("M", True, 2e-14, "j1", ""))
IMPORTERS = ParserComparison(
    source="arm.urdf",
    format="urdf",
    floating_base=False,
    reference="file",
    faults="",
    importers=tuple(Parsed(engine, "1.0", stages=STAGES) for engine in ("pinocchio", "mujoco")),
    notes=(),
    samples=3,
    seed=0,
    tolerance=1e-9,
    versions={"pin": "4.1.0"},
    processor="a processor",
    seconds=1.0,
)
PAGES = {
    "check": cache(lambda: examples.check_page(examples.AGREEING)),
    "differing": cache(lambda: examples.check_page(examples.DIFFERING)),
    "hostile": cache(lambda: examples.check_page(examples.NASTY)),
    "all": cache(lambda: examples.sweep_page(examples.ALL)),
    "bench": cache(lambda: examples.bench_page(examples.STUDY)),
    "importers": cache(lambda: pages.render(IMPORTERS.document())),
    "stress": cache(lambda: stress.stress_page(stress.RESULT)),
}


@pytest.mark.thorough("hostile", "differing")
@pytest.mark.parametrize("kind", PAGES)
def test_only_the_pages_own_script_may_run(kind: str) -> None:
    page = PAGES[kind]()
    (script,) = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'" in page
    assert not re.search(r"https?://|import|fetch|eval|innerHTML", script)


@pytest.mark.thorough("hostile")
@pytest.mark.parametrize("kind", PAGES)
def test_no_page_shows_a_value_as_python_writes_it(kind: str) -> None:
    text = examples.Tags(re.sub(r"<(style|script)>.*?</\1>", "", PAGES[kind](), flags=re.DOTALL)).text
    assert not re.search(r"\b(None|True|False|nan|inf)\b|\(\d[^()]*,\)|<\w+\.\w+: ", text)


@pytest.mark.parametrize("kind", [kind for kind in PAGES if kind != "importers"])
def test_every_figure_has_a_text_and_room_for_ten_pixels(kind: str) -> None:
    drawn = re.findall(r"<svg.*?</svg>", PAGES[kind](), flags=re.DOTALL)
    assert drawn
    for svg in drawn:
        root = ElementTree.fromstring(svg)
        assert root.get("role") == "img"
        assert len(root.get("aria-label", "")) > 20
        (least,) = re.findall(r"--least: (\d+)px", root.get("style", ""))
        sizes = [float(x) for x in re.findall(r"font(?:-size)?: ([\d.]+)px", svg)]
        width = float(root.get("viewBox", "").split()[2])
        assert min(sizes) * int(least) / width >= 10


def test_points_of_figures_say_what_they_are() -> None:
    def titles(svg: str) -> list[str]:
        return [str(e.text) for e in ElementTree.fromstring(svg).iter() if e.tag.endswith("title")]

    assert "M, mujoco: worst error 3.0e-14" in titles(examples.digits(examples.AGREEING))
    assert "M, mujoco: worst error 3.0e-14 in 1.23 µs" in titles(examples.term_costs(examples.AGREEING))
    assert "a/one: 3.0e-14, M of mujoco" in titles(drawn_robots(examples.ALL))
    curves = titles(error_against_time(examples.STUDY))
    assert "lagrangian rk4: 1.0e-03 in 0.01 s" in curves
    assert "mujoco mujoco_rk4" in curves
    for result in (examples.NASTY, examples.DIFFERING):
        ElementTree.fromstring(examples.digits(result))


# In a browser.

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
#: What a browser says of a page: its width, what stands out of it, its smallest letters, and a table before and after.
PROBE = """
<script>
const shown = {};
shown.scrolls = document.documentElement.scrollWidth - document.documentElement.clientWidth;
shown.outside = [...document.querySelectorAll("main *")]
  .filter(e => e.getBoundingClientRect().right > innerWidth + 1 && !e.closest(".scroll, .drawing"))
  .map(e => e.tagName);
shown.letters = Math.min(...[...document.querySelectorAll("svg text")].map(t => {
  const svg = t.ownerSVGElement;
  return parseFloat(getComputedStyle(t).fontSize) * svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
}));
const button = [...document.querySelectorAll("th button")].find(b => b.textContent.trim() === "worst");
if (button) {
  const head = button.parentNode, rows = () => [...head.closest("table").querySelectorAll("tbody tr")]
    .map(row => [0, 1, head.cellIndex].map(k => row.cells[k].textContent));
  shown.orders = [rows()];
  shown.states = [head.getAttribute("aria-sort")];
  for (let k = 0; k < 3; ++k) {
    button.click();
    shown.orders.push(rows());
    shown.states.push(head.getAttribute("aria-sort"));
  }
}
parent.document.title = JSON.stringify(shown);
</script></body>
"""


def dumped(file: Path) -> str:
    """Return a page as a browser has made it."""
    flags = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={file.parent}/profile")
    command = [str(BROWSER), *flags, "--window-size=1000,900", "--dump-dom", file.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


@pytest.mark.skipif(BROWSER is None, reason="needs a browser")
def test_a_browser_runs_the_script_that_the_policy_allows(tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text(PAGES["hostile"](), encoding="utf-8")
    page = dumped(file)
    assert '<th class="n" aria-sort="none"><button type="button"' in page


@pytest.mark.thorough("importers", "bench")
@pytest.mark.skipif(BROWSER is None, reason="needs a browser")
@pytest.mark.parametrize("kind", ["check", "bench", "importers", "stress"])
def test_on_a_phone_nothing_stands_out_and_letters_are_ten_pixels_high(kind: str, tmp_path: Path) -> None:
    # A window has a least width; a frame has not. The probe is another script, so the policy is taken out.
    page = re.sub(r"<meta http-equiv=[^>]*>", "", PAGES[kind]()).replace("</body>", PROBE)
    file = tmp_path / "frame.html"
    file.write_text(f'<iframe width="390" height="800" srcdoc="{html.escape(page)}"></iframe>', encoding="utf-8")
    shown = json.loads(html.unescape(re.findall(r"<title>(.*?)</title>", dumped(file))[0]))
    assert shown["scrolls"] <= 0
    assert shown["outside"] == []
    assert shown["letters"] is None or shown["letters"] >= 9.99
    if kind != "check":
        return
    assert shown["states"] == ["none", "ascending", "descending", "none"]
    written, up, down, again = shown["orders"]
    assert again == written
    # A group's name stands in each of its rows once they are sorted; what was refused has no number and is last.
    assert up[0] == ["M", "lagrangian", "–    zero"] or up[0][2].endswith("0")
    assert all(row[0] for row in up)
    assert [row[2] for row in up][-1].startswith("refused")
    assert [row[2] for row in down][-1].startswith("refused")
    assert down[0] == ["M", "mujoco", "✓ 3.0e-14"]
