"""Task: how much of what, the same for every process of a soak."""

from __future__ import annotations

import time
from argparse import ArgumentParser, RawTextHelpFormatter
from dataclasses import asdict, dataclass, fields

EPOCH_S = 30


@dataclass(frozen=True)
class Task:
    """What is run: ``robots`` at ``rate`` [Hz] by so many publisher ``processes``.

    With ``bare`` everybody is bare Zenoh with the same traffic: the control. ``role`` and ``share`` say
    which of the processes this is; none is the one that starts the others.
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
        """What the command line says."""
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
        """The robots."""
        return [f"r{number:03}" for number in range(self.robots)]

    @property
    def options(self) -> list[str]:
        """The command line that says this again, without what is as it always is."""
        said: list[str] = []
        for name, value in asdict(self).items():
            if value != getattr(Task, name):
                option = f"--{name.replace('_', '-')}"
                said += (
                    [option]
                    if value is True
                    else [option, f"{value:g}" if isinstance(value, float) else str(value)]
                )
        return said


def epoch() -> int:
    """The number of the present half minute, which the latched value of every robot says."""
    return int(time.time()) // EPOCH_S
