"""The run that chooses: rk853 where steps follow the motion, rodas5 where stability alone holds them short.

It begins with rk853 and looks, after some tries and each time that their number has doubled, at how many more
the run will take (`mbkit.simulate.auto_course`). Everything is decided by counted tries and by states, nothing
by a clock: a run repeats to the bit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from mbkit.errors import FunctionError
from mbkit.model.space import Space
from mbkit.simulate.asked import Asked
from mbkit.simulate.auto_course import Course, pause
from mbkit.simulate.auto_scene import EXPLICIT, Scene
from mbkit.simulate.embedded import march, outcome_of, stops_of
from mbkit.simulate.embedded_trials import Trials
from mbkit.simulate.outcome import Outcome

__all__ = ["run_auto"]

#: Kinds of courses of a batch that are told.
_FEW: Final = 3


def run_auto(asked: Asked) -> Outcome:
    """Integrate one state, or a batch of them, of which each is decided on by itself."""
    q0, v0, save, batch = asked.q, asked.v, asked.save, asked.batch
    space = Space(asked.dyn.model)
    scene = Scene(asked, space, stops_of(asked))
    courses = [Course(scene, i, q0.shape[1], save, asked.events) for i in range(len(q0))]
    explicit = scene.make(EXPLICIT, scene.granted(EXPLICIT, asked.tolerances))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for first in range(0, len(q0), explicit.width):
            part = slice(first, first + explicit.width)
            group = _Group(courses[part], first, asked)
            try:
                for course, q, v in zip(group.courses, q0[part], v0[part], strict=True):
                    course.track.begin(q, v)
                begun = space.enter(q0[part], v0[part])
                explicit.start(range(first, first + len(group.courses)), q0[part], begun, asked.start)
                group.together(scene, explicit)
            except FunctionError as error:
                # Where the torque is a function, trajectories run one by one.
                which = getattr(error, "member", None)
                group.courses[0 if which is None else which - first].track.member.fail(error)
                break
    tracks = [course.track for course in courses]
    outcome = outcome_of(asked.dyn, tracks, batch, save, scene.evaluations, scene.jacobians)
    told = outcome.ended in ("finished", "event")
    doubts = tuple(dict.fromkeys(course.doubt for course in courses if course.doubt and told))
    return replace(outcome, chosen=_chosen(courses, batch), doubts=(*outcome.doubts, *doubts))


class _Group:
    """Trajectories that begin side by side."""

    def __init__(self, courses: Sequence[Course], first: int, asked: Asked) -> None:
        self.courses, self._first, self._asked = courses, first, asked

    def together(self, scene: Scene, explicit: Trials) -> None:
        """Take all to the end: explicitly side by side, what leaves that one by one."""
        tracks = [course.track for course in self.courses]
        pause(explicit, self.courses)
        for made in march(explicit, tracks, scene.stops):
            for place, stretch in made:
                if self.courses[place].leaves(explicit, place, stretch):
                    explicit.drop(place)
            pause(explicit, [self.courses[place] for place, _ in made])
            self._tell()
        for course in self.courses:
            course.alone(self._tell)

    def _tell(self) -> None:
        asked = self._asked
        done = sum(course.track.member.reached - asked.start for course in self.courses) / asked.duration
        asked.bar.update((self._first + done) / len(asked.q))


def _chosen(courses: Sequence[Course], batch: int | None) -> str:
    if batch is None:
        return courses[0].told()
    kinds = Counter(course.kind() for course in courses)
    parts = []
    for kind, count in kinds.most_common(_FEW):
        example = next(i for i, course in enumerate(courses) if course.kind() == kind)
        told = courses[example].told()
        such = "" if told == kind else f", such as trajectory {example}"
        parts.append(f"{count} of {batch}{such}: {told}")
    if len(kinds) > _FEW:
        parts.append(f"and {len(kinds) - _FEW} more kinds")
    return "; ".join(parts)
