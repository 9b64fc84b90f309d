"""Joint couplings: the same terms in every engine, and MJCF tendons and actuators as MuJoCo compiles them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

import mbkit as mb

EPS = np.finfo(float).eps


def number(x: float) -> str:
    return repr(float(x))


# MJCF against MuJoCo's compiler.


def random_tree(rng: np.random.Generator, count: int) -> tuple[str, list[list[str]]]:
    """Return bodies on hinges and slides, and the joints from the ground to each joint."""
    children: dict[int, list[int]] = {}
    parents = [-1, *(int(rng.integers(-1, k)) for k in range(1, count))]
    for k, parent in enumerate(parents):
        children.setdefault(parent, []).append(k)

    def body(k: int) -> str:
        pos, axis, com = (" ".join(map(number, rng.normal(size=3))) for _ in range(3))
        kind = rng.choice(["hinge", "slide"])
        joint = f'name="j{k}" type="{kind}" axis="{axis}" ref="{number(rng.normal())}"'
        for name in ("armature", "stiffness", "damping", "springref"):
            if rng.random() < 0.4:
                joint += f' {name}="{number(rng.uniform(0.1, 2))}"'
        inside = "".join(body(c) for c in children.get(k, []))
        inertial = f'<inertial pos="{com}" mass="{number(rng.uniform(0.5, 2))}" diaginertia=".3 .4 .5"/>'
        return f'<body pos="{pos}"><joint {joint}/>{inertial}{inside}</body>'

    chains: list[list[str]] = []
    for k, parent in enumerate(parents):
        chains.append([*(chains[parent] if parent >= 0 else []), f"j{k}"])
    return "".join(body(k) for k in children[-1]), chains


def random_attributes(rng: np.random.Generator, tag: str, *, in_class: bool) -> str:
    """Return an actuator's numbers: few, so that defaults show."""
    u = [number(x) for x in rng.uniform(0.1, 3, 4)]
    some = {
        "gear": number(rng.choice([-2.0, 0.5, 3.0])),
        "armature": u[0],
        "damping": u[1],
        **{
            "general": {"gainprm": u[2], "biastype": str(rng.choice(["none", "affine"])), "biasprm": f"{u[0]} -{u[1]}"},
            "position": {"kp": u[2], **({"kv": u[3]} if in_class or rng.random() < 0.5 else {"dampratio": u[3]})},
            "intvelocity": {"kp": u[2], "kv": u[3], "actrange": "-1 1"},
            "velocity": {"kv": u[2]},
            "damper": {"kv": u[2], "ctrlrange": "0 1"},
            "cylinder": {"area": u[2], "bias": f"{u[0]} -{u[1]} -{u[3]}"},
        }.get(tag, {}),
    }
    needed = {"intvelocity": ("actrange",), "damper": ("ctrlrange",)}.get(tag, ())
    return "".join(f' {k}="{v}"' for k, v in some.items() if k in needed or rng.random() < 0.5)


def random_transmissions(seed: int) -> str:
    rng = np.random.default_rng(seed)
    bodies, chains = random_tree(rng, 6)
    tags = ("general", "motor", "position", "velocity", "cylinder", "intvelocity", "damper")

    def default(name: str, depth: int) -> str:
        tendon = f'<tendon damping="{number(rng.uniform(0, 2))}"/>' if rng.random() < 0.5 else ""
        own = "".join(
            f"<{t}{random_attributes(rng, t, in_class=True)}/>" for t in rng.choice(tags[:5], 2, replace=False)
        )
        inner = default("inner", depth + 1) if not depth else ""
        return f'<default class="{name}">{tendon}{own}{inner}</default>'

    def class_() -> str:
        return str(rng.choice(["", ' class="outer"', ' class="inner"']))

    tendons = actuators = ""
    for k in range(3):
        # MuJoCo leaves a rotor between branches out of M, so rotors here are within a branch.
        chain = chains[int(rng.integers(len(chains)))]
        joints = list(rng.choice(chain, size=min(len(chain), 3), replace=False))
        given = f' armature="{number(rng.uniform(0.1, 2))}"'
        given += f' stiffness="{number(rng.uniform(0.1, 5))}"' if rng.random() < 0.7 else ""
        given += rng.choice(["", ' springlength="-1"', ' springlength=".3"', ' springlength="-.4 -.4"'])
        inside = "".join(f'<joint joint="{j}" coef="{number(rng.normal())}"/>' for j in joints)
        tendons += f'<fixed name="t{k}"{given}{class_()}>{inside}</fixed>'
    for _ in range(5):
        tag = str(rng.choice(tags))
        at = f'tendon="t{rng.integers(3)}"' if rng.random() < 0.5 else f'joint="j{rng.integers(6)}"'
        actuators += f"<{tag} {at}{class_()}{random_attributes(rng, tag, in_class=False)}/>"
    flags = "".join(f' {name}="disable"' for name in ("spring", "damper", "actuation") if rng.random() < 0.15)
    return (
        f'<mujoco><compiler angle="{rng.choice(["degree", "radian"])}"/>'
        f'<option><flag constraint="disable"{flags}/></option>'
        f"<default>{default('outer', 0)}</default><worldbody>{bodies}</worldbody><tendon>{tendons}</tendon>"
        f"<actuator>{actuators}</actuator></mujoco>"
    )


def mujoco_terms(text: str, q: Any, v: Any) -> tuple[Any, Any, Any]:
    """Return M, the passive force with that of actuators at zero control, and the accelerations, as MuJoCo has them."""
    m = mujoco.MjModel.from_xml_string(text)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = q, v
    d.ctrl[:] = 0.0
    mujoco.mj_forward(m, d)
    M = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, M)
    return M, d.qfrc_passive + d.qfrc_actuator, np.array(d.qacc)


@pytest.mark.parametrize("seed", range(60))
def test_random_tendons_and_actuators_are_what_mujoco_makes_of_them(seed, tmp_path):
    text = random_transmissions(seed)
    (tmp_path / "robot.xml").write_text(text)
    model = mb.load(tmp_path / "robot.xml")
    q, v = model.random_state(np.random.default_rng(seed))
    M, force, a = mujoco_terms(text, q, v)
    dyn = mb.dynamics(model, "pinocchio")
    np.testing.assert_allclose(dyn.mass_matrix(q), M, rtol=0, atol=1e4 * EPS * np.abs(M).max())
    np.testing.assert_allclose(dyn.passive(q, v), force, rtol=0, atol=1e4 * EPS * max(1, np.abs(force).max()))
    np.testing.assert_allclose(
        dyn.forward_dynamics(q, v, np.zeros(model.nv)), a, rtol=0, atol=1e3 * EPS * np.linalg.cond(M) * np.abs(a).max()
    )
