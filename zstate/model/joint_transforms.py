"""What each joint does to its link, as a formula of the joint's numbers.

The pose of a link in its parent needs no tree and no solver: with ``x = scale * position + shift``,

- a hinge turns by ``x`` about a fixed axis: ``q = q_cos cos(x/2) + q_sin sin(x/2)``, where ``q_cos`` is
  the origin's rotation and ``q_sin`` is that times the half turn about the axis;
- a slide moves by ``x`` along a fixed axis: ``t = t0 + t1 x``;
- a planar joint moves by x, y in the plane of its frame and then turns by yaw about its z;
- a floating joint is its origin times the given pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from zstate.errors import InvalidInput
from zstate.extension import kernel
from zstate.model.robot import NORM_TOLERANCE, Joint, JointType, RobotModel
from zstate.se3 import multiply, rotate, to_matrix

if TYPE_CHECKING or kernel == "c":
    from zstate import _kernel

EdgeKind = Literal["fixed", "revolute", "prismatic", "planar", "floating"]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Floats = NDArray[np.float64]

_KINDS: dict[JointType, EdgeKind] = {
    "fixed": "fixed",
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "planar": "planar",
    "floating": "floating",
}

_UNIT_QUATERNIONS = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class JointTransform:
    """``parent_from_child`` as a function of the position vector.

    ``column`` and ``velocity_column`` say where the numbers of the joint (of its master, for a mimic)
    begin in the vectors of positions and velocities; -1 for a fixed edge. ``scale`` and ``shift`` are
    1 and 0 except for mimics. ``q_cos``, ``q_sin``, ``t0`` and ``t1`` are those of the module's formulas
    (quaternions x y z w; a planar joint's turn by yaw); ``origin`` is ``parent_from_joint`` as pose7
    with a unit quaternion and ``axis`` the unit axis in the joint's frame, z for planar joints.
    """

    parent: str
    child: str
    kind: EdgeKind
    column: int
    velocity_column: int
    scale: float
    shift: float
    q_cos: Quaternion
    q_sin: Quaternion
    t0: Vector
    t1: Vector
    origin: tuple[float, float, float, float, float, float, float]
    axis: Vector


def edge_forms(model: RobotModel) -> tuple[JointTransform, ...]:
    """The formula of every edge, fixed ones included, in the order of ``model.joints``."""
    return tuple(_form(model, joint) for joint in model.joints)


class JointTransforms:
    """All edges of a robot at once: positions in, ``parent_from_child`` out.

    Immutable, so any thread may use it. Positions are trusted to be finite and of the right length.
    """

    def __init__(self, model: RobotModel) -> None:
        self.forms = edge_forms(model)
        self._rest = _rest_poses(self.forms)
        self._turns = _RevoluteBatch.poses(self.forms)
        self._slides = _PrismaticBatch.poses(self.forms)
        self._floats = _FloatingBatch.poses(self.forms)
        self._compiled = _compiled(model.position_count, self.forms) if kernel == "c" else None

    def poses(self, positions: Floats, out: Floats | None = None) -> Floats:
        """``parent_from_child`` of every edge, rows as ``forms``: x y z [m], qx qy qz qw.

        ``positions`` (..., nq) give (..., E, 7), written into ``out`` when that is given. The sign of a
        quaternion is arbitrary. Raises InvalidInput for a floating joint without a unit quaternion.
        """
        if out is None:
            out = np.empty((*positions.shape[:-1], *self._rest.shape))
        positions = self.normalised(positions)
        if self._compiled is not None and _plain(positions) and _plain(out):
            self._compiled.poses(positions, out)
            return out
        out[...] = self._rest
        if self._turns is not None:
            self._turns.write(positions, out)
        if self._slides is not None:
            self._slides.write(positions, out)
        if self._floats is not None:
            self._floats.write(positions, out)
        return out

    @property
    def has_floats(self) -> bool:
        """Whether there are floating joints, whose quaternions have to be looked at."""
        return self._floats is not None

    def normalised(self, positions: Floats) -> Floats:
        """``positions`` with the quaternions of floating joints at unit length.

        Raises InvalidInput where a length is off by more than ``NORM_TOLERANCE``.
        """
        return positions if self._floats is None else self._floats.normalised(positions)


@dataclass(frozen=True, slots=True)
class _RevoluteBatch:
    """The edges that turn about an axis: hinges, and planar joints by their yaw."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    half_scale: Floats
    half_shift: Floats
    q_cos: Floats
    q_sin: Floats

    @classmethod
    def poses(cls, forms: tuple[JointTransform, ...]) -> _RevoluteBatch | None:
        turning = [(row, form) for row, form in enumerate(forms) if form.kind in ("revolute", "planar")]
        if not turning:
            return None
        return cls(
            rows=np.array([row for row, _ in turning], dtype=np.intp),
            columns=np.array([f.column + 2 * (f.kind == "planar") for _, f in turning], dtype=np.intp),
            half_scale=np.array([0.5 * form.scale for _, form in turning]),
            half_shift=np.array([0.5 * form.shift for _, form in turning]),
            q_cos=np.array([form.q_cos for _, form in turning]),
            q_sin=np.array([form.q_sin for _, form in turning]),
        )

    def write(self, positions: Floats, out: Floats) -> None:
        half = positions.take(self.columns, axis=-1) * self.half_scale + self.half_shift
        # One complex exponential is both cosine and sine, and accurate at any number of turns.
        unit: NDArray[np.complex128] = np.exp(1j * half)
        rotation = unit.real[..., None] * self.q_cos
        rotation += unit.imag[..., None] * self.q_sin
        out[..., self.rows, 3:] = rotation


@dataclass(frozen=True, slots=True)
class _PrismaticBatch:
    """The edges whose translation moves along one axis, or along two: planar joints."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    offsets: Floats
    steps: Floats

    @classmethod
    def poses(cls, forms: tuple[JointTransform, ...]) -> _PrismaticBatch | None:
        sliding = [(row, form) for row, form in enumerate(forms) if form.kind in ("prismatic", "planar")]
        if not sliding:
            return None
        return cls(
            rows=np.array([row for row, _ in sliding], dtype=np.intp),
            columns=np.array([(form.column, form.column + (form.kind == "planar")) for _, form in sliding]),
            offsets=np.array([np.array(form.t0) + np.array(form.t1) * form.shift for _, form in sliding]),
            steps=np.array([_steps(form) for _, form in sliding]),
        )

    def write(self, positions: Floats, out: Floats) -> None:
        travelled = self.steps @ positions.take(self.columns, axis=-1)[..., None]
        out[..., self.rows, :3] = travelled[..., 0] + self.offsets


@dataclass(frozen=True, slots=True)
class _FloatingBatch:
    """The edges that are given as a pose: the origin acts on it linearly, as a 7 x 7 matrix."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    offsets: Floats
    origins: Floats
    names: tuple[str, ...]

    @classmethod
    def poses(cls, forms: tuple[JointTransform, ...]) -> _FloatingBatch | None:
        floating = [(row, form) for row, form in enumerate(forms) if form.kind == "floating"]
        if not floating:
            return None
        origins = np.zeros((len(floating), 7, 7))
        for matrix, (_, form) in zip(origins, floating, strict=True):
            matrix[:3, :3] = to_matrix(form.origin)[:3, :3]
            matrix[3:, 3:] = np.transpose([multiply(form.q_cos, unit) for unit in _UNIT_QUATERNIONS])
        return cls(
            rows=np.array([row for row, _ in floating], dtype=np.intp),
            columns=np.array([np.arange(form.column, form.column + 7) for _, form in floating]),
            offsets=np.array([(*form.t0, 0.0, 0.0, 0.0, 0.0) for _, form in floating]),
            origins=origins,
            names=tuple(f"{form.parent!r} -> {form.child!r}" for _, form in floating),
        )

    def normalised(self, positions: Floats) -> Floats:
        quaternions = positions[..., self.columns[:, 3:]]
        norms: Floats = np.sqrt(np.square(quaternions).sum(axis=-1, keepdims=True))
        if not np.all(np.abs(norms - 1.0) <= NORM_TOLERANCE):
            self._refuse(norms)
        unit = positions.copy()
        unit[..., self.columns[:, 3:]] = quaternions / norms
        return unit

    def write(self, positions: Floats, out: Floats) -> None:
        poses = self.origins @ positions.take(self.columns, axis=-1)[..., None]
        out[..., self.rows, :] = poses[..., 0] + self.offsets

    def _refuse(self, norms: Floats) -> None:
        worst = int(np.abs(norms - 1.0).argmax())
        raise InvalidInput(
            f"the floating joint of {self.names[worst % len(self.names)]} was given a quaternion of length "
            f"{norms.item(worst):.6g}; its last four numbers are qx qy qz qw of length 1"
        )


def _form(model: RobotModel, joint: Joint) -> JointTransform:
    kind = _KINDS[joint.type]
    axis = _unit3((0.0, 0.0, 1.0) if kind == "planar" else joint.axis) if kind != "fixed" else joint.axis
    rotation = _unit4(joint.origin[3:])
    still = (0.0, 0.0, 0.0)
    master = model.mimic_of(joint)
    return JointTransform(
        parent=joint.parent,
        child=joint.child,
        kind=kind,
        column=model.columns.get(master.joint, -1),
        velocity_column=model.velocity_columns.get(master.joint, -1),
        scale=master.multiplier,
        shift=master.offset,
        q_cos=rotation,
        q_sin=multiply(rotation, (*axis, 0.0)) if kind in ("revolute", "planar") else (*still, 0.0),
        t0=joint.origin[:3],
        t1=rotate(rotation, axis) if kind == "prismatic" else still,
        origin=(*joint.origin[:3], *rotation),
        axis=axis,
    )


def _plain(array: Floats) -> bool:
    return array.flags.c_contiguous and array.dtype == np.float64


def _compiled(width: int, forms: tuple[JointTransform, ...]) -> _kernel.Edges:
    """The same formulas in the C extension, which takes the kinds in the order of ``EdgeKind``."""
    kinds = get_args(EdgeKind)
    return _kernel.Edges(
        width, tuple((kinds.index(form.kind), 0, form.column, False, _numbers(form)) for form in forms)
    )


def _numbers(form: JointTransform) -> tuple[float, ...]:
    if form.kind in ("revolute", "prismatic"):
        along = form.q_sin if form.kind == "revolute" else form.t1
        return (form.scale, form.shift, *form.q_cos, *form.t0, *along)
    return form.origin


def _rest_poses(forms: tuple[JointTransform, ...]) -> Floats:
    rest = np.zeros((len(forms), 7))
    for row, form in zip(rest, forms, strict=True):
        row[:3] = form.t0
        row[3:] = form.q_cos
    return rest


def _steps(form: JointTransform) -> Floats:
    """How the translation changes per unit of the joint's two numbers; a slide has but one."""
    if form.kind == "planar":
        return to_matrix(form.origin)[:3, :2]
    return np.outer(form.t1, (form.scale, 0.0))


def _unit3(values: Vector) -> Vector:
    x, y, z = (np.array(values) / np.linalg.norm(values)).tolist()
    return (x, y, z)


def _unit4(values: Quaternion) -> Quaternion:
    x, y, z, w = (np.array(values) / np.linalg.norm(values)).tolist()
    return (x, y, z, w)
