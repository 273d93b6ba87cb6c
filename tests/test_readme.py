"""The pages do what they say: README.md and those in the folders."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

import fastrod_scenes

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path
    for path in ROOT.glob("**/README.md")
    if not any(part.startswith(".") for part in path.relative_to(ROOT).parts)
)
PAGES += [ROOT / "CONTRIBUTING.md"]
EXAMPLES = [
    pytest.param(code, output, id=f"{page.relative_to(ROOT).parent}-{k}")
    for page in PAGES
    for k, (code, output) in enumerate(
        re.findall(r"```python\n(.*?)```\n\n```\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S)
    )
]


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize(("code", "output"), EXAMPLES)
def test_the_example_prints_its_output(code: str, output: str) -> None:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "README.md", "exec"), {"__name__": "readme"})
    assert printed.getvalue() == output


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_to_a_file_leads_somewhere(page: Path) -> None:
    found = re.findall(r"\]\(([^)]*)\)", page.read_text(encoding="utf-8"))
    links = [link.partition("#")[0] for link in found]
    assert [link for link in links if link and "://" not in link and not (page.parent / link).exists()] == []


def test_ci_runs_the_test_line() -> None:
    lines = re.findall(r"^python3 -m venv.*$", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.M)
    assert len(lines) == 2
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert lines[1].replace("pip install", "pip install -q") in ci


def test_the_page_of_scenes_has_them_all() -> None:
    text = (ROOT / "scenes" / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (.*) \| ([\d.]+) s \|$", text, flags=re.M)
    scenes = [fastrod_scenes.load(name) for name in fastrod_scenes.names()]
    assert rows == [(scene.name, scene.about, f"{scene.duration:.1f}") for scene in scenes]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_on_a_page_is_one(page: Path) -> None:
    """Its words are understood; nothing of it is done."""
    from fastrod.commands.cli import parse

    blocks = re.findall(r"```\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S)
    commands = re.findall(r"^fastrod (.*)$", "\n".join(blocks), flags=re.M)
    lines = [line.partition("#")[0].split() for line in commands]
    unknown = [words for words in lines if parse(words)[1]]
    assert unknown == []
