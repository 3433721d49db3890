"""The workload of a soak test, shared by all its processes."""

from __future__ import annotations

import time
from argparse import ArgumentParser, RawTextHelpFormatter
from dataclasses import asdict, dataclass, fields

EPOCH_S = 30


@dataclass(frozen=True)
class Task:
    """``robots`` at ``rate`` [Hz], shared by ``processes`` publishers.

    ``bare`` selects the control run with Zenoh alone. ``role`` and ``share`` name one of the processes; an
    empty role is the process that starts the others.
    """

    robots: int = 100
    rate: float = 50.0
    minutes: float = 10.0
    processes: int = 4
    model: str = "panda"
    fresh_s: float = 60.0
    warm_up_s: float = 120.0
    bare: bool = False
    endpoint: str = ""
    role: str = ""
    share: int = 0

    @classmethod
    def parse(cls, description: str) -> Task:
        """The task of the command line."""
        parser = ArgumentParser(description=description, formatter_class=RawTextHelpFormatter)
        for field in fields(cls):
            name = f"--{field.name.replace('_', '-')}"
            default: object = field.default
            if isinstance(default, bool):
                parser.add_argument(name, action="store_true")
            else:
                parser.add_argument(name, type=type(default), default=default)
        return cls(**vars(parser.parse_args()))

    @property
    def names(self) -> list[str]:
        """The names of the robots."""
        return [f"r{number:03}" for number in range(self.robots)]

    @property
    def options(self) -> list[str]:
        """The command line of this task, without default values."""
        options: list[str] = []
        for name, value in asdict(self).items():
            if value != getattr(Task, name):
                option = f"--{name.replace('_', '-')}"
                options += (
                    [option]
                    if value is True
                    else [option, f"{value:g}" if isinstance(value, float) else str(value)]
                )
        return options


def epoch() -> int:
    """The number of the current half minute, published as the latched value of every robot."""
    return int(time.time()) // EPOCH_S
