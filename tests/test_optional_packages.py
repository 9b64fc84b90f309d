"""What an installation may lack is imported only where it is used."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

#: Packages -> modules of mbkit that are about nothing else.
OPTIONAL = {
    ("pydrake", "heyoka", "distributed", "cvxpy", "clarabel"): ("mbkit.engines.drake.", "remote.on_drake"),
    ("llvmlite",): ("mbkit.codegen.", "_compiled", "compiled_"),
}
#: Packages that an installation has, unless somebody removed one -> what fails without, in a script.
NEEDED = {
    "matplotlib": (
        "mb.simulate(mb.dynamics(model, 'pinocchio'), [0.1], [0.0], 0.01, 'rk4', 1e-3).plot()",
        "mb.simulate(mb.dynamics(model, 'pinocchio'), [0.1], [0.0], 0.01, 'rk4', 1e-3).picture()",
        "mb.show(model, path='a.gif')",
        "mb.compare(model, samples=1, terms_only=True).plot()",
    ),
    "sympy": ("mb.lagrangian.Lagrangian", "mb.lagrangian.systems"),
    "mpmath": ("mb.dynamics(model, 'oracle', backend='mpmath').nle([0.1], [0.1])",),
    "heyoka": ("mb.simulate(mb.dynamics(model, 'lagrangian'), [0.1], [0.0], 0.01, 'taylor')",),
    "casadi": ("mb.dynamics(model, 'lagrangian')",),
    "mujoco": ("mb.dynamics(model, 'mujoco')",),
}
WITHOUT = """
import sys
sys.modules[{package!r}] = None
import mbkit as mb
model = mb.catalog.pendulum()
for line in {lines!r}:
    try:
        eval(line)
    except mb.errors.UnsupportedError as error:
        assert "not installed" in str(error) and "pip install {package}" in str(error), error
    else:
        raise AssertionError(line)
"""
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


@pytest.mark.thorough("llvmlite")
@pytest.mark.parametrize("packages", OPTIONAL, ids=" ".join)
def test_everything_else_works_without(packages: tuple[str, ...]) -> None:
    # Files of engines in environments of their own import these.
    script = SCRIPT.format(packages=packages, own=(".remote.", *OPTIONAL[packages]))
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.thorough("matplotlib", "sympy", "mpmath", "heyoka")
@pytest.mark.parametrize("package", NEEDED)
def test_a_missing_package_is_named_with_the_command_that_installs_it(package: str) -> None:
    script = WITHOUT.format(package=package, lines=NEEDED[package])
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.thorough("matplotlib", "rich")
@pytest.mark.parametrize("package", ["jinja2", "matplotlib", "rich"])
def test_the_command_names_a_missing_package(package: str, tmp_path: Path) -> None:
    script = f"import sys; sys.modules[{package!r}] = None; from mbkit.__main__ import main; main()"
    command = [
        sys.executable,
        "-c",
        script,
        *["check", "pendulum", "--samples", "1", "--no-rollouts", "--out"],
        str(tmp_path),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert f"pip install {package}" in done.stderr
