"""The one door: every check that the project has, in order, stopping at the first that fails.

python tests/check.py            all of it
python tests/check.py lint       only the checks with this name
"""

from __future__ import annotations

import os
import subprocess
import sys
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
    # Threads that spin while they wait take the core from those they wait for: a training takes eight times as long on two busy cores.
    ("tests", ["pytest", "-n", "2", "--dist", "loadfile", "-m", "not real_time"], {"OMP_WAIT_POLICY": "passive"}),
    ("real time", ["pytest", "-m", "real_time"], {"OMP_WAIT_POLICY": "passive"}),
    # The kernels as a GPU would run them, one thread a robot, on numba's simulator of one.
    ("gpu", ["pytest", "tests/gpu"], {"NUMBA_ENABLE_CUDASIM": "1"}),
    # The kernels once more as plain Python: what the compiler might hide, and the lines that it hides from coverage.
    ("plain python", ["pytest", "tests/plain"], {"NUMBA_DISABLE_JIT": "1"}),
    # And with every index checked: a compiled kernel does not notice that it reads beyond its scratch.
    (
        "bounds",
        ["pytest", "tests/plain"],
        {"NUMBA_BOUNDSCHECK": "1", "FASTROD_CACHE_DIR": str(ROOT / ".pytest_cache" / "bounds")},
    ),
]


def main() -> int:
    wanted = sys.argv[1:]
    for name, command, extra in CHECKS:
        if wanted and name not in wanted:
            continue
        print(f"== {name}: {' '.join(command)}", flush=True)
        code = subprocess.run([BIN / command[0], *command[1:]], cwd=ROOT, env={**os.environ, **extra}).returncode
        if code:
            print(f"== {name} failed", flush=True)
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main())
