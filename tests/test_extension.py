"""Which kernel is used, and that it can be chosen."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest

import zstate
from zstate.errors import InvalidInput
from zstate.extension import VARIABLE, kernel, select_kernel

SHADOW = "import sys; sys.modules['zstate._kernel'] = None; "
STALE = "import sys, types; sys.modules['zstate._kernel'] = types.SimpleNamespace(REVISION=-1); "
SHOW = "import zstate; print(zstate.kernel, '|', zstate.kernel.reason)"
LOOK = (
    "; b = zstate.TransformBuffer(); "
    "b.insert_static(zstate.Transform('a', 'b', (1, 2, 3), (0, 0, 0, 1))); print(b.lookup('a', 'b'))"
)


def python(code: str, wish: str = "") -> subprocess.CompletedProcess[str]:
    environment = os.environ | {VARIABLE: wish}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_the_package_exports_the_kernel_and_its_reason() -> None:
    is_built = find_spec("zstate._kernel") is not None
    assert zstate.kernel == (os.environ.get(VARIABLE) or ("c" if is_built else "reference"))
    assert zstate.kernel.reason
    assert zstate.kernel is kernel


def test_the_environment_forces_the_reference() -> None:
    done = python(SHOW + LOOK, "reference")
    assert done.stdout.startswith(f"reference | {VARIABLE} selects it\n<pose of b in a")


def test_without_the_extension_the_reference_answers() -> None:
    done = python(SHADOW + SHOW + LOOK)
    assert done.stdout.startswith("reference | the extension cannot be loaded")
    assert "installing zstate with a C compiler builds it" in done.stdout
    assert "<pose of b in a" in done.stdout


def test_an_extension_of_another_revision_is_not_used() -> None:
    """As in an editable install that was not built again."""
    pytest.importorskip("zstate._kernel")
    done = python(STALE + "import zstate as z; z._kernel = sys.modules['zstate._kernel']; " + SHOW + LOOK)
    assert done.stdout.startswith("reference | the extension is of revision -1, not")


def test_requiring_a_missing_extension_is_an_error() -> None:
    done = python(SHADOW + SHOW, "c")
    assert done.returncode != 0
    assert f"{VARIABLE} selects 'c', but the extension cannot be loaded" in done.stderr


def test_another_value_is_refused() -> None:
    with pytest.raises(InvalidInput, match="'c', 'reference' or not set; got 'fast'"):
        select_kernel("fast")
