"""How long the equations of a chain of pendulums take to derive, beside sympy.physics.mechanics.

    python -m validation.bench_derivation [--links 6] [--seconds 60] [--out derivation.json]

n point masses on n massless rods, in angles from the vertical, from 1 to n links, each way in a process of its own
that is ended after so many seconds. Ours is timed in three ways: T and V written as sympy.physics.mechanics would,
then read (`Lagrangian.equations`: M, C and g in symbols, shortened); the catalog's chain as a model, read
(`from_model`); and the same model as CasADi's expressions, ready to be evaluated (`forward_dynamics`). Theirs are
`LagrangesMethod` and `KanesMethod` up to the mass matrix and forcing vector, which they do not shorten.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import sympy as sp
from sympy.physics import mechanics as me

from mbkit.studies.worker import Worker
from validation.stamp import results, stamp


def _symbols(n: int) -> tuple[list[Any], list[Any], list[Any], Any]:
    q = list(me.dynamicsymbols(f"theta1:{n + 1}"))
    return q, list(sp.symbols(f"m1:{n + 1}")), list(sp.symbols(f"l1:{n + 1}")), sp.Symbol("g")


def _energies(n: int) -> tuple[Any, Any, list[Any], list[Any]]:
    q, m, l, g = _symbols(n)
    t = me.dynamicsymbols._t
    x = y = sp.Integer(0)
    T = V = sp.Integer(0)
    for i in range(n):
        x, y = x + l[i] * sp.sin(q[i]), y - l[i] * sp.cos(q[i])
        T += m[i] * (x.diff(t) ** 2 + y.diff(t) ** 2) / 2
        V += m[i] * g * y
    return T, V, q, [*m, *l, g]


def ours_written(n: int) -> float:
    import mbkit as mb

    begun = time.perf_counter()
    T, V, q, parameters = _energies(n)
    _ = mb.lagrangian.Lagrangian(T, V, q, parameters=parameters).equations().coriolis_force
    return time.perf_counter() - begun


def ours_from_model(n: int) -> float:
    import mbkit as mb

    begun = time.perf_counter()
    _ = mb.lagrangian.from_model(mb.catalog.chain(n=n)).equations().coriolis_force
    return time.perf_counter() - begun


def ours_casadi(n: int) -> float:
    import mbkit as mb
    from mbkit.derivation import Equations

    begun = time.perf_counter()
    Equations(mb.catalog.chain(n=n)).function("forward_dynamics")
    return time.perf_counter() - begun


def theirs_lagrange(n: int) -> float:
    begun = time.perf_counter()
    T, V, q, _ = _energies(n)
    method = me.LagrangesMethod(T - V, q)
    method.form_lagranges_equations()
    _ = method.mass_matrix, method.forcing
    return time.perf_counter() - begun


def theirs_kane(n: int) -> float:
    begun = time.perf_counter()
    q, m, l, g = _symbols(n)
    u, t = list(me.dynamicsymbols(f"u1:{n + 1}")), me.dynamicsymbols._t
    N, O = me.ReferenceFrame("N"), me.Point("O")
    O.set_vel(N, 0)
    particles, loads, before = [], [], O
    for i in range(n):
        frame = N.orientnew(f"A{i}", "Axis", [q[i], N.z])
        frame.set_ang_vel(N, u[i] * N.z)
        point = before.locatenew(f"P{i}", -l[i] * frame.y)
        point.v2pt_theory(before, N, frame)
        particles.append(me.Particle(f"p{i}", point, m[i]))
        loads.append((point, -m[i] * g * N.y))
        before = point
    kinematic = [a.diff(t) - b for a, b in zip(q, u, strict=True)]
    method = me.KanesMethod(N, q_ind=q, u_ind=u, kd_eqs=kinematic)
    method.kanes_equations(particles, loads)
    _ = method.mass_matrix, method.forcing
    return time.perf_counter() - begun


#: Links of the longest chain, and s for one.
LINKS, LIMIT = 6, 60.0
WAYS: dict[str, Callable[[int], float]] = {
    f.__name__: f for f in (ours_written, ours_from_model, ours_casadi, theirs_lagrange, theirs_kane)
}


def _answer(way: str, n: int) -> float:
    # Imports and SymPy's own start are nobody's derivation.
    WAYS[way](1)
    return WAYS[way](n)


def timed(way: str, n: int, seconds: float) -> float | None:
    """Return seconds, or None where it took longer than allowed."""
    worker = Worker()
    try:
        # The start of a process is not counted.
        return worker.call(_answer, way, n, deadline=time.perf_counter() + seconds + 20.0)
    except Exception:
        return None
    finally:
        worker.end()


#: See `validation.smoke`.
SMOKE = {"LINKS": 1, "WAYS": {name: WAYS[name] for name in ("ours_from_model", "theirs_kane")}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--links", type=int, default=LINKS)
    parser.add_argument("--seconds", type=float, default=LIMIT)
    parser.add_argument("--out", type=Path, default=results("derivation.json"))
    asked = parser.parse_args()
    rows: list[dict[str, Any]] = []
    lost: set[str] = set()
    for n in range(1, asked.links + 1):
        row: dict[str, Any] = {"links": n}
        for way in WAYS:
            took = None if way in lost else timed(way, n, asked.seconds)
            if took is None or took > asked.seconds:
                # A longer chain takes longer still.
                lost.add(way)
                row[way] = f"more than {asked.seconds:g} s" if took is None else took
            else:
                row[way] = took
        rows.append(row)
        print(json.dumps(row), flush=True)
    about = stamp(__file__)
    about["versions"]["sympy"] = sp.__version__
    told = {
        "seconds": rows,
        "limit": asked.seconds,
        **about,
    }
    asked.out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
