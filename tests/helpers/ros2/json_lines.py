"""Protocol of this folder's programs: JSON lines, requests on standard input, replies on standard output.

A request is ``{"do": NAME, ...}``; its reply is ``{"did": NAME, "answer": ...}`` or
``{"failed": NAME, "why": ...}``.
Between replies a program prints ``{"received": TOPIC, "message": ...}`` for every message that it receives.

Their interpreters have no zstate, so this module imports only the standard library.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

_LOCK = threading.Lock()


def print_line(**values: Any) -> None:
    """Prints one complete line; callable from any thread."""
    with _LOCK:
        sys.stdout.write(json.dumps(values) + "\n")
        sys.stdout.flush()


def report_message(topic: str, message: Any) -> None:
    """Prints ``message``, which was received on ``topic``."""
    print_line(received=topic, message=message)


def serve(commands: Mapping[str, Callable[..., Any]]) -> None:
    """Replies to ``{"do": NAME, ...}`` with the result of ``commands[NAME](...)``, until the input ends.

    "sync" does nothing; messages received before it are printed before its reply.
    """
    print_line(did="start", answer=None)
    commands = {"sync": lambda: None, **commands}
    for line in sys.stdin:
        arguments = json.loads(line)
        name = arguments.pop("do")
        try:
            answer = commands[name](**arguments)
        except Exception as error:
            print_line(failed=name, why=f"{type(error).__name__}: {error}")
        else:
            print_line(did=name, answer=answer)
