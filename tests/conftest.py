"""The tests keep their machine code apart, and interpret what they evaluate once."""

from __future__ import annotations

import gc
import os
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# A slow or busy machine fails no test.
settings.register_profile("mbkit", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("mbkit")
# Before anything is compiled, in every worker and in what the tests start: trees that
# are used once are not worth a compiler, and no test reads what an earlier run left.
os.environ.setdefault("MBKIT_COMPILE", "0")
os.environ["MBKIT_CACHE_DIR"] = str(
    Path(tempfile.gettempdir()) / f"mbkit-tests-{os.environ.get('PYTEST_XDIST_TESTRUNUID', os.getpid())}"
)
# heyoka keeps compiled code of its own.
os.environ["HEYOKA_CACHE_DIR"] = os.environ["MBKIT_CACHE_DIR"] + "-heyoka"
# The workers share the cores already: a matrix of 100 rows takes OpenBLAS's threads,
# which wait for each other, a hundred times as long as one of them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# An example of an engine, whose package no test installs.
collect_ignore = ["on_exudyn.py"]


#: What another processor's arithmetic can change: linear algebra, seeds, methods, loops, machine code. `.ci/run` runs
#: these under another kernel of BLAS and with code for any x86-64 too (``-m processors``).
PROCESSORS = {
    *("test_processors", "test_step", "test_constraints", "test_embedded", "test_new_method"),
    *("test_base_parameters", "test_operational_space", "test_linearization", "test_python_call", "test_rodas"),
}


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files without a test of a processor's arithmetic where these alone are asked for."""
    others = config.getoption("markexpr") == "processors" and collection_path.match("test_*.py")
    return True if others and collection_path.stem not in PROCESSORS else None


def pytest_sessionstart(session: pytest.Session) -> None:
    """Import a worker's share of the files of a whole run before all others.

    In a new checkout pytest writes out every assert, which takes a third of a minute. A worker reads the bytecode of
    the shares that the others have written by then.
    """
    worker = getattr(session.config, "workerinput", None)
    whole = session.config.args == session.config.getini("testpaths")
    if worker and whole and not sys.dont_write_bytecode:
        files = sorted(Path(__file__).parent.glob("test_*.py"))
        for file in files[int(worker["workerid"].removeprefix("gw")) :: worker["workercount"]]:
            # What fails or skips here does so again, and is told, where it is collected.
            with suppress(Exception, pytest.skip.Exception):
                import_module(f"tests.{file.stem}")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--thorough", action="store_true", help="run the cases marked thorough too")


def is_thorough(item: pytest.Item, place: int) -> bool:
    """Return whether an item, the ``place``-th case of its function, is left to thorough runs.

    ``@pytest.mark.thorough`` leaves a whole function to them, ``thorough("a", "b")`` the cases with these ids, and
    ``thorough(every=4)`` all but one of four.
    """
    mark = item.get_closest_marker("thorough")
    if mark is None:
        return False
    if every := mark.kwargs.get("every"):
        # The first of the first four, the second of the next: of a product of parameters no value is left out for good.
        return place % every != place // every % every
    return not mark.args or item.name.partition("[")[2][:-1] in mark.args


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of a processor's arithmetic; leave out the thorough ones, unless all or this one are asked for."""
    places: Counter[str] = Counter()
    named: set[tuple[str, str]] = set()
    chosen: dict[bool, list[pytest.Item]] = {True: [], False: []}
    for item in items:
        if item.path.stem in PROCESSORS:
            item.add_marker(pytest.mark.processors)
        function = item.nodeid.partition("[")[0]
        chosen[is_thorough(item, places[function])].append(item)
        places[function] += 1
        named |= {(function, x) for mark in item.iter_markers("thorough") for x in mark.args}
    if any("::" in x for x in config.args):
        return
    if lost := named - {(x.nodeid.partition("[")[0], x.name.partition("[")[2][:-1]) for x in chosen[True]}:
        raise pytest.UsageError(f"thorough names cases that do not exist: {sorted(lost)}")
    if not config.getoption("--thorough"):
        config.hook.pytest_deselected(items=chosen[True])
        items[:] = chosen[False]


def pytest_collection_finish() -> None:
    """Leave what stays until the end, modules and tests, out of every search for garbage."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(scope="module")
def own_environments(tmp_path_factory):
    """Environments in a folder of the module's own, whose processes are started once and end with it."""
    from mbkit._child_process import end_all

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MBKIT_ENVIRONMENTS", str(tmp_path_factory.mktemp("environments")))
        yield
        end_all()
