"""Dry friction against references of its own: ends of phases, orders across them, Moreau's step, a smoothed law.

Run ``python -m validation.friction``; it writes ``validation/friction.json``. References are closed forms, a quadrature
of the pendulum's energy, exponentials of matrices for a block with a fast rider, and a two-link arm of its own in
numbers of 40 digits, whose friction is decided by trying every pattern of what rests: nothing of them is mbkit's.
"""

from __future__ import annotations

import itertools
import json
import time

import mpmath as mp
import numpy as np

from validation.stamp import results, stamp

mp.mp.dps = 40
G = mp.mpf("9.81")


# References: times at which something stops, lets go or turns, with the positions there, and those at the end


def slope():
    """3 kg thrown up a slope of 30° with μ = 0.7, which rests where it stops; Coulomb's law."""
    force = mp.mpf("0.7") * 3 * G * mp.sqrt(3) / 2
    slowed = G / 2 + force / 3
    end = [mp.mpf(4) ** 2 / 2 / slowed]
    return {"friction": float(force), "events": [(4 / slowed, end)], "end": end}


def oscillator(m=2, k=50, f=3, start=1):
    """Each half swing is about ±f/k and takes π √(m/k), so that amplitudes fall by 2 f/k (Den Hartog 1931)."""
    half, step, x, events = mp.pi * mp.sqrt(mp.mpf(m) / k), 2 * mp.mpf(f) / k, mp.mpf(start), []
    while abs(x) * k > f:
        x = -mp.sign(x) * (abs(x) - step)
        events.append((half * (len(events) + 1), [x]))
    return {"events": events, "end": [x]}


#: Of the block on the belt, after which half a slip follows.
PERIODS = 25
BELT = {"m": 2, "k": 50, "f": 3, "s": 5, "speed": mp.mpf("0.2")}


def belt():
    """Return when a block on a belt lets go, at s/k, and when it has the belt's speed again, about f/k as far."""
    m, k, f, s, u = BELT.values()
    omega = mp.sqrt(mp.mpf(m) / k) ** -1
    slip = (2 * mp.pi - 2 * mp.atan((s - f) * omega / (k * u))) / omega
    stick, low, high, events = 2 * (s - f) / (k * u), mp.mpf(2 * f - s) / k, mp.mpf(s) / k, []
    for n in range(PERIODS):
        go = n * (stick + slip) + stick
        events += [(go, [high - u * go]), (go + slip, [low - u * (go + slip)])]
    # A third of a slip behind the last stop and a stick.
    late = events[-1][0] + stick + slip / 3
    events.append((late - slip / 3, [high - u * (late - slip / 3)]))
    wave = (s - f) / mp.mpf(k) * mp.cos(omega * slip / 3) + u / omega * mp.sin(omega * slip / 3)
    return {"start": [low], "duration": late, "events": events, "end": [f / mp.mpf(k) + wave - u * late]}


#: On a spring on the block, and how far it is out at the start.
RIDER = {"m": mp.mpf("0.1"), "k": 360, "start": mp.mpf("0.003")}


def rider():
    """Return the same for the block with a fast rider: many steps of any method in each phase."""
    (m, k, f, s, u), (n, c, out) = BELT.values(), RIDER.values()
    # Of the places and velocities of both, the time, and one.
    stick, slip = mp.zeros(6), mp.zeros(6)
    pull = mp.matrix([[-k - c, 0, c, 0, -k * u, 0]])
    for A in (stick, slip):
        A[2, 3] = A[4, 5] = 1
        A[3, :] = mp.matrix([[c, 0, -c, 0, 0, 0]]) / n
    slip[0, 1] = 1
    slip[1, :] = pull / m
    slip[1, 5] = mp.mpf(f) / m
    low = mp.mpf(2 * f - s) / k
    z, slips, events = mp.matrix([low, 0, low + out, 0, 0, 1]), False, []
    h = mp.mpf(1) / 200
    steps = {False: mp.expm(stick * h), True: mp.expm(slip * h)}

    def margin(z, slips):
        return z[1] if slips else -s - (pull * z)[0]

    while True:
        after = steps[slips] * z
        if len(events) == 2 * PERIODS + 1:
            end = [after[0], after[2] - after[0]]
            return {"start": [low, out], "duration": after[4], "events": events, "end": end}
        if margin(after, slips) > 0:
            A, now = slip if slips else stick, slips
            ends = mp.findroot(lambda t, A=A, z=z, now=now: margin(mp.expm(A * t) * z, now), (0, h), solver="anderson")
            after = mp.expm(A * ends) * z
            after[1] = 0
            events.append((after[4], [after[0], after[2] - after[0]]))
            slips = not slips
        z = after


PENDULUM = {"inertia": mp.mpf(1) / 3, "torque": G / 2, "f": mp.mpf("0.4"), "start": mp.mpf("2.5")}


def pendulum():
    """A rod of 1 kg and 1 m with a dry hinge: turns from the energy, times by quadrature, and where it rests."""
    J, T, f, angle = PENDULUM.values()
    now, events = mp.mpf(0), []
    while abs(T * mp.sin(angle)) > f:
        way = -mp.sign(mp.sin(angle))

        def left(x, a=angle, way=way):
            return T * (mp.cos(x) - mp.cos(a)) - f * way * (x - a)

        # The energy is largest where friction holds gravity, and used up before the same height on the other side.
        end = mp.findroot(left, (-angle, -way * mp.asin(f / T)), solver="anderson", tol=1e-70, verify=False)
        middle, half = (angle + end) / 2, (end - angle) / 2

        def rate(u, a=middle, h=half, left=left):
            # x = a - h cos u takes the roots at both ends away.
            return abs(h) * mp.sin(u) / mp.sqrt(2 * abs(left(a - h * mp.cos(u))) / J)

        mp.mp.dps += 20
        now += mp.quad(rate, mp.linspace(0, mp.pi, 5))
        mp.mp.dps -= 20
        angle = end
        events.append((now, [angle]))
    return {"events": events, "end": [angle]}


# Lengths, masses, friction of shoulder and elbow; bodies are thin rods, angles from the horizontal.
ARM = {"l": (mp.mpf("0.8"), mp.mpf("0.6")), "m": (2, 1), "f": (mp.mpf("1.5"), mp.mpf("1.2"))}
ARM_START, ARM_TIME = [mp.mpf("0.3"), mp.mpf("0.4"), mp.mpf(0), mp.mpf(3)], mp.mpf(3)
ARM_STEP = mp.mpf("0.02")
_SUBSTEPS = tuple(range(2, 22, 2))


def arm_terms(y):
    """Return M and what accelerates the arm without friction; Lagrange's equations of two rods."""
    (l1, l2), (m1, m2) = ARM["l"], ARM["m"]
    q1, q2, v1, v2 = y
    cross = m2 * l1 * l2 / 2
    m22 = m2 * l2**2 / 3
    m12 = m22 + cross * mp.cos(q2)
    m11 = m1 * l1**2 / 3 + m2 * l1**2 + m22 + 2 * cross * mp.cos(q2)
    bend = cross * mp.sin(q2)
    tip = m2 * G * l2 / 2 * mp.cos(q1 + q2)
    pull = [bend * (2 * v1 * v2 + v2**2) - (m1 / mp.mpf(2) + m2) * G * l1 * mp.cos(q1) - tip, -bend * v1**2 - tip]
    return [[m11, m12], [m12, m22]], pull


def arm_accelerations(y, sides, rests):
    """Return accelerations with given sides of friction, and of what rests the force that holds it."""
    M, pull = arm_terms(y)
    force = [p - (0 if r else s * f) for p, s, r, f in zip(pull, sides, rests, ARM["f"], strict=True)]
    if all(rests):
        return [mp.mpf(0)] * 2, [-p for p in pull]
    if any(rests):
        i = rests.index(False)
        a = [mp.mpf(0)] * 2
        a[i] = force[i] / M[i][i]
        return a, [M[j][i] * a[i] - pull[j] if rests[j] else mp.mpf(0) for j in (0, 1)]
    det = M[0][0] * M[1][1] - M[0][1] ** 2
    return [(M[1][1] * force[0] - M[0][1] * force[1]) / det, (M[0][0] * force[1] - M[0][1] * force[0]) / det], [0, 0]


def arm_pattern(y, moving):
    """Return sides and rests: of all patterns of what has no velocity, the one of the least constraint."""
    M, pull = arm_terms(y)
    best = None
    for pattern in itertools.product(*[(s,) if s else (0, 1, -1) for s in moving]):
        sides, rests = list(pattern), [s == 0 for s in pattern]
        a, _ = arm_accelerations(y, sides, rests)
        cost = sum(a[i] * M[i][j] * a[j] / 2 for i in (0, 1) for j in (0, 1)) - sum(map(mp.fmul, pull, a))
        cost += sum(f * (s * x if s else abs(x)) for f, s, x in zip(ARM["f"], moving, a, strict=True))
        if best is None or cost < best[0]:
            best = cost, sides, rests
    return best[1:]


def arm_step(y, h, sides, rests):
    """Return the state after h seconds of a phase: the midpoint rule extrapolated."""

    def rates(y):
        return [*y[2:], *arm_accelerations(y, sides, rests)[0]]

    def moved(y, d, r):
        return [a + d * b for a, b in zip(y, r, strict=True)]

    table = []
    for i, n in enumerate(_SUBSTEPS):
        d = h / n
        before, now = y, moved(y, d, rates(y))
        for _ in range(n - 1):
            before, now = now, moved(before, 2 * d, rates(now))
        row = [[(a + b + d * r) / 2 for a, b, r in zip(before, now, rates(now), strict=True)]]
        for j in range(i):
            factor = (mp.mpf(n) / _SUBSTEPS[i - j - 1]) ** 2 - 1
            row.append([a + (a - b) / factor for a, b in zip(row[j], table[-1][j], strict=True)])
        table.append(row)
    return table[-1][-1]


def arm_margins(y, sides, rests):
    _, held = arm_accelerations(y, sides, rests)
    parts = zip(sides, rests, y[2:], held, ARM["f"], strict=True)
    return [f - abs(x) if r else s * v for s, r, v, x, f in parts]


def arm(step=ARM_STEP):
    """Return events of the arm, a phase after the other, with the joints named 0 and 1."""
    y, t, events = list(ARM_START), mp.mpf(0), []
    sides, rests = arm_pattern(y, [int(mp.sign(v)) for v in y[2:]])
    while t < ARM_TIME:
        h = min(step, ARM_TIME - t)
        after = arm_step(y, h, sides, rests)
        margins = arm_margins(after, sides, rests)
        # A joint that has just begun to move is on its way from zero.
        if min(margins) >= 0:
            y, t = after, t + h
            continue
        ends = []
        for i in (i for i in (0, 1) if margins[i] < 0):

            def margin(s, i=i, y=y, sides=sides, rests=rests):
                return arm_margins(arm_step(y, s, sides, rests), sides, rests)[i]

            low = h * mp.mpf("1e-6")
            assert margin(low) > 0
            ends.append((mp.findroot(margin, (low, h), solver="anderson", tol=1e-60, maxsteps=60, verify=False), i))
        s, i = min(ends)
        y, t = arm_step(y, s, sides, rests), t + s
        moving = [0 if r else side for side, r in zip(sides, rests, strict=True)]
        if rests[i]:
            # It lets go against the force that held it.
            moving[i] = -int(mp.sign(arm_accelerations(y, sides, rests)[1][i]))
            sides, rests = moving, [m == 0 for m in moving]
        else:
            y[2 + i], moving[i] = mp.mpf(0), 0
            sides, rests = arm_pattern(y, moving)
        events.append((t, y[:2]))
    return {"events": events, "end": y[:2]}


# The same by mbkit


def described():
    """Return name -> model and start: q, v."""
    import mbkit as mb

    def one(name, kind, friction, gravity=(0, 0, 0), **more):
        b = mb.ModelBuilder(name, gravity=gravity)
        body = more.pop("body")
        b.add_body("block", **body)
        joint = {"axis": (1, 0, 0) if kind == "prismatic" else (0, 0, 1), **more}
        b.add_joint("x", kind, parent="world", child="block", friction=friction, **joint)
        return b

    tilt = float(mp.sqrt(3) / 2)
    on_slope = one("slope", "prismatic", slope()["friction"], (-9.81 / 2, 0, -9.81 * tilt), body={"mass": 3.0})
    spring = one("oscillator", "prismatic", 3.0, body={"mass": 2.0}, stiffness=50.0)
    on_belt = one("belt", "prismatic", 3.0, body={"mass": 2.0}, stiction=5.0)
    speed = float(BELT["speed"])
    on_belt.add_joint_force("spring", "x", lambda t, q, v: -50.0 * (q + speed * t))  # noqa: ARG005
    ridden = mb.ModelBuilder.of(on_belt.build())
    ridden.add_body("rider", mass=float(RIDER["m"]))
    ridden.add_joint("y", "prismatic", parent="block", child="rider", axis=(1, 0, 0), stiffness=float(RIDER["k"]))
    two = rider()
    rod = {"mass": 1.0, "com": (0, -0.5, 0), "inertia": (1 / 12, 0, 1 / 12)}
    hinge = one("pendulum", "continuous", float(PENDULUM["f"]), (0, -9.81, 0), body=rod)
    b, parent = mb.ModelBuilder("arm", gravity=(0, -9.81, 0)), "world"
    for name, length, mass, f in zip(("shoulder", "elbow"), ARM["l"], ARM["m"], ARM["f"], strict=True):
        length, x = float(length), 0.0 if parent == "world" else float(ARM["l"][0])
        turn = mass * length**2 / 12
        b.add_body(name, mass=mass, com=(length / 2, 0, 0), inertia=(0, turn, turn))
        place = {"axis": (0, 0, 1), "translation": (x, 0, 0)}
        b.add_joint(name, "continuous", parent=parent, child=name, friction=float(f), **place)
        parent = name
    start = [float(x) for x in ARM_START]
    return {
        "block on a slope": (on_slope.build(), [0.0], [4.0], 2.0, slope()),
        "Coulomb oscillator": (spring.build(), [1.0], [0.0], 6.0, oscillator()),
        "block on a belt": (on_belt.build(), *map(_floats, (belt()["start"], [0])), float(belt()["duration"]), belt()),
        "block with a rider": (ridden.build(), _floats(two["start"]), [0.0, 0.0], float(two["duration"]), two),
        "pendulum": (hinge.build(), [float(PENDULUM["start"])], [0.0], 12.0, pendulum()),
        "two-link arm": (b.build(), start[:2], start[2:], float(ARM_TIME), arm()),
    }


def _floats(x):
    return [float(y) for y in x]


EXACT, TIGHT = ("rk853", "auto", "taylor"), 1e-13


def accuracy(problems):
    """Return for each problem and method the worst relative error of times, and errors of positions."""
    import mbkit as mb

    rows = []
    for name, (model, q, v, duration, truth) in problems.items():
        dyn = mb.dynamics(model, "lagrangian")
        for method in EXACT:
            run = mb.simulate(dyn, q, v, duration, method, rtol=TIGHT, atol=TIGHT / 100)
            found, exact = run.events, truth["events"]
            same = len(found) == len(exact)
            times = [abs(float((e.t - t) / t)) for e, (t, _) in zip(found, exact, strict=False)]
            places = [
                abs(float(a - b)) for e, (_, x) in zip(found, exact, strict=False) for a, b in zip(e.q, x, strict=True)
            ]
            end = max(abs(float(a - b)) for a, b in zip(run.q[-1], truth["end"], strict=True))
            rows.append({"problem": name, "method": method, "phases": len(found), "events_found": same})
            rows[-1] |= {"times": max(times, default=0.0), "places": max(places, default=0.0), "end": end}
            worst = " ".join(f"{rows[-1][what]:8.1e}" for what in ("times", "places", "end"))
            print(f"{name:20} {method:8} {len(found):3} of {len(exact):3} {worst}")
    return rows


#: Of the run on the belt: numbers of steps, and of rk853 tolerances.
STEPS = {
    "moreau": [2000 * 2**i for i in range(6)],
    "semi_implicit_euler": [1000 * 2**i for i in range(4)],
    "rk4": [8000 * 2**i for i in range(4)],
    "gauss6": [2000 * 2**i for i in range(3)],
    "rk853": [10.0**-i for i in range(6, 12)],
}
#: Those that need as many for the block alone; the others carry the rider.
FIRST_ORDER = ("moreau", "semi_implicit_euler")


def orders(alone, ridden):
    """Return the observed order of methods across 51 phases of stick and slip: of the block, or of it with a rider.

    Of rk853 it is the error against the mean step that tolerances make. Moreau's step has the belt's way as a force for
    each step, and a spring at the joint, which is machine code.
    """
    import mbkit as mb

    rows, b = [], mb.ModelBuilder.of(alone[0])
    b.remove("spring")
    b.set_joint("x", stiffness=float(BELT["k"]))
    plain = mb.dynamics(b.build(), "lagrangian")
    for method, settings in STEPS.items():
        model, q, v, duration, truth = alone if method in FIRST_ORDER else ridden
        dyn, points = mb.dynamics(model, "lagrangian"), []
        for x in settings:
            more = {"rtol": x, "atol": x * 1e-2} if method == "rk853" else {"dt": duration / x}
            of = dyn
            if method == "moreau":
                way = float(BELT["speed"]) * duration / x * np.arange(x)
                of, more["torque"] = plain, (-float(BELT["k"]) * way)[:, None]
            run = mb.simulate(of, q, v, duration, method, doubt=False, **more)
            error = abs(float(run.q[-1, 0] - truth["end"][0]))
            points.append([run.stats.steps if method == "rk853" else x, error, len(run.events)])
        steps, errors = (np.array([p[i] for p in points]) for i in (0, 1))
        order = float(-np.polyfit(np.log(steps), np.log(errors), 1)[0])
        rows.append({"method": method, "order": order, "points": points})
        print(f"{method:20} {order:.2f}", *(f"{n}:{e:.1e}({k})" for n, e, k in points))
    return rows


#: Robots, steps of a run, and rounds.
COST = (("double_pendulum", "ur5", "panda", "anymal"), 20_000, 5)


def cost(names, steps, rounds):
    """Return the time of a step of Moreau's beside that of semi_implicit_euler without friction, in one process."""
    import mbkit as mb

    rows = []
    for name in names:
        bare = without_friction(name)
        b, rng = mb.ModelBuilder.of(bare), np.random.default_rng(1)
        dyn = mb.dynamics(bare, "lagrangian")
        weight = np.abs(dyn.gravity(bare.random_state(rng, 50)[0])).max(axis=0)
        for joint in bare.independent_joints:
            if joint.type.nv == 1:
                b.set_joint(joint.name, friction=0.1 * max(float(weight[bare.layout.v[joint.name]][0]), 0.1))
        rubbed = mb.dynamics(b.build(), "lagrangian")
        q, v = bare.neutral(), rng.uniform(-1, 1, bare.nv)
        runs = {"moreau": (rubbed, []), "semi_implicit_euler": (dyn, [])}
        ended = {}
        for _ in range(rounds + 1):
            for method, (of, seconds) in runs.items():
                begun = time.process_time()
                run = mb.simulate(of, q, v, steps * 1e-4, method, dt=1e-4, doubt=False)
                seconds.append(time.process_time() - begun)
                ended[method] = run.stats.ended
        # The first run compiles.
        each = {method: float(np.median(x[1:])) / steps * 1e6 for method, (_, x) in runs.items()}
        ratio = each["moreau"] / each["semi_implicit_euler"]
        rows.append({"model": name, "us_a_step": each, "ratio": ratio, "ended": ended})
        print(f"{name:20} {each} {ratio:.2f} {ended}")
    return rows


def without_friction(name):
    import mbkit as mb

    return mb.catalog.double_pendulum() if name == "double_pendulum" else mb.load(name).without("friction")


#: Robot, trajectories of a batch, variants, steps of one trajectory and of a batch, and rounds.
BATCH = ("ur5", 1000, 200, 20_000, 200, 5)


def batches(name, many, variants, alone, steps, rounds):
    """Return the time of a run by rk4 with friction on all joints over that without, of one trajectory and of many.

    What rests is under twice the friction that its weight needs. What slides is fast, and of one trajectory so short
    that nothing stops. Mixed is friction of 0.3 times the weight, with half of the joints at rest at the start.
    """
    import mbkit as mb

    bare, rows, rng = without_friction(name), [], np.random.default_rng(1)
    plain = mb.dynamics(bare, "lagrangian", threads=1)
    weight = np.maximum(np.abs(plain.gravity(bare.random_state(rng, 50)[0])).max(axis=0), 0.1)

    def rubbed(part, scale=1.0):
        b = mb.ModelBuilder.of(bare)
        for joint in bare.independent_joints:
            f = part * float(weight[bare.layout.v[joint.name]][0])
            b.set_joint(joint.name, friction=f * scale, stiction=1.2 * f * scale)
        return mb.dynamics(b.build(), "lagrangian", threads=1)

    def measure(what, dyn, q, v, steps, dt, model_of_one=None):
        runs, seconds = {}, {"with": [], "without": []}
        for _ in range(rounds + 1):
            for which, of in (("with", dyn), ("without", plain)):
                begun = time.process_time()
                runs[which] = mb.simulate(of, q, v, steps * dt, "rk4", dt=dt, doubt=False)
                seconds[which].append(time.process_time() - begun)
        # The first run compiles.
        each = {which: float(np.median(x[1:])) for which, x in seconds.items()}
        run, row = runs["with"], {"what": what, "trajectories": len(q) if q.ndim == 2 else 1, "steps": steps}
        row |= {"seconds": each, "ratio": each["with"] / each["without"], "events": len(run.events)}
        if q.ndim == 2:
            off = []
            for i in range(0, len(q), max(len(q) // 20, 1)):
                of = dyn if model_of_one is None else model_of_one(i)
                one = mb.simulate(of, q[i], v[i], steps * dt, "rk4", dt=dt, doubt=False)
                off.append(float(np.abs(one.q - run.q[i]).max()))
                assert [e.name for e in one.events] == [e.name for e in run.events if e.member == i]
            row["off_single_runs"] = max(off)
        rows.append(row)
        print(row)

    rest, slide, mixed = rubbed(2.0), rubbed(0.01), rubbed(0.3)
    q, v = bare.random_state(rng)
    measure("one at rest", rest, q, 0 * v, alone, 1e-3)
    # Faster than gravity turns it.
    fast = 6.0 * np.sign(v) + v
    measure("one sliding", slide, q, fast, alone, 1e-2 / alone)
    Q, V = bare.random_state(rng, many)
    half = V * (rng.random(V.shape) > 0.5)
    measure("many at rest", rest, Q, 0 * V, steps, 1e-3)
    measure("many sliding", slide, Q, 6.0 * np.sign(V) + V, steps, 1e-2 / steps)
    measure("many mixed", mixed, Q, half, steps, 1e-4)
    measure("many mixed, often changing", mixed, Q, half, steps, 1e-3)
    scale = mb.Parameter("scale", 1.0)
    size = rng.uniform(0.5, 2.0, variants)
    dyn = rubbed(0.3, scale).at(scale=size)
    measure(
        "variants of friction", dyn, Q[:variants], half[:variants], steps, 1e-3, lambda i: rubbed(0.3, float(size[i]))
    )
    return rows


#: Tolerances, lengths of steps, s, and widths of the smoothed law, rad/s.
RTOLS, LENGTHS = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12), (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
WIDTHS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)


def smoothed(problem, friction):
    """Return errors and times of a two-link arm whose friction is f tanh(v/ε), beside the exact law."""
    import casadi as ca

    import mbkit as mb

    model, q, v, duration, truth = problem
    rows = []

    def measure(law, dyn, method, **settings):
        mb.simulate(dyn, q, v, duration, method, doubt=False, **settings)
        begun = time.process_time()
        run = mb.simulate(dyn, q, v, duration, method, doubt=False, **settings)
        seconds = time.process_time() - begun
        error = max(abs(float(a - b)) for a, b in zip(run.q[-1], truth["end"], strict=True))
        row = {"law": law, "method": method, **settings, "error": error, "seconds": seconds}
        rows.append(row | {"evaluations": run.stats.evaluations, "steps": run.stats.steps})
        print(f"{law:8} {method:8} {settings} {error:8.1e} {seconds * 1e3:8.1f} ms {run.stats.evaluations}")

    exact = mb.dynamics(model, "lagrangian")
    for rtol in RTOLS:
        measure("exact", exact, "rk853", rtol=rtol, atol=rtol)
    for dt in LENGTHS:
        measure("exact", exact, "rk4", dt=dt)
        measure("exact", exact, "moreau", dt=dt)
    for width in WIDTHS:
        b = mb.ModelBuilder.of(model.without("friction"))
        for joint, f in zip(("shoulder", "elbow"), friction, strict=True):
            b.add_joint_force(f"dry {joint}", joint, lambda t, q, v, f=float(f), w=width: -f * ca.tanh(v / w))  # noqa: ARG005
        dyn = mb.dynamics(b.build(), "lagrangian")
        # An implicit method, whose steps the steep law does not bound.
        measure(f"tanh {width:g}", dyn, "rodas5", rtol=1e-8, atol=1e-10)
        if width >= 1e-4:
            measure(f"tanh {width:g}", dyn, "rk853", rtol=1e-8, atol=1e-10)
    return rows


#: See `validation.smoke`.
SMOKE = {
    "PERIODS": 1,
    "PENDULUM": PENDULUM | {"f": mp.mpf(2)},
    "ARM_TIME": mp.mpf("0.1"),
    "EXACT": ("rk853",),
    "TIGHT": 1e-3,
    "STEPS": {"moreau": [20, 40], "rk853": [1e-2, 1e-3]},
    "COST": (("double_pendulum",), 5, 1),
    "BATCH": ("double_pendulum", 3, 2, 20, 5, 1),
    "RTOLS": (1e-3,),
    "LENGTHS": (1e-2,),
    "WIDTHS": (1e-1,),
}


def main():
    problems = described()
    data = {
        "accuracy": accuracy(problems),
        "orders": orders(problems["block on a belt"], problems["block with a rider"]),
    }
    finer = arm(ARM_STEP / 2)
    known = zip(finer["events"], problems["two-link arm"][-1]["events"], strict=True)
    data["arm_known_to"] = max((float(abs(a[0] - b[0])) for a, b in known), default=0.0)
    print("arm known to", data["arm_known_to"])
    data["cost_of_moreau"] = cost(*COST)
    data["batches"] = batches(*BATCH)
    data["smoothed"] = smoothed(problems["two-link arm"], ARM["f"])
    results("friction.json").write_text(json.dumps({**stamp(__file__), **data}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
