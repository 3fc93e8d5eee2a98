"""Sphinx configuration."""

import sys
from importlib import metadata
from pathlib import Path

# Our own extensions, `public_names`, `kinds_tables`, `executed` and `licences`, stand beside this file.
sys.path.insert(0, str(Path(__file__).parent))

project = "softneck"
author = "the softneck developers"
release = metadata.version("softneck")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_click",
    "sphinx-mathjax-offline",
    "public_names",
    "kinds_tables",
    "executed",
    "licences",
]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_static_path = ["_static"]
html_title = "softneck"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
# A parameter to a line where they do not fit one, and defaults as they are written.
python_maximum_signature_line_length = 80
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
# Not what they stand for: `ndarray[tuple[Any, ...], dtype[floating[Any]]]`.
autodoc_type_aliases = {name: name for name in ("Vector", "Matrix", "ArrayLike", "Progress", "Labelled", "Source")}
python_use_unqualified_type_names = True
# `--json` is a command's option and no dash: what is copied from a page runs.
smartquotes = False
html_css_files = ["gallery.css"]
autodoc_default_options = {"members": True, "imported-members": True, "undoc-members": False}
nitpicky = False
napoleon_use_ivar = True
# Attribute names such as `inputs` stand in several classes; their mentions in docstrings need no link.
suppress_warnings = ["ref.python"]
