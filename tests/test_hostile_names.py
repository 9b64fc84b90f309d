"""Names from files of strangers, sent through every output: each is text there, and nothing else."""

from __future__ import annotations

import ast
import csv
import io
import json
import re
import shutil
import subprocess
import sys
import tomllib
import warnings
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest
import sympy as sp
from click.testing import CliRunner

import mbkit as mb
from mbkit import _escape
from mbkit.cli import cli
from mbkit.lagrangian.summary import SystemSummary, python_code
from tests.scenes import mounted

#: Code for every reader of an output, and what a terminal obeys. XML can hold the first of them.
SEEN = (
    "x\"\"\"'''*/??/ %&_^~#{{7*7}}-->]]>"
    "<img src=x onerror=alert(1)>|[red](a)`*b*`$x$\\input{y}\\u0041\\N{DASH}\x9b2J\u202e"
)
EVIL = SEEN + "\nimport os\n\\input{z}\x1b[31m\r\x07"


def named(what, evil=EVIL):
    return f"{what} {evil}"


def robot(evil=EVIL):
    b = mb.ModelBuilder(named("robot", evil))
    for k, parent in ((1, "world"), (2, named("body1", evil))):
        mass = mb.Parameter(named("mass", evil), 1.0) if k == 1 else 1.0
        b.add_body(named(f"body{k}", evil), mass=mass, com=(0.1, 0, 0), inertia=(0.1, 0.1, 0.1))
        place = {"parent": parent, "child": named(f"body{k}", evil), "translation": (float(k - 1), 0, 0)}
        b.add_joint(named(f"joint{k}", evil), "revolute", axis=(0, 1, 0), damping=0.1, **place)
    b.add_frame(named("frame", evil), body=named("body2", evil))
    ends = {"body_a": named("body1", evil), "body_b": named("body2", evil), "point_a": (0, 1.0, 0)}
    b.add_spring(named("spring", evil), stiffness=1.0, **ends)
    return b.build()


def paper():
    q, s, w, u, m, k = (sp.Symbol(named(x)) for x in ("q", "s", "w", "u", "m", "k"))
    T = m * (w**2 + u**2) / 2 + sp.sqrt(1 + q**2) * w**2
    V = k * q**2 / 2 + k * sp.cos(q)
    return mb.lagrangian.Lagrangian(T, V, [q, s], [w, u], parameters={m: 1.0, k: 2.0}, name=named("system"))


def is_seen(text):
    """Nothing but what can be seen, and line feeds: a terminal obeys none of it."""
    return all(c.isprintable() or c == "\n" for c in text)


class Tags(HTMLParser):
    """The elements of a page, their attributes, and its text."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.attributes, self.text, self.scripts = set(), set(), "", 0
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.add(tag)
        self.scripts += tag == "script"
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data):
        self.text += data


def is_page(text):
    page = Tags(text)
    # The page's own script is the only one, and its policy names it.
    own = page.scripts == text.count("script-src 'sha256-")
    return is_seen(text) and own and "img" not in page.elements and "onerror" not in page.attributes


def is_markdown(text):
    """Nothing but what can be seen, no HTML, and rows of tables as wide as their heads."""
    tables = re.findall(r"(?:^\|.*\n?)+", text, flags=re.MULTILINE)
    widths = [{len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()} for table in tables]
    return is_seen(text) and "<" not in text and all(len(w) == 1 for w in widths) and "*b*" not in text


def is_latex(text):
    """Nothing but what can be seen; no command from a name, and none outside of its comment."""
    body = re.sub(r"^%.*$", "", text, flags=re.MULTILINE)
    commands = set(re.findall(r"\\([A-Za-z]+)", body))
    dollars = re.findall(r"(?<!\\)\$", body)
    return is_seen(text) and not commands & {"input", "u", "N"} and len(dollars) in (0, 2)


@pytest.fixture(scope="module")
def compared():
    return mb.compare(robot(), samples=1, terms_only=True)


def test_every_result_in_a_notebook_and_in_markdown(compared, tmp_path):
    heavier = robot().with_parameters(**{named("mass"): 3.0})
    explained = mb.explain(robot(), heavier, samples=1, names=(named("a"), named("b")))
    assert explained.causes
    path = tmp_path / "a.toml"
    mb.baseline.record(robot(), path, engines=["lagrangian"])
    study = mb.work_precision(robot(), ["lagrangian"], ["rk4"], duration=0.01, repeats=1, seconds=1.0)
    told = replace(compared, rows=tuple(replace(r, reason=named("why"), passed=False) for r in compared.rows))
    lag = paper()
    run = mb.simulate(mb.dynamics(robot(), "lagrangian"), [0.1, 0.1], [0.0, 0.0], 0.01, method="rk4", dt=0.01)
    results = [compared, told, explained, study, mb.baseline.check(heavier, path), run, robot(), lag.model, lag]
    results += [lag.equations(), lag.hamiltonian(), lag.hamiltonian().equations(), lag.routhian()]
    results += [*lag.conserved_quantities(), mb.equilibrium(mb.dynamics(robot(), "lagrangian"), [0.1, 0.1])]
    shown = set()
    for result in results:
        for text in (repr(result), str(result)):
            assert is_seen(text), result
        for method, fits in (("_repr_html_", is_page), ("to_markdown", is_markdown), ("_repr_latex_", is_latex)):
            if hasattr(result, method):
                assert fits(getattr(result, method)()), (type(result), method)
                shown.add(method)
        if hasattr(result, "to_json"):
            assert is_seen(result.to_json())
            assert SEEN in json.loads(result.to_json())["model" if result is not explained else "a"]
    assert len(shown) == 3
    run.to_csv(tmp_path / "run.csv")
    for text in ((tmp_path / "run.csv").read_text(), study.to_csv()):
        assert is_seen(text)
        assert len({len(row) for row in csv.reader(io.StringIO(text))}) == 1


def test_a_baseline_reads_back_what_was_recorded(tmp_path):
    path = tmp_path / "a.toml"
    mb.baseline.record(robot(), path, engines=["lagrangian"])
    text = path.read_text()
    assert is_seen(text)
    assert tomllib.loads(text)["model"] == named("robot")
    assert mb.baseline.read(path).velocities == robot().velocity_names
    assert mb.baseline.check(robot(), path).status == "same"


@pytest.mark.parametrize("system", [paper, lambda: mb.lagrangian.from_model(robot())], ids=["paper", "robot"])
def test_python_code_has_nothing_but_its_functions(system, tmp_path):
    lag = system()
    source = python_code(lag)
    module = ast.parse(source)
    kinds = [type(x) for x in module.body]
    assert kinds == [ast.Expr, ast.Import, ast.Assign, *[ast.FunctionDef] * 3]
    assert "\\N{DASH}\\x9b2J\\u202e" in ast.get_docstring(module)
    assert is_seen(source)
    called = {ast.unparse(x.func) for x in ast.walk(module) if isinstance(x, ast.Call)}
    assert all(x.startswith("np.") or x in ("set", "sorted", "TypeError", "nonlinear", "mass_matrix") for x in called)
    (tmp_path / "made.py").write_text(source)
    run = "import made, numpy; print(made.forward_dynamics([0.1, 0.2], [0.3, 0.4]).tolist())"
    done = subprocess.run([sys.executable, "-c", run], cwd=tmp_path, capture_output=True, text=True, check=True)
    expected = lag.dynamics().forward_dynamics([0.1, 0.2], [0.3, 0.4], [0.0, 0.0])
    assert json.loads(done.stdout) == pytest.approx(expected.tolist(), rel=1e-12)


@pytest.mark.parametrize("name", ["np", "ｎｐ", "set", "out", "given", "def", "ſ", "x²", "mass_matrix", "1a", ""])
def test_a_symbol_of_any_name_is_a_variable_of_its_own(name):
    taken = {"np", "out", "given", "mass_matrix"}
    made = _escape.identifier(name, taken)
    assert made.isidentifier()
    assert made not in taken
    assert eval(f"[0 for {made} in ()]", {}) == []
    q, w, m, other = sp.symbols("q1 w1 m other")
    m, other = sp.Symbol(name or "m"), sp.Symbol("s")
    lag = mb.lagrangian.Lagrangian(m * w**2 / 2, other * q**2, [q], [w], parameters={m: 2.0, other: 3.0}, name="s")
    scope = {}
    exec(python_code(lag), scope)
    assert scope["forward_dynamics"]([1.0], [0.0]).tolist() == [-3.0]


def test_what_sympy_evaluates_holds_only_names():
    data = SystemSummary(paper()).data()
    names = {*data["coordinates"], *data["velocities"], *data["accelerations"], *data["parameters"]}
    assert all(n.isidentifier() for n in names)
    assert len(names) == 8
    T = sp.sympify(data["T"])
    assert {s.name for s in T.free_symbols} <= names


def test_latex_has_no_command_of_a_name():
    account = SystemSummary(paper())
    assert is_latex(account.latex())
    assert not [line for line in account.latex().splitlines() if line.lstrip().startswith(("\\input", "import"))]
    ordinary = SystemSummary(mb.lagrangian.systems.get("double_pendulum")()).latex()
    assert r"\dot{\theta}_{1}" in ordinary
    assert "mathrm" not in ordinary


@pytest.mark.parametrize("name", [r"\theta", r"\dot{x}", r"\mathrm{m}_{1}", "m_p", "theta1", "x'"])
def test_a_symbol_may_be_latex_of_letters_and_accents(name):
    assert _escape.latex(name, lambda x: f"as it is {x}") == f"as it is {name}"


@pytest.mark.parametrize(
    "name", [r"\input{x}", r"\csname a\endcsname", "a%", "a}b{", "a^^5cb", "$", "[1]", "a\nb", r"\\"]
)
def test_a_symbol_may_be_no_other_latex(name):
    made = _escape.latex(name, lambda x: x)
    assert made.startswith(r"\mathrm{")
    inner = made.removeprefix(r"\mathrm{").removesuffix("}")
    assert re.fullmatch(r"(\\backslash |\{\\wedge\}|\{\\sim\}|\\ |\\[{}$%#&_]|[^\\{}$%#&_^~])*", inner)
    assert inner.isprintable()


@pytest.mark.parametrize("to", ["mjcf", "urdf"])
def test_xml_reads_back_the_names_or_refuses(to):
    model = robot(SEEN)
    model = mb.Model(**{f: getattr(model, f) for f in ("name", "gravity", "bodies", "joints", "frames")})
    text = mb.convert(model, to).text
    assert is_seen(text)
    root = ElementTree.fromstring(text)
    tags = {x.tag for x in root.iter()}
    names = {x.get("name") for x in root.iter()}
    assert "img" not in tags
    assert {named("joint1", SEEN), named("body1", SEEN)} <= names
    with pytest.raises(mb.errors.UnsupportedError, match="XML"):
        mb.convert(robot(), to)


#: What a person types; {} is the hostile system.
COMMANDS = [
    "check {} --samples 1 --no-rollouts",
    "check {} --samples 1 --no-rollouts --json",
    "derive {}",
    "derive {} --latex",
    "derive {} --python",
    "derive {} --json",
    "derive {} --c",
    "export {}",
    "export {} --json",
    "convert {} --to mjcf",
    "convert {} --to urdf",
    "diff {} {}",
    "diff {} {} --json",
    "bench {} --engines lagrangian --methods rk4 --duration 0.01 --repeats 1 --seconds 1",
    "baseline record {} made --engines lagrangian",
    "baseline check made --json --target {}",
    "baseline check made --target {}",
    "check names:nothing",
    "check names:broken",
]


@pytest.mark.thorough
def test_every_command(tmp_path, monkeypatch):
    source = Path(__file__)
    (tmp_path / "names.py").write_text(
        f"import importlib.util as u, mbkit as mb\ns = u.spec_from_file_location('hostile', {str(source)!r})\n"
        "m = u.module_from_spec(s)\ns.loader.exec_module(m)\n"
        "def robot(): return m.robot()\ndef paper(): return m.paper()\n"
        "def broken(): raise ValueError(m.EVIL)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    statuses = set()
    for system in ("names:robot", "names:paper"):
        shutil.rmtree("made", ignore_errors=True)
        for command in COMMANDS:
            if system == "names:paper" and command.split()[0] in ("check", "bench", "diff", "convert"):
                continue
            done = CliRunner().invoke(cli, command.format(system, system).split())
            assert is_seen(done.stdout), command
            assert is_seen(done.stderr), command
            # A message is one of mbkit's; a name that has line feeds begins none.
            assert not re.search(r"^(import os|\\input)", done.stderr, flags=re.MULTILINE), command
            assert done.exit_code in (0, 1, 2), (command, done.output)
            statuses.add(done.exit_code)
            if "--json" in command and done.exit_code < 2:
                json.loads(done.stdout)
    assert {0, 2} <= statuses
    pages = [*Path("mbkit-report").glob("*.html")]
    assert len(pages) == 2
    for page in pages:
        assert is_page(page.read_text()), page
    for path in (*Path("mbkit-report").glob("*.json"), *Path("mbkit-report").glob("*.csv"), *Path("made").glob("*")):
        assert is_seen(path.read_text()), path


def test_errors_and_warnings_are_seen_as_they_are():
    for kind in (mb.errors.InputError, mb.errors.ModelError, mb.errors.MbkitWarning):
        made = kind(EVIL, [EVIL]) if kind is mb.errors.ModelError else kind(EVIL)
        assert is_seen(str(made))
        assert "\\x1b[31m" in str(made)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        b = mounted(named("robot"), named("body"), "j", "revolute", mass=1.0, inertia=(1.0, 1.0, 5.0), axis=(0, 0, 1))
        b.build(nonphysical="warn")
    assert heard
    assert all(is_seen(str(w.message)) for w in heard)
