"""`fastrod --help`: the commands in the order of what one wants to do."""

from __future__ import annotations

from collections.abc import Mapping

GROUPS: Mapping[str, tuple[str, ...]] = {
    "look": ("demo", "view"),
    "your robot and your log": ("new", "check", "import", "export"),
    "measure and explain": ("excite", "drive", "identify", "replay"),
    "learn": ("envs", "train", "evaluate"),
    "scale and compare": ("generate", "bench", "warmup"),
}
"""Every command once."""
_EXAMPLES = (
    ("fastrod demo", "excite, identify, plan anew, track, on an emulated robot"),
    ("fastrod view", "a robot in the browser: drag its tip"),
    ("fastrod identify run.csv --robot mine.toml", "what the model lacks, in run_identified/report.html"),
    ("fastrod train Reach --out mine", "a policy; then fastrod evaluate Reach mine"),
)


def overview(helps: Mapping[str, str]) -> str:
    """The whole text, from the one-line help of each command."""
    lines = [
        "usage: fastrod COMMAND [...]",
        "",
        "Tendon-driven continuum robots, simulated in batches and met with measured data.",
    ]
    for title, names in GROUPS.items():
        lines += ["", f"{title}:", *(f"  {name:<10}{helps[name]}" for name in names)]
    width = max(len(line) for line, _ in _EXAMPLES)
    lines += ["", "examples:", *(f"  {line:<{width}}  {what}" for line, what in _EXAMPLES)]
    lines += [
        "",
        "`fastrod COMMAND --help` lists all options of one; `fastrod --version` prints the version.",
        "",
    ]
    return "\n".join(lines)
