"""Published and exact figures, reached by simulation on several engines with several methods.

Run ``python -m validation.published``, about two minutes; it writes
``validation/published_checks.json`` and prints a table. Each check simulates one
problem of ``published.json`` in one `Way` and returns `Figure`s: an error and the bar
that it should not pass. What was printed is compared to its last digit, the rest with
the exact motions of ``elliptic``. A bar that one way misses is told, not hidden: the
light cart-pole's is beyond MuJoCo's mass matrix in double, and the box's last period beyond
double itself. Exit status 1 if no way at all reaches a figure.
"""

from __future__ import annotations

import json
import math
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

import mbkit as mb
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import MbkitWarning
from mbkit.model import Model
from mbkit.simulate import Event, Trajectory, at_section
from validation import elliptic
from validation.closed_forms import published
from validation.scenes import SCENES, Scene
from validation.stamp import results, stamp

Array = NDArray[np.float64]
SCENE: dict[str, Scene] = {scene.name: scene for scene in SCENES}
PERIODS = 1000


@dataclass(frozen=True)
class Way:
    """An engine, a method that has events, and its tolerance."""

    engine: str
    method: str
    rtol: float
    compile: bool | None = None

    def __str__(self) -> str:
        return f"{self.method} on {self.engine}"

    def run(
        self, scene: Scene, duration: float | None = None, *, save: ArrayLike, events: Sequence[Event] = ()
    ) -> Trajectory:
        """Simulate a scene, to another end if one is given."""
        dyn = self._dynamics(scene.model())
        duration = scene.duration if duration is None else duration
        with warnings.catch_warnings():
            warnings.simplefilter("error", MbkitWarning)  # a run that ends early has no figures
            return mb.simulate(
                dyn, scene.q0, scene.v0, duration, self.method, rtol=self.rtol, save=save, events=tuple(events)
            )

    def _dynamics(self, model: Model) -> Any:
        if self.engine == "oracle":
            return OracleDynamics(model)
        options = {} if self.compile is None or self.engine != "lagrangian" else {"compile": self.compile}
        return mb.dynamics(model, self.engine, **options)


@dataclass(frozen=True)
class Figure:
    """What one check found: an error in SI units, and the bar that it must not pass."""

    what: str
    error: float
    bar: float

    @property
    def reached(self) -> bool:
        return self.error <= self.bar


def pendulum(way: Way) -> tuple[list[Figure], Trajectory]:
    """A01: where the mass is at the four times, to 1e-12 of the printed 18 digits."""
    exact = published()["iftomm_A01_pendulum"]["exact"]
    printed = {float(k.split()[0].removeprefix("t=")): v for k, v in exact.items() if k.startswith("t=")}
    run = way.run(SCENE["pendulum"], save=list(printed))
    got = np.column_stack([np.sin(run.q[:, 0]), -np.cos(run.q[:, 0])])
    return [Figure("x, y at t = 1, 5, 9.99, 10", worst(got, np.array(list(printed.values()), dtype=float)), 1e-12)], run


def light_cart_pole(way: Way, every: int = 1) -> tuple[list[Figure], Trajectory]:
    """The light cart-pole's score, at every n-th of its times, the passages below and the greatest speed there."""
    scene, told = SCENE["light_cart_pole"], published()["light_cart_pole"]
    motion, t, exact = _light_cart_pole(every)
    below = at_section(scene.model(), "theta")
    run = way.run(scene, save=t, events=[below])
    difference = (run.q - exact) / [told["l"], 1.0]
    score = float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
    peak = max(abs(float(hit.v[1])) for hit in run.events)
    return [
        Figure("score on t = 0:0.01:10", score, 1e-9),
        Figure("passages below: 11", abs(len(run.events) - told["crossings"]), 0),
        Figure("greatest speed: 4429 rad/s", abs(peak - told["peak_thetadot"]), 0.5),
        Figure("greatest speed, relative", abs(peak / motion.peak_speed - 1), 1e-9),
    ], run


@cache
def _light_cart_pole(every: int) -> tuple[elliptic.CartPole, Array, Array]:
    told = published()["light_cart_pole"]
    motion = elliptic.CartPole(math.pi / 2, told["M"], told["m"], told["l"], told["g"])
    t = np.arange(0, 1001, every) / 100
    return motion, t, motion.states(t)[0]


def heavy_top(way: Way) -> tuple[list[Figure], Trajectory]:
    """Terze, Müller, Zlatar's top at 0.2 s: all printed digits, and the exact nutation."""
    scene = SCENE["heavy_top"]
    w, x, y, z = published()["heavy_top"]["published_quaternion_wxyz_t0p2_rk4"]
    assert scene.exact is not None
    run = way.run(scene, save=[0.2, 0.5, 1.0])
    q, v = scene.exact(run.t)
    # The scene's body and space axes are the paper's; only the order of the four numbers differs.
    return [
        Figure("quaternion at 0.2 s, 5 printed digits", attitude_error(run.q[:1], np.array([[x, y, z, w]])), 5e-6),
        Figure("quaternion at 0.2, 0.5, 1 s", attitude_error(run.q, q), 1e-10),
        Figure("angular velocity, of 150 rad/s", worst(run.v, v) / 150, 1e-10),
    ], run


def spherical_pendulum(way: Way) -> tuple[list[Figure], Trajectory]:
    """Period of the polar angle and apsidal angle, between nine of its maxima."""
    scene, told = SCENE["spherical_pendulum"], published()["spherical_pendulum"]
    furthest = Event(_cosine_rate, "greatest angle from down", direction=1, terminal=False)
    run = way.run(scene, save=[0.0, scene.duration], events=[furthest])
    # It starts at a maximum, azimuth 0; a start is no crossing.
    times = np.array([0.0, *(hit.t for hit in run.events if hit.t > 0.1)])
    places = np.array([(0.0, 1.0), *(_horizontal(hit.q) for hit in run.events if hit.t > 0.1)])
    azimuth = np.arctan2(places[:, 0], places[:, 1])
    azimuth += 2 * np.pi * np.round((np.arange(len(azimuth)) * told["exact_apsidal_angle"] - azimuth) / (2 * np.pi))
    count = len(times) - 1
    motion = elliptic.SphericalPendulum(math.pi / 3, told["thetadot0"], told["phidot0"])
    return [
        Figure("period", abs(float(times[-1]) / count - motion.period), 1e-12),
        Figure("apsidal angle", abs(float(azimuth[-1]) / count - motion.apsidal_angle), 1e-11),
        Figure("nine maxima", abs(count - 9), 0),
    ], run


def _cosine_rate(_t: float, q: Array, v: Array) -> float:
    """Rate of cos θ = cos α cos β, which is least where θ is greatest."""
    a, b = q
    return float(-np.sin(a) * np.cos(b) * v[0] - np.cos(a) * np.sin(b) * v[1])


def _horizontal(q: Array) -> tuple[float, float]:
    """Return y and x of the mass."""
    return float(np.sin(q[1])), float(np.sin(q[0]) * np.cos(q[1]))


def dzhanibekov_box(way: Way, periods: int = PERIODS) -> tuple[list[Figure], Trajectory]:
    """The tumbling box's angular velocity and attitude, after many periods and all along the last one."""
    scene, told = SCENE["dzhanibekov_box"], published()["dzhanibekov_box"]
    assert scene.exact is not None
    period = elliptic.free_body(0.0, told["I"], told["w0"]).period
    t = (periods - 1 + np.linspace(0, 1, 25)) * period
    run = way.run(scene, t[-1], save=t)
    q, v = scene.exact(t)
    # Rounding shifts the phase, at random, and a shift weighs forty times as much in the middle of a period,
    # where the box turns over, as at its end.
    return [
        Figure(f"angular velocity after {periods} periods", worst(run.v[-1:], v[-1:]), 1e-7),
        Figure(f"angular velocity all along period {periods}", worst(run.v, v), 1e-7),
        Figure(f"attitude all along period {periods}", attitude_error(run.q[:, 3:], q[:, 3:]), 1e-7),
    ], run


def worst(got: Array, wanted: Array) -> float:
    return float(np.abs(got - wanted).max())


def attitude_error(got: Array, wanted: Array) -> float:
    """Return the largest difference of quaternions, whose sign is free."""
    sign = np.sign(np.sum(got * wanted, axis=-1, keepdims=True))
    return worst(sign * got, wanted)


CHECKS: dict[str, Callable[[Way], tuple[list[Figure], Trajectory]]] = {
    "pendulum (IFToMM A01)": pendulum,
    "light cart-pole": light_cart_pole,
    "heavy top": heavy_top,
    "spherical pendulum": spherical_pendulum,
    "Dzhanibekov box": dzhanibekov_box,
}

WAYS = (
    Way("lagrangian", "taylor", 2.3e-16),
    Way("lagrangian", "rk853", 2.3e-14),
    Way("lagrangian", "dop853", 2.3e-14),
    Way("pinocchio", "rk853", 2.3e-14),
    Way("pinocchio", "dop853", 2.3e-14),
    Way("mujoco", "dop853", 2.3e-14),
    Way("oracle", "taylor", 1e-20),
)


def affordable(problem: str, way: Way) -> bool:
    """A thousand periods are for steps that cost microseconds, and once for 34 digits."""
    return problem != "Dzhanibekov box" or way.method == "taylor" or (way.engine, way.method) == ("lagrangian", "rk853")


def rows() -> list[dict[str, Any]]:
    """Return what every check found in every way."""
    jobs = [(problem, way) for problem in CHECKS for way in WAYS if affordable(problem, way)]
    out = []
    for problem, way in track(jobs, "simulating", console=Console(stderr=True)):
        figures, run = CHECKS[problem](way)
        how = {"problem": problem, "engine": way.engine, "method": way.method, "rtol": way.rtol}
        cost = {"steps": run.stats.steps, "seconds": round(run.stats.seconds, 4)}
        out += [{**how, **asdict(figure), "reached": figure.reached, **cost} for figure in figures]
    return out


def unreached(found: list[dict[str, Any]]) -> list[str]:
    """Return the figures that no way reaches."""
    wanted = dict.fromkeys((row["problem"], row["what"]) for row in found)
    reached = {(row["problem"], row["what"]) for row in found if row["reached"]}
    return [f"{problem}: {what}" for problem, what in wanted if (problem, what) not in reached]


def table(found: list[dict[str, Any]]) -> Table:
    out = Table("problem", "figure", "bar", "engine", "method", title="Published and exact figures, by simulation")
    out.add_column("error", justify="right")
    out.add_column("steps", justify="right")
    for row in found:
        error = f"{row['error']:.1e}" if row["reached"] else f"[red]{row['error']:.1e} missed[/red]"
        bar = f"{row['bar']:g}"
        out.add_row(row["problem"], row["what"], bar, row["engine"], row["method"], error, str(row["steps"]))
    return out


#: See `validation.smoke`.
SMOKE = {"CHECKS": {k: CHECKS[k] for k in ("pendulum (IFToMM A01)", "spherical pendulum")}, "WAYS": WAYS[1:2]}


def main() -> int:
    console = Console(width=160 if not sys.stdout.isatty() else None)
    found = rows()
    lines = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in found)
    head = json.dumps(stamp(__file__), indent=1).removesuffix("\n}")
    results("published_checks.json").write_text(f'{head},\n "checks": [\n{lines}\n ]\n}}\n', encoding="utf-8")
    console.print(table(found))
    missed = unreached(found)
    for line in missed:
        console.print(f"no way reaches it: {line}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
