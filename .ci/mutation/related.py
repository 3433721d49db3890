"""Runs the tests that execute the mutated line, cheapest first, up to a budget; status 0 if they pass.

That line is in ``git diff``. Which test executes which line is measured before, without a mutation:
``../mutation.coverage`` and ``../mutation.durations``, see docs/contributing.md. A line that runs at import
belongs to the tests that execute what it defines: the body of a function or class, or lines with the name
of a constant or field; then to those of the module, ``tests/<folder>/test_<module>*.py``, and of the folder.
"""

import ast
import json
import os
import re
import resource
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import pytest
from coverage.numbits import num_in_numbits

BUDGET_S = float(os.environ.get("BUDGET_S", "10"))
"""Of processor time, as measured with coverage."""
MOST_TESTS = int(os.environ.get("MOST_TESTS", "250"))

_OPTIONS = ("-x", "-q", "-n0", "--tb=line", "--timeout=300", "-pno:cacheprovider", "-pno:pytest_cov")


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], capture_output=True, text=True, check=True).stdout


def _costs() -> dict[str, float]:
    lines = Path("../mutation.durations").read_text().splitlines()
    return dict(json.loads(line) for line in lines)


class _Coverage:
    def __init__(self, tests: Iterable[str]) -> None:
        self._tests = set(tests)
        self._data = sqlite3.connect("file:../mutation.coverage?mode=ro", uri=True)
        self._data.create_function("has", 2, num_in_numbits)

    def touching(self, module: str, lines: Iterable[int]) -> set[str]:
        """The tests that execute one of these lines."""
        of_line = " OR ".join(f"has({line}, numbits)" for line in lines) or "0"
        query = (
            "SELECT DISTINCT context FROM line_bits JOIN context ON context.id = context_id"
            f" JOIN file ON file.id = file_id WHERE path LIKE ? AND ({of_line})"
        )
        found = self._data.execute(query, [f"%/{module}"])
        return {context.rpartition("|")[0] for (context,) in found} & self._tests

    def using(self, name: str) -> set[str]:
        """The tests that execute a line of any module which has this name."""
        found = set[str]()
        for module in Path("zstate").rglob("*.py"):
            text = module.read_text(encoding="utf-8").splitlines()
            lines = [number for number, line in enumerate(text, 1) if re.search(rf"\b{name}\b", line)]
            found |= self.touching(str(module), lines[:200]) if lines else set()
        return found


def _header(node: ast.stmt | ast.ExceptHandler) -> range:
    """The lines of a statement, without those of its body."""
    start = min(one.lineno for one in (node, *getattr(node, "decorator_list", ())))
    body = getattr(node, "body", None)
    return range(start, max(start, body[0].lineno - 1 if body else node.end_lineno or start) + 1)


def related(module: str, line: int, code: str, costs: dict[str, float]) -> list[str]:
    """The tests for a mutation in this line of ``code``, the cheapest first."""
    coverage = _Coverage(costs)
    statements = [
        node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.stmt | ast.ExceptHandler)
    ]
    around = [node for node in statements if line in _header(node)]
    node = min(around, key=lambda one: len(_header(one)), default=None)  # None: the line of a case
    executing = coverage.touching(module, [line] if node is None else {line, *_header(node)})
    groups = [coverage.touching(module, [line]) or executing]
    of_module = f"tests/{Path(module).relative_to('zstate').with_suffix('').parent}/test_{Path(module).stem}"
    files = {test.partition("::")[0] for test in executing}
    if executing:
        groups.append(
            {test for test in costs if test.startswith(of_module) and test.partition("::")[0] in files}
        )
    else:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            groups.append(coverage.touching(module, range(node.body[0].lineno, (node.end_lineno or 0) + 1)))
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = {one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)}
            groups += map(coverage.using, sorted(names))
        groups.append({test for test in costs if test.startswith(of_module)})
        groups.append({test for test in costs if test.startswith(f"{Path(of_module).parent}/")})
    chosen, spent_s = list[str](), 0.0
    for group in groups:
        for test in sorted(group - set(chosen), key=lambda test: costs[test]):
            if len(chosen) == MOST_TESTS or (chosen and spent_s + costs[test] > BUDGET_S):
                break
            chosen.append(test)
            spent_s += costs[test]
    print(f"{module}:{line}: {len(chosen)} of {len(set().union(*groups))} tests, {spent_s:.1f} s", flush=True)
    return chosen


def main() -> int:
    """The status of pytest; 0 without tests, as then the mutant survives."""
    diff = _git("diff", "-U0", "--", "zstate")
    module = re.findall(r"^--- a/(.*)$", diff, re.MULTILINE)[0]
    line = int(re.findall(r"^@@ -(\d+)", diff, re.MULTILINE)[0])
    tests = related(module, line, _git("show", f"HEAD:{module}"), _costs())
    resource.setrlimit(resource.RLIMIT_CPU, (40, 45))
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("\n".join(tests))
        file.flush()
        return int(pytest.main([*_OPTIONS, f"@{file.name}"])) if tests else 0


if __name__ == "__main__":
    sys.path.insert(0, "")
    sys.exit(main())
