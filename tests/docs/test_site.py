"""The documentation site: built with warnings as errors, complete, and without requests to other hosts."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
import zlib
from html.parser import HTMLParser
from importlib import import_module
from itertools import chain
from pathlib import Path
from pkgutil import resolve_name

import click
import pytest

from zstate.cli.main import group

ROOT = Path(__file__).parents[2]
PUBLIC = [
    "zstate",
    *(
        "zstate.cameras",
        "zstate.clouds",
        "zstate.driving",
        "zstate.odometry",
        "zstate.scans",
        "zstate.sources",
    ),
]

# What a browser loads by itself; an address in <a href> is loaded by a click.
LOADED = {
    "audio": "src",
    "embed": "src",
    "iframe": "src",
    "img": "src",
    "link": "href",
    "object": "data",
    "script": "src",
    "source": "src",
    "video": "src",
}


class LoadedAddresses(HTMLParser):
    """The addresses that a browser loads with a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name == LOADED.get(tag)]


def build(site: Path) -> None:
    """``-n`` and ``-W``: a reference without a target is an error, as is every warning."""
    # No search for garbage, which takes a seventh of the time.
    program = "import gc, sys; from sphinx.cmd.build import main; gc.disable(); sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "-nWq", "--keep-going", ROOT / "docs", site]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def addresses_on_other_hosts(site: Path) -> list[str]:
    loaded = {address for page in site.rglob("*.html") for address in LoadedAddresses(page.read_text()).found}
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    loaded |= set(re.findall(r"(?:url\(|@import )[\"']?([^\"')]+)", styles))
    assert len(loaded) > 10
    return sorted(address for address in loaded if re.match(r"(?!data:)\w+:|//", address))


def described_names(site: Path) -> set[str]:
    inventory = zlib.decompress((site / "objects.inv").read_bytes().split(b"\n", 4)[4]).decode()
    return {line.split(" ")[0] for line in inventory.splitlines()}


def names_without_reference(site: Path) -> list[str]:
    described = described_names(site)
    names = [(module, name) for module in PUBLIC for name in import_module(module).__all__]
    assert len(names) > 90
    homes = ("zstate", "zstate.errors")  # of names that two modules have
    return [
        f"{module}.{name}"
        for module, name in names
        if not described & {f"{home}.{name}" for home in (module, *homes)}
    ]


def methods_without_reference(site: Path) -> list[str]:
    """Methods that guides call, inherited ones too."""
    described = {name.rpartition(".")[2] for name in described_names(site)}
    guides = "".join(path.read_text() for path in (ROOT / "docs" / "guides").glob("*.md"))
    called = set(re.findall(r"\.(\w+)\(", guides))
    public = [
        getattr(import_module(module), name) for module in PUBLIC for name in import_module(module).__all__
    ]
    methods = {name for name in called for one in public if isinstance(one, type) and hasattr(one, name)}
    assert {"insert_joints", "add_robot", "frames"} <= methods
    return sorted(methods - described)


def commands_without_reference(site: Path) -> list[str]:
    page = (site / "commands.html").read_text()
    names = group.list_commands(click.Context(group))
    return [name for name in names if f'id="zstate-{name}"' not in page]


def pages_without_link(site: Path) -> list[str]:
    files = chain.from_iterable((ROOT / "docs").rglob(pattern) for pattern in ("*.md", "*.ipynb"))
    pages = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in files}
    contents = (site / "index.html").read_text()
    return [str(page) for page in pages if f'href="{page}"' not in contents and page.stem != "index"]


def linked_elsewhere(site: Path) -> set[str]:
    """Addresses of the descriptions of types of other projects that the API pages link to."""
    pages = "".join(page.read_text() for page in (site / "api").glob("*.html"))
    return set(re.findall(r'href="(https://(?:numpy\.org|zenoh-python)[^"]*)"', pages))


def types_elsewhere() -> dict[str, str]:
    """Types of other projects with the addresses of their descriptions."""
    return runpy.run_path(str(ROOT / "docs" / "conf.py"))["ELSEWHERE"]


def test_types_of_other_projects_that_are_linked_exist() -> None:
    for name, address in types_elsewhere().items():
        path = name if "." in name else f"numpy.typing.{name}"
        assert resolve_name(path) is not None
        assert re.search(rf"[#/]{re.escape(path)}(\.html)?$", address)


@pytest.mark.long
def test_site_is_complete_and_loads_nothing_from_other_hosts(tmp_path: Path) -> None:
    build(tmp_path)
    assert addresses_on_other_hosts(tmp_path) == []
    assert names_without_reference(tmp_path) == []
    assert methods_without_reference(tmp_path) == []
    assert commands_without_reference(tmp_path) == []
    assert "%j;" in (tmp_path / "commands.html").read_text()  # begins a line of help; a comment in MyST
    assert pages_without_link(tmp_path) == []
    assert linked_elsewhere(tmp_path) == set(types_elsewhere().values())
