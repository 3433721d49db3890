"""Writes docs/licences.md: the packages that zstate installs with all extras for users, and their licences.

pip install -e '.[all,mujoco,lint]' && python .ci/licences.py
"""

import json
import re
import subprocess
import sys
from collections import deque
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PAGE = Path(__file__).parents[1] / "docs" / "licences.md"
EXTRAS = ("all", "mujoco")
STATED = {
    "av": "BSD-3-Clause; its wheel has FFmpeg (LGPL-3.0-or-later), x264 and x265 (GPL-2.0-or-later)",
    "cmeel-qhull": "Qhull",
    "xacro": "BSD-3-Clause",
}
"""Where the metadata of a package has no name of a licence, or not those of all that is in its wheel."""

_HEAD = """# Licences of dependencies

zstate is Apache-2.0. It installs the packages below, and contains none of them. `python
.ci/licences.py` writes this page with [pip-licenses](https://github.com/raimon49/pip-licenses), by
the metadata of the packages, and a test compares the list with the requirements. Where a package
names several licences after each other, its own files have the conditions. A release has a bill of
materials (SBOM) in CycloneDX, with versions.

"""


def required(extras: tuple[str, ...]) -> dict[str, set[str]]:
    """The packages that zstate with ``extras`` needs in this environment, each with the extras of its own."""
    found: dict[str, set[str]] = {}
    queue = deque([("zstate", set(extras))])
    while queue:
        name, asked = queue.popleft()
        if name in found and asked <= found[name]:
            continue
        found.setdefault(name, set()).update(asked)
        for requirement in map(Requirement, metadata.requires(name) or ()):
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *asked)):
                queue.append((canonicalize_name(requirement.name), set(requirement.extras)))
    del found["zstate"]
    return found


def page() -> str:
    """The page as Markdown."""
    names = [*required(EXTRAS)]
    command = [sys.executable, "-m", "piplicenses", "--format=json", "--from=mixed", "--packages", *names]
    rows = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    base = required(())
    table = ["| package | licence | installed |", "|---|---|---|"]
    for row in sorted(rows, key=lambda row: canonicalize_name(row["Name"])):
        name = canonicalize_name(row["Name"])
        licence = STATED.get(name) or re.sub(r"\s*;\s*", "; ", row["License"])
        table.append(f"| {name} | {licence} | {'always' if name in base else 'with an extra'} |")
    return _HEAD + "\n".join(table) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
