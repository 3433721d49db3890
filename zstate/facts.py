"""Facts: what a Transform holds, in Python or in the C extension, which makes one in a tenth of the time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias, TypeVar

from zstate.extension import kernel

Kind: TypeAlias = Literal["static", "exact", "interpolated", "predicted"]
F = TypeVar("F", bound="Facts")

if TYPE_CHECKING or kernel == "reference":

    class Facts:
        """What is known of a pose. Filled once, when it is made."""

        __slots__ = ("_pose", "kind", "predicted_s", "source", "stamp", "target")

        target: str
        source: str
        stamp: int | None
        kind: Kind
        predicted_s: float
        _pose: tuple[float, ...]

        def _fill(  # noqa: PLR0917 - one call for each fact, on the hot path
            self,
            target: str,
            source: str,
            pose: tuple[float, ...],
            stamp: int | None,
            kind: Kind,
            predicted_s: float = 0.0,
        ) -> None:
            values = zip(Facts.__slots__, (pose, kind, predicted_s, source, stamp, target), strict=True)
            for name, value in values:
                object.__setattr__(self, name, value)

        @classmethod
        def trusted(  # noqa: PLR0917 - the buffer's hot path
            cls: type[F],
            target: str,
            source: str,
            pose: tuple[float, ...],
            stamp: int | None,
            kind: Kind,
            predicted_s: float = 0.0,
        ) -> F:
            """From seven floats that are known to be a pose: for the buffer, which checked at insert."""
            facts = cls.__new__(cls)
            facts._fill(target, source, pose, stamp, kind, predicted_s)
            return facts

else:
    from zstate._kernel import Facts

__all__ = ["Facts", "Kind"]
