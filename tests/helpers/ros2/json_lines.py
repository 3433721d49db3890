"""How the programs beside this file are talked to: a line of JSON in, a line of JSON out.

They are run by interpreters that do not have zstate, so this needs nothing but the standard library.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

_LOCK = threading.Lock()


def say(**facts: Any) -> None:
    """One line, whole, from any thread."""
    with _LOCK:
        sys.stdout.write(json.dumps(facts) + "\n")
        sys.stdout.flush()


def heard(topic: str, message: Any) -> None:
    """Tell that ``message`` arrived on ``topic``."""
    say(heard=topic, message=message)


def serve(commands: Mapping[str, Callable[..., Any]]) -> None:
    """Answer ``{"do": NAME, ...}`` lines with what ``commands[NAME](...)`` returns, until the input ends.

    "sync" does nothing: what was heard before it was told before its answer.
    """
    say(did="start", answer=None)
    commands = {"sync": lambda: None, **commands}
    for line in sys.stdin:
        arguments = json.loads(line)
        name = arguments.pop("do")
        try:
            answer = commands[name](**arguments)
        except Exception as error:
            say(failed=name, why=f"{type(error).__name__}: {error}")
        else:
            say(did=name, answer=answer)
