"""A pytest plugin: robots and engines as parameters of tests, and comparison with baselines.

pytest finds it where mbkit is installed, and every run loads this file: so mbkit is imported in fixtures alone.

    @pytest.mark.mbkit(robots=["panda", "robots/arm.urdf"], engines=["pinocchio", "mujoco"])
    def test_my_robots(mbkit_model, mbkit_engine): ...

    @pytest.mark.mbkit(robots=["panda"])
    def test_as_recorded(mbkit_model, mbkit_baseline):
        mbkit_baseline(mbkit_model)

The asserts of `mbkit.testing` need no fixture.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import pytest

if TYPE_CHECKING:
    from mbkit.engines import Dynamics
    from mbkit.model import Model

_MARK = (
    "mbkit(robots=[...], engines=[...], **load): run a test for each robot (mbkit_model) and engine (mbkit_engine); "
    "a robot is a name, a file beside the test, package.module:function, or a Model; load are options of mbkit.load"
)
#: Name of the property in which a report carries messages to the process that prints.
_PROPERTY = "mbkit"
_CACHE = pytest.StashKey[dict[Any, Any]]()
T = TypeVar("T")
# `mbkit.testing.STRICT`, which is not imported for one word.
_STRICT = "MBKIT_TEST_STRICT"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("mbkit", "robots and their engines (mbkit)")
    group.addoption("--mbkit-regen", action="store_true", help="record the baselines of the tests again")
    group.addoption("--mbkit-strict", action="store_true", help="fail, and do not skip, where an engine is missing")


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known, and strictness."""
    config.addinivalue_line("markers", _MARK)
    config.stash[_CACHE] = {}
    if config.getoption("--mbkit-strict"):
        environment = pytest.MonkeyPatch()
        environment.setenv(_STRICT, "1")
        config.add_cleanup(environment.undo)


# Robots and engines as parameters.


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test for each of its marker's robots and engines."""
    wants_model = "mbkit_model" in metafunc.fixturenames
    wants_engine = "mbkit_engine" in metafunc.fixturenames
    if not wants_model and not wants_engine:
        return
    options = _mark_options(metafunc)
    if wants_model:
        robots = _list_of(options.get("robots", ()), "robots")
        if not robots:
            pytest.fail(
                f"{metafunc.function.__name__}: mbkit_model wants @pytest.mark.mbkit(robots=[...])", pytrace=False
            )
        metafunc.parametrize("mbkit_model", robots, indirect=True, ids=[_id(r) for r in robots])
    if wants_engine:
        from mbkit.engines.registry import STANDARD

        engines = _list_of(options.get("engines", STANDARD), "engines")
        metafunc.parametrize("mbkit_engine", engines, indirect=True, ids=[str(e) for e in engines])


def _mark_options(node: Any) -> dict[str, Any]:
    """Return the arguments of a test's markers; the nearest marker wins."""
    out: dict[str, Any] = {}
    for mark in getattr(node, "definition", node).iter_markers("mbkit"):
        if mark.args:
            pytest.fail(f"{_MARK.partition(':')[0]} takes names: robots=[...], engines=[...]", pytrace=False)
        out = {**mark.kwargs, **out}
    return out


def _load_options(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Return the options of `mbkit.load` among the arguments of a test's markers."""
    options = {k: x for k, x in _mark_options(request.node).items() if k not in ("robots", "engines")}
    if isinstance(options.get("loops"), str):
        options["loops"] = _target(options["loops"], request)
    return options


def _list_of(value: Any, name: str) -> list[Any]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        pytest.fail(f"mark mbkit: {name}: expected a list, got {value!r}", pytrace=False)
    return list(value)


def _id(robot: Any) -> str:
    """Return the name of a robot in a test's name, the same in every process."""
    if isinstance(robot, (str, os.PathLike)):
        text = os.fspath(robot)
        return Path(text).stem if text.lower().endswith((".urdf", ".xml", ".mjcf")) else text
    return str(getattr(robot, "name", None) or getattr(robot, "__name__", None) or type(robot).__name__)


@pytest.fixture
def mbkit_model(request: pytest.FixtureRequest) -> Model:
    """One of the robots of the test's marker."""
    __tracebackhide__ = True
    robot = request.param
    if not isinstance(robot, (str, os.PathLike)):
        return robot() if callable(robot) else robot  # type: ignore[no-any-return]
    from mbkit.studies._targets import model_of

    target, options = _target(os.fspath(robot), request), _load_options(request)
    key = "model", target, repr(options)
    return _once(request.config, key, lambda: _without_traceback(lambda: model_of(target, options)))


def _target(text: str, request: pytest.FixtureRequest) -> str:
    """Return a robot's name, or the path of a file, which is looked for beside the test first."""
    beside = request.path.parent / text
    return str(beside) if beside.is_file() else text


@pytest.fixture
def mbkit_engine(request: pytest.FixtureRequest) -> str:
    """One of the engines of the test's marker; the test is skipped where it is not installed."""
    __tracebackhide__ = True
    from mbkit.studies._targets import not_installed

    name = str(request.param)
    for why in not_installed([name]).values():
        (pytest.fail if request.config.getoption("--mbkit-strict") else pytest.skip)(f"{name}: {why}")
    return name


@pytest.fixture
def mbkit_dynamics(request: pytest.FixtureRequest, mbkit_model: Model, mbkit_engine: str) -> Dynamics:
    """Evaluate the robot by the engine."""
    __tracebackhide__ = True
    from mbkit.engines import dynamics

    key = "dynamics", mbkit_model.digest, mbkit_engine
    return _once(request.config, key, lambda: _without_traceback(lambda: dynamics(mbkit_model, mbkit_engine)))


def _without_traceback(call: Callable[[], T], write: Callable[[Exception], str] = str) -> T:
    """Return the value of a call; an error of mbkit fails the test with its message, without a traceback."""
    __tracebackhide__ = True
    from mbkit.errors import MbkitError

    try:
        return call()
    except (AssertionError, MbkitError) as error:
        message = write(error)
    pytest.fail(message, pytrace=False)


def _once(config: pytest.Config, key: Any, make: Callable[[], T]) -> T:
    """Return a value that is computed once in a process."""
    cache = config.stash[_CACHE]
    if key not in cache:
        cache[key] = make()
    return cache[key]  # type: ignore[no-any-return]  # what `make` returned


# Baselines.


class MbkitBaseline:
    """Holds a model against its baseline, or records it with ``--mbkit-regen``; a test calls it.

    The file is ``baselines/<test file>/<test>.toml`` beside the test, or ``baselines/<name>.toml`` with a name.
    """

    def __init__(self, request: pytest.FixtureRequest) -> None:
        self._request = request
        self._used: dict[Path, str] = {}

    def path(self, name: str | None = None) -> Path:
        """Return the file."""
        folder = self._request.path.parent / "baselines"
        if name is None:
            folder, name = folder / self._request.path.stem, self._request.node.name
        return folder / f"{_plain(name)}.toml"

    def __call__(self, model: Model, name: str | None = None, **record: Any) -> Any:
        """Hold a model against its baseline.

        Parameters
        ----------
        model : Model
        name : str, optional
            Of the file; a test that calls it twice gives one.
        **record
            Arguments of `mbkit.baseline.record`, such as ``engines``, for when it is recorded.

        Returns
        -------
        BaselineResult or Baseline
            The comparison, or the recorded baseline.
        """
        __tracebackhide__ = True
        path = self.path(name)
        if self._used.setdefault(path, model.digest) != model.digest:
            pytest.fail(f"{path}: asked for two models in one test; give each a name", pytrace=False)
        target, options = self._target(model, path)
        if self._request.config.getoption("--mbkit-regen"):
            # With force: the test may have another robot than before.
            return self._record(model, path, {"target": target, "options": options, "force": True, **record})
        return self._check(model, path, target)

    def _record(self, model: Model, path: Path, arguments: Mapping[str, Any]) -> Any:
        __tracebackhide__ = True
        from mbkit.studies import baseline as baselines

        recorded = _without_traceback(lambda: baselines.record(model, path, **arguments))
        self._report(f"recorded {self._shown(path)} ({', '.join(recorded.engines)})")
        for disagreement in recorded.disagreements:
            self._report(f"{self._shown(path)}: {disagreement}")
        return recorded

    def _check(self, model: Model, path: Path, target: str) -> Any:
        __tracebackhide__ = True
        from mbkit.errors import BaselineError
        from mbkit.testing import assert_baseline

        again = f"pytest --mbkit-regen {shlex.quote(self._request.node.nodeid)}"

        def write(error: Exception) -> str:
            message = f"{error}\n  To record it: {again}" if isinstance(error, BaselineError) else str(error)
            return message.replace(str(path), self._shown(path))

        result = _without_traceback(lambda: assert_baseline(model, path, target=target or None, remedy=again), write)
        if result.status == "versions":
            self._report(f"{self._shown(path)}: {result.verdict} pytest --mbkit-regen")
        for refusal in result.skipped:
            self._report(f"{self._shown(path)}: {refusal.engine} skipped: {refusal.reason}")
        return result

    def _target(self, model: Model, path: Path) -> tuple[str, dict[str, Any]]:
        """Return where the test's own robot came from, so that its links can be named; nothing for another model."""
        robot = getattr(self._request.node, "callspec", None) and self._request.node.callspec.params.get("mbkit_model")
        if not isinstance(robot, (str, os.PathLike)) or self._request.getfixturevalue("mbkit_model") is not model:
            return "", {}
        from mbkit.studies._targets import kept, kept_options

        options = kept_options(_load_options(self._request), path)
        return kept(_target(os.fspath(robot), self._request), path), options

    def _shown(self, path: Path) -> str:
        root = self._request.config.rootpath
        return str(path.relative_to(root) if path.is_relative_to(root) else path)

    def _report(self, text: str) -> None:
        # Reports carry it to the process that prints, with pytest-xdist too.
        self._request.node.user_properties.append((_PROPERTY, text))


def _plain(name: str) -> str:
    return re.sub(r"[^\w.+-]+", "_", name).strip("._")[:120] or "model"


@pytest.fixture
def mbkit_baseline(request: pytest.FixtureRequest) -> MbkitBaseline:
    """Call it with a model: hold it against its baseline, or record that with ``--mbkit-regen``."""
    return MbkitBaseline(request)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print which baselines were recorded or skipped, and which should be recorded again."""
    messages = {
        text: None
        for reports in terminalreporter.stats.values()
        for report in reports
        if getattr(report, "when", "") == "call"
        for key, text in getattr(report, "user_properties", ())
        if key == _PROPERTY
    }
    if messages:
        terminalreporter.section("mbkit")
        for text in messages:
            terminalreporter.write_line(text)
