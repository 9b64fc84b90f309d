"""Whipple's bicycle: the linearized equations of the benchmark by its paper's formulas, and mbkit's beside them.

Meijaard, Papadopoulos, Ruina and Schwab 2007, Linearized dynamics equations for the balance and steer of a bicycle: a
benchmark and review, Proceedings of the Royal Society A 463, 1955-1982:

    M q̈ + v C1 q̇ + (g K0 + v² K2) q = 0,    q = (lean, steer)

with the matrices by the formulas of its appendix A, in mpmath with 50 digits. Nothing of this is mbkit's. Run
``python -m validation.bicycle``; it writes ``validation/bicycle.json``: these matrices and eigenvalues beside the
published ones, and how far mbkit's own linearization is from them, in double and with 34 digits.
"""

from __future__ import annotations

import json

import mpmath as mp

from validation.stamp import results, stamp

DIGITS = 50
#: At which eigenvalues are measured, m/s.
VELOCITIES = range(11)

#: Table 1 of the paper, as printed, but for the axes: x ahead, y to the right, z down.
PARAMETERS = {
    "w": "1.02", "c": "0.08", "g": "9.81",
    "rR": "0.3", "mR": "2", "IRxx": "0.0603", "IRyy": "0.12",
    "xB": "0.3", "zB": "-0.9", "mB": "85", "IBxx": "9.2", "IByy": "11", "IBzz": "2.8", "IBxz": "2.4",
    "xH": "0.9", "zH": "-0.7", "mH": "4", "IHxx": "0.05892", "IHyy": "0.06", "IHzz": "0.00708", "IHxz": "-0.00756",
    "rF": "0.35", "mF": "3", "IFxx": "0.1405", "IFyy": "0.28",
}  # fmt: skip

#: Published matrices, equations (5.4) to (5.7).
MATRICES = {
    "M": (("80.81722", "2.31941332208709"), ("2.31941332208709", "0.29784188199686")),
    "C1": (("0", "33.86641391492494"), ("-0.85035641456978", "1.68540397397560")),
    "K0": (("-80.95", "-2.59951685249872"), ("-2.59951685249872", "-0.80329488458618")),
    "K2": (("0", "76.59734589573222"), ("0", "2.65431523794604")),
}
#: Published speeds, m/s, table 2(a): where two real eigenvalues become a pair, and the ends of stability.
SPEEDS = {"bifurcation": "0.68428307889246", "weave": "4.29238253634111", "capsize": "6.02426201538837"}
#: Published eigenvalues, 1/s, table 2: at v = 0 all four, the real ones of both signs.
AT_REST = ("-5.53094371765393", "-3.13164324790656", "3.13164324790656", "5.53094371765393")
#: At v = 1, 2, ..., 10 m/s, tables 2(b) and (c): weave's real and imaginary part, capsize, castering, as the test suite
#: of Peterson 2011 transcribes them; three of them are rounded to 13 digits behind the point there. They come from
#: double precision: in 50 digits the same matrices give values that are up to nine units of the last digit away, and
#: at 7 m/s a castering eigenvalue that is 60 units away.
RUNNING = (
    ("3.52696170990070", "0.8077402751993", "-3.13423125066578", "-7.11008014637442"),
    ("2.68234517512745", "1.68066296590675", "-3.07158645641514", "-8.67387984831735"),
    ("1.70675605663975", "2.31582447384325", "-2.63366137253667", "-10.3510146724592"),
    ("0.41325331521125", "3.07910818603206", "-1.42944427361326", "-12.15861426576447"),
    ("-0.77534188219585", "4.46486771378823", "-0.32286642900409", "-14.07838969279822"),
    ("-1.52644486584142", "5.87673060598709", "-0.00406690076970", "-16.0853712309803"),
    ("-2.13875644258362", "7.19525913329805", "0.10268170574766", "-18.15788466125262"),
    ("-2.69348683581097", "8.46037971396931", "0.14327879765713", "-20.27940894394569"),
    ("-3.21675402252485", "9.69377351531791", "0.15790184030917", "-22.43788559040858"),
    ("-3.72016840437287", "10.90681139476287", "0.16105338653172", "-24.62459635017404"),
)

#: A state in full motion and its accelerations without any force: Basu-Mandal, Chatterjee and Papadopoulos 2007,
#: Hands-free circular motions of a benchmark bicycle, Proceedings of the Royal Society A 463, 1983-2003, table 1, as
#: software of Moore's transcribes it, with the meaning of its coordinates. Here they are mbkit's: x and y of that table
#: point the other way, so do lean and steer; its lean and pitch are from other zeros.
FULL_MOTION = {
    "x": ("0", "2.8069345714545", "0.5041626315047"),
    "y": ("0", "0.1480982396001", "0.3449706619454"),
    "z": ("0.2440472102925", "0.1058778746261", "-1.4604528332980"),
    "yaw": ("0", "0.7830033527065", "0.8353281706379"),
    "lean": ("0.9501292851472", "-0.6068425835418", "7.8555281128244"),
    "pitch": ("3.1257073014894", "-0.0119185528069", "0.1205543897884"),
    "rear_spin": ("0", "8.9129896614890", "1.8472554144217"),
    "steer": ("-0.2311385135743", "-0.4859824687093", "4.6198904039403"),
    "front_spin": ("0", "8.0133620584155", "2.4548072904550"),
}


def parameters(cast=mp.mpf):
    """Return the benchmark's numbers and the steering axis's tilt, λ = π/10."""
    return {name: cast(x) for name, x in PARAMETERS.items()} | {"lam": mp.pi / 10}


def matrices(p):
    """Return M, C1, K0 and K2 of the paper's appendix A; its numbers of equations stand beside them."""
    w, c, lam, mR, mB, mH, mF, rR, rF = (p[k] for k in ("w", "c", "lam", "mR", "mB", "mH", "mF", "rR", "rF"))
    xB, zB, xH, zH = (p[k] for k in ("xB", "zB", "xH", "zH"))
    sin, cos = mp.sin(lam), mp.cos(lam)
    # The whole bicycle, about the rear contact; a wheel's two moments across its axis are equal.
    mT = mR + mB + mH + mF
    xT = (xB * mB + xH * mH + w * mF) / mT
    zT = (-rR * mR + zB * mB + zH * mH - rF * mF) / mT
    Txx = p["IRxx"] + p["IBxx"] + p["IHxx"] + p["IFxx"] + mR * rR**2 + mB * zB**2 + mH * zH**2 + mF * rF**2
    Txz = p["IBxz"] + p["IHxz"] - mB * xB * zB - mH * xH * zH + mF * w * rF
    Tzz = p["IRxx"] + p["IBzz"] + p["IHzz"] + p["IFxx"] + mB * xB**2 + mH * xH**2 + mF * w**2
    # The front assembly, about its centre of mass, then about the steering axis.
    mA = mH + mF
    xA, zA = (xH * mH + w * mF) / mA, (zH * mH - rF * mF) / mA
    Axx = p["IHxx"] + p["IFxx"] + mH * (zH - zA) ** 2 + mF * (rF + zA) ** 2
    Axz = p["IHxz"] - mH * (xH - xA) * (zH - zA) + mF * (w - xA) * (rF + zA)
    Azz = p["IHzz"] + p["IFxx"] + mH * (xH - xA) ** 2 + mF * (w - xA) ** 2
    uA = (xA - w - c) * cos - zA * sin
    All = mA * uA**2 + Axx * sin**2 + 2 * Axz * sin * cos + Azz * cos**2
    Alx = -mA * uA * zA + Axx * sin + Axz * cos
    Alz = mA * uA * xA + Axz * sin + Azz * cos
    mu = c / w * cos
    SR, SF = p["IRyy"] / rR, p["IFyy"] / rF
    ST, SA = SR + SF, mA * uA + mu * mT * xT
    M = ((Txx, Alx + mu * Txz), (Alx + mu * Txz, All + 2 * mu * Alz + mu**2 * Tzz))
    K0 = ((mT * zT, -SA), (-SA, -SA * sin))
    K2 = ((mp.mpf(0), (ST - mT * zT) / w * cos), (mp.mpf(0), (SA + SF * sin) / w * cos))
    C1 = (
        (mp.mpf(0), mu * ST + SF * cos + Txz / w * cos - mu * mT * zT),
        (-(mu * ST + SF * cos), Alz / w * cos + mu * (SA + Tzz / w * cos)),
    )
    return {name: mp.matrix(x) for name, x in (("M", M), ("C1", C1), ("K0", K0), ("K2", K2))}


def eigenvalues(m, g, v):
    """Return the four eigenvalues at a speed, sorted by their real and imaginary parts."""
    A = mp.zeros(4)
    inverse = m["M"] ** -1
    K, C = -inverse * (g * m["K0"] + v**2 * m["K2"]), -inverse * (v * m["C1"])
    for i in range(2):
        A[i, 2 + i] = 1
        for j in range(2):
            A[2 + i, j], A[2 + i, 2 + j] = K[i, j], C[i, j]
    return ordered(mp.eig(A, left=False, right=False))


def ordered(values):
    return sorted((mp.mpc(x) for x in values), key=lambda x: (mp.nstr(x.real, 12).startswith("-"), x.real, x.imag))


def published(v):
    """Return the published eigenvalues at a whole speed, each as a pair of texts."""
    if v == 0:
        return [(x, "0") for x in AT_REST]
    real, imaginary, capsize, castering = RUNNING[v - 1]
    return [(real, f"-{imaginary}"), (real, imaginary), (capsize, "0"), (castering, "0")]


def places(text):
    """Return the digits behind the point of a printed number."""
    return len(text.partition(".")[2])


def as_printed(value, text):
    """Return by how many units of its last printed digit a printed number is off."""
    return abs(value - mp.mpf(text)) * mp.mpf(10) ** places(text)


def nearest(values, texts):
    return min(values, key=lambda x: abs(x - mp.mpc(*texts)))


# mbkit beside it


def running(model, v):
    """Return the state of running upright and straight ahead at a speed."""
    import numpy as np

    speed = np.zeros(model.nv)
    for name, rate in (("x", v), ("rear_spin", v / 0.3), ("front_spin", v / 0.35)):
        speed[model.velocity_names.index(name)] = rate
    return model.neutral(), speed


def roles(model):
    """Return which changes of (q, v) are lean, steer and their rates, and which stay: cyclic ones, and the speed."""
    names, n = list(model.velocity_names), model.nv
    free = [names.index("lean"), names.index("steer")]
    still = [names.index(k) for k in ("x", "y", "yaw", "rear_spin", "front_spin")] + [n + names.index("rear_spin")]
    return [*free, *(n + k for k in free)], still


def own_eigenvalues(oracle, v):
    """Return mbkit's four eigenvalues, of its exact linearization with the oracle's digits.

    Of the changes of (q, v) that keep the constraints, the null space of their derivatives, those are taken that leave
    place, heading, turns of the wheels and speed: what these do decides nothing.
    """
    import numpy as np

    model = oracle.model
    n, state, (free, still) = model.nv, running(model, v), roles(model)

    def exact(quantity, *arguments):
        high, low = oracle.extended(quantity, *arguments)
        return np.vectorize(lambda a, b: mp.mpf(float(a)) + mp.mpf(float(b)), otypes=[object])(high, low)

    by_q, by_v, _ = exact("forward_dynamics_derivatives", *state, np.zeros(n))
    J, gradient = exact("constraint_jacobian", state[0]), exact("constraint_rate_gradient", *state)
    held = len(J) - len(oracle.velocity_constraint_names)
    zero = np.full((n, n), mp.mpf(0))
    one = np.array([[mp.mpf(i == j) for j in range(n)] for i in range(n)], dtype=object)
    A = mp.matrix(np.block([[zero, one], [by_q, by_v]]).tolist())
    rows = np.block([[J[:held], zero[:held]], [gradient, J]])
    bound = [k for k in range(2 * n) if k not in free and k not in still]
    rest = -(mp.matrix(rows[:, bound].tolist()) ** -1) * mp.matrix(rows[:, free].tolist())
    N = mp.zeros(2 * n, 4)
    for j in range(4):
        N[free[j], j] = 1
        for i, k in enumerate(bound):
            N[k, j] = rest[i, j]
    moved = A * N
    return ordered(mp.eig(mp.matrix([[moved[k, j] for j in range(4)] for k in free]), left=False, right=False))


def in_double(dyn, v):
    """Return the same in double precision, from `linearize` and `consistent_changes`."""
    import numpy as np
    from scipy.linalg import null_space

    state, (free, still) = running(dyn.model, v), roles(dyn.model)
    N = dyn.consistent_changes(*state)
    N = N @ null_space(N[still])
    A = dyn.linearize(*state, np.zeros(dyn.model.nv)).A
    return [mp.mpc(complex(x)) for x in np.linalg.eigvals((A @ N)[free] @ np.linalg.inv(N[free]))]


def full_motion(model):
    """Return q, v and the printed v̇ of the state in full motion, in the order of a model's coordinates."""
    import numpy as np

    q, v, a = (np.array([float(FULL_MOTION[k][i]) for k in model.velocity_names]) for i in range(3))
    at = model.coordinate_names.index
    # Of the table: the rear wheel's height, the lean from lying, and the pitch from half a turn.
    q[at("z")] -= 0.3
    q[at("lean")] = np.pi / 2 - q[at("lean")]
    q[at("pitch")] -= np.pi
    return q, v, a


def in_full_motion(dyn):
    """Return how far the state of the print is from the constraints, and v̇ from the print, in units of 1e-13."""
    import numpy as np

    q, v, a = full_motion(dyn.model)
    left = np.concatenate([dyn.constraint_residual(q), dyn.constraint_rate(q, v)])
    off = dyn.forward_dynamics(q, v, np.zeros(dyn.model.nv)) - a
    return float(np.abs(left).max() * 1e13), float(np.abs(off).max() * 1e13)


def critical(m, g):
    """Return the weave and capsize speeds: where the pair's real part and the determinant of g K0 + v² K2 are zero."""

    def swing(v):
        return max(x.real for x in eigenvalues(m, g, v) if abs(x.imag) > 1)

    K0, K2 = m["K0"], m["K2"]
    # The determinant is linear in v², as K2 has one column.
    slope = K0[0, 0] * K2[1, 1] - K0[1, 0] * K2[0, 1]
    capsize = mp.sqrt(-g * (K0[0, 0] * K0[1, 1] - K0[0, 1] * K0[1, 0]) / slope)
    return {"weave": mp.findroot(swing, (4.2, 4.4), solver="anderson"), "capsize": capsize}


def from_print(values, v):
    """Return by how many units of the last printed digit the published eigenvalues at a speed are off, at most."""
    off = []
    for real, imaginary in published(v):
        x = nearest(values, (real, imaginary))
        off += [as_printed(x.real, real), as_printed(x.imag, imaginary) if imaginary != "0" else abs(x.imag)]
    return float(max(off))


def apart(values, others):
    """Return how far eigenvalues are from others, relative to each, at most."""
    return float(max(abs(nearest(values, (x.real, x.imag)) - x) / abs(x) for x in others))


def matrices_from_print(m):
    entries = {name: [(i, j, x) for i, row in enumerate(t) for j, x in enumerate(row)] for name, t in MATRICES.items()}
    return {name: float(max(as_printed(m[name][i, j], x) for i, j, x in some)) for name, some in entries.items()}


#: See `validation.smoke`.
SMOKE = {"VELOCITIES": (0,)}


def main():
    import mbkit as mb

    mp.mp.dps = DIGITS
    p = parameters()
    m, g = matrices(p), p["g"]
    model = mb.catalog.bicycle()
    oracle, own = mb.dynamics(model, "oracle"), mb.dynamics(model, "lagrangian")
    rows = []
    for v in VELOCITIES:
        canonical, ours = eigenvalues(m, g, mp.mpf(v)), own_eigenvalues(oracle, v)
        row = {
            "speed": v,
            "eigenvalues": [
                [mp.nstr(x.real, 16), mp.nstr(x.imag if abs(x.imag) > 1e-30 else 0, 16)] for x in canonical
            ],
            "oracle_from_canonical": apart(ours, canonical),
            "double_from_canonical": apart(in_double(own, v), canonical),
            "oracle_from_print_in_last_digits": from_print(ours, v),
            "canonical_from_print_in_last_digits": from_print(canonical, v),
        }
        print(row)
        rows.append(row)
    speeds = {
        name: {"value": mp.nstr(x, 16), "from_print_in_last_digits": float(as_printed(x, SPEEDS[name]))}
        for name, x in critical(m, g).items()
    }
    off, moving = matrices_from_print(m), in_full_motion(oracle)
    print(off, speeds, moving)
    data = {**stamp(__file__), "matrices_from_print_in_last_digits": off, "critical_speeds": speeds, "rows": rows}
    data["full_motion"] = dict(zip(("constraints_in_last_digits", "accelerations_in_last_digits"), moving, strict=True))
    results("bicycle.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
