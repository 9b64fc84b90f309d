"""A part of `python -m validation` with little of everything: whether it still runs, in seconds.

Each script has a dict `SMOKE`: names of its constants, or dotted ones of another script, and what stands for them here;
variables of the environment too.
``python -m validation --smoke [PART ...]`` runs the parts so, and ``tests/test_validation.py`` all of them. What is
written goes into a folder of its own, and is thrown away.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import warnings
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

from mbkit.engines.remote import environment
from tests.fake_cuda import fake_gpu

#: Nothing is worth a compiler, and the figures have no window.
ENVIRONMENT = {"MBKIT_COMPILE": "0", "MPLBACKEND": "Agg"}


def run(name: str, folder: Path) -> dict[str, Any]:
    """Run a part with less, and return what it wrote: name of the file -> content.

    Raises
    ------
    SystemExit
        With the status of a part that did not end well.
    """
    from validation.__main__ import PARTS

    module = import_module(f"validation.{name}")
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    environments = folder / "environments"
    places = {"MBKIT_RESULTS": str(folder), "MBKIT_ENVIRONMENTS": str(environments)}
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        stack.enter_context(mock.patch.dict(os.environ, ENVIRONMENT | places))
        _present(environment.python_of(environment.place("mujoco", "4.0.0")))
        if name == "gpu":
            stack.enter_context(fake_gpu())
        stack.enter_context(mock.patch.object(sys, "argv", [name]))
        for place, value in module.SMOKE.items():
            if place in ENVIRONMENT:
                os.environ[place] = value
                continue
            of, _, constant = place.rpartition(".")
            owner = import_module(f"validation.{of}") if of else module
            stack.enter_context(mock.patch.object(owner, constant, value))
        if status := module.main():
            raise SystemExit(status)
    return {x: json.loads((folder / x).read_text(encoding="utf-8")) for x in PARTS[name].writes}


def _present(python: Path) -> None:
    """Make an environment of the present interpreter, as that of an engine's version."""
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n', encoding="utf-8")
    python.chmod(0o755)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        run(sys.argv[1], Path(place))
