"""Blades, and discs and spheres that roll: rows that hold velocities alone, in every engine that takes them."""

from __future__ import annotations

from math import atan, cos, cosh, pi, sin, sqrt, tanh
from typing import Any

import mpmath as mp
import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError, ModelError, NumericalError, UnsupportedError
from mbkit.model import Model
from tests.scenes import mounted
from validation import bicycle as paper

KINDS = ("blade of a", "blade of b", "disc", "sphere")
#: The body whose plane or direction it is: the ground; one that shares joints with the wheel; the wheel's own carrier.
GROUNDS = ("world", "plate", "base")


def machine(kind: str, ground: str, seed: int = 0) -> Model:
    """Return a body with an arm, a wheel on it, and a sliding plate, and one contact without slip, all of it skew."""
    rng = np.random.default_rng(seed)

    def some(n: int) -> np.ndarray:
        return rng.uniform(-0.5, 0.5, n)

    b = mb.ModelBuilder("machine")
    for name, mass in (("base", 2.0), ("arm", 1.0), ("wheel", 1.5), ("plate", 0.7)):
        b.add_body(name, mass=mass, com=some(3), inertia=(0.3, 0.4, 0.5))
    b.add_joint("base", "free", parent="world", child="base")
    b.add_joint("arm", "universal", parent="base", child="arm", axis=(1, 0, 0), axis2=(0, 1, 0), translation=some(3))
    b.add_joint("wheel", "helical", parent="arm", child="wheel", axis=(0.2, 0.9, 0.3), pitch=0.3, translation=some(3))
    b.add_joint("plate", "planar", parent="base", child="plate", translation=some(3))
    ends: dict[str, Any] = {"body_a": "wheel", "body_b": ground, "translation_a": some(3)}
    if kind.startswith("blade"):
        b.add_blade("contact", speed=0.7, **ends, **{f"axis_{kind[-1]}": some(3)})
    else:
        axis = {"axis_a": some(3)} if kind == "disc" else {}
        b.add_rolling("contact", kind, radius=0.4, translation_b=some(3), axis_b=(0.1, 0.2, 0.9), **axis, **ends)  # type: ignore[arg-type]  # by name
    return b.build()


def states(model: Model, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return a consistent state and one that is none."""
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng)
    return [(q, v), (model.integrate(q, 0.1 * rng.standard_normal(model.nv)), rng.standard_normal(model.nv))]


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("ground", GROUNDS)
@pytest.mark.parametrize("kind", KINDS)
def test_engines_agree_on_every_quantity(kind: str, ground: str) -> None:
    model = machine(kind, ground)
    oracle, own, pinocchio = (mb.dynamics(model, name) for name in ("oracle", "lagrangian", "pinocchio"))
    tau = np.random.default_rng(2).standard_normal(model.nv)
    for q, v in states(model, 3):
        arguments = {"q": (q,), "qv": (q, v), "all": (q, v, tau)}
        for name, of in (
            ("constraint_residual", "q"),
            ("constraint_jacobian", "q"),
            ("constraint_rate", "qv"),
            ("constraint_bias", "qv"),
            ("constraint_forces", "all"),
            ("generalized_constraint_force", "all"),
            ("forward_dynamics", "all"),
        ):
            exact = getattr(oracle, name)(*arguments[of])
            for engine in (own, pinocchio):
                error = np.abs(getattr(engine, name)(*arguments[of]) - exact).max(initial=0.0)
                assert error < 1e-12 * max(1.0, np.abs(exact).max(initial=0.0)), (name, engine.engine)


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("ground", GROUNDS)
@pytest.mark.parametrize("kind", KINDS)
def test_rows_are_the_velocities_of_points_that_poses_give(kind: str, ground: str) -> None:
    """By differences of poses: the point of body a that is at the contact does not move past body b."""
    model = machine(kind, ground, 1)
    dyn, (part,) = mb.dynamics(model, "oracle"), model.no_slip
    q, v = model.random_state(4)
    h = 1e-5

    def pose(s: float, body: str) -> np.ndarray:
        return np.eye(4) if body == "world" else dyn.pose(model.integrate(q, s * v), body)

    A, B = pose(0.0, "wheel"), pose(0.0, ground)
    centre, axis = A[:3, :3] @ part.translation_a + A[:3, 3], A[:3, :3] @ part.axis_a
    n, down = B[:3, :3] @ part.axis_b, np.zeros(3)
    if kind == "disc":
        # The lowest of many points of the rim.
        other = np.cross(axis, n) / np.linalg.norm(np.cross(axis, n))
        angles = np.linspace(0, 2 * pi, 100001)
        rim = 0.4 * (np.outer(np.cos(angles), other) + np.outer(np.sin(angles), np.cross(axis, other)))
        down = rim[np.argmin(rim @ n)]
    elif kind == "sphere":
        down = -0.4 * n
    place = np.append(centre + down, 1.0)
    on_a, on_b = np.linalg.solve(A, place), np.linalg.solve(B, place)
    moves = [(pose(h, body) - pose(-h, body)) @ x / (2 * h) for body, x in (("wheel", on_a), (ground, on_b))]
    slip = (moves[0] - moves[1])[:3]
    if kind.startswith("blade"):
        assert abs(slip @ (axis + n) - 0.7) < 1e-8
        assert dyn.constraint_residual(q).shape == (0,)
    else:
        # The rim's points are 6e-5 rad apart.
        assert np.abs(slip).max() < (1e-3 if kind == "disc" else 1e-8)
        height = (place[:3] - B[:3, :3] @ part.translation_b - B[:3, 3]) @ n
        assert abs(height) < 1e-8


@pytest.mark.thorough("disc", "sphere")
@pytest.mark.parametrize("kind", KINDS)
def test_bias_and_gradient_are_derivatives_along_a_motion(kind: str) -> None:
    model = machine(kind, "plate", 2)
    dyn = mb.dynamics(model, "oracle")
    rng = np.random.default_rng(5)
    (_, (q, v)), a, h = states(model, 6), rng.standard_normal(model.nv), 1e-5

    def moved(s: float) -> tuple[np.ndarray, np.ndarray]:
        return model.integrate(q, s * v + 0.5 * s * s * a), v + s * a

    k = len(dyn.constraint_residual(q))
    rate = np.subtract(*(dyn.constraint_residual(moved(s)[0]) for s in (h, -h))) / (2 * h)
    assert np.abs(rate - dyn.constraint_rate(q, v)[:k]).max(initial=0.0) < 1e-8
    second = np.subtract(*(dyn.constraint_rate(*moved(s)) for s in (h, -h))) / (2 * h)
    assert np.abs(second - dyn.constraint_jacobian(q) @ a - dyn.constraint_bias(q, v)).max() < 1e-7
    gradient = dyn.constraint_rate_gradient(q, v)
    along = np.subtract(*(dyn.constraint_rate(model.integrate(q, s * a), v) for s in (h, -h))) / (2 * h)
    assert np.abs(along - gradient @ a).max() < 1e-7


@pytest.mark.thorough("rolling_disc", "bicycle")
@pytest.mark.parametrize("name", ["rolling_disc", "chaplygin_sleigh", "bicycle"])
def test_forces_do_no_work_and_rows_stay_zero(name: str) -> None:
    model = mb.catalog.get(name)()
    dyn, oracle = mb.dynamics(model, "lagrangian"), mb.dynamics(model, "oracle")
    q, v = model.random_state(1, 16)
    tau = np.random.default_rng(2).standard_normal(v.shape)
    a, J, pull = (
        dyn.forward_dynamics(q, v, tau),
        dyn.constraint_jacobian(q),
        dyn.generalized_constraint_force(q, v, tau),
    )
    assert np.abs(dyn.constraint_residual(q)).max(initial=0.0) < 1e-13
    assert np.abs(np.einsum("kij,kj->ki", J, v)).max() < 1e-13
    power, size = np.einsum("ki,ki->k", pull, v), np.linalg.norm(pull, axis=1) * np.linalg.norm(v, axis=1)
    assert (np.abs(power) < 1e-12 * size).all()
    bias = dyn.constraint_bias(q, v)
    left = np.einsum("kij,kj->ki", J, a) + bias
    assert (np.abs(left).max(axis=1) < 1e-12 * (1 + np.abs(a).max(axis=1) + np.abs(bias).max(axis=1))).all()
    exact = oracle.forward_dynamics(q, v, tau)
    assert (np.abs(a - exact).max(axis=1) < 1e-11 * np.abs(exact).max(axis=1)).all()


@pytest.mark.thorough("rk4-options0-1e-08", "gauss4-options1-1e-08", "taylor-options4-1e-11")
@pytest.mark.parametrize(("method", "options", "drift"), [
    ("rk4", {"dt": 1e-3}, 1e-8),
    ("gauss4", {"dt": 2e-3}, 1e-8),
    ("rk853", {}, 1e-8),
    ("rodas5", {}, 1e-6),
    ("taylor", {}, 1e-11),
])  # fmt: skip
def test_energy_stays_along_runs_of_a_wobbling_disc(method: str, options: dict[str, float], drift: float) -> None:
    model = mb.catalog.rolling_disc()
    dyn = mb.dynamics(model, "lagrangian")
    q, v = dyn.project([0, 0, 0, 0.2, 0.3, 0], [1.0, 0, 0, -1.0, 0.5, 4.0])
    run = mb.simulate(dyn, q, v, 2.0, method, **options)
    assert run.stats.finished
    energy = run.energy()
    assert np.ptp(energy) < drift * energy[0]
    assert np.abs(dyn.constraint_residual(run.q)).max() < 1e-13
    assert np.abs(np.einsum("kij,kj->ki", dyn.constraint_jacobian(run.q), run.v)).max() < 1e-12


def test_order_of_a_method_survives_the_projection() -> None:
    dyn = mb.dynamics(mb.catalog.rolling_disc(), "lagrangian")
    q, v = dyn.project([0, 0, 0, 0.2, 0.3, 0], [1.0, 0, 0, -1.0, 0.5, 4.0])
    exact = mb.simulate(dyn, q, v, 1.0, "rk853", rtol=1e-13, atol=1e-13, save=[1.0]).q[-1]
    errors = [np.abs(mb.simulate(dyn, q, v, 1.0, "rk4", dt=h, save=[1.0]).q[-1] - exact).max() for h in (1e-2, 5e-3)]
    assert 12 < errors[0] / errors[1] < 20


# Closed forms


@pytest.mark.parametrize("values", [{}, {"mass": 2.3, "inertia": 0.9, "offset": 0.45}])
def test_sleigh_turns_until_its_mass_leads(values: dict[str, float]) -> None:
    model = mb.catalog.chaplygin_sleigh(**values)
    dyn = mb.dynamics(model, "lagrangian")
    m, c, a = (values.get(k, x) for k, x in (("mass", 1.0), ("inertia", 0.5), ("offset", 0.3)))
    whole = c + m * a * a
    speed, k, late = 1.3, m * a / whole, 1.7
    times = np.linspace(0.0, 6.0, 25)

    def exact(t: float) -> tuple[float, float, float]:
        s = k * speed * (t - late)
        return speed * tanh(s), sqrt(m / whole) * speed / cosh(s), sqrt(whole / m) / a * 2 * atan(tanh(s / 2))

    u, omega, angle = exact(0.0)
    run = mb.simulate(dyn, [0, 0, angle], [u * cos(angle), u * sin(angle), omega], 6.0, "rk853", rtol=1e-12, atol=1e-12,
                      save=times)  # fmt: skip
    for t, q, v in zip(times, run.q, run.v, strict=True):
        u, omega, angle = exact(t)
        assert abs(q[2] - angle) < 1e-10
        assert np.abs(v - [u * cos(angle), u * sin(angle), omega]).max() < 1e-10
    x, y = (mp.quad(lambda t, f=f: exact(t)[0] * f(exact(t)[2]), np.linspace(0, 6, 13)) for f in (cos, sin))
    assert np.abs(run.q[-1, :2] - [float(x), float(y)]).max() < 1e-9


DISCS = [{}, {"radius": 0.3, "mass": 2.0, "axial": 0.18, "across": 0.09, "gravity": 3.7}]


@pytest.mark.thorough("0.4--2.0-values1", "-0.3-0.5-values0", "-0.3-0.5-values1")
@pytest.mark.parametrize("values", DISCS)
@pytest.mark.parametrize(("lean", "yaw_rate"), [(0.4, -2.0), (1.1, 3.0), (-0.3, 0.5)])
def test_disc_rolls_on_a_circle_where_its_moments_balance(
    values: dict[str, float], lean: float, yaw_rate: float
) -> None:
    model = mb.catalog.rolling_disc(**values)
    R, m, axial, across, g = (
        values.get(k, x)
        for k, x in (("radius", 0.5), ("mass", 1.0), ("axial", 0.125), ("across", 0.0625), ("gravity", 9.81))
    )
    s, c = sin(lean), cos(lean)
    spin = (across * yaw_rate**2 * s * c - m * g * R * s) / ((axial + m * R * R) * yaw_rate * c) - yaw_rate * s
    q, v = np.array([0, 0, R * (c - 1), 0, lean, 0]), np.array([0, 0, 0, yaw_rate, 0, spin])
    oracle, dyn = (mb.dynamics(model, name) for name in ("oracle", "lagrangian"))
    J = oracle.constraint_jacobian(q)
    v[:3] = -np.linalg.solve(J[:, :3], J[:, 3:] @ v[3:])
    rates = oracle.forward_dynamics(q, v, np.zeros(6))[3:]
    assert np.abs(rates).max() < 1e-13 * yaw_rate**2 * 10
    # It may be unstable: half a turn.
    run = mb.simulate(dyn, q, v, pi / abs(yaw_rate), "rk853", rtol=1e-12, atol=1e-12)
    assert np.abs(run.q[:, 4] - lean).max() < 1e-9
    assert np.abs(run.v[:, 3] - yaw_rate).max() < 1e-9


@pytest.mark.parametrize("values", [*DISCS, {"axial": 0.25, "across": 0.125}])
def test_disc_is_stable_above_its_critical_speed(values: dict[str, float]) -> None:
    model = mb.catalog.rolling_disc(**values)
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    R, m, axial, across, g = (
        values.get(k, x)
        for k, x in (("radius", 0.5), ("mass", 1.0), ("axial", 0.125), ("across", 0.0625), ("gravity", 9.81))
    )
    critical = m * g * R * across / ((axial + m * R * R) * axial)
    if not values or "gravity" not in values:
        assert sqrt(critical) * R == pytest.approx(sqrt(g * R / (4 if values else 3)))
    for square in (0.3 * critical, 0.9 * critical, 1.1 * critical, 4 * critical):
        spin = sqrt(square)
        v = np.array([R * spin, 0, 0, 0, 0, spin])
        N = dyn.consistent_changes(np.zeros(6), v)
        assert N.shape == (12, 8)
        values_ = np.linalg.eigvals(N.T @ dyn.linearize(np.zeros(6), v, np.zeros(6)).A @ N)
        grows = ((axial + m * R * R) * axial / across * square - m * g * R) / (across + m * R * R)
        largest = max(values_, key=lambda x: abs(x.real) if grows < 0 else abs(x.imag))
        expected = sqrt(abs(grows))
        assert abs((abs(largest.real) if grows < 0 else abs(largest.imag)) - expected) < 1e-9 * expected
        # Six others are zero: place, heading, turn, and the two speeds, with the rounding of a fourfold one.
        assert sum(abs(x) < 1e-3 for x in values_) == 6


def test_sphere_on_a_turntable_moves_on_a_circle() -> None:
    """At 2/7 of the turntable's rate (Earnshaw 1844), whatever its speed: the plane is that of a driven body."""
    b = mb.ModelBuilder("turntable")
    b.add_body("table", mass=3.0, inertia=(1.0, 1.0, 2.0))
    b.add_joint("turn", "continuous", parent="world", child="table", axis=(0, 0, 1))
    b.add_body("ball", mass=0.5, inertia=(0.4 * 0.5 * 0.01,) * 3)
    b.add_joint("move", "free", parent="world", child="ball", translation=(0, 0, 0.1))
    b.add_rolling("contact", "sphere", body_a="ball", body_b="table", radius=0.1)
    b.prescribe("turn", rate=3.0)
    model = b.build()
    dyn = mb.dynamics(model, "lagrangian")
    assert str(dyn.mobility()) == (
        "turntable: degrees of freedom 3 of velocity and 5 of configuration, of 4 rows none is redundant"
    )
    q, v = model.neutral(), np.zeros(7)
    q[1:3], v[0], v[1:3] = (0.7, 0.2), 3.0, (0.4, -0.3)
    # Free to spin about the vertical; what it rolls about follows.
    J = dyn.constraint_jacobian(q)
    turns, rest = [4, 5], [0, 1, 2, 3, 6]
    v[turns] = np.linalg.solve(J[2:, turns], -J[2:, rest] @ v[rest])
    assert np.abs(dyn.constraint_rate(q, v)).max() < 1e-14
    run = mb.simulate(dyn, q, v, 2.0, "rk853", rtol=1e-11, atol=1e-11)
    rate = 2 / 7 * 3.0
    centre = q[1:3] + np.array([-v[2], v[1]]) / rate
    from_centre = run.q[:, 1:3] - centre
    z = (q[1] - centre[0] + 1j * (q[2] - centre[1])) * np.exp(1j * rate * run.t)
    assert np.abs(from_centre[:, 0] + 1j * from_centre[:, 1] - z).max() < 1e-8


# The benchmark bicycle


def test_matrices_of_the_paper_are_those_that_it_prints() -> None:
    with mp.workdps(50):
        off = paper.matrices_from_print(paper.matrices(paper.parameters()))
    assert max(off.values()) <= 0.5


@pytest.mark.thorough("0", "5")
@pytest.mark.parametrize("v", [0, 3, 5, 6, 7, 10])
def test_bicycle_has_the_eigenvalues_of_the_benchmark(v: int) -> None:
    with mp.workdps(50):
        p = paper.parameters()
        canonical = paper.eigenvalues(paper.matrices(p), p["g"], mp.mpf(v))
        oracle = mb.dynamics(mb.catalog.bicycle(), "oracle")
        ours = paper.own_eigenvalues(oracle, v)
        assert paper.apart(ours, canonical) < 1e-12
        assert (
            paper.apart(paper.in_double(mb.dynamics(oracle.model, "lagrangian", compile=False), v), canonical) < 1e-12
        )
        # The print has 14 digits behind the point, and the rounding of double precision in its last ones.
        assert paper.from_print(ours, v) < (61 if v == 7 else 10)


@pytest.mark.parametrize("engine", ["oracle", "lagrangian", "pinocchio"])
def test_bicycle_in_full_motion_accelerates_as_published(engine: str) -> None:
    """Leaning by 0.62 rad, steered, turning: nine accelerations to 12 digits; the state has 13 itself."""
    left, off = paper.in_full_motion(mb.dynamics(mb.catalog.bicycle(), engine))
    assert left < 1
    assert off < 15


def test_bicycle_holds_itself_upright_between_weave_and_capsize() -> None:
    model = mb.catalog.bicycle()
    dyn = mb.dynamics(model, "lagrangian")
    ends = []
    for speed in (3.8, 5.0):
        q, v = paper.running(model, speed)
        v[model.velocity_names.index("lean")] = 0.05
        q, v = dyn.project(q, v)
        run = mb.simulate(dyn, q, v, 4.0, "rk853")
        assert np.ptp(run.energy()) < 1e-7 * run.energy()[0]
        ends.append(np.abs(run.v[-1, model.velocity_names.index("lean")]))
    assert ends[0] > 0.05 > 10 * ends[1]


# The form of constraints


def test_names_sizes_and_freedoms_tell_positions_from_velocities() -> None:
    model = mb.catalog.bicycle()
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    q, v = model.neutral(), np.zeros(9)
    names = dyn.constraint_names
    assert dyn.velocity_constraint_names == names[2:]
    assert names[:2] == ("no slip 'rear' height", "no slip 'front' height")
    assert all(name.endswith("velocity") for name in names[2:])
    assert dyn.constraint_residual(q).shape == (2,)
    assert dyn.constraint_jacobian(q).shape == (6, 9)
    assert dyn.constraint_rate(q, v).shape == dyn.constraint_bias(q, v).shape == (6,)
    free = dyn.mobility()
    assert (free.degrees_of_freedom, free.configuration_freedoms) == (3, 7)
    tree = mb.dynamics(model.without("no_slip"), "lagrangian", compile=False)
    assert tree.velocity_constraint_names == tree.constraint_names == ()
    assert tree.mobility().configuration_freedoms == 9


def test_projection_leaves_a_configuration_that_velocities_alone_bind() -> None:
    dyn = mb.dynamics(mb.catalog.chaplygin_sleigh(), "lagrangian")
    q, v = np.array([0.3, -0.2, 0.7]), np.array([1.0, 2.0, 0.5])
    q1, v1 = dyn.project(q, v)
    assert np.array_equal(q1, q)
    # The least change in the metric of M: across it nothing of the velocity is left.
    M, J = dyn.mass_matrix(q), dyn.constraint_jacobian(q)
    assert np.abs(v1 - v + np.linalg.solve(M, J.T) @ np.linalg.solve(J @ np.linalg.solve(M, J.T), J @ v)).max() < 1e-14


def cart(*, axles: int = 2, **blade: Any) -> Model:
    b = mounted("cart", "cart", "move", "planar", gravity=(0, 0, 0), mass=2.0, inertia=(0.1, 0.2, 0.3))
    for k in range(axles):
        b.add_blade(f"axle{k}", body_a="cart", translation_a=(0.0, 0.2 * k - 0.1, 0.0), axis_a=(0, 1, 0), **blade)
    return b.build()


def test_parallel_blades_are_redundant_and_share_their_force() -> None:
    model = cart()
    engines = [mb.dynamics(model, name) for name in ("lagrangian", "oracle", "pinocchio")]
    assert str(engines[0].mobility()) == (
        "cart: degrees of freedom 2 of velocity and 3 of configuration, of 2 rows 1 is redundant: "
        f"{engines[0].mobility().redundant[0]}; multipliers are not unique"
    )
    q, v = model.random_state(0)
    forces = [dyn.constraint_forces(q, v, np.array([1.0, 0.5, 0.2])) for dyn in engines]
    for f in forces:
        assert np.abs(f - forces[1]).max() < 1e-13
        assert f[0] == pytest.approx(f[1])


def test_a_blade_with_a_speed_is_a_conveyor() -> None:
    model = cart(axles=1, speed=0.8)
    dyn = mb.dynamics(model, "lagrangian")
    q, v = dyn.project(np.zeros(3), np.array([0.5, 0.0, 1.0]))
    assert v[1] == pytest.approx(0.8, abs=1e-15)
    run = mb.simulate(dyn, q, v, 2.0, "rk4", dt=1e-3)
    across = -np.sin(run.q[:, 2]) * run.v[:, 0] + np.cos(run.q[:, 2]) * run.v[:, 1]
    assert np.abs(across - 0.8).max() < 1e-13
    # Its force does work on the turning cart, and no check takes that for an error of the method.
    assert np.ptp(run.energy()) > 0.1
    assert not run.stats.doubts


def test_a_wheel_in_a_plane_keeps_the_rows_that_say_something() -> None:
    b = mb.ModelBuilder("wheel")
    b.add_body("carriage", mass=1.0)
    b.add_body("wheel", mass=2.0, inertia=(0.1, 0.2, 0.1))
    b.add_joint("x", "prismatic", parent="world", child="carriage", axis=(1, 0, 0), translation=(0, 0, 0.5))
    b.add_joint("turn", "continuous", parent="carriage", child="wheel", axis=(0, 1, 0))
    b.add_rolling("ground", "disc", body_a="wheel", radius=0.5, axis_a=(0, 1, 0))
    model = b.build()
    for name in ("lagrangian", "pinocchio", "oracle"):
        dyn = mb.dynamics(model, name)
        assert dyn.constraint_names == ("no slip 'ground' forward velocity",)
        a = dyn.forward_dynamics(np.zeros(2), np.array([1.0, 2.0]), np.array([1.0, 0.0]))
        assert np.abs(a - np.array([1.0, 2.0]) / (3 + 0.2 * 4)).max() < 1e-15


# Refusals and faults


def test_loads_and_reduced_inertia_do_not_leave_contact_forces_out_in_silence() -> None:
    model = mb.catalog.bicycle()
    still = np.zeros(9)
    for engine in ("lagrangian", "pinocchio", "oracle"):
        dyn = mb.dynamics(model, engine)
        with pytest.raises(UnsupportedError, match=r"'rear'.*'front'.*constraint_forces"):
            dyn.joint_wrenches(still, still, still, tau=still)
        with pytest.raises(UnsupportedError, match=r"holds velocities.*consistent_changes"):
            dyn.reduced_inertia(still, "lean")


def test_every_fault_is_in_the_one_error() -> None:
    b = mounted("faults", "a", "j", "free", mass=1.0, inertia=(1, 1, 1))
    b.add_blade("neither", body_a="a")
    b.add_blade("both", body_a="a", axis_a=(1, 0, 0), axis_b=(1, 0, 0))
    b.add_blade("zero", body_a="a", axis_a=(0, 0, 0))
    b.add_blade("twice", body_a="a", axis_a=(1, 0, 0))
    b.add_blade("twice", body_a="a", axis_a=(1, 0, 0))
    b.add_blade("own", body_a="a", body_b="a", axis_a=(1, 0, 0))
    b.add_blade("fast", body_a="a", axis_a=(1, 0, 0), speed=float("nan"))
    b.add_rolling("kind", "cone", body_a="a", radius=1.0, axis_a=(1, 0, 0))  # type: ignore[arg-type]  # on purpose
    b.add_rolling("flat", "disc", body_a="a", radius=0.0, axis_a=(1, 0, 0))
    b.add_rolling("no axis", "disc", body_a="a", radius=1.0)
    b.add_rolling("an axis", "sphere", body_a="a", radius=1.0, axis_a=(1, 0, 0))
    b.add_rolling("elsewhere", "sphere", body_a="b", radius=1.0)
    with pytest.raises(ModelError) as error:
        b.build()
    for text in ("'neither': expected the direction", "'both': expected the direction", "'zero': axis_a is zero",
                 "'twice': declared 2 times", "'own': both points on 'a'", "'fast': speed", "unknown kind 'cone'",
                 "'flat': expected a radius above 0", "'no axis': a disc has an axis",
                 "'an axis': a sphere has no axis", "unknown body 'b'"):  # fmt: skip
        assert text in str(error.value), text


def test_a_disc_that_lies_flat_is_named() -> None:
    model = mb.catalog.rolling_disc()
    q = np.array([0, 0, -0.5, 0, pi / 2, 0])
    for name in ("lagrangian", "pinocchio", "oracle"):
        # cos(π/2) is 6e-17 in double: exactly flat it lies where the angle is turned by the joint's frame.
        b = mounted("coin", "coin", "move", "free", mass=1.0, inertia=(1, 1, 1))
        b.add_rolling("floor", "disc", body_a="coin", radius=0.5, axis_a=(0, 0, 1))
        coin = mb.dynamics(b.build(), name)
        with pytest.raises(NumericalError, match="floor"):
            coin.constraint_jacobian(coin.model.neutral())
        assert np.isfinite(mb.dynamics(model, name).constraint_jacobian(q)).all()
    b = mounted("record", "record", "turn", "planar", mass=1.0, inertia=(1, 1, 1))
    b.add_rolling("floor", "disc", body_a="record", radius=0.5, axis_a=(0, 0, 1))
    with pytest.raises(InputError, match=r"'floor'.*lies flat"):
        mb.dynamics(b.build(), "lagrangian").constraint_names  # noqa: B018  # derived there


def test_rows_that_cannot_hold_are_refused_with_what_is_left() -> None:
    b = mb.ModelBuilder("rail")
    b.add_body("cart", mass=1.0, inertia=(1, 1, 1))
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0))
    b.add_blade("wind", body_a="cart", axis_a=(0, 1, 0), speed=0.5)
    with pytest.raises(InputError, match="no velocity has this speed"):
        mb.dynamics(b.build(), "lagrangian").constraint_names  # noqa: B018  # derived there
    b = mounted("hovering", "wheel", "x", "planar", mass=1.0, inertia=(1, 1, 1), translation=(0, 0, 0.6))
    b.add_rolling("ground", "disc", body_a="wheel", radius=0.5, axis_a=(0, 1, 0))
    with pytest.raises(InputError, match=r"height: the ends never meet.*0\.1 is left"):
        mb.dynamics(b.build(), "pinocchio").constraint_jacobian(np.zeros(3))


def test_a_bicycle_that_lies_flat_is_no_random_state_and_has_no_projection() -> None:
    """Yaw and spins turn about one line there, so that M has no inverse; a raw error of NumPy ended 64 draws."""
    model = mb.catalog.bicycle()
    q, _ = model.random_state(0, 64)
    assert np.isfinite(q).all()
    flat = np.array([0, 0, 0, 0.3, np.pi / 2, 0, 0, 0, 0])
    with pytest.raises(mb.errors.MbkitError, match="singular on what the constraints leave free"):
        mb.dynamics(model, "lagrangian").project(flat, np.ones(9))


def test_wheels_carry_the_weight() -> None:
    """At rest and upright, by the levers of the masses about both contacts."""
    model = mb.catalog.bicycle()
    dyn = mb.dynamics(model, "pinocchio")
    forces = dyn.constraint_forces(np.zeros(9), np.zeros(9), np.zeros(9))
    moment = 0.3 * 85 + 0.9 * 4 + 1.02 * 3
    # It begins to fall about its wheels, straight to one side: the normal forces are those of rest.
    assert forces[1] == pytest.approx(9.81 * moment / 1.02, rel=1e-12)
    assert forces[0] + forces[1] == pytest.approx(9.81 * 94, rel=1e-12)
