"""Named parameters: the same system as with plain numbers, at any values, derived once."""

from __future__ import annotations

import copy
import pickle

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mbkit as mb
from mbkit.derivation import FUNCTIONS, Equations
from mbkit.errors import InputError, ModelError, UnknownNameError
from mbkit.model import Expression, nominal
from tests.random_trees import off, random_tree, states

EPS = np.finfo(float).eps
# Sums of a few hundred rounded terms.
CLOSE = 1e-13
#: Name -> what a random draw of it lies between.
RANGES = {
    "mass": (0.5, 2.0),
    "length": (0.3, 1.5),
    "side": (0.1, 0.4),
    "rotor": (0.0, 0.5),
    "friction": (0.0, 2.0),
    "spring": (0.0, 20.0),
    "rest": (-0.5, 0.5),
    "ratio": (-2.0, 2.0),
    "offset": (-0.4, 0.4),
    "pitch": (-0.2, 0.2),
    "g": (1.0, 20.0),
    "tie": (1.0, 30.0),
    "slack": (0.1, 0.5),
    "point": (0.2, 1.0),
    "tip": (-0.5, 0.5),
}
QUANTITIES = {
    "mass_matrix": "q",
    "coriolis_matrix": "qv",
    "coriolis_force": "qv",
    "gravity": "q",
    "nle": "qv",
    "passive": "qv",
    "inverse_dynamics": "qva",
    "forward_dynamics": "qvt",
    "kinetic_energy": "qv",
    "potential_energy": "q",
    "energy_rate": "qva",
}


def machine(p):
    """Return a system in which every number that may be a parameter is one; `p` maps names to numbers."""
    b = mb.ModelBuilder("machine", gravity=(0.1 * p["g"], 0.0, -p["g"]))
    m, s = p["mass"], p["side"]
    box = (m / 6 * s**2 + 0.01, m * s**2 / 4 + 0.02, m * s**2 / 4 + 0.02)
    b.add_body("turret", mass=m, com=(s / 2, 0.1, p["length"] / 3), inertia=box)
    b.add_joint("turn", "revolute", parent="world", child="turret", axis=(0, 0, 1), armature=p["rotor"], rest=p["rest"])
    tilted = [[0.3 + m, 0.01 * m, 0.0], [0.01 * m, 0.4 + m, 0.02], [0.0, 0.02, 0.5 + m]]
    b.add_body("arm", mass=2 * m + 0.1, com=(0.0, 0.0, -p["length"] / 2), inertia=tilted)
    lift = {"damping": p["friction"], "stiffness": p["spring"], "rest": p["rest"], "translation": (0.1, 0, p["length"])}
    b.add_joint("lift", "revolute", parent="turret", child="arm", axis=(1, 2, 0.5), **lift)
    b.add_body("screw", mass=0.3, com=(0.05, 0.0, 0.0), inertia=(0.01, 0.01, 0.01))
    drive = {"pitch": p["pitch"], "translation": (0, 0, -s)}
    b.add_joint("drive", "helical", parent="arm", child="screw", axis=(0, 1, 0), **drive)
    b.add_body("finger", mass=m / 3, com=(s, 0.0, 0.0), inertia=(0.01, 0.01, 0.01))
    mimic = ("lift", p["ratio"], p["offset"])
    b.add_joint("follow", "revolute", parent="arm", child="finger", axis=(0, 1, 0), mimic=mimic)
    b.add_body("nail", mass=0.2, com=(0.1, 0.0, 0.0), inertia=(0.01, 0.01, 0.01))
    b.add_joint("echo", "revolute", parent="finger", child="nail", axis=(1, 0, 0), mimic=("follow", 0.5, p["offset"]))
    b.add_body("ball", mass=m, inertia=(0.1, 0.1, 0.1))
    b.add_joint("socket", "ball", parent="screw", child="ball", translation=(0, p["length"] * 0.5, 0))
    tie = {"stiffness": p["tie"], "rest_length": p["slack"], "damping": p["friction"] * 0.1}
    b.add_spring("tie", body_a="world", body_b="ball", point_a=(0, p["point"], 2), **tie)
    b.add_frame("tip", body="nail", translation=(p["tip"], 0, 0.1), rpy=(0.1, 0.2, 0.3))
    return b.build()


def symbols(values=None):
    return {name: mb.Parameter(name, None if values is None else values[name]) for name in RANGES}


def draw(seed):
    rng = np.random.default_rng(seed)
    return {name: float(rng.uniform(*ends)) for name, ends in RANGES.items()}


def arguments(model, n=4):
    q, v, a, tau = states(model, n)
    return {"q": q, "v": v, "a": a, "t": tau}


@pytest.fixture(scope="module")
def open_machine():
    """The machine without any value, and its dynamics."""
    model = machine(symbols())
    return model, mb.dynamics(model, "lagrangian")


# The lagrangian engine: parameters are arguments of what was derived once


@pytest.mark.thorough("0", "2")
@pytest.mark.parametrize("seed", range(3))
def test_every_quantity_is_that_of_the_plain_model(open_machine, seed):
    model, dyn = open_machine
    values = draw(seed)
    plain = machine(values)
    at, reference = dyn.at(**values), mb.dynamics(plain, "lagrangian")
    x = arguments(model)
    for name, needs in QUANTITIES.items():
        given = [x[n] for n in needs]
        assert off(getattr(at, name)(*given), getattr(reference, name)(*given)) < CLOSE, name
    assert off(at.pose(x["q"], "tip"), reference.pose(x["q"], "tip")) < CLOSE
    for axes in ("local", "world", "local_world_aligned"):
        assert off(at.jacobian(x["q"], "tip", axes), reference.jacobian(x["q"], "tip", axes)) < CLOSE


@pytest.mark.parametrize("engine", ["pinocchio", "oracle"])
def test_other_engines_take_values_too(open_machine, engine):
    values = draw(5)
    model = machine(symbols(draw(6)))
    x = arguments(model)
    dyn, reference = mb.dynamics(model, engine).at(**values), open_machine[1].at(**values)
    for name in ("mass_matrix", "nle", "passive", "forward_dynamics", "potential_energy"):
        if name in dyn.supports:
            given = [x[n] for n in QUANTITIES[name]]
            assert off(getattr(dyn, name)(*given), getattr(reference, name)(*given)) < 1e-11, name


def test_mujoco_takes_values_too():
    model = mb.catalog.chain(n=3, length=mb.Parameter("l", 1.0), mass=mb.Parameter("m", 2.0))
    x = arguments(model)
    dyns = [mb.dynamics(model, engine).at(l=0.7, m=0.3) for engine in ("mujoco", "lagrangian")]
    results = [d.inverse_dynamics(x["q"], x["v"], x["a"]) for d in dyns]
    assert off(*results) < CLOSE


def test_a_value_for_every_sample(open_machine):
    model, dyn = open_machine
    values, other = draw(1), draw(2)
    x = arguments(model)
    masses, lengths = np.array([0.6, 1.0, 1.5, 2.0]), np.array([0.4, 0.5, 0.6, 0.7])
    many = dyn.at(**values).at(mass=masses, length=lengths)
    for name, needs in QUANTITIES.items():
        got = getattr(many, name)(*(x[n] for n in needs))
        for i in range(4):
            one = dyn.at(**{**values, "mass": masses[i], "length": lengths[i]})
            assert off(got[i], getattr(one, name)(*(x[n][i] for n in needs))) < CLOSE
    # One state beside a batch of values is repeated; a single value ends the batch.
    assert off(many.mass_matrix(x["q"][0])[2], many.mass_matrix(np.tile(x["q"][0], (4, 1)))[2]) == 0
    assert many.pose(x["q"][0], "tip").shape == (4, 4, 4)
    assert many.at(mass=1.0, length=1.0).mass_matrix(x["q"][0]).shape == (model.nv, model.nv)
    assert off(many.at(**other).nle(x["q"], x["v"]), dyn.at(**other).nle(x["q"], x["v"])) == 0


def test_some_samples_of_a_batch(open_machine):
    model, dyn = open_machine
    many = dyn.at(**draw(1)).at(mass=[0.6, 1.0, 1.5])
    q = states(model, 3)[0]
    some = [2, 0, 2, 1]
    assert off(many._of_samples(some).mass_matrix(q[some]), many.mass_matrix(q)[some]) == 0
    assert many._samples == 3
    for single in (dyn, mb.dynamics(dyn.at(**draw(1)).model, "pinocchio")):
        assert single._of_samples(some) is single
        assert single._samples is None


def test_nothing_is_derived_again(open_machine):
    model, dyn = open_machine
    q = model.neutral()
    first = dyn.at(**draw(1))
    first.mass_matrix(q)
    second = first.at(**draw(2))
    assert second.equations is first.equations
    assert second._machines is first._machines
    assert len({m.form_digest for m in (model, first.model, second.model)}) == 1
    assert len({m.digest for m in (model, first.model, second.model)}) == 3


def test_the_model_of_the_dynamics_has_the_values(open_machine):
    values = draw(3)
    dyn = open_machine[1].at(**values)
    assert dict(dyn.model.parameters) == values
    assert dyn.model == machine(symbols(values))
    assert dyn.model.with_parameters(**values).mass == pytest.approx(machine(values).mass, rel=4 * EPS)
    other = mb.dynamics(dyn.model, "lagrangian")
    q = dyn.model.neutral()
    assert off(other.mass_matrix(q), dyn.mass_matrix(q)) == 0


def test_functions_take_parameters_last(open_machine):
    model, dyn = open_machine
    values = draw(4)
    x = {"q": "q", "v": "v", "a": "a", "tau": "t"}
    given = arguments(model, 1)
    column = [values[name] for name in model.parameters]
    for name, needs in FUNCTIONS.items():
        f = dyn.function(name)
        assert f.name_in() == [*needs, "parameters"]
        got = f(*(given[x[n]][0] for n in needs), column)
        if name in QUANTITIES:
            expected = getattr(dyn.at(**values), name)(*(given[x[n]][0] for n in needs))
            assert off(np.array(got).reshape(np.shape(expected)), expected) < CLOSE
    assert mb.dynamics(machine(values), "lagrangian").function("nle").name_in() == ["q", "v"]


@pytest.mark.parametrize("batch", [False, True])
def test_dynamics_at_values_are_pickled(open_machine, batch):
    dyn = open_machine[1].at(**draw(1))
    if batch:
        dyn = dyn.at(mass=[1.0, 2.0])
    q = open_machine[0].neutral()
    again = pickle.loads(pickle.dumps(dyn))
    assert off(again.mass_matrix(q), dyn.mass_matrix(q)) == 0
    assert again.model == dyn.model


def test_missing_values_are_named(open_machine):
    model, dyn = open_machine
    values = draw(1)
    del values["length"], values["tie"]
    with pytest.raises(InputError, match=r"no value for parameter 'length', 'tie'.*dynamics\.at\(length=\.\.\."):
        dyn.at(**values).mass_matrix(model.neutral())
    for engine in ("pinocchio", "mujoco", "oracle"):
        with pytest.raises(InputError, match=r"'length'.*model\.with_parameters\("):
            mb.dynamics(model, engine)
    with pytest.raises(InputError, match="'mass'"):
        _ = model.mass
    with pytest.raises(InputError, match="'mass'"):
        Equations(model, "symbols")


def test_wrong_values_are_refused(open_machine):
    _, dyn = open_machine
    dyn = dyn.at(**draw(1))
    pin = mb.dynamics(dyn.model, "pinocchio")
    for wrong in (np.nan, np.inf, "1", None, True):
        for d in (dyn, pin):
            with pytest.raises(InputError, match="parameter 'mass'"):
                d.at(mass=wrong)
    with pytest.raises(InputError, match=r"parameter 'mass'.*index \(1,\)"):
        dyn.at(mass=[1.0, np.nan])
    with pytest.raises(InputError, match=r"parameter 'mass': expected a number or shape \(N,\)"):
        dyn.at(mass=[[1.0]])
    with pytest.raises(InputError, match="parameter 'mass': expected a number"):
        pin.at(mass=[1.0, 2.0])
    with pytest.raises(InputError, match="mass has 2, length has 3"):
        dyn.at(mass=[1.0, 2.0], length=[1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="q: a batch of 3, but the parameters' values are 2"):
        dyn.at(mass=[1.0, 2.0]).mass_matrix(np.tile(dyn.model.neutral(), (3, 1)))
    for d in (dyn, pin, dyn.model):
        with pytest.raises(UnknownNameError, match="did you mean 'mass'"):
            (d.with_parameters if d is dyn.model else d.at)(masss=1.0)
        with pytest.raises(ModelError, match="body 'turret': mass -1 is negative"):
            (d.with_parameters if d is dyn.model else d.at)(mass=-1.0)


# The description


def test_values_fixed_one_by_one_or_at_once():
    values = draw(7)
    model = machine(symbols())
    step = model
    for name, value in values.items():
        assert name in step.parameters
        step = step.with_parameters(**{name: value})
    assert step == model.with_parameters(**values) == machine(symbols(values)).with_parameters(**values)
    assert not step.parameters
    plain = machine(values)
    for mine, other in zip((*step.bodies, *step.joints), (*plain.bodies, *plain.joints), strict=True):
        for field in ("mass", "com", "inertia", "translation", "armature", "damping", "stiffness", "rest", "pitch"):
            if hasattr(mine, field):
                assert np.array_equal(getattr(mine, field), getattr(other, field)), (mine.name, field)
    assert [j.mimic for j in step.joints] == [j.mimic for j in plain.joints]
    assert step.digest == plain.digest


def test_digest_equality_and_pickling():
    values = draw(8)
    model, plain = machine(symbols(values)), machine(values)
    assert model != plain
    assert model.digest != plain.digest
    assert model == machine(symbols(values))
    assert model != machine(symbols({**values, "tip": 0.123}))
    for again in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        assert again == model
        assert again.parameters == model.parameters
    empty = machine(symbols())
    assert pickle.loads(pickle.dumps(empty)) == empty
    assert "nan" not in f"{model!r}{empty!r}{empty._repr_html_()}".split("child's mass")[0]


def test_without_forgets_the_parameters_of_what_is_gone():
    values = draw(9)
    model = machine(symbols(values))
    assert "g" not in model.without("gravity").parameters
    assert {"spring", "tie"} & set(model.without("springs").parameters) == set()
    assert "rotor" not in model.without("armature").parameters
    assert "friction" not in model.without("damping").parameters
    bare = model.without("damping", "springs", "gravity", "armature")
    assert "tie" not in {s.name for s in bare.springs}
    expected = machine(values).without("damping", "springs", "gravity", "armature")
    fixed = bare.with_parameters(**{n: values[n] for n in bare.parameters})
    assert fixed.digest == expected.digest


def test_what_may_become_nonzero_is_needed():
    model = mb.catalog.pendulum(gravity=mb.Parameter("g", 0.0))
    assert model.needs.gravity
    assert not model.with_parameters(g=0.0).needs.gravity
    b = mb.ModelBuilder("slider")
    b.add_body("block", mass=1.0)
    zero = mb.Parameter("zero", 0.0)
    b.add_joint("x", "prismatic", parent="world", child="block", axis=(1, 0, 0), armature=zero, damping=zero)
    b.add_spring("tie", body_a="world", body_b="block", point_a=(0, 1, 0), stiffness=zero)
    needs = b.build().needs
    assert needs.armature
    assert needs.damping
    assert needs.springs
    assert mb.dynamics(b.build(), "lagrangian").at(zero=2.0).mass_matrix([0.0]).item() == 3.0
    assert [s.name for s in b.build().without("damping").springs] == ["tie"]


def test_states_are_drawn_without_values(open_machine):
    q, v = open_machine[0].random_state(np.random.default_rng(0), 8)
    assert np.isfinite(q).all()
    assert np.isfinite(v).all()


def test_faults_are_collected():
    b = mb.ModelBuilder("faulty", gravity=(0, 0, 1 / mb.Parameter("zero", 0.0)))
    b.add_body("a", mass=mb.Parameter("m", 1.0), com=(0, mb.Parameter("m", 2.0), 0))
    b.add_joint(
        "j", "revolute", parent="world", child="a", axis=(0, mb.Parameter("x", 1.0), 0), lower=mb.Parameter("x", 1.0)
    )
    b.add_spring("s", body_a="world", body_b="a", stiffness=-mb.Parameter("k", 1.0))
    p = mb.Parameter("p", 1.0)
    b.add_body("b", mass=1.0, inertia=[[p, p, 0], [0, p, 0], [0, 0, p]])
    b.add_body("c", mass=1.0, inertia=(p, p, 3 * p))
    b.add_body("d", mass=-p, com=(p, p))
    with pytest.raises(ModelError) as caught:
        b.build()
    told = "\n".join(caught.value.faults)
    for expected in (
        "gravity[2]: (1 / zero) at zero = 0",
        "parameter 'm': two values, 1.0 and 2.0",
        "axis: expected real numbers, got dtype object; no parameter can stand here",
        "lower: expected 1 numbers",
        "spring 's': stiffness -1 is negative",
        "inertia is not symmetric; expected the same expression",
        "violates A + B >= C",
        "mass -1 is negative",
        "body 'd': com: expected shape (3,), got (2,)",
    ):
        assert expected in told, told


def test_the_same_name_with_and_without_a_value_is_refused():
    with pytest.raises(ModelError, match="parameter 'm': two values, None and 2"):
        mb.catalog.double_pendulum(mass1=mb.Parameter("m"), mass2=mb.Parameter("m", 2.0))


@pytest.mark.parametrize(
    ("build", "argument"),
    [
        (mb.catalog.pendulum, "length"),
        (mb.catalog.double_pendulum, "mass2"),
        (mb.catalog.cart_pole, "cart_mass"),
        (mb.catalog.chain, "length"),
        (mb.catalog.chain, "mass"),
        (mb.catalog.heavy_top, "mass"),
        (mb.catalog.free_body, "mass"),
        (mb.catalog.pendulum, "gravity"),
    ],
)
def test_the_catalog_takes_parameters(build, argument):
    model = build(**{argument: mb.Parameter("x", 1.7)})
    assert model.with_parameters(x=2.3) == build(**{argument: 2.3})
    assert build(**{argument: mb.Parameter("x")}).with_parameters(x=2.3) == build(**{argument: 2.3})
    with pytest.raises(InputError, match=argument):
        build(**{argument: mb.Parameter("x", -1.0)})


def test_the_catalogs_vectors_take_parameters():
    p = mb.Parameter("p", 0.3)
    assert mb.catalog.free_body(sides=(p, 2 * p, 0.9)).with_parameters(p=0.2) == mb.catalog.free_body(
        sides=(0.2, 0.4, 0.9)
    )
    top = mb.catalog.heavy_top(inertia=(p, p, p / 2), com=np.array([0.0, 1.0, 0.0]) * p)
    assert top.with_parameters(p=0.5) == mb.catalog.heavy_top(inertia=(0.5, 0.5, 0.25), com=(0.0, 0.5, 0.0))
    with pytest.raises(InputError, match="sides"):
        mb.catalog.free_body(sides=(p, -p, p))
    with pytest.raises(InputError, match="inertia"):
        mb.catalog.heavy_top(inertia=(p, p, 3 * p))


# Expressions

LEAVES = st.one_of(
    st.floats(-10, 10, allow_nan=False).map(float),
    st.sampled_from([mb.Parameter("a", 1.25), mb.Parameter("b", -0.75), mb.Parameter("c", 3.0)]),
)


def _grown(inner):
    pairs = st.tuples(st.sampled_from("+-*"), inner, inner)
    return st.one_of(
        pairs.map(lambda x: {"+": x[1] + x[2], "-": x[1] - x[2], "*": x[1] * x[2]}[x[0]]),
        inner.map(lambda x: -x),
        st.tuples(inner, st.integers(0, 3)).map(lambda x: x[0] ** x[1]),
        inner.map(lambda x: x / 4.0),
    )


class Magnitude(float):
    """The sum of magnitudes behind a number, by which rounding is measured."""

    def __add__(self, other):
        return Magnitude(float(self) + float(other))

    __sub__ = __add__

    def __mul__(self, other):
        return Magnitude(float(self) * float(other))

    def __truediv__(self, other):
        return Magnitude(float(self) / float(other))

    def __neg__(self):
        return self

    def __pow__(self, exponent):
        return Magnitude(float(self) ** exponent)


@settings(max_examples=40)
@given(st.recursive(LEAVES, _grown, max_leaves=8))
def test_expressions_are_what_floats_would_be(x):
    if not isinstance(x, Expression):
        return
    names = {p.name: p.value for p in x.parameters()}
    assert nominal(x) == x.evaluate(lambda p: p.value, float)
    symbol = {n: ca.SX.sym(n) for n in names}
    f = ca.Function("f", list(symbol.values()), [x.evaluate(lambda p: symbol[p.name], float)])
    # At most some forty operations, each of which rounds once, here and there.
    scale = float(x.evaluate(lambda p: Magnitude(abs(p.value)), lambda n: Magnitude(abs(n))))
    assert float(f(*names.values())) == pytest.approx(nominal(x), rel=0, abs=100 * EPS * scale)
    assert pickle.loads(pickle.dumps(x)) == x
    assert hash(x) == hash(copy.deepcopy(x))


def test_numpy_scalars_and_arrays_combine():
    p = mb.Parameter("p", 2.0)
    for x in (np.float64(3.0) * p, p * np.float64(3.0), np.int64(3) * p):
        assert isinstance(x, Expression)
        assert nominal(x) == 6.0
    for array in (p * np.array([1.0, 2.0]), np.array([1.0, 2.0]) * p):
        assert [nominal(x) for x in array] == [2.0, 4.0]
    assert nominal((+p) ** 0.5) == np.sqrt(2.0)
    assert nominal(1 / p**-2) == 4.0
    for wrong in ("a", None, True, [1.0]):
        with pytest.raises(TypeError):
            p + wrong
    with pytest.raises(InputError, match="whole number"):
        p**1.5
    with pytest.raises(InputError, match="whole number"):
        p**p
    with pytest.raises(InputError, match="finite"):
        nominal(p * 1e300 * 1e300)
    with pytest.raises(InputError, match=r"\(-p\)\*\*0.5 at p = 2"):
        nominal((-p) ** 0.5)


# The model's numbers as symbols


@pytest.mark.thorough("panda", "tree")
@pytest.mark.parametrize(
    "build",
    [
        lambda: mb.load("panda"),
        lambda: mb.load("ur5"),
        lambda: mb.catalog.cart_pole(),
        lambda: machine(symbols(draw(1))),
        lambda: random_tree(1, 6, mimic=True),
    ],
    ids=["panda", "ur5", "cart_pole", "machine", "tree"],
)
def test_symbols_give_the_same_numbers(build):
    model = build()
    literal, symbolic = Equations(model), Equations(model, "symbols")
    nominal_values = list(model.parameters.values())
    behind = [nominal_values] if nominal_values else []
    q, v, a, tau = (x[0] for x in states(model, 1))
    state = {"q": q, "v": v, "a": a, "tau": tau}
    for name, needs in FUNCTIONS.items():
        f, g = literal.function(name), symbolic.function(name)
        assert g.name_in() == [*needs, "constants"]
        given = [state[n] for n in needs]
        expected, got = f.call([*given, *behind]), g.call([*given, symbolic.constant_values])
        condition = (
            1 if "forward" not in name else np.linalg.cond(np.array(literal.function("mass_matrix")(q, *behind)))
        )
        for x, y in zip(got, expected, strict=True):
            assert off(np.array(x), np.array(y)) < CLOSE * condition, name
        constants = {g.instruction_constant(k) for k in range(g.n_instructions()) if g.instruction_id(k) == ca.OP_CONST}
        # Nothing of the model is left in the graph, and what is left is exact in any precision.
        assert constants <= {-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0}, name
        # Zeros vanish in both: what grows is a product for a folded constant.
        assert g.n_instructions() < 2 * f.n_instructions() + 40
    frame = model.bodies[-1].name
    given = [q, *behind], [q, symbolic.constant_values]
    poses = (np.array(e.body_quantity("pose", (frame,))(*x)) for e, x in zip((literal, symbolic), given, strict=True))
    assert off(*poses) < CLOSE


def test_a_planar_arm_of_symbols_stays_planar():
    spatial = random_tree(0, 3, ("revolute",))
    planar = mb.catalog.chain(n=3)
    sizes = [Equations(m, "symbols").function("inverse_dynamics").n_instructions() for m in (planar, spatial)]
    assert sizes[0] < 0.3 * sizes[1]


def test_equal_numbers_share_a_symbol():
    eq = Equations(mb.catalog.chain(n=6), "symbols")
    assert len(eq.constant_values) == len(set(np.abs(eq.constant_values)))
    # Length and mass 1, half a length, the rod's inertia, and gravity.
    assert len(eq.constant_values) == 4
    assert eq.constants.numel() == 4


@pytest.mark.parametrize("which", [[False, True], 1, [0.5], [[0]], "a"])
def test_samples_are_chosen_by_whole_numbers_alone(which):
    dyn = mb.dynamics(mb.catalog.pendulum(mass=mb.Parameter("m")), "lagrangian").at(m=[1.0, 2.0])
    assert dyn._of_samples([]).mass_matrix([0.0]).shape == (0, 1, 1)
    with pytest.raises(InputError, match="expected a list of indices"):
        dyn._of_samples(which)
