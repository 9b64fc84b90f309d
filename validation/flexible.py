"""Flexible parts on paper: frequencies beside closed forms, and a beam beside chains of rigid segments in two engines.

Run ``python -m validation.flexible``; it writes ``validation/flexible.json``. The closed forms and the spin-up are
those of `validation.beams`, which uses nothing of mbkit. A chain has hinges with springs EI/h between segments of the
length h, the first half a segment from the root: its frequencies and motions come to those of the beam as h².
"""

from __future__ import annotations

import json

import numpy as np
import sympy as sp

import mbkit as mb
from validation import beams
from validation.stamp import results, stamp

x, s, t, L, RHO, EI = sp.symbols("x s t L rho EI")
#: Segments of the chains, and the engines that run them.
SEGMENTS = (5, 10, 20)
#: Modes of the turning beam and of the spin-up, and the parts of the full speed at which elements run.
MODES, COUNTS, PARTS = (2, 4, 6, 8), (1, 2, 3, 4, 5), (1.0, 0.1)
#: Modes of the spin-up beside Kane's equations.
TURNED = 3
#: Systems whose frequencies are measured; all of them.
CASES = None
ENGINES = ("pinocchio", "mujoco", "drake")
#: The hub's inertia kg m², its speed rad/s, the torque N m that grows and falls in so long, s, and steps of it.
HUB, TURN, TORQUE, PULSE = 50.0, 6.0, 2.0, 1.0
TIMES = np.linspace(0, PULSE, 21)


# Frequencies


def strings_and_beams() -> dict[str, float]:
    """Return the largest relative difference of the first three frequencies from the roots of closed forms."""
    w, psi = (sp.Function(n)(x, t) for n in ("w", "psi"))
    P, m, J, kGA, RI, Om = sp.symbols("P m J kGA rhoI Omega")
    Continuum, moving, bent = mb.lagrangian.Continuum, RHO * w.diff(t) ** 2 / 2, EI * w.diff(x, 2) ** 2 / 2
    body = {L: m * w.diff(t) ** 2 / 2}
    clamped, numbers = {0: [w, w.diff(x)]}, {RHO: 1.3, EI: 2.1, L: 1.7}
    tip = {m: 0.8, J: 0.3}
    shear = {kGA: 40.0, RI: 0.02}
    cases = {
        "string with a mass": lambda: (
            Continuum(moving, P * w.diff(x) ** 2 / 2, w, (0, L), fixed={0: [w]}, T_ends=body),
            {RHO: 1.3, P: 2.1, L: 1.7, m: 0.8},
            beams.string(2.1, 1.3, 1.7, 0.8, 3),
        ),
        "Euler-Bernoulli beam": lambda: (
            Continuum(moving, bent, w, (0, L), fixed=clamped),
            numbers,
            beams.cantilever(2.1, 1.3, 1.7, 0, 0, 3),
        ),
        "Euler-Bernoulli beam with a body": lambda: (
            Continuum(moving, bent, w, (0, L), fixed=clamped, T_ends={L: body[L] + J * w.diff(x, t) ** 2 / 2}),
            numbers | tip,
            beams.cantilever(2.1, 1.3, 1.7, 0.8, 0.3, 3),
        ),
        "Timoshenko beam with a body": lambda: (
            Continuum(
                moving + RI * psi.diff(t) ** 2 / 2,
                EI * psi.diff(x) ** 2 / 2 + kGA * (w.diff(x) - psi) ** 2 / 2,
                [w, psi],
                (0, L),
                fixed={0: [w, psi]},
                T_ends={L: body[L] + J * psi.diff(t) ** 2 / 2},
            ),
            numbers | tip | shear,
            beams.timoshenko(2.1, 40.0, 1.3, 0.02, 1.7, 0.8, 0.3, 3, 0.3),
        ),
        "rotating beam": lambda: (
            Continuum(moving, bent + RHO * Om**2 * (L**2 - x**2) / 4 * w.diff(x) ** 2, w, (0, L), fixed=clamped),
            numbers | {Om: 3.0},
            beams.rotating(2.1, 1.3, 1.7, 3.0, 3, 0.5),
        ),
    }
    out = {}
    for name in CASES or cases:
        system, values, exact = cases[name]()
        modes = system.normal_modes(3, values)
        # Once as they are found, and once more as coordinates of a Lagrangian.
        a = system.discretized(modes)
        lag = mb.lagrangian.Lagrangian(a.T, a.V, a.coordinates, parameters=values)
        found = np.array([modes.frequencies, np.sort(mb.equilibrium(lag, np.zeros(3)).frequencies)])
        out[name] = float(np.abs(found / np.array(exact, dtype=float) - 1).max())
    return out


# Spin-up


def paper(count: int, *, stiffening: bool = True) -> mb.lagrangian.Lagrangian:
    """Return the beam whose root turns by θ(t)."""
    theta = beams.angle(t, sp)[0]
    beam = mb.lagrangian.beam(L, EI, RHO, rotation=theta, stiffening=stiffening)
    a = beam.discretized(mb.lagrangian.clamped_free(count, s, L))
    numbers = {L: beams.LENGTH, EI: beams.EI, RHO: beams.DENSITY}
    return mb.lagrangian.Lagrangian(a.T, a.V, a.coordinates, time=t, parameters=numbers, name="spin-up"), a


def spin_up() -> dict[str, object]:
    """Return the deflection of the tip beside Kane's equations, and that of the naive form."""
    times, out = np.linspace(0, beams.RISE, 151), {}
    for name, stiffening in (("stiffened", True), ("naive", False)):
        lag, a = paper(TURNED, stiffening=stiffening)
        run = mb.simulate(
            lag.dynamics(), *np.zeros((2, TURNED)), beams.RISE, "rk853", save=times, rtol=1e-12, atol=1e-14, doubt=False
        )
        tip, exact = run.q @ a.at(1.0), beams.spin_up(TURNED, times, stiffening=stiffening)
        at = int(np.abs(tip).argmax())
        out[name] = {
            "largest_m": float(tip[at]),
            "at_s": float(times[at]),
            "error": float(np.abs(tip - exact).max() / np.abs(exact).max()),
        }
    out["element"] = {str(part): of_element(part) for part in PARTS}
    out["of_modes_m"] = {}
    for count in COUNTS:
        out["of_modes_m"][str(count)] = float(beams.spin_up(count, np.linspace(0, beams.RISE, 1501)).min())
    return out


def of_element(part: float) -> dict[str, float]:
    """Return the tip of a beam in a description beside Kane's equations, at a part of the full speed.

    Its kinetic energy is that of points, with terms of third and fourth order in deflections that the equations lack.
    """
    b = mb.ModelBuilder.of(rotor(TURNED))
    b.prescribe("turn", part * beams.angle(t, sp)[0])
    dyn, times = mb.dynamics(b.build(), "lagrangian"), np.linspace(0, beams.RISE, 151)
    run = mb.simulate(dyn, *np.zeros((2, TURNED + 1)), beams.RISE, "rk853", save=times, rtol=1e-10, atol=1e-13)
    tip, exact = tip_of(dyn, run.q), beams.spin_up(TURNED, times, speed=part * beams.SPEED)
    return {"largest_m": float(tip.min()), "difference": float(np.abs(tip - exact).max() / np.abs(exact).max())}


# Chains of rigid segments


def rotor(modes: int) -> mb.Model:
    """Return a hub on a vertical axis that carries the beam of the spin-up."""
    b = mb.ModelBuilder("rotor", gravity=(0, 0, 0))
    b.add_body("hub", mass=1.0, inertia=(HUB, HUB, HUB))
    b.add_joint("turn", "revolute", parent="world", child="hub", axis=(0, 0, 1))
    place = {"length": beams.LENGTH, "stiffness": beams.EI, "density": beams.DENSITY}
    b.add_beam("beam", parent="hub", modes=modes, **place)
    return b.build()


def tip_of(dyn: mb.Dynamics, q: np.ndarray) -> np.ndarray:
    """Return how far the beam's end lies across the line of the root."""
    hub, end = (dyn.pose(q, name) for name in ("hub", "beam"))
    return np.einsum("ki,ki->k", hub[:, :3, 1], end[:, :3, 3])


def torque(time, q, v):  # noqa: ARG001
    out = np.zeros(len(v))
    out[0] = TORQUE * np.sin(np.pi * time / PULSE) ** 2
    return out


def chains() -> dict[str, object]:
    """Return frequencies and the tip's deflection on a turning hub, from the modes and from chains in two engines."""
    th, J = sp.symbols("theta J")
    beam = mb.lagrangian.beam(L, EI, RHO, rotation=th, coordinates=[th])
    numbers = {L: beams.LENGTH, EI: beams.EI, RHO: beams.DENSITY, J: HUB}
    tips: dict[int, np.ndarray] = {}
    for count in MODES:
        a = beam.discretized(mb.lagrangian.clamped_free(count, s, L))
        T = J * sp.Symbol("thetadot") ** 2 / 2 + a.T
        lag = mb.lagrangian.Lagrangian(T, a.V, [th, *a.coordinates], parameters=numbers)
        start = np.zeros(count + 1), np.array([TURN, *np.zeros(count)])
        run = mb.simulate(lag.dynamics(), *start, PULSE, "rk853", torque=torque, save=TIMES, rtol=1e-11, atol=1e-13)
        tips[count] = run.q[:, 1:] @ a.at(1.0)
    size = np.abs(tips[MODES[-1]]).max()
    element = mb.dynamics(rotor(MODES[-1]), "lagrangian")
    start = np.zeros(MODES[-1] + 1), np.array([TURN, *np.zeros(MODES[-1])])
    run = mb.simulate(element, *start, PULSE, "rk853", torque=torque, save=TIMES, rtol=1e-11, atol=1e-13)
    of_modes = {str(n): float(np.abs(tip - tips[MODES[-1]]).max() / size) for n, tip in tips.items() if n < MODES[-1]}
    of_element = float(np.abs(tip_of(element, run.q) - tips[MODES[-1]]).max() / size)
    out: dict[str, object] = {"tip_m": float(size), "errors_of_modes": of_modes, "error_of_element": of_element}
    out["chains"] = []
    exact = [float(w) for w in beams.cantilever(beams.EI, beams.DENSITY, beams.LENGTH, 0, 0, 3)]
    for n in SEGMENTS:
        model = element.model.segmented(n)
        for engine in ENGINES:
            dyn = mb.dynamics(model, engine)
            M, K = (
                dyn.mass_matrix(np.zeros(n + 1))[1:, 1:],
                -dyn.passive(np.eye(n + 1), np.zeros((n + 1, n + 1)))[1:, 1:],
            )
            squares = np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real)[:3]
            start = np.zeros(n + 1), np.array([TURN, *np.zeros(n)])
            run = mb.simulate(dyn, *start, PULSE, "rk853", torque=torque, save=TIMES, rtol=1e-9, atol=1e-12)
            row = {
                "segments": n,
                "engine": engine,
                "tip_error": float(np.abs(tip_of(dyn, run.q) - tips[MODES[-1]]).max() / size),
            }
            row["frequency_errors"] = (np.sqrt(squares) / exact - 1).tolist()
            out["chains"].append(row)
            print(row, flush=True)
    by = {e: [r for r in out["chains"] if r["engine"] == e] for e in ENGINES}
    out["orders"] = {
        e: {
            "frequency": float(np.log2(abs(rows[-2]["frequency_errors"][0] / rows[-1]["frequency_errors"][0]))),
            "tip": float(np.log2(abs(rows[-2]["tip_error"] / rows[-1]["tip_error"]))),
        }
        for e, rows in by.items()
    }
    return out


#: See `validation.smoke`.
SMOKE = {
    "SEGMENTS": (4, 5),
    "ENGINES": ("pinocchio",),
    "MODES": (1, 2),
    "COUNTS": (1,),
    "PARTS": (0.1,),
    "TURNED": 1,
    "CASES": ("string with a mass",),
    "PULSE": 0.02,
    "TIMES": np.linspace(0, 0.02, 3),
    "beams.RISE": 0.02,
}


def main() -> None:
    data = stamp(__file__)
    data["frequencies"] = strings_and_beams()
    print(data["frequencies"], flush=True)
    data["spin_up"] = spin_up()
    print(data["spin_up"], flush=True)
    data["chain"] = chains()
    print(data["chain"]["errors_of_modes"], data["chain"]["orders"], flush=True)
    results("flexible.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
