"""Small motions whose masses, damping and stiffness differ by many powers of ten: none is lost, none called stable."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.lagrangian import Lagrangian
from mbkit.methods.small_motions import definite, eigenvalues, small_motion

x, y, z, u, v, w = sp.symbols("x y z u v w")
EPS = np.finfo(float).eps
NEGATIVE_DAMPER = Lagrangian(
    (u**2 + v**2) / 2, 50 * (x**2 + y**2), [x, y], [u, v], forces={y: v / 2}, dissipation=1e8 * u**2 / 2
)
FOLLOWER = Lagrangian(
    (u**2 + v**2 + w**2) / 2,
    1e10 * x**2 / 2 + 100 * (y**2 + z**2),
    [x, y, z],
    [u, v, w],
    forces={y: -20 * z, z: 20 * y},
)
TWO = Lagrangian((u**2 + v**2) / 2, 1e8 * x**2 / 2 + y**2 / 2, [x, y], [u, v])
#: Each with its eigenvalues, in closed form.
CASES = {
    "negative damper": (NEGATIVE_DAMPER, False, [*np.roots([1, -0.5, 100]), -1e8 + 1e-6, -1e-6 - 1e-20]),
    "follower": (
        FOLLOWER,
        False,
        [s * np.sqrt(np.complex128(-200 + a)) for s in (1, -1) for a in (20j, -20j)] + [1e5j, -1e5j],
    ),
    "two oscillators": (TWO, True, [1j, -1j, 1e4j, -1e4j]),
}


def near(found, exact, rel=1e-11):
    """Return whether each exact eigenvalue has one that was found."""
    left = list(found)
    for value in sorted(exact, key=abs):
        left.remove(min(left, key=lambda e, value=value: abs(e - value)) if left else None)
    ends = [min(found, key=lambda e, value=value: abs(e - value)) for value in exact]
    return not left and all(abs(a - b) <= rel * abs(b) for a, b in zip(ends, exact, strict=True))


@pytest.mark.parametrize("name", CASES)
def test_slow_motions_beside_fast_ones(name):
    system, stable, exact = CASES[name]
    rest = mb.equilibrium(system, np.zeros(len(system.coordinates)))
    assert rest.stable is stable
    assert near(rest.eigenvalues, exact)
    turning = sorted(e.imag for e in exact if e.imag > 0)
    assert rest.frequencies == pytest.approx(turning, rel=1e-11)
    # The linear system and the diagnosis of stiffness have the same rates.
    dyn, still = system.dynamics(), np.zeros(len(system.coordinates))
    assert near(dyn.linearize(still, still, still).eigenvalues, exact)
    rates = mb.simulate.stiffness(dyn, still, still)
    assert near(rates.eigenvalues, exact)
    assert rates.growth == pytest.approx(max(0.0, *(e.real for e in exact)), rel=1e-11)


@pytest.mark.thorough("mujoco")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco"])
def test_a_pendulum_on_a_stiff_mount_keeps_its_frequency(engine):
    b = mb.ModelBuilder("mount")
    b.add_body("block", mass=50.0)
    b.add_body("bob", mass=0.02, com=(0, 0, -0.3))
    b.add_joint("slide", "prismatic", parent="world", child="block", axis=(1, 0, 0), stiffness=1e7)
    b.add_joint("hinge", "revolute", parent="block", child="bob", axis=(0, 1, 0))
    dyn = mb.dynamics(b.build(), engine)
    for angle, side in ((0.0, 1), (np.pi, -1)):
        # (1e7 - 50.02 ω²) (± m g l - m l² ω²) = (m l ω²)².
        hung = side * 0.02 * 9.81 * 0.3
        a, b, c = 0.02 * 0.3**2 * 50, -1e7 * 0.02 * 0.3**2 - 50.02 * hung, 1e7 * hung
        with mpmath.workdps(40):
            squares = np.array(mpmath.polyroots([a, b, c], maxsteps=500, extraprec=400), dtype=float)
        rest = mb.equilibrium(dyn, [0.0, angle])
        assert rest.stable is (side > 0)
        assert rest.frequencies == pytest.approx(np.sqrt(squares[squares > 0]), rel=1e-9)
        assert rest.eigenvalues.real.max() == pytest.approx(np.sqrt(max(0.0, -squares.min())), rel=1e-9)
        rates = mb.simulate.stiffness(dyn, [0.0, angle], [0.0, 0.0])
        slow = np.sort(np.abs(rates.eigenvalues))[:2]
        assert slow == pytest.approx(np.sqrt(np.abs(squares).min()) * np.ones(2), rel=1e-6)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_dry_friction_is_no_damping_of_small_motions(engine):
    b = mb.ModelBuilder("hinge")
    b.add_body("bob", mass=1.0, com=(0, 0, -1.0))
    b.add_joint("hinge", "revolute", parent="world", child="bob", axis=(0, 1, 0), friction=0.5, damping=0.1)
    rest = mb.equilibrium(mb.dynamics(b.build(), engine), [0.2])
    assert near(rest.eigenvalues, np.roots([1, 0.1, 9.81]), rel=1e-10)
    (note,) = rest.notes
    assert "dry friction" in note
    assert note in str(rest)
    assert not mb.equilibrium(mb.dynamics(b.build().without("friction"), engine), [0.2]).notes


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_rounding_of_a_spatial_chain_is_no_circulatory_force(engine):
    b, parent = mb.ModelBuilder("chain"), "world"
    # The first one turns about the vertical, where gravity has no moment: its row of the stiffness is rounding.
    for k, axis in enumerate(np.eye(3)[[2, 1, 2, 0, 1, 2]]):
        b.add_body(f"link{k}", mass=1.0, com=(0.1, 0.05, -0.3), inertia=(0.02, 0.03, 0.04))
        more = {"translation": (0, 0, -0.5), "stiffness": 30.0}
        b.add_joint(f"hinge{k}", "revolute", parent=parent, child=f"link{k}", axis=axis, **more)
        parent = f"link{k}"
    dyn = mb.dynamics(b.build(), engine)
    rest = mb.equilibrium(dyn, 0.1 * np.ones(6))
    assert rest.stable is True
    assert len(rest.frequencies) == 6


def beam(segments):
    b = mb.ModelBuilder("beam", gravity=(0, 0, 0))
    b.add_beam("beam", parent="world", length=1.0, stiffness=100.0, density=1.0, modes=1)
    return b.build().segmented(segments)


def test_a_beam_of_many_segments_has_its_first_frequency():
    exact = 10 * np.array([1.875104068711961, 4.694091132974175, 7.854757438237613]) ** 2
    model = beam(80)
    rest = mb.equilibrium(mb.dynamics(model, "pinocchio"), np.zeros(80))
    assert rest.stable is True
    assert len(rest.frequencies) == 80
    assert rest.frequencies[:3] == pytest.approx(exact, rel=3e-4)
    # One spring constant: the masses' largest eigenvalues, which are good to rounding, are the slowest motions.
    model = beam(160)
    M, springs = mb.dynamics(model, "pinocchio").mass_matrix(np.zeros(160)), [100.0 * 160] * 160
    found = small_motion(M, 0 * M, np.diag(springs))
    assert found.stable is True
    slowest = np.sqrt(springs[0] / np.linalg.eigvalsh(M)[::-1])
    assert found.frequencies[:20] == pytest.approx(slowest[:20], rel=1e-11)
    assert found.frequencies == pytest.approx(slowest, rel=1e-6)


@pytest.mark.parametrize(("soft", "stable"), [(1.0, True), (-1.0, False)])
def test_steady_motions_with_a_stiff_and_a_soft_direction(soft, stable):
    r, phi, vr, vphi = sp.symbols("r phi v_r v_phi")
    system = Lagrangian(
        (vr**2 + r**2 * vphi**2 + w**2) / 2, 1e8 * (r - 1) ** 2 / 2 + soft * z**2 / 2, [r, phi, z], [vr, vphi, w]
    )
    steady = mb.steady_motion(system, [1.0, 0.0, 0.0], momenta={"p_phi": 2.0})
    assert steady.stable is stable
    radius = steady.equilibrium.q[0]
    fast = np.sqrt(1e8 + 3 * 4 / radius**4)
    assert steady.frequencies == pytest.approx([1.0, fast] if stable else [fast], rel=1e-12)
    assert steady.equilibrium.eigenvalues.real.max() == pytest.approx(0.0 if stable else 1.0, abs=1e-12)


def test_a_soft_direction_comes_to_rest_beside_a_stiff_one():
    system = Lagrangian((u**2 + v**2) / 2, 1e12 * x**2 / 2 + y**4 / 4 - y, [x, y], [u, v])
    assert mb.equilibrium(system, [0.0, 0.9]).q[1] == pytest.approx(1.0, abs=1e-13)


@pytest.mark.parametrize(
    ("matrix", "answer"),
    [
        ([[1e12, 0], [0, 1e-12]], 1),
        ([[1e12, 0], [0, -1e-12]], -1),
        ([[1e12, 1.0], [1.0, 0.9e-12]], -1),
        ([[1e12, 1.0], [1.0, 1.1e-12]], 1),
        ([[1.0, 1.0], [1.0, 1.0]], 0),
        ([[1.0, 0.0], [0.0, 0.0]], 0),
        ([[1e12, 1e-3], [1e-3, 0.0]], -1),
        ([[0.0, 1e-9], [1e-9, 0.0]], -1),
    ],
)
def test_definiteness_has_no_unit(matrix, answer):
    A = np.array(matrix)
    assert definite(A, EPS * np.abs(A)) == answer


def test_what_rounding_leaves_is_not_decided():
    M = np.eye(2)
    bars = np.array([[1.0, -1.0], [-1.0, 1.0]])
    free = small_motion(M, 0 * M, bars * 1e9 / 3)
    assert free.stable is None
    assert free.frequencies == pytest.approx([np.sqrt(2e9 / 3)], rel=1e-14)
    # A soft spring in the sum of stiff ones, beyond the last digit.
    assert small_motion(M, 0 * M, bars * 1e17 + np.diag([1.0, 0.0])).stable is None
    assert small_motion(M, 0 * M, np.diag([1e9, 1e-3]), (0.0, 0.0, 1e-2)).stable is None
    # A coordinate without mass has no motion of its own.
    massless = small_motion(np.diag([1.0, 0.0]), np.diag([0.0, 1e3]), np.diag([4.0, 1.0]))
    assert massless.stable is True
    assert near(massless.eigenvalues, [2j, -2j, -1e-3])


# Random systems against 80 digits


def random_system(rng):
    """Return M, D and K over twelve decades: chains, bars and dense ones; damped, turning, circulatory, falling."""
    n = int(rng.integers(1, 4))

    def sizes(share=1.0):
        return np.diag(10.0 ** rng.uniform(-6, 6, n) * (rng.random(n) < share))

    def form(size):
        way = (np.eye(n), np.eye(n) - np.eye(n, k=-1), rng.standard_normal((n, n)))[rng.integers(3)]
        whole = way.T @ size @ way
        return (whole + whole.T) / 2

    def skew(*around):
        G = rng.standard_normal((n, n)) * np.sqrt(np.outer(*[np.abs(around[0].diagonal())] * 2))
        return (G - G.T) * 10.0 ** rng.uniform(-3, 1)

    M, K, D = sizes(), form(sizes()), np.zeros((n, n))
    if rng.random() < 0.4:
        arm = np.tril(rng.uniform(0.3, 3, (n, n)))
        M = arm.T @ M @ arm
        M = (M + M.T) / 2
    kinds = rng.random(5) < (0.5, 0.3, 0.3, 0.2, 0.2)
    D = D + (form(sizes(0.8)) if kinds[0] else 0.0) + (skew(M) if kinds[1] else 0.0)
    D = D - (1e-3 * sizes(0.4) if kinds[3] else 0.0)
    K = K + (skew(K) if kinds[2] else 0.0) - (sizes(0.4) if kinds[4] else 0.0)
    return M, D, K


def exact_eigenvalues(M, D, K):
    n = len(M)
    with mpmath.workdps(80):
        mass = mpmath.matrix(M.tolist()) ** -1
        A = mpmath.zeros(2 * n)
        A[:n, n:] = mpmath.eye(n)
        A[n:, :n], A[n:, n:] = -mass * mpmath.matrix(K.tolist()), -mass * mpmath.matrix(D.tolist())
        return mpmath.eig(A, left=False, right=False)


@pytest.mark.thorough(every=9)
@pytest.mark.parametrize("batch", range(10))
def test_random_systems_over_twelve_decades(batch):
    rng, decided, digits = np.random.default_rng(batch), [], []
    for _ in range(50):
        M, D, K = random_system(rng)
        found, exact = small_motion(M, D, K), exact_eigenvalues(M, D, K)
        assert len(found.eigenvalues) == 2 * len(M)
        values, error = eigenvalues((M, D, K), [EPS * np.abs(A) for A in (M, D, K)])
        left = [complex(e) for e in exact]
        for k in np.argsort(-np.abs(values)):
            nearest = min(left, key=lambda e, k=k: abs(e - values[k]))
            left.remove(nearest)
            assert abs(nearest - values[k]) <= error[k]
            digits.append(abs(nearest - values[k]) / abs(nearest))
            # Stable is said against no eigenvalue beyond rounding, unstable of one that grows.
            assert found.stable is not True or nearest.real <= error[k]
        growth = max(float(e.real / abs(e)) for e in exact)
        assert found.stable is not False or growth > 1e-40
        # Undamped motions do not decay, and circulatory ones that only just stay small are not decided.
        decided += [found.stable is not None] if abs(growth) > 1e-40 else []
    assert np.mean(decided) > 0.9
    assert np.quantile(digits, 0.5) < 1e-12
    assert np.quantile(digits, 0.95) < 1e-4


def test_each_frequency_of_undamped_systems_is_one_of_the_exact_ones():
    """Units over twelve decades in M and K: of two near motions neither is given for the other."""
    rng = np.random.default_rng(0)
    for case in range(60):
        n = rng.integers(2, 7)
        inertial = 10.0 ** rng.uniform(-6, 6, n) if case % 2 else np.ones(n)
        A = rng.standard_normal((n, n))
        M = np.outer(inertial, inertial) * (A @ A.T + 0.1 * np.eye(n))
        B, elastic = rng.standard_normal((n, n)), 10.0 ** rng.uniform(-6, 6, n)
        K = np.outer(elastic, elastic) * (B @ B.T)
        M, K = (M + M.T) / 2, (K + K.T) / 2
        with mpmath.workdps(60):
            inverse = mpmath.cholesky(mpmath.matrix(M.tolist())) ** -1
            squares = mpmath.eigsy(inverse * mpmath.matrix(K.tolist()) * inverse.T, eigvals_only=True)
            exact = [float(mpmath.sqrt(x)) for x in squares]
        found = small_motion(M, 0 * M, K).frequencies.tolist()
        values, error = eigenvalues((M, 0 * M, K), [EPS * np.abs(M), 0 * M, EPS * np.abs(K)])
        # What is within its bound of zero is no frequency.
        assert len(found) >= n - 1
        for frequency in found:
            nearest = min(exact, key=lambda x, f=frequency: abs(x / f - 1))
            exact.remove(nearest)
            assert abs(nearest - frequency) <= error[np.argmin(np.abs(values - 1j * frequency))]
