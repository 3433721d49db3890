"""Browser: one that nobody sees, to draw pictures with."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from contextlib import suppress

from zstate.closing import Closing
from zstate.errors import LibraryMissing

_NAMES = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "microsoft-edge",
    "brave-browser",
)
# It draws without a graphics card, and asks nobody outside about anything.
_FLAGS = (
    "--headless=new",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1 , EXCLUDE localhost",
)
_ENDS_WITHIN_S = 3.0


class Browser(Closing):
    """Shows ``url`` in a window of ``width`` by ``height`` pixels that is on no screen.

    Raises LibraryMissing where no browser of Chromium's kind is installed.
    """

    def __init__(self, url: str, width: int, height: int) -> None:
        program = installed_browser()
        self._profile = tempfile.TemporaryDirectory(prefix="zstate-view-", ignore_cleanup_errors=True)
        command = [
            program,
            *_FLAGS,
            f"--user-data-dir={self._profile.name}",
            f"--window-size={width},{height}",
        ]
        if os.geteuid() == 0:
            command.append("--no-sandbox")  # root has none
        silent = subprocess.DEVNULL
        self._process = subprocess.Popen(
            [*command, url], stdin=silent, stdout=silent, stderr=silent, start_new_session=True
        )

    @property
    def has_ended(self) -> bool:
        """Whether it has ended by itself, which it never should."""
        return self._process.poll() is not None

    def close(self) -> None:
        """End it and what it started. A second call does nothing."""
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_ENDS_WITHIN_S)
        self._process.kill()
        self._process.wait()
        self._profile.cleanup()


def installed_browser() -> str:
    """The path of a browser that can be driven. Raises LibraryMissing."""
    for name in _NAMES:
        path = shutil.which(name)
        if path is not None:
            return path
    raise LibraryMissing(
        "a picture is drawn by a browser, and none of Chromium's kind is installed: apt-get install chromium"
    )
