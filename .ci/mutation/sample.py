"""``sample.py SESSION COUNT``: keeps COUNT random mutants of a session, in proportion over the modules.

Dropped are mutations inside annotations (no module evaluates them) and of ``if TYPE_CHECKING``, mutants that
do not compile, and mutants equal to the original or to another one.
"""

import ast
import random
import sqlite3
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

Place = tuple[int, int]


class _Untyped(ast.NodeTransformer):
    def visit(self, node: ast.AST) -> ast.AST:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            return ast.Pass()
        for field in {"annotation", "returns"} & set(node._fields):
            setattr(node, field, None)
        return self.generic_visit(node)


def behaviour(code: str) -> str | None:
    """What runs of ``code``, as text of its tree; None if it does not compile."""
    try:
        return ast.dump(_Untyped().visit(ast.parse(code)))
    except SyntaxError:
        return None


@cache
def source(path: str) -> str:
    """The text of a module."""
    return Path(path).read_text(encoding="utf-8")


@cache
def typed_ranges(path: str) -> list[tuple[Place, Place]]:
    """Start and end of annotations and of ``if TYPE_CHECKING``, as lines and characters."""
    lines, found = source(path).splitlines(), list[ast.expr | ast.stmt]()
    for node in ast.walk(ast.parse(source(path))):
        found += [one for one in (getattr(node, "annotation", None), getattr(node, "returns", None)) if one]
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            found.append(node)

    def place(line: int, column: int) -> Place:
        return line, len(lines[line - 1].encode()[:column].decode())

    return [(place(n.lineno, n.col_offset), place(n.end_lineno or 0, n.end_col_offset or 0)) for n in found]


def main(session_path: str, count: int) -> None:
    """Delete all other mutants from the session."""
    session = sqlite3.connect(session_path)
    columns = "module_path, operator_name, occurrence, start_pos_row, start_pos_col, job_id"
    specs: dict[str, list[tuple[str, int, str]]] = defaultdict(list)
    for path, operator, occurrence, row, column, job in session.execute(
        f"SELECT {columns} FROM mutation_specs ORDER BY 1, 2, 3"
    ):
        if not any(start <= (row, column) < end for start, end in typed_ranges(path)):
            specs[path].append((operator, occurrence, job))
    shares = {path: len(found) * count / sum(map(len, specs.values())) for path, found in specs.items()}
    quota = {path: int(share) for path, share in shares.items()}
    by_rest = sorted(shares, key=lambda path: quota[path] - shares[path])
    for path in by_rest[: count - sum(quota.values())]:
        quota[path] += 1
    chance, kept = random.Random(30), set[str]()
    for path, found in specs.items():
        seen = {None, behaviour(source(path))}
        chosen = 0
        for operator, occurrence, job in chance.sample(found, len(found)):
            if chosen == quota[path]:
                break
            result = behaviour(mutate_code(source(path), get_operator(operator)(), occurrence))
            if result not in seen:
                seen.add(result)
                kept.add(job)
                chosen += 1
    dropped = [(job,) for (job,) in session.execute("SELECT job_id FROM work_items") if job not in kept]
    for table in ("mutation_specs", "work_items"):
        session.executemany(f"DELETE FROM {table} WHERE job_id = ?", dropped)
    session.commit()
    print(f"{len(kept)} of {len(kept) + len(dropped)} mutants are kept")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
