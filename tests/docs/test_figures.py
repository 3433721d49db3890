"""The figures of the pages are what docs/figures.py draws, small, and on the pages."""

from __future__ import annotations

import re
from pathlib import Path
from runpy import run_path
from xml.etree import ElementTree

DOCS = Path(__file__).parents[2] / "docs"
FIGURES = {path.name: path.read_text() for path in (DOCS / "figures").glob("*.svg")}
PAGES = {path: path.read_text() for path in DOCS.rglob("*.md")}


def numbers(svg: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d*\.?\d+", svg)]


def test_figures_are_those_of_the_script() -> None:
    """To a pixel: the last digits of a computed place differ between versions of NumPy."""
    drawn = run_path(str(DOCS / "figures.py"))["files"]()
    assert drawn.keys() == FIGURES.keys()
    for name, svg in drawn.items():
        ours, theirs = numbers(svg), numbers(FIGURES[name])
        assert len(ours) == len(theirs), f"{name}: run python docs/figures.py"
        assert all(abs(one - other) <= 1 for one, other in zip(ours, theirs, strict=True)), name


def test_figures_are_small_and_load_nothing() -> None:
    for name, svg in FIGURES.items():
        ElementTree.fromstring(svg)
        assert len(svg) < 8_000, name
        assert "href" not in svg
        assert "prefers-color-scheme" in svg


def test_each_figure_is_on_a_page_and_each_guide_has_one() -> None:
    shown = {
        page: re.findall(r"!\[[^\]]+\]\((?:\.\./)?figures/(\w+\.svg)\)", text) for page, text in PAGES.items()
    }
    assert {name for names in shown.values() for name in names} == FIGURES.keys()
    assert [page.name for page, names in shown.items() if page.parent.name == "guides" and not names] == []
