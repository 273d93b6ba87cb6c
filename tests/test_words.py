"""One thing has one name: words that the code has given up stay out of its identifiers, and a public class
name stands for one class of the wheel."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from wheel import PACKAGES, ROOT, sources

GONE: dict[str, str] = {
    "wire wires wired": "tendon",
    "reach reaches": "length, tendon offset, limit or workspace",
    "slot slots": "contact, contact set",
    "probes": "contact points, point loads",
    "strand strands": "rod proximity, line",
    "placing placed": "node placement, with positions",
    "touch touches": "contact",
    "mobile": "mobility",
    "stride": "step limit, step",
    "scenery": "scene arrays",
    "loosen": "release slack tendons",
    "feed carry": "predict, propagate",
    "foil foils": "alternative patterns",
    "audit": "residual structure test",
    "evidence judge opinion": "model selection, verdict",
    "hand hands": "command",
    "pilot pilots": "teleop, driver",
    "knob knobs": "control",
    "grip grips": "drag handle, grasp",
    "foot feet": "base",
    "turn turns": "rotation, angle, orientation",
    "way ways": "displacement, direction, path",
    "part parts": "fraction, piece, section",
    "share shares": "fraction",
    "told tell tells": "reported, stated, reports",
    "asked": "requested, evaluated",
    "led": "continued",
    "mend mends": "fix, correct",
}
"""Words, as the whole or as one word of an identifier, and what to say instead."""
ALLOWED: dict[str, str] = {
    # another library's names, or those of the paper's public code
    "fastrod/access.py": "ShareUrlRequest ShareUrlDisconnect",
    "fastrod/hosts/softmanisim.py": "in_hand_camera in_hand_camera_capture_image",
    "fastrod/logs/linefile.py": "tell",
    "viewer/fastrod_viewer/app.py": "show_share_button",
    "viewer/fastrod_viewer/drive/page.py": "HAND_STOP",
    "viewer/fastrod_viewer/export.py": "feed",
    "viewer/fastrod_viewer/server.py": "FileTransferPart",
    "fastrod/identification/log/noise.py": "stride_tricks",
    "gym_envs/fastrod_envs/page.py": "show_share_button",
    "device/fastrod_device/emulator/seal.py": "__slots__",
    "fastrod/errors.py": "__slots__",
    # a motor's counts, a bench that can be turned: the field's words
    "device/fastrod_device/can/configuring.py": "counts_per_turn",
    "device/fastrod_device/can/inbox.py": "counts_per_turn",
    "device/fastrod_device/emulator/motor.py": "counts_per_turn",
    "device/fastrod_device/units.py": "counts_per_turn",
    "device/fastrod_device/bench/loop.py": "turn",
    "fastrod/identification/excite.py": "turn",
    # a file's method
    "device/fastrod_device/journal.py": "tell",
    "gym_envs/fastrod_envs/learning/arrays.py": "tell",
    # names in reports, of options of environments and in policies that were trained
    "device/fastrod_device/bench/report.py": "cannot_be_told_from",
    "fastrod/identification/report/assemble.py": "cannot_be_told_from evidence",
    "fastrod/identification/report/motion.py": "cannot_be_told_from evidence",
    "fastrod/identification/report/page.py": "cannot_be_told_from evidence",
    "fastrod/identification/report/report.py": "cannot_be_told_from evidence",
    "fastrod/identification/report/result.py": "cannot_be_told_from evidence",
    "gym_envs/fastrod_envs/learning/actor.py": "reach",
    "gym_envs/fastrod_envs/sb3.py": "reach",
    "gym_envs/fastrod_envs/tasks/pick_place.py": "Grip grip",
    "gym_envs/fastrod_envs/tasks/reach.py": "Reach ReachOptions ReachRewardOptions ReachTask",
    "gym_envs/fastrod_envs/tasks/reach_obstacle.py": "reach ReachObstacle ReachTask",
}
"""Identifiers that stay, by file."""
INSTEAD = {word: instead for words, instead in GONE.items() for word in words.split()}


def identifiers(text: str) -> Iterator[tuple[int, str]]:
    """Line and name of every identifier, those in the expressions of f-strings among them: a tokenizer before
    Python 3.12 takes an f-string for one string."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME:
            yield token.start[0], token.string
    for string in ast.walk(ast.parse(text)):
        if isinstance(string, ast.JoinedStr):
            for node in ast.walk(string):
                if isinstance(name := getattr(node, "id", getattr(node, "attr", None)), str):
                    yield string.lineno, name


def words_of(name: str) -> list[str]:
    """Words of an identifier in lower case.

    >>> words_of("_LAST_touchPoint2")
    ['last', 'touch', 'point']
    """
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


@pytest.mark.study
@pytest.mark.parametrize("file", sources(*PACKAGES), ids=lambda file: str(file.relative_to(ROOT)))
def test_no_identifier_has_a_word_that_is_gone(file: Path) -> None:
    allowed = ALLOWED.get(file.relative_to(ROOT).as_posix(), "").split()
    found = {
        f"line {line}: {name}; say {INSTEAD[word]}"
        for line, name in identifiers(file.read_text(encoding="utf-8"))
        if name not in allowed
        for word in words_of(name)
        if word in INSTEAD
    }
    assert sorted(found) == []


def test_what_is_allowed_is_there() -> None:
    for file, names in ALLOWED.items():
        there = {name for _, name in identifiers((ROOT / file).read_text(encoding="utf-8"))}
        assert set(names.split()) <= there, file


def test_no_file_is_called_by_a_word_that_is_gone() -> None:
    named = {str(file.relative_to(ROOT)): words_of(file.stem) for file in sources(*PACKAGES)}
    gone = INSTEAD.keys() - {"reach"}  # Reach is an environment's id
    assert [file for file, words in named.items() if gone & set(words)] == []


def test_names_in_the_expressions_of_f_strings_are_seen() -> None:
    seen = [name for _, name in identifiers('f"the way {robot.reach:.{n_parts}f} {told!r}"')]
    assert {"robot", "reach", "n_parts", "told"} <= set(seen)
    assert "way" not in seen


@pytest.mark.study
def test_a_docstring_begins_with_a_verb_or_names_the_thing() -> None:
    found = []
    for file in sources(*PACKAGES):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            # strings that stand alone: docstrings, and those below attributes
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                text = str(node.value.value)
                if re.match(r"\s*(What|Where|How|Who|Of|As|From)\b", text):
                    found.append(f"{file.relative_to(ROOT)}:{node.lineno}: {text[:40]}")
    assert found == []


@pytest.mark.study
def test_a_public_class_name_stands_for_one_class() -> None:
    places = defaultdict(list)
    for file in sources(*PACKAGES):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(str(file.relative_to(ROOT)))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}
