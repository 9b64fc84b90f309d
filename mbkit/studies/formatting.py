"""Numbers, judgements, settings and facts as text, the same on a terminal and on a page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from mbkit._check import by_key
from mbkit.studies.document import Bullet, Span, Text
from mbkit.studies.results import Refusal

#: Letters of a list that has a place in a sentence.
_MAX_LISTED_LETTERS: Final = 80
_UNITS: Final = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))


def error_text(x: float) -> str:
    """Return an error with two digits; no one needs a third."""
    if math.isnan(x):
        return "NaN"
    if math.isinf(x):
        return "∞" if x > 0 else "−∞"
    return "0" if x == 0 else f"{x:.1e}"


def time_text(seconds: float) -> str:
    """Return a time with three digits and its unit; empty where it was not measured."""
    if math.isnan(seconds):
        return ""
    if math.isinf(seconds):
        return "∞"
    size = abs(seconds)
    if size >= 99.95:
        return f"{seconds:.0f} s"
    for scale, unit in _UNITS:
        # Half of the last digit shown, so that 999.6 ns is not "1000 ns".
        if size >= 0.9995 * scale:
            return f"{seconds / scale:.{0 if size >= 99.95 * scale else 1 if size >= 9.995 * scale else 2}f} {unit}"
    return "0 ns" if size < 5e-12 else f"{seconds * 1e9:.2f} ns"


def count_text(x: float) -> str:
    """Return a factor without decimals where it has three digits."""
    return "" if math.isnan(x) else "∞" if math.isinf(x) else f"{x:.3g}" if abs(x) < 1000 else f"{x:.1e}"


def judged(passed: bool | None, text: str) -> Span:
    """Return a text with ✓ or ✗ before it; with a dash where nothing was judged."""
    if passed is None:
        return Span(f"– {text:>7}", "muted")
    return Span(f"✓ {text:>7}", "good") if passed else Span(f"✗ {text:>7}", "bad")


def setting_words(value: Any) -> str:
    """Return a setting (a switch, a number, a text or several of them) as a person writes it."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, Mapping):
        return "; ".join(f"{k}: {setting_words(x)}" for k, x in value.items())
    return ", ".join(map(setting_words, value)) if isinstance(value, (list, tuple)) else str(value)


def missing_text(missing: Iterable[str]) -> str:
    """Return what a study left out, to follow a sentence; of long lists their number alone, as they stand below."""
    return "".join(f"; {x if len(x) <= _MAX_LISTED_LETTERS else x.rpartition(':')[0] or x}" for x in missing)


def refusals(those: Iterable[Refusal]) -> list[Bullet]:
    """Return what engines could not do, those of one reason together."""
    out = []
    for (engine, reason), names in by_key(((r.engine, r.reason), r.term) for r in those).items():
        of = f" ({', '.join(dict.fromkeys(filter(None, names)))})" if any(names) else ""
        out.append(Bullet(f"{engine}{of}".strip(), reason))
    return out


def model_facts(facts: Mapping[str, Any], target: str, setup: Mapping[str, float]) -> Iterator[tuple[str, Text]]:
    """Yield what a page says of a model."""
    if target:
        yield "asked for as", target
    mass = f", {facts['mass']:.5g} kg" if "mass" in facts else ""
    yield "size", f"nq = {facts.get('nq', '?')} coordinates, nv = {facts.get('nv', '?')} velocities{mass}"
    if "needs" in facts:
        for name, there in (("has", True), ("has not", False)):
            needs = ", ".join(need.replace("_", " ") for need, has in facts["needs"].items() if has == there)
            yield name, Span(needs or "–", "" if there else "muted")
    if "digest" in facts:
        yield "digest", Span(facts["digest"], "mono")
    if setup:
        yield "set-up", ", ".join(f"{engine} {time_text(seconds)}" for engine, seconds in setup.items())
