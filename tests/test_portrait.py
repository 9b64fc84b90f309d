"""Phase portraits: their curves are motions, their dots are states of rest, and what is refused."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.errors import InputError, UnsupportedError

systems, portrait = mb.lagrangian.systems, mb.lagrangian.portrait


def dots(fig):
    return [line.get_xdata() for line in fig.axes[0].lines]


def test_the_pendulum_has_its_separatrix():
    fig = portrait(systems.pendulum(), (-4, 10), (-8, 8), l=0.7)
    stable, unstable = dots(fig)
    assert stable == pytest.approx([0, 2 * np.pi], abs=1e-3)
    assert unstable == pytest.approx([-np.pi, np.pi, 3 * np.pi], abs=1e-3)
    # On it v² = 2 g/l (1 + cos θ).
    separatrix = fig.axes[0].collections[-1].get_paths()[0].vertices
    theta, v = separatrix.T
    assert np.abs(v**2 - 2 * 9.81 / 0.7 * (1 + np.cos(theta))).max() < 0.1
    assert fig.axes[0].get_xlabel() == "θ"


def test_a_hoop_that_turns_fast_has_three_states_of_rest():
    stable, unstable = dots(portrait(systems.bead_on_hoop(), (-2, 2), (-5, 5), Omega=4.0))
    assert stable == pytest.approx([-np.arccos(9.81 / 16), np.arccos(9.81 / 16)], abs=1e-3)
    assert unstable == pytest.approx([0.0], abs=1e-3)


def test_a_reduced_system_and_one_with_friction():
    orbit = systems.kepler().routhian()
    stable, unstable = dots(portrait(orbit, (0.3, 4), (-1, 1), p_phi=1.0))
    assert stable == pytest.approx([1.0], abs=1e-3)
    assert not len(unstable)
    fig, ax = plt.subplots()
    assert portrait(systems.falling_body(), (0, 1), (-10, 1), ax) is fig
    plt.close(fig)


@pytest.mark.filterwarnings("error")
def test_a_free_body_has_lines_without_a_state_of_rest():
    q, v, m = sp.symbols("q qdot m")
    fig = portrait(mb.lagrangian.Lagrangian(m * v**2 / 2, 0, [q], parameters={m: 1.0}), (-1, 1), (-1, 1))
    assert [len(x) for x in dots(fig)] == [0, 0]


def test_what_is_refused():
    with pytest.raises(UnsupportedError, match="theta1, theta2"):
        portrait(systems.double_pendulum(), (0, 1), (0, 1))
    with pytest.raises(UnsupportedError, match="time"):
        portrait(systems.driven_pendulum(), (0, 1), (0, 1))
    with pytest.raises(InputError, match="system: expected"):
        portrait(mb.catalog.pendulum(), (0, 1), (0, 1))
    with pytest.raises(InputError, match="bounds that increase"):
        portrait(systems.pendulum(), (1, 1), (0, 1))
    with pytest.raises(InputError, match="no value for parameter"):
        portrait(systems.pendulum(length=None), (0, 1), (0, 1))
    with pytest.raises(InputError, match="ax: expected axes of Matplotlib, got 3"):
        portrait(systems.pendulum(), (-1, 1), (0, 1), ax=3)
    x, xdot = sp.symbols("x xdot")
    falling = mb.lagrangian.Lagrangian(xdot**2 / 2, sp.log(x), [x])
    with pytest.raises(InputError, match="no finite energy or acceleration from -2 to -1"):
        portrait(falling, (-2, -1), (0, 1))
    with pytest.raises(UnsupportedError, match="constraints"):
        portrait(mb.lagrangian.Lagrangian(sp.Symbol("xdot") ** 2, 0, [x], constraints=[x - 1]), (0, 1), (0, 1))
