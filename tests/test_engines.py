"""Three engines on one description: the same numbers, the same manners."""

from __future__ import annotations

import inspect
import os
import pickle
import re
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines import ENGINES, QUANTITIES, Dynamics
from mbkit.errors import InputError, MbkitError, MbkitWarning, NumericalError, UnsupportedError
from mbkit.model import kind_of
from tests.random_trees import off, random_tree, states
from tests.scenes import mounted

VECTORS = {
    "gravity": "q",
    "nle": "qv",
    "passive": "qv",
    "inverse_dynamics": "qva",
    "forward_dynamics": "qvt",
    "kinetic_energy": "qv",
    "potential_energy": "q",
    "mass_matrix": "q",
}
#: Every quantity of a state, with the argument names that the protocol documents.
ARGUMENTS = {
    name: tuple(
        name
        for name, x in inspect.signature(getattr(Dynamics, name)).parameters.items()
        # Loads take a or τ; here they take a.
        if name in ("q", "v", "a", "tau") and (x.default is x.empty or name == "a")
    )
    for name in QUANTITIES
    if name != "function"
}
#: The engines, and the own derivation as machine code too (the suite interprets it by default).
WAYS = (*ENGINES, "compiled")
# Engines do a few hundred roundings per entry on these well-scaled trees.
CLOSE = 2e-13


def made_by(model, way):
    return mb.dynamics(model, "lagrangian", compile=True) if way == "compiled" else mb.dynamics(model, way)


@cache
def small_tree(kinds, way):
    return made_by(random_tree(1, len(kinds), kinds, armature=False), way)


TURNING = ("free", "revolute")


def calls(dyn, q, v, a, tau):
    """Yield each quantity that an engine has, as a function of its arguments, and these arguments by name."""
    for name, letters in ARGUMENTS.items():
        if name in dyn.supports:
            given = {"q": q, "v": v, "a": a, "tau": tau}
            method = getattr(dyn, name)
            takes = inspect.signature(method).parameters
            more = {"frame": "tip"} if "frame" in takes else {}
            more |= {"wrenches": {"tip": np.arange(1.0, 7.0)}} if "wrenches" in takes else {}
            yield name, partial(method, **more), {x: given[x] for x in letters}


def answer(call, given):
    """Return what a call gives, or the error that it raises."""
    try:
        return call(**given)
    except MbkitError as error:
        return error


def arguments(letters, q, v, a, tau):
    return [{"q": q, "v": v, "a": a, "t": tau}[x] for x in letters]


@pytest.mark.parametrize("engine", list(ENGINES))
def test_declaration_order_of_joints_does_not_matter_to_the_physics(engine):
    # Breadth first, siblings against the alphabet, a child declared before its
    # parent: Pinocchio wants depth first and MuJoCo nests bodies.
    b = mb.ModelBuilder("shuffled")
    inertia = np.diag([0.1, 0.2, 0.25])
    for name in ("trunk", "a1", "z1", "a2", "z2"):
        b.add_body(name, mass=1.0, com=(0.1, 0.2, -0.3), inertia=inertia)
    b.add_joint("z2", "revolute", parent="z1", child="z2", axis=(1, 1, 0), translation=(0, 0, -1))
    b.add_joint("trunk", "ball", parent="world", child="trunk")
    b.add_joint("z1", "prismatic", parent="trunk", child="z1", axis=(1, 0, 0), translation=(1, 0, 0))
    b.add_joint("a1", "revolute", parent="trunk", child="a1", axis=(0, 1, 0), translation=(-1, 0, 0))
    b.add_joint("a2", "planar", parent="a1", child="a2", translation=(0, 0, -1))
    model = b.build()
    assert model.joint_names == ("z2", "trunk", "z1", "a1", "a2")
    q, v, _, tau = states(model, 3)
    own = mb.dynamics(model, "lagrangian").forward_dynamics(q, v, tau)
    assert off(mb.dynamics(model, engine).forward_dynamics(q, v, tau), own) < CLOSE
    # And the reference itself, by moving one joint alone: a slide of z1 carries z1 and z2.
    M = mb.dynamics(model, engine).mass_matrix(q[0])
    assert M[model.layout.v["z1"].start, model.layout.v["z1"].start] == pytest.approx(2.0)


@pytest.mark.parametrize("engine", list(ENGINES))
def test_results_are_not_views_of_the_next_call(engine):
    model = mb.load("ur5")
    dyn = mb.dynamics(model, engine)
    q, v, a, tau = states(model, 2)
    for name, letters in VECTORS.items():
        first = getattr(dyn, name)(*(x[0] for x in arguments(letters, q, v, a, tau)))
        kept = np.array(first)
        getattr(dyn, name)(*(x[1] for x in arguments(letters, q, v, a, tau)))
        assert np.array_equal(first, kept), name


def unaligned(x):
    out = np.frombuffer(bytearray(x.nbytes + 1), dtype=float, count=x.size, offset=1).reshape(x.shape)
    out[...] = x
    return out


def read_only(x):
    out = x.copy()
    out.setflags(write=False)
    return out


def masked(x):
    out = np.ma.array(x)
    out[..., 0] = np.ma.masked
    return out


#: Arrays that hold real numbers: their values count, however they lie in memory.
NUMBERS = {
    "byte-swapped": lambda x: x.astype(">f8"),
    "float32": lambda x: x.astype("f4"),
    "byte-swapped float32": lambda x: x.astype(">f4"),
    "half": lambda x: x.astype("f2"),
    "long double": lambda x: x.astype(np.longdouble),
    "integers": lambda x: x.astype("i8"),
    "byte-swapped integers": lambda x: x.astype(">i8"),
    "bytes": lambda x: np.abs(x).astype("u1"),
    "read-only": read_only,
    "strided": lambda x: np.repeat(x, 2, axis=-1)[..., ::2],
    "backwards": lambda x: np.ascontiguousarray(x[..., ::-1])[..., ::-1],
    "Fortran": np.asfortranarray,
    "unaligned": unaligned,
    "nothing masked": np.ma.array,
    "list": lambda x: x.tolist(),
    "tuple": lambda x: tuple(x.tolist()),
    "unpickled": lambda x: pickle.loads(pickle.dumps(x)),
}
#: What holds anything else, or says that it holds less.
NO_NUMBERS = {
    "bool": lambda x: x > 0,
    "complex": lambda x: x.astype(complex),
    "masked": masked,
    "object": lambda x: x.astype(object),
    "text": lambda x: x.astype(str),
    "durations": lambda x: x.astype("m8[s]"),
    "records": lambda x: np.zeros(x.shape, [("x", "f8")]),
    "one number": lambda x: np.array(float(x.flat[0])),
    "a column too many": lambda x: x[..., None, None],
}


@pytest.mark.thorough(every=3)
@pytest.mark.parametrize(
    ("way", "batch", "kinds"),
    [
        *((way, False, TURNING) for way in WAYS),
        *((way, True, TURNING) for way in ("pinocchio", "mujoco", "compiled")),
        # Without quaternions these two have a faster path.
        *((way, False, ("revolute", "prismatic")) for way in ("pinocchio", "compiled")),
    ],
)
def test_every_array_is_read_rightly_or_refused(way, batch, kinds):
    dyn, own = small_tree(kinds, way), small_tree(kinds, "lagrangian")
    state = states(own.model, 2) if batch else [x[0] for x in states(own.model, 1)]
    reference = {name: call for name, call, _ in calls(own, *state)}
    for k, (name, call, given) in enumerate(calls(dyn, *state)):
        call(**given)  # what is derived at the first call takes the fast path now
        # All kinds in some quantities, and in each of the others a part of them, which all of them share.
        some = slice(None) if name in ("nle", "forward_dynamics") else slice(k % 5, None, 5)
        for x, value in given.items():
            for kind, convert in [*NUMBERS.items()][some]:
                other = given | {x: convert(value)}
                plain = {k: np.asarray(y, dtype=float) for k, y in other.items()}
                # Rounded to such a type a quaternion may not be of unit length.
                expected, found = answer(reference[name], plain), answer(call, other)
                if isinstance(expected, MbkitError) or isinstance(found, MbkitError):
                    assert str(found) == str(expected), (name, x, kind)
                else:
                    assert off(found, expected) < 1e-10, (name, x, kind)
            for kind, convert in [*NO_NUMBERS.items()][some]:
                error = answer(call, given | {x: convert(value)})
                assert isinstance(error, InputError), (name, x, kind)
                assert str(error).startswith(f"{x}: expected"), (name, x, kind)


def with_hidden_entries():
    """Yield models with coordinates that nothing reads, and with results that are an argument itself."""
    b = mounted("slide", "a", "x", "prismatic", mass=1.0, axis=(1, 0, 0))
    b.add_body("b", mass=1.0, com=(0, 0, 1), inertia=(1, 1, 1))
    b.add_joint("y", "revolute", parent="a", child="b", axis=(0, 1, 0))
    b.add_frame("tip", body="b")
    yield b.build()
    for kinds in (["free"], ["prismatic", "ball", "planar"]):
        unit = mb.ModelBuilder("unit", gravity=(0, 0, 0))
        for i, kind in enumerate(kinds):
            unit.add_body(f"b{i}", mass=1.0, inertia=(1, 1, 1))
            axis = {"axis": (0, 0, 1)} if kind_of(kind).n_axes else {}
            unit.add_joint(f"j{i}", kind, parent="world", child=f"b{i}", **axis)
        unit.add_frame("tip", body="b0")
        yield unit.build()


@pytest.mark.thorough("lagrangian", "oracle", "compiled")
@pytest.mark.parametrize("way", WAYS)
def test_no_entry_that_is_not_finite_passes_unseen(way):
    rng = np.random.default_rng(0)
    for model in with_hidden_entries():
        dyn = made_by(model, way)
        for name, call, given in calls(dyn, *states(model, 3)):
            call(**given)
            call(**{x: value[0] for x, value in given.items()})
            for x, i in ((x, i) for x, value in given.items() for i in range(value.shape[1])):
                row, bad = rng.integers(3), rng.choice([np.nan, np.inf, -np.inf])
                batch = {k: y.copy() for k, y in given.items()}
                batch[x][row, i] = bad
                for spoiled in (batch, {k: y[row] for k, y in batch.items()}):
                    error = answer(call, spoiled)
                    assert isinstance(error, InputError), (model.name, name, x, i, bad)
                    assert str(error).startswith(f"{x}: "), (model.name, name, x, i, bad)


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
@pytest.mark.parametrize("way", WAYS)
def test_overflow_is_an_error_in_every_quantity(way):
    """A slide of 1e200 m with 1e200 kg: products of these numbers are beyond a double."""
    b = mounted("huge", "a", "turn", "revolute", mass=1.0, com=(0, 0, 1), inertia=(1, 1, 1), axis=(0, 1, 0))
    b.add_body("b", mass=1e200)
    b.add_joint("slide", "prismatic", parent="a", child="b", axis=(1, 0, 0))
    b.add_frame("tip", body="b")
    model = b.build()
    q, one = np.array([0.3, 1e200]), np.ones(2)
    for name, call, given in calls(made_by(model, way), q, one, one, one):
        # The oracle's numbers have a larger exponent, and its accelerations here are small.
        if name in {*VECTORS, "coriolis_force"} - {"passive"} and (way, name) != ("oracle", "forward_dynamics"):
            assert isinstance(answer(call, given), NumericalError), name


@pytest.mark.thorough("free-0.9-compiled", "ball-0.9-compiled")
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("length", [0.9, 1 + 1e-6])
@pytest.mark.parametrize("kind", ["free", "ball"])
def test_a_quaternion_of_another_length_is_refused_by_every_engine(way, length, kind):
    dyn = small_tree((kind, "revolute"), way)
    q, v = dyn.model.random_state(0)
    (start, joint), *_ = dyn.model.quaternions
    calls = (lambda: dyn.nle(q, v), lambda: dyn.forward_dynamics(q, v, v), lambda: dyn.mass_matrix(q[None]))
    for call in calls:
        call()  # what is derived at the first call takes the short way now
    q[start : start + 4] *= length
    for call in calls:
        with pytest.raises(InputError, match=rf"{joint}.*norm {re.escape(str(length))}"):
            call()


@pytest.mark.parametrize("engine", list(ENGINES))
def test_batches_must_be_of_one_size(engine):
    dyn = mb.dynamics(mb.load("ur5"), engine)
    with pytest.raises(InputError, match="q has 2, v has 3"):
        dyn.nle(np.zeros((2, 6)), np.zeros((3, 6)))


def test_what_an_engine_cannot_do_has_a_reason():
    model = random_tree(0, 4, ("revolute", "prismatic"))
    mujoco = mb.dynamics(model, "mujoco")
    assert "coriolis_matrix" not in mujoco.supports
    with pytest.raises(UnsupportedError, match="without the matrix"):
        mujoco.coriolis_matrix(model.neutral(), np.zeros(model.nv))
    with pytest.raises(UnsupportedError, match="lagrangian"):
        mb.dynamics(model).function("nle")
    for name in (3, None, ["pose"]):
        with pytest.raises(InputError, match="name: expected the name of a quantity"):
            mb.dynamics(mb.catalog.pendulum(), "lagrangian").function(name)  # type: ignore[arg-type]
    with pytest.raises(UnsupportedError, match="'j0' is a helical joint"):
        mb.dynamics(random_tree(0, 1, ("helical",)), "mujoco")


@pytest.mark.parametrize("engine", list(ENGINES))
def test_a_loop_that_no_joint_can_open_is_refused_and_not_ignored(engine):
    b = mounted("loop", "a", "j", "revolute", mass=1.0, com=(0, 0, 1), axis=(0, 1, 0))
    b.add_loop("closed", "point", body_a="a", body_b="world")
    model = b.build()
    with pytest.raises((InputError, UnsupportedError), match=r"loop|constraints between bodies"):
        mb.dynamics(model, engine).forward_dynamics([0.0], [0.0], [0.0])
    mb.dynamics(model.without("loops"), engine)


@pytest.mark.parametrize("engine", list(ENGINES))
def test_dynamics_can_be_pickled(engine):
    model = mb.load("panda")
    dyn = mb.dynamics(model, engine)
    q, v, _, _ = (x[0] for x in states(model, 1))
    assert np.array_equal(pickle.loads(pickle.dumps(dyn)).nle(q, v), dyn.nle(q, v))


SHARED = {
    "panda": lambda: mb.load("panda"),
    "floating": lambda: mb.load("solo12", floating_base=True),
    "four_bar": mb.catalog.four_bar,
}


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("engine", list(ENGINES))
@pytest.mark.parametrize("name", SHARED)
def test_threads_that_share_an_engine_get_the_values_of_their_own_states(name, engine):
    """Whichever instruction one thread is interrupted at."""
    model = SHARED[name]()
    dyn, frame = mb.dynamics(model, engine), model.bodies[-1].name
    q, v, a, tau = states(model, 12)
    if model.constrained:
        q, v = mb.dynamics(model, "lagrangian").project(q, v)
    of_frames = {"pose": (q,), "jacobian": (q,), "acceleration": (q, v, a)}
    of_states = {"coriolis_force": (q, v), "inverse_dynamics": (q, v, a), "constraint_bias": (q, v)}
    with_wrenches = {"forward_dynamics": (q, v, tau)}
    before = sys.getswitchinterval()
    for kind, more in ((of_frames, (frame,)), (of_states, ()), (with_wrenches, ({frame: np.arange(6.0)},))):
        for quantity in {*kind} & dyn.supports:
            call = partial(lambda of, more, *row: of(*row, *more), getattr(dyn, quantity), more)
            rows = [*zip(*kind[quantity], strict=True)]
            expected = [call(*row) for row in rows]
            sys.setswitchinterval(1e-6)
            try:
                with ThreadPoolExecutor(4) as pool:
                    got = list(pool.map(call, *zip(*30 * rows, strict=True)))
            finally:
                sys.setswitchinterval(before)
            assert all(np.array_equal(x, y) for x, y in zip(got, 30 * expected, strict=True)), quantity


def test_mujoco_writes_no_log_and_gives_no_number_where_there_is_none(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    b = mounted(
        "twice", "a", "j", "universal", mass=1.0, com=(0, 0, -1), inertia=(1, 1, 1), axis=(1, 0, 0), axis2=(1, 0, 0)
    )
    with pytest.warns(mb.errors.NonPhysicalWarning):
        model = b.build(nonphysical="warn")
    dyn = mb.dynamics(model, "mujoco")
    with pytest.raises(NumericalError):
        dyn.forward_dynamics(np.zeros(2), np.ones(2), np.ones(2))
    assert os.listdir(tmp_path) == []
    assert "WARNING" not in capfd.readouterr().err


def test_a_point_spring_of_no_length_pulls_and_does_not_divide_by_zero():
    b = mounted("tether", "a", "j", "prismatic", gravity=(0, 0, 0), mass=1.0, axis=(1, 0, 0))
    b.add_spring("s", body_a="world", body_b="a", stiffness=7.0)
    model = b.build()
    for engine in ENGINES:
        dyn = mb.dynamics(model, engine)
        assert dyn.passive([0.0], [0.0]) == pytest.approx([0.0])
        assert dyn.passive([0.5], [0.0]) == pytest.approx([-3.5])
        assert dyn.potential_energy([0.5]) == pytest.approx(7 * 0.125)


@pytest.mark.thorough("spring0-1-compiled", "spring0-3-compiled", "spring1-1-compiled", "spring1-3-compiled")
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("axes", [1, 3])
@pytest.mark.parametrize("spring", [{"damping": 0.5}, {"stiffness": 7.0, "rest_length": 0.2}])
def test_a_spring_that_needs_a_direction_is_refused_where_it_has_none(way, axes, spring):
    """Beside that pose the force has different limits along different ways, so no number is right there."""
    b = mb.ModelBuilder("tether")
    parents = ["world", "x", "y"]
    for name, axis, parent in zip("xyz"[-axes:], np.eye(3)[-axes:], ["world", *parents[4 - axes :]], strict=True):
        b.add_body(name, mass=float(name == "z"))
        b.add_joint(f"along {name}", "prismatic", parent=parent, child=name, axis=axis)
    b.add_spring("s", body_a="world", body_b="z", **spring)
    dyn = made_by(b.build(), way)
    zero, one = np.zeros(axes), np.ones(axes)
    for quantity, *rest in (("passive", one), ("inverse_dynamics", one, one), ("forward_dynamics", one, one)):
        with pytest.raises(NumericalError, match=r"direction.*'s'"):
            getattr(dyn, quantity)(zero, *rest)
        assert np.isfinite(getattr(dyn, quantity)(1e-9 * one, *rest)).all()
    if way != "drake":  # it refuses the energy there too
        assert dyn.potential_energy(zero) == pytest.approx(0.5 * 7 * 0.2**2 * ("stiffness" in spring))
    assert dyn.nle(zero, one)[-1] == pytest.approx(9.80665, rel=1e-3)
    if way == "mujoco":
        with pytest.raises(NumericalError, match="'s'"):
            dyn.rollout("rk4", zero, one, 1e-3, None, 2)


@pytest.mark.parametrize("engine", ["pinocchio", "lagrangian", "mujoco", "oracle"])
def test_a_dynamics_is_read_only_and_knows_what_others_call_its_methods(engine):
    dyn = mb.dynamics(mb.catalog.pendulum(), engine)
    for name in ("gravity", "mass_matrix", "model", "supports"):
        with pytest.raises((InputError, AttributeError), match=r"read-only|no setter"):
            setattr(dyn, name, 0.0)
    assert dyn.gravity([0.3]) == pytest.approx(dyn.inverse_dynamics([0.3], [0.0], [0.0]))
    for name, meant in {
        "M": "mass_matrix",
        "crba": "mass_matrix",
        "qfrc_bias": "nle",
        "aba": "forward_dynamics",
    }.items():
        with pytest.raises(AttributeError, match=f"no attribute '{name}'; did you mean {meant}"):
            getattr(dyn, name)
    with pytest.raises(AttributeError, match="did you mean jacobian"):
        dyn.jacobain  # noqa: B018
    assert not hasattr(dyn, "_no_such_thing")


def test_a_function_in_the_place_of_a_configuration_is_named():
    model = mb.load("panda")
    with pytest.raises(InputError, match=r"got a function; call it: neutral\(\)"):
        mb.dynamics(model).mass_matrix(model.neutral)


@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_one_value_for_each_sample_is_told_to_be_the_own_derivations(engine):
    model = mb.catalog.pendulum(mass=mb.Parameter("m", 2.0))
    with pytest.raises(InputError, match=r"'m': expected a number, got shape \(2,\); the lagrangian engine takes one"):
        mb.dynamics(model, engine).at(m=np.array([1.0, 2.0]))


def test_a_seed_that_looks_like_a_number_of_states_is_told():
    model = mb.catalog.pendulum()
    with pytest.warns(MbkitWarning, match=r"100 is a seed, of one state; random_state\(seed, 100\) draws 100"):
        model.random_state(100)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.random_state(7)
        model.random_state(100, 3)
