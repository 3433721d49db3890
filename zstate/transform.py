"""Transform: a pose with the names of its two frames; Twist: the velocity of a frame.

The one convention is ``p_a = a_from_b @ p_b``. A ``Transform(target="a", source="b", ...)``
is ``a_from_b``: the pose of frame b in frame a, which also maps coordinates in b into a.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast, overload

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from zstate import se3
from zstate.checks import QUATERNION_TOLERANCE, check_names, real_numbers
from zstate.clock import Clock, check_stamp, format_stamp
from zstate.errors import FrameMismatch, InvalidInput, LibraryMissing, format_duration
from zstate.extension import kernel

Array: TypeAlias = NDArray[np.float64]
Kind: TypeAlias = Literal["static", "exact", "interpolated", "predicted"]
MaybeNone: TypeAlias = Any
"""None if nothing between the frames moves, which no type checker can know of two names.

``int | MaybeNone`` is an int to them that may be compared with None: users of moving frames narrow nothing.
The term is that of typeshed, where ``re.Match.group`` returns ``str | MaybeNone``.
"""

# By decreasing certainty: the kind of a product is the later one of its factors.
KINDS: tuple[Kind, ...] = ("static", "exact", "interpolated", "predicted")


def combine_kinds(*kinds: Kind) -> Kind:
    """The kind of a product of transforms of these kinds."""
    return KINDS[max(map(KINDS.index, kinds))]


def check_pose(numbers: ArrayLike, what: str = "a pose") -> tuple[float, ...]:
    """x y z qx qy qz qw as seven finite floats with a quaternion of length one.

    Lengths within 1e-3 of one are normalised. Raises InvalidInput for others.
    """
    array = real_numbers(numbers, what)
    if array.shape != (7,):
        raise InvalidInput(f"{what} takes 7 numbers x y z qx qy qz qw; got shape {array.shape}")
    values = array.tolist()
    if not all(map(math.isfinite, values)):
        raise InvalidInput(f"{what} must be finite; got {values}")
    norm = math.sqrt(sum(value * value for value in values[3:]))
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise InvalidInput(
            f"the quaternion of {what} has length {norm:.6g}, which is more than {QUATERNION_TOLERANCE:g} "
            f"from 1: {values[3:]} (order x y z w)"
        )
    return (*values[:3], *(value / norm for value in values[3:]))


if TYPE_CHECKING or kernel == "c":
    from zstate._kernel import TransformFields
else:
    from zstate._util.reference_fields import TransformFields


COVARIANCE_NUMBERS = 21
"""The upper triangle of a covariance of a pose, row by row."""

UPPER_TRIANGLE = np.triu_indices(6)
"""The places of these numbers."""


class Transform(TransformFields):
    """The pose of frame ``source`` in frame ``target``, at one instant or for ever.

    ``translation`` is x y z [m] in target axes, ``rotation`` the unit quaternion x y z w, ``stamp``
    nanoseconds since the Unix epoch, or None if it holds at any time; to type checkers it is an int.
    ``kind`` is "static", "exact", "interpolated" or "predicted", the last ``predicted_s`` seconds beyond the
    newest sample. Immutable, and so are its arrays. Raises InvalidInput if the numbers are not a pose or a
    name is not a frame name.

    ``transform @ points`` is ``apply``: ``p_a = a_from_b @ p_b``. ``np.asarray(transform)`` is ``matrix``.

    Two transforms are equal if frames, stamp and all seven numbers are, where q and -q are the same rotation;
    ``kind`` and ``covariance`` are not compared. Equal transforms have one hash. Copies and pickles are equal
    and keep ``kind`` and ``covariance``.
    """

    __slots__ = ()
    # Prevents numpy from computing ``transform @ array`` as a matrix product.
    __array_ufunc__ = None

    def __init__(
        self,
        target: str,
        source: str,
        translation: ArrayLike,
        rotation: ArrayLike,
        stamp: int | None = None,
        *,
        kind: Kind | None = None,
    ) -> None:
        check_names(target, source)
        position = real_numbers(translation, "a translation")
        quaternion = real_numbers(rotation, "a rotation")
        if position.shape != (3,) or quaternion.shape != (4,):
            raise InvalidInput(
                f"a transform takes a translation x y z and a rotation x y z w; got shapes "
                f"{position.shape} and {quaternion.shape}"
            )
        pose = check_pose(np.concatenate((position, quaternion)), f"{target!r} from {source!r}")
        stamp = None if stamp is None else check_stamp(stamp)
        if kind is not None and kind not in KINDS:
            raise InvalidInput(f"a transform's kind is one of {', '.join(KINDS)}; got {kind!r}")
        self._fill(target, source, pose, stamp, kind or ("static" if stamp is None else "exact"))

    @classmethod
    def from_pose7(cls, target: str, source: str, pose7: ArrayLike, stamp: int | None = None) -> Transform:
        """The pose of ``source`` in ``target`` at ``stamp``, from ``pose7``: x y z [m], qx qy qz qw."""
        check_names(target, source)
        pose = check_pose(pose7, f"{target!r} from {source!r}")
        stamp = None if stamp is None else check_stamp(stamp)
        return cls.trusted(target, source, pose, stamp, "static" if stamp is None else "exact")

    @classmethod
    def from_matrix(cls, target: str, source: str, matrix: ArrayLike, stamp: int | None = None) -> Transform:
        """The pose of ``source`` in ``target`` at ``stamp``, from a homogeneous ``matrix``, (4, 4).

        Raises InvalidInput if its rotation is off orthonormal by more than 1e-3.
        """
        array = real_numbers(matrix, "a transform's matrix")
        if array.shape != (4, 4):
            raise InvalidInput(f"a transform's matrix has shape (4, 4); got {array.shape}")
        if not np.isfinite(array).all():
            raise InvalidInput(f"a transform's matrix must be finite; got {array.tolist()}")
        rotation = array[:3, :3]
        error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        if error > QUATERNION_TOLERANCE or np.linalg.det(rotation) < 0.0:
            raise InvalidInput(
                f"the rotation of {target!r} from {source!r} is not a rotation: it is off orthonormal by "
                f"{error:.3g}, its determinant is {np.linalg.det(rotation):.6g}"
            )
        if np.abs(array[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
            raise InvalidInput(f"the last row of a transform's matrix is 0 0 0 1; got {array[3].tolist()}")
        return cls(target, source, array[:3, 3], se3.quaternion_from_matrix(rotation), stamp)

    @classmethod
    def from_se3(cls, target: str, source: str, placement: Any, stamp: int | None = None) -> Transform:
        """From a ``pinocchio.SE3``, the ``placement`` of ``source`` in ``target``, at ``stamp``.

        ``oMi`` is ``from_se3("o", "i", oMi)``. Raises InvalidInput for other types, and if its rotation is
        off orthonormal by more than 1e-3.
        """
        matrix = getattr(placement, "homogeneous", None)
        if matrix is None:
            raise InvalidInput(
                f"from_se3 takes a pinocchio.SE3; got {type(placement).__name__}: from_matrix takes arrays"
            )
        return cls.from_matrix(target, source, matrix, stamp)

    @classmethod
    def from_rpy(
        cls, target: str, source: str, translation: ArrayLike, rpy: ArrayLike, stamp: int | None = None
    ) -> Transform:
        """The pose of ``source`` in ``target`` at ``stamp``, from a ``translation`` x y z [m] and ``rpy``.

        These are roll pitch yaw [rad] as in URDF: about the fixed x, then y, then z.
        Raises InvalidInput for an angle beyond 2 pi, which is degrees more often than a full turn.
        """
        angles = real_numbers(rpy, "rpy")
        if angles.shape != (3,) or not np.isfinite(angles).all():
            raise InvalidInput(f"rpy is three finite angles [rad]; got {angles!r}")
        if np.abs(angles).max() > math.tau:
            degrees = ", ".join(f"{angle:g}" for angle in angles.tolist())
            radians = ", ".join(f"{angle:.6g}" for angle in np.radians(angles).tolist())
            raise InvalidInput(
                f"rpy is three angles in radians, none beyond 2 pi; got {degrees}. If these are degrees, "
                f"they are {radians} rad"
            )
        return cls(target, source, translation, se3.quaternion_from_rpy(*angles.tolist()), stamp)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a Transform is immutable; make a new one to change {name!r}")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"a Transform is immutable; {name!r} cannot be deleted")

    @property
    def translation(self) -> Array:
        """x y z [m] of the source's origin, in target axes: (3,)."""
        return _frozen(self._pose[:3])

    @property
    def rotation(self) -> Array:
        """The unit quaternion x y z w: (4,)."""
        return _frozen(self._pose[3:])

    @property
    def pose7(self) -> Array:
        """x y z qx qy qz qw: (7,)."""
        return _frozen(self._pose)

    @property
    def covariance(self) -> Array | None:
        """The covariance of the pose: (6, 6), or None if it is not known.

        In the order x y z [m], rotation about the fixed axes x y z of ``target`` [rad], as in ROS
        (geometry_msgs/PoseWithCovariance). A lookup has one if samples of the path have it, an inverse if its
        transform has, and a product if one factor has and the other has, too, or is of kind "static", which
        is exact. The factors' errors are taken as independent, and the result is of first order in them
        (``zstate.covariance``): right for rotations uncertain by a few tenths of a radian at most.
        """
        return None

    def with_covariance(self, covariance: ArrayLike) -> Transform:
        """The same transform with a covariance, (6, 6). Raises InvalidInput unless it can be one."""
        from zstate.covariance import check_covariance  # noqa: PLC0415 - of transforms that have one

        return PoseWithCovariance.of_pose(self, check_covariance(covariance))

    @property
    def matrix(self) -> Array:
        """The homogeneous matrix: (4, 4)."""
        matrix = se3.to_matrix(self._pose)
        matrix.flags.writeable = False
        return matrix

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """``matrix`` for NumPy; a list of N transforms is (N, 4, 4). Read-only unless requested as a copy."""
        if copy is False:
            raise InvalidInput("the matrix of a Transform is computed, so there is no array without a copy")
        matrix = np.array(self.matrix, dtype=dtype)
        matrix.flags.writeable = copy is True
        return matrix

    @property
    def se3(self) -> Any:
        """The pose as a ``pinocchio.SE3``. Raises LibraryMissing if Pinocchio cannot be loaded."""
        try:
            import pinocchio  # noqa: PLC0415  # pyright: ignore[reportMissingTypeStubs] - on request
        except ImportError as error:
            command = "pip install pin"
            text = f"Pinocchio cannot be loaded: {error}; `{command}` installs it"
            raise LibraryMissing(text, command=command) from error
        solver: Any = pinocchio
        return solver.SE3(self.matrix)

    @property
    def rpy(self) -> Array:
        """Roll pitch yaw [rad] as in URDF: (3,)."""
        return _frozen(se3.rpy_from_quaternion(self._pose[3:]))  # type: ignore[arg-type]

    def inverse(self) -> Transform:
        """source_from_target at the same instant."""
        pose = se3.invert(self._pose)  # type: ignore[arg-type]
        if not all(map(math.isfinite, pose)):
            raise InvalidInput(f"the inverse of {self!r} is not finite: its numbers are too large")
        inverse = Transform.trusted(self.source, self.target, pose, self.stamp, self.kind, self.predicted_s)
        covariance = self.covariance
        if covariance is None:
            return inverse
        from zstate.covariance import carry_covariance  # noqa: PLC0415 - as above

        carried = carry_covariance(covariance, pose[3:], pose[:3])
        return PoseWithCovariance.of_pose(inverse, carried[UPPER_TRIANGLE].tolist())

    @overload  # a Transform is ArrayLike, too; its product is not that of its matrix
    def __matmul__(self, other: Transform) -> Transform: ...  # pyright: ignore[reportOverlappingOverload]
    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...
    def __matmul__(self, other: Transform | ArrayLike) -> Transform | Array:
        """``a_from_b @ b_from_c`` is a_from_c, and ``a_from_b @ p_b`` is p_a: points (3,) or (..., 3).

        Raises FrameMismatch if the inner frames differ. The stamp is the common or the only one; None
        for two different stamps.
        """
        if not isinstance(other, Transform):
            return self._apply_to_points(other)
        if self.source != other.target:
            raise FrameMismatch(
                f"{self.target!r} from {self.source!r} @ {other.target!r} from {other.source!r}: the inner "
                f"frames differ; invert one, or look up {self.source!r} from {other.target!r} between them"
            )
        pose = se3.compose(self._pose, other._pose)  # type: ignore[arg-type]
        if not all(map(math.isfinite, pose)):
            raise InvalidInput(f"the product of {self!r} and {other!r} is not finite: numbers are too large")
        stamps = {stamp for stamp in (self.stamp, other.stamp) if stamp is not None}
        product = Transform.trusted(
            self.target,
            other.source,
            se3.normalize(pose, se3.SCALARS),
            stamps.pop() if len(stamps) == 1 else None,
            combine_kinds(self.kind, other.kind),
            max(self.predicted_s, other.predicted_s),
        )
        first, second = self.covariance, other.covariance
        is_unknown = (first is None and self.kind != "static") or (second is None and other.kind != "static")
        if is_unknown or (first is None and second is None):
            return product
        from zstate.covariance import product_covariance  # noqa: PLC0415 - as above

        rotation: se3.Quaternion = self._pose[3:]  # type: ignore[assignment]
        arm = se3.rotate(rotation, other._pose[:3])  # type: ignore[arg-type]
        covariance = product_covariance(first, second, rotation, arm)
        return PoseWithCovariance.of_pose(product, covariance[UPPER_TRIANGLE].tolist())

    def _apply_to_points(self, points: object) -> Array:
        if not (isinstance(points, (list, tuple)) or hasattr(points, "__array__")):
            return NotImplemented
        array = real_numbers(cast("ArrayLike", points), "points")
        if array.ndim == 0 or array.shape[-1] != 3:
            # Four columns could be homogeneous points or a matrix.
            raise InvalidInput(
                f"transform @ points takes points of shape (3,) or (N, 3); got shape {array.shape}. For "
                "homogeneous points use transform.apply(points), for a matrix transform.matrix @ matrix"
            )
        return self.apply(array)

    def apply(self, points: ArrayLike) -> Array:
        """Points given in ``source``, in ``target``: (3,), (..., 3), or homogeneous (4,), (..., 4)."""
        if _has_transforms(points):  # whose matrices have four columns
            raise InvalidInput("a transform is no point: a_from_b @ b_from_c is the product of transforms")
        array = real_numbers(points, "points")
        if array.ndim == 0 or array.shape[-1] not in (3, 4):
            raise InvalidInput(f"points have 3 or 4 (homogeneous) columns; got shape {array.shape}")
        matrix = self.matrix
        if array.shape[-1] == 4:
            return array @ matrix.T
        return array @ matrix[:3, :3].T + matrix[:3, 3]

    def age(self, clock: Clock) -> float:
        """Seconds since this transform's instant by ``clock``; 0 for a static one."""
        return 0.0 if self.stamp is None else (clock.now() - self.stamp) * 1e-9

    def to_dict(self) -> dict[str, Any]:
        """Plain names, lists and numbers, ready for JSON; ``from_dict`` reads them back.

        The covariance is there if it is known.
        """
        covariance = self.covariance
        known: dict[str, Any] = {} if covariance is None else {"covariance": covariance.tolist()}
        return {
            "target": self.target,
            "source": self.source,
            "stamp": self.stamp,
            "kind": self.kind,
            "translation": list(self._pose[:3]),
            "rotation": list(self._pose[3:]),
            **known,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Transform:
        """From the result of ``to_dict``, with the checks of the constructor."""
        names = ("target", "source", "translation", "rotation", "stamp")
        missing = [name for name in names if name not in values]
        if missing:
            raise InvalidInput(f"a transform needs {', '.join(missing)}; got {sorted(values)}")
        transform = cls(*(values[name] for name in names), kind=values.get("kind"))
        covariance = values.get("covariance")
        return transform if covariance is None else transform.with_covariance(covariance)

    def __reduce__(self) -> tuple[Any, ...]:
        fields = (self.target, self.source, self._pose, self.stamp, self.kind, self.predicted_s)
        return (Transform.trusted, fields)

    def __eq__(self, other: object) -> bool:
        """The same frames, instant and motion; q and -q are the same rotation."""
        if not isinstance(other, Transform):
            return NotImplemented
        mine, theirs = self._pose, other._pose
        opposite = tuple(-value for value in theirs[3:])
        names = (self.target, self.source, self.stamp) == (other.target, other.source, other.stamp)
        return names and mine[:3] == theirs[:3] and mine[3:] in (theirs[3:], opposite)

    def __hash__(self) -> int:
        return hash((self.target, self.source, self.stamp, self._pose[:3]))

    def __repr__(self) -> str:
        when = "at any time" if self.stamp is None else f"at {format_stamp(self.stamp)}"
        # Adding zero turns -0 into 0.
        x, y, z, *rest = (round(value, 4) + 0.0 for value in self._pose)
        quaternion = ", ".join(f"{value:.4f}" for value in rest)
        how = f"predicted {format_duration(round(self.predicted_s * 1e9))} ahead" * (self.kind == "predicted")
        return (
            f"<pose of {self.source} in {self.target} {when}: xyz [{x:.4f}, {y:.4f}, {z:.4f}] m, "
            f"quaternion xyzw [{quaternion}], {how or self.kind}>"
        )

    def _repr_html_(self) -> str:
        from zstate._util.html import html_table  # noqa: PLC0415 - for notebooks alone

        rows = [
            ("translation xyz [m]", _vector_text(self.translation)),
            ("rotation xyzw", _vector_text(self.rotation)),
            ("roll pitch yaw [deg]", _vector_text(np.degrees(self.rpy))),
            ("stamp [ns]", "at any time" if self.stamp is None else str(self.stamp)),
            ("kind", self.kind),
        ]
        if self.covariance is not None:
            deviations = np.sqrt(self.covariance.diagonal())
            rows.append(("standard deviations [m, rad]", _vector_text(deviations)))
        return html_table(f"pose of {self.source} in {self.target}", rows)


Triangle: TypeAlias = Sequence[float]
"""The upper triangle of a covariance: 21 numbers, row by row."""


class PoseWithCovariance(Transform):
    """A Transform whose covariance is known. Made by ``Transform.with_covariance`` and by lookups."""

    __slots__ = ("_triangle",)

    _triangle: Triangle | Callable[[], Triangle]

    @classmethod
    def of_pose(cls, transform: Transform, triangle: Triangle | Callable[[], Triangle]) -> PoseWithCovariance:
        """``transform`` with this covariance, or that which ``triangle()`` returns when it is first used."""
        pose = cls.trusted(*Transform.__reduce__(transform)[1])
        object.__setattr__(pose, "_triangle", triangle if callable(triangle) else tuple(triangle))
        return pose

    def _known_triangle(self) -> Triangle:
        if callable(self._triangle):
            object.__setattr__(self, "_triangle", tuple(self._triangle()))
        return self._triangle  # type: ignore[return-value]

    @property
    def covariance(self) -> Array:
        """As ``Transform.covariance``."""
        matrix = np.empty((6, 6))
        matrix[UPPER_TRIANGLE] = matrix.T[UPPER_TRIANGLE] = self._known_triangle()
        matrix.flags.writeable = False
        return matrix

    def __reduce__(self) -> tuple[Any, ...]:
        pose = Transform.trusted(*super().__reduce__()[1])
        return (PoseWithCovariance.of_pose, (pose, self._known_triangle()))


def _frozen(numbers: ArrayLike) -> Array:
    """A read-only copy, because writing to it would not change the transform."""
    array = np.array(numbers, dtype=np.float64)
    array.flags.writeable = False
    return array


class Twist:
    """The velocity of ``frame`` in ``reference``: d/dt of ``reference_from_frame``.

    ``linear`` [m/s] is the velocity of the frame's origin, ``angular`` [rad/s] that of its axes;
    both are vectors in the axes of ``reference``. ``stamp`` is None if nothing can move.
    """

    __slots__ = ("angular", "frame", "linear", "reference", "stamp")

    stamp: int | MaybeNone

    def __init__(
        self, frame: str, reference: str, linear: ArrayLike, angular: ArrayLike, stamp: int | None
    ) -> None:
        self.frame = frame
        self.reference = reference
        self.linear = _frozen(linear)
        self.angular = _frozen(angular)
        self.stamp = stamp

    def __reduce__(self) -> tuple[Any, ...]:
        return (Twist, (self.frame, self.reference, self.linear, self.angular, self.stamp))

    @property
    def expressed_in(self) -> str:
        """The frame in whose axes both vectors are given."""
        return self.reference

    @property
    def about(self) -> str:
        """The frame at whose origin ``linear`` is measured."""
        return self.frame

    def __repr__(self) -> str:
        when = "" if self.stamp is None else f" at {format_stamp(self.stamp)}"
        return (
            f"<twist of {self.frame} in {self.reference}{when}: linear {_vector_text(self.linear)} m/s, "
            f"angular {_vector_text(self.angular)} rad/s>"
        )


def _has_transforms(points: object) -> bool:
    elements = cast("Sequence[object]", points) if isinstance(points, (list, tuple)) else (points,)
    return any(isinstance(one, Transform) for one in elements)


def _vector_text(vector: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{round(value, 4) + 0.0:.4f}" for value in vector.tolist()) + "]"
