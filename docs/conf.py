"""Sphinx's configuration of the documentation site: python -m sphinx -nW docs build/docs.

Sphinx, because docstrings are reST, -n checks every cross reference into the API, linkcheck is built in,
and Furo's pages make no request to other hosts. Pages are Markdown, read by MyST.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path.insert(0, str(DOCS))

import zstate  # noqa: E402

project = "zstate"
author = "the zstate authors"
project_copyright = author
version = release = zstate.__version__
REPOSITORY = "https://github.com/zstate/zstate"

extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["requirements*.txt"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
nitpicky = True

html_theme = "furo"
html_title = f"zstate {version}"
html_theme_options = {
    "source_repository": f"{REPOSITORY}/",
    "source_branch": "main",
    "source_directory": "docs/",
}
html_copy_source = False

# Files of the repository that are pages of the site; links to other files lead to the repository.
PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
    "bench/README.md": "benchmarks.md",
    "deploy/README.md": "deploy.md",
    "models/tutorial/README.md": "ros2.md",
}


def _link(file: Path, page: Path, target: str) -> str:
    """``target``, a relative link in ``file``, as a link of ``page``, the page that shows the file."""
    path, hash_, anchor = target.partition("#")
    named = Path(os.path.normpath(file.parent / path))
    if not named.exists() or not named.is_relative_to(ROOT):
        return target
    inside = named.relative_to(ROOT).as_posix()
    shown = DOCS / PAGES[inside] if inside in PAGES else named
    if shown.is_relative_to(DOCS) and shown.suffix in (".md", ".png", ".svg"):
        return os.path.relpath(shown, page.parent) + hash_ + anchor
    return f"{REPOSITORY}/{'tree' if named.is_dir() else 'blob'}/main/{inside}{hash_}{anchor}"


def _with_links(text: str, file: Path, page: Path) -> str:
    return re.sub(
        r"(?<=[^!]\[)([^\]]*)\]\(([^):\s]+)\)", lambda m: f"{m[1]}]({_link(file, page, m[2])})", text
    )


def _read_page(app: Sphinx, name: str, content: list[str]) -> None:
    page = Path(app.env.doc2path(name))
    if name == "index":  # until these pages exist
        content[0] = re.sub(
            r"^(\S+\*)\n", lambda m: m[0] if any(DOCS.glob(m[1])) else "", content[0], flags=re.MULTILINE
        )
    if page.suffix == ".md":
        content[0] = _with_links(content[0], page, page)


def _include(app: Sphinx, included: Path, parent: str, content: list[str]) -> None:
    content[0] = _with_links(content[0], Path(os.path.normpath(DOCS / included)), DOCS / app.env.docname)


def setup(app: Sphinx) -> None:
    """Registers what this file adds to Sphinx."""
    app.connect("source-read", _read_page)
    app.connect("include-read", _include)
