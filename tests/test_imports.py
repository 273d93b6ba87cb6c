"""No module imports itself through others, not even by an import inside a function."""

from __future__ import annotations

import subprocess
import sys

import grimp
import pytest

PACKAGES = ("fastrod", "fastrod_device", "fastrod_envs", "fastrod_scenes", "fastrod_viewer")


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph(*PACKAGES, include_external_packages=False, cache_dir=None)


def cycles(graph: grimp.ImportGraph) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan 1972)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        number[module] = low[module] = len(number)
        stack.append(module)
        for other in sorted(graph.find_modules_directly_imported_by(module)):
            if other not in number:
                visit(other)
                low[module] = min(low[module], low[other])
            elif other in stack:
                low[module] = min(low[module], number[other])
        if low[module] == number[module]:
            together = [stack.pop()]
            while together[-1] != module:
                together.append(stack.pop())
            if len(together) > 1:
                found.append(sorted(together))

    for module in sorted(graph.modules):
        if module not in number:
            visit(module)
    return found


def test_no_imports_go_round(graph: grimp.ImportGraph) -> None:
    assert cycles(graph) == []


def test_an_import_inside_a_function_is_one(graph: grimp.ImportGraph) -> None:
    assert "fastrod_viewer.worlds.hosted" in graph.find_modules_directly_imported_by(
        "fastrod_viewer.worlds.catalogue"
    )


@pytest.mark.study
def test_a_plain_simulator_needs_neither_contact_nor_modes() -> None:
    code = (
        "import sys, fastrod; robot = fastrod.load_robot('prototype'); "
        "fastrod.Simulator(robot).settle(); print(*(m for m in sys.modules if m.startswith('fastrod')))"
    )
    words = [sys.executable, "-c", code]
    loaded = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()
    assert [name for name in loaded if ".contact" in name or ".modal" in name] == []
    assert len(loaded) <= 55


def test_a_circle_is_found() -> None:
    graph = grimp.ImportGraph()
    for name in "abcd":
        graph.add_module(name)
    for importer, imported in ("ab", "bc", "ca", "cd"):
        graph.add_import(importer=importer, imported=imported)
    assert cycles(graph) == [["a", "b", "c"]]
