"""The documentation site: `make docs` builds it into site/ from these pages, the README and the docstrings."""

import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from site_pages import adapt_page
from sphinx.pycode import ModuleAnalyzer

from navrep_data import __version__

project = "navrep-data"
author = "The navrep-data developers"
version = release = __version__
copyright = "The navrep-data developers, MIT licence"

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc"]
exclude_patterns = ["images/**"]
html_extra_path = ["view.html"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = "navrep-data"
html_theme = "pydata_sphinx_theme"
html_theme_options = {
    "navigation_with_keys": False,
    "navbar_align": "left",
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"index": [], "tour": []}
html_show_sourcelink = False
html_copy_source = False
pygments_style = "tango"

myst_heading_anchors = 3
myst_enable_extensions = ["attrs_inline"]

# Docstrings: numpydoc. Names in single backticks are code, and a link where there is such an object.
default_role = "py:obj"
numpydoc_show_class_members = False
autodoc_default_options = {
    "members": True,
    "member-order": "groupwise",
    # what our own (private) bases have is shown, what comes from these libraries is not
    "inherited-members": "Dataset,IterableDataset,Module,Exception,tuple,int,str,dict,Enum,Generic,Protocol,"
    "Env,VectorEnv,Wrapper,ObservationWrapper,VectorWrapper,VectorObservationWrapper",
}
autodoc_class_signature = "mixed"
# Signatures show names and defaults; types, shapes and units are in the parameter lists.
autodoc_typehints = "none"
add_module_names = False
# Roles that name a function, method, module or exception must find it. Types are prose ("ndarray of shape (N, 3)").
nitpicky = True
nitpick_ignore_regex = [("py:(class|obj)", ".*")]
LONGEST_VALUE = 250  # characters; longer ones tell nobody anything


def _adapt(app, docname, source):
    source[0] = adapt_page(docname, source[0])
    if docname.startswith("api/") and docname != "api/index":
        source[0] += _constants(f"navrep_data.{docname.removeprefix('api/')}")


def _constants(name):
    """Return what shows a module's constants with their values, where those are short: autodoc leaves them out."""
    module = importlib.import_module(name)
    documented = {attribute for _, attribute in ModuleAnalyzer.for_module(name).find_attr_docs()}  # autodoc shows these
    found = [
        constant
        for constant in getattr(module, "__all__", vars(module))
        if constant.isupper()
        and constant not in documented
        and not callable(value := getattr(module, constant))
        and len(repr(value)) < LONGEST_VALUE
    ]
    shown = "".join(f".. autodata:: {name}.{constant}\n" for constant in found)
    return f"\nConstants\n---------\n\n{shown}" if shown else ""


def setup(app):
    """Register what turns repository pages into site pages."""
    app.connect("source-read", _adapt)
