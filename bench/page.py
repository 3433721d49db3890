"""The figures of docs/benchmarks.md and README.md: generated from a results folder, and how old they are."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from bench.report import cell, figure_table, number, origin, table
from bench.results import CPU, FIGURES, MEMORY, MICRO, P50, ROOT, Figure, Results, Spread, git
from bench.scenario import PAGE, Scenario

DOCUMENTS = ("docs/benchmarks.md", "README.md")
COMMAND = "python -m bench page"
REFERENCE = "zstate_peer"
END = "<!-- end of bench -->"
_BLOCK = re.compile(r"<!-- bench: (?P<what>\w+) of (?P<folder>\S+) -->\n.*?" + re.escape(END), re.DOTALL)

MOST_DAYS, MOST_COMMITS = 60, 300
MEASURED = (
    *(f"zstate/{name}" for name in ("_util", "buffer", "ingest", "model", "net", "nodes", "sources", "wire")),
    *(
        f"zstate/{name}.py"
        for name in ("__init__", "__main__", "checks", "clock", "errors", "extension", "message")
    ),
    *(f"zstate/{name}.py" for name in ("plugins", "rate", "se3", "stream_registry", "streams", "transform")),
    "setup.py",
    "bench/subjects",
    "bench/worker.py",
    "bench/measure.py",
)
"""The files that a sample passes from a publisher to a lookup, and those that measure it."""

PARTS = {
    "chain": "1000 Hz",
    "publisher": "g1",
    "kinematics": "talos",
    "lookup": "^arm, by name:|^arm, plan|batch|1 kHz|memory|future",
    "startup": "zstate",
    "view": "CPU|picture",
}
"""The micro benchmarks of the page, and which of their rows it shows."""


class CannotKnow(Exception):
    """The age of figures is unknown: the text names what is missing."""


def documents(results: Results, root: Path = ROOT) -> dict[Path, str]:
    """Each document with every block regenerated from ``results``."""
    named = f"bench/results/{results.folder.name}"

    def renew(block: re.Match[str]) -> str:
        lines = "\n".join(BLOCKS[block["what"]](results)).strip()
        if not lines:  # this run has no such figures: those of an earlier one stay, with its name
            return block[0]
        return f"<!-- bench: {block['what']} of {named} -->\n\n{lines}\n\n{END}"

    paths = [root / name for name in DOCUMENTS]
    return {path: _BLOCK.sub(renew, path.read_text(encoding="utf-8")) for path in paths}


def shown_folders(root: Path = ROOT) -> set[Path]:
    """The results folders that the documents name."""
    texts = (root.joinpath(name).read_text(encoding="utf-8") for name in DOCUMENTS)
    return {root / block["folder"] for text in texts for block in _BLOCK.finditer(text)}


def why_stale(results: Results) -> str | None:
    """Why the figures are too old, and the command that renews them; None if they are not.

    Raises CannotKnow without git, in a shallow clone, and if the commit of the run is not in it.
    """
    commit, began = results.about["commit"].removesuffix("-dirty"), results.about["began"]
    try:
        if git("rev-parse", "--is-shallow-repository") != "false":
            raise CannotKnow("this clone is shallow: `git fetch --unshallow` brings the history")
        newest = git("log", "-1", "--format=%ci", "--", *MEASURED)
        count = int(git("rev-list", "--count", f"{commit}..HEAD", "--", *MEASURED))
    except (OSError, subprocess.CalledProcessError) as error:
        raise CannotKnow(f"git does not know the commit {commit} of the run here ({error})") from None
    form = "%Y-%m-%d %H:%M:%S %z"
    days = (datetime.strptime(newest, form) - datetime.strptime(began, form)).days
    if days <= MOST_DAYS and count <= MOST_COMMITS:
        return None
    return (
        f"the figures of {results.folder.name} are {days} days and {count} commits older than the last "
        f"change of what they measure; {MOST_DAYS} and {MOST_COMMITS} are allowed. `{COMMAND}` renews them"
    )


def tables(results: Results) -> Iterator[str]:
    """Both tables with their charts, and where other systems are better."""
    yield f"{origin(results)}; `{results.about['command']}`. While it ran, the rest of the machine used"
    yield f"at most {results.others_percent:.0f} % of a core."
    for scenario in page_scenarios(results):
        folder = f"../bench/results/{results.folder.name}"
        yield from ("", f"### {scenario.title}", "", f"{rounds(scenario)}, median [least to most]:", "")
        yield from figure_table(results, scenario)
        yield from (f"![latency, CPU, memory and bytes, {scenario.title}]({folder}/{scenario.name}.svg)", "")
        yield from better(results, scenario)
    if results.failures:
        yield from ("", f"{len(results.failures)} runs failed; the report names them.")
    for one in results.missing.values():
        yield from ("", f"Not installed on that machine: {one['title']}.")


def summary(results: Results) -> Iterator[str]:
    """The medians of both scenarios in one table."""
    figures = (P50, CPU, MEMORY)
    scenarios = page_scenarios(results)
    rows = [
        [
            results.title(name),
            *(
                number(spread.median) if (spread := results.spread(name, scenario, one)) else "-"
                for scenario in scenarios
                for one in figures
            ),
        ]
        for name in results.subjects
    ]
    short = [f"{one.robot} {one.rate_hz:g} Hz: {what}" for one in scenarios for what in ("us", "CPU %", "MB")]
    yield from table(["", *short], rows)
    yield "Medians: latency from stamp to pose, CPU and memory of all processes."
    yield f"{origin(results)}, {rounds(scenarios[0])}."
    for scenario in scenarios:
        yield from ("", better_in_short(results, scenario))


def rounds(scenario: Scenario) -> str:
    """How the scenario was repeated."""
    what = "round" if scenario.rounds == 1 else "rounds"
    return f"{scenario.rounds} {what} of {scenario.seconds:g} s"


class Lead(NamedTuple):
    """A figure in which another system's median is better than that of zstate by default."""

    system: str
    figure: Figure
    theirs: Spread
    ours: Spread

    @property
    def doubt(self) -> str:
        """A remark if the ranges over the rounds overlap."""
        overlap = self.theirs.least <= self.ours.most and self.ours.least <= self.theirs.most
        return " (within the spread of the rounds)" if overlap else ""


def leads(results: Results, scenario: Scenario) -> list[Lead]:
    """Where other systems are better than zstate, floors aside."""
    found: list[Lead] = []
    for figure in FIGURES:
        ours = results.spread(REFERENCE, scenario, figure)
        for name in results.measured(scenario):
            theirs = results.spread(name, scenario, figure)
            if name.startswith("zstate") or results.subjects[name]["floor"] or not (theirs and ours):
                continue
            if figure.loss(scenario, theirs.median) < figure.loss(scenario, ours.median):
                found.append(Lead(results.title(name), figure, theirs, ours))
    return found


def better(results: Results, scenario: Scenario) -> Iterator[str]:
    """The sentence that compares other systems with zstate, with the figures of each that is better."""
    found = leads(results, scenario)
    if not found:
        yield f"{scenario.title}: no other system is better than zstate in any of these figures."
        return
    yield from (f"{scenario.title}: other systems are better than zstate in", "")
    for one in found:
        yield f"- {one.figure.title}, {one.system}: {cell(one.theirs)} against {cell(one.ours)}{one.doubt}"


def short_title(figure: Figure) -> str:
    """The title without unit and processes."""
    return figure.title.split(" [")[0].split(",")[0]


def better_in_short(results: Results, scenario: Scenario) -> str:
    """The same without figures."""
    found = leads(results, scenario)
    systems = {one.system: [other for other in found if other.system == one.system] for one in found}
    told = [
        f"{system} in {', '.join(short_title(one.figure) + one.doubt for one in better_in)}"
        for system, better_in in systems.items()
    ]
    if not told:
        return f"{scenario.title}: no other system is better than zstate."
    return f"{scenario.title}: better than zstate are {'; '.join(told)}."


def parts(results: Results) -> Iterator[str]:
    """The chosen rows of the micro benchmarks; nothing if the run has none."""
    path = results.folder / MICRO
    if not path.exists():
        return
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    shown = [row for row in rows if re.search(PARTS[row["program"]], row["what"])]
    cells = [
        [row["what"], *(number(row[name]) for name in ("median", "p99")), row["unit"], f"`{row['program']}`"]
        for row in shown
    ]
    yield from table(["what", "median", "p99", "unit", "`python -m bench.micro` ..."], cells)
    yield f"{origin(results)}."


def page_scenarios(results: Results) -> list[Scenario]:
    """The two scenarios of the page, as they were run. Raises LookupError if one is missing."""
    return [results.scenario(one.robot, one.rate_hz) for one in PAGE]


BLOCKS: dict[str, Callable[[Results], Iterator[str]]] = {"tables": tables, "summary": summary, "parts": parts}
