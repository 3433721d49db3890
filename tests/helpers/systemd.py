"""A systemd of its own: process 1 of a namespace, with zstate in /opt and the units of deploy/ installed."""

from __future__ import annotations

import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from helpers.deployment import DEPLOY
from helpers.processes import DEADLINE_S, until
from helpers.requirements import DEBIAN_PYTHON

import zstate

SYSTEMD = "/lib/systemd/systemd"

# Everything that is mounted here is mounted for this systemd alone. /opt/zstate is a virtual environment of
# Debian's Python, since units have no access to homes or to /tmp, where that of the tests may be.
_BOOT = """
set -e
mount --make-rprivate /
mount --bind "$1/etc" /etc
mkdir -p "$1/opt/zstate/packages" "$1/opt/zstate/source"
mount --bind "$2" "$1/opt/zstate/packages"
mount --bind "$3" "$1/opt/zstate/source"
mount --rbind "$1/opt" /opt
mount --bind "$1/lib" /var/lib
for folder in /run /tmp /var/tmp; do mount -t tmpfs -o mode=1777 none "$folder"; done
mkdir -p /run/systemd/system
exec env -i container=lxc PATH=/usr/bin:/bin SYSTEMD_UNIT_PATH=/etc/systemd/system \\
  "$4" --system --unit=units.target --show-status=no
"""


class SystemManager:
    """``with SystemManager(folder) as manager: manager.systemctl("start", "zstate-drive@r1")``.

    ``folder`` is empty. Write the files that a unit reads to ``etc / "zstate"``; ``state`` is /var/lib.
    """

    def __init__(self, folder: Path) -> None:
        self.etc = folder / "etc"
        shutil.copytree("/etc", self.etc, symlinks=True, ignore=shutil.ignore_patterns("systemd"))
        units = self.etc / "systemd/system"
        units.mkdir(parents=True)
        # What the units need is there, and starts nothing: SYSTEMD_UNIT_PATH leaves the units of this machine
        # out, of which some empty /tmp.
        for target in ("units", "sysinit", "basic", "network-online", "shutdown"):
            (units / f"{target}.target").write_text("[Unit]\nDefaultDependencies=no\n")
        for path in DEPLOY.glob("*.service"):
            shutil.copy(path, units)
        (self.etc / "zstate").mkdir()
        with (self.etc / "passwd").open("a") as users:
            users.write("zstate:x:9990:9990::/nonexistent:/usr/sbin/nologin\n")
        with (self.etc / "group").open("a") as groups:
            groups.write("zstate:x:9990:\n")
        self._folder = folder
        self.state = folder / "lib"
        self.state.mkdir()
        self._install(folder / "opt/zstate")

    def _install(self, environment: Path) -> None:
        packages = environment / "lib/python3.11/site-packages"
        packages.mkdir(parents=True)
        (environment / "bin").mkdir()
        (environment / "bin/python3").symlink_to(DEBIAN_PYTHON)
        (environment / "pyvenv.cfg").write_text(f"home = {Path(DEBIAN_PYTHON).parent}\n")
        (packages / "zstate.pth").write_text(
            "/opt/zstate/source\nimport site; site.addsitedir('/opt/zstate/packages')\n"
        )
        program = environment / "bin/zstate"
        program.write_text("#!/opt/zstate/bin/python3\nfrom zstate.cli.main import main\nmain()\n")
        program.chmod(0o755)

    def __enter__(self) -> SystemManager:
        with ExitStack() as opened:
            self._process = opened.enter_context(
                subprocess.Popen(
                    [
                        *("unshare", "--mount", "--pid", "--fork", "--mount-proc"),
                        *("--kill-child", "bash", "-c", _BOOT, "boot", self._folder),
                        *(Path(np.__file__).parents[1], Path(zstate.__file__).parents[1], SYSTEMD),
                    ],
                    stdin=subprocess.DEVNULL,
                )
            )
            opened.callback(self._process.kill)
            until(lambda: self.systemctl("is-system-running", check=False) == "running")
            self._opened = opened.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def systemctl(self, *arguments: str, check: bool = True) -> str:
        """The output of ``systemctl``."""
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        if not children:
            return ""
        ended = subprocess.run(
            ["nsenter", "--target", children[0], "--mount", "--pid", "systemctl", *arguments],
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
        assert not check or not ended.returncode, ended.stderr
        return ended.stdout.strip()

    def property(self, unit: str, name: str) -> str:
        """A property of a unit, such as ``"NRestarts"``."""
        return self.systemctl("show", "--value", "--property", name, unit)
