"""The reference in numpy of the poses of all edges of a robot, used without the C extension."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate.checks import Floats
from zstate.model.joint_forms import JointTransform
from zstate.se3 import multiply, to_matrix

_Rows: TypeAlias = Sequence[tuple[int, JointTransform]]
_Write: TypeAlias = Callable[[Floats, Floats], None]


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


def edge_poses(forms: Sequence[JointTransform]) -> _Write:
    """Writes the poses of all edges, (..., E, 7), for positions (..., nq)."""
    rest = np.array([(*form.t0, *form.q_cos) for form in forms]).reshape(-1, 7)
    writes: list[_Write] = []
    for make, kinds in (
        (_rotations, ("revolute", "planar")),
        (_translations, ("prismatic", "planar")),
        (_floating_poses, ("floating",)),
    ):
        edges = [(row, form) for row, form in enumerate(forms) if form.kind in kinds]
        if edges:
            writes.append(make(edges))

    def write(positions: Floats, out: Floats) -> None:
        out[...] = rest
        for one in writes:
            one(positions, out)

    return write
