"""A robot simulated by MuJoCo, from an MJCF file with position actuators: pip install 'zstate[mujoco]'."""

from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from zstate import JointReading
from zstate.driving import Setpoint

LONGEST_S = 0.1  # what is simulated at most for one reading


class MujocoArm:
    """The joints with an actuator in the model at ``path``; time is that of the stamps of ``read``."""

    modes: frozenset[Literal["position"]] = frozenset({"position"})

    def __init__(self, path: str | Path) -> None:
        self._model = model = mujoco.MjModel.from_xml_path(str(path))
        self._data = mujoco.MjData(model)
        self._actuators = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        joints = model.actuator_trnid[self._actuators, 0]
        self.joint_names = tuple(model.joint(joint).name for joint in joints)
        self._q, self._v = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._owed_s = 0.0
        self._read_at: int | None = None

    def open(self) -> None:
        self.stop("relax")

    def enable(self, on: bool) -> None:
        self.stop("hold" if on else "relax")

    def read(self, stamp: int) -> JointReading:
        past_s = 0.0 if self._read_at is None else (stamp - self._read_at) * 1e-9
        self._owed_s, self._read_at = self._owed_s + min(max(past_s, 0.0), LONGEST_S), stamp
        while self._owed_s >= self._model.opt.timestep:
            mujoco.mj_step(self._model, self._data)
            self._owed_s -= self._model.opt.timestep
        data = self._data
        return JointReading(data.qpos[self._q], data.qvel[self._v], data.qfrc_actuator[self._v])

    def write(self, setpoint: Setpoint) -> None:
        self._data.ctrl[self._actuators] = setpoint.positions

    def stop(self, how: str) -> None:
        self._data.ctrl[self._actuators] = self._data.qpos[self._q]
        no_actuation = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        if how == "relax":
            self._model.opt.disableflags |= no_actuation
        else:
            self._model.opt.disableflags &= ~no_actuation

    def close(self) -> None:
        self.stop("relax")
