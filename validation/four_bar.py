"""One four-bar in four engines: the error of its angle, how far the loop opens, and the time of a step.

Run ``python -m validation.four_bar``; it writes ``validation/four_bar.json``. The engines close the loop by their own
means: Pinocchio by `constraintDynamics`, iterated or with Baumgarte's stabilization, MuJoCo by a soft equality, Drake
by the SAP solver of its discrete plant. The own derivation takes the loop as constraints. The truth is the motion of
the one coordinate that is free, in numbers of 64 bits of mantissa: nothing of it is mbkit's.
"""

from __future__ import annotations

import json
import time

import numpy as np

from validation.stamp import results, stamp

#: Crank, coupler, rocker and the distance between their pivots, m; kg a metre; m/s².
CRANK, COUPLER, ROCKER, GROUND = 0.3, 0.9, 0.7, 1.0
LINE, GRAVITY = 2.0, 9.81
#: Each rod, what carries it, where along that, and its length.
RODS = (("crank", "", 0.0, CRANK), ("coupler", "crank", CRANK, COUPLER), ("rocker", "", GROUND, ROCKER))
#: Angle and speed of the crank at the start, rad and rad/s.
START, SPEED = 0.5, 5.0
DT, TIMES = 1e-3, (1.0, 5.0)
_LONG = np.longdouble
#: Substeps of the modified midpoint rule whose results are extrapolated, and the step between, s.
_SUBSTEPS, _STEP = tuple(range(2, 14, 2)), 0.01


# The truth


def geometry(theta):
    """Return the angles of coupler and rocker, with their first and second derivatives by the crank's."""
    a, c, r = _LONG(str(CRANK)), _LONG(str(COUPLER)), _LONG(str(ROCKER))
    x, y = a * np.cos(theta) - _LONG(str(GROUND)), a * np.sin(theta)
    # From the rocker's pivot to the crank's pin, and the triangle of coupler and rocker above it.
    square = x * x + y * y
    psi = np.arctan2(y, x) - np.arccos((square + r * r - c * c) / (2 * r * np.sqrt(square)))
    phi = np.arctan2(r * np.sin(psi) - y, r * np.cos(psi) - x)
    # The closure differentiated once and twice: c u_φ φ' - r u_ψ ψ' = right-hand side, with unit vectors u.
    K = np.array([[-c * np.sin(phi), r * np.sin(psi)], [c * np.cos(phi), -r * np.cos(psi)]])
    first = _solve(K, a * np.array([np.sin(theta), -np.cos(theta)]))
    along = [(a, theta, 1), (c, phi, first[0] ** 2), (-r, psi, first[1] ** 2)]
    second = _solve(K, np.array([sum(n * f(x) * w for n, x, w in along) for f in (np.cos, np.sin)]))
    return (phi, psi), first, second


def _solve(K, b):
    return np.array([b[0] * K[1, 1] - K[0, 1] * b[1], K[0, 0] * b[1] - K[1, 0] * b[0]]) / (
        K[0, 0] * K[1, 1] - K[0, 1] * K[1, 0]
    )


def acceleration(theta, rate):
    """Return θ̈ of J(θ) θ̈ + ½ J' θ̇² + V' = 0, and the energy."""
    a, c, r = _LONG(str(CRANK)), _LONG(str(COUPLER)), _LONG(str(ROCKER))
    ma, mc, mr = (_LONG(str(LINE)) * x for x in (a, c, r))
    g = _LONG(str(GRAVITY))
    (phi, psi), (f1, r1), (f2, r2) = geometry(theta)
    ends = np.array([-a * np.sin(theta) - c / 2 * np.sin(phi) * f1, a * np.cos(theta) + c / 2 * np.cos(phi) * f1])
    bend = np.array(
        [
            -a * np.cos(theta) - c / 2 * (np.cos(phi) * f1**2 + np.sin(phi) * f2),
            -a * np.sin(theta) + c / 2 * (np.cos(phi) * f2 - np.sin(phi) * f1**2),
        ]
    )
    J = ma * a**2 / 3 + mc * (ends @ ends) + mc * c**2 / 12 * f1**2 + mr * r**2 / 3 * r1**2
    half_slope = mc * (ends @ bend) + mc * c**2 / 12 * f1 * f2 + mr * r**2 / 3 * r1 * r2
    pull = g * (ma * a / 2 * np.cos(theta) + mc * ends[1] + mr * r / 2 * np.cos(psi) * r1)
    height = ma * a / 2 * np.sin(theta) + mc * (a * np.sin(theta) + c / 2 * np.sin(phi)) + mr * r / 2 * np.sin(psi)
    return -(half_slope * rate**2 + pull) / J, J * rate**2 / 2 + g * height


def _rates(y):
    return np.array([y[1], acceleration(*y)[0]])


def extrapolated(y, h, rates=_rates):
    """Return the state after a step, by Gragg's, Bulirsch's and Stoer's extrapolation of the midpoint rule."""
    table = []
    for i, n in enumerate(_SUBSTEPS):
        d = h / n
        before, now = y, y + d * rates(y)
        for _ in range(n - 1):
            before, now = now, before + 2 * d * rates(now)
        row = [(before + now + d * rates(now)) / 2]
        for j in range(i):
            row.append(row[j] + (row[j] - table[-1][j]) / ((_LONG(n) / _SUBSTEPS[i - j - 1]) ** 2 - 1))
        table.append(row)
    return table[-1][-1]


def truth(step=_STEP):
    """Return the crank's angle at `TIMES`, and how far the energy moved, relative to the kinetic one."""
    y = np.array([_LONG(str(START)), _LONG(str(SPEED))])
    _, energy = acceleration(*y)
    out, done = [], 0.0
    for t in TIMES:
        steps = round((t - done) / step)
        for _ in range(steps):
            y = extrapolated(y, _LONG(t - done) / steps)
        done = t
        out.append(y[0])
    return out, float(abs(acceleration(*y)[1] - energy) / abs(energy))


def start():
    """Return joint angles and rates: crank, coupler beside the crank, rocker."""
    (phi, psi), (f1, r1), _ = geometry(_LONG(str(START)))
    q, v = np.array([START, phi - _LONG(str(START)), psi]), SPEED * np.array([1, f1 - 1, r1])
    return q.astype(float), v.astype(float)


def opened(q):
    """Return the distance of coupler's and rocker's ends, m, of (N, 3) angles."""
    theta, phi, psi = q[:, 0], q[:, 0] + q[:, 1], q[:, 2]
    x = CRANK * np.cos(theta) + COUPLER * np.cos(phi) - GROUND - ROCKER * np.cos(psi)
    y = CRANK * np.sin(theta) + COUPLER * np.sin(phi) - ROCKER * np.sin(psi)
    return np.hypot(x, y)


def stepped(step, q, v):
    """Return the angles after each step up to the last of `TIMES`, and the seconds that a step takes."""
    states = [q]
    begun = time.perf_counter()
    for _ in range(round(TIMES[-1] / DT)):
        q, v = step(q, v)
        states.append(q)
    return np.array(states), (time.perf_counter() - begun) / (len(states) - 1)


# The engines


def pinocchio(baumgarte):
    import pinocchio as pin

    m = pin.Model()
    ends = {}
    for name, parent, x, length in RODS:
        place = pin.SE3(np.eye(3), np.array([x, 0, 0]))
        joint = m.addJoint(ends.get(parent, 0), pin.JointModelRZ(), place, name)
        mass = LINE * length
        inertia = np.diag([0, 1, 1]) * mass * length**2 / 12
        body = pin.Inertia(mass, np.array([length / 2, 0, 0]), inertia)
        m.appendBodyToJoint(joint, body, pin.SE3.Identity())
        ends[name] = joint
    m.gravity.linear = np.array([0, -GRAVITY, 0])
    d = m.createData()
    places = [pin.SE3(np.eye(3), np.array([x, 0, 0])) for x in (COUPLER, ROCKER)]
    pairs = [y for pair in zip((ends["coupler"], ends["rocker"]), places, strict=True) for y in pair]
    loop = pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, m, *pairs, pin.ReferenceFrame.LOCAL)
    if baumgarte:
        # Critically damped, with a time of 10 ms.
        loop.m_baumgarte_parameters.Kp, loop.m_baumgarte_parameters.Kd = 1e4, 200.0
    loops, data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    loops.append(loop)
    data.append(loop.createData())
    pin.initConstraintDynamics(m, d, loops, data)
    still = np.zeros(3)

    def rate(q, v, mu=1e-8):
        settings = pin.ProximalSettings(1e-14, 1e-14, mu, 20)
        return pin.constraintDynamics(m, d, q, v, still, loops, data, settings).copy()

    def rk4(q, v):
        a1 = rate(q, v)
        v2 = v + DT / 2 * a1
        a2 = rate(q + DT / 2 * v, v2)
        v3 = v + DT / 2 * a2
        a3 = rate(q + DT / 2 * v2, v3)
        v4 = v + DT * a3
        a4 = rate(q + DT * v3, v4)
        return q + DT / 6 * (v + 2 * v2 + 2 * v3 + v4), v + DT / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    states, seconds = stepped(rk4, *start())
    return states, seconds, bool(np.isfinite(rate(*start(), mu=0.0)).all())


MJCF = """<mujoco><option timestep="{dt}" gravity="0 -{g} 0" integrator="{integrator}"/>
<compiler inertiafromgeom="false"/><worldbody>
<body name="crank">{crank}<body name="coupler" pos="{a} 0 0">{coupler}<site name="c" pos="{c} 0 0"/></body></body>
<body name="rocker" pos="{ground} 0 0">{rocker}<site name="r" pos="{r} 0 0"/></body></worldbody>
<equality><connect site1="c" site2="r" {soft}/></equality></mujoco>"""


def mujoco(integrator, soft):
    import mujoco as mj

    def rod(length):
        mass = LINE * length
        # No tensor may be singular here; the first moment turns nothing in the plane.
        moments = f"{mass * length**2 / 12} {mass * length**2 / 12} {mass * length**2 / 12}"
        return f'<joint axis="0 0 1"/><inertial pos="{length / 2} 0 0" mass="{mass}" diaginertia="{moments}"/>'

    rods = {"crank": rod(CRANK), "coupler": rod(COUPLER), "rocker": rod(ROCKER)}
    sizes = {"a": CRANK, "c": COUPLER, "r": ROCKER, "ground": GROUND, "g": GRAVITY, "dt": DT}
    m = mj.MjModel.from_xml_string(MJCF.format(**rods, **sizes, integrator=integrator, soft=soft))
    d = mj.MjData(m)
    d.qpos[:], d.qvel[:] = start()

    def step(*_):
        mj.mj_step(m, d)
        return d.qpos.copy(), None

    return stepped(step, d.qpos.copy(), None)


def drake():
    from pydrake.math import RigidTransform
    from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
    from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia
    from pydrake.systems.analysis import Simulator

    plant = MultibodyPlant(DT)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    bodies = {}
    for name, parent, x, length in RODS:
        unit = UnitInertia.ThinRod(length, [1, 0, 0]).ShiftFromCenterOfMass([-length / 2, 0, 0])
        bodies[name] = plant.AddRigidBody(name, SpatialInertia(LINE * length, [length / 2, 0, 0], unit))
        on = bodies[parent] if parent else plant.world_body()
        base = plant.AddFrame(FixedOffsetFrame(f"{name}_base", on.body_frame(), RigidTransform([x, 0, 0])))
        plant.AddJoint(RevoluteJoint(name, base, bodies[name].body_frame(), [0, 0, 1]))
    plant.AddBallConstraint(bodies["coupler"], [COUPLER, 0, 0], bodies["rocker"], [ROCKER, 0, 0])
    plant.mutable_gravity_field().set_gravity_vector([0, -GRAVITY, 0])
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, start()[0])
    plant.SetVelocities(context, start()[1])
    simulator = Simulator(plant, context)
    simulator.Initialize()
    # Sums of the step would be beside the plant's own multiples of it, and a step too few or too many be taken.
    times = iter(DT * np.arange(1, round(TIMES[-1] / DT) + 1))

    def step(*_):
        simulator.AdvanceTo(next(times))
        return plant.GetPositions(context), None

    return stepped(step, start()[0], None)


def described():
    """Return the four-bar as mbkit's description."""
    import mbkit as mb

    b = mb.ModelBuilder("four_bar", gravity=(0, -GRAVITY, 0))
    for name, parent, x, length in RODS:
        mass = LINE * length
        turn = mass * length**2 / 12
        b.add_body(name, mass=mass, com=(length / 2, 0, 0), inertia=(0, turn, turn))
        b.add_joint(name, "continuous", parent=parent or "world", child=name, axis=(0, 0, 1), translation=(x, 0, 0))
    b.add_loop(
        "pin", "point", body_a="coupler", translation_a=(COUPLER, 0, 0), body_b="rocker", translation_b=(ROCKER, 0, 0)
    )
    return b.build()


def own(method, **tolerance):
    import mbkit as mb

    dyn = mb.dynamics(described(), "lagrangian")
    save = np.linspace(0, TIMES[-1], round(TIMES[-1] / DT) + 1)
    # The first run derives and compiles.
    for _ in range(2):
        run = mb.simulate(dyn, *start(), TIMES[-1], method, save=save, doubt=False, **tolerance)
    return run.q, run.stats.seconds / run.stats.steps


#: See `validation.smoke`.
SMOKE = {"TIMES": (0.02, 0.05)}


def main():
    exact, drift = truth()
    finer, _ = truth(_STEP / 2)
    uncertain = max(float(abs(x - y)) for x, y in zip(exact, finer, strict=True))
    *iterated, finite = pinocchio(baumgarte=False)
    stiff = 'solref="0.002 1" solimp="0.9999 0.9999 0.001 0.5 2"'
    runs = {
        "Pinocchio, constraintDynamics, RK4": tuple(iterated),
        "the same with Baumgarte's stabilization": pinocchio(baumgarte=True)[:2],
        "MuJoCo, default, Euler": mujoco("Euler", ""),
        "MuJoCo, stiffest at this step, RK4": mujoco("RK4", stiff),
        "Drake, SAP": drake(),
        "mbkit, own derivation, RK4": own("rk4", dt=DT),
        "mbkit, own derivation, rk853": own("rk853", rtol=1e-13),
    }
    rows = []
    for name, (states, seconds) in runs.items():
        errors = [float(abs(states[round(t / DT), 0] - x)) for t, x in zip(TIMES, exact, strict=True)]
        gap = float(opened(states).max())
        rows.append({"engine": name, "error": errors, "gap": gap, "us_a_step": round(seconds * 1e6, 1)})
        print(f"{name:45}", *(f"{x:9.1e}" for x in (*errors, gap)), f"{seconds * 1e6:9.1f} us")
    data = {**stamp(__file__), "dt": DT, "times": TIMES, "truth_known_to": uncertain, "truth_energy_drift": drift}
    data |= {"pinocchio_without_regularization_is_finite": finite, "rows": rows}
    results("four_bar.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
