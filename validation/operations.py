"""Scalar operations of each form of the dynamics, and the share of the processor's vector units that they fill.

Run ``python -m validation.operations`` on an otherwise idle machine; it writes ``validation/operations.json`` and
draws ``validation/figures/operations.svg``. ``--samples 2048 --rounds 3 --most 16 --out FOLDER`` is a quick try.

What is counted
    Operations of one evaluation of inverse dynamics, M and forward dynamics, after repeated ones are merged; a sine is
    one. The forms are those of `FORMS`.

What is measured
    ns per sample of the compiled kernels on one thread, over a batch of C-ordered arrays that is evaluated again and
    again without Python in between: from the energies, and the form that mbkit chooses. Beside them Pinocchio's RNEA
    and ABA over one large batch, one thread, and its CRBA in a loop from Python, which pays for the loop. Beside all,
    the limit of the vector units: independent chains of fused multiply-adds in registers, two operations each. All are
    timed in turn, round by round; a share or a ratio is the median over the rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin

import mbkit as mb
from mbkit.codegen import jit
from mbkit.codegen.batch_loop import RUN
from mbkit.codegen.compiled import Call, KernelSequence
from mbkit.derivation import FUNCTIONS, Equations, LinkEquations, elimination_of
from mbkit.derivation.gauss_elimination import GaussElimination
from mbkit.derivation.model_values import scalar
from mbkit.engines.pinocchio import model as pinocchio_model
from tests.random_trees import random_tree
from validation import bench_terms
from validation.stamp import results, stamp

ROBOTS = {name: make for name, make in bench_terms.ROBOTS.items() if name != "double_pendulum"} | {
    "tiago_dual": "mb.load('tiago_dual', mimic='free')"
}
#: Name -> where the numbers come from.
FORMS = {
    "energies": "derivatives of T and V; forward dynamics by LᵀDL of M",
    "links": "link by link, in the description's own frames and constants; all accelerations eliminated",
    "regrouped": "the same, in frames along common normals, with matter that no motion tells apart moved to parents",
    "M and factors": "regrouped; no acceleration eliminated: M by composite bodies, and its LᵀDL",
    "chosen": "what mbkit compiles by default",
}
SIZES = (2, 4, 8, 16, 32, 64, 128, 256)
#: Samples of a kernel's batch, few enough for the second cache, and of all that a round evaluates.
BATCH, SAMPLES, ROUNDS = 256, 65_536, 21
#: Chains of multiply-adds: as many as hide their latency, and few enough for the registers.
CHAINS, TURNS = 12, 100_000


def expressions(model):
    """Yield (quantity, form, equations, expression)."""
    energies = Equations(model)
    chosen = LinkEquations(model, elimination=elimination_of(model))
    links = LinkEquations(model, elimination="links")
    frames = {"links": links.plain, "regrouped": links.mechanics}
    for quantity in ("inverse_dynamics", "mass_matrix"):
        for form, equations in (("energies", energies), ("chosen", chosen)):
            yield quantity, form, equations, getattr(equations, quantity)
    a = [scalar(links.a[i]) for i in range(model.nv)]
    for form, mechanics in frames.items():
        yield "inverse_dynamics", form, links, ca.vertcat(*(ca.SX(x) for x in mechanics.forces(a))) - links.passive
        M = ca.SX(model.nv, model.nv)
        for (i, j), x in GaussElimination(mechanics, range(model.nv)).rest.items():
            M[i, j] = M[j, i] = x
        yield "mass_matrix", form, links, M
    quantity = "forward_dynamics"
    yield quantity, "energies", energies, energies.forward_dynamics
    for form, mechanics in frames.items():
        yield quantity, form, links, links._reduced(mechanics, ())
    yield quantity, "M and factors", links, links._reduced(links.mechanics, links.elimination_order)
    yield quantity, "chosen", chosen, chosen.forward_dynamics


def carried(model):
    """Return how many velocities the chosen forward dynamics carries to the root; None where it is no such form."""
    equations = LinkEquations(model, elimination=elimination_of(model))
    if equations.elimination != "links":
        return None
    size = ca.n_nodes(equations.forward_dynamics)
    forms = {c: ca.n_nodes(equations._reduced(equations.mechanics, c)) for c in ((), *equations._carried())}
    return next((len(c) for c, n in forms.items() if n == size), None)


def short(model):
    """Return whether the chosen forward dynamics is in short frames, with matter moved."""
    return carried(model) is not None


def counted(model):
    """Return {quantity: {form: {operation: number}}}."""
    out = {}
    for quantity, form, equations, expression in expressions(model):
        symbols = {"q": equations.q, "v": equations.v, "a": equations.a, "tau": equations.tau}
        names = FUNCTIONS[quantity]
        function = equations.named(quantity, names, [symbols[n] for n in names], expression)
        out.setdefault(quantity, {})[form] = bench_terms.operations(function)
    return out


# The limit of the vector units.


def limit():
    """Return a call of multiply-adds that touch no memory, and how many operations it does."""
    width = jit.host().width
    V, names = f"<{width} x double>", [f"start{k}" for k in range(CHAINS)]
    # All numbers are read, so that the compiler knows nothing of them.
    reads = "\n".join(
        f"  %p_{name} = getelementptr {V}, ptr %numbers, i64 {k}\n  %{name} = load {V}, ptr %p_{name}, align 8"
        for k, name in enumerate(["a", "b", *names])
    )
    first = "\n".join(f"  %x{k} = phi {V} [ %{name}, %entry ], [ %y{k}, %turn ]" for k, name in enumerate(names))
    turn = "\n".join(f"  %y{k} = call {V} @llvm.fma.v{width}f64({V} %x{k}, {V} %a, {V} %b)" for k in range(CHAINS))
    sums = "\n".join(f"  %sum{k} = fadd {V} %{f'sum{k - 1}' if k else 'a'}, %y{k}" for k in range(CHAINS))
    text = f"""
declare {V} @llvm.fma.v{width}f64({V}, {V}, {V})
define void @{RUN}(ptr %numbers, ptr %out, i64 %first, i64 %last) nounwind {{
entry:
{reads}
  br label %turn
turn:
  %i = phi i64 [ %first, %entry ], [ %next, %turn ]
{first}
{turn}
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %last
  br i1 %more, label %turn, label %done
done:
{sums}
  store {V} %sum{CHAINS - 1}, ptr %out, align 8
  ret void
}}
"""
    loaded = jit.load(jit.object_code(text))
    # x/2 + 1/2 stays at 1.
    numbers, out = np.repeat([0.5, 0.5, *[1.0] * CHAINS], width), np.empty(width)

    def call():
        loaded.run(numbers.ctypes.data, out.ctypes.data, 0, TURNS)

    call()
    if not (out == CHAINS + 0.5).all():
        raise SystemExit(f"the vector units' limit: expected {CHAINS + 0.5}, got {out}")
    return call, 2 * width * CHAINS * TURNS


# Times.


def kernel(model, quantity, states, elimination):
    """Return the call of a compiled kernel, a batch again and again, and its results, (BATCH, entries)."""
    code = mb.dynamics(model, "lagrangian", threads=1, elimination=elimination)._code(quantity)
    out = np.empty((BATCH, int(np.prod(code.shapes[0]))))
    times = len(states[0]) // BATCH
    sequence = KernelSequence([Call(code, [x[:BATCH] for x in states], [out])])
    return lambda: sequence.run(0, times), out


def crba(model, q):
    """Return a loop over `pinocchio.crba` from Python, and a function of the last state's M."""
    built = pinocchio_model.build(model)
    data, own, order = built.model.createData(), q[:, built.q_order], np.argsort(built.v_order)

    def loop():
        for x in own:
            pin.crba(built.model, data, x)

    def last():
        upper = np.triu(data.M)
        return (upper + np.triu(upper, 1).T)[np.ix_(order, order)].ravel()

    return loop, last


def calls_of(model, quantity, samples):
    """Return the calls of a quantity by label, after a comparison of one result."""
    states = bench_terms.states_of(model, samples)
    arguments = states[: len(FUNCTIONS[quantity])]
    calls, results = {}, {}
    for label, elimination in (("energies", "mass matrix"), ("chosen", None)):
        call, out = kernel(model, quantity, arguments, elimination)
        call()
        calls[label], results[label] = (call, samples), out[-1]
    if quantity == "mass_matrix":
        loop, last = crba(model, states[0][:BATCH])
        loop()
        calls["pinocchio, crba from Python"], results["pinocchio"] = (loop, BATCH), last()
    else:
        label, (call, shown), _ = next(bench_terms.pinocchio_calls(model, quantity, states))
        calls[label.removesuffix(", 1")], results["pinocchio"] = (call, samples), shown()[BATCH - 1]
    scale = np.abs(results["chosen"]).max()
    for label, x in results.items():
        if (apart := np.abs(x - results["chosen"]).max() / scale) > bench_terms.AGREE:
            raise SystemExit(f"{model.name} {quantity}: {label} is off by {apart:.1e}; nothing was timed")
    return calls


def robot(name, make, samples, rounds, unit):
    model = bench_terms.made(make)
    row = {"robot": name, "nv": model.nv, "regrouped": short(model), "carried": carried(model), "quantities": {}}
    for quantity, forms in counted(model).items():
        calls = calls_of(model, quantity, samples)
        times = bench_terms.timed(calls | {"limit": unit}, rounds)
        ns = {label: bench_terms.summary(x) for label, x in times.items() if label != "limit"}
        shares = {
            form: float(np.median(times["limit"] * sum(forms[form].values()) / times[form]))
            for form in ("energies", "chosen")
        }
        theirs = next(x for label, x in times.items() if label.startswith("pinocchio"))
        row["quantities"][quantity] = {
            "operations": forms,
            "ns": ns,
            "share_of_limit": shares,
            "times_as_fast_as_energies": float(np.median(times["energies"] / times["chosen"])),
            "times_as_fast_as_pinocchio": float(np.median(theirs / times["chosen"])),
            "operations_per_ns_limit": float(np.median(1 / times["limit"])),
        }
        shown = ", ".join(f"{form} {sum(x.values())}" for form, x in forms.items())
        print(f"{name} {quantity}: {shown}; ns", {k: round(x["median"], 1) for k, x in ns.items()}, shares, flush=True)
    return row


def systems(most):
    """Yield the kind, the number of joints and the model: chains in a plane and in space, and trees."""
    bare = {"springs": False, "damping": False, "armature": False}
    for n in (n for n in SIZES if n <= most):
        yield "chain", n, mb.catalog.chain(n=n)
    for n in (n for n in SIZES if n <= most):
        yield "chain in space", n, random_tree(0, n, kinds=("revolute",), nearest=1, **bare)
    for n in (n for n in SIZES if n <= most):
        yield "tree", n, random_tree(n, n, ("revolute", "prismatic"), **bare)


#: See `validation.smoke`.
SMOKE = {
    "ROBOTS": {"two links": "mb.catalog.double_pendulum()"},
    "SIZES": (2,),
    "BATCH": 8,
    "SAMPLES": 64,
    "ROUNDS": 1,
    "TURNS": 10,
    "MBKIT_COMPILE": "1",
}


def main():
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--samples", type=int, default=SAMPLES)
    asked.add_argument("--rounds", type=int, default=ROUNDS)
    asked.add_argument("--most", type=int, default=SIZES[-1], help="joints of the largest chain and tree")
    asked.add_argument("--robots", nargs="*", default=list(ROBOTS), choices=ROBOTS)
    asked.add_argument("--out", type=Path, default=results(""))
    given = asked.parse_args()
    if (load := os.getloadavg()[0]) > 0.3:
        print(f"others are at work here (load {load:.2f}): the times will not hold", file=sys.stderr)
    unit = limit()
    data = {
        "load": load,
        "samples": given.samples,
        "rounds": given.rounds,
        "width": jit.host().width,
        **stamp(__file__),
        "forms": FORMS,
        "robots": [robot(name, ROBOTS[name], given.samples, given.rounds, unit) for name in given.robots],
        "growth": bench_terms.growth(given.samples, given.rounds, systems(given.most)),
    }
    data["exponents"] = bench_terms.exponents(data["growth"])
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "operations.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    from validation.operations_figure import draw

    draw(data, given.out / "figures")


if __name__ == "__main__":
    main()
