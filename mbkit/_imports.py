"""Imports that no import statement can make: packages that are functions, and modules of upper rooms for lower ones."""

from __future__ import annotations

import importlib
import sys

# The module typing is no light one, and the command listens to Ctrl-C only after this.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from types import ModuleType
    from typing import Any

_handed_down: dict[str, str] = {}


def hand_down(modules: Mapping[str, str]) -> None:
    """Let lower rooms use modules of upper ones by name.

    No room imports one above it. A model under constraints draws its states by the own derivation, for example, and a
    step of dynamics is a step of runs; the table of `mbkit.__init__` has all such modules.
    """
    _handed_down.update(modules)


def from_above(name: str) -> Any:
    """Return a module that was handed down, imported at its first use."""
    return importlib.import_module(_handed_down[name])


def make_callable(package: str, function: Callable[..., Any]) -> None:
    """Let a package be called as one of its functions.

    Importing ``mbkit.load`` binds the package to the name ``load`` in `mbkit`, which is also the function's name;
    so it is both. It has the function's signature and docstring and the package's public names, and can be pickled.
    """
    import inspect
    from types import ModuleType

    module = sys.modules[package]
    public = sorted(module.__all__)
    signature = inspect.signature(function)
    itself = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)

    # Without a docstring, which a shell would show beside the package's own.
    def call(_self: ModuleType, /, *args: Any, **kwargs: Any) -> Any:
        return function(*args, **kwargs)

    call.__signature__ = signature.replace(parameters=[itself, *signature.parameters.values()])  # type: ignore[attr-defined]

    class CallablePackage(ModuleType):
        __call__ = call

        def __dir__(self) -> list[str]:
            return public

        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return importlib.import_module, (package,)

    module.__class__ = CallablePackage
    module.__doc__ = function.__doc__
    module.__signature__ = signature  # type: ignore[attr-defined]
