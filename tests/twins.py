"""Systems on paper, each with the same system built of bodies and joints, and how their states belong together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import sympy as sp
from scipy.spatial.transform import Rotation

import mbkit as mb
from mbkit.engines import Dynamics
from mbkit.lagrangian import Lagrangian, systems
from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.statics.virtual_work import generalized_force
from mbkit.model import Model
from validation.textbook import MassiveSliderCrank, SliderCrank, WheeledSpacecraft

SWING = (0.0, -1.0, 0.0)
Turn = Callable[[Any, Any], tuple[Any, Any]]


@dataclass(frozen=True)
class Twin:
    """A system on paper in q, v = q̇, and its like of bodies and joints in q', v'.

    Attributes
    ----------
    paper, model : callable
        Make the two.
    place : callable
        From q and t to q'.
    turn : callable
        From q and t to S and s of v' = S v + s. It takes complex numbers, so that a step along the imaginary axis
        gives their rates to the last digit.
    force : callable, optional
        From (dyn, t, q', v') to forces of the model that stand in the paper's energies and forces.
    drive : callable, optional
        From (dyn, t, q', v') to those that keep up what the paper prescribes or ties; they do no work on v.
    """

    paper: Callable[[], Lagrangian]
    model: Callable[[], Model]
    place: Callable[[Any, float], Any] = lambda q, _: q
    turn: Turn = lambda q, _: (np.eye(len(q)), np.zeros(len(q)))
    force: Callable[[Dynamics, float, Any, Any], Any] | None = None
    drive: Callable[[Dynamics, float, Any, Any], Any] | None = None

    def velocity(self, q: Any, v: Any, t: Any = 0.0) -> Any:
        """Return v'."""
        return carried_along(self.turn, q, v, t)

    def bias(self, q: np.ndarray, v: np.ndarray, t: float = 0.0) -> np.ndarray:
        """Return v̇' - S v̇."""
        return own_acceleration(self.turn, q, v, t)


def carried_along(turn: Turn, q: Any, v: Any, t: Any) -> Any:
    S, s = turn(q, t)
    return np.asarray(S) @ v + s


def own_acceleration(turn: Turn, q: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    h = 1e-40
    return np.imag(carried_along(turn, q + 1j * h * v, v, t + 1j * h)) / h


def linear(S: np.ndarray) -> dict[str, Any]:
    """Return place and turn of q' = S q."""
    return {"place": lambda q, _: S @ q, "turn": lambda *_: (S, np.zeros(len(S)))}


# Pendulums


def suspended(q: Any, _: float) -> np.ndarray:
    th, ph = q
    x, y, z = np.sin(th) * np.cos(ph), np.sin(th) * np.sin(ph), np.cos(th)
    return np.array([np.arctan(x / z), np.arcsin(y)])


def suspension(q: Any, t: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the rates of the Cardan suspension by the azimuth's: those of (sin α cos β, sin β, -cos α cos β)."""
    th, ph = q
    al, be = suspended(q, t)
    s, c = np.sin(th), np.cos(th)
    by = np.array([[c * np.cos(ph), -s * np.sin(ph)], [c * np.sin(ph), s * np.cos(ph)], [s, 0 * s]])
    return np.array([(by[0] * np.cos(al) + by[2] * np.sin(al)) / np.cos(be), by[1] / np.cos(be)]), np.zeros(2)


def rods(n: int = 3, length: float = 1.0, mass: float = 1.0, gravity: float = 9.81) -> Lagrangian:
    """Return thin rods hanging one from the other, in angles from the vertical."""
    q = sp.symbols(f"phi1:{n + 1}")
    w = [velocity_of(x) for x in q]
    m, l, g = sp.symbols("m l g")
    T = V = sp.Integer(0)
    for i in range(n):
        for j in range(i + 1):
            below = n - 1 - i
            part = below + sp.Rational(1, 3) if i == j else 2 * (below + sp.Rational(1, 2))
            T += m * l**2 * part * sp.cos(q[i] - q[j]) * w[i] * w[j] / 2
        V -= m * g * l * (sp.Rational(1, 2) + n - 1 - i) * sp.cos(q[i])
    return Lagrangian(T, V, q, w, parameters={m: mass, l: length, g: gravity}, name="rods")


# One degree of freedom, and n


def stretched_scale(stiffness: float = 4.0, damping: float = 0.3) -> Lagrangian:
    """Return a mass on a spring and a damper in the coordinate q = arsinh x: J = m cosh² q."""
    k, c = sp.symbols("k c")
    return systems.one_degree(
        lambda q: sp.cosh(q) ** 2,
        lambda q: k * sp.sinh(q) ** 2 / 2,
        lambda q, w: -c * sp.cosh(q) ** 2 * w,
        parameters={k: stiffness, c: damping},
    )


def spring_chain(n: int = 4, mass: float = 0.7, stiffness: float = 5.0, damping: float = 0.2) -> Lagrangian:
    """Return masses in a row on springs, with Rayleigh's dissipation; places from where they rest."""
    m, k, c = sp.symbols("m k c")
    q = sp.symbols(f"x1:{n + 1}")
    w = [velocity_of(x) for x in q]
    T = m * sum(u**2 for u in w) / 2
    V, R = (f * sum((a - b) ** 2 for a, b in zip(z, [0, *z], strict=False)) / 2 for f, z in ((k, q), (c, w)))
    return Lagrangian(
        T, V, q, w, dissipation=R, parameters={m: mass, k: stiffness, c: damping}, name="masses on springs"
    )


def slides(n: int, mass: float, axis: Any = (1.0, 0.0, 0.0), gravity: Any = (0.0, 0.0, 0.0), **joint: float) -> Model:
    """Return point masses, each sliding along the one before."""
    b = mb.ModelBuilder("slides", gravity=gravity)
    for i in range(n):
        b.add_body(f"m{i}", mass=mass)
        parent = f"m{i - 1}" if i else "world"
        b.add_joint(f"s{i}", "prismatic", parent=parent, child=f"m{i}", axis=axis, **joint)
    return b.build()


# Driven ones


def carried(kind: str, axis: Any, length: float, mass: float, gravity: float) -> Model:
    """Return a point mass on a rod that hangs from a carriage without mass."""
    b = mb.ModelBuilder("carried", gravity=(0.0, 0.0, -gravity))
    b.add_body("carriage")
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("carrier", kind, parent="world", child="carriage", axis=axis)
    b.add_joint("theta", "continuous", parent="carriage", child="bob", axis=SWING)
    return b.build()


def kept(acceleration: Callable[[float], float]) -> Callable[[Dynamics, float, Any, Any], np.ndarray]:
    """Return the force on the first joint that gives it this acceleration, the second being free."""

    def drive(dyn: Dynamics, t: float, q: Any, v: Any) -> np.ndarray:
        M, h, a = dyn.mass_matrix(q), dyn.nle(q, v), acceleration(t)
        other = -(M[1, 0] * a + h[1]) / M[1, 1]
        return np.array([M[0, 0] * a + M[0, 1] * other + h[0], 0.0])

    return drive


HOOP = {"mass": 0.7, "radius": 0.5, "speed": 6.0}
KAPITZA = {"mass": 1.4, "length": 0.8, "amplitude": 0.05, "frequency": 150.0}
_LIFT = KAPITZA["amplitude"] * KAPITZA["frequency"]

# Slider-cranks

PISTON = SliderCrank(crank=0.1, rod=0.3, mass=0.4)
CRANK = MassiveSliderCrank()
CRANK_TORQUE = np.array([0.1, 0.0, 0.0])


def crank_and_rod() -> Model:
    """Return a thin crank, a thin rod at its end and a piston on the line through the shaft; nothing ties them."""
    b = mb.ModelBuilder("crank and rod", gravity=(0.0, 0.0, 0.0))
    for name, mass, length in (("crank", CRANK.crank_mass, CRANK.crank), ("rod", CRANK.rod_mass, CRANK.rod)):
        thin = mass * length**2 / 12
        b.add_body(name, mass=mass, com=(length / 2, 0.0, 0.0), inertia=(0.0, thin, thin))
    b.add_body("piston", mass=CRANK.piston_mass)
    b.add_joint("theta", "continuous", parent="world", child="crank", axis=(0.0, 0.0, 1.0))
    place = (CRANK.crank, 0.0, 0.0)
    b.add_joint("lean", "continuous", parent="crank", child="rod", axis=(0.0, 0.0, 1.0), translation=place)
    b.add_joint("slide", "prismatic", parent="world", child="piston", axis=(1.0, 0.0, 0.0))
    return b.build()


def crank_turn(q: Any, _: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes of rod and piston by the crank's angle, with sin φ = (r/l) sin θ."""
    form = SliderCrank(CRANK.crank, CRANK.rod)
    lean = CRANK.crank / CRANK.rod * np.cos(q[0]) / np.cos(form.lean(q[0]))
    return np.array([[1.0 + 0 * lean], [-1 - lean], [form.slope(q[0])]]), np.zeros(3)


def crank_place(q: Any, _: float) -> np.ndarray:
    form = SliderCrank(CRANK.crank, CRANK.rod)
    return np.array([q[0], -q[0] - form.lean(q[0]), form.position(q[0])])


def tied(dyn: Dynamics, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the forces of the pins that hold crank, rod and piston together, by d'Alembert's principle."""
    S, own = crank_turn(q[:1], t)[0], own_acceleration(crank_turn, q[:1], v[:1], t)
    M, left = dyn.mass_matrix(q), CRANK_TORQUE - dyn.nle(q, v)
    angular = S.T @ (left - M @ own) / (S.T @ M @ S)[0, 0]
    return np.asarray(M @ (S @ angular + own) - left)


# Forces


def tilted(slope: float, mass: float) -> Model:
    return slides(1, mass, axis=(np.cos(slope), 0.0, -np.sin(slope)), gravity=(0.0, 0.0, -9.81))


THRUSTER = {"mass": 2.0, "inertia": 0.3, "thrust": 1.5, "arm": 0.2}


def thruster() -> Lagrangian:
    """Return a plane body with a thrust F along its own x-axis, d beside its centre."""
    m, I, F, d = sp.symbols("m I F d")
    x, y, th = q = sp.symbols("x y theta")
    u, v, w = (velocity_of(s) for s in q)
    point = [x + d * sp.sin(th), y - d * sp.cos(th)]
    Q = generalized_force([[F * sp.cos(th), F * sp.sin(th)]], [point], q)
    values = dict(zip((m, I, F, d), THRUSTER.values(), strict=True))
    return Lagrangian(m * (u**2 + v**2) / 2 + I * w**2 / 2, 0, q, forces=Q, parameters=values, name="thruster")


def plane_body() -> Model:
    b = mb.ModelBuilder("plane body", gravity=(0.0, 0.0, 0.0))
    b.add_body("hull", mass=THRUSTER["mass"], inertia=(THRUSTER["inertia"],) * 3)
    b.add_joint("base", "planar", parent="world", child="hull")
    b.add_frame("nozzle", body="hull", translation=(0.0, -THRUSTER["arm"], 0.0))
    return b.build()


def thrust(dyn: Dynamics, _: float, q: Any, v: Any) -> np.ndarray:  # noqa: ARG001
    """Return what a wrench does, by the Jacobian of the point on which it acts."""
    along = THRUSTER["thrust"] * np.array([np.cos(q[2]), np.sin(q[2]), 0.0])
    return np.asarray(dyn.jacobian(q, "nozzle")[:3].T @ along)


# Bodies in Euler's angles, z-x-z


def attitude(q: Any) -> np.ndarray:
    """Return Rz(φ) Rx(θ) Rz(ψ)."""
    return np.asarray(Rotation.from_euler("ZXZ", np.asarray(q)[:3]).as_matrix())


def body_rates(q: Any) -> np.ndarray:
    """Return B of ω = B q̇ in body axes (Goldstein, eq. 4.87)."""
    (_, th, ps), zero = q[:3], 0 * q[0]
    return np.array(
        [
            [np.sin(th) * np.sin(ps), np.cos(ps), zero],
            [np.sin(th) * np.cos(ps), -np.sin(ps), zero],
            [np.cos(th), zero, 1 + zero],
        ]
    )


def by_body_rates(lag: Lagrangian) -> sp.Matrix:
    """Return D of q̇ = D ω for the first three coordinates, with the rates of the others kept."""
    _, th, ps, *others = lag.coordinates
    s, c = sp.sin, sp.cos
    D = sp.Matrix(
        [
            [s(ps) / s(th), c(ps) / s(th), 0],
            [c(ps), -s(ps), 0],
            [-s(ps) * c(th) / s(th), -c(ps) * c(th) / s(th), 1],
        ]
    )
    return sp.diag(D, sp.eye(len(others)))


BALL = {
    "place": lambda q, _: Rotation.from_matrix(attitude(q)).as_quat(),
    "turn": lambda q, _: (body_rates(q), np.zeros(3)),
}
TOP = {"mass": 2.0, "length": 0.3, "across": 0.5, "axial": 0.2}
BODY = (1.0, 2.0, 2.5)

#: One wheel on the axis of a symmetric hub, beside its centre.
DUAL_SPIN = WheeledSpacecraft(
    hub_mass=7.0,
    hub_inertia=(0.4, 0.4, 0.3),
    wheel_axes=((0.0, 0.0, 1.0),),
    wheel_mass=0.6,
    wheel_inertia=0.02,
    wheel_distance=0.35,
)


def dual_spin() -> Lagrangian:
    """Return that spacecraft about its centre of mass, in Euler's angles and the wheel's turn."""
    A, C, J = sp.symbols("A C J")
    q = sp.symbols("phi theta psi s")
    u, w, r, spin = (velocity_of(x) for x in q)
    along = r + u * sp.cos(q[1])
    T = A * (w**2 + u**2 * sp.sin(q[1]) ** 2) / 2 + (C - J) * along**2 / 2 + J * (along + spin) ** 2 / 2
    values = {A: DUAL_SPIN.central_inertia[0, 0], C: DUAL_SPIN.central_inertia[2, 2], J: DUAL_SPIN.wheel_inertia}
    return Lagrangian(T, 0, q, parameters=values, name="dual_spin")


def craft_turn(q: Any, _: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the free joint's velocity, of a hub whose centre of mass rests: v = -ω × c."""
    B, c = body_rates(q), DUAL_SPIN.com
    S = np.zeros((7, 4), dtype=B.dtype)
    S[:3, :3] = -np.cross(B, c, axis=0)
    S[3:6, :3], S[6, 3] = B, 1.0
    return S, np.zeros(7)


def craft_place(q: Any, _: float) -> np.ndarray:
    R = attitude(q)
    return np.concatenate([-R @ DUAL_SPIN.com, Rotation.from_matrix(R).as_quat(), q[3:]])


def craft() -> Model:
    d = DUAL_SPIN
    return mb.catalog.spacecraft_with_wheels(
        hub_mass=d.hub_mass,
        hub_inertia=d.hub_inertia,
        wheel_axes=d.wheel_axes,
        wheel_mass=d.wheel_mass,
        wheel_inertia=d.wheel_inertia,
        wheel_distance=d.wheel_distance,
    )


RELATIVE = linear(np.array([[1.0, 0.0], [-1.0, 1.0]]))
SPRINGS, ELASTIC = {"mass": 0.7, "stiffness": 5.0, "damping": 0.2}, {"length": 0.8, "stiffness": 30.0}
DOUBLE = {"mass1": 0.7, "length2": 0.6}
FURUTA = {"arm_inertia": 4e-3, "pendulum_inertia": 7e-4}
BLOCK, FALL = {"mass": 2.0, "slope": 0.5, "friction": 0.3, "creep": 0.4}, {"mass": 2.0, "drag": 0.5}
FLEXIBLE = {"segments": 1, "hub_mass": 1.1, "hub_radius": 0.4, "length": 1.7, "mass": 0.6, "bending_stiffness": 0.9}


def of(name: str, **values: float) -> Callable[[], Lagrangian]:
    return lambda: systems.get(name)(**values)


def built(name: str, **values: Any) -> Callable[[], Model]:
    return lambda: mb.catalog.get(name)(**values)


def rubbed(_dyn: Dynamics, _: float, q: Any, v: Any) -> np.ndarray:  # noqa: ARG001
    hold = BLOCK["friction"] * BLOCK["mass"] * 9.81 * np.cos(BLOCK["slope"])
    return np.asarray(-hold * np.tanh(np.asarray(v) / BLOCK["creep"]))


TWINS: dict[str, Twin] = {
    "pendulum": Twin(of("pendulum", mass=0.7, length=1.3), built("pendulum", mass=0.7, length=1.3)),
    "double_pendulum": Twin(of("double_pendulum", **DOUBLE), built("double_pendulum", **DOUBLE), **RELATIVE),
    "weightless double_pendulum": Twin(
        of("double_pendulum", **DOUBLE, gravity=0.0), built("double_pendulum", **DOUBLE, gravity=0.0), **RELATIVE
    ),
    "elastic_pendulum": Twin(of("elastic_pendulum", **ELASTIC), built("elastic_pendulum", **ELASTIC)),
    "weightless elastic_pendulum": Twin(
        of("elastic_pendulum", **ELASTIC, gravity=0.0), built("elastic_pendulum", **ELASTIC, gravity=0.0)
    ),
    "spherical_pendulum": Twin(
        of("spherical_pendulum", length=0.8), built("spherical_pendulum", length=0.8), suspended, suspension
    ),
    "rods": Twin(rods, built("chain", n=3), **linear(np.eye(3) - np.eye(3, k=-1))),
    "cart_pole": Twin(of("cart_pole", pole_mass=0.3), built("cart_pole", pole_mass=0.3)),
    "acrobot": Twin(of("acrobot"), built("acrobot")),
    "weightless acrobot": Twin(of("acrobot", gravity=0.0), built("acrobot", gravity=0.0)),
    "furuta_pendulum": Twin(
        of("furuta_pendulum", **FURUTA),
        built("furuta_pendulum", arm_com=0.1, arm_inertia=2e-3, pendulum_inertia=(7e-4, 7e-4, 0.0)),
    ),
    "kepler": Twin(
        of("kepler", mass=3.0, strength=1.7),
        lambda: mb.catalog.elastic_pendulum(mass=3.0, gravity=0.0).without("springs"),
        lambda q, _: np.array([q[1], q[0] - 1]),
        lambda *_: (np.array([[0.0, 1.0], [1.0, 0.0]]), np.zeros(2)),
        force=lambda _dyn, _, q, _v: np.array([0.0, -1.7 / (1 + q[1]) ** 2]),
    ),
    "bead_on_hoop": Twin(
        of("bead_on_hoop", **HOOP),
        lambda: carried("continuous", (0.0, 0.0, 1.0), HOOP["radius"], HOOP["mass"], 9.81),
        lambda q, t: np.array([HOOP["speed"] * t, q[0]]),
        lambda *_: (np.array([[0.0], [1.0]]), np.array([HOOP["speed"], 0.0])),
        drive=kept(lambda _: 0.0),
    ),
    "driven_pendulum": Twin(
        of("driven_pendulum", **KAPITZA),
        lambda: carried("prismatic", (0.0, 0.0, 1.0), KAPITZA["length"], KAPITZA["mass"], 9.81),
        lambda q, t: np.array([KAPITZA["amplitude"] * np.cos(KAPITZA["frequency"] * t), q[0]]),
        lambda _, t: (np.array([[0.0], [1.0]]), np.array([-_LIFT * np.sin(KAPITZA["frequency"] * t), 0.0])),
        drive=kept(lambda t: -_LIFT * KAPITZA["frequency"] * np.cos(KAPITZA["frequency"] * t)),
    ),
    "slider_crank": Twin(
        of("slider_crank", crank=PISTON.crank, rod=PISTON.rod, mass=PISTON.mass, force=-3.0),
        lambda: slides(1, PISTON.mass),
        lambda q, _: np.array([PISTON.position(q[0])]),
        lambda q, _: (np.array([[PISTON.slope(q[0])]]), np.zeros(1)),
        force=lambda _dyn, _t, _q, _v: np.array([3.0]),
    ),
    "rigid_slider_crank": Twin(
        of("rigid_slider_crank"),
        crank_and_rod,
        crank_place,
        crank_turn,
        force=lambda _dyn, _t, _q, _v: CRANK_TORQUE,
        drive=tied,
    ),
    "one_degree": Twin(
        stretched_scale,
        lambda: slides(1, 1.0, stiffness=4.0, damping=0.3),
        lambda q, _: np.sinh(q),
        lambda q, _: (np.diag(np.cosh(q)), np.zeros(1)),
    ),
    "masses on springs": Twin(
        lambda: spring_chain(**SPRINGS),
        lambda: slides(4, SPRINGS["mass"], stiffness=SPRINGS["stiffness"], damping=SPRINGS["damping"]),
        **linear(np.eye(4) - np.eye(4, k=-1)),
    ),
    "sliding_block": Twin(of("sliding_block", **BLOCK), lambda: tilted(BLOCK["slope"], BLOCK["mass"]), force=rubbed),
    "falling_body": Twin(
        of("falling_body", **FALL),
        lambda: slides(1, FALL["mass"], axis=(0.0, 0.0, 1.0), gravity=(0.0, 0.0, -9.81)),
        force=lambda _dyn, _t, _q, v: -FALL["drag"] * np.asarray(v) * np.abs(v),
    ),
    "thruster": Twin(thruster, plane_body, force=thrust),
    "heavy_top": Twin(
        of("heavy_top", **TOP),
        # About the centre of mass, by Steiner.
        built("heavy_top", mass=2.0, com=(0, 0, 0.3), inertia=(0.5 - 0.18, 0.5 - 0.18, 0.2)),
        **BALL,
    ),
    "rigid_body": Twin(
        of("rigid_body"), built("heavy_top", mass=2.0, com=(0, 0, 0), inertia=BODY, gravity=0.0), **BALL
    ),
    "gyroscope": Twin(of("gyroscope"), built("gyroscope")),
    "spacecraft": Twin(dual_spin, craft, craft_place, craft_turn),
    "flexible_spacecraft": Twin(
        lambda: mb.lagrangian.from_model(mb.catalog.flexible_spacecraft(**FLEXIBLE, hub_inertia=(0.3,) * 3)),
        built("flexible_spacecraft", **FLEXIBLE, hub_inertia=(0.3,) * 3),
    ),
}


@cache
def paper(name: str) -> Lagrangian:
    """Return a twin on paper, derived once."""
    return TWINS[name].paper()
