"""Sphinx's configuration of the documentation site: python -m sphinx -nW docs build/docs.

Sphinx, because docstrings are reST, -n checks every cross reference into the API, linkcheck is built in,
and Furo's pages make no request to other hosts. Pages are Markdown, read by MyST.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

import zstate

DOCS = Path(__file__).parent
ROOT = DOCS.parent

project = "zstate"
author = "the zstate authors"
project_copyright = author
version = release = zstate.__version__
REPOSITORY = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]["Homepage"]

extensions = ["myst_nb", "sphinx.ext.autodoc"]
nb_execution_mode = "off"  # notebooks are shown with the outputs that they hold
exclude_patterns = ["**.ipynb_checkpoints"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
smartquotes = False  # they turn -- of options into dashes
# Aliases of types; they are shown by name.
_ALIASES = (
    "ConfigSource",
    "Floats",
    "Group",
    "Mode",
    "OutcomeName",
    "Points",
    "Positions",
    "StreamName",
)
nitpicky = True
nitpick_ignore_regex = [
    ("py:class", r"DuckDBPyConnection"),
    ("py:.*", r"(collections|os|pathlib|threading)\..*"),
    ("py:class", "|".join(("msgspec.Meta", r"(.*\.)?(S|M|_\w+|\w+Like)", *_ALIASES))),
]

# With members of base classes, up to those named here.
_BASES = "BaseException,ImportError,LookupFailed,OSError,Struct,ZStateError,object,str,tuple"
autodoc_default_options = {"members": True, "member-order": "bysource", "inherited-members": _BASES}
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("ArrayLike", *_ALIASES)}
TypeAliasForwardRef.__repr__ = lambda alias: alias.name  # as printed in a union, such as Floats | None
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"zstate {version}"
html_theme_options = {"top_of_page_buttons": []}
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_copy_source = False

# The modules whose names are the API.
PUBLIC = (
    *("zstate", "zstate.archive", "zstate.cameras", "zstate.clouds", "zstate.driving", "zstate.errors"),
    *("zstate.odometry", "zstate.scans", "zstate.sources"),
)

_ARRAY = r"~?numpy\.ndarray\[tuple\[~?typing\.Any, \.\.\.\], ~?numpy\.dtype\[(~?numpy\.\w+)\]\]"

# Files of the repository that are pages of the site; links to other files lead to the repository.
PAGES = {
    "CHANGELOG.md": "changelog.md",
    "README.md": "index.md",
    "bench/README.md": "benchmarks.md",
    "deploy/README.md": "deploy.md",
}


# Types of other projects: their inventories are on other hosts, and the build makes no requests.
_NUMPY = "https://numpy.org/doc/stable/reference"
_ZENOH = "https://zenoh-python.readthedocs.io/en/latest/api_reference.html"
_SCALARS = ("bool", "float32", "float64", "int8", "int64", "uint8", "void")
ELSEWHERE = {
    **{f"numpy.{name}": f"{_NUMPY}/generated/numpy.{name}.html" for name in ("dtype", "ndarray")},
    **{f"numpy.{name}": f"{_NUMPY}/arrays.scalars.html#numpy.{name}" for name in _SCALARS},
    **{name: f"{_NUMPY}/typing.html#numpy.typing.{name}" for name in ("ArrayLike", "NDArray")},
    "zenoh.Session": f"{_ZENOH}#zenoh.Session",
}
"""By name, the address of its description. A name that is not here fails the build."""


def _target(file: Path, link: str) -> Path | None:
    """The file of the repository that ``link`` in ``file`` leads to; None for others."""
    path = link.partition("#")[0]
    target = Path(os.path.normpath(file.parent / path))
    return target if path and target.exists() and target.is_relative_to(ROOT) else None


def _for_page(file: Path, page: Path, link: str) -> str:
    """``link`` of ``file`` as a link of ``page``, which shows the file: to a page, or to the repository."""
    target = _target(file, link)
    if target is None:
        return link
    _, hash_, anchor = link.partition("#")
    inside = target.relative_to(ROOT).as_posix()
    target = DOCS / PAGES[inside] if inside in PAGES else target
    is_shown = target.suffix in (".png", ".svg", ".webp") or (
        target.suffix in (".md", ".ipynb") and target.is_relative_to(DOCS)
    )
    if is_shown:
        return os.path.relpath(target, page.parent) + hash_ + anchor
    return f"{REPOSITORY}/{'tree' if target.is_dir() else 'blob'}/main/{inside}{hash_}{anchor}"


def _with_links(text: str, file: Path, page: Path) -> str:
    return re.sub(r"(?<=\]\()([^()\s]+)(?=\))", lambda link: _for_page(file, page, link[1]), text)


def _read_page(app: Sphinx, name: str, content: list[str]) -> None:
    page = Path(app.env.doc2path(name))
    if page.suffix == ".ipynb":
        book = json.loads(content[0])
        book["cells"][0]["source"] += ["\n\n", f"{{download}}`Download this notebook <{page.name}>`"]
        content[0] = json.dumps(book)
    content[0] = _with_links(content[0], page, page)


def _read_included(app: Sphinx, included: Path, parent: str, content: list[str]) -> None:
    page = Path(app.env.doc2path(app.env.docname))
    content[0] = _with_links(content[0], Path(os.path.normpath(DOCS / included)), page)


def _link_elsewhere(*event: Any) -> nodes.reference | None:
    """A type of another project as a link; None for other names."""
    _, _, node, content = event
    address = ELSEWHERE.get(node["reftarget"])
    return None if address is None else nodes.reference("", "", content, internal=False, refuri=address)


def _shorten_signature(*event: Any) -> tuple[str, str] | None:
    """Arrays by the name of their type; of classes outside of the public modules only their fields."""
    _, what, name, given, _, arguments, result = event
    if arguments is None:
        return None
    if what == "class" and name.rpartition(".")[0] not in PUBLIC and not is_dataclass(given):
        fields = getattr(given, "__struct_fields__", ())  # of messages
        arguments = f"({', '.join(fields)})" if fields else ""
    texts = (re.sub(_ARRAY, r"NDArray[\1]", text or "") for text in (arguments, result))
    # With a class that the module imports for types alone, annotations are as they are written.
    arguments, result = (re.sub(r"\bnp\.(\w+?)_?\b", r"~numpy.\1", text) for text in texts)
    return arguments, result


def setup(app: Sphinx) -> None:
    """Registers what this file adds to Sphinx."""
    app.connect("source-read", _read_page)
    app.connect("include-read", _read_included)
    app.connect("autodoc-process-signature", _shorten_signature)
    app.connect("missing-reference", _link_elsewhere)
