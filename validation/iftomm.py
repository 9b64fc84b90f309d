"""Published problems with loops: Andrews' squeezer, and A01 to A05 of the IFToMM library of benchmark problems.

Run ``python -m validation.iftomm``; it writes ``validation/iftomm.json``. The truth is apart from mbkit: elliptic
functions for the pendulum and for rows of four-bars, which move as one pendulum (`validation.elliptic`); one coordinate
in numbers of 64 bits of mantissa for Andrews' squeezer (`validation.squeezer`); two coordinates and SciPy's Radau for
the governor. Bricard's mechanism has its energy. Reference motions of the library are files that are not at hand; the
times of another code are those of `published`.
"""

from __future__ import annotations

import json
import math
import warnings

import numpy as np

import mbkit as mb
from mbkit.errors import MbkitWarning, UnsupportedError
from validation import elliptic, squeezer
from validation.closed_forms import published
from validation.stamp import results, stamp

TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
TIMES = np.arange(1.0, 11.0)
#: N, engine and methods of A02.
#: Of Andrews' squeezer: s of the runs, and the methods with their settings; Pinocchio takes the first five.
SQUEEZED = 0.05
WAYS = [("rk853", {"rtol": x}) for x in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)]
WAYS += [("taylor", {"rtol": x}) for x in (1e-6, 1e-10, 1e-14)]
WAYS += [(m, {"rtol": x}) for m in ("rodas5", "dop853", "radau") for x in (1e-4, 1e-6, 1e-8)]
WAYS += [("rk4", {"dt": x}) for x in (4e-5, 2e-5, 1e-5, 5e-6)] + [("gauss4", {"dt": x}) for x in (1e-4, 5e-5)]
STIFF = ("rodas5", "radau", "auto")
ROWS = ((1, "lagrangian", ("rk853", "taylor", "rodas5")), (1, "pinocchio", ("rk853",)))
ROWS += ((4, "lagrangian", ("rk853", "taylor", "rodas5")), (4, "pinocchio", ("rk853",)), (40, "lagrangian", ("rk853",)))


def run(dyn, q, v, duration, method, *, repeats=2, **options):
    """Return the run that took the least time; the first one derives and compiles."""
    with warnings.catch_warnings():
        # Singular poses are told.
        warnings.simplefilter("ignore", MbkitWarning)
        return min(
            (mb.simulate(dyn, q, v, duration, method, doubt=False, **options) for _ in range(repeats + 1)),
            key=lambda r: r.stats.seconds,
        )


def figures(run, **more):
    return {
        **more,
        "ended": run.stats.ended,
        "steps": run.stats.steps,
        "seconds": run.stats.seconds,
        "drift": float(np.ptp(run.energy())) if len(run.t) else None,
    }


def pendulum():
    """A01: the error of x and y at 10 s."""
    dyn = mb.dynamics(mb.catalog.pendulum(), "lagrangian")
    theta, _ = elliptic.pendulum(TIMES[-1:], -math.pi / 2)
    out = []
    for rtol in TOLERANCES:
        end = run(dyn, [-math.pi / 2], [0.0], TIMES[-1], "rk853", rtol=rtol, save=[0.0, TIMES[-1]])
        x, exact = end.q[-1, 0], theta[0, 0]
        error = math.hypot(math.sin(x) - math.sin(exact), math.cos(x) - math.cos(exact))
        out.append(figures(end, rtol=rtol, error=error))
    return out


def angle_of_rows(n, t):
    """Return the turn of the rods of n four-bars from upright after an angular velocity of -1 rad/s."""
    g = ((n + 1) / 2 + n) * 9.81 / ((n + 1 + 3 * n) / 3)
    theta, _ = elliptic.pendulum(t, np.pi, 1.0, g=g)
    return np.pi - theta[:, 0]


def four_bars(n, engine, methods):
    """A02: the largest error of the angle at whole seconds, of a run that passes singular poses."""
    model = mb.catalog.four_bars(n=n)
    dyn = mb.dynamics(model, engine)
    q = np.zeros(model.nv)
    v = np.array([1.0 if name.startswith("phi") else -1.0 for name in model.coordinate_names])
    exact, out = angle_of_rows(n, TIMES), []
    for method in methods:
        for rtol in TOLERANCES:
            found = run(dyn, q, v, TIMES[-1], method, repeats=1 if n > 4 else 2, rtol=rtol, save=[0.0, *TIMES])
            error = float(np.abs(found.q[1:, 0] - exact[: len(found.q) - 1]).max())
            at_1s = float(abs(found.q[1, 0] - exact[0]))
            out.append(figures(found, n=n, engine=engine, method=method, rtol=rtol, error=error, error_1s=at_1s))
            print("A02", out[-1], flush=True)
    return out


def turns(x):
    """Return the turn, or its rate, of each body of the squeezer from its seven joints'."""
    b, th, ga, ph, de, om, ep = x
    return np.array([b, b + th, ga, ph + de, de, om + ep, ep])


def andrews():
    """The problem of the IVP test set: errors of all turns and rates, from the truth and from what was printed."""
    told = published()["andrews_squeezing_mechanism"]
    start, end = np.array([float(x) for x in told["q0"]]), told["reference_t_0p03"]
    turn, rate = (x.astype(float) for x in squeezer.truth(squeezer.STEPS))
    finer, _ = squeezer.truth(2 * squeezer.STEPS)
    model = mb.catalog.andrews_squeezer()
    torque = np.array([told["drive_torque_on_beta"], *[0.0] * 6])
    out = []
    for engine in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, engine)
        for method, setting in WAYS if engine == "lagrangian" else WAYS[:5]:
            try:
                found = run(dyn, np.zeros(7), np.zeros(7), 0.03, method, torque=torque, save=[0.03], **setting)
            except UnsupportedError:
                continue
            if not len(found.t):
                continue
            q, v = start + found.q[-1], found.v[-1]
            off = np.abs(np.angle(np.exp(1j * (turns(q) - turn)))).max()
            row = {
                "engine": engine,
                "method": method,
                "setting": setting,
                "error": float(off),
                "error_rate": float(np.abs(turns(v) - rate).max() / np.abs(rate).max()),
                "from_printed_q": float(np.abs(q - end["q"]).max()),
                "from_printed_v": float(np.abs(v - np.array(end["v"])).max()),
            }
            out.append(figures(found, **row))
            print(out[-1], flush=True)
    printed = np.abs(np.angle(np.exp(1j * (turns(np.array(end["q"])) - turn)))).max()
    printed_rate = np.abs(turns(np.array(end["v"])) - rate).max()
    known = float(np.abs(finer - turn).max())
    return {"truth_known_to": known, "printed_q": float(printed), "printed_v": float(printed_rate), "rows": out}


def squeezer_from_iftomm():
    """A03: it starts at β = -0.0620; the balance of energy and work after 0.05 s, as the library asks."""
    told = published()["andrews_squeezing_mechanism"]
    from scipy.optimize import fsolve

    dyn = mb.dynamics(mb.catalog.andrews_squeezer(), "lagrangian")
    beta = -0.0620 - float(told["q0"][0])
    rest = fsolve(lambda x: dyn.constraint_residual(np.array([beta, *x])), np.zeros(6), xtol=1e-14)
    q, torque, out = np.array([beta, *rest]), np.array([told["drive_torque_on_beta"], *[0.0] * 6]), []
    for rtol in TOLERANCES:
        found = run(
            dyn, q, np.zeros(7), SQUEEZED, "rk853", rtol=rtol, torque=torque, save=np.linspace(0, SQUEEZED, 101)
        )
        energy = found.energy()
        balance = energy - energy[0] - torque[0] * (found.q[:, 0] - q[0])
        out.append(figures(found, rtol=rtol, balance=float(np.abs(balance).max())))
    return out


def bricard():
    """A04: the drift of the energy, and how far the runs of two tolerances and two engines are apart."""
    model, out = mb.catalog.bricard(), []
    ends = {}
    for engine in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, engine)
        for rtol in TOLERANCES:
            found = run(dyn, np.zeros(6), np.zeros(6), TIMES[-1], "rk853", rtol=rtol, save=[0.0, *TIMES])
            ends[engine, rtol] = found.q
            out.append(figures(found, engine=engine, rtol=rtol))
    best = ends["lagrangian", TOLERANCES[-1]]
    for row in out:
        q = ends[row["engine"], row["rtol"]]
        row["from_tightest"] = float(np.abs(q - best[: len(q)]).max())
    return out


# A05: stiff springs in place of the links

_GOVERNOR = published()["iftomm_A05_stiff_flyball_governor"]
_ARM, _MASS, _BALL, _SLIDER, _OUT = 1.0, 0.3, 5.0, 3.0, 0.05
_COS, _SIN = math.cos(math.pi / 6), 0.5


def governor():
    """Return A05 as mbkit's description: shaft, two arms with balls, slider, and two springs with dampers."""
    b = mb.ModelBuilder("stiff_governor", gravity=(0, 0, -9.81))
    across, along = _MASS * (_ARM**2 + 1e-4) / 12, _MASS * 1e-4 / 6
    b.add_body("shaft", mass=_MASS, com=(0, 0, 0.5), inertia=(across, across, along))
    b.add_joint("turn", "continuous", parent="world", child="shaft", axis=(0, 0, 1))
    b.add_body("slider", mass=_SLIDER, inertia=[_SLIDER * 0.01 / 6] * 3)
    b.add_joint("s", "prismatic", parent="shaft", child="slider", axis=(0, 0, 1), translation=(0, 0, 0.5))
    for k, side in ((1, 1.0), (2, -1.0)):
        # The arm's own axes: x from the hinge to the ball.
        out = np.array([side * _COS, 0.0, -_SIN])
        turn = np.array([out, [0.0, 1.0, 0.0], np.cross(out, [0.0, 1.0, 0.0])]).T
        mass = _MASS + _BALL
        reduced = _MASS * _BALL / mass * (_ARM / 2) ** 2
        own = turn @ np.diag([along, across + reduced, across + reduced]) @ turn.T
        lever = (_MASS * _ARM / 2 + _BALL * _ARM) / mass
        b.add_body(f"arm{k}", mass=mass, com=tuple(lever * out), inertia=own.tolist())
        b.add_joint(
            f"alpha{k}",
            "continuous",
            parent="shaft",
            child=f"arm{k}",
            axis=(0, -side, 0),
            translation=(side * _OUT, 0, 1.0),
        )
        b.add_spring(
            f"rod{k}",
            body_a=f"arm{k}",
            point_a=tuple(_ARM / 2 * out),
            body_b="slider",
            point_b=(side * _OUT, 0, 0),
            stiffness=_GOVERNOR["K"],
            damping=_GOVERNOR["C"],
            rest_length=_GOVERNOR["l0"],
        )
    return b.build()


def governor_truth(times):
    """Return s and the arms' angle, by the two coordinates of the symmetric motion; the angular momentum stays."""
    from scipy.integrate import solve_ivp

    across, along = _MASS * (_ARM**2 + 1e-4) / 12, _MASS * 1e-4 / 6
    fixed = along + _SLIDER * 0.01 / 6
    pivot = across + _MASS * _ARM**2 / 4 + _BALL * _ARM**2

    def inertia(g):
        # Of both arms about the shaft, g below the level, and its slope.
        c, s = math.cos(g), math.sin(g)
        first = _MASS * (_OUT + c / 2) ** 2 + across * c * c + along * s * s + _BALL * (_OUT + c) ** 2
        slope = -_MASS * (_OUT + c / 2) * s - 2 * (across - along) * c * s - 2 * _BALL * (_OUT + c) * s
        return fixed + 2 * first, 2 * slope

    start = math.pi / 6
    momentum = inertia(start)[0] * _GOVERNOR["omega0"]

    def rates(_, y):
        s, g, ds, dg = y
        total, slope = inertia(g)
        # The spring from the arm's middle, c/2 further out and sin g / 2 below the hinge at 1 m, to the slider at s.
        x, z = math.cos(g) / 2, 1.0 - math.sin(g) / 2 - s
        length = math.hypot(x, z)
        dx, dz = -math.sin(g) / 2 * dg, -math.cos(g) / 2 * dg - ds
        force = _GOVERNOR["K"] * (length - _GOVERNOR["l0"]) + _GOVERNOR["C"] * (x * dx + z * dz) / length
        down = 9.81 * (_MASS / 2 + _BALL) * math.cos(g)
        turning = momentum**2 * slope / (4 * total**2)
        pull = -force * (x * -math.sin(g) / 2 + z * -math.cos(g) / 2) / length
        return [ds, dg, 2 * force * z / length / _SLIDER - 9.81, (down + turning + pull) / pivot]

    found = [
        solve_ivp(rates, (0, times[-1]), [0.5, start, 0, 0], "Radau", t_eval=times, rtol=rtol, atol=rtol).y
        for rtol in (1e-12, 1e-13)
    ]
    return found[1][0], found[1][1], float(np.abs(found[0][:2] - found[1][:2]).max())


def stiff_governor():
    """A05: the error of s over 10 s."""
    dyn = mb.dynamics(governor(), "lagrangian")
    s, _, known = governor_truth(TIMES)
    out = []
    for method in STIFF:
        for rtol in TOLERANCES[:3]:
            v = np.array([_GOVERNOR["omega0"], 0, 0, 0])
            found = run(dyn, np.zeros(4), v, TIMES[-1], method, rtol=rtol, save=[0.0, *TIMES])
            error = float(np.abs(0.5 + found.q[1:, 1] - s[: len(found.q) - 1]).max())
            out.append(figures(found, method=method, rtol=rtol, error=error))
    return {"truth_known_to": known, "rows": out}


#: See `validation.smoke`.
SMOKE = {
    "TOLERANCES": (1e-3,),
    "TIMES": np.array([0.02, 0.04]),
    "ROWS": ROWS[1:2],
    "SQUEEZED": 1e-3,
    "WAYS": [("rk853", {"rtol": 1e-3})],
    "STIFF": ("rodas5",),
    "squeezer.STEPS": 10,
}


def main():
    data = {**stamp(__file__)}
    for name, part in (
        ("pendulum", pendulum),
        ("andrews", andrews),
        ("squeezer", squeezer_from_iftomm),
        ("bricard", bricard),
        ("governor", stiff_governor),
        ("four_bars", lambda: [row for each in ROWS for row in four_bars(*each)]),
    ):
        data[name] = part()
        print(name, "done", flush=True)
        results("iftomm.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
