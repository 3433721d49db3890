"""The help of a command is there at once: what it needs to work is loaded when it works."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

pytestmark = pytest.mark.processes

HEAVY = {
    *("numpy", "scipy", "zenoh", "pinocchio", "msgspec", "rich", "mcap", "yaml", "viser", "matplotlib"),
    *("asyncio", "concurrent.futures", "http", "multiprocessing", "ssl", "subprocess", "tomllib", "xml.dom"),
}
"""Libraries, and the parts of Python's own that take milliseconds."""

ASK = f"""
import contextlib, io, json, sys
from zstate.cli.main import group, run
loaded, texts = {{}}, {{}}
for name in ("", *group.list_commands(None)):
    with contextlib.redirect_stdout(io.StringIO()) as text:
        assert run([name, "--help"] if name else ["--help"]) == 0, name
    texts[name] = text.getvalue()
    loaded[name] = sorted({HEAVY!r} & set(sys.modules))
print(json.dumps([loaded, texts]))
"""


def test_help_names_every_command_and_the_help_of_none_loads_a_library():
    ended = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=True)
    loaded, texts = json.loads(ended.stdout)
    # What one command loads stays: the first that has any is the one to look at.
    assert {name: heavy for name, heavy in loaded.items() if heavy} == {}
    for name, text in texts.items():
        assert f"  {name} " in texts[""], name
        assert "--help" in text, name
