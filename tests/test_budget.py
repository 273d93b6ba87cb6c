"""Lines of code of each room, without docstrings, comments and blanks, against `[tool.fastrod.budget]`.

A room that grows by more than 2 % changes the table, in a commit of its own that says what it gives for that.
"""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WINGS = ("gym_envs", "viewer", "device", "scenes", "tests", "perf")
PAGES = {"README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "mkdocs.yml"}
# a docstring begins its line; other strings are code, in all their lines
TEXT = re.compile(
    r'(?P<doc>^[ \t]*[rR]?"""(?:\\.|[^\\])*?""")|"""(?:\\.|[^\\])*?"""'
    r"""|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|(?P<comment>\#[^\n]*)""",
    re.M | re.S,
)


def lines_of_code(source: str) -> int:
    bare = TEXT.sub(lambda m: "" if m["doc"] or m["comment"] else "x" + "\nx" * m[0].count("\n"), source)
    return sum(bool(line.strip()) for line in bare.splitlines())


def rooms() -> dict[str, int]:
    files = {"fastrod": (ROOT / "fastrod").glob("*.py")}
    for room in [*sorted((ROOT / "fastrod").glob("*/")), *(ROOT / name for name in WINGS)]:
        files[room.name] = room.rglob("*.py")
    counts = {name: sum(lines_of_code(p.read_text("utf-8")) for p in found) for name, found in files.items()}
    return {name: n for name, n in counts.items() if n}


def test_no_room_outgrows_its_budget() -> None:
    table = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["fastrod"]["budget"]
    assert {name: n for name, n in rooms().items() if n > 1.02 * table.get(name, 0)} == {}


def test_nothing_else_is_at_the_top() -> None:
    git = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if git.returncode:
        pytest.skip("no git repository")
    top = {line.partition("/")[0] for line in git.stdout.splitlines()}
    assert {name for name in top if not name.startswith(".")} == {*WINGS, *PAGES, "fastrod", "pyproject.toml"}


if __name__ == "__main__":
    print("\n".join(f"{name} = {n}" for name, n in rooms().items()))
