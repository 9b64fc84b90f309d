"""Exported C code: it computes what the engine computes, compiles clean, and takes no file that is not ours."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.codegen.c_source import c_code, export_c
from mbkit.derivation import FUNCTIONS
from mbkit.derivation.body_motion import OF_FRAME
from mbkit.errors import InputError, MbkitError, OutputError, UnknownNameError, UnsupportedError
from tests.random_trees import off, random_tree, states
from tests.scenes import mounted

CC, CXX = shutil.which("cc"), shutil.which("c++")
EPS = float(np.finfo(float).eps)
needs_cc = pytest.mark.skipif(CC is None, reason="no C compiler on PATH")
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Werror")
# The compiler may then not contract a product and a sum, and what is computed is known to the bit.
C99 = (str(CC), "-std=c99", "-ffp-contract=off", *STRICT)
# On thousands of lines of one block the optimizer spends seconds.
OPTIMIZED = ("panda_free", "pair")
LIGHT = tuple(name for name in FUNCTIONS if name != "coriolis_matrix" and not name.endswith("derivatives"))
CASES = {
    "panda": (lambda: mb.load("panda"), LIGHT),
    "panda_free": (lambda: mb.load("panda", mimic="free"), ("forward_dynamics",)),
    "solo12": (lambda: mb.load("solo12", floating_base=True), ("mass_matrix", "inverse_dynamics", "forward_dynamics")),
    "tree": (lambda: random_tree(1, 10), ("nle", "passive", "inverse_dynamics", "energy_rate")),
    "pair": (lambda: random_tree(3, 2, ("ball", "prismatic")), tuple(FUNCTIONS)),
    "bars": (mb.catalog.four_bar, tuple(FUNCTIONS)),
}


class Compiled:
    """An exported model, loaded with ctypes."""

    def __init__(self, model, made, folder):
        self.model, self.functions = model, {f.quantity: f for f in made.functions}
        _, source = made.write(folder)
        library = folder / "library.so"
        level = "-O1" if made.name in OPTIMIZED else "-O0"
        subprocess.run([*C99, level, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True)
        self.library = ctypes.CDLL(str(library))

    def __call__(self, quantity, *arguments, out=None):
        """Return each output, a matrix where it is one."""
        described = self.functions[quantity]
        arguments = [np.ascontiguousarray(x) for x in arguments]
        assert [x.size for x in arguments] == [n for _, n in described.inputs]
        outputs = [np.full(rows * columns, np.nan) for _, (rows, columns) in described.outputs] if out is None else out
        pointers = [x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for x in (*arguments, *outputs)]
        call = getattr(self.library, described.name)
        call.restype = None
        call(*pointers)
        return [x.reshape(shape, order="F") for x, (_, shape) in zip(outputs, described.outputs, strict=True)]


@pytest.fixture(scope="module", params=list(CASES))
def compiled(request, tmp_path_factory):
    if CC is None:
        pytest.skip("no C compiler on PATH")
    make, quantities = CASES[request.param]
    model = make()
    return Compiled(model, export_c(model, quantities, name=request.param), tmp_path_factory.mktemp("c"))


def arguments_of(quantity, model, n, seed=0):
    named = dict(zip(("q", "v", "a", "tau"), states(model, n, seed), strict=True))
    return [named[name] for name in FUNCTIONS[quantity]]


@pytest.mark.thorough("panda", "solo12", "tree", "pair", "bars")
def test_every_quantity_is_casadis_to_the_bit(compiled):
    dyn = mb.dynamics(compiled.model, "lagrangian")
    for quantity in compiled.functions:
        f = dyn.function(quantity)
        for state in zip(*arguments_of(quantity, compiled.model, 8), strict=True):
            wanted = f.call([ca.DM(x) for x in state])
            for got, want in zip(compiled(quantity, *state), wanted, strict=True):
                np.testing.assert_array_equal(got, want.full(), err_msg=quantity)


@pytest.mark.thorough("panda", "panda_free", "solo12", "pair")
def test_every_quantity_is_the_engines(compiled):
    dyn = mb.dynamics(compiled.model, "lagrangian")
    for quantity, described in compiled.functions.items():
        arguments = arguments_of(quantity, compiled.model, 8)
        wanted = getattr(dyn, quantity)(*arguments)
        # Sums of a few hundred rounded terms; what solves with M loses its condition number.
        solves = quantity.startswith("forward_dynamics")
        conditions = np.linalg.cond(dyn.mass_matrix(arguments[0])) if solves else np.ones(8)
        for k, state in enumerate(zip(*arguments, strict=True)):
            got = compiled(quantity, *state)
            want = [x[k] for x in wanted] if len(described.outputs) > 1 else [wanted[k]]
            for g, w in zip(got, want, strict=True):
                assert off(g.reshape(np.shape(w)), w) < 256 * EPS * conditions[k], quantity


@pytest.mark.thorough("panda")
def test_an_output_may_lie_on_an_input(compiled):
    for quantity, on in (("forward_dynamics", "tau"), ("inverse_dynamics", "a"), ("nle", "v")):
        if quantity not in compiled.functions:
            continue
        arguments = [x[0].copy() for x in arguments_of(quantity, compiled.model, 1)]
        (apart,) = compiled(quantity, *arguments)
        shared = arguments[FUNCTIONS[quantity].index(on)]
        compiled(quantity, *arguments, out=[shared])
        np.testing.assert_array_equal(shared, apart[:, 0])


@needs_cc
def test_entries_that_pass_through_survive_an_output_on_their_input(tmp_path):
    x = ca.SX.sym("x", 3)
    swap = ca.Function("swap", [x], [ca.vertcat(x[1], x[0], 7, x[2] * x[0])])
    source, library = tmp_path / "swap.c", tmp_path / "swap.so"
    source.write_text(c_code("test", {"swap": swap}))
    subprocess.run([*C99, "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
    data = (ctypes.c_double * 4)(2, 3, 5, 0)
    ctypes.CDLL(str(library)).swap(data, data)
    assert list(data) == [3, 2, 7, 10]


@needs_cc
def test_every_operation_can_be_written(tmp_path):
    # More operations than derivations use, and constants of every kind.
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    terms = [x + y, x - y, x * y, x / y, -x, x * x, 2 * x, 1 / x, ca.sqrt(y), ca.sin(x), ca.cos(x), x < y]
    terms += [ca.if_else(x < y, x, 0), -2.5 - x, x + 1e-300, x * np.inf, x * -np.inf, x + 0.1, ca.SX(np.nan), -0.0]
    f = ca.Function("f", [x, y], [ca.vertcat(*terms)])
    source, library = tmp_path / "f.c", tmp_path / "f.so"
    source.write_text(c_code("test", {"f": f}))
    subprocess.run([*C99, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True)
    call = ctypes.CDLL(str(library)).f
    for a, b in ((-1.5, 2.25), (3.5, 0.7), (1e-320, 1.0)):
        out = (ctypes.c_double * len(terms))()
        call((ctypes.c_double * 1)(a), (ctypes.c_double * 1)(b), out)
        wanted = f(a, b).full()[:, 0]
        np.testing.assert_array_equal(list(out), wanted)
        np.testing.assert_array_equal(np.signbit(list(out)), np.signbit(wanted))


@needs_cc
def test_parameters_are_the_last_input(tmp_path):
    free = mb.catalog.double_pendulum(mass1=mb.Parameter("m1", 2.0), length1=mb.Parameter("l1"))
    made = export_c(free, ["forward_dynamics", "potential_energy", "kinetic_energy"])
    compiled = Compiled(free, made, tmp_path)
    assert [f.inputs[-1] for f in made.functions] == [("parameters", 2)] * 3
    assert "0  m1  2.0\n" in made.header
    assert "1  l1  none\n" in made.header
    assert "{2.0, NAN}" in made.header
    for values in ({"m1": 3.0, "l1": 0.5}, {"m1": 0.1, "l1": 2.0}):
        model = mb.catalog.double_pendulum(mass1=values["m1"], length1=values["l1"])
        dyn = mb.dynamics(model, "lagrangian")
        for f in made.functions:
            state = [x[0] for x in arguments_of(f.quantity, model, 1)]
            (got,) = compiled(f.quantity, *state, np.array(list(values.values())))
            want = getattr(dyn, f.quantity)(*state)
            assert off(got.reshape(np.shape(want)), want) < 256 * EPS


# The header.


@needs_cc
@pytest.mark.parametrize(("robot", "options"), [("panda", {}), ("solo12", {"floating_base": True})])
def test_the_headers_own_program_compiles_and_runs(tmp_path, robot, options):
    model = mb.load(robot, **options)
    made = export_c(model, ["potential_energy", "gravity"], name=robot)
    made.write(tmp_path)
    told = [line.removeprefix(" *") for line in made.header.split(" */")[0].splitlines()]
    begin = next(k for k, line in enumerate(told) if "#include" in line)
    end = next(k for k, line in enumerate(told) if k > begin and line.strip() == "}")
    (tmp_path / "main.c").write_text("\n".join(told[begin : end + 1]) + "\n")
    command = next(line for line in told if "A program" in line).split("A program")[1].split()
    assert command[0] == "cc"
    subprocess.run([command[0], *STRICT, *command[1:]], check=True, cwd=tmp_path)
    printed = subprocess.run([tmp_path / "main"], check=True, capture_output=True, text=True).stdout
    energy = mb.dynamics(model, "lagrangian").potential_energy(model.neutral())
    assert float(printed) == pytest.approx(energy, rel=64 * EPS)


@needs_cc
def test_headers_compile_alone_twice_over_and_in_cpp(tmp_path):
    export_c(mb.load("panda"), ["gravity"]).write(tmp_path)
    export_c(mb.catalog.double_pendulum(), ["gravity"]).write(tmp_path)
    included = '#include "panda.h"\n#include "panda.h"\n#include "double_pendulum.h"\n'
    used = "double q[PANDA_NQ] = {0.0}, g[PANDA_NV]; panda_gravity(q, g); return 0;"
    # A file without any declaration of its own is no C99.
    (tmp_path / "alone.c").write_text(f"{included}int nothing;\n")
    subprocess.run([*C99, "-fsyntax-only", str(tmp_path / "alone.c")], check=True)
    if CXX is None:
        pytest.skip("no C++ compiler on PATH")
    (tmp_path / "main.cpp").write_text(f"{included}int main() {{ {used} }}\n")
    subprocess.run([*C99, "-c", str(tmp_path / "panda.c"), "-o", str(tmp_path / "panda.o")], check=True)
    # Linked, so that the names must be C's.
    linked = [str(tmp_path / "main.cpp"), str(tmp_path / "panda.o"), "-o", str(tmp_path / "main"), "-lm"]
    subprocess.run([CXX, "-std=c++11", *STRICT, *linked], check=True)
    subprocess.run([tmp_path / "main"], check=True)
    # The source is C++ as well.
    subprocess.run([CXX, "-std=c++11", *STRICT, "-x", "c++", "-fsyntax-only", str(tmp_path / "panda.c")], check=True)


# Names, files and the command.


def test_bad_names_are_told():
    model = mb.catalog.pendulum()
    with pytest.raises(UnknownNameError, match="did you mean 'mass_matrix'"):
        export_c(model, ["mass_matrx"])
    with pytest.raises(InputError, match="at least one of mass_matrix"):
        export_c(model, [])
    with pytest.raises(InputError, match="list of names"):
        export_c(model, "nle")
    for quantities in (5, None, ["nle", 5]):
        with pytest.raises(MbkitError, match=f"quantit.*{5 if quantities else quantities}"):
            export_c(model, quantities)
    for name in ("", "2link", "a b", "é", "a;b", "../x"):
        with pytest.raises(InputError, match="name: expected letters"):
            export_c(model, ["nle"], name=name)


def test_c_of_what_does_not_move_is_refused():
    b = mounted("statue", "stone", "foot", "fixed", mass=2.0)
    with pytest.raises(UnsupportedError, match="no joint of it moves"):
        export_c(b.build())


def test_files_of_other_origin_are_kept(tmp_path):
    made = export_c(mb.catalog.pendulum(), ["nle"])
    paths = made.write(tmp_path / "new" / "folder")
    assert [p.name for p in paths] == ["pendulum.h", "pendulum.c"]
    assert made.write(tmp_path / "new" / "folder") == paths
    mine = tmp_path / "pendulum.c"
    mine.write_text("int mine;\n")
    with pytest.raises(OutputError, match=r"pendulum\.c is there and mbkit did not write it"):
        made.write(tmp_path)
    assert mine.read_text() == "int mine;\n"
    assert not (tmp_path / "pendulum.h").exists()
    made.write(tmp_path, force=True)
    assert mine.read_text() == made.source


def call(*arguments):
    return CliRunner().invoke(cli, ["export", *arguments])


def test_the_command_writes_and_tells(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = call("double_pendulum")
    assert result.exit_code == 0, result.output
    assert "double_pendulum_forward_dynamics(q[2], v[2], tau[2]) -> a[2]: " in result.stdout
    assert {p.name for p in Path("mbkit-export").iterdir()} == {"double_pendulum.h", "double_pendulum.c"}
    result = call("panda", "--mimic", "free", "--quantity", "nle", "--quantity", "gravity", "--json", "--name", "arm")
    told = json.loads(result.stdout)
    assert told["header"] == os.path.join("mbkit-export", "arm.h")
    assert [f["name"] for f in told["functions"]] == ["arm_nle", "arm_gravity"]
    assert told["functions"][0]["inputs"] == {"q": 9, "v": 9}
    assert told["digest"] == mb.load("panda", mimic="free").digest
    assert call("solo12", "--floating-base", "--quantity", "gravity").exit_code == 0
    assert "[6] = 1.0" in Path("mbkit-export/solo12.h").read_text()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["pendulum", "--quantity", "nlee"], "did you mean 'nle'"),
        (["pendulum", "--name", "a b"], "name: expected"),
        (["pendulum", "--out", "regular/below"], "regular"),
        (["pendulum", "--out", "taken"], "mbkit did not write it"),
    ],
)
def test_misuse_is_one_message_and_exit_2(tmp_path, monkeypatch, arguments, told):
    monkeypatch.chdir(tmp_path)
    Path("regular").write_text("")
    Path("taken").mkdir()
    Path("taken/pendulum.h").write_text("/* mine */\n")
    result = call(*arguments)
    assert result.exit_code == 2, result.output
    assert told in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="whoever may write everywhere meets no refusal")
def test_a_folder_without_permission_is_told(tmp_path):
    tmp_path.chmod(0o500)
    assert call("pendulum", "--out", str(tmp_path)).exit_code == 2


# The functions themselves, for optimal control.


#: Of frames, their inputs; and of the whole.
OF_BODIES = {
    **dict.fromkeys(("pose", "jacobian", "center_of_mass", "center_of_mass_jacobian"), "q"),
    **dict.fromkeys(("centroidal_momentum_matrix", "locked_inertia"), "q"),
    **dict.fromkeys(("velocity", "jacobian_dot_v", "center_of_mass_velocity"), "qv"),
    **dict.fromkeys(("centroidal_momentum", "centroidal_momentum_bias"), "qv"),
    **dict.fromkeys(("acceleration", "center_of_mass_acceleration"), "qva"),
}


@pytest.mark.thorough(
    "local_world_aligned-anymal_b-LF_FOOT-True", "local-anymal_b-LF_FOOT-True", "world-anymal_b-LF_FOOT-True"
)
@pytest.mark.parametrize(
    ("robot", "frame", "floating"), [("panda", "panda_hand", False), ("anymal_b", "LF_FOOT", True)]
)
@pytest.mark.parametrize("axes", ["local_world_aligned", "local", "world"])
def test_functions_of_frames_and_of_the_whole_are_every_engines(robot, frame, floating, axes):
    model = mb.load(robot, floating_base=floating)
    own, other = mb.dynamics(model, "lagrangian"), mb.dynamics(model, "pinocchio")
    q, v = model.random_state(2)
    states = {"q": q, "v": v, "a": np.linspace(-1, 1, model.nv)}
    for name, inputs in OF_BODIES.items():
        at = [states[x] for x in inputs]
        if name in OF_FRAME:
            more = {} if name == "pose" else {"axes": axes}
            f, theirs = own.function(name, frame=frame, **more), getattr(other, name)(*at, frame, **more)
        else:
            f, theirs = own.function(name), getattr(other, name)(*at)
        assert f.name_in() == list(inputs)
        found = f(*at).full().reshape(np.shape(theirs))
        np.testing.assert_allclose(found, theirs, rtol=0, atol=1e-12 * max(1.0, np.abs(theirs).max()), err_msg=name)
    w = np.array([1.0, -2.0, 3.0, 0.4, 0.5, -0.6])
    force = own.function("generalized_force", frame, axes=axes)(q, w).full().ravel()
    np.testing.assert_allclose(force, other.generalized_force(q, {frame: w}, axes), atol=1e-12)


def test_the_derivative_of_an_end_effectors_place_is_its_jacobian():
    """By CasADi, of the pose's function: a second way to J."""
    model = mb.load("ur5")
    dyn = mb.dynamics(model, "lagrangian")
    x, q = ca.SX.sym("q", model.nq), model.random_state(0)[0]
    place = dyn.function("pose", frame="tool0")(x)[:3, 3]
    by_q = ca.Function("by_q", [x], [ca.jacobian(place, x)])
    np.testing.assert_allclose(by_q(q).full(), dyn.jacobian(q, "tool0")[:3], atol=1e-14)


def test_frames_and_axes_that_are_not_there_are_told():
    model = mb.catalog.pendulum()
    dyn = mb.dynamics(model, "lagrangian")
    for bad, error, words in (
        (lambda: dyn.function("jacobian"), InputError, "frame: jacobian is of a frame; expected its name"),
        (lambda: dyn.function("pose", frame="tp"), UnknownNameError, "did you mean 'tip'"),
        (lambda: dyn.function("pose", frame="tip", axes="here"), InputError, "axes: expected one of"),
        (lambda: mb.lagrangian.export_c(model, ["pose"]), InputError, "frames: pose is of a frame"),
        (lambda: mb.lagrangian.export_c(model, ["pose"], frames=["tp"]), UnknownNameError, "did you mean 'tip'"),
        (lambda: dyn.function("center_of_mas"), UnknownNameError, "did you mean 'center_of_mass'"),
    ):
        with pytest.raises(error, match=words):
            bad()


@needs_cc
def test_frames_in_c_are_the_engines(tmp_path):
    model = mb.load("panda")
    source = mb.lagrangian.export_c(model, ["pose", "jacobian", "center_of_mass"], frames=["panda_hand", "panda_link3"])
    own = Compiled(model, source, tmp_path)
    own.functions = {f.name.removeprefix("panda_"): f for f in source.functions}
    dyn, (q, _) = mb.dynamics(model, "pinocchio"), model.random_state(4)
    for frame in ("panda_hand", "panda_link3"):
        (pose,), (J,) = own(f"pose_{frame}", q), own(f"jacobian_{frame}", q)
        np.testing.assert_allclose(pose, dyn.pose(q, frame), atol=1e-14)
        np.testing.assert_allclose(J, dyn.jacobian(q, frame), atol=1e-14)
    np.testing.assert_allclose(np.ravel(own("center_of_mass", q)[0]), dyn.center_of_mass(q), atol=1e-14)
    assert "jacobian of panda_hand in local_world_aligned axes" in source.header
