"""What must not change while the code is rebuilt: public names, results, texts, and runs to the bit.

    python -m tests.referee record before.json
    python -m tests.referee check before.json
    python -m tests.referee names               # records tests/public_names.json again

A record holds for one machine and one set of versions, since the last bits depend on both. The part that does not,
public names with their signatures, is kept in `tests/public_names.json` and checked by the suite.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import json
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import mbkit as mb

PACKAGES = (
    "mbkit",
    "mbkit.catalog",
    "mbkit.engines",
    "mbkit.errors",
    "mbkit.lagrangian",
    "mbkit.lagrangian.systems",
    "mbkit.load",
    "mbkit.model",
    "mbkit.show",
    "mbkit.simulate",
    "mbkit.spatial",
    "mbkit.studies",
    "mbkit.studies.baseline",
    "mbkit.studies.stress",
    "mbkit.testing",
)
#: What a study measures in seconds, or what names the machine.
TIMED = re.compile(
    r"ns|ns_.*|.*_ns|seconds?|.*_seconds|saved_.*|setup|first_run|compile|front|spread|ratio|versions?|processor|date"
)


def public_names() -> dict[str, Any]:
    """Return each public name of each public package with its signature, and of classes their public attributes."""
    out: dict[str, Any] = {}
    for package in PACKAGES:
        module = importlib.import_module(package)
        names = getattr(module, "__all__", None) or [n for n in vars(module) if not n.startswith("_")]
        for name in sorted(names):
            thing = getattr(module, name)
            if inspect.ismodule(thing) and not callable(thing):
                out[f"{package}.{name}"] = "module"
            elif inspect.isclass(thing):
                out[f"{package}.{name}"] = {"class": _signature(thing), **dict(_attributes(thing))}
            else:
                out[f"{package}.{name}"] = _signature(thing) if callable(thing) else type(thing).__name__
    return out


def _signature(thing: Any) -> str:
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return "callable"
    parts, marked = [], False
    for p in signature.parameters.values():
        if p.kind is p.KEYWORD_ONLY and not marked:
            parts.append("*")
            marked = True
        marked = marked or p.kind is p.VAR_POSITIONAL
        stars = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "")
        default = p.default
        plain = isinstance(default, (str, int, float, bool, tuple, type(None)))
        text = "" if default is p.empty else f"={default!r}" if plain else "=..."
        parts.append(f"{stars}{p.name}{text}{'/' if p.kind is p.POSITIONAL_ONLY else ''}")
    return f"({', '.join(parts)})"


def _attributes(cls: type) -> Iterator[tuple[str, str]]:
    for name in sorted(n for n in dir(cls) if not n.startswith("_")):
        thing = inspect.getattr_static(cls, name)
        if isinstance(thing, (staticmethod, classmethod)):
            thing = thing.__func__
        yield name, _signature(thing) if inspect.isfunction(thing) else "attribute"


def _bits(*arrays: Any) -> str:
    digest = hashlib.sha256()
    for x in arrays:
        x = np.ascontiguousarray(x)
        digest.update(repr((x.shape, x.dtype.str)).encode() + x.tobytes())
    return digest.hexdigest()[:20]


def _models() -> dict[str, Any]:
    catalog = mb.catalog
    return {
        "double_pendulum": catalog.double_pendulum(),
        "cart_pole": catalog.cart_pole(),
        "heavy_top": catalog.heavy_top(),
        "free_body": catalog.free_body(),
        "ur5": mb.load("ur5"),
        "panda": mb.load("panda"),
        "anymal_b": mb.load("anymal_b", floating_base=True),
    }


def terms() -> dict[str, str]:
    """Return the terms of each engine on each model, to the bit."""
    out = {}
    for name, model in _models().items():
        q, v = model.random_state(np.random.default_rng(1), 5)
        for engine in ("pinocchio", "lagrangian", "mujoco", "oracle"):
            dyn = mb.dynamics(model, engine)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                values = [dyn.mass_matrix(q), dyn.nle(q, v), dyn.gravity(q), dyn.passive(q, v)]
                values += [dyn.inverse_dynamics(q, v, 0.3 * v), dyn.forward_dynamics(q, v, 0.2 * v)]
                values += [dyn.kinetic_energy(q, v), dyn.potential_energy(q)]
            out[f"{name} {engine}"] = _bits(*values)
    return out


def runs() -> dict[str, str]:
    """Return runs by every method on a few models, to the bit."""
    out = {}
    for name, model in _models().items():
        for method, info in mb.simulate.METHODS.items():
            engine = info.engines[0] if info.engines else "lagrangian"
            if not mb.engines.ENGINES.keys() & {engine}:
                continue
            if method.startswith("drake") and model.quaternions:
                continue
            q, v = model.random_state(np.random.default_rng(2))
            setting: dict[str, Any] = {"rtol": 1e-8} if info.kind == "adaptive" else {"dt": 2e-3}
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    run = mb.simulate(mb.dynamics(model, engine), q, 0.3 * v, 0.1, method, save=[0.0, 0.1], **setting)
                except mb.MbkitError as error:
                    out[f"{name} {method}"] = type(error).__name__
                    continue
            out[f"{name} {method}"] = f"{_bits(run.q, run.v)} {run.stats.steps} {run.stats.ended}"
    return out


def texts() -> dict[str, str]:
    """Return what is written for others: C, MJCF, URDF, equations."""
    from click.testing import CliRunner

    from mbkit.cli import cli

    out = {}
    with tempfile.TemporaryDirectory() as folder:
        commands = {
            "c": ["export", "cart_pole", "--out", folder],
            "mjcf": ["convert", "panda", "--to", "mjcf", "--out", f"{folder}/panda.xml"],
            "urdf": ["convert", "ur5", "--to", "urdf", "--out", f"{folder}/ur5.urdf"],
        }
        for name, command in commands.items():
            CliRunner().invoke(cli, command)
            out[name] = "written"
        for path in sorted(Path(folder).iterdir()):
            out[path.name] = _bits(np.frombuffer(path.read_bytes(), dtype=np.uint8))
    for name in ("cart_pole", "double_pendulum", "heavy_top", "kepler", "slider_crank"):
        for form in ([], ["--latex"], ["--python"], ["--json"]):
            printed = CliRunner().invoke(cli, ["derive", name, *form]).stdout
            out[f"derive {name} {' '.join(form)}"] = hashlib.sha256(printed.encode()).hexdigest()[:20]
    return out


def studies() -> dict[str, Any]:
    """Return the results of the studies without what they time."""
    out: dict[str, Any] = {}
    for name, model in list(_models().items())[:5]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            out[f"compare {name}"] = _untimed(json.loads(mb.compare(model, samples=8, terms_only=True).to_json()))
            curves = mb.work_precision(model, ("lagrangian",), ("rk4", "rk853"), duration=0.1, repeats=1)
        found = json.loads(curves.to_json())
        out[f"work_precision {name}"] = _untimed(found)
    return out


def _untimed(x: Any) -> Any:
    if isinstance(x, dict):
        return {k: _untimed(v) for k, v in x.items() if not TIMED.fullmatch(k)}
    return [_untimed(v) for v in x] if isinstance(x, list) else x


PARTS: dict[str, Callable[[], dict[str, Any]]] = {
    "public_names": public_names,
    "terms": terms,
    "runs": runs,
    "texts": texts,
    "studies": studies,
}


def record() -> dict[str, Any]:
    """Return everything."""
    return {name: part() for name, part in PARTS.items()}


def differences(before: Any, after: Any, where: str = "") -> Iterator[str]:
    """Yield what differs."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in before | after:
            if key not in after:
                yield f"{where}/{key}: gone"
            elif key not in before:
                yield f"{where}/{key}: new"
            else:
                yield from differences(before[key], after[key], f"{where}/{key}")
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for k, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from differences(one, other, f"{where}/{k}")
    elif before != after:
        yield f"{where}: {before!r} -> {after!r}"


def main() -> int:
    """Record, or compare with a record; status 1 where something differs."""
    if sys.argv[1:] == ["names"]:
        text = json.dumps(public_names(), indent=1)
        Path(__file__).with_name("public_names.json").write_text(text + "\n", encoding="utf-8")
        return 0
    what, path = sys.argv[1], Path(sys.argv[2])
    found = json.loads(json.dumps(record()))
    if what == "record":
        path.write_text(json.dumps(found, indent=1) + "\n")
        return 0
    told = list(differences(json.loads(path.read_text()), found))
    print("\n".join(told) or f"nothing differs in {sum(len(x) for x in found.values())} entries")
    return 1 if told else 0


if __name__ == "__main__":
    sys.exit(main())
