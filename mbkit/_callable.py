"""Packages that carry the name of their main function: `mb.load(...)`, `mb.simulate(...)`."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

__all__ = ["make_callable"]


def make_callable(package: str, function: Callable[..., Any]) -> None:
    """Let a package be called as one of its functions.

    Importing ``mbkit.load`` binds the package to the name ``load`` in `mbkit`, where
    people expect the function; so it is both. It shows the function's signature and
    docstring, and can be sent to worker processes.
    """

    class CallablePackage(ModuleType):
        __call__ = staticmethod(function)

        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return importlib.import_module, (package,)

    module = sys.modules[package]
    module.__class__ = CallablePackage
    module.__doc__ = function.__doc__
