"""The site: Sphinx with MyST, from the Markdown pages of docs/ and the docstrings. `make docs` builds it."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

project = "pdvc-bench"
author = "The pdvc-bench developers"
copyright = "the pdvc-bench developers"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "navigation",
    "generated_pages",
    "markdown_docstrings",
    "short_signatures",
    "linked_code",
    "mathml",
]
exclude_patterns = ["site", "figures"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
myst_links_external_new_tab = False
highlight_language = "text"  # a block without a language is a drawing, a table or a command
nitpicky = False  # types of other packages are not looked up, as that would ask their hosts

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_type_aliases = {  # by the names that the code gives them
    name: name for name in ("Floats", "Image", "Indices", "Linearise", "Progress", "ArrayLike", "NDArray")
}
python_maximum_signature_line_length = 90
python_use_unqualified_type_names = True
add_module_names = False
viewcode_follow_imported_members = False  # what a page shows is defined there
toc_object_entries_show_parents = "hide"

# nothing is fetched: no fonts, no scripts, equations as MathML
html_theme = "furo"
html_title = "pdvc-bench"
html_math_renderer = "mathml"
html_static_path = [str(HERE / "static")]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}
html_permalinks_icon = "#"
