"""Which engines are there."""

from __future__ import annotations

import importlib
from collections.abc import Iterable

from mbkit.engines import ENGINES

__all__ = ["not_installed"]


def not_installed(engines: Iterable[str]) -> dict[str, str]:
    """Return the engines that are not installed, each with how to get it; unknown names are left to others."""
    out = {}
    for name in engines:
        if name not in ENGINES:
            continue
        module, _, package = ENGINES[name]
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            if error.name and error.name.startswith("mbkit"):
                raise
            out[name] = f"not installed; pip install {package}"
    return out
