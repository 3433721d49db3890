"""The C extension, made of buffer/_kernel.c. ``zstate.extension.kernel`` is "c" if it is used."""

from collections.abc import Callable
from typing import Any, Self, TypeAlias

from numpy.typing import NDArray
from typing_extensions import Buffer

from zstate.transform import Kind, MaybeNone, Transform

REVISION: int

StepTuple: TypeAlias = tuple[int, int, int, bool, tuple[float, ...]]
FailureTuple: TypeAlias = tuple[int, int, int | None, int | None, int | None, float | None]

class TransformFields:
    """The data of a Transform, set once."""

    target: str
    source: str
    stamp: int | MaybeNone
    kind: Kind
    predicted_s: float
    _pose: tuple[float, ...]

    def _fill(
        self,
        target: str,
        source: str,
        pose: tuple[float, ...],
        stamp: int | None,
        kind: Kind,
        predicted_s: float = 0.0,
    ) -> None: ...
    @classmethod
    def trusted(
        cls,
        target: str,
        source: str,
        pose: tuple[float, ...],
        stamp: int | None,
        kind: Kind,
        predicted_s: float = 0.0,
    ) -> Self:
        """From seven floats without a check: for the buffer, which checked them at insert."""

def placement_poses(
    placements: NDArray[Any], rows: NDArray[Any], parents: NDArray[Any], poses: NDArray[Any], /
) -> None: ...

class Block(Buffer):
    @property
    def capacity(self) -> int: ...
    @property
    def width(self) -> int: ...

Window: TypeAlias = tuple[Block, int, int]
"""Samples ``first`` up to, not including, ``end`` of a block."""
Windows: TypeAlias = tuple[Window, ...]

class History:
    def __init__(self, width: int, span_ns: int) -> None: ...
    @property
    def width(self) -> int: ...
    @property
    def span_ns(self) -> int: ...
    @property
    def window(self) -> Window: ...
    @property
    def newest(self) -> int | None: ...
    @property
    def oldest(self) -> int | None: ...
    def insert(self, stamp: int, row: NDArray[Any], /) -> bool: ...
    def try_insert(
        self, stamp: object, positions: object, velocities: object, position_count: int, /
    ) -> bool | None: ...
    def replace(self, stamps: NDArray[Any], rows: NDArray[Any], /) -> None: ...
    def reaches(self, stamp: int, /) -> bool: ...
    def clear(self) -> None: ...
    def close(self) -> None: ...

class FastPath:
    def __init__(
        self, waiters: dict[Any, Any], counts: dict[str, int], sources: tuple[object, ...]
    ) -> None: ...
    def expect(
        self,
        message: bytes,
        track: object,
        history: History,
        position_count: int,
        versions: tuple[int, ...],
        /,
    ) -> bool: ...
    def insert(self, message: object, earliest: int, latest: int, /) -> Any: ...
    def stop(self) -> tuple[int, int] | None: ...

class Edges:
    def __init__(self, width: int, steps: tuple[StepTuple, ...]) -> None: ...
    def poses(self, positions: NDArray[Any], out: NDArray[Any], /) -> None: ...

class JointStateEncoder:
    def __init__(
        self, session: int, order: bytes, positions: int, velocities: int, quaternions: tuple[int, ...]
    ) -> None: ...
    def encode(
        self, positions: object, velocities: object, efforts: object, stamp: object, seq: int, /
    ) -> bytes | None: ...

class RosJointStateEncoder:
    def __init__(
        self,
        parts: tuple[tuple[bytes, bytes, bytes, bytes], ...],
        positions: int,
        slots: tuple[int, ...],
        gid: bytes | None,
    ) -> None: ...
    def encode(
        self, positions: object, velocities: object, efforts: object, stamp: object, /
    ) -> bytes | None: ...
    def attachment(self, now: int, /) -> bytes | None: ...

class SampleRing:
    def __init__(self, capacity: int, span_ns: int, set_back_ns: int) -> None: ...
    def append(self, stamp: int, seq: int, payload: bytes, /) -> None: ...
    def samples(self) -> list[tuple[int, int, bytes]]: ...

class PublishPath:
    def __init__(
        self,
        encoder: JointStateEncoder,
        ros: RosJointStateEncoder | None,
        ring: SampleRing | None,
        put: Callable[..., object],
        lower: NDArray[Any],
        upper: NDArray[Any],
        on_outside: Callable[[bytes], object] | None,
        reads_clock: bool,
    ) -> None: ...
    @property
    def ready(self) -> bool: ...
    @property
    def seq(self) -> int: ...
    @property
    def samples(self) -> int: ...
    @property
    def bytes(self) -> int: ...
    def publish(self, positions: object, velocities: object, efforts: object, stamp: object, /) -> bool: ...
    def resume(self, seq: int, /) -> None: ...
    def pause(self) -> None: ...
    def stop(self) -> int: ...

class Path:
    def __init__(
        self,
        type: type[Transform],
        target: str,
        source: str,
        to_target: tuple[StepTuple, ...],
        to_source: tuple[StepTuple, ...],
        histories: tuple[object, ...],
    ) -> None: ...
    def at(self, stamp: object = None, /) -> Transform | None: ...
    def failure_at(self, stamp: object, /) -> FailureTuple | None: ...
    def at_with_windows(self, stamp: object, /) -> tuple[Transform, Windows] | None: ...
    def at_both(
        self, stamp: object, other: Path, other_stamp: object, /
    ) -> tuple[Transform, Transform] | None: ...
    def poses(self, stamps: NDArray[Any], out: NDArray[Any], valid: NDArray[Any], /) -> Windows: ...
    def place(
        self, points: NDArray[Any], stamps: NDArray[Any], out: NDArray[Any], valid: NDArray[Any], /
    ) -> Windows: ...

class NewerTransforms:
    def __init__(self, path: Path, version: int, stamp: int) -> None: ...
    def is_met(self) -> bool: ...
    def take(self, version: int, /) -> Transform | None: ...
