"""Address: where metrics are served, as a user says it."""

from __future__ import annotations

import re
from typing import NamedTuple

from zstate.errors import InvalidInput

LOCAL = "127.0.0.1"

_FORM = re.compile(r"(?:(\[[0-9A-Fa-f:.]+\]|[^\s:/\[\]]+):)?([0-9]{1,5})")


class Address(NamedTuple):
    """A host to bind to and a port; port 0 is a free one."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """ "9100" (this host alone), "0.0.0.0:9100" or "[::]:9100". Raises InvalidInput."""
        match = _FORM.fullmatch(text)
        if match is None or int(match[2]) > 65535:
            raise InvalidInput(f"{text!r} is not PORT or HOST:PORT; for instance 9100, or 0.0.0.0:9100")
        return cls((match[1] or LOCAL).strip("[]"), int(match[2]))
