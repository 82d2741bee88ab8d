"""The documentation site: ``make docs``. Nothing is fetched or executed while Sphinx builds it.

``make docs`` executes before what runs/laptop/seed0 lacks of the notebooks as they are stored now,
and their pages show it; ``make docs RUN=runs/paper/seed0`` shows another run.
"""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

import tsmlib  # noqa: E402

project, author, release = "tsmlib", "The tsmlib authors", tsmlib.__version__
copyright = "the tsmlib authors, MIT licence"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "pages",  # beside this file
]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
templates_path = ["_templates"]

# Pages
myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath"]
myst_heading_anchors = 3
myst_heading_slug_func = "pages.anchor"
nb_execution_mode = "off"
nitpicky = True
nitpick_ignore_regex = [(r"py:.*", r"(?!tsmlib\.\w+$).*")]  # what has no page of its own
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # no page loads a script from elsewhere

# API
autosummary_generate = True
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
toc_object_entries = False

# Look
html_theme = "furo"
html_title = f"tsmlib {release}"
html_copy_source = False
html_search_scorer = str(Path(__file__).with_name("scorer.js"))
html_math_renderer = "mathml"  # of pages.py
html_static_path: list[str] = []
