"""Cost of each test, in CPU seconds of the process and of its children: a pytest plugin.

`@pytest.mark.study` marks a function that is too dear for every check, `@pytest.mark.study(beyond=n)` all its
cases but the first n. A function that is not marked and costs more than `MOST`, all its cases together, fails
the run. CPU time is counted, so that a busy machine does not matter; compiling and importing are not. A
second of a slow core is worth less (`pace`).
"""

from __future__ import annotations

import builtins
import json
import os
import resource
import time
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

import numba
import pytest
from numba.core import event

MOST = 1.5  # CPU s: caps 195 functions of 2,400, which were half of all that the tests cost
PACE = 0.0055  # CPU s of `pace` on an EPYC at 2.4 GHz that nobody else uses
TOO_DEAR = 13
"""Exit code of a run in which nothing failed but a cost."""
QUICK = 0.3  # CPU s: 4,898 of 5,616 cases cost less, and 144 s together
COSTS = Path(__file__).with_name("costs.json")
"""CPU seconds of the functions above `QUICK`; `tests/check.py costs` writes it."""
_ALTERED = (numba.config.DISABLE_JIT, numba.config.BOUNDSCHECK, numba.config.ENABLE_CUDASIM)


def cpu_seconds() -> float:
    """CPU seconds of this process and of the children that it has waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def pace() -> float:
    """CPU s of the same arithmetic on any machine: more where the core is slower, or shares its units with
    another that works."""
    begun = time.thread_time()
    sum(i * i for i in range(100_000))
    return time.thread_time() - begun


class Once(event.Listener):
    """CPU seconds of what a process does once, whichever test comes first: importing, and compiling kernels
    or reading them from the cache (numba does both under its lock)."""

    def __init__(self) -> None:
        self.spent, self._depth, self._begun = 0.0, 0, 0.0
        self._import = builtins.__import__
        builtins.__import__ = self._imported
        event.register("numba:compiler_lock", self)

    def on_start(self, what: Any) -> None:
        """Note the start of the outermost import or compilation."""
        if self._depth == 0:
            self._begun = cpu_seconds()
        self._depth += 1

    def on_end(self, what: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.spent += cpu_seconds() - self._begun

    def _imported(self, *given: Any, **named: Any) -> Any:
        self.on_start(None)
        try:
            return self._import(*given, **named)
        finally:
            self.on_end(None)


class Cost:
    """The plugin. Which cases are studies is decided where they are collected; what they cost is measured
    where they run, and summed up in the process that reports."""

    def __init__(self, config: pytest.Config, once: Once) -> None:
        self._config, self._once, self._begun, self._n_cases = config, once, 0.0, 0
        self.spent: Counter[str] = Counter()
        self.paces: list[float] = []

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Take the mark from the first cases of a study that says `beyond`; leave out what is not quick."""
        seen: Counter[str] = Counter()
        for item in items:
            mark = item.get_closest_marker("study")
            if mark is not None and seen[name_of(item.nodeid)] < mark.kwargs.get("beyond", 0):
                item.own_markers = [one for one in item.own_markers if one.name != "study"]
            seen[name_of(item.nodeid)] += 1
        if self._config.getoption("--quick"):
            dear = json.loads(COSTS.read_text(encoding="utf-8"))
            left_out = [item for item in items if name_of(item.nodeid) in dear]
            items[:] = [item for item in items if name_of(item.nodeid) not in dear]
            self._config.hook.pytest_deselected(items=left_out)

    def _now(self) -> float:
        return cpu_seconds() - self._once.spent

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self) -> None:
        self._begun = self._now()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]) -> None:
        """Give the report of the call its cost, the fixtures' included, and whether it is a study. What is
        torn down after it may be shared, a browser say."""
        if call.when == "call":
            if self._n_cases % 25 == 0:
                item.user_properties.append(("pace", pace()))
            self._n_cases += 1
            study = item.get_closest_marker("study") is not None
            item.user_properties.append(("cost", (self._now() - self._begun, study)))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add to the cost of the function; a function is dear by those cases that are not studies."""
        for name, value in report.user_properties:
            if name == "pace" and report.when == "call":
                self.paces.append(value)
            if name == "cost" and report.when == "call":
                seconds, study = value
                self.spent[f"study {name_of(report.nodeid)}" if study else name_of(report.nodeid)] += seconds

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the costs where `tests/check.py` asks for them; fail for a dear function without the mark."""
        if hasattr(self._config, "workerinput"):
            return
        if where := os.environ.get("FASTROD_TEST_COSTS"):
            Path(where).write_text(json.dumps(self.spent), encoding="utf-8")
        if self.too_dear() and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = TOO_DEAR

    def most(self) -> float:
        """`MOST` CPU seconds at `PACE`, or as many more as this machine was slower while the tests ran."""
        return MOST * max(1.0, median(self.paces) / PACE) if self.paces else MOST

    def too_dear(self) -> dict[str, float]:
        """Functions that cost more than `most` and are not marked; none where the kernels are not compiled as
        they are for a user."""
        return {
            name: spent
            for name, spent in self.spent.most_common()
            if spent > self.most() and not name.startswith("study ") and not any(_ALTERED)
        }

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Name what is too dear."""
        for name, spent in self.too_dear().items():
            terminalreporter.write_line(
                f"TOO DEAR {name}: {spent:.1f} CPU s, more than {self.most():.1f}; make it cheaper, or mark "
                "it @pytest.mark.study(beyond=n): its cases beyond the first n run in `check.py studies`."
            )


def name_of(nodeid: str) -> str:
    """The function of a case."""
    return nodeid.partition("[")[0]
