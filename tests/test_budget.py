"""Lines of code of each room, without docstrings, comments and blanks, against `[tool.fastrod.budget]`.

A room that grows by more than 2 % changes the table, in a commit of its own that says what it gives for that.
"""

import ast
import io
import tokenize
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
WINGS = ("gym_envs", "viewer", "device", "scenes", "tests", "perf")
BLANK = {getattr(tokenize, kind) for kind in ("COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER")}


def lines_of_code(source: str) -> int:
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    rows = {row for t in tokens if t.type not in BLANK for row in range(t.start[0], t.end[0] + 1)}
    for node in ast.walk(ast.parse(source)):  # a string alone is a docstring, of a field too
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str):
            rows -= set(range(node.lineno, node.end_lineno + 1))
    return len(rows)


def rooms() -> dict[str, int]:
    files = {"fastrod": (ROOT / "fastrod").glob("*.py")}
    for room in [*sorted((ROOT / "fastrod").glob("*/")), *(ROOT / name for name in WINGS)]:
        files[room.name] = room.rglob("*.py")
    counts = {name: sum(lines_of_code(p.read_text("utf-8")) for p in found) for name, found in files.items()}
    return {name: n for name, n in counts.items() if n}


def test_no_room_outgrows_its_budget() -> None:
    table = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["fastrod"]["budget"]
    assert {name: n for name, n in rooms().items() if n > 1.02 * table.get(name, 0)} == {}


if __name__ == "__main__":
    print("\n".join(f"{name} = {n}" for name, n in rooms().items()))
