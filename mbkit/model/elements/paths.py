"""Paths: all that a model goes through, each with the kinds of parts that it carries; it refuses the others by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from mbkit.errors import InputError, UnsupportedError
from mbkit.model.elements.kinds import EFFECTS, PART_KINDS, Kind, kind, unregistered

#: A `mbkit.model.description.Description`, a floor above.
_Model = Any


@dataclass(frozen=True, eq=False)
class Path:
    """A path of a model, such as an engine, a file format or a kind of run, and its gate. It registers itself.

    Attributes
    ----------
    name : str
        Key in `PATHS`.
    words : str
        Begin of a refusal; the model's name follows. Empty for a path of several users, who give their own.
    carries : frozenset of str
        Names of kinds, and effects: ``"V"`` and ``"t"`` stand for all kinds that have these effects alone.
    why : mapping of str to str
        Reasons for refusals, by kind or effect; the first one counts.
    notes : mapping of str to str or callable
        Notes on what is carried otherwise, or left out, by kind or effect, or functions of the model that return them.
        A kind with a note is not refused.
    asks : (set of str, str)
        Kinds and effects of which one has to act, and the fault of a model without.
    apart : tuple of (str, str, str)
        Two kinds or effects that it does not carry together, and why.
    also : callable
        ``also(model)`` yields further faults, which depend on numbers.
    beside : callable
        ``beside(model)`` yields further notes, on what is of no kind.
    instead : str
        Remedies, beside `Model.without`.
    """

    name: str
    words: str
    carries: frozenset[str]
    why: dict[str, str] = field(default_factory=dict)
    notes: Mapping[str, str | Callable[[_Model], str]] = field(default_factory=dict)
    asks: tuple[frozenset[str], str] = (frozenset(), "")
    apart: tuple[tuple[str, str, str], ...] = ()
    also: Callable[[_Model], Iterable[str]] = lambda _: ()
    beside: Callable[[_Model], Iterable[str]] = lambda _: ()
    instead: str = ""

    def __post_init__(self) -> None:
        named = {*self.carries, *self.why, *self.notes, *self.asks[0], *(x for *two, _ in self.apart for x in two)}
        for name in named - {*EFFECTS}:
            kind(name)
        if PATHS.setdefault(self.name, self) is not self:
            raise InputError(f"path {self.name!r}: expected a name that no other path has")

    def takes(self, kind: Kind) -> bool:
        """Return whether it carries a kind, or leaves it out with a note."""
        if kind.name in self.carries or kind.name in self.notes:
            return True
        # A kind that does the same as another one is carried with that.
        return bool(kind.does) and all(
            x in self.carries or (x in PART_KINDS and self.takes(PART_KINDS[x])) for x in kind.does
        )

    def admit(self, model: _Model, words: str = "") -> tuple[str, ...]:
        """Return the notes on a model; raise `UnsupportedError` with every part that the path does not carry."""
        if refusal := self.refuses(model, words):
            raise UnsupportedError(refusal)
        kinds = [kind(name) for name in model.acts] if self.notes else []
        notes = [text for key, text in self.notes.items() if any(_is(k, key) for k in kinds)]
        texts = (text if isinstance(text, str) else text(model) for text in notes)
        return tuple(filter(None, dict.fromkeys([*texts, *self.beside(model)])))

    def refuses(self, model: _Model, words: str = "") -> str:
        """Return why the path does not carry a model, with every part; empty where it does."""
        kinds = [kind(name) for name in model.acts]
        lost = [k for k in kinds if not self.takes(k)]
        asked, absent = self.asks
        lacks = [absent] if absent and not any(_is(k, x) for k in kinds for x in asked) else []
        lacks += unregistered(model)
        faults = dict.fromkeys([*lacks, *self._refused(model, lost), *self._together(model, kinds), *self.also(model)])
        features = ", ".join(dict.fromkeys(repr(k.features[-1]) for k in lost if k.features))
        remedies = self.instead, f"model.without({features}) leaves them out" if features else ""
        return f"{self.words or words} {model.name}: {'; '.join(filter(None, (*faults, *remedies)))}" if faults else ""

    def _refused(self, model: _Model, lost: list[Kind]) -> Iterator[str]:
        leaders = {p.name for k in lost if "q" in k.does for p in k.parts(model)}
        for k in lost:
            why = next((f", and {text}" for key, text in self.why.items() if _is(k, key)), "")
            # A part is told of by its finest kind, and what follows another joint with that.
            finer = [x for x in lost if x.name.startswith(k.name + ".")]
            for p in k.parts(model):
                follows = "q" in k.does and p.mimic and p.mimic.joint in leaders
                if not follows and not any(x.at(model, p) for x in finer):
                    yield k.words.format(p=p) + why

    def _together(self, model: _Model, kinds: list[Kind]) -> Iterator[str]:
        for *two, why in self.apart:
            first = [next((k for k in kinds if _is(k, x)), None) for x in two]
            if all(first):
                yield ", while ".join(k.words.format(p=k.parts(model)[0]) for k in first if k) + f": {why}"


#: Effects of paths that take all but kinds of no known effect.
ALL: Final = frozenset({*EFFECTS, "energies"})
#: And what those carry that go by bodies.
OF_BODIES: Final = ALL - {"energies"}
#: Paths by name.
PATHS: Final[dict[str, Path]] = {}


def _is(kind: Kind, key: str) -> bool:
    return key == kind.name or key in kind.does
