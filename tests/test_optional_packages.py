"""What an installation may lack is imported only where it is used."""

from __future__ import annotations

import subprocess
import sys

import pytest

#: Packages -> modules of mbkit that are about nothing else.
OPTIONAL = {
    ("pydrake", "heyoka", "distributed"): ("mbkit.engines.drake.",),
    ("llvmlite",): ("mbkit.codegen.", "_compiled", "compiled_"),
}
SCRIPT = """
import importlib, pkgutil, sys
sys.modules.update(dict.fromkeys({packages!r}))
import mbkit as mb
for found in pkgutil.walk_packages(mb.__path__, "mbkit."):
    if not found.name.endswith("__main__") and not any(part in found.name for part in {own!r}):
        importlib.import_module(found.name)
model = mb.catalog.pendulum()
assert mb.compare(model, samples=2, terms_only=True).passed
run = mb.simulate(mb.dynamics(model, "lagrangian", compile=False), [0.1], [0.0], 0.01, "implicit_midpoint")
assert run.stats.finished
"""


@pytest.mark.parametrize("packages", OPTIONAL, ids=" ".join)
def test_everything_else_works_without(packages: tuple[str, ...]) -> None:
    script = SCRIPT.format(packages=packages, own=OPTIONAL[packages])
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
