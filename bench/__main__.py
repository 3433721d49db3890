"""The benchmark: ``python -m bench`` compares what is installed; ``page`` renews the documentation."""

from __future__ import annotations

import secrets
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from bench import results
from bench.page import COMMAND, PARTS, documents, shown_folders
from bench.report import cell, soak_lines, write_report
from bench.results import FIGURES, ROOT, Results
from bench.scenario import PAGE, QUICK, Scenario, estimated_seconds, plan_turns, select_scenarios
from bench.subjects import all_subjects
from bench.subjects.subject import Subject
from bench.trial import Facts, run_trial

CONSOLE = Console()
SUBJECTS = all_subjects()
QUICK_WITHIN_S = 110.0


@click.group(invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.pass_context
def main(context: click.Context) -> None:
    """Compare zstate with the real systems. Alone: a table of what is installed, in two minutes."""
    if context.invoked_subcommand is None:
        quick()


def quick() -> None:
    """Runs every installed subject once, and prints a table."""
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder), list(SUBJECTS.values()), QUICK, within_s=QUICK_WITHIN_S)
        [scenario] = found.scenarios
        table = Table(scenario.title, *(one.title for one in FIGURES[:-1]), box=None)
        for name in found.measured(scenario):
            cells = (cell(found.spread(name, scenario, one)) for one in FIGURES[:-1])
            table.add_row(found.title(name), *cells)
        CONSOLE.print(table)
        for run in found.failures:
            _say(f"{run['subject']} failed: {run['failed']}")
    for one in SUBJECTS.values():
        if one.python() is None:
            root = " (as root)" if any("apt-get" in command for command in one.install) else ""
            _say(f"{one.name} is not installed: python -m bench setup {one.name}{root}")
    _say(f"One short run each on a machine that may be busy: no figures to quote. `{COMMAND}` makes those.")


@main.command()
@click.argument("names", nargs=-1, metavar="[SUBJECT]...", type=click.Choice(list(SUBJECTS)))
def setup(names: Sequence[str]) -> None:
    """Install each SUBJECT; without any, list the commands that do."""
    for name in names:
        for command in SUBJECTS[name].install:
            _say(f"$ {command}")
            # The command shown is the command run; it comes from this repository.
            if subprocess.run(command, shell=True, cwd=ROOT, check=False).returncode:
                raise click.ClickException(f"{name}: this command failed; the commands after it were not run")
    for one in SUBJECTS.values() if not names else ():
        versions = (
            "not installed" if one.python() is None else ", ".join(map(" ".join, one.versions().items()))
        )
        _say(f"{one.name}: {one.title}; {versions}")
        for command in one.install if one.python() is None else ():
            _say(f"  {command}")


@main.command("run")
@click.option(
    "--subject", "names", multiple=True, type=click.Choice(list(SUBJECTS)), help="Only this one; repeatable."
)
@click.option(
    "--scenario", "patterns", multiple=True, metavar="PATTERN", help="As talos-1000 or panda-*; repeatable."
)
@click.option("--rounds", type=click.IntRange(min=1), help="Rounds of each scenario.")
@click.option("--seconds", type=float, help="The measured window.")
@click.option(
    "--to", "parent", type=click.Path(path_type=Path), default=results.FOLDER, help="Where results go."
)
@click.option("--seed", type=int, help="Seed of the order of subjects; random by default.")
@click.option("--list", "only_list", is_flag=True, help="List the runs and their total duration, then exit.")
def run_command(
    *,
    names: Sequence[str],
    patterns: Sequence[str],
    rounds: int | None,
    seconds: float | None,
    parent: Path,
    seed: int | None,
    only_list: bool,
) -> None:
    """Measure scenarios, and write a report. PAGE's two have several rounds, the others one."""
    try:
        scenarios = select_scenarios(patterns, rounds=rounds, seconds=seconds)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--scenario") from None
    subjects = [SUBJECTS[name] for name in names or SUBJECTS]
    if only_list:
        for turn in plan_turns([one for one in subjects if one.python()], scenarios, seed or 0):
            _say(f"{turn.scenario.name}  {turn.subject.name}")
        return
    folder = results.new_folder(parent)
    report(measure(folder, subjects, scenarios, seed=seed))


@main.command()
@click.argument("folder", required=False, type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--rounds", type=click.IntRange(min=1), help="Fewer rounds, for a trial.")
@click.option("--seconds", type=float, help="A shorter window, for a trial.")
@click.option(
    "--to", "root", type=click.Path(exists=True, path_type=Path), default=ROOT, help="Another checkout."
)
def page(*, folder: Path | None, rounds: int | None, seconds: float | None, root: Path) -> None:
    """Measure the figures of docs/benchmarks.md and README.md, and write them; with FOLDER only write."""
    if folder is None:
        if root == ROOT and results.commit().endswith("-dirty"):
            raise click.ClickException(
                "figures need a commit to name: commit the changes of zstate and bench first"
            )
        folder = results.new_folder(root / "bench" / "results")
        scenarios = select_scenarios([one.name for one in PAGE], rounds=rounds, seconds=seconds)
        measure(folder, list(SUBJECTS.values()), scenarios)
        measure_parts(folder)
    before = shown_folders(root)
    report(Results.read(folder))
    for path, text in documents(Results.read(folder), root).items():
        path.write_text(text, encoding="utf-8")
        _say(str(path))
    for old in sorted(before - shown_folders(root)):
        _say(f"no page shows this one any more: git rm -r {old.relative_to(root)}")


def measure_parts(folder: Path) -> None:
    """Runs the micro benchmarks of the page; one that fails is left out and named."""
    for name in PARTS:
        command = [sys.executable, "-m", "bench.micro", name, "--json", str(folder / results.MICRO)]
        if subprocess.run(command, cwd=ROOT, check=False).returncode:
            _say(f"`python -m bench.micro {name}` failed: its rows are missing")


def measure(
    folder: Path,
    subjects: Sequence[Subject],
    scenarios: Sequence[Scenario],
    *,
    seed: int | None = None,
    within_s: float | None = None,
) -> Results:
    """Runs every installed subject in every scenario into ``folder``; no turn begins after ``within_s``."""
    seed = secrets.randbits(32) if seed is None else seed
    turns = plan_turns([one for one in subjects if one.python() is not None], scenarios, seed)
    _say(f"{len(turns)} runs, about {estimated_seconds(turns) / 60:.0f} minutes, seed {seed}")
    results.write_about(
        folder, shlex.join(["python", "-m", "bench", *sys.argv[1:]]), subjects, scenarios, seed
    )
    began = time.monotonic()
    for number, turn in enumerate(turns, 1):
        if within_s is not None and time.monotonic() > began + within_s:
            left = ", ".join(one.subject.name for one in turns[number - 1 :])
            _say(f"not run, as this machine is slow or busy: {left}")
            break
        facts = run_trial(turn.subject, turn.scenario)
        head = {"subject": turn.subject.name, "scenario": turn.scenario.name, "round": turn.round}
        results.append(folder, {**head, **facts})
        _say(f"{number} of {len(turns)}  {turn.scenario.name}  {turn.subject.title}: {_summary(facts)}")
    return Results.read(folder)


def _summary(facts: Facts) -> str:
    if "failed" in facts:
        return f"FAILED, {facts['failed']}"
    if "soak" in facts:
        return "\n".join(soak_lines(facts["soak"]))
    slowest = min(one["rate_hz"] for one in facts["readers"])
    cpu = ", ".join(f"{role} {percent:g} %" for role, percent in facts["cpu_percent"].items())
    return f"{slowest:.1f} Hz, {cpu}"


def report(found: Results) -> None:
    """Writes the charts and the report."""
    try:
        from bench.charts import write_charts  # noqa: PLC0415 - tables need no matplotlib

        write_charts(found)
    except ImportError as error:
        _say(f"no charts, as they need matplotlib ({error}): pip install -e '.[bench]'")
    _say(str(write_report(found)))


def _say(text: str) -> None:
    CONSOLE.print(text, highlight=False, markup=False, soft_wrap=True)


if __name__ == "__main__":
    main(prog_name="python -m bench")
