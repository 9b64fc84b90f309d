r"""Safe text from names: one function for each kind of output.

Names of robots, links, joints and symbols come from untrusted files. Each function here returns text that the
reader of its output (a terminal, a browser, TeX, Python, a C compiler, an XML parser) takes as text alone. Characters
that cannot be seen, such as a terminal's control codes and marks that change the direction of writing, are spelled
out in all of them: ``\x1b``, ``\u202e``.
"""

from __future__ import annotations

import builtins
import html as _html
import keyword
import re
import unicodedata
from collections.abc import Callable, Container
from typing import Final


def terminal(text: str) -> str:
    """Return text with everything spelled out that a terminal would obey; line feeds stay."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str, most: int = 0) -> str:
    """Return text for a terminal on one line, cut after `most` characters if that is a number."""
    one = " ".join(terminal(text).split())
    return one if not most or len(one) <= most else one[: most - 1].rstrip() + "…"


def html(text: str) -> str:
    """Return text for a page, inside an element or a quoted attribute."""
    return _html.escape(terminal(text))


#: Characters that Markdown reads as a mark inside a line; an underscore only where it does not stand inside a word.
_MARKS: Final = re.compile(r"[\\`*\[\]|~$]|(?<![^\W_])_|_(?![^\W_])")
#: Text that it reads as a mark at the beginning of a line, a cell or a list's entry.
_LEADING: Final = re.compile(r"(?=[#+=>-])|(?<=\d)(?=[.)]\s)")


def markdown(text: str) -> str:
    """Return text for one line or one cell of a table in Markdown; HTML in it is escaped."""
    marked = _MARKS.sub(lambda m: "\\" + m[0], one_line(text))
    if found := _LEADING.match(marked):
        marked = marked[: found.end()] + "\\" + marked[found.end() :]
    return _html.escape(marked, quote=False)


#: Commands that are letters, accents and fonts: what SymPy and textbooks have in names.
_COMMAND: Final = re.compile(
    r"\\(?:(?:var)?(?:epsilon|theta|pi|rho|sigma|phi|kappa)|alpha|beta|gamma|delta|zeta|eta|iota|lambda|mu|nu|xi|tau|"
    r"upsilon|chi|psi|omega|Gamma|Delta|Theta|Lambda|Xi|Pi|Sigma|Upsilon|Phi|Psi|Omega|ell|hbar|d{1,4}ot|hat|bar|tilde|"
    r"vec|acute|grave|check|breve|overline|underline|mathrm|mathbf|mathit|mathsf|mathtt|mathcal|mathbb|mathscr|mathfrak|"
    r"boldsymbol|text|textrm|operatorname|prime|circ|parallel|perp|star|ast|dagger)(?![A-Za-z])"
)
_TEX: Final = {"\\": r"\backslash ", "^": r"{\wedge}", "~": r"{\sim}", " ": r"\ ", **{c: f"\\{c}" for c in "{}$%#&_"}}


def latex(name: str, ordinary: Callable[[str], str]) -> str:
    r"""Return a symbol's name in LaTeX's mathematics.

    Parameters
    ----------
    name : str
        May be LaTeX itself, such as ``\dot{\theta}_{1}``, of letters, accents and fonts.
    ordinary : callable
        How a name is set that holds no other command and no character that TeX obeys.
    """
    rest = _COMMAND.sub("", name)
    harmless = rest.isprintable() and not re.search(r"[\\$%#&~\[\]]|\^\s*\^|[_^]\s*$", rest) and _balanced(rest)
    return ordinary(name) if harmless else rf"\mathrm{{{''.join(_TEX.get(c, c) for c in one_line(name))}}}"


def _balanced(text: str) -> bool:
    depth = 0
    for c in text:
        depth += (c == "{") - (c == "}")
        if depth < 0:
            return False
    return depth == 0


def python_docstring(text: str) -> str:
    """Return text for one line inside a docstring of double quotes, whose value is the text."""
    return one_line(text).replace("\\", "\\\\").replace('"', '\\"')


def identifier(name: str, taken: Container[str] = ()) -> str:
    """Return a name as Python and SymPy read it: as it is where it is one, and else with underscores.

    What Python reads as the same name, such as letters of full width, is the same here. A name that is a keyword, a
    built-in function or `taken` gets an underscore behind it.
    """
    plain = unicodedata.normalize("NFKC", name)
    plain = "".join(c if f"_{c}".isidentifier() else "_" for c in plain)
    plain = plain if plain.isidentifier() else f"_{plain}"
    while keyword.iskeyword(plain) or hasattr(builtins, plain) or plain in taken:
        plain += "_"
    return plain


def c_comment(text: str) -> str:
    """Return text for a comment in C: nothing in it ends the comment, and there are no trigraphs."""
    return "".join(f"\\x{ord(c):02x}" if c in "*?" else c for c in one_line(text))


def xml_attribute(text: str) -> str:
    """Return text as an attribute's value in XML, with its quotes; see `xml_holds`."""
    return '"' + "".join(_XML.get(c) or (c if c.isprintable() else _reference(c)) for c in text) + '"'


_XML: Final = {"<": "&lt;", ">": "&gt;", "&": "&amp;", '"': "&quot;"}


def _reference(c: str) -> str:
    return f"&#x{ord(c):x};" if xml_holds(c) else terminal(c)


def xml_holds(text: str) -> bool:
    """Return whether XML has a way to write each character of a text."""
    return not re.search("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]", text)


def xml_comment(text: str) -> str:
    """Return text for a comment in XML, which may hold no two hyphens in a row."""
    return re.sub("-(?=-|$)", "- ", one_line(text))


def csv_text(text: str) -> str:
    """Return text for a cell that a spreadsheet takes for no formula."""
    one = one_line(text)
    return f"'{one}" if one[:1] in ("=", "+", "-", "@") else one


def json_text(text: str) -> str:
    r"""Return JSON in which what cannot be seen is written as JSON writes it, such as ``\u001b``."""
    return "".join(c if c.isprintable() or c == "\n" else _units(c) for c in text)


def _units(c: str) -> str:
    raw = c.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{raw[k]:02x}{raw[k + 1]:02x}" for k in range(0, len(raw), 2))
