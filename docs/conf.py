"""Sphinx's settings; `make docs` builds the site from the documents where they lie."""

from importlib.metadata import version as version_of

project = 'Meta-GC-TTT for robots'
author = copyright = 'the Meta-GC-TTT contributors'
release = version = version_of('metagcttt-core')

# The source folder is the repository's root, so that links work here as they do on a forge.
root_doc = 'docs/index'
include_patterns = [
    'README.md',
    'CHANGELOG.md',
    'CONTRIBUTING.md',
    'SECURITY.md',
    'assets/**.md',
    'docs/**.md',
    'examples/*.ipynb',
    'ros2_ws/README.md',
]
exclude_patterns = ['docs/_build/**', '.venv/**', 'out/**']

extensions = [
    'myst_nb',
    'sphinx.ext.autodoc',
    'sphinx.ext.napoleon',
    'sphinx.ext.viewcode',
    'sphinx_copybutton',
]
myst_heading_anchors = 4
nb_execution_mode = 'force'
nb_execution_raise_on_error = True
nb_execution_timeout = 120
# Tables written by programs have no title of their own and begin at any level.
suppress_warnings = ['myst.header', 'toc.no_title']

autodoc_member_order = 'bysource'
autodoc_typehints = 'description'
add_module_names = False

html_theme = 'furo'
html_title = f'Meta-GC-TTT {release}'
