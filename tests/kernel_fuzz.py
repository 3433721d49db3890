"""Hostile arguments for the C extension, under AddressSanitizer and UndefinedBehaviorSanitizer.

    python tests/kernel_fuzz.py [SECONDS]

Builds the extension with gcc's sanitizers, calls everything it offers with whatever comes to mind, and
ends with a non-zero exit at the first crash, bad access, undefined operation or SystemError.
"""

from __future__ import annotations

import gc
import importlib.util
import math
import os
import random
import struct
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np

SOURCE = Path(__file__).parent.parent / "zstate" / "buffer" / "_kernel.c"
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer"]
LIBRARY = "KERNEL_FUZZ_LIBRARY"

STAMPS = (0, 1, -1, 7, 10**18, 2**63 - 1, -(2**63), 2**63, -(2**63) - 1, 2**200)
ODD = (None, 1.5, math.nan, "abc", b"\0" * 16, [1.0, 2.0], (), {}, True, object(), np.int64(4), type, float)
FLOATS = (0.0, -0.0, 1.0, math.nan, math.inf, -math.inf, 1e308, 5e-324, 3.0)
STEP_NUMBERS = (7, 13, 12, 7, 7)


def build(folder: str) -> Path:
    """The extension with sanitizers."""
    library = Path(folder, f"_kernel{sysconfig.get_config_var('EXT_SUFFIX')}")
    include = sysconfig.get_path("include")
    warnings = ["-Wall", "-Wextra", "-Wshadow", "-Wno-missing-field-initializers", "-Werror"]
    command = ["gcc", "-std=c11", "-g", "-O1", *warnings, *SANITIZERS, "-fPIC", "-shared", f"-I{include}"]
    subprocess.run([*command, str(SOURCE), "-o", str(library)], check=True)
    return library


def run_under_sanitizers(seconds: float) -> int:
    """This script again, with the sanitizers' runtime loaded before Python's own memory is."""
    found = subprocess.run(["gcc", "-print-file-name=libasan.so"], check=True, capture_output=True, text=True)
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {
            LIBRARY: str(build(folder)),
            "LD_PRELOAD": found.stdout.strip(),
            "ASAN_OPTIONS": "detect_leaks=0,allocator_may_return_null=1",  # the interpreter itself leaks
            "PYTHONMALLOC": "malloc",  # so that each object is a piece of memory of its own
        }
        command = [sys.executable, __file__, str(seconds)]
        return subprocess.run(command, env=environment, check=False).returncode


class Versioned:
    """A source of versions for a fast path; reading one may run any code, for instance change that."""

    reenter: ClassVar[Callable[[], object]]

    def __init__(self, fuzz: Fuzz) -> None:
        self.fuzz = fuzz
        self.value = object()

    @property
    def version(self) -> object:
        choice = self.fuzz.random.random()
        if choice < 0.03:
            Versioned.reenter()
        elif choice < 0.06:
            for fast_path in self.fuzz.fast_paths:
                fast_path.stop()
        elif choice < 0.08:
            raise ValueError("no version")
        return self.value if choice < 0.97 else object()


class Fuzz:
    """One seed's worth of calls; histories and paths made on the way are used again."""

    def __init__(self, kernel: Any, seed: int) -> None:
        self.kernel = kernel
        self.random = random.Random(seed)
        self.numbers = np.random.default_rng(seed)
        self.fast_paths: list[Any] = []
        self.sources: dict[int, tuple[Versioned, ...]] = {}
        self.histories: list[Any] = [kernel.History(width, 10**9) for width in (0, 1, 7, 14, 40)]
        self.paths: list[Any] = []
        self.encoders: list[Any] = [kernel.JointStateEncoder(7, bytes(8), 7, 6, (3,))]
        self.widths: list[Any] = [(7, 6)]
        self.rings: list[Any] = [kernel.SampleRing(5, 100, 10)]
        self.publish_paths: list[tuple[Any, int, int]] = []
        self.ros_encoders: list[tuple[Any, int, int]] = []
        self.kept: list[Any] = []
        self.transform = type("Transform", (kernel.TransformFields,), {"__slots__": ()})
        self.calls: tuple[Callable[[], object], ...] = (
            self.make_history,
            *(self.write,) * 8,
            self.replace,
            self.clear,
            self.make_fast_path,
            *(self.insert_next,) * 6,
            self.write_together,
            self.make_path,
            self.make_good_path,
            *(self.lookup,) * 6,
            *(self.take_newer,) * 3,
            *(self.lookup_many,) * 2,
            *(self.place,) * 3,
            self.make_facts,
            self.edges,
            self.make_encoder,
            *(self.encode,) * 4,
            self.make_ring,
            *(self.cache,) * 2,
            self.make_publish_path,
            *(self.publish,) * 4,
            self.make_ros_encoder,
            self.encode_for_ros,
            self.placements,
            self.keep_memory,
        )

    def pick(self, *choices: Any) -> Any:
        return self.random.choice(choices)

    def stamp(self) -> Any:
        near = self.random.randrange(-50, 1000)
        return self.pick(near, near, near, near * 10**7, self.pick(*STAMPS), self.pick(*ODD))

    def array(self, size: int, good: float = 0.8) -> Any:
        """Mostly ``size`` doubles; at times something else."""
        row = self.numbers.normal(size=max(size, 0))
        if self.random.random() < good:
            return row
        wide = np.zeros((max(size, 1), 2))
        frozen = row.copy()
        frozen.flags.writeable = False
        odd = [row[::-1], wide[:, 0], frozen, row.astype("f4"), row.astype("i8"), row.astype(">f8")]
        odd += [
            np.zeros(size + 1),
            np.zeros((size, 1)),
            np.full(size, math.nan),
            memoryview(row),
            np.zeros(()),
        ]
        odd += [row.view("u1"), np.zeros((3, 0)), np.empty(2, object), bytearray(8 * size), self.pick(*ODD)]
        return self.pick(*odd, *self.kept)

    def history(self) -> Any:
        return self.random.choice(self.histories)

    def make_history(self) -> None:
        width = self.pick(0, 1, 3, 7, -1, 2**20 + 1, 2**62, 2**70, *ODD)
        self.histories.append(self.kernel.History(width, self.pick(0, 1, 5, 10**9, 2**63 - 1, -1, *ODD)))
        del self.histories[: max(0, len(self.histories) - 12)]

    def write(self) -> None:
        history = self.history()
        if self.random.random() < 0.5:
            history.insert(self.stamp(), self.array(history.width))
        else:
            count = self.pick(history.width, history.width // 2, -1, 2**62, *ODD)
            size = count if isinstance(count, int) and 0 <= count < 100 else 3
            rates = self.pick(None, self.array(history.width - size))
            numbers = self.array(size)
            if isinstance(numbers, np.ndarray) and self.random.random() < 0.4:
                numbers = numbers.tobytes()[self.pick(0, 0, 0, 1, 8) :]
            history.try_insert(self.stamp(), numbers, rates, count)
            history.try_insert_poses(self.stamp(), numbers)
        history.reaches(self.stamp())

    def replace(self) -> None:
        history = self.history()
        size = self.random.randrange(30)
        stamps = np.cumsum(self.numbers.integers(0 if self.random.random() < 0.1 else 1, 9, size))
        rows = self.array(size * history.width)
        history.replace(self.pick(stamps, stamps[::-1], stamps.astype("i4"), self.array(3)), rows)

    def clear(self) -> None:
        self.history().clear()

    def mostly(self, good: Any, *bad: Any) -> Any:
        return good if self.random.random() < 0.95 else self.pick(*bad, *ODD)

    def make_fast_path(self) -> None:
        sources = tuple(Versioned(self) for _ in range(self.random.randrange(3)))
        counts = self.pick({}, {"received": 2**63 - 1}, {"received": "many"})
        waiters = self.mostly({"track": (1, 2)}, {}, {"track": None})
        self.fast_paths.append(self.kernel.FastPath(waiters, self.mostly(counts), self.mostly(sources)))
        self.sources[id(self.fast_paths[-1])] = sources
        del self.fast_paths[: max(0, len(self.fast_paths) - 6)]

    def message(self, history: Any, stamp: int, seq: int, counts: tuple[int, ...]) -> Any:
        """Mostly a message of the native wire; at times a damaged one."""
        numbers = [self.numbers.normal(size=count) for count in counts]
        for block in numbers:
            if len(block) % 7 == 0:
                block.reshape(-1, 7)[:, 3:] = (1.0, 0.0, 0.0, 0.0)
        head = [self.mostly(stamp, *STAMPS[:6]), seq, 7, b"\0" * 8]
        good = msgspec.msgpack.encode([*head, *(block.tobytes() for block in numbers), None])
        if self.random.random() < 0.4:
            good = self.ros_message(stamp, seq, numbers)
        at = self.random.randrange(len(good))
        flipped = good[:at] + bytes([self.random.randrange(256)]) + good[at + 1 :]
        return self.mostly(good, good[:at], flipped, flipped, good + b"\0", bytearray(good), b"")

    def ros_message(self, stamp: int, seq: int, numbers: list[Any]) -> bytes:
        """A JointState as CDR, with its attachment."""
        cdr = bytearray(struct.pack("<4siII4sI", b"\0\1\0\0", *divmod(stamp % 2**60, 10**9), 4, b"abc\0", 2))
        cdr += struct.pack("<I2sxxI1s", 2, b"a\0", 1, b"\0")
        for block in [*numbers, (), ()][:3]:
            cdr += bytes(-len(cdr) % 4) + struct.pack("<I", self.mostly(len(block), 2**32 - 1, 2**29))
            cdr += bytes((4 - len(cdr)) % 8 if len(block) else 0) + np.array(block, "<f8").tobytes()
        return bytes(cdr) + struct.pack("<qqB16s", seq, self.random.randrange(9), 16, b"gid")

    def insert_next(self) -> None:
        """A run of messages, of which each should be the one after the last."""
        if not self.fast_paths:
            self.make_fast_path()
        fast_path, history = self.random.choice(self.fast_paths), self.history()
        width = min(history.width, 100)
        counts = self.pick((width,), (width // 2, width - width // 2), (width // 2, width - width // 2, 3))
        place = self.pick(counts[0], counts[0], -1)
        if place == -1:
            counts = self.pick((width,), (width // 4,))
        sources = self.sources[id(fast_path)]
        Versioned.reenter = lambda: fast_path.expect(message, track, history, place, versions)
        versions, track = tuple(source.value for source in sources), self.mostly("track")
        stamp, seq = self.mostly(10**9, 2**62), self.pick(0, 5, 100, 2**31, 2**63 - 3)
        message = self.message(history, stamp, seq, counts)
        fast_path.expect(message, track, history, self.mostly(place, 2**62, -(2**62)), self.mostly(versions))
        for step in range(1, self.random.randrange(2, 6)):
            limits = self.mostly((-(2**63), 2**63 - 1), (0, 10**6), (self.stamp(), self.stamp()), ())
            message = self.message(history, stamp + step, seq + step, counts)
            fast_path.insert(message, *limits)
            if self.random.random() < 0.1:
                self.pick(history.close, history.clear, fast_path.stop, gc.collect)()
        fast_path.stop()

    def write_together(self) -> None:
        some = tuple(self.random.choices(self.histories, k=self.random.randrange(4)))
        rows = tuple(self.array(history.width, 0.95) for history in some)
        self.kernel.insert_together(
            self.pick(some, list(some), (1,)), self.stamp(), self.pick(rows, rows[:1])
        )

    def step(self, tracks: int) -> tuple[Any, ...]:
        kind = self.random.randrange(5)
        numbers: list[Any] = list(self.numbers.normal(size=STEP_NUMBERS[kind]))
        if self.random.random() < 0.1:
            numbers[0] = self.pick(*FLOATS, *ODD)
        use = self.random.randrange(max(tracks, 1))
        return (kind, use, self.random.randrange(8), self.random.random() < 0.5, tuple(numbers))

    def make_path(self) -> None:
        some = tuple(self.random.choices(self.histories, k=self.random.randrange(4)))
        steps = [self.step(len(some)) for _ in range(self.random.randrange(5))]
        if self.random.random() < 0.5 and steps:
            bad = list(steps[-1])
            bad[self.random.randrange(5)] = self.pick(-1, 5, 2**31, 2**62, 2**70, (1.0,) * 7, *ODD)
            steps[-1] = tuple(bad)
        chains = tuple(steps[:2]), tuple(steps[2:])
        of = self.pick(self.transform, self.transform, self.transform, self.kernel.TransformFields, int, *ODD)
        self.paths.append(self.kernel.Path(of, *self.pick(("a", "b"), ODD[:2]), *chains, some))

    def make_good_path(self) -> None:
        history = self.kernel.History(7, 2**62)
        first = self.pick(0, -(2**63), 2**63 - 2000)
        for number in range(self.random.randrange(40)):
            history.insert(first + number * self.pick(1, 2, 30), self.numbers.normal(size=7))
        self.histories.append(history)
        uses = range(self.pick(1, 2, 20))
        steps = tuple((4, use, 0, False, (0.0,) * 6 + (1.0,)) for use in uses)
        self.paths.append(
            self.kernel.Path(self.transform, "a", "b", steps, steps[:1], (history,) * len(uses))
        )
        del self.paths[: max(0, len(self.paths) - 8)]

    def lookup(self) -> None:
        for path in self.paths[-3:]:
            answer = path.at(*self.pick((), (self.stamp(),), (1, 2)))
            if answer is not None:
                repr((answer._pose, answer.stamp, answer.kind, answer.target, answer.predicted_s))
            path.failure_at(self.stamp())
            found = path.at_with_windows(self.pick(None, None, self.stamp()))
            if found is not None:
                self.write()  # the blocks stay as they were read
                for block, first, end in found[1]:
                    stamps = np.frombuffer(block, np.int64, block.capacity)[first:end]
                    assert first < end and (np.diff(stamps) > 0).all()
            other = self.pick(self.paths[0], self.paths[0], *ODD)
            both = path.at_both(*self.pick((self.stamp(), other, self.stamp()), (None, other, None), ()))
            assert both is None or len(both) == 2

    def take_newer(self) -> None:
        for path in self.paths[-3:]:
            newer = self.kernel.NewerTransforms(
                *self.mostly((path, self.mostly(3, 2**63), self.stamp()), (path,))
            )
            self.write()
            is_met, transform = newer.is_met(), newer.take(self.mostly(3, 2**70))
            assert is_met or transform is None
            assert transform is None or not newer.is_met()

    def lookup_many(self) -> None:
        for path in self.paths[-3:]:
            count = self.random.randrange(40)
            stamps = self.numbers.integers(-50, 1000, count)
            stamps[: count // 3] = self.numbers.integers(-(2**63), 2**63 - 1, count // 3)
            valid = self.pick(
                np.empty(count, bool), np.empty(count, bool), bytearray(count + 1), b"x" * count
            )
            path.poses(
                self.pick(stamps, stamps, stamps[::2], self.array(count)), self.array(7 * count), valid
            )

    def place(self) -> None:
        for path in self.paths[-3:]:
            count = self.pick(0, 1, 7, 40, 300)
            stamps = self.pick(
                np.sort(self.numbers.integers(-50, 1000, count)),
                self.numbers.integers(-(2**63), 2**63 - 1, count),
                np.full(count, 7),
                np.arange(1),
                self.array(count),
            )
            dtype = self.pick("f4", "f8", "f8")
            wide = self.numbers.normal(size=(count, 7)).astype(dtype)
            points = self.pick(wide[:, :3], wide[:, ::-2][:, :3], wide[::-1, 1:4], self.array(3 * count))
            packed = np.frombuffer(bytes(13 * count + 12), "u1")[1:]
            if self.random.random() < 0.2:
                points = np.ndarray((count, 3), "f4", packed.data, 0, (13, 4))
            out = self.pick(np.empty((count, 3), dtype), np.empty((count, 3), dtype), self.array(3 * count))
            valid = self.pick(
                np.empty(count, bool), np.empty(count, bool), bytearray(count + 1), b"x" * count
            )
            path.place(*self.pick((points, stamps, out, valid), (points, stamps, out, valid), ODD[:4], ()))

    def edges(self) -> None:
        width = self.pick(8, 14, 0, -1, *ODD)
        steps = tuple(self.step(1) for _ in range(self.random.randrange(6)))
        edges = self.kernel.Edges(width, steps)
        rows = self.random.randrange(4)
        edges.poses(self.array(rows * width), self.array(rows * 7 * len(steps)))

    def make_encoder(self) -> None:
        counts = (self.pick(0, 1, 7, 40, 9000, -1, 2**62, *ODD), self.pick(0, 1, 6, 40, -1, 2**20 + 1, *ODD))
        quaternions = self.pick((), (), (0,), (3,), (36, 0), (-1,), (2**62,), (2**70,), ODD, *ODD)
        order = self.pick(bytes(8), bytes(8), bytes(7), *ODD)
        session = self.pick(0, 7, 2**32, 2**64 - 1, 2**64, -1, *ODD)
        self.encoders.append(self.kernel.JointStateEncoder(session, order, *counts, quaternions))
        self.widths.append(counts)
        del self.encoders[:-4], self.widths[:-4]

    def encode(self) -> None:
        number = self.random.randrange(len(self.encoders))
        encoder, (positions, velocities) = self.encoders[number], self.widths[number]
        numbers = self.array(positions)
        if isinstance(numbers, np.ndarray) and numbers.size == 7 and numbers.dtype == np.float64:
            numbers = numbers / 1e5
            numbers.flat[6] = 1.0
        if isinstance(numbers, np.ndarray):
            items = numbers.tolist()
            numbers = self.pick(numbers, items, tuple(items), numbers[::-1], [*items, 2**1100], [None])
        rates = [self.pick(None, self.array(velocities)) for _ in range(2)]
        seq = self.pick(0, 5, 2**40, 2**63 - 1, -1, 2**63, *ODD)
        payload = encoder.encode(numbers, *rates, self.stamp(), self.pick(3, seq))
        assert payload is None or (type(payload) is bytes and payload[0] == 0x98)
        encoder.encode(*self.pick((), (numbers,), (numbers,) * 6))

    def make_ring(self) -> None:
        spans = [self.pick(0, 1, 100, 10**9, 2**63 - 1, -1, 2**63, *ODD) for _ in range(2)]
        self.rings.append(self.kernel.SampleRing(self.pick(1, 2, 63, 200, 2**62, 0, -1, *ODD), *spans))
        del self.rings[:-4]

    def cache(self) -> None:
        ring = self.random.choice(self.rings)
        for _ in range(self.random.randrange(90)):
            ring.append(self.stamp(), self.mostly(5), self.mostly(b"payload" * self.random.randrange(9)))
        samples = ring.samples()
        assert all(type(one[2]) is bytes for one in samples)

    def ros_encoder(self, positions: int, velocities: int) -> Any:
        slots = tuple(self.mostly(number % max(positions, 1), -1, positions) for number in range(velocities))
        parts = [tuple(bytes(self.random.randrange(9)) for _ in range(4)) for _ in range(4)]
        parts[0] = self.mostly(parts[0], parts[0][:3], (1, 2, 3, 4))
        given = self.mostly(tuple(parts), (), parts), self.mostly(positions, -1, 2**62), self.mostly(slots)
        return self.kernel.RosJointStateEncoder(*given, self.mostly(bytes(16), None, bytes(15)))

    def make_ros_encoder(self) -> None:
        counts = self.pick(0, 1, 7, 40), self.pick(0, 1, 6, 40)
        self.ros_encoders.append((self.ros_encoder(*counts), *counts))
        del self.ros_encoders[:-4]

    def encode_for_ros(self) -> None:
        if not self.ros_encoders:
            self.make_ros_encoder()
        encoder, positions, velocities = self.random.choice(self.ros_encoders)
        rates = [self.pick(None, self.array(velocities)) for _ in range(2)]
        payload = encoder.encode(self.array(positions), *rates, self.stamp())
        assert payload is None or type(payload) is bytes
        encoder.attachment(self.stamp())

    def make_publish_path(self) -> None:
        number = self.random.randrange(len(self.encoders))
        positions, velocities = self.widths[number]
        ring = self.mostly(self.random.choice(self.rings), None)

        def put(payload: bytes, attachment: bytes | None = None) -> Any:
            """Whatever a subscriber's callback in the same thread may do."""
            choice = self.random.random()
            if choice < 0.1:
                self.pick(path.pause, gc.collect, lambda: path.publish(*(None,) * 4))()
            elif choice < 0.2 and ring is not None:
                self.pick(ring.samples, lambda: ring.append(self.stamp(), 3, payload))()
            elif choice < 0.25:
                raise self.pick(ValueError, KeyboardInterrupt, path.resume)(7)
            return self.pick(None, object())

        bounds = [self.mostly(np.full(positions, limit)) for limit in (-1.0, 1.0)]
        encoder = self.mostly(self.encoders[number])
        ros = self.pick(None, self.ros_encoder(positions, velocities))
        arguments = (
            encoder,
            self.mostly(ros),
            ring,
            self.mostly(put),
            *bounds,
            self.mostly(len),
            self.pick(True, False),
        )
        path = self.kernel.PublishPath(*arguments)
        self.publish_paths.append((path, positions, velocities))
        del self.publish_paths[:-4]

    def publish(self) -> None:
        if not self.publish_paths:
            self.make_publish_path()
        path, positions, velocities = self.random.choice(self.publish_paths)
        path.resume(self.mostly(self.pick(0, 5, 2**31), -1, 2**63 - 1, 2**64))
        for _ in range(self.random.randrange(9)):
            rates = [self.pick(None, self.array(velocities)) for _ in range(2)]
            numbers = self.array(positions)
            if isinstance(numbers, np.ndarray) and numbers.size == 7 and numbers.dtype == np.float64:
                numbers = numbers / 1e5
                numbers.flat[6] = 1.0
            with suppress(KeyboardInterrupt):
                path.publish(numbers, *rates, self.pick(None, self.stamp()))
        self.pick(path.pause, path.stop, lambda: path.publish(1))()
        repr((path.ready, path.seq, path.samples, path.bytes))

    def placements(self) -> None:
        count, rows = self.random.randrange(1, 6), self.random.randrange(4)
        chosen = self.numbers.integers(-1 if self.random.random() < 0.1 else 0, count, rows)
        poses = self.array(7 * rows)
        if self.random.random() < 0.1:
            chosen = np.zeros(7, np.int64)  # rows in the memory that is written
            rows, poses = 1, chosen.view(np.float64)
            chosen = self.pick(chosen[:1], chosen)
        given = self.array(12 * count), self.pick(chosen, chosen, self.array(rows)), self.array(12 * rows)
        self.kernel.placement_poses(*given, poses)

    def make_facts(self) -> None:
        pose = tuple(self.numbers.normal(size=self.pick(7, 7, 6)))
        facts = self.transform.trusted(*self.pick(("a", "b", pose, 1, "exact"), ODD[:5], (), (1,) * 9))
        empty = self.transform()
        for name in ("_pose", "target", "source", "stamp", "kind", "predicted_s"):
            getattr(facts, name)
            getattr(empty, name, None)
        empty._fill(*self.pick(("a", "b", pose, 1, "exact", 0.5), ODD[:5], ()))
        empty._fill("a", "b", pose, 1, "exact")

    def keep_memory(self) -> None:
        """Memory of a history as an argument of calls to come, at times after its history is gone."""
        block, first, end = self.history().window
        rows = np.frombuffer(block, np.float64, offset=8 * block.capacity)
        float(np.nansum(rows[first * block.width : end * block.width]))
        self.kept = [*self.kept[-2:], rows[: block.width], self.pick(rows, memoryview(block))]

    def run(self, calls: int) -> Counter[str]:
        outcomes: Counter[str] = Counter()
        for _ in range(calls):
            outcomes[self.outcome()] += 1
        return outcomes

    def outcome(self) -> str:
        try:
            self.random.choice(self.calls)()
        except Exception as error:
            if isinstance(error, SystemError):  # the extension broke a rule of CPython
                raise
            return type(error).__name__
        return "fine"


def run_concurrently(kernel: Any, seconds: float) -> None:
    """Batches without the GIL while another thread writes, late samples and clears included."""
    history = kernel.History(7, 5000)
    transform = type("Transform", (kernel.TransformFields,), {"__slots__": ()})
    step = (4, 0, 0, False, (0.0,) * 6 + (1.0,))
    path = kernel.Path(transform, "a", "b", (), (step,), (history,))
    stop = threading.Event()

    def write() -> None:
        row = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
        stamp = 0
        while not stop.is_set():
            stamp += 10
            history.insert(stamp, row)
            if stamp % 70 == 0:
                history.insert(stamp - 35, row)
            if stamp % 100_000 == 0:
                history.clear()

    writer = threading.Thread(target=write)
    writer.start()
    deadline = time.monotonic() + seconds
    poses, valid = np.empty((5000, 7)), np.empty(5000, bool)
    points, placed = np.zeros((5000, 3)), np.empty((5000, 3))
    while time.monotonic() < deadline:
        block, _, end = history.window
        newest = int(np.frombuffer(block, np.int64, block.capacity)[end - 1]) if end else 0
        path.poses(newest - np.arange(5000), poses, valid)
        assert (poses[valid, :3] == (1.0, 2.0, 3.0)).all()
        path.place(points, np.arange(newest - 4999, newest + 1), placed, valid)
        assert np.abs(placed[valid] - (1.0, 2.0, 3.0)).max(initial=0.0) < 1e-12
    stop.set()
    writer.join()


def publish_concurrently(kernel: Any, seconds: float) -> None:
    """Samples of two threads, which a third one stops and resumes: each number once, in order."""
    encoder, ring = kernel.JointStateEncoder(7, bytes(8), 2, 2, ()), kernel.SampleRing(10, 2**62, 0)
    sent: list[bytes] = []

    def put(payload: bytes) -> None:
        time.sleep(0)
        sent.append(payload)

    path = kernel.PublishPath(encoder, None, ring, put, np.full(2, -9.0), np.full(2, 9.0), None, True)
    stop = threading.Event()

    def publish() -> None:
        while not stop.is_set():
            path.publish(np.zeros(2), None, None, None)

    threads = [threading.Thread(target=publish) for _ in range(2)]
    path.resume(0)
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        seq = path.stop()
        assert seq == path.samples == len(sent)
        path.resume(seq)
    stop.set()
    for thread in threads:
        thread.join()
    assert [msgspec.msgpack.decode(payload)[1] for payload in sent] == list(range(len(sent)))


def main() -> int:
    """Fuzzes for the given number of seconds; the exit code is 0 if no check failed."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    library = os.environ.get(LIBRARY)
    if library is None:
        return run_under_sanitizers(seconds)
    loader = ExtensionFileLoader("zstate._kernel", library)
    spec = importlib.util.spec_from_loader("zstate._kernel", loader)
    assert spec is not None
    kernel = importlib.util.module_from_spec(spec)
    loader.exec_module(kernel)
    outcomes: Counter[str] = Counter()
    deadline = time.monotonic() + 0.8 * seconds
    seed = 0
    while time.monotonic() < deadline:
        outcomes += Fuzz(kernel, seed).run(2000)
        seed += 1
    run_concurrently(kernel, 0.1 * seconds)
    publish_concurrently(kernel, 0.1 * seconds)
    print(f"{outcomes.total()} calls from {seed} seeds, no crash: {dict(outcomes.most_common())}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
