"""Asserts for tests of robots and engines, in pytest, unittest or a script.

Each raises AssertionError with the difference, the joint, and what to do next. `mbkit.pytest_plugin` has fixtures too.
"""

from __future__ import annotations

import os
import unittest
from collections.abc import Iterable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from mbkit._check import MAX_LINES
from mbkit.engines.registry import STANDARD, find_engine
from mbkit.errors import InputError

if TYPE_CHECKING:
    from mbkit.model import Model
    from mbkit.studies.baseline import BaselineResult
    from mbkit.studies.compare.result import Comparison
    from mbkit.studies.explain import Explanation
    from mbkit.studies.lint import LintFinding, LintResult

__all__ = ["STRICT", "assert_baseline", "assert_engines_agree", "assert_plausible", "assert_same_dynamics"]

#: Set to 1, an engine that is not installed fails a test instead of being skipped.
STRICT = "MBKIT_TEST_STRICT"


def assert_engines_agree(
    model: Model,
    engines: Sequence[str] = STANDARD,
    rtol: float = 1e-12,
    *,
    samples: int = 16,
    seed: int = 0,
    strict: bool | None = None,
) -> Comparison:
    """Assert that every engine gives every term of a model as the 34-digit oracle does.

    Parameters
    ----------
    model : Model
    engines : sequence of str
        At least two. One that is not installed is left out; one that refuses the model fails.
    rtol : float
        Largest error, normwise relative to the forces at play, as `mbkit.compare` measures it.
    samples, seed : int
        Random states, beside which stand neutral, at-limit and near-singular ones.
    strict : bool, optional
        Whether an engine that is not installed fails; by default as ``MBKIT_TEST_STRICT`` says.

    Raises
    ------
    AssertionError
        Engines differ; with terms, joints, the worst state, known defects and versions.
    unittest.SkipTest
        Fewer than two of the engines are installed.

    Examples
    --------
    >>> import mbkit as mb
    >>> from mbkit.testing import assert_engines_agree
    >>> assert_engines_agree(mb.catalog.pendulum(), engines=("pinocchio", "lagrangian"), samples=2).passed
    True
    """
    __tracebackhide__ = True
    from mbkit.studies import compare
    from mbkit.studies._targets import not_installed
    from mbkit.studies.document import to_text

    missing = {} if isinstance(engines, str) else not_installed(engines)
    present = [name for name in engines if name not in missing]
    message = "; ".join(f"{name}: {why}" for name, why in missing.items())
    if missing and _strict(strict):
        raise AssertionError(f"engines are missing, and the test is strict: {message}")
    if missing and len(present) < 2:
        raise unittest.SkipTest(message)
    result = compare(model, present if missing else engines, samples, seed, tolerance=rtol, terms_only=True)
    if not result.passed or any(not r.term for r in result.refusals):
        lines = [to_text(result.document(full=False), MAX_LINES)]
        if worst := result.worst:
            lines.append(f"  worst state ({worst.worst_kind}): q = {list(worst.worst_q)}, v = {list(worst.worst_v)}")
        packages = ((e, find_engine(e).distribution) for e in result.engines)
        # A user's own engine goes by its own name.
        versions = (f"{x} {result.versions[x]}" if x in result.versions else e for e, x in packages)
        lines.append(f"  {', '.join(versions)}")
        lines.append(f"  to see it all: mbkit.compare(model, {result.engines}, {result.samples}, {result.seed})")
        raise AssertionError("\n".join(lines))
    return result


def assert_same_dynamics(
    model_a: Model, model_b: Model, rtol: float = 1e-9, *, samples: int = 3, seed: int = 0
) -> Explanation:
    """Assert that two models move alike: the same terms at the same states, joint by joint.

    Joints may stand in another order, bodies be cut otherwise, and frames be drawn elsewhere.

    Parameters
    ----------
    model_a, model_b : Model
    rtol : float
        Largest difference, normwise relative to the forces at play. A converted file has as many digits as its
        converter wrote.
    samples, seed : int
        Random states.

    Raises
    ------
    AssertionError
        They do not; with the causes that make the difference vanish, or the smallest part that differs.

    Examples
    --------
    >>> import mbkit as mb
    >>> from mbkit.testing import assert_same_dynamics
    >>> assert_same_dynamics(mb.catalog.pendulum(), mb.catalog.pendulum()).agree
    True
    """
    __tracebackhide__ = True
    from mbkit.studies.document import to_text
    from mbkit.studies.explain import explain

    names = (model_a.name, model_b.name) if model_a.name != model_b.name else ("model_a", "model_b")
    result = explain(model_a, model_b, samples=samples, seed=seed, tolerance=rtol, names=names)
    if not result.agree:
        raise AssertionError(to_text(result.document(), MAX_LINES))
    return result


def assert_plausible(
    model: Model | str | os.PathLike[str], *, ignore: Iterable[str] = (), control_period: float = 1e-3
) -> LintResult:
    """Assert that nothing in a description is wrong for sure or likely, by what it knows of itself (`mbkit.lint`).

    Parameters
    ----------
    model : Model, str or path
    ignore : iterable of str
        Checks, links and joints, or ``"part: check"``, whose findings are known and accepted; with wildcards.
    control_period : float
        s.

    Raises
    ------
    AssertionError
        Some findings are sure or likely; with each one's link, number and what is expected.

    Examples
    --------
    >>> from mbkit.testing import assert_plausible
    >>> assert_plausible("ur5", ignore=["wrist_*: *"]).passed
    False
    """
    __tracebackhide__ = True
    from mbkit.studies.document import to_text
    from mbkit.studies.lint import lint
    from mbkit.studies.lint.result import LOOK

    if isinstance(ignore, str):
        raise InputError(f"ignore: expected several names, got {ignore!r}; write [{ignore!r}]")
    result, accepted = lint(model, control_period=control_period), [*ignore]

    def known(row: LintFinding) -> bool:
        names = row.part, row.check, f"{row.part}: {row.check}"
        return any(fnmatchcase(name, pattern) for name in names for pattern in accepted)

    wrong = [row for row in result.rows if row.confidence != LOOK and not known(row)]
    if wrong:
        raise AssertionError(to_text(replace(result, rows=tuple(wrong)).document(), MAX_LINES))
    return result


def assert_baseline(
    model: Model,
    path: str | os.PathLike[str],
    *,
    strict: bool | None = None,
    target: str | None = None,
    remedy: str = "",
) -> BaselineResult:
    """Assert that a model and the engines are as a baseline has them.

    Parameters
    ----------
    model : Model
    path : path
        Of the file of `mbkit.baseline.record`.
    strict : bool, optional
        Whether a recorded engine that is not installed fails; by default as ``MBKIT_TEST_STRICT`` says.
    target : str, optional
        Where the model was loaded from, if not from the recorded target.
    remedy : str
        How to record again, for the message.

    Returns
    -------
    BaselineResult
        The status ``"versions"`` says that it is time to record again.

    Raises
    ------
    AssertionError
        A parameter or a number changed.
    unittest.SkipTest
        None of the engines is installed.
    BaselineError
        The file cannot be read, or is another robot's.
    """
    __tracebackhide__ = True
    from mbkit.studies.baseline import check

    result = check(model, path, strict=_strict(strict), target=target)
    if result.status == "skipped" and not result.strict:
        raise unittest.SkipTest(result.verdict)
    if not result.passed:
        raise AssertionError(result.text(remedy or f"mbkit.baseline.record(model, {os.fspath(path)!r})"))
    return result


def _strict(strict: bool | None) -> bool:
    return os.environ.get(STRICT, "0") not in ("", "0") if strict is None else strict
