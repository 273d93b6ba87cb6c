"""The one door: every check that the project has, in order, ending at the first that fails.

python tests/check.py            all of it
python tests/check.py lint       only the checks with this name
"""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent

CHECKS: list[tuple[str, list[str], dict[str, str]]] = [
    ("lint", ["ruff", "check", "."], {}),
    ("format", ["ruff", "format", "--check", "."], {}),
    ("types", ["mypy"], {}),
    ("imports", ["lint-imports"], {}),
    # Once, and side by side: otherwise every process of the tests compiles the same kernels.
    ("kernels", ["python", "tests/kernels.py"], {}),
    # Threads that spin while they wait take the core from those they wait for: a training takes eight times
    # as long on two busy cores.
    (
        "tests",
        ["pytest", "-n", "2", "--dist", "loadfile", "-m", "not real_time"],
        {"OMP_WAIT_POLICY": "passive"},
    ),
    ("real time", ["pytest", "-m", "real_time"], {"OMP_WAIT_POLICY": "passive"}),
    # The kernels as a GPU would run them, one thread a robot, on numba's simulator of one.
    ("gpu", ["pytest", "tests/gpu"], {"NUMBA_ENABLE_CUDASIM": "1"}),
    # The kernels once more as plain Python: what the compiler might hide, and the lines that it hides from
    # coverage.
    ("plain python", ["pytest", "tests/plain"], {"NUMBA_DISABLE_JIT": "1"}),
    # And with every index checked: a compiled kernel does not notice that it reads beyond its scratch.
    (
        "bounds",
        ["pytest", "tests/plain"],
        {"NUMBA_BOUNDSCHECK": "1", "FASTROD_CACHE_DIR": str(ROOT / ".pytest_cache" / "bounds")},
    ),
]


ASIDE = ("gpu", "plain python", "bounds")
"""One thread each: run side by side, two at a time."""


def run(command: list[str], extra: dict[str, str], *, quiet: bool = False) -> tuple[int, str]:
    """Exit code, and with `quiet` what was printed."""
    kept = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True} if quiet else {}
    done = subprocess.run([BIN / command[0], *command[1:]], cwd=ROOT, env={**os.environ, **extra}, **kept)
    return done.returncode, done.stdout or ""


def main() -> int:
    wanted = sys.argv[1:]
    chosen = [check for check in CHECKS if not wanted or check[0] in wanted]
    for name, command, extra in chosen:
        if name not in ASIDE:
            print(f"== {name}: {' '.join(command)}", flush=True)
            if code := run(command, extra)[0]:
                print(f"== {name} failed", flush=True)
                return code
    aside = [check for check in chosen if check[0] in ASIDE]
    with ThreadPoolExecutor(2) as pool:
        answers = pool.map(lambda check: run(check[1], check[2], quiet=True), aside)
        for (name, command, _), (code, said) in zip(aside, answers, strict=True):
            print(f"== {name}: {' '.join(command)}\n{said}", flush=True)
            if code:
                print(f"== {name} failed", flush=True)
                return code
    return 0


if __name__ == "__main__":
    sys.exit(main())
