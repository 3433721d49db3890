"""Micro benchmarks: one form, whose options are the defaults of ``measure``."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bench.micro import __main__ as micro
from bench.micro import chain
from bench.micro.form import Row, chain_urdf, compared, mean_times_us
from bench.page import PARTS
from zstate import load_model

PROGRAMS = [name for name in micro.NAMES if name not in micro.WORKERS]
MODULES = Path(micro.__file__).parent


def test_list_has_a_line_for_each_program(capsys: pytest.CaptureFixture[str]) -> None:
    micro.main([])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == PROGRAMS
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("name", PROGRAMS)
def test_every_program_has_a_measure_whose_parameters_have_defaults(name: str) -> None:
    tree = ast.parse((MODULES / f"{name}.py").read_text(encoding="utf-8"))
    [measure] = [one for one in tree.body if isinstance(one, ast.FunctionDef) and one.name == "measure"]
    given = measure.args
    defaults = [one for one in (*given.defaults, *given.kw_defaults) if one is not None]
    assert len([*given.args, *given.kwonlyargs]) == len(defaults) > 0


def test_page_shows_programs_that_exist() -> None:
    assert set(PARTS) <= set(PROGRAMS)


def test_defaults_of_measure_are_the_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}

    def measure(robots: tuple[int, ...] = (1, 2), rate: float = 10.0, name: str = "panda") -> Iterator[Row]:
        given.update(robots=robots, rate=rate, name=name)
        yield from compared("a title", "us", {"floor": [2.0, 4.0], "ours": [9.0]})

    module = SimpleNamespace(measure=measure, __doc__="A program.")
    monkeypatch.setattr(micro, "import_module", lambda _: module)
    micro.main(["chain", "--robots", "7", "8", "--rate", "2.5", "--json", str(tmp_path / "rows")])
    assert given == {"robots": [7, 8], "rate": 2.5, "name": "panda"}
    rows = [json.loads(line) for line in (tmp_path / "rows").read_text().splitlines()]
    assert [(row["program"], row["what"], row["median"], row["most"], row["times"]) for row in rows] == [
        ("chain", "a title: floor", 3.0, 4.0, None),
        ("chain", "a title: ours", 9.0, 9.0, 3.0),
    ]
    assert re.search(r"a title: ours +9 +9 +9  us +3\n", capsys.readouterr().out)


def test_first_round_warms_up_and_is_not_counted() -> None:
    calls: list[int] = []
    times = mean_times_us({"a": lambda: calls.append(1)}, rounds=3, calls=5)
    assert len(times["a"]) == 3
    assert len(calls) == 4 * 5


@pytest.mark.processes
@pytest.mark.robots
@pytest.mark.long
def test_roles_run_in_other_processes_and_return_their_results() -> None:
    rows = {row.what: row.values for row in chain.run_chain("panda", "panda", 50.0, 1.0, "woken")}
    assert list(rows) == [
        "panda: deviation of the rate",
        "panda: lost samples",
        "panda: CPU of the publisher",
        "panda: CPU of the reader",
        "panda: stamp to result",
    ]
    assert all(one > 0.0 for one in rows["panda: stamp to result"])


def test_chain_has_as_many_joints_as_asked() -> None:
    model = load_model(chain_urdf(5))
    assert (len(model.joint_names), len(model.links)) == (5, 6)
