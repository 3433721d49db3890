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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from zstate.checks import QUATERNION_TOLERANCE, Floats
from zstate.errors import InvalidInput
from zstate.extension import kernel
from zstate.model.robot import Joint, Pose7, RobotModel, Vector3
from zstate.se3 import SCALARS, multiply, normalize, rotate, to_matrix

if TYPE_CHECKING or kernel == "c":
    from zstate import _kernel

EdgeKind = Literal["fixed", "revolute", "prismatic", "planar", "floating"]
Quaternion = tuple[float, float, float, float]


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
    t0: Vector3
    t1: Vector3
    origin: Pose7
    axis: Vector3


_Rows: TypeAlias = Sequence[tuple[int, JointTransform]]
_Write: TypeAlias = Callable[[Floats, Floats], None]


class JointTransforms:
    """Poses ``parent_from_child`` of all edges of a robot, from one position vector.

    Immutable, so any thread may use it. Positions must be finite and of the right length (not checked).
    """

    def __init__(self, model: RobotModel) -> None:
        self.forms = edge_forms(model)
        self._rest = np.array([(*form.t0, *form.q_cos) for form in self.forms]).reshape(-1, 7)
        self._floats = [form for form in self.forms if form.kind == "floating"]
        quaternions = [range(form.column + 3, form.column + 7) for form in self._floats]
        self._quaternions = np.array(quaternions, dtype=np.intp).reshape(-1, 4)
        self._writes: list[_Write] = []
        for make, kinds in (
            (_rotations, ("revolute", "planar")),
            (_translations, ("prismatic", "planar")),
            (_floating_poses, ("floating",)),
        ):
            edges = [(row, form) for row, form in enumerate(self.forms) if form.kind in kinds]
            if edges:
                self._writes.append(make(edges))
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
        for write in self._writes:
            write(positions, out)
        return out

    @property
    def has_floats(self) -> bool:
        """Whether there are floating joints, whose quaternions need a check."""
        return bool(self._floats)

    def has_unit_quaternions(self, positions: Floats) -> NDArray[np.bool_]:
        """Whether ``normalised`` accepts the quaternions of each row (N, nq)."""
        off = np.abs(self._norms(positions) - 1.0).max(axis=(1, 2), initial=0.0)
        return np.asarray(off) <= QUATERNION_TOLERANCE

    def normalised(self, positions: Floats) -> Floats:
        """``positions`` with the quaternions of floating joints at unit length.

        Raises InvalidInput if a length is off by more than ``QUATERNION_TOLERANCE``.
        """
        if not self._floats:
            return positions
        norms = self._norms(positions)
        if not np.all(np.abs(norms - 1.0) <= QUATERNION_TOLERANCE):
            worst = int(np.abs(norms - 1.0).argmax())
            form = self._floats[worst % len(self._floats)]
            raise InvalidInput(
                f"the floating joint of {form.parent!r} -> {form.child!r} was given a quaternion of length "
                f"{norms.item(worst):.6g}; its last four numbers are qx qy qz qw of length 1"
            )
        unit = positions.copy()
        unit[..., self._quaternions] = positions[..., self._quaternions] / norms
        return unit

    def _norms(self, positions: Floats) -> Floats:
        """The lengths of the quaternions, (..., floating joints, 1)."""
        norms: Floats = np.sqrt(np.square(positions[..., self._quaternions]).sum(axis=-1, keepdims=True))
        return norms


@lru_cache(maxsize=16)
def shared_transforms(model: RobotModel) -> JointTransforms:
    """The table of ``model``; the robots of a fleet that have one model share it."""
    return JointTransforms(model)


def _rotations(edges: _Rows) -> _Write:
    """The rotation of the edges that turn about an axis: revolute joints, and planar joints by their yaw."""
    rows = np.array([row for row, _ in edges])
    columns = np.array([form.column + 2 * (form.kind == "planar") for _, form in edges])
    half_scale = np.array([0.5 * form.scale for _, form in edges])
    half_shift = np.array([0.5 * form.shift for _, form in edges])
    q_cos = np.array([form.q_cos for _, form in edges])
    q_sin = np.array([form.q_sin for _, form in edges])

    def write(positions: Floats, out: Floats) -> None:
        half = positions.take(columns, axis=-1) * half_scale + half_shift
        # One complex exponential is both cosine and sine, and accurate at any number of turns.
        unit: NDArray[np.complex128] = np.exp(1j * half)
        rotation = unit.real[..., None] * q_cos
        rotation += unit.imag[..., None] * q_sin
        out[..., rows, 3:] = rotation

    return write


def _translations(edges: _Rows) -> _Write:
    """The translation of the edges that move along one axis (prismatic) or along two (planar)."""
    columns = np.array([(form.column, form.column + (form.kind == "planar")) for _, form in edges])
    offsets = np.array([np.array(form.t0) + np.array(form.t1) * form.shift for _, form in edges])
    # The derivative of the translation by the joint's two numbers; a prismatic joint has one.
    steps = [
        to_matrix(form.origin)[:3, :2] if form.kind == "planar" else np.outer(form.t1, (form.scale, 0.0))
        for _, form in edges
    ]
    return _linear(edges, columns, np.array(steps), offsets)


def _floating_poses(edges: _Rows) -> _Write:
    """The poses of floating joints: the origin acts on the joint's pose linearly, as a 7 x 7 matrix."""
    columns = np.array([range(form.column, form.column + 7) for _, form in edges])
    offsets = np.array([(*form.t0, 0.0, 0.0, 0.0, 0.0) for _, form in edges])
    origins = np.zeros((len(edges), 7, 7))
    for matrix, (_, form) in zip(origins, edges, strict=True):
        matrix[:3, :3] = to_matrix(form.origin)[:3, :3]
        matrix[3:, 3:] = np.transpose(
            [multiply(form.q_cos, (x, y, z, w)) for x, y, z, w in np.eye(4).tolist()]
        )
    return _linear(edges, columns, origins, offsets)


def _linear(edges: _Rows, columns: NDArray[np.intp], matrices: Floats, offsets: Floats) -> _Write:
    """Writes ``matrices @ positions[columns] + offsets`` into the first numbers of the poses of ``edges``."""
    rows, count = np.array([row for row, _ in edges]), offsets.shape[1]

    def write(positions: Floats, out: Floats) -> None:
        moved = matrices @ positions.take(columns, axis=-1)[..., None]
        out[..., rows, :count] = moved[..., 0] + offsets

    return write


def edge_forms(model: RobotModel) -> tuple[JointTransform, ...]:
    """The closed form of every edge, fixed ones included, in the order of ``model.joints``."""
    return tuple(_form(model, joint) for joint in model.joints)


def _form(model: RobotModel, joint: Joint) -> JointTransform:
    kind: EdgeKind = "revolute" if joint.type == "continuous" else joint.type
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
