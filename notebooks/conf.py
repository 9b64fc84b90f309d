"""The book, built by Sphinx from pages whose cells run: ``sphinx-build -W -j auto notebooks build/book``."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from docutils import nodes
from jupyter_cache import get_cache
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.domains.python import PyObject
from sphinx.util.docfields import TypedField

import mbkit

project = "mbkit"
author = "the authors of mbkit"
copyright = "2026, the authors of mbkit"  # noqa: A001  # Sphinx's name
version = release = mbkit.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "sphinx_design"]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
# A name in backquotes that is no reference stays code.
default_role = "code"

# Text
myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# Cells
nb_execution_mode = "cache"
nb_execution_timeout = 180
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
nb_render_markdown_format = "myst"
nb_execution_excludepatterns = ["examples/*"]
nb_render_image_options = {"align": "center"}

# Signatures
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {
    "members": True,
    "inherited-members": "object, tuple, dict, BaseException, Exception, OSError, LookupError",
}
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

# Pages: nothing is loaded from a network.
html_theme = "furo"
html_title = "mbkit"
html_static_path = ["_static"]
html_css_files = ["book.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False

# For cells: where the repository is, and figures as SVG.
os.environ["MBKIT_TOP"] = str(Path(__file__).resolve().parent.parent)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (os.environ["MBKIT_TOP"], os.environ.get("PYTHONPATH"))))
# Cells run commands of this environment, which need not be activated.
os.environ["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
_profile = Path(os.environ.setdefault("IPYTHONDIR", tempfile.mkdtemp(prefix="mbkit-book-"))) / "profile_default"
if not _profile.exists():
    _profile.mkdir()
    (_profile / "ipython_kernel_config.py").write_text(
        # Figures made without pyplot are shown too.
        "c.IPKernelApp.matplotlib = 'inline'\n"
        "c.InlineBackend.figure_formats = {'svg'}\nc.HistoryManager.enabled = False\n",
        encoding="utf-8",
    )
    atexit.register(shutil.rmtree, _profile.parent, ignore_errors=True)


# Below an exponent or an index there is no room for a space.
_FUNCTION = re.compile(
    r"(?<!<msup>)(?<!<msub>)(?<!<msubsup>)(<mi>(?:arctan|cos|cosh|cot|exp|log|ln|sin|sinh|tan)</mi>)"
)


def _mathml(translator: Any, node: nodes.Element, *, block: bool) -> None:
    """Write a formula as MathML, which a browser shows without a script and a screen reader reads."""
    # The converter knows one name for lines that are aligned.
    tex = node.astext().replace("{aligned}", "{align*}").replace("{align}", "{align*}")
    # It knows no column of lines. They begin at the left, as wide ones run out of the page.
    tex = tex.replace("\\begin{gathered}", "\\begin{array}{l}").replace("\\end{gathered}", "\\end{array}")
    if block and "\\begin{" not in tex and "\\\\" in tex:
        tex = f"\\begin{{align*}}{tex}\\end{{align*}}"
    text = convert(tex, display="block" if block else "inline")
    # The converter sets no space beside the name of a function, and takes ⟂ for one letter.
    text = text.replace("<mi>&#x027C2;</mi>", "<mo>&#x027C2;</mo>")
    text = _FUNCTION.sub(r'<mspace width="0.17em" />\1<mspace width="0.17em" />', text)
    translator.body.append(f'<div class="math">{text}</div>' if block else text)
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register the writer of formulas; a type such as ``(nv,) array`` is text, and no reference to some `nv`."""
    for field in PyObject.doc_field_types:
        if isinstance(field, TypedField):
            field.typerolename = ""
    # Pages are read side by side, and each process would make the cache of their cells.
    get_cache(Path(app.outdir).parent / ".jupyter_cache").list_cache_records()
    sys.path.insert(0, os.environ["MBKIT_TOP"])
    from validation import page_kernels

    page_kernels.use()
    app.add_html_math_renderer(
        "mathml",
        (lambda self, node: _mathml(self, node, block=False), None),
        (lambda self, node: _mathml(self, node, block=True), None),
    )
