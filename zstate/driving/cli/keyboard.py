"""Driving by the keys of a terminal, which repeats a held key and does not report its release."""

from __future__ import annotations

import os
import select
import sys
from dataclasses import dataclass

from zstate._util.closeable import Closeable
from zstate.cli.output.console import fail

FIRST_HOLD_S, HOLD_S = 0.6, 0.25
"""How long a key counts as held: after its first press, until the terminal repeats it, and after that."""

_ARROWS = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}
_AHEAD, _BACK, _LEFT, _RIGHT = (1.0, 1.0), (-1.0, -1.0), (-0.5, 0.5), (0.5, -0.5)
"""The rates of the left and the right wheel, as parts of the chosen one. Turns on the spot are slower."""
_WAYS = {
    **{"w": _AHEAD, "s": _BACK, "a": _LEFT, "d": _RIGHT},
    **{"up": _AHEAD, "down": _BACK, "left": _LEFT, "right": _RIGHT},
}

KEYS_TEXT = "hold w a s d or an arrow key to drive; space stops, q quits"


class KeyReader(Closeable):
    """The keys of the terminal on standard input, without Enter and without echo, until it is closed.

    Ends the command if standard input is no terminal.
    """

    def __init__(self) -> None:
        if not sys.stdin.isatty():
            fail("--keys reads the keys of a terminal, and standard input is none; run it in a terminal")
        import termios  # not on every system
        import tty

        self._input = sys.stdin.fileno()
        self._termios = termios
        self._before = termios.tcgetattr(self._input)
        tty.setcbreak(self._input)

    def read(self, timeout_s: float) -> list[str]:
        """The keys that were pressed, once there are some; none after ``timeout_s``.

        Characters are themselves in lower case, arrow keys are "up", "down", "left" and "right"; the end of
        the input is "q". Other keys are left out.
        """
        if not select.select([self._input], [], [], timeout_s)[0]:
            return []
        data = os.read(self._input, 1024)
        return keys_in(data) if data else ["q"]

    def close(self) -> None:
        """Give the terminal back as it was."""
        self._termios.tcsetattr(self._input, self._termios.TCSADRAIN, self._before)


def keys_in(data: bytes) -> list[str]:
    """The keys in the bytes of a terminal; arrow keys are ESC [ A to D, or ESC O A to D (ECMA-48, xterm)."""
    keys: list[str] = []
    while data:
        if data[:2] in (b"\x1b[", b"\x1bO"):
            keys += [_ARROWS[data[2:3]]] if data[2:3] in _ARROWS else []
            data = data[3:]
            continue
        keys += [chr(data[0]).lower()] if data[0] < 0x80 else []
        data = data[1:]
    return keys


@dataclass
class HeldKey:
    """The key that is held, and until when it counts as that [s, monotonic]."""

    key: str = ""
    until: float = 0.0

    def press(self, key: str, now: float) -> None:
        """A key was pressed, or repeated by the terminal; one that moves nothing ends the motion."""
        is_repeated = key == self.key and now < self.until
        self.key = key if key in _WAYS else ""
        self.until = now + (HOLD_S if is_repeated else FIRST_HOLD_S)

    def wheel_rates(self, now: float, rate: float) -> tuple[float, float] | None:
        """The rates of the left and the right wheel [rad/s], of at most ``rate``; None if no key is held."""
        if now >= self.until or self.key not in _WAYS:
            return None
        left, right = _WAYS[self.key]
        return left * rate, right * rate
