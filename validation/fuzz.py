"""Random and damaged files, and random trees: what becomes of each, counted by outcome.

Run ``python -m validation.fuzz [count [trees [minutes]]]``; it writes ``validation/fuzz.json``. By default there are
10,000 damaged copies of 18 robots' files, 10,000 random MJCFs and 165 random trees, in about ten minutes of one core.
With a number of minutes each of the three parts ends after a third of them, and the table holds how many were done.

- A damaged file is refused with an error of mbkit's, or its model is that of the engine whose format it is, where
  that engine reads the same bytes: MuJoCo's compiler for MJCF, Pinocchio's parser for URDF.
- M, nle and the passive forces of a random MJCF are those of MuJoCo's compiler.
- M and nle of a random tree of every joint kind, by the own derivation and by Pinocchio, are those of the
  Newton–Euler recursion of `validation.newton_euler` in 45 digits.

Anything else is a failure: another exception, a value that is not finite, a difference that has no reason, a
process that ends or takes more than a minute. Exit status 1 if there is one.
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from collections import Counter
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin

import mbkit as mb
from mbkit._child_process import WorkerDiedError, WorkerTimeoutError
from mbkit.engines.mujoco.mjcf_writer import mjcf_text
from mbkit.errors import MbkitError, MbkitWarning, UnsupportedError
from mbkit.studies.worker import Worker, describe
from tests.random_files import EPS, errors, mujoco_terms, mutant, random_mjcf
from tests.random_trees import ALL, random_tree, states
from validation import newton_euler
from validation.plain_model import plain
from validation.stamp import results, stamp

URDFS = ("double_pendulum", "asr_twodof", "finger_edu", "so100", "ur5", "panda", "borinot", "hextilt")
URDFS += ("simple_humanoid", "kinova")
WRITTEN = ("ur5", "z1", "solo12")
GENERATED = (11, 12, 14, 16, 20)
#: In units of eps times the number of velocities and the largest entry.
ROUNDING = 1e3
#: Of damaged files, whose numbers span many decades.
COARSE = 1e-6
#: Seconds for one file.
PATIENCE = 60.0
#: Files of each kind, and trees.
COUNT, TREES = 10_000, 165
ALONE = "Pinocchio alone holds the model"
#: How the outcomes begin that may be; every other one is a failure.
GOOD = {
    "mutants": ("agrees", "refused", "MuJoCo alone refuses", "Pinocchio alone refuses", ALONE, "differs: "),
    "random MJCFs": ("agrees", "MuJoCo refuses"),
    "random trees": ("agrees",),
}


@cache
def bases() -> dict[str, bytes]:
    """Return the files that are damaged: name with suffix -> content."""
    out = {f"{name}.urdf": path_of(name).read_bytes() for name in URDFS}
    out |= {f"{name}.xml": mjcf_text(mb.load(name), "").encode() for name in WRITTEN}
    return out | {f"random{seed}.xml": random_mjcf(seed).encode() for seed in GENERATED}


def path_of(name: str) -> Path:
    """Return the file of a robot, by the first name that has this in it."""
    names = {r.name: r.path for r in mb.robots()}
    return names[min((n for n in names if name in n.split("/")[-1] or name in n), key=len)]


def mjcf_outcome(seed: int, folder: Path) -> str:
    """Return what becomes of a random MJCF."""
    text, path = random_mjcf(seed), folder / "random.xml"
    path.write_text(text, encoding="utf-8")
    made = mjcf_judged(path, "error", seed, ROUNDING)
    if made.startswith("refused"):
        try:
            mujoco_terms(text, 1, seed)
        except ValueError:
            return "MuJoCo refuses"
    return made


def mutant_outcome(seed: int, folder: Path, files: dict[str, bytes]) -> str:
    """Return the kind of damage and what becomes of a damaged file."""
    name = list(files)[seed // 5 % len(files)]
    kind, text = mutant(files[name], seed)
    path = folder / f"mutant{Path(name).suffix}"
    path.write_bytes(text)
    policy = ("error", "warn")[seed % 2]
    judged = mjcf_judged if path.suffix == ".xml" else urdf_judged
    return f"{path.suffix[1:]} {kind}: {judged(path, policy, seed, COARSE / EPS)}"


def loaded(path: Path, policy: str) -> mb.Model:
    """Load a file; no warning but mbkit's own may arise."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", MbkitWarning)
        return mb.load(path, nonphysical=policy, mimic="free")


def values(model: mb.Model, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...] | str:
    """Return M, nle and passive by Pinocchio, or the outcome where they are not finite."""
    # What is read beside it has dry friction in no term.
    dyn = mb.dynamics(model.without("friction"))
    out = dyn.mass_matrix(q), dyn.nle(q, v), dyn.passive(q, v)
    return out if all(np.isfinite(x).all() for x in out) else "not finite"


def outcome(judge):
    """Turn whatever a judge raises into an outcome."""

    def judged(path: Path, policy: str, seed: int, tolerance: float) -> str:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                return judge(path, policy, seed, tolerance)
            except MbkitError as error:
                return f"refused: {type(error).__name__}"
            except Exception as error:
                return f"raised {type(error).__name__}: {str(error)[:80]}"

    return judged


@outcome
def mjcf_judged(path: Path, policy: str, seed: int, tolerance: float) -> str:
    """Compare what mbkit reads in an MJCF with MuJoCo's compiler."""
    model = loaded(path, policy)
    try:
        reference = mujoco_terms(path.read_text(encoding="utf-8-sig"), 2, seed)
    except (ValueError, mujoco.FatalError):
        made = engines_judged(model, seed)
        return "MuJoCo alone refuses" if made in ("agrees", ALONE) else made
    if reference.v.shape[1] != model.nv or reference.q.shape[1] != model.nq:
        return "differs in coordinates"
    found = values(model, reference.q, reference.v)
    if isinstance(found, str):
        return found
    worst = max(errors(reference, *found).values())
    if worst > tolerance and 100 * reference.rounding.max() > worst:
        return "differs: digits that cancel in MuJoCo's sums"
    return "agrees" if worst <= tolerance else reason(model, reference.q, found[0], worst)


def engines_judged(model: mb.Model, seed: int) -> str:
    """Compare mbkit's two engines on a model whose file has no reading to compare with."""
    q, v = model.random_state(np.random.default_rng(seed), 2)
    found = values(model, q, v)
    if isinstance(found, str):
        return found
    try:
        other = mb.dynamics(model, "mujoco")
        M = other.mass_matrix(q)
    except UnsupportedError:
        return ALONE
    worst = np.abs(M - found[0]).max() / (np.abs(found[0]).max() * EPS)
    return "agrees" if worst <= COARSE / EPS else reason(model, q, found[0], worst)


@outcome
def urdf_judged(path: Path, policy: str, seed: int, tolerance: float) -> str:
    """Compare what mbkit reads in a URDF with Pinocchio's own parser of the same bytes."""
    model = loaded(path, policy)
    q, v = model.random_state(np.random.default_rng(seed), 2)
    found = values(model, q, v)
    if isinstance(found, str):
        return found
    try:
        raw = pin.buildModelFromXML(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RuntimeError, IndexError):
        return "Pinocchio alone refuses"
    if any(x not in raw.names for x in model.joint_names) or raw.nv != model.nv:
        return "differs in coordinates"
    data, worst = raw.createData(), 0.0
    for k in range(len(q)):
        theirs, order = pin.neutral(raw), []
        for joint in model.independent_joints:
            j = raw.joints[raw.getJointId(joint.name)]
            x = q[k][model.layout.q[joint.name]]
            if joint.kind == "planar":
                # Pinocchio's velocities are in other axes there.
                return engines_judged(model, seed)
            theirs[j.idx_q : j.idx_q + j.nq] = (np.cos(x[0]), np.sin(x[0])) if j.nq == j.nv + 1 == 2 else x
            order += range(j.idx_v, j.idx_v + j.nv)
        M = np.array(pin.crba(raw, data, theirs))
        M = np.triu(M) + np.triu(M, 1).T
        g = np.array(pin.computeGeneralizedGravity(raw, data, theirs))[order]
        own = mb.dynamics(model).gravity(q[k])
        size = np.abs(M).max()
        worst = max(worst, np.abs(M[np.ix_(order, order)] - found[0][k]).max() / size)
        worst = max(worst, np.abs(g - own).max() / max(np.abs(g).max(), 10 * size))
    return "agrees" if worst <= tolerance * EPS else reason(model, q, found[0], worst / EPS)


def reason(model: mb.Model, q: np.ndarray, M: np.ndarray, worst: float) -> str:
    """Return why terms are `worst` eps from the reference, as far as it is known."""
    if model.nonphysical:
        return "differs: a body that no matter is like"
    try:
        other = mb.dynamics(model, "mujoco").mass_matrix(q)
    except MbkitError:
        return f"differs by {worst * EPS:.0e}"
    # Sizes of many decades: engines that are given the same numbers differ as much.
    apart = np.abs(other - M).max() / (np.abs(M).max() * EPS)
    return "differs: digits lost on the same numbers" if not apart < 1e-2 * worst else f"differs by {worst * EPS:.0e}"


def tree_outcome(seed: int) -> str:
    """Return whether a random tree's M and nle are those of Newton and Euler in 45 digits."""
    model = random_tree(seed, 2 + seed % 11, ALL, mimic=bool(seed % 2))
    reading = newton_euler.Reading(plain(model))
    q, v, _, _ = (x[0] for x in states(model, 1, seed))
    M = np.array(newton_euler.mass_matrix(reading, q).tolist(), dtype=float)
    nle = np.array([float(x) for x in newton_euler.nle(reading, q, v)])
    scale = max(np.abs(nle).max(initial=0), np.abs(M).max(initial=0) * (v @ v))
    for engine in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, engine)
        off = np.abs(dyn.mass_matrix(q) - M).max(initial=0) / np.abs(M).max(initial=1e-300)
        off = max(off, np.abs(dyn.nle(q, v) - nle).max(initial=0) / max(scale, 1e-300))
        if not off <= ROUNDING * EPS:
            return f"{engine} differs by {off:.0e}"
    return "agrees"


# A process does it, and this one watches.


def made_of(part: str, seed: int) -> str:
    """Return what becomes of a seed, in the folder of this process."""
    if part == "mutants":
        return mutant_outcome(seed, Path.cwd(), bases())
    return mjcf_outcome(seed, Path.cwd()) if part == "random MJCFs" else tree_outcome(seed)


def counted(worker: Worker, part: str, count: int, seconds: float) -> tuple[Counter[str], dict[str, list[int]]]:
    """Return how often each outcome came, and the seeds of the failures; no seed is begun after `seconds`."""
    found: Counter[str] = Counter()
    failures: dict[str, list[int]] = {}
    begun = time.perf_counter()
    for seed in range(count):
        if time.perf_counter() - begun > seconds:
            break
        try:
            made = worker.call(made_of, part, seed, deadline=time.perf_counter() + PATIENCE)
        except WorkerTimeoutError:
            made = "took longer than a minute"
        except WorkerDiedError:
            made = "ended the process"
        except Exception as error:
            made = describe(error)
        found[made] += 1
        if not is_good(part, made):
            failures.setdefault(made, []).append(seed)
            print(f"{part}, seed {seed}: {made}", flush=True)
    return found, failures


def is_good(part: str, made: str) -> bool:
    """Return whether an outcome is one that may be; that of a damaged file begins with the kind of damage."""
    return (made.split(": ", 1)[1] if part == "mutants" and ": " in made else made).startswith(GOOD[part])


#: See `validation.smoke`.
SMOKE = {"COUNT": 3, "TREES": 1}


def main() -> int:
    """Run and write."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else COUNT
    trees = int(sys.argv[2]) if len(sys.argv) > 2 else TREES
    seconds = float(sys.argv[3]) * 20 if len(sys.argv) > 3 else float("inf")
    os.environ.setdefault("MBKIT_COMPILE", "0")
    table, worker = {}, Worker()
    for part, n in (("mutants", count), ("random MJCFs", count), ("random trees", trees)):
        begun = time.perf_counter()
        found, failures = counted(worker, part, n, seconds)
        table[part] = {
            "count": found.total(),
            "failures": sum(map(len, failures.values())),
            "outcomes": dict(sorted(found.items(), key=lambda x: -x[1])),
            "seeds of failures": {k: x[:20] for k, x in failures.items()},
        }
        print(f"{part}: {found.total()} in {time.perf_counter() - begun:.0f} s")
        print(json.dumps(table[part]["outcomes"], indent=1), flush=True)
    worker.end()
    told = {**stamp(__file__), **table}
    results("fuzz.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    return int(any(x["failures"] for x in table.values()))


if __name__ == "__main__":
    sys.exit(main())
