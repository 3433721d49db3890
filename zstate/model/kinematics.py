"""Forward kinematics: poses and velocities of links from positions.

Poses of links in their parents come from closed forms (``joint_transforms.py``) and need numpy only.
Pinocchio computes poses in the root and velocities; it is imported at the first such call. It gets
numbers, never names or text: its model is built joint by joint from the RobotModel, depth first as its
algorithms expect.
"""

from __future__ import annotations

from collections import defaultdict
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.fork_safe import fork_safe_lock
from zstate._util.format import did_you_mean
from zstate.errors import InvalidInput, LibraryMissing
from zstate.model.joint_transforms import Floats, JointTransform, JointTransforms
from zstate.model.robot import RobotModel


class Kinematics:
    """Forward kinematics of one robot.

    ``edges`` are the (parent, child) of every joint, in the order of ``model.joints``. Positions are
    arrays or lists in the order of ``model.joint_names``; methods raise InvalidInput for a wrong
    count, NaN or infinity, and for a floating joint's quaternion that is not of unit length. Mimic
    joints follow their master. Any thread may call; ``link_poses`` and ``twist`` share one locked
    workspace, whose memory grows with the cube of the joint count (8 MB at 44, 0.5 GB at 200, which is
    why ``load_model`` refuses larger robots). ``edge_poses`` needs no workspace and no lock.
    """

    def __init__(self, model: RobotModel) -> None:
        self.model = model
        self.edges = tuple((joint.parent, joint.child) for joint in model.joints)
        self._table = JointTransforms(model)
        self._lock = fork_safe_lock()

    def __repr__(self) -> str:
        return f"<Kinematics of {self.model.name!r}, {len(self.model.links)} links>"

    def edge_poses(self, positions: ArrayLike, out: Floats | None = None) -> Floats:
        """The pose of every link but the root in its parent.

        Row i is ``parent_from_child`` of ``edges[i]``: (E, 7), x y z [m], qx qy qz qw; written into
        ``out`` if passed. The sign of a quaternion is arbitrary.
        """
        checked = self.model.check_positions(positions)
        return self._table.poses(checked, _destination(out, len(self.edges)))

    def link_poses(self, positions: ArrayLike, out: Floats | None = None) -> Floats:
        """The pose of every link in the root link.

        Row i is ``root_from_link`` of ``model.links[i]``: (L, 7), x y z [m], qx qy qz qw; written into
        ``out`` if passed. The sign of a quaternion is arbitrary.
        """
        checked = self._table.normalised(self.model.check_positions(positions))
        out = _destination(out, len(self.model.links))
        with self._lock:
            return self._solver.link_poses(checked, out)

    def twist(
        self, link: str, positions: ArrayLike, velocities: ArrayLike, reference: str | None = None
    ) -> Floats:
        """The velocity of ``link`` in ``reference`` (None: the root): (6,).

        The rate of ``reference_from_link``: linear velocity of the link's origin [m/s], then angular
        velocity [rad/s], both in the axes of ``reference``. Velocities as ``model.check_velocities``.
        """
        frame = self._row(link)
        seen_from = self._row(self.model.root if reference is None else reference)
        checked = self._table.normalised(self.model.check_positions(positions))
        rates = self.model.check_velocities(velocities)
        with self._lock:
            return self._solver.twist(frame, seen_from, checked, rates)

    @cached_property
    def _solver(self) -> _Solver:
        return _Solver(self.model, self._table.forms)

    def _row(self, link: str) -> int:
        if link not in self.model.links:
            hint = did_you_mean(link, self.model.links)
            raise InvalidInput(f"{self.model.name!r} has no link {link!r}{hint}")
        return self.model.links.index(link)


class _Solver:
    """Pinocchio's model and workspace of one robot. Not thread-safe.

    Frame i + 1 of Pinocchio is link i, frame 0 its universe, which is the root link. Continuous joints
    are ordinary revolute joints here: Pinocchio computes cosine and sine of any angle itself.
    """

    def __init__(self, model: RobotModel, forms: tuple[JointTransform, ...]) -> None:
        # Imported here because edge_poses does not need it; it comes without types.
        try:
            import pinocchio  # noqa: PLC0415  # pyright: ignore[reportMissingTypeStubs]
        except ImportError as error:
            raise LibraryMissing(
                f"link poses and twists need Pinocchio, which cannot be loaded: {error}; "
                "its wheel needs the system's OpenMP: apt-get install libgomp1"
            ) from error
        self._pin: Any = pinocchio
        self._model: Any = self._pin.Model()
        rows = [
            (form, self._model.idx_qs[joint_id], self._model.idx_vs[joint_id])
            for form, joint_id in self._add_links(model, forms).items()
        ]
        self._data: Any = self._model.createData()
        single = [row for row in rows if row[0].kind in ("revolute", "prismatic")]
        self._q_rows = np.array([q_row for _, q_row, _ in single], dtype=np.intp)
        self._v_rows = np.array([v_row for _, _, v_row in single], dtype=np.intp)
        self._columns = np.array([form.column for form, _, _ in single], dtype=np.intp)
        self._velocity_columns = np.array([form.velocity_column for form, _, _ in single], dtype=np.intp)
        self._scale = np.array([form.scale for form, _, _ in single])
        self._shift = np.array([form.shift for form, _, _ in single])
        self._planar = [row for row in rows if row[0].kind == "planar"]
        self._floating = [row for row in rows if row[0].kind == "floating"]
        # A view of Pinocchio's placements, which are contiguous, twelve doubles each: the rotation by
        # columns, then the translation. Reading them one by one from Python costs more than ten times
        # what computing them does. The view keeps the workspace alive.
        first = self._data.oMf[0].rotation
        self._frames = np.lib.stride_tricks.as_strided(first, (len(model.links) + 1, 12), (96, 8))[1:]

    def link_poses(self, positions: Floats, out: Floats) -> Floats:
        self._pin.framesForwardKinematics(self._model, self._data, self._configuration(positions))
        out[:, :3] = self._frames[:, 9:]
        out[:, 3:] = _quaternions(self._frames[:, :9])
        return out

    def twist(self, link: int, reference: int, positions: Floats, velocities: Floats) -> Floats:
        q, v = self._configuration(positions), self._velocity(positions, velocities)
        self._pin.forwardKinematics(self._model, self._data, q, v)
        linear, angular, root_from_link = self._motion(link)
        reference_linear, reference_angular, root_from_reference = self._motion(reference)
        lever = root_from_link.translation - root_from_reference.translation
        linear = linear - reference_linear - np.cross(reference_angular, lever)
        rotation = root_from_reference.rotation.T
        return np.concatenate((rotation @ linear, rotation @ (angular - reference_angular)))

    def _motion(self, link: int) -> tuple[Floats, Floats, Any]:
        """Linear velocity of a link's origin, its angular velocity and its pose, in the root."""
        pose = self._pin.updateFramePlacement(self._model, self._data, link + 1).copy()
        axes = self._pin.LOCAL_WORLD_ALIGNED
        motion = self._pin.getFrameVelocity(self._model, self._data, link + 1, axes)
        return motion.linear.copy(), motion.angular.copy(), pose

    def _configuration(self, positions: Floats) -> Floats:
        q = np.empty(self._model.nq)
        q[self._q_rows] = positions[self._columns] * self._scale + self._shift
        for form, row, _ in self._planar:
            x, y, yaw = positions[form.column : form.column + 3].tolist()
            q[row : row + 4] = x, y, np.cos(yaw), np.sin(yaw)
        for form, row, _ in self._floating:
            q[row : row + 7] = positions[form.column : form.column + 7]
        return q

    def _velocity(self, positions: Floats, velocities: Floats) -> Floats:
        """Pinocchio's velocities: those of planar and floating joints are in the axes of the child."""
        v = np.empty(self._model.nv)
        v[self._v_rows] = velocities[self._velocity_columns] * self._scale
        for form, _, row in self._planar:
            x, y, yaw_rate = velocities[form.velocity_column : form.velocity_column + 3]
            yaw = positions[form.column + 2]
            cos, sin = np.cos(yaw), np.sin(yaw)
            v[row : row + 3] = cos * x + sin * y, cos * y - sin * x, yaw_rate
        for form, _, row in self._floating:
            pose = self._pin.XYZQUATToSE3(positions[form.column : form.column + 7])
            rates = velocities[form.velocity_column : form.velocity_column + 6]
            v[row : row + 6] = (rates.reshape(2, 3) @ pose.rotation).ravel()
        return v

    def _add_links(self, model: RobotModel, forms: tuple[JointTransform, ...]) -> dict[JointTransform, int]:
        """Add all joints and links to Pinocchio's model. Returns the ids of the joints that move."""
        pin, joint_ids = self._pin, dict[JointTransform, int]()
        below: defaultdict[str, list[JointTransform]] = defaultdict(list)
        for form in forms:
            below[form.parent].append(form)
        # For each link Pinocchio's joint that carries it, and the link's pose in that joint.
        placed: dict[str, tuple[int, Any]] = {model.root: (0, pin.SE3.Identity())}
        waiting = below[model.root].copy()
        while waiting:
            form = waiting.pop()
            waiting += below[form.child]
            joint_id, placement = placed[form.parent]
            placement = placement * pin.XYZQUATToSE3(np.array(form.origin))
            if form.kind != "fixed":
                if form.kind == "revolute":
                    joint = pin.JointModelRevoluteUnaligned(np.array(form.axis))
                elif form.kind == "prismatic":
                    joint = pin.JointModelPrismaticUnaligned(np.array(form.axis))
                else:
                    joint = pin.JointModelPlanar() if form.kind == "planar" else pin.JointModelFreeFlyer()
                joint_id = self._model.addJoint(joint_id, joint, placement, f"j{len(joint_ids)}")
                joint_ids[form], placement = joint_id, pin.SE3.Identity()
            placed[form.child] = joint_id, placement
        for row, link in enumerate(model.links):
            joint_id, placement = placed[link]
            self._model.addFrame(pin.Frame(f"l{row}", joint_id, 0, placement, pin.FrameType.BODY))
        return joint_ids


def _destination(out: Floats | None, rows: int) -> Floats:
    if out is None:
        return np.empty((rows, 7))
    if out.shape != (rows, 7) or out.dtype != np.float64:
        raise InvalidInput(f"out must be float64 of shape ({rows}, 7); got {out.dtype} of shape {out.shape}")
    return out


def _quaternion_products() -> tuple[Floats, Floats]:
    """``rotation @ matrix + offset`` is 4 q q^T for a rotation given as nine numbers by columns."""
    matrix = np.zeros((3, 3, 4, 4))
    offset = np.eye(4)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        matrix[i, i, range(4), range(4)] = -1.0
        matrix[i, i, (i, 3), (i, 3)] = 1.0
        matrix[i, j, (i, j), (j, i)] = matrix[j, i, (i, j), (j, i)] = 1.0
        matrix[i, j, k, 3] = matrix[i, j, 3, k] = 1.0
        matrix[j, i, k, 3] = matrix[j, i, 3, k] = -1.0
    return matrix.reshape(9, 16), offset.reshape(16)


_PRODUCTS, _PRODUCTS_OFFSET = _quaternion_products()


def _quaternions(rotations: Floats) -> Floats:
    """Unit quaternions x y z w of rotations given as (n, 9), by columns.

    Each row of 4 q q^T is a multiple of q; the row of q's largest component is never near zero.
    """
    products = rotations @ _PRODUCTS + _PRODUCTS_OFFSET
    largest: NDArray[np.intp] = products[:, ::5].argmax(axis=1)
    rows = products.reshape(-1, 4, 4)[np.arange(len(largest)), largest]
    return rows / np.sqrt(np.einsum("ij,ij->i", rows, rows))[:, None]
