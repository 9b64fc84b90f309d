"""What each cause does to a motion: two described systems under one controller, with one cause after the other.

Each cause is put alone into the first world, and taken alone out of the second; how far the motion changes by that is
its effect, in rad and m.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import UnsupportedError
from mbkit.methods.simulation_settings import WORDS, Settings
from mbkit.model import Model
from mbkit.model.elements.kinds import EFFECTS, kind
from mbkit.model.elements.paths import Path
from mbkit.model.validation import model_faults
from mbkit.simulate.progress import Bar
from mbkit.studies.explain.controlled_runs import DEFAULTS, Motion, Run, Runner, runnable
from mbkit.studies.explain.hypotheses import Hypothesis
from mbkit.studies.explain.joint_matching import Matching
from mbkit.studies.explain.merged_model import MergedModel, merge
from mbkit.studies.explain.motion_result import CauseMotion, MotionComparison
from mbkit.studies.explain.worlds import World, joint_order, setting_differences, settings_text


def _lost_in_merging(model: Model) -> Iterator[str]:
    """Yield the parts that act and that a description with fused links does not have; fixed joints are what fuses."""
    left = merge(model).model.acts if model.has_bodies else {}
    fixed = {j.name for j in model.joints if not j.type.nv}
    for name, parts in model.acts.items():
        lost = {*parts} - {*left.get(name, ())} - fixed
        some = (p for p in kind(name).parts(model) if p.name in lost)
        yield from (kind(name).words.format(p=p) + ", which is lost where links are fused" for p in some)


MOTIONS: Final = Path(
    "motions",
    "motions are compared of descriptions whose fixed links are fused, without",
    frozenset(EFFECTS),
    also=_lost_in_merging,
)


@dataclass(frozen=True, eq=False)
class Compared:
    """What `explain` has found of two descriptions.

    `alike` are both with the same joints and frames, in which the `regular` differences stand; `read` are both as they
    were read, the second in the first's names. `bases` are differences in the frames of free bodies, `alone` those in
    the joints themselves. `order` has the joints of the second, in its own names and order.
    Motions begin at `time`, s.
    """

    alike: tuple[MergedModel, MergedModel]
    read: tuple[MergedModel, MergedModel]
    regular: tuple[Hypothesis, ...]
    bases: tuple[Hypothesis, ...]
    alone: tuple[Hypothesis, ...]
    matching: Matching
    order: tuple[str, ...]
    time: float

    def worlds(self, settings: tuple[Settings, Settings]) -> tuple[World, World]:
        """Return both sides in like frames, at the first's time."""
        name = {m.b: m.a for m in self.matching.pairs}
        held = (replace(x, joint=name[x.joint]) for x in settings[1].servos or () if x.joint in name)
        second = replace(settings[1], servos=None if settings[1].servos is None else tuple(held))
        orders = (
            tuple(j.name for j in self.alike[0].model.independent_joints),
            tuple(name[n] for n in self.order if n in name),
        )
        timed = (x.put(("",), {"time": self.time}) for x in self.alike)
        one, other = (World(*x) for x in zip(timed, (settings[0], second), orders, strict=True))
        return one, other


def compare_motions(compared: Compared, motion: Motion, names: tuple[str, str]) -> MotionComparison:
    """Run both sides, and both with each cause alone put in or taken out."""
    first, second = compared.worlds((motion.settings[0] or Settings(), motion.settings[1] or Settings()))
    unsaid = _unsaid(first.settings, second.settings, names)
    first, second, notes = runnable(first, second)
    settings = setting_differences(first.settings, second.settings)
    if any(w.settings.engine == DEFAULTS.engine and "jump" in w.system.model.effects for w in (first, second)):
        notes.append("dry friction is soft in these runs, as it is in MuJoCo")
    causes = [*compared.regular, *settings, *joint_order(first, second)]
    # As they were read, with frames of free bodies and with joints that one side has alone.
    framed = second
    for h in compared.bases:
        framed = h.apply(framed)
    wholes = [first, framed]
    for k, only in enumerate((compared.matching.only_a, compared.matching.only_b)):
        if only:
            wholes[k] = replace(wholes[k], system=compared.read[k].put(("",), {"time": compared.time}))
    runner = Runner(first, motion, names[1])
    runner.require_no_memory(first)
    found = list[CauseMotion]()
    with Bar("motions") as bar:
        whole, joints = runner.apart(*wholes)
        together = first
        for k, h in enumerate(causes):
            bar((k + 1) / (len(causes) + 2), h.kind)
            sides = ((first, h.apply), (second, h.revert))
            found.append(_effect(runner, h, *(_measured(runner, world, change) for world, change in sides)))
            together = h.apply(together)
        for h in compared.bases:
            found.append(_effect(runner, h, _measured(runner, first, h.apply), _measured(runner, framed, h.revert)))
            together = h.apply(together)
        pairs = [(first, wholes[0]), (framed, wholes[1])]
        if compared.alone:
            # They are one difference: the joints that a side has alone are held or taken away together.
            says = "; ".join(f"{h.subject} ({h.says})" for h in compared.alone)
            h = Hypothesis(compared.alone[0].kind, "", f"has other joints: {says}")
            found.append(_effect(runner, h, *(None if a is b else runner.apart(a, b) for a, b in pairs)))
        steps = [runner.apart(first, together), *(runner.apart(a, b) for a, b in pairs if a is not b)]
        left, _ = runner.apart(together, framed)
    explained = np.fmax.reduce([x.max(axis=1, initial=0.0) for x, _ in steps])
    ends = [f"{name}: {run.why}" for name, run in zip(names, map(runner.of, wholes), strict=True) if run.why]
    here = [int(np.searchsorted(runner.grid, t)) for t in motion.times]
    over_time, unexplained = (x.max(axis=1, initial=0.0) for x in (whole, left))
    shown = joints[int(np.argmax(np.nan_to_num(whole).max(axis=0)))] if joints else ""
    left_out = (f"{x} of {n}" for n, some in zip(names, motion.left_out, strict=True) for x in some)
    return MotionComparison(
        a=names[0],
        b=names[1],
        times=tuple(map(float, motion.times)),
        bound=motion.bound,
        controller=runner.controller,
        settings=tuple(settings_text(x.settings) for x in wholes),
        whole=tuple(over_time[here].tolist()),
        explained=tuple(explained[here].tolist()),
        unexplained=tuple(unexplained[here].tolist()),
        effects=tuple(sorted(found, key=lambda x: -x.largest)),
        not_compared=(*unsaid, *left_out),
        notes=(*notes, *ends),
        grid=tuple(runner.grid.tolist()),
        joint=shown,
        paths=tuple(_path(runner.of(world), shown, len(runner.grid)) for world in wholes),
        over_time=tuple(over_time.tolist()),
        first=first,
    )


def _measured(runner: Runner, world: World, change: Callable[[Any], Any]) -> tuple[Array, list[str]] | None:
    """Return how far a change moves a world; None where the changed one cannot be, or cannot be run."""
    changed = change(world)
    # One number of several may not be changed alone, such as a Stribeck velocity without stiction.
    if {*model_faults(changed.system.model)} - {*model_faults(world.system.model)}:
        return None
    try:
        return runner.apart(world, changed)
    except (UnsupportedError, ArithmeticError):
        return None


def _effect(
    runner: Runner, h: Hypothesis, alone: tuple[Array, list[str]] | None, without: tuple[Array, list[str]] | None
) -> CauseMotion:
    here = [int(np.searchsorted(runner.grid, t)) for t in runner.motion.times]
    sizes = [None if x is None else x[0].max(axis=1, initial=0.0) for x in (alone, without)]
    read = [(np.nan,) * len(here) if x is None else tuple(float(x[k]) for k in here) for x in sizes]
    known = [x for x in sizes if x is not None]
    over = np.fmax.reduce(known) if known else np.full(len(runner.grid), np.nan)
    beyond = np.flatnonzero(over > runner.motion.bound)
    values, names = alone or without or (np.zeros((1, 0)), [])
    joint = names[int(np.argmax(np.nan_to_num(values).max(axis=0)))] if names else ""
    passes = float(runner.grid[beyond[0]]) if len(beyond) else np.nan
    over_time = tuple(over.tolist())
    return CauseMotion(h.kind, h.subject, h.sentence(runner.other), read[0], read[1], passes, joint, over_time, h)


def _path(run: Run, joint: str, n: int) -> tuple[tuple[float, ...], ...]:
    """Return the coordinates of a joint over the grid, NaN after the run's end."""
    x = run.positions.get(joint, np.zeros((0, 0)))
    return tuple(map(tuple, np.vstack([x, np.full((n - len(x), x.shape[1]), np.nan)]).tolist()))


def _unsaid(a: Settings, b: Settings, names: tuple[str, str]) -> list[str]:
    """Return what one side alone has said of its simulation; the period of control is no file's."""
    for x, other, name in ((a, b, names[0]), (b, a, names[1])):
        if other.engine is not None and x == Settings():
            return [f"the simulation of {name}, of which nothing is said"]
    some = (f.name for f in fields(Settings) if (getattr(a, f.name) is None) != (getattr(b, f.name) is None))
    return [WORDS[n][0] if n in WORDS else n for n in some if n != "control_period"]
