"""Counter of refused input, which logs the first refusal of each reason."""

from __future__ import annotations

import logging
from collections import Counter

from zstate._util.fork_safe import fork_safe_lock

_LOG = logging.getLogger("zstate")


class Refusals:
    """Counts refusals by reason and logs the first of each. Any thread may count.

    ``subject`` names the refused input in the log. With a ``parent``, a refusal is logged only if it is the
    first of its reason there, too, and ``parent.first`` has it as well; ``parent.counts`` does not.
    """

    def __init__(self, subject: str = "", parent: Refusals | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self.first: dict[str, str] = {}
        """The text of the first refusal of each reason."""
        self.newest: object = ""
        """The explanation of the newest refusal."""
        self._prefix = f"{subject} " if subject else ""
        self._parent = parent
        self._lock = fork_safe_lock()

    def count(self, reason: str, text: object) -> None:
        """Count one refusal for ``reason``; ``text`` explains it, in ``first`` before it is counted."""
        is_first = reason not in self.first and self._is_first(reason, str(text))
        with self._lock:
            self.counts[reason] += 1
            self.newest = text
        if is_first:
            facts = {"event": "refused", "reason": reason}
            text = f"{self._prefix}refused ({reason}): {text}; further ones are only counted"
            _LOG.warning("%s", text, extra=facts)

    def _is_first(self, reason: str, text: str) -> bool:
        with self._lock:
            if reason in self.first:
                return False
            self.first[reason] = text
        return self._parent is None or self._parent._is_first(reason, text)
