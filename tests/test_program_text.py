"""Programs of named terms: what they compute, how long they are, and what they refuse."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys

import numpy as np
import pytest
import sympy as sp
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.lagrangian import Lagrangian, program
from tests.kind_paths import program_of
from tests.kind_studies import cell
from tests.random_trees import random_tree
from tests.scenes import mounted

EPS = float(np.finfo(float).eps)
QUANTITIES = {
    "mass_matrix": "q",
    "coriolis_matrix": "qv",
    "gravity": "q",
    "passive": "qv",
    "inverse_dynamics": "qva",
    "forward_dynamics": "qvt",
    "kinetic_energy": "qv",
    "potential_energy": "q",
}


def state(model: mb.Model, letters: str, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng)
    numbers = {"q": q, "v": v, "a": rng.standard_normal(model.nv), "t": rng.standard_normal(model.nv)}
    return [numbers[x] for x in letters]


def run(code: str, quantity: str, *arguments: np.ndarray) -> np.ndarray:
    names: dict = {}
    exec(code, names)
    return np.asarray(names[quantity](*arguments))


@pytest.mark.thorough(every=5)
@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("name", ["ur5", "cart_pole", "tree"])
def test_the_python_of_a_program_is_the_engine(name, quantity) -> None:
    models = {"ur5": lambda: mb.load("ur5"), "cart_pole": mb.catalog.cart_pole, "tree": lambda: random_tree(3, n=4)}
    model = models[name]()
    given = state(model, QUANTITIES[quantity])
    expected = np.asarray(getattr(mb.dynamics(model, "lagrangian", compile=False), quantity)(*given))
    scale = np.abs(expected).max() + 1e-300
    # The same operations, but for numbers that SymPy joins.
    assert run(program(model, quantity).python(), quantity, *given) == pytest.approx(expected, abs=1e3 * EPS * scale)


def test_a_robot_of_six_joints_fits_on_three_pages() -> None:
    text = program(mb.load("ur5"), "inverse_dynamics")
    lines = str(text).splitlines()
    # 55 lines a page.
    assert len(lines) < 165
    assert max(map(len, lines)) <= 100
    assert text.operations < 500
    assert sum(x.count_ops() for _, x in text.terms) < 2 * text.operations
    assert r"s_{2} &= \sin" in text.latex()
    assert pickle.loads(pickle.dumps(text)).python() == text.python()


def test_named_parameters_keep_their_names() -> None:
    m, k = sp.symbols("m k")
    x, xdot = sp.symbols("x xdot")
    model = mb.lagrangian.Lagrangian(m * xdot**2 / 2, k * x**2 / 2, [x], parameters={m: 2.0, k: 3.0}).model
    text = program(model, "forward_dynamics")
    assert dict(text.inputs)["parameters"] == (m, k)
    given = [np.array([0.5]), np.array([0.1]), np.array([0.2]), np.array([2.0, 3.0])]
    assert run(text.python(), "forward_dynamics", *given) == pytest.approx((0.2 - 3 * 0.5) / 2, rel=1e-15)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc here")
def test_the_c_of_a_program_computes_the_same(tmp_path) -> None:
    model = mb.load("ur5")
    q, v, a = state(model, "qva")
    listed = ["{" + ", ".join(map(repr, x.tolist())) + "}" for x in (q, v, a)]
    source = program(model, "inverse_dynamics").c() + (
        "#include <stdio.h>\nint main(void) {\n"
        + "".join(f"double {n}[] = {x};\n" for n, x in zip("qva", listed, strict=True))
        + f"double out[{model.nv}];\ninverse_dynamics(q, v, a, out);\n"
        + f'for (int i = 0; i < {model.nv}; i++) printf("%.17g\\n", out[i]);\nreturn 0;\n}}\n'
    )
    (tmp_path / "main.c").write_text(source)
    subprocess.run(["gcc", "-std=c99", "-o", "main", "main.c", "-lm"], cwd=tmp_path, check=True)
    printed = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    expected = mb.dynamics(model, "lagrangian", compile=False).inverse_dynamics(q, v, a)
    assert np.array(printed.split(), dtype=float) == pytest.approx(expected, abs=1e3 * EPS * np.abs(expected).max())


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc here")
@pytest.mark.parametrize("case", ["abs", "max", "piecewise", "both"])
def test_cases_are_lines_too(case, tmp_path) -> None:
    x, xdot = sp.symbols("x xdot")
    potentials = {
        "abs": sp.Abs(x),
        "max": sp.Max(x, x**2),
        "piecewise": sp.Piecewise((x**2, x > 0), (3 * x, x > -1), (0, True)),
        "both": sp.Piecewise((x**4, sp.And(x > 0, x < 1)), (sp.Abs(x) * x, True)),
    }
    model = Lagrangian(xdot**2 / 2, potentials[case], [x]).model
    dyn, text = mb.dynamics(model, "lagrangian", compile=False), program(model, "gravity")
    source = text.c() + (
        "#include <stdio.h>\nint main(void) {\ndouble out[1];\n"
        + "".join(
            f'{{double q[] = {{{x}}}; gravity(q, out); printf("%.17g\\n", out[0]);}}\n' for x in (-1.5, -0.4, 0.3, 1.7)
        )
        + "return 0;\n}\n"
    )
    (tmp_path / "main.c").write_text(source)
    subprocess.run(["gcc", "-std=c99", "-o", "main", "main.c", "-lm"], cwd=tmp_path, check=True)
    printed = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.split()
    for q, out in zip((-1.5, -0.4, 0.3, 1.7), printed, strict=True):
        expected = dyn.gravity([q])[0]
        assert run(text.python(), "gravity", np.array([q])) == pytest.approx(expected, abs=1e-14)
        assert float(out) == pytest.approx(expected, abs=1e-14)
    assert "Piecewise" not in str(text)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc here")
@pytest.mark.parametrize("names", [("double", "static"), ("q_", "v_"), ("sin", "cos")])
def test_names_of_parameters_that_c_has_for_itself_are_others(names, tmp_path) -> None:
    x, xdot = sp.symbols("x xdot")
    a, b = map(sp.Symbol, names)
    model = Lagrangian(a * xdot**2 / 2, b * sp.sin(x) + a * sp.cos(2 * x), [x], parameters={a: 1.5, b: 0.5}).model
    source = program(model, "inverse_dynamics").c() + (
        "#include <stdio.h>\nint main(void) {\n"
        "double q[] = {0.3}, v[] = {0.2}, a[] = {0.7}, p[] = {1.5, 0.5}, out[1];\n"
        'inverse_dynamics(q, v, a, p, out);\nprintf("%.17g", out[0]);\nreturn 0;\n}\n'
    )
    (tmp_path / "main.c").write_text(source)
    subprocess.run(["gcc", "-std=c99", "-o", "main", "main.c", "-lm"], cwd=tmp_path, check=True)
    printed = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert float(printed) == pytest.approx(1.5 * 0.7 + 0.5 * np.cos(0.3) - 3 * np.sin(0.6), rel=10 * EPS)


def test_what_a_program_cannot_hold_is_refused() -> None:
    for bad in (None, "ur5", mb.lagrangian.systems.kepler()):
        with pytest.raises(InputError, match="model: expected a Model"):
            program(bad)
    with pytest.raises(UnknownNameError, match="quantity"):
        program(mb.catalog.pendulum(), ["gravity"])
    with pytest.raises(UnknownNameError, match="inverse_dynamic"):
        program(mb.catalog.pendulum(), "inverse_dynamic")
    with pytest.raises(UnsupportedError, match="results"):
        program(mb.catalog.pendulum(), "forward_dynamics_derivatives")
    still = mounted("statue", "stone", "foot", "fixed", mass=2.0)
    with pytest.raises(UnsupportedError, match="no joint that moves"):
        program(still.build())


def test_the_command_prints_and_writes_it(tmp_path) -> None:
    run = CliRunner().invoke
    shown = run(cli, ["derive", "panda", "--program", "inverse_dynamics"])
    assert shown.exit_code == 0
    assert "named terms" in shown.output
    written = run(cli, ["derive", "ur5", "--program", "gravity", "--python", "--out", str(tmp_path)])
    assert written.exit_code == 0
    module = (tmp_path / "ur5.py").read_text()
    assert subprocess.run([sys.executable, "-c", module], check=False).returncode == 0
    assert run(cli, ["derive", "ur5", "--program", "gravities"]).exit_code == 2
    assert run(cli, ["derive", "ur5", "--program", "gravity", "--json"]).exit_code == 2


def test_what_is_no_number_where_rows_depend_on_each_other_is_written() -> None:
    """A bead on a circle: its equations have a branch without a number, which its state does not enter."""
    q, v = sp.symbols("x y z"), sp.symbols("xdot ydot zdot")
    T, V = sum(x**2 for x in v) / 2, 9.81 * q[1]
    bead = Lagrangian(T, V, q, v, constraints=[sum(x**2 for x in q) - 1, q[2]], name="bead")
    text, scope = program(bead.model, "forward_dynamics"), {}
    exec(text.python(), scope)
    a = np.ravel(scope["forward_dynamics"]([0.6, 0.8, 0.0], [0.8, -0.6, 0.0], [0.0, 0.0, 0.0]))
    # The circle's force along (x, y) makes up for gravity's part and the turn.
    wanted = np.array([0.0, -9.81, 0.0]) + (9.81 * 0.8 - 1.0) * np.array([0.6, 0.8, 0.0])
    assert a == pytest.approx(wanted, rel=1e-12, abs=1e-14)


def test_conditions_of_a_loop_are_read_back_from_print(tmp_path) -> None:
    """Minima, negations and joined comparisons decide which rows are solved; the truth is NumPy's."""
    got = cell("loop.point", "program text and LaTeX, read", tmp_path)
    assert got.outcome == "right", got
    assert "constraints hold accelerations" in str(program_of("loop.point"))
