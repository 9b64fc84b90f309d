"""The book as it is written: complete, connected, and in short sentences. It is read here, and built elsewhere."""

from __future__ import annotations

import importlib
import inspect
import json
import re
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import click
import numpy as np
import pytest

import mbkit as mb
from mbkit.cli import cli
from mbkit.codegen.c_source import export_c
from tests.scenes import METHODS

BOOK = Path(__file__).resolve().parent.parent / "notebooks"
PAGES = sorted(p for p in BOOK.rglob("*.md") if not {"_build", ".ipynb_checkpoints"} & {*p.parts})
NAMES = [p.relative_to(BOOK).as_posix() for p in PAGES]
#: Of the pages for readers in a hurry.
MOST_WORDS = 30
DIRECTIVE = re.compile(r"^\s*(?:\.\. |```\{|:::\{)(?:auto\w+|py:\w+)(?:::|\})\s*([\w.]+)", re.MULTILINE)


def named(path: str) -> Any:
    """Return what a dotted path names: an attribute of `mbkit` first, as users write it, else of a module."""
    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError:
        return getattr(named(module), name)


def prose(text: str) -> str:
    """Return a page's text without front matter, code, tables, formulas, comments and the targets of links."""
    text = re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)
    text = re.sub(r"^( *)(```+|:::+|~~~+).*?^\1\2\s*$", "\n\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"\$\$.*?\$\$|<!--.*?-->|\\begin\{(\w+\*?)\}.*?\\end\{\1\}", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"^\s*(\||#|\(\w[\w-]*\)=).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"`[^`]*`|(?<!\\)\$[^$\n]+\$", "x", text)
    return re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)


def sentences(text: str) -> Iterator[str]:
    """Yield sentences: parts of a paragraph or list item that end in . ! or ? before a space."""
    for block in re.split(r"\n\s*\n|\n\s*(?:[-*+]|\d+\.)\s+", prose(text)):
        line = " ".join(block.split())
        line = re.sub(r"\b(e\.g|i\.e|ch|eq|eqs|fig|sec|no|vs|cf|al|p|pp)\.", r"\1", line)
        yield from (s for s in re.split(r"(?<=[.!?])[)\"”*_]*\s+", line) if s)


def words(sentence: str) -> list[str]:
    return [w for w in sentence.split() if any(c.isalnum() for c in w)]


def links(text: str) -> Iterator[str]:
    text = re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)
    text = re.sub(r"^( *)(```+|~~~+)(?!\{toctree|\{eval-rst).*?^\1\2\s*$", "", text, flags=re.DOTALL | re.MULTILINE)
    yield from re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", text))


def test_every_public_name_has_a_directive_in_the_reference():
    """Aliases of a class or function count as documented with it; data and modules by their own names."""
    listed = {n for p in (BOOK / "reference").glob("*.md") for n in DIRECTIVE.findall(p.read_text("utf-8"))}
    unknown = []
    documented: list[Any] = []
    for path in sorted(listed):
        try:
            documented.append(named(path))
        except (AttributeError, ModuleNotFoundError):
            unknown.append(path)
    assert not unknown, f"directives of names that do not exist: {unknown}"
    public = json.loads((Path(__file__).parent / "public_names.json").read_text("utf-8"))
    missing = []
    for path in public:
        value = named(path)
        if path not in listed and not (
            callable(value) and any(value is x or _function(value) is _function(x) for x in documented)
        ):
            missing.append(path)
    assert not missing, f"public names without a directive in notebooks/reference: {missing}"


def _function(value: Any) -> Any:
    """Return the function behind a callable package, such as `mbkit.load`."""
    function = getattr(value, value.__name__.rpartition(".")[2], None) if hasattr(value, "__path__") else None
    return value if function is None else function


def test_a_property_does_not_begin_like_a_type():
    """Sphinx reads ``"What is missing: curves"`` as a property of the type "What is missing"."""
    read = []
    for path in json.loads((Path(__file__).parent / "public_names.json").read_text("utf-8")):
        if isinstance(value := named(path), type):
            for name, thing in inspect.getmembers_static(value, lambda x: isinstance(x, (property, cached_property))):
                if not name.startswith("_") and ": " in (inspect.getdoc(thing) or "").partition("\n")[0]:
                    read.append(f"{path}.{name}")
    assert not read, f"a colon in the first line: {read}"


def test_each_public_name_has_one_place():
    """A second directive of one name would be a duplicate target, and a warning of Sphinx."""
    found = [n for p in sorted((BOOK / "reference").glob("*.md")) for n in DIRECTIVE.findall(p.read_text("utf-8"))]
    assert not (twice := {n for n in found if found.count(n) > 1}), f"documented twice: {twice}"


def test_the_page_of_the_command_has_every_command():
    text = (BOOK / "reference" / "command.md").read_text("utf-8")

    def paths(command: click.Command, path: str) -> Iterator[str]:
        yield path
        for name, inside in getattr(command, "commands", {}).items():
            yield from paths(inside, f"{path} {name}")

    headings = {*re.findall(r"^#+ (mbkit .*)$", text, re.MULTILINE)}
    shown = {f"mbkit {x}" for x in re.findall(r'^options\("([^"]+)"\)$', text, re.MULTILINE)}
    for path in paths(cli, "mbkit"):
        assert path == "mbkit" or path in headings, f"no heading for `{path}`"
        group = path in ("mbkit", "mbkit baseline")
        assert group or path in shown, f"no options of `{path}`"


def test_every_page_is_in_a_toctree():
    reached, open_ = set(), ["index"]
    while open_:
        page = open_.pop()
        if page in reached:
            continue
        reached.add(page)
        path = BOOK / f"{page}.md"
        if not path.exists():
            assert (BOOK / f"{page}.ipynb").exists(), f"{page} is in a toctree and does not exist"
            continue
        for block in re.findall(r"^```\{toctree\}\n(.*?)^```", path.read_text("utf-8"), re.DOTALL | re.MULTILINE):
            for line in block.splitlines():
                if line.strip() and not line.startswith(":"):
                    target = re.sub(r"^.*<(.*)>$", r"\1", line.strip()).removesuffix(".md").removesuffix(".ipynb")
                    open_.append((path.parent / target).resolve().relative_to(BOOK).as_posix())
    pages = {n.removesuffix(".md") for n in NAMES}
    pages |= {p.relative_to(BOOK).with_suffix("").as_posix() for p in (BOOK / "examples").glob("*.ipynb")}
    assert not pages - reached, f"pages in no toctree: {sorted(pages - reached)}"


@pytest.mark.parametrize("name", NAMES)
def test_relative_links_lead_to_files(name):
    path = BOOK / name
    for link in links(path.read_text("utf-8")):
        target = unquote(link.partition("#")[0])
        if target and not re.match(r"[a-z]+:", target):
            assert (path.parent / target).exists(), f"{name}: no such file: {link}"


@pytest.mark.parametrize("name", NAMES)
def test_pages_with_cells_have_front_matter(name):
    text = (BOOK / name).read_text("utf-8")
    if "{code-cell}" in text:
        head = re.match(r"---\n(.*?)\n---\n", text, re.DOTALL)
        assert head, f"{name}: cells without front matter"
        assert "file_format: mystnb" in head[1], name
        assert re.search(r"kernelspec:\s+name: python3", head[1]), name


@pytest.mark.parametrize("name", [n for n in NAMES if n.startswith(("start/", "howto/"))])
def test_sentences_are_short(name):
    long = [s for s in sentences((BOOK / name).read_text("utf-8")) if len(words(s)) > MOST_WORDS]
    assert not long, f"{name}: {len(words(long[0]))} words: {long[0]}"


def test_the_splitter_counts_what_is_read():
    text = (
        "---\nx: y\n---\n# A head\n\nOne two `three four`. Five [six](seven/eight.md)\nnine:\n\n| a |\n\n- ten\n- a\n"
    )
    assert [len(words(s)) for s in sentences(text)] == [3, 3, 1, 1]
    assert list(sentences("```{code-cell} ipython3\nlong = 'code. is not read'\n```\n\nRead, e.g. here.")) == [
        "Read, e.g here."
    ]


def test_each_figure_of_a_notebook_has_a_text_for_those_who_do_not_see_it():
    notebooks = sorted((BOOK / "examples").glob("*.ipynb"))
    assert notebooks
    for path in notebooks:
        for cell in json.loads(path.read_text("utf-8"))["cells"]:
            if any("image/svg+xml" in output.get("data", {}) for output in cell.get("outputs", [])):
                assert len(cell["metadata"]["mystnb"]["image"]["alt"]) > 20, path.name


# Of what each path takes: a sentence of a page beside the code that does so.


def arm(**joint: Any) -> mb.ModelBuilder:
    """Return a swinging body, with more numbers of its joint."""
    b = mb.ModelBuilder("arm")
    b.add_body("rod", mass=2.0, com=(0, 0, -0.5), inertia=(0.2, 0.2, 0.01))
    b.add_joint("pivot", **{"kind": "revolute", "parent": "world", "child": "rod", "axis": (0, 1, 0), **joint})
    return b


def driven() -> mb.Model:
    b = arm()
    b.add_joint_force("motor", "pivot", lambda t, q, v: -v * v)  # noqa: ARG005
    return b.build()


def refuses(call: Callable[[], Any], *words: str) -> bool:
    """Return whether a call is refused with an error that has these words."""
    with pytest.raises(mb.errors.MbkitError) as error:
        call()
    return all(word in str(error.value) for word in words)


def loads_of_a_loop() -> bool:
    dyn = mb.dynamics(mb.catalog.four_bar())
    q, v = dyn.project([0.5, 0.0, 0.0], np.zeros(3))
    tau = np.array([3.0, 0.0, 0.0])
    a = dyn.forward_dynamics(q, v, tau)
    loads = dyn.joint_wrenches(q, v, tau=tau)
    assert np.array_equal(loads, dyn.joint_wrenches(q, v, a, tau=tau))
    assert np.any(dyn.loop_wrenches(q, v, tau))
    # Moments across its plane alone are open, and forces across it.
    (first, *_) = dyn.undetermined_loads(q).joints
    return not first.all() and refuses(lambda: dyn.joint_wrenches(q, v, a), "joint_wrenches(..., tau=tau)")


def friction_acts() -> bool:
    slow = [
        mb.dynamics(arm(friction=3.0, lower=-0.1, upper=0.1).build(), engine).forward_dynamics([0.3], [1.0], [0.0])[0]
        for engine in ("lagrangian", "pinocchio", "mujoco")
    ]
    # Beyond its limit, which is off: m g l sin q and the friction over the inertia about the pivot.
    right = -(3.0 + 2.0 * 9.81 * 0.5 * np.sin(0.3)) / (0.2 + 2.0 * 0.25)
    return slow == pytest.approx([right] * 3, rel=1e-12)


def features_are_listed() -> bool:
    (listed,) = re.findall(r"The features are (.*)\.", (BOOK / "howto/describe_a_system.md").read_text("utf-8"))
    with pytest.raises(mb.errors.UnknownNameError) as error:
        arm().build().without("nothing")
    return {*re.findall(r"\w+", str(error.value).partition("there are:")[2])} == {*re.findall(r"\w+", listed)} - {"and"}


def rolling_is_refused() -> bool:
    model = mb.catalog.chaplygin_sleigh()
    q, v = model.random_state(0)
    return all(
        refuses(lambda name=name: mb.dynamics(model, name).forward_dynamics(q, v, np.zeros_like(v)), x.name)
        for name in ("mujoco", "drake")
        for x in model.no_slip
    )


def armature_has_one_number() -> bool:
    for kind in ("free", "planar"):
        assert refuses(arm(kind=kind, axis=None, armature=0.1).build, f"armature on a {kind} joint")
    return bool(arm(kind="ball", axis=None, armature=0.1).build().needs.armature)


def own_integrators_refuse_dry_friction() -> bool:
    model = arm(friction=1.0).build()
    run = partial(mb.simulate, mb.dynamics(model, "mujoco"), model.neutral(), [0.0], 0.1, "mujoco_rk4", dt=0.01)
    return refuses(run, "dry friction")


def methods_take_stops() -> bool:
    """A joint that is pushed onto its stop at 0.1 rad rests there, by every method that this machine has."""
    model = arm(lower=-1.0, upper=0.1, stops=True).build()
    for method in METHODS.values():
        engine = (method.engines or ("lagrangian",))[0]
        settings = {} if method.kind == "adaptive" else {"dt": 1e-2}
        more = {"torque": [5.0], "doubt": False} | settings
        run = partial(mb.simulate, mb.dynamics(model, engine), [0.0], [1.0], 0.2, method.name, **more)
        if engine != "lagrangian":
            assert refuses(run, "joint 'pivot' has stops"), method.name
        else:
            assert run().q[-1] == 0.1, method.name
    return True


CLAIMS: dict[tuple[str, str], Callable[[], Any]] = {
    ("howto/wrenches_and_loads.md", "loads of a mechanism with loops need the force τ too"): loads_of_a_loop,
    ("howto/wrenches_and_loads.md", "Forces given by functions are refused here"): lambda: refuses(
        lambda: mb.dynamics(driven()).joint_wrenches([0.1], [0.0], [0.0]), "joint_wrenches"
    ),
    ("howto/mechanisms.md", "Without accelerations it takes those of `forward_dynamics`"): loads_of_a_loop,
    ("reference/engines.md", "Joint loads of a mechanism are those under a force"): loads_of_a_loop,
    ("reference/engines.md", "Base parameters and `identify` refuse models with loops"): lambda: (
        refuses(mb.catalog.four_bar().base_parameters, "loops")
        and refuses(lambda: mb.identify(mb.catalog.four_bar(), *np.zeros((4, 50, 3))), "loops")
    ),
    ("howto/describe_a_system.md", "Dry `friction` and `stiction` of a joint act on every engine"): friction_acts,
    ("howto/describe_a_system.md", "The features are"): features_are_listed,
    ("howto/describe_a_system.md", "MuJoCo and Drake refuse them by name"): rolling_is_refused,
    ("howto/describe_a_system.md", "Armature on a free or planar joint is refused"): armature_has_one_number,
    ("howto/describe_a_system.md", "MJCF and URDF cannot hold forces by functions"): lambda: all(
        refuses(lambda form=form: mb.convert(driven(), form), "motor") for form in ("mjcf", "urdf")
    ),
    (
        "howto/take_code_out.md",
        "C of models with loops, couplers, rolling contacts or motions prescribed in time has",
    ): (lambda: "forward_dynamics" in {x.quantity for x in export_c(mb.catalog.four_bar()).functions}),
    ("howto/dry_friction.md", "Integrators of MuJoCo and Drake themselves are refused"): (
        own_integrators_refuse_dry_friction
    ),
    ("howto/joint_stops.md", "Every method but the integrators of MuJoCo and Drake takes stops"): methods_take_stops,
}


@pytest.mark.parametrize(("place", "sentence"), CLAIMS)
def test_what_a_page_says_that_a_path_takes_is_so(place, sentence):
    assert sentence in (BOOK / place).read_text("utf-8")
    assert CLAIMS[place, sentence]()
