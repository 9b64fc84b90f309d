"""Published problems with loops: Andrews' squeezer to its printed digits, and A03 to A05 of the IFToMM library."""

from __future__ import annotations

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from validation import iftomm, squeezer
from validation.closed_forms import published

TOLD = published()["andrews_squeezing_mechanism"]
START = np.array([float(x) for x in TOLD["q0"]])


@pytest.fixture(scope="module")
def truth():
    turn, rate = squeezer.truth()
    return turn.astype(float), rate.astype(float)


def off(a, b) -> float:
    """Return the largest difference of angles, up to whole turns."""
    return float(np.abs(np.angle(np.exp(1j * (a - b)))).max())


@pytest.mark.thorough
def test_one_coordinate_reaches_the_printed_solution(truth) -> None:
    turn, rate = truth
    end = TOLD["reference_t_0p03"]
    # Printed with 16 digits of a run at a tolerance of 1e-14: ten of them are right, of 16 rad and 1400 rad/s.
    assert off(iftomm.turns(np.array(end["q"])), turn) < 1.2e-9
    assert np.abs(iftomm.turns(np.array(end["v"])) - rate).max() < 6e-7
    # At the start the bodies have the printed angles.
    axes, *_ = squeezer.shape(np.longdouble(TOLD["q0"][0]))
    assert off(iftomm.turns(START), np.array([float(np.arctan2(u[1].f, u[0].f)) for u in axes])) < 1e-15


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("method", "setting", "close"),
    [
        ("rk853", {"rtol": 1e-12}, 1e-10),
        ("taylor", {"rtol": 1e-14}, 1e-12),
        ("rodas5", {"rtol": 1e-8}, 1e-6),
        ("dop853", {"rtol": 1e-10}, 1e-8),
        ("rk4", {"dt": 1e-5}, 1e-6),
        ("gauss4", {"dt": 5e-5}, 1e-4),
    ],
)
def test_the_squeezer_reaches_it(truth, method, setting, close) -> None:
    if method == "taylor":
        pytest.importorskip("heyoka")
    dyn = mb.dynamics(catalog.andrews_squeezer(), "lagrangian")
    torque = np.array([TOLD["drive_torque_on_beta"], *[0.0] * 6])
    run = mb.simulate(dyn, np.zeros(7), np.zeros(7), 0.03, method, torque=torque, save=[0.0, 0.03], **setting)
    turn, rate = truth
    assert off(iftomm.turns(START + run.q[-1]), turn) < close
    assert np.abs(iftomm.turns(run.v[-1]) - rate).max() < close * np.abs(rate).max()


@pytest.mark.thorough
def test_the_stiff_governor_is_that_of_two_coordinates() -> None:
    t = np.array([0.5, 1.0])
    s, angle, known = iftomm.governor_truth(t)
    assert known < 1e-9
    v = [2 * np.pi, 0.0, 0.0, 0.0]
    run = mb.simulate(mb.dynamics(iftomm.governor(), "lagrangian"), np.zeros(4), v, 1.0, "rodas5", rtol=1e-9, save=t)
    assert 0.5 + run.q[:, 1] == pytest.approx(s, abs=1e-7)
    # Both arms, up from 30° below the level.
    assert run.q[:, 2:] == pytest.approx(np.pi / 6 - np.array([angle, angle]).T, abs=1e-7)
