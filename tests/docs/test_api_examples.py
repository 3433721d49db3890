"""Examples of the API pages: they print what the comments beside say, and each class has one."""

from __future__ import annotations

import re
from pathlib import Path
from pkgutil import resolve_name

import pytest
from helpers.pages import programs, section

import zstate

PAGE = (Path(__file__).parents[2] / "docs" / "api" / "zstate.md").read_text()
EXAMPLES = programs(PAGE)


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_prints_what_its_comments_say(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[name], name, "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.splitlines() == re.findall(r"print\(.*\)  # (.*)", EXAMPLES[name])


def test_each_class_of_the_front_door_has_an_example() -> None:
    classes = [name for name in zstate.__all__ if isinstance(getattr(zstate, name), type)]
    used = [name for name in classes if not issubclass(getattr(zstate, name), Exception)]
    text = "".join(EXAMPLES.values())
    assert [name for name in used if not re.search(rf"\b{name}\b", text)] == []


def test_names_for_jobs_exist() -> None:
    table = section(PAGE, "## Which class for which job")
    names = [name for name in re.findall(r"`([\w.]+)`", table) if "." in name or not name.islower()]
    assert len(names) > 20
    for name in names:
        module, _, rest = name.partition(".")
        assert callable(resolve_name(f"zstate.{module}:{rest}" if module.islower() else f"zstate:{name}"))
