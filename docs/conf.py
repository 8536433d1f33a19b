"""The documentation as a site: `make docs`.  The pages read well without it, too."""

from __future__ import annotations

import os
import sysconfig

import bayesdist
from bayesdist import formats
from bayesdist.missions import wise
from sphinx.ext.autosummary import Autosummary

project = "bayesdist"
author = "The bayesdist developers"
copyright = author
version = release = bayesdist.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "myst_nb",  # also the parser of all other pages
    "sphinx-mathjax-offline",
]
templates_path = ["_templates"]
nitpicky = True
# a name in backticks becomes a link where it is the name of something documented, else it is code
default_role = "py:obj"
nitpick_ignore_regex = [("py:obj", ".*")]

autodoc_typehints = "none"  # the docstrings have types, shapes and units
autodoc_member_order = "bysource"
autosummary_generate = False
numpydoc_show_class_members = False

# notebooks are executed where they can write files, and find the commands of this environment
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 600  # seconds for one cell, on a machine with much else to do
nb_merge_streams = True
os.environ["PATH"] = os.pathsep.join(
    [sysconfig.get_path("scripts"), os.environ.get("PATH", "")]
)

myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3

html_theme = "pydata_sphinx_theme"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"bayesdist {version}"
html_sidebars = {"**": ["sidebar-tree"]}
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "navbar_start": ["navbar-logo"],
    "navbar_center": [],
    "navbar_align": "left",
    "footer_start": ["copyright"],
    "footer_end": [],
}


class TypedNames(Autosummary):
    """Summary of names as scripts have them, each with a link to its page."""

    def get_items(self, names):
        """Names as they are shown, signatures, summaries, and names that are linked to."""
        return [
            (typed(real), *others, real)
            for _, *others, real in super().get_items(names)
        ]


def typed(full_name):
    """Name as scripts have it: bd.sample for bayesdist.infer.sample."""
    name = full_name.rpartition(".")[2]
    packages = {"bd": bayesdist, "bd.formats": formats, "wise": wise}
    return next(
        (f"{k}.{name}" for k, v in packages.items() if name in v.__all__), full_name
    )


def setup(app):
    """Add the directive `typed-names`."""
    app.add_directive("typed-names", TypedNames)
