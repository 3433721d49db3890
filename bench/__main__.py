"""The benchmark: ``python -m bench setup``, then ``run``, then ``report``."""

from __future__ import annotations

import secrets
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from bench import results
from bench.page import PAGE, with_current_tables
from bench.plots import PlotsMissing, write_plots
from bench.process import ROOT
from bench.report import write_report
from bench.run import Turn, estimated_seconds, plan_turns, run
from bench.scenario import FULL, QUICK, select_scenarios
from bench.subjects import NAMES, subject_named
from bench.subjects.subject import Subject
from bench.trial import Facts

CONSOLE = Console()


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Compare zstate with the real systems: rates, latency and cost."""


@main.command()
@click.argument("names", nargs=-1, metavar="[SUBJECT]...")
def setup(names: tuple[str, ...]) -> None:
    """Show which subjects are installed; install each named SUBJECT with the commands shown."""
    for name in names:
        for command in _subject(name).install:
            CONSOLE.print(f"[bold]$ {command}[/]", highlight=False)
            # The command shown is the command run; it comes from this repository.
            if subprocess.run(command, shell=True, cwd=ROOT, check=False).returncode:
                raise click.ClickException(f"{name}: this command failed; the commands after it were not run")
    _show_installed([subject_named(name) for name in NAMES])


def _show_installed(subjects: Sequence[Subject]) -> None:
    table = Table("subject", "is", "installed", box=None)
    missing = [one for one in subjects if one.python() is None]
    for one in subjects:
        versions = "[red]no[/]" if one in missing else ", ".join(map(" ".join, one.versions().items()))
        table.add_row(one.name, one.title, versions)
    CONSOLE.print(table)
    for one in missing:
        CONSOLE.print(f"\n[bold]{one.name}[/]: python -m bench setup {one.name}, which is", highlight=False)
        for command in one.install:
            # Unbroken, so that it can be pasted.
            CONSOLE.print(f"  {command}", highlight=False, markup=False, soft_wrap=True)


@main.command("run")
@click.option(
    "--quick", is_flag=True, help="A few scenarios with short windows: minutes instead of most of an hour."
)
@click.option(
    "--subject", "subjects", multiple=True, metavar="NAME", help="Run only this subject; may be repeated."
)
@click.option(
    "--scenario",
    "words",
    multiple=True,
    metavar="NAME",
    help="Run only this scenario or group; may be repeated.",
)
@click.option(
    "--repeat",
    default=1,
    show_default=True,
    type=click.IntRange(min=1),
    help="Multiply the number of rounds.",
)
@click.option("--seed", type=int, help="Seed of the order of subjects; random by default.")
@click.option("--list", "only_list", is_flag=True, help="List the runs and their total duration, then exit.")
def run_command(
    *,
    quick: bool,
    subjects: tuple[str, ...],
    words: tuple[str, ...],
    repeat: int,
    seed: int | None,
    only_list: bool,
) -> None:
    """Measure, and write the report."""
    try:
        scenarios = select_scenarios(QUICK if quick else FULL, words)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--scenario") from None
    chosen = [_subject(name) for name in subjects or NAMES]
    seed = secrets.randbits(32) if seed is None else seed
    planned = plan_turns([one for one in chosen if one.python() is not None], scenarios, repeat, seed)
    CONSOLE.print(
        f"{len(planned)} runs, about {estimated_seconds(planned) / 60:.0f} minutes, seed {seed}",
        highlight=False,
    )
    for one in chosen:
        if one.python() is None:
            CONSOLE.print(f"not installed: {one.title}; python -m bench setup {one.name}", highlight=False)
    if only_list:
        for turn in planned:
            CONSOLE.print(f"{turn.scenario.name}  {turn.subject.name}", highlight=False)
        return
    folder = results.new_folder()
    results.write_about(folder, shlex.join(["python", "-m", "bench", *sys.argv[1:]]), chosen, scenarios, seed)
    _run(folder, planned)
    _report(folder)


def _run(folder: Path, planned: list[Turn]) -> None:
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    # Drawn only between runs: a moving bar would be measured too.
    with Progress(*columns, console=CONSOLE, auto_refresh=False) as progress:
        task = progress.add_task("", total=len(planned))

        def show(number: int, turn: Turn, facts: Facts | None) -> None:
            what = f"{turn.scenario.name}  {turn.subject.title}"
            if facts is None:
                progress.update(task, description=what, completed=number, refresh=True)
            else:
                progress.update(task, completed=number + 1)
                progress.print(f"{what}: {_summary(facts)}", highlight=False, markup=False, soft_wrap=True)

        run(folder, planned, show)
        progress.update(task, description="done", refresh=True)


def _summary(facts: Facts) -> str:
    if "failed" in facts:
        return f"FAILED, {facts['failed']}"
    if "whole_ms" in facts:
        return f"whole tree within {max(facts['whole_ms']):g} ms"
    rates = [one["rate_hz"] for one in facts["readers"]]
    cpu = ", ".join(f"{role} {percent:g} %" for role, percent in facts["cpu_percent"].items())
    medians = [one["latency_us"][50] for one in facts["readers"] if one["latency_us"]]
    return f"{min(rates):.1f} Hz, {max(medians, default=float('nan')):.0f} us, {cpu}"


@main.command()
@click.argument("folder", required=False, type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--page", is_flag=True, help="Rewrite the tables of docs/benchmarks.md, each from the folder it names."
)
def report(*, folder: Path | None, page: bool) -> None:
    """Rewrite the tables and plots of the last run, or of the run in FOLDER."""
    if page:
        PAGE.write_text(with_current_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        _report(folder or results.newest())


def _report(folder: Path) -> None:
    found = results.Results.read(folder)
    plots: list[Path] = []
    try:
        plots = write_plots(found)
    except PlotsMissing as reason:
        CONSOLE.print(str(reason), highlight=False, markup=False)
    for path in (write_report(found, plots), *plots):
        CONSOLE.print(str(path), highlight=False, soft_wrap=True)


def _subject(name: str) -> Subject:
    if name not in NAMES:
        raise click.BadParameter(f"{name!r} is not one of {', '.join(NAMES)}", param_hint="subject")
    return subject_named(name)


if __name__ == "__main__":
    main(prog_name="python -m bench")
