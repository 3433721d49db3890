"""Expansion of xacro to URDF by the ``xacrodoc`` or ``xacro`` package, in a process of its own with limits.

The expressions in a file are Python, which xacro restricts: they read other files, and may take any time and
memory. So the process ends after 30 s of CPU, 60 s in all, or 2 GiB of memory (not limited on macOS, whose
kernel has no such limit), and returns no more text than a URDF may have.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from zstate._util.format import did_you_mean
from zstate.model.findings import Finding, model_error
from zstate.model.xml import MAX_BYTES

_CPU_S = 30
_WITHIN_S = 60.0
_MEMORY_BYTES = 2 << 30
_MISSING = "this is a xacro file, which must be expanded: pip install 'zstate[xacro]'"
_TOO_SLOW = f"its expansion has taken {_WITHIN_S:g} s, which is the limit"
_TOO_LONG = f"its expansion takes more than {_CPU_S} s of CPU, which is the limit"
_TOO_MUCH = f"its expansion has more than {MAX_BYTES} characters, which is the limit"
_TOO_LARGE = f"its expansion needs more than {_MEMORY_BYTES >> 30} GiB of memory, which is the limit"
# Isolated (-I): neither the folder it runs in nor the environment adds modules; those of this process do.
_PROGRAM = """
import json, sys
request = json.load(sys.stdin)
sys.path[:] = request.pop("modules")
from zstate.model.xacro_expansion import answer_request
answer_request(**request)
"""


def expand_xacro(
    text: str, source: str, path: Path | None, args: Mapping[str, str]
) -> tuple[str, tuple[Finding, ...]]:
    """The URDF that ``text`` expands to with the xacro arguments ``args``, and xacro's warnings.

    Each distinct warning is one finding, and so is an argument that the file does not use. ``path`` is the
    file of the text, if there is one: includes are relative to it, and packages are searched from there
    upwards (with xacrodoc) or where ROS has them. Raises ModelError with the cause in one line.
    """
    request = {
        "modules": sys.path,
        "text": text,
        "path": None if path is None else os.fspath(path),
        "args": dict(args),
    }
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-c", _PROGRAM],
            input=json.dumps(request).encode(),
            stdout=subprocess.PIPE,
            timeout=_WITHIN_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise model_error(source, _TOO_SLOW) from None
    if done.returncode == -signal.SIGXCPU:
        raise model_error(source, _TOO_LONG)
    try:
        answer: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        ended = f"the process of its expansion ended with {done.returncode}"
        raise model_error(source, f"xacro could not expand it: {ended}") from None
    if answer["failure"]:
        raise model_error(source, answer["failure"])
    messages = [
        f"xacro: {text}{f', {count} times' if count > 1 else ''}"
        for text, count in answer["warnings"].items()
    ]
    messages += [
        f"the xacro argument {name!r} is not used by the file{did_you_mean(name, answer['used'])}"
        for name in args
        if name not in answer["used"]
    ]
    return answer["urdf"], tuple(Finding(None, message, "warning") for message in messages)


def answer_request(text: str, path: str | None, args: dict[str, str]) -> None:
    """Expand ``text`` under the limits and write the result to standard output, as JSON.

    The main function of the process. What the file prints goes to standard error.
    """
    output = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    _limit(resource.RLIMIT_CPU, _CPU_S)
    _limit(resource.RLIMIT_AS, _MEMORY_BYTES)
    used = _XacroArguments(args)
    urdf, failure = "", ""
    warnings: Counter[str] = Counter()
    try:
        import_module("xacro")
    except ImportError:
        failure = _MISSING
    try:
        urdf = "" if failure else _expand(text, path, used, warnings)
    except Exception as error:  # the file's own expressions may raise anything
        cause = " ".join(str(error).split()) or type(error).__name__
        hint = ""
        if "package" in cause.lower() or "PackageNotFound" in type(error).__name__:
            hint = "; packages are found by ROS_PACKAGE_PATH, a sourced ROS, or a package.xml above the file"
        failure = _TOO_LARGE if _is_of_memory(error) else f"xacro could not expand it: {cause[:500]}{hint}"
    if len(urdf) + sum(map(len, (*warnings, *used.used))) > MAX_BYTES:
        # The process that waits for the answer reads all of it.
        urdf, failure, warnings, used.used = "", _TOO_MUCH, Counter[str](), {}
    answer = {"urdf": urdf, "failure": failure, "warnings": warnings, "used": list(used.used)}
    with os.fdopen(output, "w", encoding="ascii") as file:
        json.dump(answer, file)


def _is_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or the one that it was raised for, is a lack of memory."""
    while error is not None and not isinstance(error, MemoryError):
        error = error.__cause__ or error.__context__
    return error is not None


def _limit(kind: int, amount: int) -> None:
    """Lower a limit of this process, if the platform has it."""
    _, highest = resource.getrlimit(kind)
    with suppress(ValueError, OSError):
        resource.setrlimit(kind, (amount if highest < 0 else min(amount, highest), highest))


def _expand(text: str, path: str | None, arguments: _XacroArguments, warnings: Counter[str]) -> str:
    with suppress(ImportError):
        xacrodoc = import_module("xacrodoc")  # replaces xacro's search for packages, which needs ROS
        if path is not None:
            xacrodoc.packages.walk_up_from(Path(path))
    xacro: Any = import_module("xacro")
    xacro.init_stacks(path)  # the base of includes
    document = xacro.parse(text)
    with _count_warnings(xacro, warnings):
        xacro.process_doc(document, mappings=arguments, verbosity=0)
    return document.toprettyxml(indent="  ")


class _XacroArguments(dict[str, str]):
    """Xacro's arguments; ``used`` has those that the file has declared or read."""

    def __init__(self, args: Mapping[str, str]) -> None:
        super().__init__(args)
        self.used: dict[str, None] = {}

    def __contains__(self, name: object) -> bool:
        self.used[str(name)] = None
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.used[name] = None
        return super().__getitem__(name)


@contextmanager
def _count_warnings(xacro: Any, counts: Counter[str]) -> Generator[None]:
    """Counts xacro's warnings, which it prints to standard error with three lines for each use of a macro."""
    color: Any = import_module("xacro.color")

    def message(*parts: object, **options: Any) -> None:
        if not options.get("alt_text"):
            kept_message(*parts, **options)  # printed by the file itself with xacro.message()
            return
        file = next((name for name in reversed(xacro.filestack or []) if name), None)
        where = "" if file is None else f" ({Path(file).name})"
        counts[" ".join(f"{' '.join(map(str, parts))}{where}".split())] += 1

    def print_location(*_: object, **__: object) -> None:
        pass  # the warning names its file

    # All warnings, of xacro and of the expressions in a file, go through these two functions.
    kept_message, kept_location = color.message, xacro.print_location
    color.message, xacro.print_location = message, print_location
    try:
        yield
    finally:
        color.message, xacro.print_location = kept_message, kept_location
