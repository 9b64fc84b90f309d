"""The catalog against closed forms written apart from mbkit, on every engine."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from mbkit import catalog
from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.model import Model
from validation import closed_forms

EPS = np.finfo(float).eps

#: Numbers that hide no factor, in the order in which the closed form takes them.
NUMBERS: list[tuple[str, dict[str, Any]]] = [
    ("pendulum", {"length": 0.7, "mass": 1.3, "gravity": 3.7}),
    ("double_pendulum", {"length1": 0.7, "mass1": 1.3, "length2": 1.9, "mass2": 0.4, "gravity": 3.7}),
    ("cart_pole", {"cart_mass": 2.1, "pole_mass": 0.3, "length": 0.6, "gravity": 3.7}),
    ("spherical_pendulum", {"length": 0.7, "mass": 1.3, "gravity": 3.7}),
    ("chain", {"n": 1}),
    ("chain", {"n": 4, "length": 0.6, "mass": 1.7, "gravity": 3.7}),
    ("heavy_top", {"mass": 2.0, "inertia": (0.3, 0.4, 0.6), "com": (0.1, -0.2, 0.7), "gravity": 3.7}),
    ("free_body", {"mass": 2.0, "sides": (0.5, 0.3, 0.2), "gravity": 3.7}),
]
# Each system with its defaults and with those.
CASES: dict[str, tuple[Model, closed_forms.System]] = {
    " ".join((name, *map(str, numbers.values()))): (
        catalog.get(name)(**numbers),
        getattr(closed_forms, name)(*numbers.values()),
    )
    for name, given in NUMBERS
    for numbers in ({}, given)
}


def test_every_system_is_found_by_tab_completion():
    assert {*dir(catalog)} == {*catalog.systems(), "get", "systems"}


def engine(model: Model, name: str) -> Dynamics:
    try:
        return dynamics(model, name)
    except UnsupportedError as error:
        if "not installed" in str(error):
            pytest.skip(str(error))
        raise


def states(model: Model) -> list[tuple[np.ndarray, np.ndarray]]:
    q, v = model.random_state(np.random.default_rng(5), 8)
    return [(model.neutral(), np.zeros(model.nv)), *zip(q, 3 * v, strict=True)]


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize("case", CASES)
def test_engines_agree_with_closed_forms(case: str, name: str) -> None:
    """Terms to 64 eps of their scale, accelerations to that times cond(M)."""
    model, form = CASES[case]
    dyn = engine(model, name)
    rng = np.random.default_rng(6)
    for q, v in states(model):
        tau = rng.standard_normal(model.nv)
        M, g, nle = form.mass_matrix(q), form.gravity(q), form.nle(q, v)
        diagonal = np.sqrt(np.diag(M))
        assert np.all(np.abs(dyn.mass_matrix(q) - M) <= 64 * EPS * np.outer(diagonal, diagonal))
        # Gravity may vanish at a pose by cancellation, so its scale is not its own size.
        weight = model.mass * float(np.linalg.norm(model.gravity)) * max(1.0, diagonal.max())
        force = weight + float(np.linalg.norm(M) * (v @ v))
        assert np.all(np.abs(dyn.gravity(q) - g) <= 64 * EPS * weight)
        assert np.all(np.abs(dyn.nle(q, v) - nle) <= 64 * EPS * force)
        a = form.forward_dynamics(q, v, tau)
        scale = float(np.linalg.cond(M) * (np.linalg.norm(a) + force / np.linalg.norm(M)))
        assert np.linalg.norm(dyn.forward_dynamics(q, v, tau) - a) <= 64 * EPS * max(scale, 1.0)
        energy = force * max(1.0, float(np.abs(q).max()))
        assert abs(dyn.kinetic_energy(q, v) - form.kinetic_energy(q, v)) <= 64 * EPS * energy
        assert abs(dyn.potential_energy(q) - form.potential_energy(q)) <= 64 * EPS * max(energy, weight)


@pytest.mark.parametrize(
    ("name", "q", "tip"),
    [
        ("pendulum", [np.pi / 2], (1.0, 0.0, 0.0)),
        ("pendulum", [0.0], (0.0, 0.0, -1.0)),
        ("double_pendulum", [np.pi / 2, -np.pi / 2], (1.0, 0.0, -1.0)),
        ("cart_pole", [0.3, np.pi / 2], (1.3, 0.0, 0.0)),
        ("spherical_pendulum", [np.pi / 2, 0.0], (1.0, 0.0, 0.0)),
        ("spherical_pendulum", [1.0, np.pi / 2], (0.0, 1.0, 0.0)),
        ("chain", [np.pi / 2, 0.0, 0.0, 0.0, np.pi / 2], (4.0, 0.0, 1.0)),
    ],
)
def test_angles_grow_from_down_towards_x(name: str, q: list[float], tip: tuple[float, ...]) -> None:
    dyn = dynamics(catalog.get(name)())
    assert dyn.pose(q, "tip")[:3, 3] == pytest.approx(np.array(tip), abs=1e-15)


@pytest.mark.thorough("128")
@pytest.mark.parametrize("n", closed_forms.published()["chain_conditioning"]["cond"])
def test_chain_is_as_ill_conditioned_as_published(n: str) -> None:
    wanted = closed_forms.published()["chain_conditioning"]["cond"][n]["cond"]
    model = catalog.chain(n=int(n))
    got = np.linalg.cond(dynamics(model).mass_matrix(model.neutral()))
    # A condition number loses as many digits as it has.
    assert got == pytest.approx(wanted, rel=4 * EPS * wanted + 64 * EPS)


def test_elliptic_solution_reaches_the_published_figures() -> None:
    figures = closed_forms.published()["iftomm_A01_pendulum"]["exact"]
    assert closed_forms.pendulum_period(np.pi / 2) == pytest.approx(float(figures["period"]), rel=4 * EPS)
    for key in ("t=1 x,y", "t=5 x,y", "t=9.99 x,y", "t=10 x,y"):
        time = float(key.split()[0].removeprefix("t="))
        theta, _ = closed_forms.pendulum_solution(np.array([time]), -np.pi / 2)
        got = np.array([np.sin(theta[0]), -np.cos(theta[0])])
        assert got == pytest.approx(np.array(figures[key], dtype=float), abs=1e-14)


def test_free_spin_starts_right_and_obeys_euler() -> None:
    box = closed_forms.published()["dzhanibekov_box"]
    inertia = closed_forms.box_inertia(box["m"], box["dims"])
    assert inertia == pytest.approx(np.array(box["I"]), rel=4 * EPS)
    _, period = closed_forms.free_spin(np.zeros(1), inertia, np.array(box["w0"], dtype=float))
    assert period == pytest.approx(float(box["exact_period"]), rel=16 * EPS)
    h = 1e-5
    for w0 in ([0.1, 5.0, 0.1], [-1.0, 0.5, -3.0], [3.0, -1.0, -2.0]):
        for moments in (inertia, np.array([1.0, 2.0, 1.5])):
            w, _ = closed_forms.free_spin(np.array([0.0, 1 - h, 1.0, 1 + h]), moments, np.array(w0))
            assert w[0] == pytest.approx(np.array(w0), abs=1e-13)
            rate = (w[3] - w[1]) / (2 * h)
            assert moments * rate == pytest.approx(-np.cross(w[2], moments * w[2]), abs=1e-7)


BAD = [
    ("pendulum", "length", 0.0),
    ("pendulum", "mass", -1.0),
    ("pendulum", "gravity", -9.81),
    ("double_pendulum", "mass2", np.nan),
    ("chain", "n", 0),
    ("chain", "n", 2.5),
    ("heavy_top", "com", (0.0, 1.0)),
    ("heavy_top", "inertia", (1.0, 1.0, 3.0)),
    ("free_body", "sides", (0.1, 0.0, 0.2)),
    ("free_body", "mass", None),
    ("slider_crank", "rod", 0.0),
]


@pytest.mark.parametrize(("name", "parameter", "value"), BAD)
def test_bad_parameters_are_named(name: str, parameter: str, value: Any) -> None:
    with pytest.raises(InputError, match=rf"^{parameter}: .*expected"):
        catalog.get(name)(**{parameter: value})


def test_registry() -> None:
    assert catalog.get("cart_pole") is catalog.cart_pole
    assert set(catalog.systems()) <= set(dir(catalog))
    with pytest.raises(UnknownNameError, match="unknown system 'cartpole'; did you mean 'cart_pole'"):
        catalog.get("cartpole")
    catalog.systems().clear()
    assert catalog.systems(), "the registry was handed out, not a copy"


@pytest.mark.parametrize("name", catalog.systems())
def test_systems_document_themselves(name: str) -> None:
    text = catalog.get(name).__doc__ or ""
    assert all(section in text for section in ("Parameters", "Raises", "References"))
    model = catalog.get(name)()
    assert model.name == {"chain": "chain_5", "four_bars": "four_bars_2", "scissor": "scissor_3"}.get(name, name)
    assert pickle.loads(pickle.dumps(model)) == model
    # What the docstring calls the coordinates is what the model calls them.
    assert all(f"``{joint}``" in text for joint in model.joint_names[:2])
