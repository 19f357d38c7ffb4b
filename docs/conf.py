"""The site of these pages: `make docs`."""

import re
from importlib.metadata import version as installed
from pydoc import locate

from sphinx.util.typing import stringify_annotation

from darswin.lens import Number

project, author, release = "darswin", "the darswin authors", installed("darswin")
copyright = author
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]

html_theme, html_title = "furo", "darswin"
html_static_path, html_css_files = ["_static"], ["tables.css"]

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

# Docstrings name things between single backticks.
default_role = "literal"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_inherit_docstrings = False  # Lightning's and torch's are in another markup
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Convention", ("Keys", "params_style")]
napoleon_use_rtype = False  # "(N,) rad" is a shape and a unit

# Names of other projects, since the site is built without a network.
OTHERS = "torch|torchmetrics|numpy|np|matplotlib|lightning|"
OTHERS += "collections|typing|os|pathlib|datetime|contextlib"
UNITS = r"[A-Z]|\d|rad|px"  # of properties, whose docstrings begin with shape and unit
nitpick_ignore_regex = [("py:.*", rf"({OTHERS})\..*"), ("py:class", UNITS)]


def one_a_line(app, what, name, obj, options, lines):
    """Gives each argument and each error a line of its own, as napoleon wants them."""
    found, indent = [], None
    for line in lines:
        start = len(line) - len(line.lstrip())
        if line.strip() in ("Args:", "Raises:"):
            indent = start + 4
        elif line.strip() and indent is not None and start < indent:
            indent = None
        if indent is not None:
            line = re.sub(r"(?<=[.;]) (?=[a-zA-Z_]\w*(, \w+)*: )", "\n" + " " * indent, line)
            line = re.sub(r"(: [A-Z])\.$", r"\1\\.", line, flags=re.M)  # "A." begins no list
        found += line.split("\n")
    # What Python writes for a NamedTuple's fields says nothing.
    lines[:] = [line for line in found if not line.startswith("Alias for field number")]


def short(app, what, name, obj, options, signature, returns):
    """Names the type of a lens's parameters, which is as long as a line."""
    number = stringify_annotation(Number, "smart")
    return signature and signature.replace(number, "~darswin.lens.Number"), returns


def private(app, env, node, contnode):
    """Leaves a name without a link where darswin has it, but not as a public name."""
    target = node["reftarget"]
    return contnode if target.startswith("darswin.") and locate(target) else None


def setup(app):
    app.connect("autodoc-process-docstring", one_a_line, priority=1)  # before napoleon's
    app.connect("autodoc-process-signature", short)
    app.connect("missing-reference", private)
