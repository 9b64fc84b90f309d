"""Inverse and forward dynamics of batches: what one sample costs on each engine, and how that grows.

Run ``python -m validation.bench_terms`` (several minutes, on an otherwise idle machine); it
writes ``validation/terms.json``, draws ``validation/figures/terms.png`` and ``.svg``, and
prints the README's table. ``--samples 2048 --rounds 3 --most 16`` is a quick try, written
to ``--out``.

What is measured
    Every engine gets the same random states, and results are compared before any clock
    starts. All calls of a robot are timed in turn, round by round, in one process: the
    machine's mood meets all alike, and a ratio is the median over rounds of ratios
    within a round. Damping is taken out, since Pinocchio's algorithms do not know it.

    lagrangian   ``dyn.inverse_dynamics(q, v, a)`` as a user calls it: checks of the
                 arguments and memory for the result are within. "C order" is an ordinary
                 (N, n) array, "coordinate-major" one whose transpose is.
    pinocchio    ``rneaInParallel`` and ``abaInParallel`` with a `ModelPool`, arrays of its
                 own order, the result's memory given.
    mujoco       ``mj_inverse`` and ``mj_forward`` one by one from Python, writing the state
                 included; and one Euler step for every state by ``mujoco.rollout``, which
                 is a forward evaluation and a little more, all in C.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np
import pinocchio as pin

import mbkit as mb
from mbkit._child_process import cores
from mbkit.codegen import jit
from mbkit.codegen.program import program
from mbkit.engines.mujoco import model as mujoco_model
from mbkit.engines.pinocchio import model as pinocchio_model
from mbkit.spatial import conjugate, rotate
from tests.random_trees import random_tree
from validation.stamp import results, stamp

QUANTITIES = ("inverse_dynamics", "forward_dynamics")
#: Name -> how to make it, as Python that a fresh process can run too.
ROBOTS = {
    "double_pendulum": "mb.catalog.double_pendulum()",
    "ur5": "mb.load('ur5')",
    "panda": "mb.load('panda', mimic='free')",
    "talos_reduced": "mb.load('talos_reduced', mimic='free')",
    "anymal_b, floating": "mb.load('anymal_b', floating_base=True)",
    "talos_reduced, floating": "mb.load('talos_reduced', mimic='free', floating_base=True)",
}
#: Engines must agree to this before they are timed, relative to the largest entry.
AGREE = 1e-9
# Python's loop over single calls is slow, and one of its calls costs what the next one does.
LOOPED = 4096
#: Of a round, how many, and fresh processes for a first result.
SAMPLES, ROUNDS, FRESH = 65_536, 15, 3
SIZES = (2, 4, 8, 16, 32, 64, 128)


def made(text):
    # The other engines' algorithms know no damping and no dry friction.
    return eval(text, {"mb": mb}).without("damping", "friction")


# The calls. Each takes nothing, returns (N, nv) or fills it, and says how many samples it does.


def lagrangian_calls(model, quantity, states):
    # One alone, and all of them where there are more.
    engines = {t: mb.dynamics(model, "lagrangian", threads=t) for t in sorted({1, cores()})}
    orders = {"C order": states, "coordinate-major": tuple(np.asfortranarray(x) for x in states)}
    for order, arrays in orders.items():
        for threads, dyn in engines.items():
            call = getattr(dyn, quantity)
            yield f"lagrangian, {order}, {threads}", lambda call=call, arrays=arrays: call(*arrays), len(states[0])


def pinocchio_calls(model, quantity, states):
    built = pinocchio_model.build(model)
    run = pin.rneaInParallel if quantity == "inverse_dynamics" else pin.abaInParallel
    q, v, x = states
    arrays = [np.asfortranarray(y.T) for y in (q[:, built.q_order], v[:, built.v_order], x[:, built.v_order])]
    back = np.argsort(built.v_order)
    for threads in sorted({1, cores()}):
        pool = pin.ModelPool(built.model, threads)
        out = np.empty((model.nv, len(q)), order="F")

        def call(pool=pool, threads=threads, out=out):
            run(threads, pool, *arrays, out)
            return out

        yield f"pinocchio, {run.__name__}, {threads}", (call, lambda call=call: call().T[:, back]), len(q)


def in_world(built, q, x, *, back=False):
    """Return velocities or forces with a free joint's linear part turned into the world's axes, MuJoCo's, or back."""
    x = x.copy()
    for iq, iv in built.free:
        turn = np.roll(q[: len(x), iq + 3 : iq + 7], -1, axis=1)
        x[:, iv : iv + 3] = rotate(conjugate(turn) if back else turn, x[:, iv : iv + 3])
    return x


def centripetal(built, v):
    """Return ω × v of free joints: in their own axes the velocity turns with the body."""
    out = np.zeros_like(v)
    for _, iv in built.free:
        out[:, iv : iv + 3] = np.cross(v[:, iv + 3 : iv + 6], v[:, iv : iv + 3])
    return out


def mujoco_calls(model, quantity, states):
    built = mujoco_model.build(model)
    m, back = built.model, np.argsort(built.v_index)
    d = mujoco.MjData(m)
    q, v, x = states
    q, v, x = q[:, built.q_index], v[:, built.v_index], x[:, built.v_index]
    few = min(LOOPED, len(q))
    out = np.empty((few, model.nv))
    inverse = quantity == "inverse_dynamics"
    moved = centripetal(built, v)
    v, x = in_world(built, q, v), in_world(built, q, x + moved if inverse else x)

    def own(y):
        """Return what came out in the description's axes and order."""
        y = in_world(built, q, y, back=True)
        return (y if inverse else y - moved[: len(y)])[:, back]

    evaluate = mujoco.mj_inverse if inverse else mujoco.mj_forward
    given, result = (d.qacc, d.qfrc_inverse) if inverse else (d.qfrc_applied, d.qacc)

    def loop():
        for k in range(few):
            d.qpos[:], d.qvel[:], given[:] = q[k], v[k], x[k]
            evaluate(m, d)
            out[k] = result
        return out

    yield f"mujoco, {evaluate.__name__} from Python, 1", (loop, lambda: own(loop())), few
    if inverse:
        return
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros((len(q), mujoco.mj_stateSize(m, full)))
    start[:, 1 : 1 + m.nq], start[:, 1 + m.nq : 1 + m.nq + m.nv] = q, v
    after = np.empty((len(q), 1, start.shape[1]))
    force = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
    m.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for threads in sorted({1, cores()}):
        datas = [mujoco.MjData(m) for _ in range(threads)]
        runner = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

        def step(runner=runner, datas=datas):
            runner.rollout(m, datas, start, x[:, None], control_spec=force, nstep=1, state=after)

        def acceleration(step=step):
            step()
            return own((after[:, 0, 1 + m.nq : 1 + m.nq + m.nv] - v) / m.opt.timestep)

        yield f"mujoco, step by rollout, {threads}", (step, acceleration), len(q)


def calls_of(model, quantity, states):
    """Return the calls by label, after a comparison of their results, and the worst difference of each."""
    calls, apart, reference = {}, {}, None
    for engine in (lagrangian_calls, pinocchio_calls, mujoco_calls):
        for label, call, n in engine(model, quantity, states):
            timed, shown = call if isinstance(call, tuple) else (call, call)
            result = np.array(shown())
            reference = result if reference is None else reference
            worst = np.abs(result - reference[:n]).max(axis=1) / np.abs(reference[:n]).max(axis=1)
            apart[label] = float(worst.max())
            # A step gives the acceleration as a small difference of velocities.
            if apart[label] > (1e-5 if "rollout" in label else AGREE):
                raise SystemExit(f"{model.name} {quantity}: {label} is off by {apart[label]:.1e}; nothing was timed")
            calls[label] = timed, n
    return calls, apart


def timed(calls, rounds):
    """Return each call's times per sample in ns, one a round."""
    times = {label: [] for label in calls}
    for call, _ in calls.values():
        call()
    for _ in range(rounds):
        for label, (call, n) in calls.items():
            begun = time.perf_counter()
            call()
            times[label].append((time.perf_counter() - begun) / n * 1e9)
    return {label: np.array(x) for label, x in times.items()}


def summary(times):
    low, median, high = np.percentile(times, [25, 50, 75])
    return {"median": float(median), "spread": float(high - low) / 2, "least": float(times.min())}


def states_of(model, n, seed=0):
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng, n)
    return q, v, rng.standard_normal((n, model.nv))


def operations(function):
    """Return what one evaluation computes, counted by kind; a sine is one operation."""
    counted = Counter(o.name for o in program(function).operations)
    return {name: n for name, n in counted.most_common() if name not in ("input", "const")}


# Time to the first result.

FIRST = """
import sys, time
import numpy as np
import mbkit as mb
model = {make}.without("damping", "friction")
q, v = model.random_state(np.random.default_rng(0))
begun = time.perf_counter()
getattr(mb.dynamics(model, "lagrangian"), {quantity!r})(q, v, np.zeros(model.nv))
print(time.perf_counter() - begun)
"""


def first_result(name, quantity, repetitions):
    """Return the seconds from `mb.dynamics` to the first result in fresh processes: nothing cached, then cached."""
    cold, warm = [], []
    for _ in range(repetitions):
        with tempfile.TemporaryDirectory() as folder:
            environment = os.environ | {"MBKIT_CACHE_DIR": folder}
            code = FIRST.format(make=ROBOTS[name], quantity=quantity)
            for seconds in (cold, warm):
                run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
                if run.returncode:
                    raise SystemExit(run.stderr)
                seconds.append(float(run.stdout))
    return {"cold_s": float(np.median(cold)), "warm_s": float(np.median(warm))}


def robots(samples, rounds, names):
    out = []
    for name in names:
        model = made(ROBOTS[name])
        for quantity in QUANTITIES:
            calls, apart = calls_of(model, quantity, states_of(model, samples))
            times = timed(calls, rounds)
            counted = operations(mb.dynamics(model, "lagrangian").function(quantity))
            row = {"robot": name, "nv": model.nv, "quantity": quantity, "operations": counted}
            row["ns"] = {label: summary(x) | {"difference": apart[label]} for label, x in times.items()}
            theirs = {
                threads: next(x for label, x in times.items() if label.startswith("pin") and label.endswith(threads))
                for threads in {label.rsplit(", ", 1)[1] for label in times if label.startswith("pin")}
            }
            row["times_as_fast_as_pinocchio"] = {
                label: float(np.median(theirs[label.rsplit(", ", 1)[1]] / x))
                for label, x in times.items()
                if label.startswith("lagrangian")
            }
            row["first_result"] = first_result(name, quantity, FRESH)
            out.append(row)
            told = "  ".join(f"{label} {x['median']:.1f}" for label, x in row["ns"].items())
            print(f"{name} {quantity}: {told}", file=sys.stderr, flush=True)
    return out


# Growth.


def systems(most):
    """Yield the kind, the number of joints and the model of chains in a plane and of branched trees in space."""
    for n in (n for n in SIZES if n <= most):
        yield "chain", n, mb.catalog.chain(n=n)
    for n in (n for n in SIZES if n <= most):
        yield "tree", n, random_tree(n, n, ("revolute", "prismatic"), springs=False, damping=False, armature=False)


def growth(samples, rounds, systems):
    """Return ns per sample and seconds to derive and compile, on one thread, against the number of joints."""
    # Nothing may come from the disk.
    os.environ["MBKIT_CACHE_DIR"] = ""
    out = []
    for kind, n, model in systems:
        few = max(64, samples // n)
        for quantity in QUANTITIES:
            states = states_of(model, few)
            columns = tuple(np.asfortranarray(x) for x in states)
            # The first call of all pays for a compiler's start, which is not this system's.
            dyn = mb.dynamics(model, "lagrangian", threads=1)
            run = getattr(dyn, quantity)
            begun = time.perf_counter()
            run(*(x[0] for x in states))
            seconds = time.perf_counter() - begun
            _, call, _ = next(pinocchio_calls(model, quantity, states))
            calls = {
                "lagrangian": (lambda run=run, s=states: run(*s), few),
                "lagrangian, coordinate-major": (lambda run=run, s=columns: run(*s), few),
                "pinocchio": (call[0], few),
            }
            times = timed(calls, rounds)
            row = {"kind": kind, "n": n, "quantity": quantity, "samples": few, "derive_and_compile_s": seconds}
            row["operations"] = sum(operations(dyn.function(quantity)).values())
            row["ns"] = {name: summary(x) for name, x in times.items()}
            row["times_as_fast_as_pinocchio"] = {
                name: float(np.median(times["pinocchio"] / x)) for name, x in times.items() if name != "pinocchio"
            }
            out.append(row)
            print(f"{kind} {n} {quantity}: {seconds:.2f} s", row["ns"], file=sys.stderr, flush=True)
    return out


def exponent(rows, value):
    """Return the exponent of growth, by least squares over the last three sizes."""
    points = np.array([(r["n"], value(r)) for r in rows])[-3:]
    return float(np.polyfit(*np.log(points).T, 1)[0]) if len(points) > 1 else None


def exponents(rows):
    """Return the exponents of each kind of system and quantity."""
    out = {}
    for kind, quantity in dict.fromkeys((r["kind"], r["quantity"]) for r in rows):
        own = [r for r in rows if (r["kind"], r["quantity"]) == (kind, quantity)]
        out[f"{kind}, {quantity}"] = {
            "operations": exponent(own, lambda r: r["operations"]),
            "ns": exponent(own, lambda r: r["ns"]["lagrangian"]["median"]),
            "derive_and_compile_s": exponent(own, lambda r: r["derive_and_compile_s"]),
        }
    return out


# What is shown.


def table(data):
    """Return the README's table."""
    threads = data["threads"]
    head = ["robot (velocities)", "operations", "1 thread", "coordinate-major"]
    head += [f"{threads} threads"] if threads > 1 else []
    head += ["Pinocchio, 1 thread", "ratio", "MuJoCo", "first result, cold", "cached"]
    lines = []
    for quantity in QUANTITIES:
        lines += [f"{quantity.replace('_', ' ').capitalize()}, ns per sample", "", "| " + " | ".join(head) + " |"]
        lines.append("|---|" + "---:|" * (len(head) - 1))
        for row in data["robots"]:
            if row["quantity"] != quantity:
                continue
            ns = {label: x["median"] for label, x in row["ns"].items()}
            theirs = next(x for label, x in ns.items() if label.startswith("pin") and label.endswith(", 1"))
            step = next(
                x
                for label, x in ns.items()
                if label.startswith("mujoco") and ("rollout" in label or "inverse" in label)
            )
            cells = [f"{row['robot']} ({row['nv']})", str(sum(row["operations"].values()))]
            cells += [f"{ns['lagrangian, C order, 1']:.3g}", f"{ns['lagrangian, coordinate-major, 1']:.3g}"]
            cells += [f"{ns[f'lagrangian, C order, {threads}']:.3g}"] if threads > 1 else []
            cells += [f"{theirs:.4g}", f"{row['times_as_fast_as_pinocchio']['lagrangian, C order, 1']:.3g}"]
            cells += [f"{step:.4g}", *(f"{row['first_result'][k]:.2f} s" for k in ("cold_s", "warm_s"))]
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


#: See `validation.smoke`.
SMOKE = {
    "ROBOTS": {"two links": "mb.catalog.double_pendulum()"},
    "SIZES": (2,),
    "SAMPLES": 64,
    "ROUNDS": 1,
    "FRESH": 1,
}


#: The level of x86-64 without AVX-512.
NARROWER = "x86-64-v3"


def narrower(robots, samples, rounds):
    """Return ratios to Pinocchio where registers hold half as many doubles: in a process that is told so.

    None on a processor whose registers hold no more.
    """
    if jit.host().width <= jit.LEVELS[NARROWER][1]:
        return None
    code = "import json, sys; from validation import bench_terms as b; given = json.loads(sys.argv[1]); "
    command = [
        sys.executable,
        "-c",
        code + "print(json.dumps(b.ratios(*given)))",
        json.dumps([robots, samples, rounds]),
    ]
    own = {"MBKIT_CPU": NARROWER, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(command, env=os.environ | own, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(run.stdout.splitlines()[-1])


def ratios(robots, samples, rounds):
    """Return how many times as fast as Pinocchio the own derivation is here: one thread, C order."""
    rows = []
    for name, make in robots.items():
        model = made(make)
        for quantity in QUANTITIES:
            states = states_of(model, samples)
            (_, own, n), (_, (theirs, _), m) = (
                next(calls(model, quantity, states)) for calls in (lagrangian_calls, pinocchio_calls)
            )
            times = timed({"own": (own, n), "theirs": (theirs, m)}, rounds)
            ratio = float(np.median(times["theirs"] / times["own"]))
            rows.append({"robot": name, "quantity": quantity, "times_as_fast_as_pinocchio": ratio})
    return {"simd": stamp(__file__)["simd"], "robots": rows}


def main():
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--samples", type=int, default=SAMPLES)
    asked.add_argument("--rounds", type=int, default=ROUNDS)
    asked.add_argument("--most", type=int, default=SIZES[-1], help="joints of the largest chain and tree")
    asked.add_argument("--robots", nargs="*", default=list(ROBOTS))
    asked.add_argument("--out", type=Path, default=results(""))
    given = asked.parse_args()
    load = os.getloadavg()[0]
    if load > 0.3:
        print(f"others are at work here (load {load:.2f}): the numbers will not hold", file=sys.stderr)
    data = {
        "load": load,
        "samples": given.samples,
        "rounds": given.rounds,
        "threads": cores(),
        **stamp(__file__),
        "robots": robots(given.samples, given.rounds, given.robots),
    }
    data["narrower"] = narrower({name: ROBOTS[name] for name in given.robots}, given.samples, given.rounds)
    data["growth"] = growth(given.samples, given.rounds, systems(given.most))
    data["exponents"] = exponents(data["growth"])
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "terms.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    from validation.terms_figure import draw

    draw(data, given.out / "figures")
    print(table(data))


if __name__ == "__main__":
    main()
