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


def one_title(_app, _page, source):
    """A page with several titles of the first level would fill the table of contents: the later ones go one down."""
    head, *rest = source[0].split("\n# ")
    fence = "```"
    if rest and source[0].count(fence) % 2 == 0 and not any(part.count(fence) % 2 for part in (head, *rest[:-1])):
        below = "\n# " + "\n# ".join(rest)
        source[0] = head + "".join(f"#{line}" if line.startswith("#") else line for line in below.splitlines(True))


def setup(app):
    app.connect("source-read", one_title)
