"""Strings and beams on paper: their equations and ends, frequencies beside closed forms, and beams on moving roots."""

import warnings

import mpmath
import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.errors import InputError, MbkitWarning, NumericalError, UnsupportedError
from validation import beams, flexible

x, s, t, L, rho, EI, P, m, J, Om, kGA, RI = sp.symbols("x s t L rho EI P m J Omega kGA rhoI")
w, psi = sp.Function("w")(x, t), sp.Function("psi")(x, t)
MOVING, BENT, TIP = rho * w.diff(t) ** 2 / 2, EI * w.diff(x, 2) ** 2 / 2, {L: m * w.diff(t) ** 2 / 2}
CLAMP = {0: [w, w.diff(x)]}
Continuum, Lagrangian, beam = mb.lagrangian.Continuum, mb.lagrangian.Lagrangian, mb.lagrangian.beam
CANTILEVER = Continuum(MOVING, BENT, w, (0, L), fixed=CLAMP)
TIMOSHENKO = Continuum(
    MOVING + RI * psi.diff(t) ** 2 / 2,
    EI * psi.diff(x) ** 2 / 2 + kGA * (w.diff(x) - psi) ** 2 / 2,
    [w, psi],
    (0, L),
    fixed={0: [w, psi]},
    T_ends={L: TIP[L] + J * psi.diff(t) ** 2 / 2},
)
ROTATING = Continuum(MOVING, BENT + rho * Om**2 * (L**2 - x**2) / 4 * w.diff(x) ** 2, w, (0, L), fixed=CLAMP)


# Equations


def test_a_string_with_a_mass():
    string = Continuum(MOVING, P * w.diff(x) ** 2 / 2, w, (0, L), fixed={0: [w]}, T_ends=TIP, forces={w: -w.diff(t)})
    lines = str(string.equations()).splitlines()
    assert lines == ["ρ w_tt - P w_xx = -w_t", "w = 0   at x = 0", "m w_tt + P w_x = 0   at x = L"]


def test_a_beam_with_a_body():
    body = {L: TIP[L] + J * w.diff(x, t) ** 2 / 2}
    spring = {L: P * w**2 / 2}
    lines = str(Continuum(MOVING, BENT, w, (0, L), fixed=CLAMP, T_ends=body, V_ends=spring).equations()).splitlines()
    assert lines[0] == "ρ w_tt + EI w_xxxx = 0"
    assert lines[3:] == ["m w_tt - EI w_xxx + P w = 0   at x = L", "J w_xtt + EI w_xx = 0   at x = L"]


def test_a_beam_with_shear():
    first, second = TIMOSHENKO.equations().field_equations
    jets = {str(a): a for a in first.lhs.free_symbols | second.lhs.free_symbols}
    wtt, wx, wxx, turn, tx, txx, ttt = (jets[n] for n in ["w_tt", "w_x", "w_xx", "psi", "psi_x", "psi_xx", "psi_tt"])
    assert sp.expand(first.lhs - (rho * wtt - kGA * (wxx - tx))) == 0
    assert sp.expand(second.lhs - (RI * ttt - EI * txx - kGA * (wx - turn))) == 0
    places = [str(end) for end, _ in TIMOSHENKO.equations().boundary_conditions]
    assert places == ["0", "0", "L", "L"]
    assert "(x = L)" in TIMOSHENKO.equations().latex()


def test_a_section_that_changes():
    stiff, heavy = sp.Function("EI")(x), sp.Function("rho")(x)
    lines = str(Continuum(heavy * w.diff(t) ** 2 / 2, stiff * w.diff(x, 2) ** 2 / 2, w, (0, L)).equations())
    assert lines.splitlines()[0] == "ρ(x) w_tt + EI(x) w_xxxx + 2 EI′(x) w_xxx + EI′′(x) w_xx = 0"


def test_nothing_is_passed_on_at_the_free_end_of_a_turning_string():
    string = Continuum(MOVING, rho * Om**2 * (L**2 - x**2) / 4 * w.diff(x) ** 2, w, (0, L), fixed={0: [w]})
    assert len(string.equations().boundary_conditions) == 1
    # Legendre's polynomials: ω² = n (2 n - 1) Ω².
    squares = string.normal_modes(4, {rho: 1.3, Om: 1.0, L: 2.0}).frequencies ** 2
    assert np.abs(squares / [1, 6, 15, 28] - 1).max() < 1e-13


@pytest.mark.thorough("shear", "rotating")
@pytest.mark.parametrize("system", [CANTILEVER, TIMOSHENKO, ROTATING], ids=["beam", "shear", "rotating"])
def test_modes_satisfy_the_equations_and_every_boundary_condition(system):
    values = {rho: 1.3, EI: 2.1, L: 1.7, m: 0.8, J: 0.3, kGA: 40.0, RI: 0.02, Om: 3.0}
    found, equations = system.normal_modes(2, values), system.equations()
    for omega, shape in zip(found.frequencies, found.shapes, strict=True):
        fields = shape if isinstance(shape, dict) else {"w": shape}

        def put(e, at, omega=omega, fields=fields):
            for a in e.free_symbols:
                name, _, order = a.name.partition("_")
                if name in fields:
                    value = sp.diff(fields[name], x, order.count("x")) * (-(omega**2)) ** (order.count("t") // 2)
                    e = e.subs(a, value.subs(x, at))
            return float(e.subs(x, at).subs(values))

        rows = [(e.lhs, L / 3) for e in equations.field_equations]
        rows += [(e.lhs, end) for end, e in equations.boundary_conditions]
        for row, at in rows:
            size = max(abs(put(term, at)) for term in sp.Add.make_args(sp.expand(row)))
            curvature = max(abs(put(system.jets.symbol(0, (2, 0)), L / 5)), 1)
            assert abs(put(row, at)) < 1e-9 * max(size, curvature), row


# Frequencies


@pytest.mark.thorough
def test_frequencies_are_those_of_closed_forms():
    assert max(flexible.strings_and_beams().values()) < 1e-12


def on(force, *, fixed=CLAMP, V=BENT, **more):
    return Continuum(MOVING, V, w, (0, L), fixed=fixed, forces={w: force}, **more)


def test_forces_of_the_deflection_are_stiffness_of_the_modes():
    values = {rho: 1.7, EI: 3.1, L: 2.3, P: 3.0}
    squares = (np.array([1.875104068711961, 4.694091132974175]) / 2.3) ** 4 * 3.1 / 1.7
    found = on(-P * w).normal_modes(2, values).frequencies
    assert np.abs(found - [1.60321, 5.77950]).max() < 1e-5
    assert np.abs(found / np.sqrt(squares + 3.0 / 1.7) - 1).max() < 1e-13
    # Loads move the place of rest alone; a force may have a potential that its ends show.
    assert np.abs(on(m * sp.sin(t) * x).normal_modes(2, values).frequencies / np.sqrt(squares) - 1).max() < 1e-13
    pinned, k = {0: [w], L: [w]}, np.arange(1, 3) * np.pi / 2.3
    found = on(P * w.diff(x, 2), fixed=pinned).normal_modes(2, values).frequencies
    assert np.abs(found / np.sqrt((3.1 * k**4 + 3.0 * k**2) / 1.7) - 1).max() < 1e-12
    with pytest.raises(NumericalError, match="not stable"):
        on(-P * w).normal_modes(2, values | {P: -30.0})
    # Modes and assumed modes are of one system.
    a = on(-P * w).discretized(on(-P * w).normal_modes(2, values))
    whole = Lagrangian(a.T, a.V, a.coordinates, forces=a.forces, parameters=values)
    assert np.abs(mb.equilibrium(whole, [0, 0]).frequencies / np.sqrt(squares + 3.0 / 1.7) - 1).max() < 1e-12


@pytest.mark.parametrize(
    ("force", "words"),
    [
        (-P * w.diff(t), r"forces\[w\(x, t\)\]: w_t damps"),
        (-P * w**2, r"forces\[w\(x, t\)\]: modes of free vibration are of linear forces"),
        (-P * w.diff(x), "forces: they have no potential"),
        (-P * w.diff(x, 2), "forces: they have no potential"),
    ],
)
def test_forces_without_modes_of_real_shapes_are_refused(force, words):
    with pytest.raises(UnsupportedError, match=words):
        on(force).normal_modes(1, {rho: 1.7, EI: 3.1, L: 2.3, P: 3.0})


def test_names_are_free_in_ends_and_forces_too():
    a1, slope = sp.symbols("a1 w_x")
    for more in ({"V_ends": {L: a1 * w**2}}, {"T_ends": {L: a1 * w.diff(t) ** 2}}, {"force": -a1 * w}):
        with pytest.raises(InputError, match="name: a1 is in the energies or forces already"):
            on(**({"force": 0 * w} | more)).discretized([(x / L) ** 2])
    with pytest.raises(InputError, match=r"V_ends\[L\]: w_x is how a derivative"):
        on(0 * w, V_ends={L: slope * w.diff(x) ** 2})


def test_a_free_beam_moves_as_a_rigid_body_too():
    free = Continuum(MOVING, BENT, w, (0, L)).normal_modes(4, {rho: 1.3, EI: 2.1, L: 1.7})
    assert (free.frequencies[:2] == 0).all()
    betas = np.sqrt(free.frequencies[2:] * np.sqrt(1.3 / 2.1)) * 1.7
    assert np.abs(np.cos(betas) * np.cosh(betas) - 1).max() < 1e-9 * np.cosh(betas).max()


def test_a_column_buckles_under_its_own_weight():
    g, v = sp.symbols("g"), {EI: 1.0, rho: 1.0, L: 1.0}
    column = beam(L, EI, rho, rotation=sp.pi / 2, gravity=(0, -g))
    # Greenhill 1881: the first zero of J of order -1/3.
    j = mpmath.findroot(lambda z: mpmath.besselj(-mpmath.mpf(1) / 3, z), 1.87)
    critical = float(9 * j**2 / 4)
    assert column.normal_modes(1, {**v, g: critical * (1 - 1e-9)}).frequencies[0] < 1e-3
    with pytest.raises(NumericalError, match="not stable"):
        column.normal_modes(1, {**v, g: critical * (1 + 1e-9)})
    hanging = beam(L, EI, rho, rotation=-sp.pi / 2, gravity=(0, -g)).normal_modes(1, {**v, g: 8.0})
    assert hanging.frequencies[0] > 3.52


def test_forces_and_large_deflections_of_a_string():
    f, EA = sp.symbols("f EA")
    V = P * w.diff(x) ** 2 / 2 + EA * w.diff(x) ** 4 / 8
    string = Continuum(MOVING, V, w, (0, L), fixed={0: [w], L: [w]}, forces={w: f - 2 * w.diff(t)})
    a = string.discretized([sp.sin(sp.pi * x / L)])
    (q,), (v,) = a.coordinates, a.velocities
    with mpmath.workdps(20):
        exact = (P * sp.pi**2 / (4 * L)) * q**2 + 3 * EA * sp.pi**4 / (64 * L**3) * q**4
        for numbers in ({P: 1, EA: 0, L: 3, q: 1}, {P: 0, EA: 1, L: 3, q: 1}):
            assert abs((a.V / exact).subs(numbers).evalf(20) - 1) < 1e-18
    assert abs((a.forces[q] - (2 * L * f / sp.pi - L * v)).subs({f: 1, L: 3, v: 1}).evalf(20)) < 1e-17


def test_a_section_that_is_no_polynomial():
    # ρ and P as e^(2 x): w = e^-x sin kx with ω² = k² + 1, and tan k = k at the free end; x e^-x is the first mode.
    horn = sp.exp(2 * x)
    string = Continuum(horn * w.diff(t) ** 2 / 2, horn * w.diff(x) ** 2 / 2, w, (0, 1), fixed={0: [w]})
    found = string.normal_modes(3, {})
    roots = [mpmath.findroot(lambda k: mpmath.sin(k) - k * mpmath.cos(k), guess) for guess in (4.49, 7.73)]
    exact = [1.0, *(float(mpmath.sqrt(k**2 + 1)) for k in roots)]
    assert np.abs(found.frequencies / exact - 1).max() < 1e-12
    a = string.discretized(found)
    assert (sp.hessian(a.T, a.velocities) - sp.eye(3)).norm() < 1e-12


# Beams on moving roots


def second_order(root, R, shapes):
    """Return T of a beam without stretch to second order in its deflection, from the places of its points."""
    e = sp.symbols("e")
    a = [sp.Function(f"a{i + 1}")(t) for i in range(len(shapes[0]))]
    bent = [e * sum(f * b for f, b in zip(row, a, strict=True)) for row in shapes]
    u = -sum(sp.integrate(sp.expand(b.diff(s) ** 2), (s, 0, s)) for b in bent) / 2
    place = root + R * sp.Matrix([s + u, *bent])
    T = sum(c**2 for c in place.diff(t)) * rho / 2
    T = sum(T.diff(e, k).subs(e, 0) / sp.factorial(k) for k in range(3))
    return sp.integrate(sp.expand(T.doit()), (s, 0, L)), a


@pytest.mark.thorough
@pytest.mark.parametrize("space", [False, True], ids=["plane", "space"])
def test_the_energy_of_a_beam_is_that_of_its_points_to_second_order(space):
    names = "X Y Z theta phi"
    X, Y, Z, th, ph = sp.symbols(names)
    shapes = [[(s / L) ** 2, (s / L) ** 3], [(s / L) ** 2, 0]][: 1 + space]
    c, d, C, D = sp.cos(th), sp.sin(th), sp.cos(ph), sp.sin(ph)
    R = sp.Matrix([[c, -d], [d, c]])
    root = sp.Matrix([X + d, Y * X])
    coordinates = [X, Y, th]
    if space:
        R = sp.Matrix([[c, -d, 0], [d, c, 0], [0, 0, 1]]) * sp.Matrix([[C, 0, D], [0, 1, 0], [-D, 0, C]])
        root, coordinates = sp.Matrix([*root, Z]), [X, Y, Z, th, ph]
    one = beam(L, EI, rho, position=root, rotation=R if space else th, coordinates=coordinates)
    modes = [dict(zip("vw", pair, strict=False)) if space else pair[0] for pair in zip(*shapes, strict=True)]
    found = one.discretized(modes)
    moved = {q: sp.Function(q.name)(t) for q in coordinates}
    exact, a = second_order(root.subs(moved), R.subs(moved), shapes)
    put = [(sp.Derivative(f, t), sp.Symbol(f"{f.func.__name__}dot")) for f in moved.values()]
    put += [(sp.Derivative(f, t), v) for f, v in zip(a, found.velocities, strict=True)]
    put += [(f, q) for q, f in moved.items()] + list(zip(a, found.coordinates, strict=True))
    named = {n: sp.Symbol(f"{n.name}dot") for n in coordinates}
    exact = exact.subs(put)
    rng = np.random.default_rng(3)
    for _ in range(4):
        symbols = (exact.free_symbols | found.T.free_symbols) | set(named.values())
        numbers = {y: sp.Rational(int(rng.integers(-9, 10)), 7) for y in sorted(symbols, key=str)}
        numbers[L] = sp.Rational(5, 3)
        a0, b0 = (sp.N(e.subs(numbers), 30) for e in (exact, found.T))
        assert abs(a0 - b0) < 1e-14 * abs(a0)


def test_a_string_and_a_body_at_the_end():
    th = sp.Symbol("theta")
    string = beam(L, 0, rho, tension=P, rotation=th, coordinates=[th], tip_mass=m)
    assert [str(c.lhs) for e, c in string.equations().boundary_conditions if e == 0] == ["v"]
    tip = beam(L, EI, rho, rotation=th, coordinates=[th], tip_mass=m, tip_inertia=J).discretized([(s / L) ** 2])
    rate, a, adot = sp.symbols("thetadot a1 adot1")
    body = sp.expand(tip.T).coeff(J)
    assert sp.expand(body - (rate + 2 * adot / L) ** 2 / 2) == 0
    # v² - L ∫ v′² L dx at the end: a² (1 - 4/3).
    of_mass = ((L * rate + adot) ** 2 - rate**2 * a**2 / 3) / 2
    assert sp.expand(sp.expand(tip.T).coeff(m) - of_mass) == 0


def test_a_beam_of_small_deflections_is_no_negative_mass():
    th, arm = sp.Symbol("theta"), {L: 10.0, EI: 1.4e4, rho: 1.2, J: 50.0}
    a = beam(L, EI, rho, rotation=th, coordinates=[th]).discretized(mb.lagrangian.clamped_free(2, s, L))
    T = J * sp.Symbol("thetadot") ** 2 / 2 + a.T
    with warnings.catch_warnings():
        warnings.simplefilter("error", MbkitWarning)
        Lagrangian(T, a.V, [th, *a.coordinates], parameters=arm)
    with pytest.warns(MbkitWarning, match="negative kinetic energy"):
        Lagrangian(-T, a.V, [th, *a.coordinates], parameters=arm)


# What is refused


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: Continuum(MOVING, BENT, sp.Symbol("w"), (0, L)), InputError, "functions of one place"),
        (lambda: Continuum(MOVING, BENT, w, (0, L), fixed={0: [w.diff(x, 2)]}), InputError, "below the highest"),
        (lambda: Continuum(MOVING, P * w.diff(x) ** 2, w, (0, L), T_ends={L: w.diff(x, t) ** 2}), InputError, "w_xt"),
        (lambda: Continuum(w.diff(t, 2) ** 2, BENT, w, (0, L)), InputError, "second derivatives by the time"),
        (lambda: Continuum(MOVING, w.diff(t) ** 2, w, (0, L)), InputError, "no rates"),
        (lambda: CANTILEVER.discretized([x / L]), InputError, "w_x = 1"),
        (lambda: CANTILEVER.discretized([m * x**2]), InputError, "m beside"),
        (lambda: TIMOSHENKO.discretized([x**2]), InputError, "mapping of w, psi"),
        (lambda: Continuum(MOVING, sp.cos(w.diff(x)), w, (0, L)).discretized([x / L]), UnsupportedError, "polynomial"),
        (lambda: CANTILEVER.discretized([sp.sqrt(x / L - 2)]), InputError, "no real value"),
        (lambda: CANTILEVER.discretized([sp.sqrt(x / L) ** 5, (x / L) ** 2]), NumericalError, "does not settle"),
        (lambda: CANTILEVER.normal_modes(1, {L: 0, EI: 1, rho: 1}), InputError, "not above zero"),
        (lambda: beam(-1, EI, rho), InputError, "length: expected a length above zero, got -1"),
        (lambda: CANTILEVER.normal_modes(2, {L: 1.0}), InputError, "EI, rho"),
        (lambda: beam(L, EI, rho, position=[0, 0, 0], rotation=sp.ones(3)), InputError, "orthonormal"),
        (lambda: beam(L, EI, rho, rotation=s, coordinates=[s]), InputError, "place along the beam"),
        (lambda: mb.lagrangian.clamped_free(21, x, L), UnsupportedError, "at most 20"),
        (lambda: CANTILEVER.discretized([(x / L) ** 2]).at(2.0), InputError, "from 0 to 1"),
    ],
)
def test_what_is_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_exact_modes_of_a_cantilever():
    a = CANTILEVER.discretized(mb.lagrangian.clamped_free(4, x, L))
    k = Lagrangian(a.T, a.V, a.coordinates, parameters={rho: 1.0, EI: 1.0, L: 1.0})
    assert k.kinetic.M.subs({rho: 1, L: 1}) == sp.eye(4)
    assert k.V.subs({EI: 1, L: 1}).coeff(a.coordinates[0] * a.coordinates[1]) == 0
    found, exact = mb.equilibrium(k, np.zeros(4)).frequencies, beams.cantilever(1, 1, 1, 0, 0, 4)
    assert np.abs(np.sort(found) / np.array(exact, dtype=float) - 1).max() < 1e-13
    assert np.abs(np.abs(a.at(1.0)) - 2).max() < 1e-14
    assert a.at([0.0, 1.0]).shape == (2, 4)


def test_without_stiffening_the_energy_is_that_of_points_that_move_across_only():
    th = sp.Symbol("theta")
    found = beam(L, EI, rho, rotation=th, coordinates=[th], stiffening=False).discretized([(s / L) ** 2])
    turn = sp.Symbol("thetadot")
    assert sp.expand(found.T.coeff(turn**2)).coeff(sp.Symbol("a1") ** 2) == L * rho / 10


def test_chains_of_rigid_segments_come_to_the_beam_as_the_square_of_their_length():
    exact = float(beams.cantilever(beams.EI, beams.DENSITY, beams.LENGTH, 0, 0, 1)[0])
    for engine in ("pinocchio", "mujoco"):
        errors = []
        for n in (6, 12):
            M = mb.dynamics(flexible.rotor(1).segmented(n), engine).mass_matrix(np.zeros(n + 1))[1:, 1:]
            K = np.eye(n) * beams.EI * n / beams.LENGTH
            errors.append(np.sqrt(np.linalg.eigvals(np.linalg.solve(M, K)).real.min()) / exact - 1)
        assert 1.9 < np.log2(errors[0] / errors[1]) < 2.1
