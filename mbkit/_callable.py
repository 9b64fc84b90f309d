"""Packages that carry the name of their main function: `mb.load(...)`, `mb.simulate(...)`."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(package: str, function: Callable[..., Any]) -> None:
    """Let a package be called as one of its functions.

    Importing ``mbkit.load`` binds the package to the name ``load`` in `mbkit`, which is also the function's name;
    so it is both. It has the function's signature and docstring and the package's public names, and can be pickled.
    """
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
