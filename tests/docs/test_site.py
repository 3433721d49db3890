"""The documentation site: built with warnings as errors, complete, and without requests to other hosts."""

from __future__ import annotations

import re
import subprocess
import sys
import zlib
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path

import pytest

from zstate.cli.main import group

ROOT = Path(__file__).parents[2]
PUBLIC = ["zstate", "zstate.driving", "zstate.odometry", "zstate.scans", "zstate.sources"]

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


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site. ``-n`` and ``-W``: a reference without a target is an error, as every warning."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-nWq", "--keep-going", ROOT / "docs", folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


class LoadedAddresses(HTMLParser):
    """The addresses that a browser loads with a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name == LOADED.get(tag)]


def test_pages_load_nothing_from_other_hosts(site: Path) -> None:
    loaded = {address for page in site.rglob("*.html") for address in LoadedAddresses(page.read_text()).found}
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    loaded |= set(re.findall(r"(?:url\(|@import )[\"']?([^\"')]+)", styles))
    assert len(loaded) > 10
    assert sorted(address for address in loaded if re.match(r"(?!data:)\w+:|//", address)) == []


def test_every_public_name_has_a_reference(site: Path) -> None:
    inventory = zlib.decompress((site / "objects.inv").read_bytes().split(b"\n", 4)[4]).decode()
    described = {line.split(" ")[0] for line in inventory.splitlines()}
    names = [(module, name) for module in PUBLIC for name in getattr(import_module(module), "__all__", ())]
    assert len(names) > 90
    homes = ("zstate", "zstate.errors")  # of names that two modules have
    assert [
        f"{module}.{name}"
        for module, name in names
        if not described & {f"{home}.{name}" for home in (module, *homes)}
    ] == []


def test_every_command_has_a_reference(site: Path) -> None:
    page = (site / "commands.html").read_text()
    assert [name for name in group.list_commands(None) if f'id="zstate-{name}"' not in page] == []


def test_every_page_of_the_repository_is_in_the_site(site: Path) -> None:
    pages = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    contents = (site / "index.html").read_text()
    assert [str(page) for page in pages if f'href="{page}"' not in contents and page.stem != "index"] == []
