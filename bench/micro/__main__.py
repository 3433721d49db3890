"""Runs a micro benchmark and prints its table.

    python -m bench.micro [NAME [--OPTION VALUE...]]

Without a name it lists all of them. A module here has a docstring, and a generator ``measure`` of rows, whose
parameters are the options. Figures of a row are the median, the 99th percentile and the largest.
"""

from __future__ import annotations

import argparse
import inspect
import json
import platform
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import zstate
from bench.micro.form import send_event

NAMES = sorted(
    path.stem for path in Path(__file__).parent.glob("*.py") if path.stem[0] != "_" and path.stem != "form"
)
WORKERS = ("lookup_buffers",)
"""Modules that run in the processes of another."""


def main(arguments: list[str]) -> None:
    """Lists, measures, or runs one role of a benchmark."""
    if not arguments or arguments[0] not in NAMES:
        for name in NAMES:
            if name not in WORKERS:
                print(f"{name:12} {documentation(name).splitlines()[0]}")
        return
    name, *others = arguments
    module = import_module(f"bench.micro.{name}")
    if others[:1] == ["--role"]:
        send_event("result", value=getattr(module, others[1])(**json.loads(others[2])))
        return
    options = vars(parser_of(name, module).parse_args(others))
    measure(name, module, options, options.pop("json"))


def documentation(name: str) -> str:
    """The docstring of a module, which is not imported: it may need more than is installed."""
    source = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    return source.split('"""')[1]


def parser_of(name: str, module: ModuleType) -> argparse.ArgumentParser:
    """The options of a benchmark, by the defaults of its ``measure``."""
    parser = argparse.ArgumentParser(
        prog=f"python -m bench.micro {name}",
        description=module.__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--json", type=Path, help="append the rows to this file")
    for option in inspect.signature(module.measure).parameters.values():
        several = isinstance(option.default, tuple)
        kind = type(option.default[0] if several else option.default)
        flag = f"--{option.name.replace('_', '-')}"
        parser.add_argument(flag, type=kind, default=option.default, nargs="+" if several else None)
    return parser


def measure(name: str, module: ModuleType, options: dict[str, object], path: Path | None) -> None:
    """Prints the table, and appends its rows to ``path``."""
    print(f"zstate {zstate.__version__} ({zstate.kernel}), Python {platform.python_version()}, ", end="")
    print(f"{platform.machine()}: {name}")
    print(f"{'':62}{'median':>10}{'p99':>10}{'largest':>10}  {'':12}{'times':>7}")
    for row in module.measure(**options):
        facts = row.facts()
        numbers = "".join(f"{facts[one]:10.4g}" for one in ("median", "p99", "most"))
        times = "" if facts["times"] is None else f"{facts['times']:7.3g}"
        print(f"{row.what:62}{numbers}  {row.unit:12}{times}", flush=True)
        if path is not None:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"program": name, **facts}) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
