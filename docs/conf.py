"""Sphinx configuration."""

from __future__ import annotations

import sb3_tbc

project = "sb3_tbc"
author = "The sb3_tbc developers"
release = sb3_tbc.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinxcontrib.mermaid"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
myst_fence_as_directive = ["mermaid"]
html_theme = "alabaster"
html_theme_options = {"description": "Hierarchical RL with timed subgoals", "page_width": "1100px"}
autodoc_typehints = "description"
