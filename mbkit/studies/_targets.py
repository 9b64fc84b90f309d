"""Models and engines by the names that users write."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import sys
import traceback
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from mbkit import catalog
from mbkit._check import real
from mbkit.engines.registry import ENGINES, REFERENCE, compared, find_engine
from mbkit.engines.remote.packages import EngineVersion, names_version, remote_engines
from mbkit.engines.remote.packages import engine as named_version
from mbkit.errors import InputError, LoadError, MbkitError, MbkitWarning, UnknownNameError, UnsupportedError
from mbkit.load import load
from mbkit.load.loader import find
from mbkit.methods.registry import METHODS, method_of
from mbkit.model import Model

_FUNCTION: Final = re.compile(r"[^\W\d][\w.]*:[^\W\d][\w.]*")


def model_of(target: str, options: Mapping[str, Any] | None = None) -> Model:
    """Return the model of a robot's name, a catalog system, a path or ``package.module:function``.

    The function has no arguments and returns a `Model`; the current folder is searched first. `options` are keyword
    arguments of `mbkit.load`, for robots and files only. What a user's function raises becomes a `LoadError`.
    """
    options = options or {}
    if _FUNCTION.fullmatch(target) and not os.path.exists(target):
        _refuse(options, "a function")
        return _from_function(target)
    named = catalog.systems()
    if target in named:
        if find(target) is None:
            _refuse(options, "a catalog system")
            return named[target]()
        message = f"{target!r} is a robot and a catalog system; this is the robot, mbkit.catalog:{target} is the other"
        warnings.warn(message, MbkitWarning, stacklevel=2)
    try:
        return load(target, **options)
    except UnknownNameError as error:
        hint = "(mbkit robots lists them; a path ends in .urdf or .xml, a function is package.module:function)"
        raise UnknownNameError("robot or catalog system", target, [*named, *error.known], hint) from None


def is_code(target: str) -> bool:
    """Return whether `model_of` would import and call what a text names: a function, and no system of mbkit's own."""
    if not _FUNCTION.fullmatch(target):
        return False
    module, _, name = target.partition(":")
    if module == "mbkit.lagrangian.systems":
        from mbkit.lagrangian import systems

        return name not in systems.names()
    return module != "mbkit.catalog" or name not in catalog.systems()


def _refuse(options: Mapping[str, Any], what: str) -> None:
    if options:
        names = ", ".join(options)
        raise InputError(f"{names}: only for robots and files; the target is {what}, which makes its own model")


def function_of(target: str) -> Any:
    """Return what ``package.module:function`` names; the current folder is searched first."""
    module_name, _, name = target.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    with _blamed(f"{target}: cannot import {module_name!r}"):
        value: Any = importlib.import_module(module_name)
    where = module_name
    for part in name.split("."):
        if not hasattr(value, part):
            raise UnknownNameError("function", part, [n for n in dir(value) if n[0] != "_"], f"(in {where})")
        value, where = getattr(value, part), f"{where}.{part}"
    return value


def _from_function(target: str) -> Model:
    value = function_of(target)
    if callable(value):
        with _blamed(f"{target}: the function failed"):
            value = value()
    if not isinstance(value, Model) and isinstance(getattr(value, "model", None), Model):
        # A system on paper, which knows itself as a model.
        value = value.model
    if not isinstance(value, Model):
        message = f"expected a Model, got {type(value).__name__}; return mbkit.load(...) or builder.build()"
        raise LoadError(f"{target}: {message}")
    return value


@contextlib.contextmanager
def _blamed(what: str) -> Iterator[None]:
    """Turn any exception of a user's code into a `LoadError` that says where it was."""
    try:
        # Its prints must not end up among a caller's JSON.
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f" ({place.filename}, line {place.lineno})"
        # The message itself may say where, or the fault is not in code.
        ours = place.filename == __file__ or place.filename.startswith("<frozen")
        if ours or isinstance(error, (SyntaxError, MbkitError)):
            where = ""
        raise LoadError(f"{what}: {type(error).__name__}: {error}{where}") from error


# Targets of baselines as text: a robot's name, a function, or a file by its place beside the baseline.


def checked_target(target: object, options: object = None) -> None:
    """Refuse what a baseline cannot keep as a target, or as the options that it is loaded with."""
    if not isinstance(target, str):
        raise InputError(f"target: expected a text such as 'panda' or './arm.urdf', got {type(target).__name__}")
    if options is None:
        return
    names, values = (list(options), [*options.values()]) if isinstance(options, Mapping) else ([None], [])
    parts = [y for x in values for y in (x if isinstance(x, (list, tuple)) else [x])]
    if not all(isinstance(k, str) for k in names) or not all(isinstance(x, (bool, int, float, str)) for x in parts):
        raise InputError(f"options: expected keyword arguments of mbkit.load, of numbers and texts, got {options!r}")


def kept(target: str, baseline: Path) -> str:
    """Return a target as a baseline keeps it: a file relative to the baseline, with a dot first, as in no name."""
    if not os.path.isfile(target):
        return target
    try:
        relative = Path(os.path.relpath(target, baseline.absolute().parent)).as_posix()
    except ValueError:
        # Another drive: there is no way from one to the other.
        return Path(target).absolute().as_posix()
    return relative if relative.startswith(".") else f"./{relative}"


def resolved(target: str, baseline: Path) -> str:
    """Return a kept target as it is loaded from the current folder."""
    return os.path.normpath(baseline.absolute().parent / target) if target.startswith(".") else target


def kept_options(options: Mapping[str, Any], baseline: Path) -> dict[str, Any]:
    """Return options of loading as a baseline keeps them: a file of loops by its place, as a target is."""
    return {k: kept(x, baseline) if k == "loops" and isinstance(x, str) else x for k, x in options.items()}


def resolved_options(options: Mapping[str, Any], baseline: Path) -> dict[str, Any]:
    """Return kept options as a target is loaded with them from the current folder."""
    return {k: resolved(x, baseline) if k == "loops" and isinstance(x, str) else x for k, x in options.items()}


# Engines that are there, and models as any of them takes them.


def with_values(model: Model, purpose: str = "") -> Model:
    """Return the model with numbers for its named parameters, which not every engine takes.

    With a purpose, a parameter without a value is an error.
    """
    if purpose:
        model.require_values(purpose)
    values = {name: x for name, x in model.parameters.items() if x is not None}
    return model.with_parameters(**values) if values else model


def names_of(what: str, names: object) -> tuple[str, ...]:
    """Return names as a tuple, each once; `what` begins the message of an error."""
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise InputError(f"{what}: expected several names, got {names!r}; write ({names!r},)")
    unique = tuple(dict.fromkeys(names))
    if not unique:
        raise InputError(f"{what}: expected at least one name, got none")
    for name in unique:
        if not isinstance(name, str):
            raise InputError(f"{what}: expected names, got {name!r}")
    return unique


def numbers_of(what: str, values: object, **sign: bool) -> tuple[float, ...]:
    """Return numbers as a tuple, at least one; `what` begins the message of an error, `sign` is as in `real`."""
    if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        raise InputError(f"{what}: expected several numbers, got {values!r}")
    numbers = tuple(real(f"{what}[{i}]", x, **sign) for i, x in enumerate(values))
    if not numbers:
        raise InputError(f"{what}: expected at least one number, got none; leave it out for the study's own")
    return numbers


def engine_names(engines: object, least: int = 1) -> tuple[str, ...]:
    """Return the names of engines that can be compared and measured, each once; other versions too, as `dynamics`."""
    known = compared()
    if isinstance(engines, Iterable) and not isinstance(engines, str):
        # An engine that always has an environment is its newest tested version.
        engines = [named_version(x) if names_version(x) else x for x in engines]
        engines = [x.name if isinstance(x, EngineVersion) else x for x in engines]
    names = names_of("engines", engines)
    for name in names:
        if name == REFERENCE:
            raise InputError("engines: the oracle is the reference by which the others are measured; leave it out")
        if "==" in name:
            find_engine(name)
        elif name not in known:
            raise UnknownNameError("engine", name, (*known, *remote_engines()))
    if len(names) < least:
        raise InputError(f"engines: expected at least {least} of {list(known)}, got {list(names)}")
    return names


def methods_by_engine(
    engines: Sequence[str], methods: Sequence[str] | Mapping[str, Sequence[str]] | None
) -> dict[str, tuple[str, ...]]:
    """Return the methods of each engine, checked: all, those named for all engines that have them, or for each."""
    names = engine_names(engines)
    if isinstance(methods, Mapping):
        for engine in methods:
            if engine not in names:
                raise InputError(f"methods: {engine!r} is not among the engines {list(names)}")
        wanted = {engine: names_of(f"methods[{engine!r}]", methods[engine]) for engine in names if engine in methods}
        if not wanted:
            raise InputError("methods: expected the methods of at least one engine, got none")
        for engine, own in wanted.items():
            for method in map(method_of, own):
                if not method.on(engine):
                    raise InputError(
                        f"methods[{engine!r}]: {method.name} is not on {engine}; it is on {', '.join(method.engines)}"
                    )
    else:
        wanted = dict.fromkeys(names, tuple(METHODS) if methods is None else names_of("methods", methods))
    out = {e: tuple(m for m in ms if method_of(m).on(e)) for e, ms in wanted.items()}
    available = {name for ms in out.values() for name in ms}
    for name in dict.fromkeys(m for ms in wanted.values() for m in ms):
        if methods is not None and name not in available:
            raise InputError(
                f"methods: {name} is not on {' or '.join(wanted)}; it is on {', '.join(METHODS[name].engines)}"
            )
    return out


def not_installed(engines: Iterable[str]) -> dict[str, str]:
    """Return the engines that are not installed, each with how to get it; unknown names are left to others."""
    out = {}
    for name in engines:
        if names_version(name):
            # Another version has an environment, or gets one.
            try:
                named_version(name).interpreter()
            except UnsupportedError as error:
                out[name] = str(error)
            continue
        if name not in ENGINES:
            continue
        try:
            ENGINES[name].load()
        except UnsupportedError:
            out[name] = f"not installed; pip install {ENGINES[name].package}"
    return out
