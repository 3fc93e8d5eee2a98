"""Sphinx configuration."""

from importlib import metadata

project = "softneck"
author = "the softneck developers"
release = metadata.version("softneck")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_click", "sphinx-mathjax-offline"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_static_path = ["_static"]
html_title = "softneck"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "imported-members": True, "undoc-members": False}
nitpicky = False
napoleon_use_ivar = True
# Attribute names such as `inputs` stand in several classes; their mentions in docstrings need no link.
suppress_warnings = ["ref.python"]
