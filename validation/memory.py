"""Memory that models leave behind when they are released, by stage of a compilation and by use.

Run ``python -m validation.memory`` (14 minutes of processor time; ``--models 200`` for a first look).
Each case has a process of its own. It makes one model after another, a double pendulum with other
numbers each time, uses it and releases it. Twenty times on the way the resident memory is read, and
what the C library's allocator has handed out and not got back, which holes in the heap do not hide.
Reported are the slopes of straight lines through the second half of the readings: caches of bounded
size, such as heyoka's of 64 MiB, fill in the first half. The stages of a compilation stand alone:
each case takes one more than that before it, and loading takes one object file again and again.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import multiprocessing
import os
import resource
import tempfile
import time
import warnings
from functools import cache
from pathlib import Path

import numpy as np

from validation.stamp import results, stamp

READINGS, MODELS = 20, 2000
#: All of them.
CHOSEN = None
Q, V = np.array([0.1, 0.2]), np.zeros(2)


def fresh(rng):
    import mbkit as mb

    return mb.catalog.double_pendulum(length1=float(rng.uniform(0.5, 2)), mass1=float(rng.uniform(0.5, 2)))


def engine(name, **options):
    """Return a case: one evaluation of forward dynamics."""

    def use(model):
        import mbkit as mb

        mb.dynamics(model, name, **options).forward_dynamics(Q, V, V)

    return use


def run(method, **options):
    """Return a case: a run of 0.1 s on the own derivation."""

    def use(model):
        import mbkit as mb

        mb.simulate(mb.dynamics(model, "lagrangian"), Q, V, 0.1, method=method, **options)

    return use


def graph(model):
    from mbkit.engines.lagrangian import equations_of

    return equations_of(model).function("forward_dynamics")


def llvm_text(model):
    from mbkit.codegen import jit, program, simd_kernel

    return simd_kernel.vector_code(program.program(graph(model)), jit.host().width)[0]


def object_code(*, optimize):
    def use(model):
        from mbkit.codegen import jit

        jit.object_code(llvm_text(model), optimize=optimize)

    return use


@cache
def objects():
    """Return the object files of one kernel and of the loop over a batch."""
    from mbkit.codegen import jit

    return jit.object_code(llvm_text(fresh(np.random.default_rng(1)))), jit.batch_object()


def load(_model):
    from mbkit.codegen import jit

    jit.load(*objects())


def from_disk(_model):
    """Compile one function at the first call; fetch its machine code from disk at the others; evaluate it."""
    import mbkit as mb

    if not os.environ["MBKIT_CACHE_DIR"]:
        os.environ["MBKIT_CACHE_DIR"] = tempfile.mkdtemp()
    mb.dynamics(fresh(np.random.default_rng(1)), "lagrangian", compile=True).gravity(Q)


CASES = {
    "model": lambda model: model.digest,
    "graph": graph,
    "LLVM text": llvm_text,
    "object code": object_code(optimize=False),
    "object code, with LLVM's passes": object_code(optimize=True),
    "load": load,
    "from disk": from_disk,
    "compiled": engine("lagrangian", compile=True),
    "interpreted": engine("lagrangian", compile=False),
    "pinocchio": engine("pinocchio"),
    "mujoco": engine("mujoco"),
    "rk4": run("rk4", dt=0.01),
    "rk853": run("rk853"),
    "taylor": run("taylor"),
}


def resident():
    """Return the resident memory of this process, kB."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1000


class _Mallinfo(ctypes.Structure):
    """glibc's ``struct mallinfo2``."""

    _names = ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    _fields_ = [(name, ctypes.c_size_t) for name in _names]


def allocated():
    """Return the kB that glibc's allocator has handed out and not got back, or None without glibc 2.33."""
    read = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if read is None:
        return None
    read.restype = _Mallinfo
    gc.collect()
    now = read()
    return (now.uordblks + now.hblkhd) / 1000


def slope(models, kilobytes):
    """Return kB per model, by least squares over the second half of the readings."""
    half = len(models) // 2
    return float(np.polyfit(models[half:], kilobytes[half:], 1)[0])


def measure(name, count):
    """Use and release `count` models; return the readings and their slopes."""
    from mbkit.codegen import backend

    warnings.simplefilter("ignore")
    # Derived functions of some 5,000 such models stay in memory. A tenth of that is full in the first half.
    backend._DERIVED._most //= 10
    rng = np.random.default_rng(0)
    done, readings, live = [], [], []
    start = time.process_time()
    for k in range(1, count + 1):
        CASES[name](fresh(rng))
        if k % max(1, count // READINGS) == 0:
            done.append(k)
            live.append(allocated())
            readings.append(resident())
    return {
        "case": name,
        "models": count,
        "kB_per_model": slope(done, readings),
        "allocated_kB_per_model": None if None in live else slope(done, live),
        "first_MB": readings[0] / 1000,
        "last_MB": readings[-1] / 1000,
        "resident_MB": [round(x / 1000, 2) for x in readings],
        "processor_s": time.process_time() - start,
    }


#: See `validation.smoke`.
SMOKE = {"MODELS": 4, "CHOSEN": ("graph",)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", type=int, default=MODELS)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CHOSEN or CASES))
    asked = parser.parse_args()
    # Nothing comes from disk: each model is compiled.
    os.environ["MBKIT_CACHE_DIR"] = os.environ["HEYOKA_CACHE_DIR"] = ""
    path = results("memory.json")
    rows = {row["case"]: row for row in json.loads(path.read_text())["rows"]} if path.exists() else {}
    context = multiprocessing.get_context("spawn")
    for name in asked.cases:
        with context.Pool(1) as pool:
            row = rows[name] = pool.apply(measure, (name, asked.models))
        print(f"{name:32} {row['kB_per_model']:8.2f} kB a model  {row['first_MB']:6.0f} to {row['last_MB']:.0f} MB")
        whole = {"rows": [rows[case] for case in CASES if case in rows], **stamp(__file__)}
        path.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
