"""Solvers: fixed step, adaptive, automatic, and those of SciPy, heyoka, MuJoCo and Drake."""

from __future__ import annotations

import importlib
from typing import Any


def load(module: str, function: str) -> Any:
    """Return the function that runs a method, which `mbkit.methods` names; it is imported at its first use."""
    return getattr(importlib.import_module(f"{__name__}.{module}"), function)
