"""Beams as elements of a description: the paper's energies, the oracle, rigid segments, and what is refused."""

import pickle

import numpy as np
import pytest
import sympy as sp
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation
from scipy.special import jn_zeros

import mbkit as mb
from mbkit.errors import InputError, ModelError, UnsupportedError
from mbkit.model.elements.beams import clamped_free
from mbkit.simulate.plotting.motion_strip import skeleton
from mbkit.testing import assert_engines_agree
from tests.scenes import mounted
from validation import beams

POWER = Polynomial([0, 0, 1.0])
L, EI, RHO, EI2 = 2.3, 31.0, 0.7, 12.0
s, length, bending, heavy, other, mass, down = sp.symbols("s length bending heavy other mass g")
NUMBERS = {length: L, bending: EI, heavy: RHO, other: EI2, mass: 0.4, down: 9.81}


def hub(gravity=(0, 0, 0), **how) -> mb.ModelBuilder:
    """Return a hub on a vertical axis that carries a beam along x."""
    b = mounted("rotor", "hub", "theta", "revolute", gravity=gravity, mass=1.0, inertia=(3.0, 3.0, 3.0), axis=(0, 0, 1))
    b.add_beam("beam", **{"parent": "hub", "length": L, "stiffness": EI, "density": RHO, "modes": 2} | how)
    return b


def satellite() -> mb.Model:
    """Return a body in space with a beam that bends in two planes, a joint at its end, and a beam on the ground."""
    b = mounted("satellite", "hub", "base", "free", gravity=(0.3, -0.2, -9.81), mass=4.0, inertia=(3.0, 2.5, 2.0))
    place = {"translation": (0.5, 0.1, 0), "rpy": (0.1, 0.2, 0.3)}
    b.add_beam("arm", parent="hub", length=L, stiffness=(EI, EI2), density=RHO, modes=2, damping=0.02, **place)
    b.add_body("load", mass=0.3, com=(0.2, 0.1, 0), inertia=(0.01, 0.02, 0.015))
    b.add_joint("wrist", "revolute", parent="arm", child="load", axis=(0, 1, 0), translation=(0.1, 0, 0))
    b.add_beam("wing", parent="hub", length=1.0, stiffness=4.0, density=0.3, shapes=[Polynomial([0, 0, 1])])
    return b.build()


# The paper's energies


def second_order(energy: sp.Expr, small: list[sp.Symbol]) -> sp.Expr:
    """Return the terms of up to second order in deflections and their rates."""
    polynomial = sp.Poly(sp.expand(energy), *small)
    return sp.Add(
        *(c * sp.prod(x**k for x, k in zip(small, m, strict=True)) for m, c in polynomial.terms() if sum(m) < 3)
    )


def same(a: sp.Expr, b: sp.Expr, symbols: list[sp.Symbol], seed: int = 5) -> bool:
    """Return whether two energies are equal to rounding at random states."""
    rng, f = np.random.default_rng(seed), sp.lambdify(symbols, [a, b])
    pairs = np.array([f(*rng.standard_normal(len(symbols))) for _ in range(20)])
    return bool(np.abs(pairs[:, 0] - pairs[:, 1]).max() < 1e-12 * np.abs(pairs).max())


@pytest.mark.thorough("0.0-3", "0.4-3", "0.4-1")
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("tip", [0.0, 0.4])
def test_energies_are_those_of_the_paper_to_second_order(count, tip):
    b = mounted("cart", "cart", "X", "planar", gravity=(0, -9.81, 0), mass=1e-300)
    b.add_beam("a", parent="cart", length=L, stiffness=EI, density=RHO, modes=count, translation=(0.3, 0.2, 0))
    if tip:
        b.add_body("tip", mass=tip)
        b.add_joint("weld", "fixed", parent="a", child="tip")
    lag = mb.lagrangian.from_model(
        b.build(nonphysical="warn"), coordinates=["X", "Y", "theta", *(f"a{i + 1}" for i in range(count))]
    )
    X, Y, th = sp.symbols("X Y theta")
    at = sp.Matrix([X, Y]) + sp.Matrix([[sp.cos(th), -sp.sin(th)], [sp.sin(th), sp.cos(th)]]) @ sp.Matrix([0.3, 0.2])
    on_paper = mb.lagrangian.beam(
        *(length, bending, heavy),
        position=list(at),
        rotation=th,
        coordinates=[X, Y, th],
        gravity=(0, -down),
        tip_mass=mass if tip else 0,
    ).discretized(mb.lagrangian.clamped_free(count, s, length))
    states = [*lag.coordinates, *lag.velocities]
    small = [*on_paper.coordinates, *on_paper.velocities]
    assert same(second_order(lag.T, small), on_paper.T.subs(NUMBERS), states)
    # The potential has no other terms.
    assert same(lag.V.subs(NUMBERS), on_paper.V.subs(NUMBERS), states)


def test_energies_in_space_are_those_of_the_paper_to_second_order():
    b = mb.ModelBuilder("mast", gravity=(0, 0, -9.81))
    for name, parent, axis in (("turn", "world", (0, 0, 1)), ("lift", "turn", (0, 1, 0))):
        b.add_body(name)
        b.add_joint(name, "revolute", parent=parent, child=name, axis=axis)
    b.add_beam("a", parent="lift", length=L, stiffness=(EI, EI2), density=RHO, modes=1)
    lag = mb.lagrangian.from_model(b.build(), coordinates=["A", "B", "a1", "a2"])
    A, B = sp.symbols("A B")
    R = sp.rot_ccw_axis3(A) @ sp.rot_ccw_axis2(B)
    field = mb.lagrangian.beam(
        *(length, (bending, other), heavy), position=(0, 0, 0), rotation=R, coordinates=[A, B], gravity=(0, 0, -down)
    )
    (shape,) = mb.lagrangian.clamped_free(1, s, length)
    on_paper = field.discretized([{"v": shape, "w": 0}, {"v": 0, "w": shape}])
    states, small = [*lag.coordinates, *lag.velocities], [*on_paper.coordinates, *on_paper.velocities]
    assert same(second_order(lag.T, small), on_paper.T.subs(NUMBERS), states)
    assert same(lag.V.subs(NUMBERS), on_paper.V.subs(NUMBERS), states)


def test_shapes_give_the_frequencies_of_the_paper():
    x = sp.Symbol("x")
    w = sp.Function("w")(x, sp.Symbol("t"))
    clamped = mb.lagrangian.Continuum(
        heavy * w.diff("t") ** 2 / 2, bending * w.diff(x, 2) ** 2 / 2, w, (0, length), fixed={0: [w, w.diff(x)]}
    )
    a = clamped.discretized([(x / length) ** k for k in (2, 3, 5)])
    lag = mb.lagrangian.Lagrangian(
        a.T, a.V, a.coordinates, parameters={k: NUMBERS[k] for k in (heavy, bending, length)}
    )
    b = mb.ModelBuilder("wall", gravity=(0, 0, 0))
    shapes = [Polynomial([0] * k + [c]) for k, c in ((2, 1.0), (3, -7.0), (5, 0.1))]
    b.add_beam("a", parent="world", length=L, stiffness=EI, density=RHO, shapes=shapes)
    dyn = mb.dynamics(b.build(), "lagrangian")
    found, exact = (np.sort(mb.equilibrium(x, np.zeros(3)).frequencies) for x in (dyn, lag))
    assert np.abs(found / exact - 1).max() < 1e-12
    # Normal modes: neither M nor K has entries beside the diagonal, and the ends are on the positive side.
    assert np.abs(dyn.mass_matrix(np.zeros(3)) - RHO * L * np.eye(3)).max() < 1e-12
    assert (np.array(dyn.model.joint("a").type.across) > 0).all()


@pytest.mark.thorough
def test_the_mass_matrix_stays_positive_where_the_paper_loses_it():
    """Terms beyond second order in the kinetic energy of points keep it a sum of squares."""
    th = sp.Symbol("theta")
    a = mb.lagrangian.beam(length, bending, heavy, rotation=th, coordinates=[th]).discretized(
        mb.lagrangian.clamped_free(3, s, length)
    )
    lag = mb.lagrangian.Lagrangian(
        a.T, a.V, [th, *a.coordinates], parameters={k: NUMBERS[k] for k in (length, bending, heavy)}
    )
    b = mounted("pin", "pin", "theta", "revolute", gravity=(0, 0, 0), axis=(0, 0, 1))
    b.add_beam("a", parent="pin", length=L, stiffness=EI, density=RHO, modes=3)
    q = np.array([0.0, 0.1 * L, 0.0, 0.0])
    paper, element = (
        np.linalg.eigvalsh(d.mass_matrix(q)) for d in (lag.dynamics(), mb.dynamics(b.build(), "lagrangian"))
    )
    assert paper[0] < 0 < element[0]


@pytest.mark.thorough
def test_spin_up_stiffens():
    """Kane, Ryan and Banerjee's test: the element comes to their equations where deflections are small."""
    errors = []
    for speed in (beams.SPEED, beams.SPEED / 10):
        t, J = sp.Symbol("t"), 1e12
        b = mounted(
            "spin-up", "hub", "theta", "revolute", gravity=(0, 0, 0), mass=1.0, inertia=(J, J, J), axis=(0, 0, 1)
        )
        b.add_beam("beam", parent="hub", length=beams.LENGTH, stiffness=beams.EI, density=beams.DENSITY, modes=2)
        b.add_joint_force("drive", "theta", J * speed / beams.RISE * (1 - sp.cos(2 * sp.pi * t / beams.RISE)))
        dyn = mb.dynamics(b.build(), "lagrangian")
        times = np.linspace(0, beams.RISE, 31)
        run = mb.simulate(dyn, *np.zeros((2, 3)), beams.RISE, "rk853", save=times, rtol=1e-11, atol=1e-13)
        tip = run.q[:, 1:] @ np.array(dyn.model.joint("beam").type.across)[0]
        exact = beams.spin_up(2, times, speed=speed)
        errors.append(np.abs(tip - exact).max() / np.abs(exact).max())
    assert errors[0] < 4e-3
    assert errors[1] < errors[0] / 80


def test_the_end_turns_as_a_section_that_is_not_twisted():
    """To second order: the frame that is carried along the axis without a turn about it (Bishop's)."""
    b = mb.ModelBuilder("wall")
    b.add_beam("a", parent="world", length=L, stiffness=(EI, EI2), density=RHO, modes=3)
    joint = b.build().joint("a")
    shapes, q, errors = clamped_free(3).shapes, np.random.default_rng(2).standard_normal(6), []
    places, steps = (np.arange(800) + 0.5) / 800, L / 800
    for size in (0.02, 0.01):
        (v1, w1), (v2, w2) = ([size * p @ shapes(places, k) / L**k for p in (q[:3], q[3:])] for k in (1, 2))
        R = np.eye(3)
        tangents = np.transpose([1 - (v1**2 + w1**2) / 2, v1, w1])
        for tangent, rate in zip(tangents, np.transpose([-v1 * v2 - w1 * w2, v2, w2]), strict=True):
            # The tangent turns about t × t′.
            R = Rotation.from_rotvec(np.cross(tangent, rate) * steps).as_matrix() @ R
        got = np.array(joint.type.placement(np, joint, list(size * q))[0])
        errors.append(np.abs(got - R).max())
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 7


# Every quantity, and motion


@pytest.fixture(scope="module")
def flexible() -> mb.Model:
    return satellite()


def test_the_material_damps():
    """With c = τ k a mode of the frequency ω falls as exp(-τ ω² t/2)."""
    tau, model = 2e-3, hub().build()
    b = mb.ModelBuilder("wall", gravity=(0, 0, 0))
    b.add_beam("a", parent="world", length=L, stiffness=EI, density=RHO, modes=1, damping=tau)
    dyn = mb.dynamics(b.build(), "lagrangian")
    size, square = 1e-6, float(beams.cantilever(EI, RHO, L, 0, 0, 1)[0]) ** 2
    run = mb.simulate(dyn, [size], [0.0], 0.5, "rk853", rtol=1e-11, atol=1e-18)
    fast = np.sqrt(square - (tau * square / 2) ** 2)
    fall = np.exp(-tau * square / 2 * run.t) * (np.cos(fast * run.t) + tau * square / 2 / fast * np.sin(fast * run.t))
    assert np.abs(run.q[:, 0] / size - fall).max() < 1e-9
    assert not model.needs.damping


def test_stiffness_and_density_may_be_parameters():
    free = {"stiffness": mb.Parameter("EI", EI), "density": mb.Parameter("rho", RHO), "damping": 0.01}
    model = hub(**free).build()
    q, v = model.random_state(0)
    found = mb.dynamics(model, "lagrangian").at(EI=[EI, 2 * EI], rho=0.9)
    for k, stiff in enumerate((EI, 2 * EI)):
        exact = mb.dynamics(hub(stiffness=stiff, density=0.9, damping=0.01).build(), "lagrangian")
        assert found.forward_dynamics(q, v, v)[k] == pytest.approx(exact.forward_dynamics(q, v, v), rel=1e-10)
    assert hub(stiffness=mb.Parameter("EI")).build().segmented(2).parameters == {"EI": None}
    whole = model.segmented(3).with_parameters(EI=2 * EI, rho=0.9)
    exact = hub(stiffness=2 * EI, density=0.9, damping=0.01).build().segmented(3)
    states = exact.random_state(0)
    one, other = (mb.dynamics(x, "lagrangian").forward_dynamics(*states, states[1]) for x in (whole, exact))
    assert one == pytest.approx(other, rel=1e-10)


# Rigid segments


def squares(model: mb.Model, engine: str, rate: float = 0.0) -> np.ndarray:
    """Return the squares of a string's frequencies, rising; on a heavy hub that turns at this rate."""
    dyn = mb.dynamics(model, engine, **({"compile": False} if engine == "lagrangian" else {}))
    still, v, own = np.zeros(model.nv), np.zeros(model.nv), slice(int(rate != 0), None)
    v[: own.start] = rate
    M, K = dyn.mass_matrix(still), dyn.inverse_dynamics_derivatives(still, v, still)[0]
    return np.sort(np.linalg.eigvals(np.linalg.solve(M[own, own], K[own, own])).real)


def hanging(modes: int) -> mb.Model:
    b = mb.ModelBuilder("hanging", gravity=(9.81, 0, 0))
    b.add_beam("chain", parent="world", length=L, stiffness=0.0, density=RHO, modes=modes)
    return b.build()


def test_a_hanging_string_has_the_frequencies_of_bessels_function():
    """ω = j₀ₖ √(g/L)/2 with the zeros of J₀ (Daniel Bernoulli)."""
    exact = (jn_zeros(0, 2) / 2) ** 2 * 9.81 / L
    found = squares(hanging(6), "lagrangian")[:2] / exact - 1
    assert (np.abs(found) < [1e-13, 1e-8]).all()
    errors = [squares(hanging(2).segmented(n), "pinocchio")[0] / exact[0] - 1 for n in (10, 20)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)


@pytest.mark.thorough("0.0-exact0")
@pytest.mark.parametrize(("across", "exact"), [(0.0, [0, 5, 14]), (np.pi / 2, [1, 6, 15])])
def test_a_string_that_turns_has_the_frequencies_of_legendres_polynomials(across, exact):
    """Across the plane ω² = k (2k - 1) Ω², in it Ω² less: of a string on a heavy hub's axis, at any length and mass."""
    b = mounted(
        "rotor", "hub", "theta", "revolute", gravity=(0, 0, 0), mass=1.0, inertia=(1e12, 1e12, 1e12), axis=(0, 0, 1)
    )
    b.add_beam("string", parent="hub", length=L, stiffness=0.0, density=RHO, modes=5, rpy=(across, 0, 0))
    assert squares(b.build(), "lagrangian", 3.0)[:3] / 9 == pytest.approx(exact, abs=1e-9)


def test_engines_agree_on_segments(flexible):
    assert_engines_agree(hub((0, -9.81, 0), damping=0.01).build().segmented(4))
    chain = flexible.segmented(4)
    q, v = chain.random_state(1)
    one, other = (mb.dynamics(chain, e).forward_dynamics(q, v, v) for e in ("pinocchio", "lagrangian"))
    assert one == pytest.approx(other, rel=1e-9)
    assert chain.mass == pytest.approx(flexible.mass, rel=1e-12)
    assert [j.name for j in chain.independent_joints][-1] == "wing.s4"
    assert hub(damping=0.01).build().segmented(2).joint("beam.s1").damping == pytest.approx([0.01 * EI * 2 / L])
    rigid = mb.load("ur5")
    assert rigid.segmented(3) is rigid


# What is refused, and edits


@pytest.mark.parametrize("engine", ["pinocchio", "mujoco", "drake"])
def test_other_engines_name_the_beam_and_the_way_out(engine):
    with pytest.raises(UnsupportedError, match=rf"{engine}: (rotor: )?joint 'beam' is beam_.*segmented\(20\)"):
        mb.dynamics(hub().build(), engine)


@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_file_formats_name_the_beam_alone(form):
    with pytest.raises(UnsupportedError, match=r"joint 'beam' is beam") as error:
        mb.convert(hub().build(), form)
    assert "beam.1" not in str(error.value)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"length": 0.0}, "length: expected a number above 0, got 0"),
        ({"stiffness": -1.0}, "stiffness: expected a number from 0, got -1"),
        ({"stiffness": (1.0, 2.0, 3.0)}, r"stiffness: expected shape \(2,\)"),
        ({"modes": 11}, "modes: expected at most 10"),
        ({"modes": None}, "expected modes or shapes, one of them"),
        ({"modes": None, "shapes": [lambda x: x]}, r"shapes\[0\]: expected a numpy.polynomial"),
        ({"modes": None, "shapes": [Polynomial([0, 1.0])]}, r"shapes\[0\]: expected zero with its slope"),
        ({"stiffness": 0, "modes": None, "shapes": [Polynomial([1.0])]}, r"shapes\[0\]: expected zero at the root"),
        ({"modes": None, "shapes": [POWER, 2 * POWER]}, "shapes: one of them is a sum of the others"),
    ],
)
def test_bad_input_is_one_fault_that_names_the_argument(how, message):
    b = hub(**how)
    b.add_frame("end", body="beam")
    with pytest.raises(ModelError, match=message) as error:
        b.build()
    assert len(error.value.faults) == 1
    with pytest.raises(ModelError, match=r"joint 'beam\.root': unknown body 'hob'; did you mean 'hub'"):
        hub(parent="hob").build()


def test_edits_work_or_refuse_by_name(flexible):
    model = hub().build()
    b = mb.ModelBuilder.of(model)
    b.set_joint("beam.root", translation=(1.0, 0, 0))
    b.set_joint("beam", damping=0.5)
    b.add_prefix("x_")
    moved = b.build()
    assert moved.joint("x_beam").damping.tolist() == [0.5, 0.5]
    M = mb.dynamics(moved, "lagrangian").mass_matrix(np.zeros(3))
    assert M[0, 0] == pytest.approx(3.0 + RHO * ((1 + L) ** 3 - 1) / 3, rel=1e-12)
    b = mb.ModelBuilder.of(model)
    b.remove_joint("beam.root")
    assert b.build().nv == 1
    for edit, message in (
        (lambda b: b.remove_joint("beam"), r"joint 'beam' is a part of a beam; remove_joint\('beam.root'\)"),
        (lambda b: b.remove_joint("beam.3"), r"joint 'beam.3' is a part of a beam; remove_joint\('beam.root'\)"),
        (lambda b: b.set_joint("beam.3", mimic=None), "joint 'beam.3' is a point of beam 'beam'"),
    ):
        b = mb.ModelBuilder.of(model)
        edit(b)
        with pytest.raises(ModelError, match=message):
            b.build()
    with pytest.raises(InputError, match=r"'beam\.3' follows 'beam'; lock that one"):
        model.lock(["beam.3"])
    assert pickle.loads(pickle.dumps(flexible)) == flexible
    assert model.without("springs", "limits").needs.springs is False


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b.set_body("beam.2", mass=1.0), "the mass of its points of beam 'beam'"),
        (lambda b: b.set_joint("beam", stiffness=(1.0, 2.0)), "the stiffness of beam 'beam'"),
        (lambda b: b.add_frame("middle", body="beam.3"), "'middle' acts on the modes or points"),
        (
            lambda b: b.add_joint_force("push", "beam", potential=sp.Symbol("q_0") ** 4),
            "'push' acts on the modes or points",
        ),
        (lambda b: b.add_joint_force("servo", "theta", sp.Symbol("beam.1")), "'servo' acts on the modes or points"),
        (lambda b: b.add_spring("pull", body_a="beam.3", body_b="world", stiffness=1.0), "'pull' acts on the modes"),
    ],
)
def test_segments_refuse_what_they_have_not(change, message):
    b = mb.ModelBuilder.of(hub().build())
    change(b)
    with pytest.raises(UnsupportedError, match=message):
        b.build().segmented(4)


def test_a_beam_is_drawn_along_its_axis():
    """From the clamp to the end, point by point; it does not stretch."""
    model = hub(modes=3).build()
    q = np.array([[0.3, 0.05, -0.02, 0.01]])
    links = skeleton(model, q).links[:, :, 0]
    assert np.abs(links[1:, 0] - links[:-1, 1]).max() < 1e-14
    assert links[-1, 1] == pytest.approx(mb.dynamics(model, "lagrangian").pose(q[0], "beam")[:3, 3], abs=1e-14)
    assert np.linalg.norm(links[:, 1] - links[:, 0], axis=1).sum() == pytest.approx(L, rel=1e-3)


def test_what_turns_at_the_end_is_not_written_out():
    b = mb.ModelBuilder.of(hub().build())
    b.add_body("load", mass=1.0)
    b.add_joint("wrist", "revolute", parent="beam", child="load", axis=(0, 0, 1))
    with pytest.raises(UnsupportedError, match="joint 'wrist' at the end of beam 'beam'"):
        mb.lagrangian.from_model(b.build(nonphysical="warn"))
