"""References: exact motions to thirty digits, what two engines say, and where it ends."""

# Torques, and what stands in for others, have the signature they are called with.
# ruff: noqa: ARG001, ARG005

from __future__ import annotations

import sys
from typing import Any

import mpmath as mp
import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.engines import dynamics
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.simulate import simulate
from mbkit.studies import reference_motions as module
from mbkit.studies.reference_motions import (
    checked_motion,
    gap,
    reference,
    taylor_pair,
    two_engines,
)
from mbkit.studies.study_runs import Deadline, TooLongError
from tests.scenes import mounted

hy = pytest.importorskip("heyoka")
# No test reads what an earlier run left, or leaves anything.
hy.llvm_state.set_diskcache_enabled(False)
pytestmark = pytest.mark.skipif(not hasattr(hy, "real128"), reason="heyoka was built without quadruple numbers")

EPS = float(np.finfo(float).eps)
TIMES = np.linspace(0.0, 3.0, 7)


def summed(high: Any, low: Any) -> Any:
    """Return high + low with 40 digits."""
    return np.frompyfunc(lambda a, b: mp.mpf(float(a)) + mp.mpf(float(b)), 2, 1)(high, low)


@pytest.fixture(autouse=True)
def quick_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops for all but the smallest systems: what is run once is not worth more."""
    monkeypatch.setattr("mbkit.codegen.taylor._MAX_UNROLLED_OPERATIONS", 2000)


def ample() -> Deadline:
    return Deadline(100.0, lambda done: None)


# Exact motions


def test_a_pendulum_to_thirty_digits() -> None:
    truth = reference(catalog.pendulum(), [2.0], [0.0], 3.0, TIMES)
    with mp.workdps(40):
        k, rate = mp.sin(mp.mpf(1)), mp.sqrt(mp.mpf(9.81))
        K = mp.ellipk(k**2)
        exact = [2 * mp.asin(k * mp.ellipfun("sn", K - rate * mp.mpf(float(t)), m=k**2)) for t in TIMES]
        error = [abs(a - b) for a, b in zip(summed(truth.q, truth.q_low)[:, 0], exact, strict=True)]
        assert max(error) < mp.mpf("1e-31")
        # What it says of itself holds, and is not far off.
        assert max(error) < truth.scale[0] * 10**-truth.digits < mp.mpf("1e-30")
    assert truth.horizon == 3.0
    assert np.array_equal(truth.t, TIMES)
    # The doubles are the nearest there are.
    assert (truth.floor <= EPS * 2).all()
    assert "quadruple numbers" in truth.how
    assert "from those of pinocchio" in truth.how


def test_a_tumbling_box_to_thirty_digits() -> None:
    """Euler's equations in Jacobi's functions (Landau, Lifshitz, Mechanics, §37), and what the rotation conserves."""
    model = catalog.free_body()
    w = np.array([2.0, 0.0, 0.5])
    truth = reference(model, model.neutral(), [0, 0, 0, *w], 3.0, TIMES)
    with mp.workdps(40):
        A, B, C = (mp.mpf(float(x)) for x in np.diag(model.bodies[0].inertia))
        a, b = mp.mpf(2), mp.mpf("0.5")
        rate = mp.sqrt((A - C) * (A - B) * a**2 / (B * C))
        side = (C - A) * a * b / (B * rate)
        m = (C - B) * side * b / (A * a * rate)
        found = summed(truth.v, truth.v_low)[:, 3:]
        q = summed(truth.q, truth.q_low)[:, 3:]
        for i, t in enumerate(TIMES):
            sn, cn, dn = (mp.ellipfun(f, rate * mp.mpf(float(t)), m=m) for f in ("sn", "cn", "dn"))
            for x, y in zip(found[i], (a * dn, side * sn, b * cn), strict=True):
                assert abs(x - y) < mp.mpf("1e-30")
            # The angular momentum rests in the world, and the quaternion has norm 1.
            x, y, z, s = q[i]
            L = [A * found[i][0], B * found[i][1], C * found[i][2]]
            inner = [y * L[2] - z * L[1] + s * L[0], z * L[0] - x * L[2] + s * L[1], x * L[1] - y * L[0] + s * L[2]]
            u = [y * inner[2] - z * inner[1], z * inner[0] - x * inner[2], x * inner[1] - y * inner[0]]
            for now, turned, before in zip(L, u, (A * a, 0, C * b), strict=True):
                assert abs(now + 2 * turned - before) < mp.mpf("1e-30")
            assert abs(x * x + y * y + z * z + s * s - 1) < mp.mpf("1e-32")


# What the pairs say of themselves


@pytest.mark.skipif(np.finfo(np.longdouble).nmant != 63, reason="no 80-bit numbers")
def test_each_pair_knows_how_good_it_is() -> None:
    """Against quadruple precision, no pair is wrong by more than the safety that is put on top."""
    model = catalog.double_pendulum()
    q, v = [2.0, 1.0], [0.0, 0.5]
    motion = checked_motion(model, q, v, 3.0, TIMES)
    best = taylor_pair(motion, ample(), 113)
    for known in (taylor_pair(motion, ample(), 64), two_engines(motion, ample())):
        error = np.abs((known.q[0] - best.q[0]) + (known.q[1] - best.q[1])).max(axis=1)
        rounding = 2 * EPS * (known.how.count(" on ") == 2)
        allowed = module._FLOOR_PER_GAP * np.maximum.accumulate(known.apart[0]) + rounding
        assert (error <= allowed + 1e-19).all()
    assert known.how == "taylor on lagrangian and dop853 on pinocchio"


def test_gap_measures_angles() -> None:
    model = catalog.free_body()
    rng = np.random.default_rng(0)
    q, _ = model.random_state(rng, 5)
    dq = 1e-5 * rng.standard_normal((5, 6))
    moved = np.array([model.integrate(a, b) for a, b in zip(q, dq, strict=True)])
    angle = np.linalg.norm(dq[:, 3:], axis=1)
    position = np.abs(moved[:, :3] - q[:, :3]).max(axis=1)
    assert gap(model, moved, q) == pytest.approx(np.maximum(angle, position), rel=1e-6)
    # A quaternion and its negative are one rotation.
    assert gap(model, np.concatenate([q[:, :3], -q[:, 3:]], axis=1), q).max() == 0.0


# Where it ends


@pytest.mark.thorough
def test_chaos_cuts_the_horizon(monkeypatch: pytest.MonkeyPatch) -> None:
    """A double pendulum that tumbles forgets a digit every second or so: in double it ends first."""
    model = catalog.double_pendulum()
    start = [3.0, 3.0], [0.0, 0.0]
    save = np.linspace(0, 10.0, 21)
    with monkeypatch.context() as patch:
        patch.setattr(module, "taylor_pair", _refused)
        short = reference(model, *start, 10.0, save)
    assert 1.0 < short.horizon < 9.5
    assert short.t[-1] == short.horizon
    assert len(short.q) == len(short.v) == len(short.floor) == len(short.t) < len(save)
    assert short.digits > 11
    assert f"until t = {short.horizon:.6g} s, where the reference ends: beyond, they part" in short.how
    assert (np.diff(short.floor) > -4 * EPS).all()
    long = reference(model, *start, 10.0, save)
    assert long.horizon == 10.0
    # Up to its horizon the short one is as good as it says.
    n = len(short.t)
    assert (gap(model, short.q, long.q[:n]) <= short.floor).all()


def _refused(*_: Any) -> Any:
    raise UnsupportedError("taylor: not here")


def test_time_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known when the time is up is returned, and it says so."""

    def look(self: Deadline, done: float) -> None:
        if done > 0.4:
            raise TooLongError("late")

    monkeypatch.setattr(Deadline, "look", look)
    found = reference(catalog.pendulum(), [2.0], [0.0], 3.0, np.linspace(0, 3, 301))
    assert 1.15 < found.horizon < 1.5
    assert "ends: the seconds allowed for it were used up at t = 1." in found.how


def test_a_way_that_is_too_slow_leaves_time_for_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    deadline = Deadline(100.0, lambda done: None, lambda: now[0])
    now[0] = 1.0
    assert deadline.left == 99.0
    assert deadline.part(200.0).left == 99.0
    part = deadline.part(10.0)
    assert part.left == 10.0
    with deadline.paused():
        now[0] += 5.0
    assert (part.left, deadline.left) == (10.0, 99.0)
    now[0] += 2.0
    assert (part.left, deadline.left) == (8.0, 97.0)
    now[0] += 9.0
    with pytest.raises(TooLongError):
        part.look(0.5)
    monkeypatch.setattr(module, "_quadruple_seconds", lambda motion, steps: 1e9)
    found = reference(catalog.pendulum(), [2.0], [0.0], 1.0, [0, 1.0])
    assert "quadruple" not in found.how
    assert found.digits > 11


def test_a_motion_that_ends_in_a_singularity_is_known_up_to_it() -> None:
    b = mounted("bead", "bead", "slide", "prismatic", gravity=(0, 0, 0), mass=1.0, axis=(1, 0, 0))
    b.add_spring("rubber", body_a="world", body_b="bead", stiffness=1.0, rest_length=0.5)
    found = reference(b.build(), [1.0], [-10.0], 1.0, np.linspace(0, 1.0, 101))
    assert found.horizon < 0.11
    assert "ends: " in found.how


# Torques, and what is at hand


def test_held_torques() -> None:
    model, save = catalog.cart_pole(), np.linspace(0, 1.0, 5)
    torque = np.array([[1.0, 0.0], [-2.0, 0.1], [0.0, 0.0], [3.0, -0.1]])
    truth = reference(model, [0.0, 1.0], [0.0, 0.0], 1.0, save, torque)
    run = simulate(dynamics(model), [0.0, 1.0], [0.0, 0.0], 1.0, "dop853", rtol=1e-13, save=save, torque=torque)
    assert truth.horizon == 1.0
    assert truth.q == pytest.approx(run.q, abs=1e-11)
    constant = reference(model, [0.0, 1.0], [0.0, 0.0], 1.0, [0.5, 1.0], torque[0])
    assert constant.t.tolist() == [0.0, 0.5, 1.0]


def test_a_torque_function_takes_two_engines() -> None:
    model = catalog.pendulum()
    truth = reference(model, [1.0], [0.0], 2.0, [0, 1, 2.0], lambda t, q, v: -0.3 * v + np.sin(5 * t))
    run = simulate(
        dynamics(model), [1.0], [0.0], 2.0, "dop853", rtol=1e-13, torque=lambda t, q, v: -0.3 * v + np.sin(5 * t)
    )
    assert truth.horizon == 2.0
    assert truth.digits > 11
    assert truth.q[-1] == pytest.approx(run.q[-1], abs=1e-11)
    assert "dop853 on pinocchio" in truth.how
    assert "taylor" not in truth.how


def test_without_heyoka_two_engines_do_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "heyoka", None)
    truth = reference(catalog.pendulum(), [1.0], [0.0], 1.0, [0, 0.5, 1.0])
    assert truth.horizon == 1.0
    assert "on lagrangian and dop853 on pinocchio" in truth.how
    assert truth.digits > 11


def test_no_independent_engine_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "taylor_pair", _refused)
    monkeypatch.setattr(module, "two_engines", _refused)
    with pytest.raises(UnsupportedError, match="reference: taylor: not here"):
        reference(catalog.pendulum(), [1.0], [0.0], 1.0, [0, 1.0])


def test_parameters_have_their_values() -> None:
    parametrised = catalog.pendulum(length=mb.Parameter("l", 0.5))
    one = reference(parametrised, [1.0], [0.0], 1.0, [0, 1.0])
    other = reference(catalog.pendulum(length=0.5), [1.0], [0.0], 1.0, [0, 1.0])
    assert one.q == pytest.approx(other.q, abs=EPS)
    with pytest.raises(InputError, match="no value for parameter 'l'"):
        reference(catalog.pendulum(length=mb.Parameter("l")), [1.0], [0.0], 1.0, [0, 1.0])


# The object, and bad input


@pytest.mark.parametrize("duration", [0.0, 1.0])
def test_what_rests_is_known(duration: float) -> None:
    truth = reference(catalog.pendulum(), [0.0], [0.0], duration, [0.0, duration] if duration else [0.0])
    assert truth.horizon == duration
    assert (truth.q == 0).all()


def test_an_interruption_gets_through(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(self: Deadline, done: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Deadline, "look", interrupted)
    with pytest.raises(KeyboardInterrupt):
        reference(catalog.pendulum(), [1.0], [0.0], 1.0, [0, 1.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "pendulum"}, "model: expected a Model, got str"),
        ({"q0": [[1.0], [2.0]]}, "q0, v0: expected one state"),
        ({"v0": [np.nan]}, "v0: nan"),
        ({"duration": -1.0}, "duration: expected a number of at least 0"),
        ({"save": [0, 2.0]}, "save: expected times between 0 and 1"),
        ({"torque": [1.0, 2.0]}, "torque: expected shape"),
        ({"seconds": 0.0}, "seconds: expected a number above 0"),
        ({"progress": 3}, "progress: expected None, True or a callable"),
    ],
)
def test_bad_input_is_named(change: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"model": catalog.pendulum(), "q0": [1.0], "v0": [0.0], "duration": 1.0, "save": [0, 1.0]}
    with pytest.raises(InputError, match=message):
        reference(**(good | change))


def test_a_reference_without_a_witness_says_why(monkeypatch):
    """That an engine gives no accelerations is no reason to say that it does not hold the model."""

    def refuse(*_: object) -> None:
        raise NumericalError("M is singular here")

    monkeypatch.setattr(sys.modules[reference.__module__], "_accelerations", refuse)
    known = reference(mb.catalog.pendulum(), [1.0], [0.0], 0.1, [0.0, 0.1])
    assert "no other engine gives its accelerations" in known.how
    assert "M is singular here" in known.how
