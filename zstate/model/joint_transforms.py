"""Closed forms of ``parent_from_child`` as a function of the joint's positions.

With ``x = scale * position + shift``,

- a revolute or continuous joint turns by ``x`` about a fixed axis: ``q = q_cos cos(x/2) + q_sin sin(x/2)``,
  where ``q_cos`` is the origin's rotation and ``q_sin`` is that times the half turn about the axis;
- a prismatic joint moves by ``x`` along a fixed axis: ``t = t0 + t1 x``;
- a planar joint moves by x, y in the plane of its frame and then turns by yaw about its z;
- a floating joint is its origin times the given pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from zstate.errors import InvalidInput
from zstate.extension import kernel
from zstate.model.robot import NORM_TOLERANCE, Joint, JointType, RobotModel
from zstate.se3 import SCALARS, multiply, normalize, rotate, to_matrix

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


@dataclass(frozen=True, slots=True)
class JointTransform:
    """``parent_from_child`` as a function of the position vector.

    ``column`` and ``velocity_column`` are the indices of the joint's first number (its master's, for a
    mimic) in the vectors of positions and velocities; -1 for a fixed edge. ``scale`` and ``shift`` are
    1 and 0 except for mimics. ``q_cos``, ``q_sin``, ``t0`` and ``t1`` stand in the module's formulas
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
    """The closed form of every edge, fixed ones included, in the order of ``model.joints``."""
    return tuple(_form(model, joint) for joint in model.joints)


class JointTransforms:
    """Poses ``parent_from_child`` of all edges of a robot, from one position vector.

    Immutable, so any thread may use it. Positions must be finite and of the right length (not checked).
    """

    def __init__(self, model: RobotModel) -> None:
        self.forms = edge_forms(model)
        self._rest = np.array([(*form.t0, *form.q_cos) for form in self.forms]).reshape(-1, 7)
        self._floats = _FloatingBatch.build(self.forms)
        batches = (_RevoluteBatch.build(self.forms), _PrismaticBatch.build(self.forms), self._floats)
        self._batches = tuple(batch for batch in batches if batch is not None)
        self._compiled = _compiled(model.position_count, self.forms) if kernel == "c" else None

    def poses(self, positions: Floats, out: Floats | None = None) -> Floats:
        """``parent_from_child`` of every edge, rows as ``forms``: x y z [m], qx qy qz qw.

        ``positions`` (..., nq) give (..., E, 7), written into ``out`` if passed. The sign of a
        quaternion is arbitrary. Raises InvalidInput for a floating joint without a unit quaternion.
        """
        if out is None:
            out = np.empty((*positions.shape[:-1], *self._rest.shape))
        positions = self.normalised(positions)
        if self._compiled is not None and _plain(positions) and _plain(out):
            self._compiled.poses(positions, out)
            return out
        out[...] = self._rest
        for batch in self._batches:
            batch.write(positions, out)
        return out

    @property
    def has_floats(self) -> bool:
        """Whether there are floating joints, whose quaternions need a check."""
        return self._floats is not None

    def normalised(self, positions: Floats) -> Floats:
        """``positions`` with the quaternions of floating joints at unit length.

        Raises InvalidInput if a length is off by more than ``NORM_TOLERANCE``.
        """
        return positions if self._floats is None else self._floats.normalised(positions)


@dataclass(frozen=True, slots=True)
class _RevoluteBatch:
    """The edges that turn about an axis: revolute joints, and planar joints by their yaw."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    half_scale: Floats
    half_shift: Floats
    q_cos: Floats
    q_sin: Floats

    @classmethod
    def build(cls, forms: tuple[JointTransform, ...]) -> _RevoluteBatch | None:
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
    """The edges that move along one axis (prismatic joints) or along two (planar joints)."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    offsets: Floats
    steps: Floats

    @classmethod
    def build(cls, forms: tuple[JointTransform, ...]) -> _PrismaticBatch | None:
        sliding = [(row, form) for row, form in enumerate(forms) if form.kind in ("prismatic", "planar")]
        if not sliding:
            return None
        return cls(
            rows=np.array([row for row, _ in sliding], dtype=np.intp),
            columns=np.array([(form.column, form.column + (form.kind == "planar")) for _, form in sliding]),
            offsets=np.array([np.array(form.t0) + np.array(form.t1) * form.shift for _, form in sliding]),
            # The derivative of the translation by the joint's two numbers; a prismatic joint has one.
            steps=np.array(
                [
                    to_matrix(form.origin)[:3, :2]
                    if form.kind == "planar"
                    else np.outer(form.t1, (form.scale, 0.0))
                    for _, form in sliding
                ]
            ),
        )

    def write(self, positions: Floats, out: Floats) -> None:
        travelled = self.steps @ positions.take(self.columns, axis=-1)[..., None]
        out[..., self.rows, :3] = travelled[..., 0] + self.offsets


@dataclass(frozen=True, slots=True)
class _FloatingBatch:
    """Floating joints, whose positions are a pose: the origin acts on it linearly, as a 7 x 7 matrix."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    offsets: Floats
    origins: Floats
    names: tuple[str, ...]

    @classmethod
    def build(cls, forms: tuple[JointTransform, ...]) -> _FloatingBatch | None:
        floating = [(row, form) for row, form in enumerate(forms) if form.kind == "floating"]
        if not floating:
            return None
        origins = np.zeros((len(floating), 7, 7))
        for matrix, (_, form) in zip(origins, floating, strict=True):
            matrix[:3, :3] = to_matrix(form.origin)[:3, :3]
            matrix[3:, 3:] = np.transpose(
                [multiply(form.q_cos, (x, y, z, w)) for x, y, z, w in np.eye(4).tolist()]
            )
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
            worst = int(np.abs(norms - 1.0).argmax())
            raise InvalidInput(
                f"the floating joint of {self.names[worst % len(self.names)]} was given a quaternion of "
                f"length {norms.item(worst):.6g}; its last four numbers are qx qy qz qw of length 1"
            )
        unit = positions.copy()
        unit[..., self.columns[:, 3:]] = quaternions / norms
        return unit

    def write(self, positions: Floats, out: Floats) -> None:
        poses = self.origins @ positions.take(self.columns, axis=-1)[..., None]
        out[..., self.rows, :] = poses[..., 0] + self.offsets


def _form(model: RobotModel, joint: Joint) -> JointTransform:
    kind = _KINDS[joint.type]
    axis = joint.axis
    if kind != "fixed":
        x, y, z = (0.0, 0.0, 1.0) if kind == "planar" else joint.axis
        length = math.hypot(x, y, z)
        axis = (x / length, y / length, z / length)
    rotation = normalize(joint.origin, SCALARS)[3:]
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
    """The same formulas in the C extension, which expects the kinds in the order of ``EdgeKind``."""
    kinds = get_args(EdgeKind)
    edges: list[tuple[int, int, int, bool, tuple[float, ...]]] = []
    for form in forms:
        numbers: tuple[float, ...] = form.origin
        if form.kind in ("revolute", "prismatic"):
            along = form.q_sin if form.kind == "revolute" else form.t1
            numbers = (form.scale, form.shift, *form.q_cos, *form.t0, *along)
        edges.append((kinds.index(form.kind), 0, form.column, False, numbers))
    return _kernel.Edges(width, tuple(edges))
