"""The data of a Transform where the C extension is not built."""

from __future__ import annotations

from typing import Any, Self


class TransformFields:
    """The data of a Transform, set once; the C extension makes one in a tenth of the time."""

    __slots__ = ("_pose", "kind", "predicted_s", "source", "stamp", "target")

    def _fill(  # noqa: PLR0917 - one call for all fields, on the hot path
        self,
        target: str,
        source: str,
        pose: tuple[float, ...],
        stamp: int | None,
        kind: str,
        predicted_s: float = 0.0,
    ) -> None:
        values = (pose, kind, predicted_s, source, stamp, target)
        for name, value in zip(TransformFields.__slots__, values, strict=True):
            object.__setattr__(self, name, value)

    @classmethod
    def trusted(cls, *values: Any) -> Self:
        """From the values of ``_fill`` without a check: for the buffer, which checked them at insert."""
        fields = cls.__new__(cls)
        fields._fill(*values)
        return fields
