"""Forward kinematics: poses and velocities of links from positions.

Readers get the poses of links in their parents from closed forms (``joint_transforms.py``), which need numpy
only. Pinocchio (``pinocchio_solver.py``) computes poses in the root, velocities and what publishers send.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from zstate._util.fork_safe import fork_safe_lock
from zstate._util.format import did_you_mean
from zstate.checks import Floats
from zstate.errors import InvalidInput, LibraryMissing
from zstate.model.joint_transforms import JointTransforms
from zstate.model.robot import RobotModel

if TYPE_CHECKING:
    from zstate.model.pinocchio_solver import PinocchioSolver


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

    def __reduce__(self) -> tuple[Any, ...]:
        return Kinematics, (self.model,)

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
        velocity [rad/s], both in the axes of ``reference``. ``positions`` and ``velocities`` as
        ``model.check_positions`` and ``model.check_velocities`` take them.
        """
        frame = self._row(link)
        seen_from = self._row(self.model.root if reference is None else reference)
        checked = self._table.normalised(self.model.check_positions(positions))
        rates = self.model.check_velocities(velocities)
        with self._lock:
            return self._solver.twist(frame, seen_from, checked, rates)

    def origins(
        self, links: Sequence[str], positions: ArrayLike, reference: str | None = None
    ) -> tuple[Floats, Floats]:
        """The origins of k ``links`` in ``reference`` (None: the root) [m], and their Jacobians.

        (k, 3), and (k, 3, n) for the n velocities of ``model.check_velocities``: ``jacobians @ velocities``
        are the linear velocities of ``twist``.
        """
        frames = [self._row(link) for link in links]
        seen_from = self._row(self.model.root if reference is None else reference)
        checked = self._table.normalised(self.model.check_positions(positions))
        with self._lock:
            return self._solver.origins(frames, seen_from, checked)

    @cached_property
    def _solver(self) -> PinocchioSolver:
        from zstate.model.pinocchio_solver import PinocchioSolver  # noqa: PLC0415 - readers load no Pinocchio

        return PinocchioSolver(self.model, self._table.forms)

    def _row(self, link: str) -> int:
        if link not in self.model.links:
            hint = did_you_mean(link, self.model.links)
            raise InvalidInput(f"{self.model.name!r} has no link {link!r}{hint}")
        return self.model.links.index(link)


class MovingEdges:
    """The edges of a robot that joints move, for publishers: ``forms`` in the order of ``model.joints``.

    Poses come from Pinocchio, or from the closed forms if it cannot be loaded (``engine.reason``), or if
    ``pinocchio`` is False. Raises ModelError, which names the joint, if both differ by more than 1e-9. Any
    thread may call; the workspace is locked, and as large as that of ``Kinematics``.
    """

    def __init__(self, model: RobotModel, *, pinocchio: bool = True) -> None:
        from zstate.model import pinocchio_solver as solvers  # noqa: PLC0415 - as above

        self._table = JointTransforms(model)
        self._rows = np.flatnonzero([form.kind != "fixed" for form in self._table.forms])
        self.forms = tuple(self._table.forms[row] for row in self._rows)
        self._lock = fork_safe_lock()
        self._solver: PinocchioSolver | None = None
        self.engine = solvers.Engine("closed forms")
        if not pinocchio:
            return
        try:
            self._solver = solvers.PinocchioSolver(model, self._table.forms)
            self.engine = self._solver.engine
        except LibraryMissing as error:
            self.engine = solvers.closed_forms(error)
        else:
            solvers.compare_with_closed_forms(model, self._table, self._solver)

    def poses(self, positions: Floats) -> Floats:
        """``parent_from_child`` of every moving edge: (M, 7), x y z [m], qx qy qz qw.

        Positions must be finite and of the right length (not checked). Raises InvalidInput for a floating
        joint without a unit quaternion. The sign of a quaternion is arbitrary.
        """
        if self._solver is None:
            return self._table.poses(positions).take(self._rows, axis=0)
        positions = self._table.normalised(positions)
        with self._lock:
            return self._solver.moving_edges(positions)


def _destination(out: Floats | None, rows: int) -> Floats:
    if out is None:
        return np.empty((rows, 7))
    if out.shape != (rows, 7) or out.dtype != np.float64:
        raise InvalidInput(f"out must be float64 of shape ({rows}, 7); got {out.dtype} of shape {out.shape}")
    return out
