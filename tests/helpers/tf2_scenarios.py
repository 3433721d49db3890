"""Random frame trees and lookups, evaluated by tf2 and by zstate."""

from __future__ import annotations

import json
import random
import subprocess
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import (
    Disconnected,
    InFuture,
    InPast,
    InvalidInput,
    LookupFailed,
    NoData,
    Stale,
    UnknownFrame,
)
from zstate.transform import Transform

MS = 1_000_000
S = 1_000_000_000
SYSTEM_PYTHON = "/usr/bin/python3"
DEEPEST = 8

# Kinds of results, common to both sides.
TF2_KINDS = {
    "LookupException": "unknown",
    "InvalidArgumentException": "name",
    "ConnectivityException": "disconnected",
    "ExtrapolationException": "time",
}


def tf2_answers(scenarios: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """The results of tf2 for every lookup of every scenario."""
    lines = "".join(json.dumps(scenario) + "\n" for scenario in scenarios)
    command = [SYSTEM_PYTHON, str(Path(__file__).with_name("tf2_process.py"))]
    done = subprocess.run(command, input=lines, capture_output=True, timeout=60, check=False, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def tf2_error_kind(answer: dict[str, Any]) -> str:
    return TF2_KINDS[answer["error"]] if "error" in answer else "answer"


Answer: TypeAlias = Transform | LookupFailed | InvalidInput

_KINDS = {
    UnknownFrame: "unknown",
    InvalidInput: "name",
    Disconnected: "disconnected",
    InFuture: "time",
    InPast: "time",
    NoData: "time",
    Stale: "time",
    Transform: "answer",
}


def zstate_error_kind(answer: Answer) -> str:
    return _KINDS[type(answer)]


def zstate_answers(scenario: dict[str, Any]) -> list[Answer]:
    """The results of zstate for every lookup of one scenario; refused inserts are skipped."""
    buffer = TransformBuffer(scenario["history"] / S)
    answers: list[Answer] = []
    for name, *values in scenario["steps"]:
        if name == "ask":
            answers.append(_answer(buffer, values))
        elif name == "clear":
            buffer.clear()
        else:
            _insert(buffer, name, values)
    return answers


def _insert(buffer: TransformBuffer, name: str, values: list[Any]) -> None:
    try:
        if name == "insert":
            parent, child, stamp, pose = values
            buffer.insert_many([(parent, child)], stamp, [pose])
        else:
            parent, child, pose = values
            buffer.insert_static(Transform.from_pose7(parent, child, pose))
    except InvalidInput:
        pass


def _answer(buffer: TransformBuffer, question: list[Any]) -> Answer:
    try:
        return buffer.lookup(*question) if len(question) == 3 else buffer.lookup_between(*question)
    except (LookupFailed, InvalidInput) as reason:
        return reason


def a_pose(rng: random.Random) -> list[float]:
    q = np.array([rng.gauss(0, 1) for _ in range(4)])
    return [*(rng.uniform(-2, 2) for _ in range(3)), *(q / np.linalg.norm(q)).tolist()]


def a_scenario(rng: random.Random, questions: int) -> dict[str, Any]:
    """A forest of up to 14 frames, its samples in any order, and lookups between and after them."""
    history = rng.choice([2, 5, 10]) * S
    begin = rng.randrange(1, 900_000) * S + rng.randrange(1000) * MS
    inserts = _inserts(rng, begin)
    rng.shuffle(inserts)
    stamps = [step[3] for step in inserts if step[0] == "insert"] or [begin]
    frames = sorted({name for step in inserts for name in step[1:3]})
    asks = [["ask", *_question(rng, frames, stamps)] for _ in range(questions)]
    half = questions // 2
    steps = [*inserts[::2], *asks[:half], *inserts[1::2], *asks[half:]]
    if rng.random() < 0.15:
        steps += [["clear"], *inserts[::3], *asks[:half]]
    return {"history": history, "steps": steps}


def _inserts(rng: random.Random, begin: int) -> list[list[Any]]:
    depths = {"f0": 0}
    inserts: list[list[Any]] = []
    for n in range(1, rng.randrange(2, 15)):
        parent, child = rng.choice([name for name, depth in depths.items() if depth < DEEPEST]), f"f{n}"
        depths[child] = depths[parent] + 1
        if n > 1 and rng.random() < 0.1:
            # The root of another tree.
            depths[child] = 0
        elif rng.random() < 0.3:
            inserts.append(["static", parent, child, a_pose(rng)])
        else:
            stamps = {begin + rng.randrange(12_000) * MS for _ in range(rng.choice([1, 2, 4, 12]))}
            samples = [["insert", parent, child, stamp, a_pose(rng)] for stamp in stamps]
            # Some messages arrive twice.
            inserts += samples + (samples[:1] if rng.random() < 0.3 else [])
    return inserts


def _question(rng: random.Random, frames: list[str], stamps: list[int]) -> list[Any]:
    def frame() -> str:
        return rng.choice(frames) if rng.random() < 0.97 else rng.choice(["unknown", "", "/f1"])

    def stamp() -> int | None:
        draw = rng.random()
        if draw < 0.25:
            return None
        if draw < 0.27:
            return 0
        return rng.choice(stamps) + (0 if draw < 0.5 else rng.randrange(-1000, 1000) * MS)

    if rng.random() < 0.75:
        return [frame(), frame(), stamp()]
    return [frame(), stamp(), frame(), stamp(), frame()]
