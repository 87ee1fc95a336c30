"""Settings of Sphinx; `make docs` builds runs/docs/index.html. Pages are Markdown and read as well on their own."""

project = "Reenact"
author = "The Reenact developers"
copyright = ""
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3  # links to headings work as on any forge
html_theme = "furo"
html_title = "Reenact"
html_show_copyright = False
html_copy_source = False
html_show_sourcelink = False
exclude_patterns = ["_build"]
nitpicky = True
