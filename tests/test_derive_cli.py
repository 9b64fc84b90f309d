"""`mbkit derive`: what is printed reads like a textbook, and what is written runs by itself."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
import sympy as sp
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.lagrangian import systems
from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.printer import ExpressionPrinter, folded, written
from mbkit.lagrangian.summary import SystemSummary, python_code, with_plain_turns
from mbkit.load.loader import find


@cache
def derive(*arguments, status=0):
    out = CliRunner().invoke(cli, ["derive", *map(str, arguments)])
    assert out.exit_code == status, out.output
    return out


def test_a_free_body_reads_in_newtons_and_eulers_equations():
    text = derive("free_body").stdout
    for line in ("m v̇₁ + m (v₃ ω₂ - v₂ ω₃) = 0", "θ̇ = ω₂ cos φ - ω₃ sin φ"):
        assert f"  {line}\n" in text
    assert r"\dot{\theta} &= \omega_{2} \cos {\phi}" in derive("free_body", "--latex").stdout


def test_a_slider_crank_reads_as_in_a_textbook():
    text = derive("slider_crank").stdout
    assert "T = ½ m r² (1 + r cos θ/ρ)² θ̇² sin² θ\n" in text
    assert "with ρ = √(l² - r² sin² θ)\n" in text
    half_slope = "m r² (cos θ + r (l² cos 2θ + r² sin⁴ θ)/ρ³) (1 + r cos θ/ρ)"
    assert f"[ {half_slope} θ̇ sin θ ]" in text
    equation = f"m r² (1 + r cos θ/ρ)² θ̈ sin² θ + {half_slope} θ̇² sin θ = τ + F r (1 + r cos θ/ρ) sin θ"
    assert equation in " ".join(text.split())


def test_the_name_of_a_slider_crank_means_one_system():
    out = derive("slider_crank")
    # Which system, its zero and its direction.
    for said in ("massless crank and rod", "dead centre", "farthest", "counterclockwise", "mbkit.catalog:slider_crank"):
        assert said in out.stderr
    loop = derive("mbkit.catalog:slider_crank")
    assert "coordinates θ, φ, x" in loop.stdout
    assert "m₃ ẍ = -λ₁" in loop.stdout
    assert "massless" not in loop.stderr


def test_terms_and_factors_stand_where_one_writes_them():
    acrobot = derive("mbkit.lagrangian.systems:acrobot").stdout
    assert "V = -(m₁ l_c₁ + m₂ l₁) g cos θ₁ - m₂ g l_c₂ cos(θ₁ + θ₂)\n" in acrobot
    assert "m l² θ̈ - m a l Ω² sin θ cos(Ω t) + m g l sin θ = 0" in derive("driven_pendulum").stdout
    assert "½ (2 (A - C) φ̇ cos θ - C ψ̇) sin θ" in derive("heavy_top").stdout
    # Coordinates in their own order, not the alphabet's, and no line beyond the page.
    names = sp.symbols("q1:12")
    board = ExpressionPrinter(names, sp.symbols("v1:12"))
    assert board.text(sp.cos(sum(names))).endswith("q₉ + q₁₀ + q₁₁)")
    a, b, m = sp.symbols("m1 m2 m3")
    v = sp.Symbol("v1")
    assert board.text((a + b) * m * v**2 + m * v ** sp.Symbol("n")) == "(m₁ + m₂) m₃ v₁² + m₃ v1**n"
    assert board.text(sp.Rational(2802749430154621, 302749430154621)) == "9.25765385825233"
    long = " + ".join(f"θ̇{k} sin(θ{k})" for k in range(40))
    assert max(sum(c != "\u0307" for c in line) for line in folded(long, 60)) <= 60


def test_systems_on_paper_and_functions_of_ones_own():
    assert "V = -k/r\n" in derive("kepler").stdout
    assert "Jacobi's integral" in derive("bead_on_hoop").stdout
    assert "time t" in derive("mbkit.lagrangian.systems:driven_pendulum").stdout
    out = derive("heavy_top")
    assert "Cyclic: φ, ψ" in out.stdout
    assert "Euler angles" in out.stderr


def test_long_names_are_told_once():
    text = derive("gyroscope").stdout
    assert "coordinates α (precession), β (nutation), γ (spin)" in text
    assert "C α̈ sin β + C γ̈ + C α̇ β̇ cos β = 0" in text


def test_a_files_rounded_quarter_turn_is_read_as_exact_and_said(tmp_path):
    """A quarter turn of 12 digits has a cosine of 5e-12, which would stand in most terms."""
    links = "".join(
        f'<link name="l{i}"><inertial><origin xyz="0.1 0.2 0.3"/><mass value="1"/>'
        '<inertia ixx="1" iyy="1.1" izz="1.2" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for i in range(2)
    )
    joint = (
        '<joint name="j{0}" type="revolute"><parent link="{1}"/><child link="l{0}"/><axis xyz="0 0 1"/>'
        '<origin rpy="1.57079632679 0 0" xyz="0.3 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    path = tmp_path / "arm.urdf"
    joints = joint.format(0, "base") + joint.format(1, "l0")
    path.write_text(f'<robot name="arm"><link name="base"/>{links}{joints}</robot>')

    out, exact = derive(path), derive(path, "--snap", 0)
    assert "e-1" not in out.stdout
    assert "4.9e-12" in out.stderr
    assert "e-1" in exact.stdout
    assert not exact.stderr
    assert len(out.stdout) < 0.6 * len(exact.stdout)
    assert derive(path, "--python").stdout == derive(path, "--python", "--snap", 0).stdout
    # What was left out is as small as it is said to be.
    model = mb.load(path)
    plain, _ = with_plain_turns(model, 1e-9)
    q, v = model.random_state(0, 20)
    ours, theirs = (mb.dynamics(m, "lagrangian") for m in (plain, model))
    difference = np.abs(ours.nle(q, v) - theirs.nle(q, v)).max()
    assert 0 < difference < 1e-10 * np.abs(theirs.nle(q, v)).max()


def test_derivation_says_how_far_it_is():
    seen = []
    lag = systems.get("double_pendulum")()
    SystemSummary(lag, progress=lambda fraction, what: seen.append((fraction, what))).text()
    assert [what for _, what in seen][-2:] == ["equation 1 of 2", "equation 2 of 2"]
    assert sorted(seen) == seen
    assert seen[0][0] == 0.0
    assert seen[-1][0] < 1.0


def test_json_can_be_read_back():
    data = json.loads(derive("cart_pole", "--json").stdout)
    lag = mb.lagrangian.Lagrangian(
        sp.sympify(data["T"], {n: sp.Symbol(n) for n in data["parameters"]}),
        sp.sympify(data["V"], {n: sp.Symbol(n) for n in data["parameters"]}),
        sp.symbols(data["coordinates"]),
        parameters={sp.Symbol(n): x for n, x in data["parameters"].items()},
    )
    assert _matrix(lag.equations().mass_matrix) == data["mass_matrix"]
    assert data["cyclic"] == ["x"]
    assert [c["name"] for c in data["conserved"]] == ["p_x", "E"]
    assert len(data["equations"]) == len(data["latex"]) == 2


def _matrix(A):
    return [[str(x) for x in A[i, :]] for i in range(A.rows)]


def test_latex_has_what_a_document_needs():
    text = derive("cart_pole", "--latex").stdout
    assert text.count(r"\begin{align*}") == text.count(r"\end{align*}") == 3
    assert r"T &= \tfrac{1}{2} \left(m_{c} + m_{p}\right) \dot{x}^{2} + m_{p} l \dot{x} \dot{\theta}" in text


@pytest.mark.thorough("slider_crank", "a robot")
@pytest.mark.parametrize("name", ["double_pendulum", "driven_pendulum", "slider_crank", "sliding_block", "a robot"])
def test_python_runs_by_itself(name, tmp_path):
    if name == "a robot":
        asked = find("double_pendulum").path
        ref = mb.dynamics(mb.load(asked), "lagrangian")
    else:
        asked = name
        read = mb.lagrangian.from_model(mb.catalog.get(name)()) if name == "double_pendulum" else systems.get(name)()
        ref = read.dynamics(options={"compile": False})
    path = derive(asked, "--python", "--out", tmp_path).stdout.split()[-1]
    n = ref.model.nv
    q, v, tau = np.random.default_rng(0).uniform(0.2, 1.0, (3, n))
    more = ", t=0.3" if name == "driven_pendulum" else ""
    program = f"""
import sys, runpy
sys.modules["mbkit"] = None
m = runpy.run_path({path!r})
q, v, tau = {q.tolist()}, {v.tolist()}, {tau.tolist()}
out = [m["mass_matrix"](q{more}).ravel(), m["nonlinear"](q, v{more}), m["forward_dynamics"](q, v, tau{more})]
print([float(x) for part in out for x in part])
"""
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path)
    got = np.array(json.loads(out.stdout))
    at = ref.at(t=0.3) if more else ref
    expected = [at.mass_matrix(q).ravel(), at.nle(q, v) - at.passive(q, v), at.forward_dynamics(q, v, tau)]
    assert np.allclose(got, np.concatenate(expected), rtol=1e-12, atol=1e-13)


def test_python_takes_parameters_by_name():
    space = {}
    exec(python_code(systems.pendulum()), space)
    assert space["forward_dynamics"]([0.3], [0.0], l=2.0) == pytest.approx([-9.81 / 2 * np.sin(0.3)], rel=1e-15)
    with pytest.raises(TypeError, match="no such parameters"):
        space["mass_matrix"]([0.3], length=2.0)


def test_c_compiles_and_holds_the_parameters(tmp_path):
    out = derive("cart_pole", "--c", "--out", tmp_path).stdout
    assert "cart_pole_forward_dynamics(q[2], v[2], tau[2], parameters[4])" in out
    derive("driven_pendulum", "--c", "--out", tmp_path)
    for stem in ("cart_pole", "driven_pendulum"):
        command = ["cc", "-std=c99", "-Wall", "-Werror", "-c", f"{stem}.c", "-o", f"{stem}.o"]
        subprocess.run(command, cwd=tmp_path, check=True)


def test_bad_input_is_one_message():
    out = derive("keplr", status=2)
    assert out.stderr.count("\n") == 1
    assert "'kepler'" in out.stderr
    assert "exclude each other" in derive("pendulum", "--json", "--latex", status=2).stderr
    said = derive("pendulum", "--python", "--latex", "--c", status=2).stderr
    assert all(x in said for x in ("--python", "--latex", "--c", "exclude each other"))
    assert "the function failed" in derive("json:dumps", status=2).stderr


def test_symbols_as_they_are_written():
    assert [written(n) for n in ("thetadot1", "m_p", "l_c1", "Omega", "p_phi", "m1")] == [
        "θ̇₁",
        "m_p",
        "l_c₁",
        "Ω",
        "p_φ",
        "m₁",
    ]


def test_dots_stand_on_the_letter_of_a_part_s_coordinate():
    names = ("x.x", "floating_base.theta1", "wrist.1")
    rates = [velocity_of(sp.Symbol(n)) for n in names]
    assert [written(r.name) for r in rates] == ["x.ẋ", "floating_base.θ̇₁", "wri̇st.1"]
    board = ExpressionPrinter((), ())
    assert [board.latex(r) for r in rates] == [r"x.\dot{x}", r"floating_{base}.\dot{\theta}_{1}", r"\dot{wrist}.1"]


def test_expressions_on_one_line():
    orbit = systems.kepler()
    board = ExpressionPrinter(orbit.coordinates, orbit.velocities)
    m, k, r, g, th = sp.symbols("m k r g theta")
    told = {
        -k / r: "-k/r",
        sp.Rational(7, 2) * m * g: "7/2 m g",
        k * sp.sin(th) ** 2 * sp.cos(th): "k sin² θ cos θ",
        sp.sqrt(1 - k**2): "√(1 - k²)",
        k * sp.Abs(g) / (m * r): "k |g|/(m r)",
        sp.Float(9.81) * m: "9.81 m",
        sp.cos(2 * th): "cos 2θ",
        sp.tanh(k / m): "tanh(k/m)",
        sp.sin(sp.Mul(2, m + k, evaluate=False)): "sin(2 (m + k))",
        sp.sin(2 * m + 2 * k): "sin(2 m + 2 k)",
        sp.cos(2 * sp.Symbol("lean")): "cos(2 lean)",
        sp.cos(th) / sp.sqrt(sp.cos(th) ** 2): "cos θ/|cos θ|",
        sp.sqrt((r - m) ** 2) * sp.sqrt(k**4): "k² |m - r|",
        1 / sp.sqrt(k**2 * g**2): "1/(|g| |k|)",
        sp.sqrt(2) * sp.Float(1.0) * m: "√2 m",
        sp.sin(th + sp.pi / 4): "sin(θ + ¼ π)",
        sp.atan2(th, k): "atan2(θ, k)",
        sp.Piecewise((m, sp.And(th > 0, k < 1)), (k, True)): "(m if (k < 1) and (θ > 0) else k)",
        sp.Integer(0): "0",
    }
    assert {x: board.text(x) for x in told} == told
    assert board.latex(sp.cos(2 * th - 2 * r)) == r"\cos{\left(2 r - 2 \theta \right)}"
    assert board.latex(sp.sin(sp.Mul(2, m + k, evaluate=False))) == r"\sin{\left(2 \left(m + k\right) \right)}"
    assert board.latex(1 / sp.sqrt(th**2)) == r"\frac{1}{\left|{\theta}\right|}"
