"""Sphinx: how the Guide is built.  `scripts/guide/build_guide.py` gathers the pages and calls this."""

from clrecon.version import package_version

project = "clrecon"
author = "The clrecon authors"
copyright = "the clrecon authors, BSD-3-Clause"  # noqa: A001 (the name is Sphinx's)
version = release = package_version()

extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc", "myst_parser", "sphinx_copybutton"]
root_doc = "index"
nitpicky = True
default_role = "py:obj"  # a name in single backticks is a public name, and so a link

autodoc_typehints = "none"  # types, shapes and units stand in the docstrings
autodoc_member_order = "bysource"
autosummary_generate = False  # one page a subject, not one a name
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

myst_enable_extensions = ["deflist", "attrs_block"]
myst_heading_anchors = 4
myst_links_external_new_tab = False

smartquotes = False  # it makes a dash of the two hyphens of an option

html_theme = "pydata_sphinx_theme"
html_title = "clrecon"
html_show_sourcelink = False
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["guide.css"]
_ALONE = ("index", "quickstart", "concepts", "limits", "citing", "readme", "changes", "contributing")
html_sidebars = {page: [] for page in _ALONE}  # pages without others below them
# Nothing that asks a server for anything: no icons of other sites, no switcher of versions, no search engine.
html_theme_options = {
    "logo": {"text": "clrecon"},
    "navbar_align": "left",
    "header_links_before_dropdown": 6,
    "show_prev_next": True,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
copybutton_exclude = ".linenos, .gp, .go"
