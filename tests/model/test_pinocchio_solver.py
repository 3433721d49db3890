"""Which Pinocchio is loaded, and how its memory is read."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.model_samples import every_joint, local_model, random_positions

from zstate.errors import LibraryMissing
from zstate.extension import kernel
from zstate.model import pinocchio_solver
from zstate.model.kinematics import Kinematics, MovingEdges
from zstate.model.pinocchio_solver import load_pinocchio, select_engine


@pytest.fixture
def broken_pinocchio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file in place of Pinocchio, for its text."""
    for name in [name for name in sys.modules if name.split(".")[0] == "pinocchio"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / "pinocchio.py"


@pytest.mark.parametrize(
    ("text", "command"),
    [
        (
            "libgomp.so.1: cannot open shared object file: No such file or directory",
            "apt-get install libgomp1",
        ),
        (
            "liburdfdom_sensor.so.6.0: cannot open shared object file",
            "pip install --force-reinstall 'cmeel-urdfdom>=6,<7'",
        ),
        ("libcoal.so: cannot open shared object file", "pip install --force-reinstall pin"),
    ],
)
def test_the_command_that_mends_pinocchio_depends_on_what_is_missing(
    broken_pinocchio: Path, text: str, command: str
) -> None:
    broken_pinocchio.write_text(f"raise ImportError({text!r})")
    with pytest.raises(LibraryMissing) as missing:
        load_pinocchio()
    assert text in str(missing.value)
    assert f"`{command}`" in str(missing.value)
    assert missing.value.command == command


def test_without_pinocchio_link_poses_raise_and_edge_poses_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    kinematics = local_model("rrbot")
    kinematics.edge_poses([0.0, 0.0])
    with pytest.raises(LibraryMissing, match="`pip install pin`"):
        kinematics.link_poses([0.0, 0.0])


def test_the_engine_has_the_version_of_pinocchio_or_the_reason_why_it_is_not_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert select_engine() == (f"Pinocchio {load_pinocchio().__version__}", "", "")
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    name, reason, command = select_engine()
    assert (name, command) == ("closed forms", "pip install pin")
    assert "`pip install pin`" in reason


def test_placements_of_another_size_in_memory_are_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    # As a release that appends a number to each placement would have it, seen from this side.
    stride = np.lib.stride_tricks.as_strided
    monkeypatch.setattr(np.lib.stride_tricks, "as_strided", lambda x, shape, _: stride(x, shape, (88, 8)))
    model = every_joint().model
    with pytest.raises(LibraryMissing, match="another memory layout"):
        Kinematics(model).link_poses(random_positions(model, 1))
    assert MovingEdges(model).engine.name == "closed forms"


@pytest.mark.skipif(kernel != "c", reason=f"runs on the reference: {kernel.reason}")
def test_the_extension_and_numpy_read_the_same_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    model = every_joint().model
    kinematics, edges = Kinematics(model), MovingEdges(model)
    for seed in range(5):
        positions = random_positions(model, seed)
        compiled = kinematics.link_poses(positions), edges.poses(positions)
        monkeypatch.setattr(pinocchio_solver, "kernel", "reference")
        in_numpy = kinematics.link_poses(positions), edges.poses(positions)
        monkeypatch.undo()
        for one, other in zip(compiled, in_numpy, strict=True):
            np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-14)
