"""What runs, and what every test has: a rendezvous, free ports, sessions, processes that end with it.

``pytest`` runs the tests that need pip's packages only, and little time. ``--system`` adds those that need
more, each with the marker of its requirement (helpers/requirements.py); ``--long`` those that compute for
seconds, as on a whole recording; ``--soak`` trials by the hundred.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from helpers.plugins import battery_installed
from helpers.processes import Child, find_free_port, until
from helpers.requirements import REQUIREMENTS
from helpers.tokens import have_met
from hypothesis import settings

from zstate.net.session import Session, connect

if TYPE_CHECKING:
    from zstate.driving import DriverHost
    from zstate.streams import Stream

# bench/ is not in the package, so it is imported from the repository. The path is appended: the tests use an
# installed zstate if there is one.
TESTS = Path(__file__).parent
ROOT = str(TESTS.parent)
if ROOT not in sys.path:
    sys.path.append(ROOT)


# An example may take any time: on a busy machine one takes seconds.
settings.register_profile("zstate", deadline=None)
# For --hypothesis-profile: properties that another run has searched, with other versions.
settings.register_profile("versions", deadline=None, max_examples=15)
settings.load_profile("zstate")


LEFT_OUT = pytest.StashKey[Counter[str]]()
SYSTEM = "need system packages, root, a browser or other interpreters; `pytest --system` runs them"
LONG = "compute for a second or more; `pytest --long` runs them"
SOAK = "are trials by the hundred; `pytest --soak` runs them"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--system", action="store_true", help="also tests that need more than pip's packages")
    parser.addoption("--long", action="store_true", help="also tests that compute for a second or more")
    parser.addoption("--soak", action="store_true", help="also trials by the hundred")


def pytest_configure(config: pytest.Config) -> None:
    config.stash[LEFT_OUT] = Counter()
    _collect_elsewhere(config)
    # Collection makes 100,000 objects that stay: searching them for garbage takes a third of its time.
    gc.disable()
    # Processes of tests would inherit what nohup and shells make of a program in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    for name, requirement in REQUIREMENTS.items():
        config.addinivalue_line("markers", f"{name}: runs with --system; {requirement.install}")
    config.addinivalue_line("markers", "system: has one of those markers")


def _collect_elsewhere(config: pytest.Config) -> None:
    """Let each worker of ``-n`` begin with other tests: what one of them has compiled, the others read."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if config.args == config.getini("testpaths") and worker:
        places = sorted(str(path) for path in TESTS.iterdir() if path.is_dir() or path.match("test_*.py"))
        first = len(places) * int(worker.removeprefix("gw")) // config.workerinput["workercount"]
        config.args[:] = places[first:] + places[:first]


def pytest_itemcollected(item: pytest.Item) -> None:
    if not REQUIREMENTS.keys().isdisjoint(marker.name for marker in item.iter_markers()):
        item.add_marker("system")
    if item.get_closest_marker("long") and not item.get_closest_marker("timeout"):
        item.add_marker(pytest.mark.timeout(600))  # minutes, beside others


def pytest_collection_finish() -> None:
    gc.enable()
    gc.freeze()


@cache
def is_met(requirement: str) -> bool:
    return REQUIREMENTS[requirement].is_met()


def reason_to_leave_out(item: pytest.Item) -> str | None:
    markers = {marker.name for marker in item.iter_markers()}
    if "soak" in markers and not item.config.getoption("--soak"):
        return SOAK
    needed = [name for name in REQUIREMENTS if name in markers]
    if needed and not item.config.getoption("--system"):
        return SYSTEM
    missing = next((name for name in needed if not is_met(name)), None)
    if missing:
        return f"need what the marker {missing!r} names: {REQUIREMENTS[missing].install}"
    return LONG if "long" in markers and not item.config.getoption("--long") else None


@pytest.hookimpl(trylast=True)  # after -m and -k
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    reasons = {item: reason for item in items if (reason := reason_to_leave_out(item))}
    config.stash[LEFT_OUT].update(reasons.values())
    config.hook.pytest_deselected(items=list(reasons))
    items[:] = sorted((item for item in items if item not in reasons), key=lambda item: item.path)


def pytest_sessionfinish(session: pytest.Session) -> None:
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left_out"] = dict(session.config.stash[LEFT_OUT])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    return 4 * (os.cpu_count() or 1)  # tests wait more than they compute


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Of ``-n``: a worker without tests takes half of another's.

    Each begins with the tests of some packages, so that those that wait run beside those that compute.
    """
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.getoption("dist") == "load" else None


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    # Each worker collects all tests.
    node.config.stash[LEFT_OUT] |= Counter(getattr(node, "workeroutput", {}).get("left_out", {}))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for reason, count in config.stash[LEFT_OUT].items():
        terminalreporter.write_line(f"LEFT OUT: {count} tests that {reason}")


@pytest.fixture
def free_port() -> int:
    return find_free_port()


@pytest.fixture(autouse=True)
def rendezvous(monkeypatch: pytest.MonkeyPatch) -> str:
    """A rendezvous address for this test and its processes, which isolates them from all others."""
    address = f"127.0.0.1:{find_free_port()}"
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", address)
    for variable in ("ZENOH_CONFIG", "ZSTATE_MODE", "ZSTATE_CONNECT", "ZSTATE_LISTEN", "ZSTATE_CONFIG"):
        monkeypatch.delenv(variable, raising=False)
    return address


@pytest.fixture
def sessions() -> Iterator[tuple[Session, Session]]:
    """A session for publishers and a session for readers, which have met."""
    with connect() as writer, connect() as reader:
        until(lambda: have_met(writer, reader) and have_met(reader, writer))
        yield writer, reader


@pytest.fixture
def battery_plugin() -> Iterator[Stream]:
    """The row of the stream ``battery`` of another package, installed during the test."""
    with battery_installed() as row:
        yield row


@pytest.fixture
def host_driver(
    sessions: tuple[Session, Session], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., DriverHost]]:
    """``host_driver()`` runs the driver of the robot "arm" until the end of the test.

    It is a simulated rrbot whose joints are at their setpoints, with 2 rad/s at most. ``options`` are those
    of DriverHost. Stops are kept in a folder of the test.
    """
    from helpers.robots import RRBOT

    from zstate.driving import DriverHost, Limits, SimulatedDriver

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    limits = Limits.of(RRBOT, velocity=2.0, acceleration=float("inf"))
    with ExitStack() as opened:

        def hosted(**options: Any) -> DriverHost:
            driver = SimulatedDriver(RRBOT, "mirror")
            options = {"rate_hz": 100.0, "limits": limits, "program": "driver", **options}
            host = opened.enter_context(DriverHost(sessions[0], driver, RRBOT, "arm", **options))
            thread = threading.Thread(target=host.run)
            thread.start()
            opened.callback(thread.join)
            opened.callback(host.close)
            until(lambda: host.state == "ready")
            return host

        yield hosted


@pytest.fixture
def spawn() -> Iterator[Callable[..., Child]]:
    """``spawn(code, *arguments)`` starts a Child, which is killed at the end of the test.

    It is a fork of a process that has imported zstate, a tenth of the cost; with ``is_forked=False`` an
    interpreter of its own, for what depends on imports.
    """
    children: list[Child] = []

    def start(code: str, *arguments: str, **options: Any) -> Child:
        children.append(Child(code, *arguments, **options))
        return children[-1]

    yield start
    for child in children:
        child.kill()
        child.wait()
