"""The one door: the checks of the project, in three tiers.

python tests/check.py quick      after every change: ruff, mypy, the tests of at most 0.3 CPU seconds
python tests/check.py            the README's line: everything but the studies
python tests/check.py studies    the dear tests, those that are marked `study`
python tests/check.py costs      the tests, and what they cost into tests/costs.json, by which quick chooses
python tests/check.py NAME ...   only the jobs with these names
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from cost import COSTS, QUICK, TOO_DEAR

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
CORES = 2
# xdist waits for ever for what a worker that died had left
PARALLEL = ["-n", str(CORES), "--dist", "loadfile", "--max-worker-restart", "0"]
# Threads of torch and of numpy's BLAS that spin while they wait take the cores from those they wait for: a
# training takes eight times as long on two busy cores, and a test twice. Those of the kernels sleep by
# themselves, and what fastrod does with BLAS it does on one thread; what tests compute for comparison is not.
SLEEPY = {"OMP_WAIT_POLICY": "passive", "OPENBLAS_NUM_THREADS": "1"}


class Job(NamedTuple):
    """A command. One that takes both cores, or needs the machine for itself, runs alone, after the others."""

    name: str
    command: list[str]
    extra: dict[str, str]
    alone: bool = False


def tests(which: str, *more: str) -> Job:
    """The tests of these marks, on both cores."""
    return Job("tests", ["pytest", *PARALLEL, "-m", which, *more], SLEEPY, alone=True)


def real_time(which: str) -> Job:
    """The tests that need the machine for themselves; only their files are collected."""
    files = [
        str(path)
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if "mark.real_time" in path.read_text()
    ]
    return Job("real time", ["pytest", *files, "-m", which], SLEEPY, alone=True)


BOUNDS = {
    "NUMBA_BOUNDSCHECK": "1",
    "NUMBA_OPT": "0",  # a third of the time of the compiler; the checks are the same
    "FASTROD_CACHE_DIR": str(ROOT / ".pytest_cache" / "bounds"),
}
READING = [
    Job("types", ["mypy"], {}),
    Job("lint", ["ruff", "check", "."], {}),
    Job("format", ["ruff", "format", "--check", "."], {}),
    Job("imports", ["lint-imports"], {}),
]
# Ahead of the tests, once: otherwise every process of the tests compiles the same kernels.
KERNELS = [
    Job("kernels of rod and contact", ["fastrod", "warmup", "rod", "contact"], {"FASTROD_QUIET": "1"}),
    Job("kernels of modes", ["fastrod", "warmup", "modes"], {"FASTROD_QUIET": "1"}),
]
ALTERED = [
    # And with every index checked: a compiled kernel does not notice that it reads beyond its scratch.
    # Code that is not optimised keeps addresses, and numba warns that it caches none of it.
    Job("bounds", ["pytest", "tests/plain", "-W", "ignore:Cannot cache compiled function"], BOUNDS),
    # The kernels as plain Python: what the compiler might hide, and the lines that it hides from coverage.
    Job("plain python", ["pytest", "tests/plain"], {"NUMBA_DISABLE_JIT": "1"}),
    # The kernels as a GPU would run them, one thread a robot, on numba's simulator of one.
    Job("gpu", ["pytest", "tests/gpu"], {"NUMBA_ENABLE_CUDASIM": "1"}),
]
CHECK = "not study and not real_time"
TIERS = {
    "quick": [*READING, *KERNELS, tests(CHECK, "--quick")],
    "": [
        KERNELS[0],
        ALTERED[0],
        KERNELS[1],
        *READING,
        *ALTERED[1:],
        tests(CHECK),
        real_time("real_time and not study"),
    ],
    "studies": [*KERNELS, tests("study and not real_time"), real_time("study and real_time")],
    "costs": [*KERNELS, tests(CHECK)],
}
"""The jobs of each tier, the longest first."""


class Done(NamedTuple):
    """Result of a job."""

    job: Job
    code: int
    cpu: float
    wall: float
    tests: int


class Run:
    """Jobs on two cores; after the first that fails none is begun."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.done, self._printing = folder, list[Done](), threading.Lock()

    @property
    def failed(self) -> bool:
        """Whether a job has failed."""
        return any(done.code for done in self.done)

    def run(self, jobs: list[Job]) -> None:
        """Run what can be beside others in two queues, then what is to be alone."""
        left = [job for job in jobs if not job.alone]

        def work() -> None:
            while left and not self.failed:
                self.one(left.pop(0))

        workers = [threading.Thread(target=work) for _ in range(CORES)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        for job in jobs:
            if job.alone and not self.failed:
                self.one(job)

    def one(self, job: Job) -> None:
        """Run a job; what it prints is shown at once if it is alone, else when it has ended."""
        begun, said, title = time.monotonic(), b"", f"== {job.name}: {' '.join(job.command)}"
        environment = {**os.environ, "FASTROD_TEST_COSTS": str(self.folder / f"{job.name}.json"), **job.extra}
        if job.alone:
            print(title, flush=True)
        process = subprocess.Popen(
            [BIN / job.command[0], *job.command[1:]],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        assert process.stdout is not None
        while part := os.read(process.stdout.fileno(), 65536):
            said += part
            if job.alone:
                os.write(1, part)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = code = os.waitstatus_to_exitcode(status)
        counted = re.findall(r"^(\d+) passed", said.decode(errors="replace"), flags=re.M)
        wall = time.monotonic() - begun
        if code == TOO_DEAR and job.alone and not job.name.endswith("again"):
            # the lesser of two costs counts: whatever else a machine does, costs too
            names = re.findall(r"^TOO DEAR (\S+): ", said.decode(errors="replace"), flags=re.M)
            which = job.command[job.command.index("-m") : job.command.index("-m") + 2]
            self.one(job._replace(name=f"{job.name} again", command=["pytest", *names, *which]))
            code = 0
        with self._printing:
            if not job.alone:
                print(f"{title}\n{said.decode(errors='replace')}", flush=True)
            if code:
                print(f"== {job.name} failed", flush=True)
            self.done.append(
                Done(job, code, used.ru_utime + used.ru_stime, wall, int(counted[-1]) if counted else 0)
            )

    def costs(self) -> Counter[str]:
        """CPU seconds of the test functions."""
        every: Counter[str] = Counter()
        for path in self.folder.glob("*.json"):
            if path.stem in ("tests", "real time"):
                every.update(json.loads(path.read_text(encoding="utf-8")))
        return every

    def table(self, wall: float) -> str:
        """Return what each job took, and the ten dearest functions."""
        rows = [f"{'job':<28}{'CPU s':>8}{'wall s':>8}{'tests':>8}"]
        rows += [f"{d.job.name:<28}{d.cpu:8.0f}{d.wall:8.0f}{d.tests or '':>8}" for d in self.done]
        total = sum(d.cpu for d in self.done)
        rows += [f"{'all':<28}{total:8.0f}{wall:8.0f}{sum(d.tests for d in self.done) or '':>8}"]
        dearest = self.costs().most_common(10)
        rows += ["", "dearest functions, CPU s:"] if dearest else []
        return "\n".join(rows + [f"{seconds:8.1f}  {name}" for name, seconds in dearest])


def main() -> int:
    """The exit code."""
    wanted, begun = sys.argv[1:], time.monotonic()
    jobs = TIERS.get(wanted[0] if wanted else "", [])
    if not jobs:
        every = {job.name: job for job in TIERS[""]}
        if unknown := [name for name in wanted if name not in every]:
            print(
                f"no job {unknown[0]!r}; known: {', '.join([*filter(None, TIERS), *every])}.", file=sys.stderr
            )
            return 2
        jobs = [every[name] for name in wanted]
    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder))
        run.run(jobs)
        print(run.table(time.monotonic() - begun), flush=True)
        if wanted == ["costs"] and not run.failed:
            dear = {name: round(s, 2) for name, s in sorted(run.costs().items()) if s > QUICK}
            COSTS.write_text(json.dumps(dear, indent=0) + "\n", encoding="utf-8")
        return int(run.failed)


if __name__ == "__main__":
    sys.exit(main())
