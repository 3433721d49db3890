"""``pytest -p helpers.removal --without FOLDER``: the tests without that folder of zstate.

Left out are the tests of the folder, those of other folders that need it, and every test that imports it or
calls its commands. Run it with ``-m 'not processes'``: in processes that tests start, nothing is hidden.
"""

from __future__ import annotations

import sys
from collections.abc import Generator, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from zstate.plugins import built_in_plugins

REMOVED = "is removed for this run"

# What the help says of all commands together.
OF_ALL_COMMANDS = {
    "test_every_synonym_leads_to_commands_that_exist",
    "test_the_help_lists_the_commands_of_plugins_as_well",
}


class Hidden:
    """A finder that finds nothing in ``folders`` of zstate."""

    def __init__(self, folders: Sequence[str]) -> None:
        self._folders = {f"zstate.{folder}" for folder in folders}

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        if ".".join(name.split(".")[:2]) in self._folders:
            raise ModuleNotFoundError(f"{name} {REMOVED}", name=name)
        return None


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--without", metavar="FOLDER", help="hide a folder of zstate and what needs it")


def removed_folders(config: pytest.Config) -> list[str]:
    folder = config.getoption("--without")
    return [folder, *(plugin.name for plugin in built_in_plugins() if folder in plugin.needs)]


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    folders = removed_folders(config)
    config.stash[FOLDERS] = folders
    for name in [one for one in sys.modules if one.startswith(tuple(f"zstate.{one}" for one in folders))]:
        del sys.modules[name]
    gone = {name for plugin in built_in_plugins() if plugin.name in folders for name in plugin.commands}
    config.stash[COMPLAINTS] = [REMOVED, *(f"there is no command {name!r}" for name in gone)]
    built_in_plugins.cache_clear()
    sys.meta_path.insert(0, Hidden(folders))


FOLDERS = pytest.StashKey[list[str]]()
COMPLAINTS = pytest.StashKey[list[str]]()
"""What fails because of the removal says one of these."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    tests = Path(__file__).parents[1]
    return True if any(collection_path == tests / one for one in config.stash[FOLDERS]) else None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    if report.failed and REMOVED in str(report.longrepr):
        report.outcome, report.longrepr = "skipped", (str(collector.path), 0, f"Skipped: {REMOVED}")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    text = str(report.longrepr)
    is_of_all = item.name.partition("[")[0] in OF_ALL_COMMANDS
    if report.failed and (is_of_all or any(one in text for one in item.config.stash[COMPLAINTS])):
        report.outcome, report.longrepr = "skipped", (str(item.path), 0, f"Skipped: {REMOVED}")
    return report
