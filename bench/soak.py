"""A fleet through one router, for a long time: does anything grow, and is anything lost?

    python -m bench.soak [--robots 100] [--rate 50] [--minutes 10] [--processes 4] [--model panda]

One router process; publisher processes that share the robots, each robot with a session of its own; one
reader of all. Every robot also has a static edge, whose value is the number of the present half minute:
within it the reader must see each robot's new value, and so must a fresh reader that joins then.

Sampled every 5 s from outside, out of /proc: resident memory, threads, file descriptors and CPU of each
process. The result goes to bench/results as JSON, with a table beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from zstate import (
    SineSource,
    StatePublisher,
    StaticPublisher,
    TransformBuffer,
    TransformListener,
    ZStateError,
    connect,
    load_model,
)
from zstate.clock import SystemClock
from zstate.rate import Rate
from zstate.transform import Transform

EPOCH_S = 30
SAMPLE_S = 5.0
WARM_UP_S = 120.0  # buffers fill their 10 s and allocators settle
STALE_NS = 1_000_000_000
RESULTS = Path(__file__).parent / "results"

Options: TypeAlias = argparse.Namespace
Report: TypeAlias = "dict[str, Any]"


def main() -> None:
    """Run one role of the soak, or the whole of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--model", default="panda")
    for hidden in ("--role", "--endpoint"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    parser.add_argument("--share", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    roles = {"router": _route, "publisher": _publish, "reader": _read}
    if options.role:
        print(json.dumps(roles[options.role](options)))
    else:
        _soak(options)


# ---- the roles: each says a line when it is ready, and reports when its standard input ends


def _until_told() -> threading.Event:
    told = threading.Event()

    def listen() -> None:
        sys.stdin.read()
        told.set()

    threading.Thread(target=listen, daemon=True).start()
    return told


def _route(options: Options) -> Report:
    with connect(mode="router", listen=options.endpoint):
        print("ready", flush=True)
        _until_told().wait()
    return {}


def _epoch() -> int:
    return int(time.time()) // EPOCH_S


def _names(options: Options) -> list[str]:
    return [f"r{number:03}" for number in range(options.robots)]


def _publish(options: Options) -> Report:
    model = load_model(options.model)
    source = SineSource(model)
    stop = _until_told()
    with ExitStack() as opened:
        robots: list[tuple[StatePublisher, StaticPublisher]] = []
        for name in _names(options)[options.share :: options.processes]:
            session = opened.enter_context(connect(mode="client", endpoints=options.endpoint))
            publisher = opened.enter_context(StatePublisher(session, model, name))
            robots.append((publisher, opened.enter_context(StaticPublisher(session, name, "mark"))))
        print("ready", flush=True)
        rate = Rate(options.rate, SystemClock(), stop)
        told = 0
        for stamp in rate:
            reading = source.read(stamp)
            for publisher, _ in robots:
                publisher.publish(reading.positions, reading.velocities, stamp=stamp)
            if _epoch() != told:
                told = _epoch()
                for _, statics in robots:
                    statics.set(_mark(model.root, told))
    report = rate.report()
    return {"sent": report.ticks * len(robots), "achieved_hz": report.rate_hz, "skipped": report.skipped}


def _mark(root: str, epoch: int) -> Transform:
    return Transform.from_rpy(root, "mark", (float(epoch), 0.0, 0.0), (0.0, 0.0, 0.0))


def _read(options: Options) -> Report:
    model = load_model(options.model)
    names, root, tip = _names(options), model.root, model.links[-1]
    stop = _until_told()
    with (
        connect(mode="client", endpoints=options.endpoint) as session,
        TransformListener(session) as listener,
    ):
        print("ready", flush=True)
        watching = _Watching(listener.buffer, names, root, tip)
        for _ in Rate(2.0, SystemClock(), stop):
            watching.look()
        stats = listener.stats
    return {
        "received": stats.received,
        "missed": stats.missed,
        "dropped": stats.dropped,
        "late": stats.late,
        "refused": stats.refused,
        **watching.report(),
    }


class _Watching:
    """Looks at every robot twice a second: how old it is, and which half minute its static edge names."""

    def __init__(self, buffer: TransformBuffer, names: list[str], root: str, tip: str) -> None:
        self._buffer = buffer
        self._ends = [(f"{name}/{root}", f"{name}/{tip}", f"{name}/mark") for name in names]
        self._ages_s: list[float] = []
        self._stale = 0
        self._epoch = 0
        self._latched_after_s: list[float] = []
        self._lost_latched = 0
        self._is_complete = True

    def look(self) -> None:
        now = time.time_ns()
        for root, tip, _ in self._ends:
            try:
                age = now - self._buffer.latest(root, tip)
            except ZStateError:
                continue
            self._ages_s.append(age * 1e-9)
            self._stale += age > STALE_NS
        self._look_at_latched()

    def _look_at_latched(self) -> None:
        behind = missing(self._buffer, self._ends)
        if _epoch() != self._epoch:
            # The half minute in which the soak begins is not counted: not everybody is there yet.
            # Nor is the end, when the publishers have gone and taken their edges back.
            if not self._is_complete and self._latched_after_s and behind < len(self._ends):
                self._lost_latched += behind
            self._epoch, self._is_complete = _epoch(), False
            behind = missing(self._buffer, self._ends)
        if not behind and not self._is_complete:
            self._is_complete = True
            self._latched_after_s.append(time.time() - self._epoch * EPOCH_S)

    def report(self) -> Report:
        ages = np.array(self._ages_s) * 1e3
        late = np.array(self._latched_after_s[1:])  # the first is the time of joining
        return {
            "looks": len(ages),
            "age_ms_p50_p99_max": [round(float(v), 2) for v in (*np.percentile(ages, (50, 99)), ages.max())],
            "stale_looks": self._stale,
            "latched_rounds": len(self._latched_after_s),
            "latched_lost": self._lost_latched,
            "latched_within_s_median_max": [round(float(np.median(late)), 2), round(float(late.max()), 2)],
        }


def missing(buffer: TransformBuffer, ends: list[tuple[str, str, str]]) -> int:
    """How many robots have not got the static edge of this half minute."""
    epoch = float(_epoch())
    return sum(_marked(buffer, root, mark) != epoch for root, _, mark in ends)


def _marked(buffer: TransformBuffer, root: str, mark: str) -> float | None:
    try:
        return float(buffer.lookup(root, mark).translation[0])
    except ZStateError:  # not there yet, or withdrawn at the end
        return None


# ---- the whole


def _soak(options: Options) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        options.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    roles = ["router", "reader", *(f"publisher {share}" for share in range(options.processes))]
    processes = {role: _start(options, role) for role in roles}
    samples: dict[str, list[list[float]]] = {role: [] for role in roles}
    joins: list[Report] = []
    began = time.monotonic()
    try:
        for elapsed_s in _every(SAMPLE_S, options.minutes * 60):
            for role, process in processes.items():
                samples[role].append([round(elapsed_s, 1), *_usage(process.pid)])
            if round(elapsed_s / SAMPLE_S) % 12 == 6:
                joins.append(_join_fresh(options))
    finally:
        ended = {role: _end(process) for role, process in reversed(processes.items())}
    result = _result(options, time.monotonic() - began, ended, samples, joins)
    _write(result, RESULTS / f"soak-{time.strftime('%Y-%m-%d')}")


def _start(options: Options, role: str) -> subprocess.Popen[str]:
    kind, _, share = role.partition(" ")
    command = [sys.executable, "-m", "bench.soak", "--role", kind, "--share", share or "0"]
    for name in ("endpoint", "robots", "rate", "processes", "model"):
        command += [f"--{name}", str(getattr(options, name))]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout and process.stdout.readline() == "ready\n", f"the {role} did not start"
    return process


def _end(process: subprocess.Popen[str]) -> Report:
    said, _ = process.communicate(timeout=30.0)
    return json.loads(said)


def _every(period_s: float, seconds: float) -> Iterator[float]:
    began = time.monotonic()
    tick = 0
    while (elapsed_s := time.monotonic() - began) < seconds:
        yield elapsed_s
        tick += 1
        time.sleep(max(0.0, began + tick * period_s - time.monotonic()))


def _usage(pid: int) -> list[float]:
    """Resident kB, threads, file descriptors, CPU seconds."""
    process = Path(f"/proc/{pid}")
    lines = (process / "status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    times = (process / "stat").read_text().rpartition(")")[2].split()
    cpu_s = (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")
    return [
        int(status["VmRSS"].split()[0]),
        int(status["Threads"]),
        len(list((process / "fd").iterdir())),
        cpu_s,
    ]


def _join_fresh(options: Options) -> Report:
    """A reader that joins now: after how long it has every model and every present static edge."""
    model = load_model(options.model)
    names, began = _names(options), time.monotonic()
    ends = [(f"{name}/{model.root}", f"{name}/{model.links[-1]}", f"{name}/mark") for name in names]
    with (
        connect(mode="client", endpoints=options.endpoint) as session,
        TransformListener(session) as listener,
    ):
        buffer = listener.buffer
        complete = _within(10.0, lambda: not missing(buffer, ends) and _all_answer(buffer, ends))
        return {"complete": complete, "seconds": round(time.monotonic() - began, 3)}


def _all_answer(buffer: TransformBuffer, ends: list[tuple[str, str, str]]) -> bool:
    return all(buffer.can_lookup(root, tip) for root, tip, _ in ends)


def _within(timeout_s: float, condition: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.01)
    return False


def _result(
    options: Options, seconds: float, ended: dict[str, Report], samples: dict[str, Any], joins: list[Report]
) -> Report:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line.partition(":")[2].strip() for line in lines if "model name" in line), "")
    sent = sum(report.get("sent", 0) for report in ended.values())
    return {
        "command": f"python -m bench.soak --robots {options.robots} --rate {options.rate:g} "
        f"--minutes {options.minutes:g} --processes {options.processes} --model {options.model}",
        "machine": f"{os.cpu_count()} x {cpu or platform.machine()}, Linux {platform.release()}",
        "versions": {
            "python": platform.python_version(),
            **{p: version(p) for p in ("zstate", "eclipse-zenoh")},
        },
        "seconds": round(seconds, 1),
        "load_1_5_15": os.getloadavg(),
        "robots": options.robots,
        "sent": sent,
        "arrived_percent": round(100.0 * ended["reader"]["received"] / sent, 4),
        "processes": {role: {**report, **_growth(samples[role])} for role, report in ended.items()},
        "fresh_readers": joins,
        "sample_columns": ["seconds", "rss_kb", "threads", "fds", "cpu_s"],
        "samples": samples,
    }


def _growth(samples: list[list[float]]) -> Report:
    rows = np.array(samples)
    steady = rows[rows[:, 0] >= min(WARM_UP_S, rows[-1, 0] / 2)]
    minutes = steady[:, 0] / 60.0
    return {
        "rss_mb_first_last": [round(float(v) / 1024, 1) for v in (steady[0, 1], steady[-1, 1])],
        "rss_slope_kb_per_minute": round(float(np.polyfit(minutes, steady[:, 1], 1)[0]), 1),
        "threads_first_last": [int(steady[0, 2]), int(steady[-1, 2])],
        "fds_first_last": [int(steady[0, 3]), int(steady[-1, 3])],
        "cpu_percent": round(float((steady[-1, 4] - steady[0, 4]) / (minutes[-1] - minutes[0]) / 0.6), 1),
    }


def _write(result: Report, path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    table = "\n".join([*_head(result), *map(_row, result["processes"].items()), "", *_findings(result), ""])
    path.with_suffix(".json").write_text(json.dumps(result) + "\n", encoding="utf-8")
    path.with_suffix(".md").write_text(table, encoding="utf-8")
    print(table)


def _head(result: Report) -> list[str]:
    versions = ", ".join(f"{name} {number}" for name, number in result["versions"].items())
    return [
        f"# `{result['command']}`",
        "",
        f"{result['machine']}; {versions}; {result['seconds']} s, load {result['load_1_5_15'][1]:.2f}.",
        "Memory, threads and file descriptors are those after two minutes and at the end.",
        "",
        "| process | CPU % | memory MB | slope kB/min | threads | fds | Hz |",
        "|---|---|---|---|---|---|---|",
    ]


def _row(named: tuple[str, Report]) -> str:
    role, one = named
    spans = ["{} -> {}".format(*one[f"{what}_first_last"]) for what in ("rss_mb", "threads", "fds")]
    hz = f"{one['achieved_hz']:.3f}" if "achieved_hz" in one else ""
    cells = [role, one["cpu_percent"], spans[0], one["rss_slope_kb_per_minute"], *spans[1:], hz]
    return f"| {' | '.join(map(str, cells))} |"


def _findings(result: Report) -> list[str]:
    reader, joins = result["processes"]["reader"], result["fresh_readers"]
    losses = ", ".join(f"{what} {reader[what]}" for what in ("missed", "dropped", "late", "refused"))
    return [
        f"- sent {result['sent']}, received {reader['received']} ({result['arrived_percent']} %); {losses}",
        f"- age of the newest sample at {reader['looks']} looks, median, p99, largest: "
        f"{reader['age_ms_p50_p99_max']} ms; older than a second: {reader['stale_looks']}",
        f"- latched values: {reader['latched_rounds']} rounds of {result['robots']} robots, lost "
        f"{reader['latched_lost']}; all there after {reader['latched_within_s_median_max']} s (median, max)",
        f"- fresh readers: {sum(one['complete'] for one in joins)} of {len(joins)} had everything, after "
        f"{max((one['seconds'] for one in joins), default=0.0)} s at most",
    ]


if __name__ == "__main__":
    main()
