"""Files from strangers: a slice of `python perf/fuzz_files.py`, and what it can only stumble on."""

from __future__ import annotations

import io
import json
import logging
import os
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'fastrod[envs]'")
pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'fastrod[parquet]'")
pytest.importorskip("can", reason="python-can is not installed (pip install 'fastrod[device]')")
sys.path.insert(0, str(Path(__file__).parent))

from fuzz_read import FINE, try_file, warm
from fuzz_seeds import KINDS, Originals, foreign, npz

from fastrod.commands.cli import main
from fastrod.contact import MeshLimits, mesh
from fastrod.contact.meshfile import read_mesh
from fastrod.errors import FastrodError, InputError, LogError, RobotError, UnknownNameError
from fastrod.logs.reader import read_log
from fastrod.model.robotfile import load_robot
from fastrod_device.hardware import SHIPPED, load_hardware
from fastrod_envs.learning.policies import Policy, find
from fastrod_scenes.measured import read


@pytest.fixture(scope="module")
def originals() -> Originals:
    return Originals()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, originals: Originals) -> Path:
    path = tmp_path_factory.mktemp("strangers")
    warm(path, originals)
    return path


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.study(beyond=6)
def test_a_damaged_file_is_read_right_or_refused_in_a_sentence(
    kind: str, folder: Path, originals: Originals
) -> None:
    first = KINDS.index(kind)
    for index in range(first, first + 17 * len(KINDS), len(KINDS)):
        outcome = try_file(index, 7, folder, originals)
        # time is of the machine: the command looks at it
        assert outcome.verdict in (*FINE, "over time"), outcome


def policy(path: Path, originals: Originals, **files: bytes) -> Path:
    """A folder of a policy with these files in place of its own; those of no bytes are left out."""
    own = dict(zip(("actor.npz", "config.json"), originals.policy, strict=True))
    path.mkdir()
    for name, data in (own | files).items():
        if data:
            (path / name).write_bytes(data)
    return path


Captured = pytest.CaptureFixture[str]
PROTOTYPE, SQUARE = load_robot("prototype"), np.zeros((256, 256), np.float32)


def changed(originals: Originals, **arrays: Any) -> bytes:
    return npz({name: a for name, a in (dict(originals.actor) | arrays).items() if a is not None})


def setting(**given: Any) -> Callable[[dict[str, Any]], None]:
    return lambda config: config["plan"]["settings"].update(given)


def declared(name: str, size: int) -> bytes:
    """A zip whose directory says that a member is of `size` bytes."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(name, b"x")
        archive.filelist[0].file_size = size
    return out.getvalue()


FOREIGN = {
    "evaluate": "evaluate Reach FOLDER --episodes 1 --no-baselines",
    "drive": "drive track --emulate --policy FOLDER",
    "resume": "train --resume --out FOLDER",
}


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.parametrize("trust", [False, True])
def test_code_in_a_folder_runs_with_trust_alone(
    name: str, trust: bool, tmp_path: Path, originals: Originals, capsys: Captured, monkeypatch: Any
) -> None:
    why = "stable-baselines3 is not installed: pip install 'fastrod[rl]'"
    pytest.importorskip("stable_baselines3", reason=why)
    monkeypatch.chdir(tmp_path)
    canary = tmp_path / "canary"
    config = json.loads(originals.policy[1])
    config["plan"]["n_envs"] = 2
    task = "Track" if name == "drive" else "Reach"
    text = json.dumps(config).replace("fastrod/Reach-v0", f"fastrod/{task}-v0")
    theirs = dict.fromkeys(("policy.zip", "checkpoint.zip", "replay.pkl"), foreign(canary))
    theirs |= {"actor.npz": b"", "config.json": text.encode()}
    path = policy(tmp_path / "theirs", originals, **theirs)
    words = FOREIGN[name].replace("FOLDER", str(path)).split()
    # with trust their code has run, and what it made is no model
    assert main([*words, *(["--trust"] if trust else [])]) == 2
    said = capsys.readouterr().err
    assert canary.exists() == trust
    assert ("runs code of whoever made it" in said) != trust
    assert len(said.splitlines()) == 1


def test_trust_is_of_files_of_others_alone(tmp_path: Path, originals: Originals) -> None:
    canary = tmp_path / "canary"
    path = policy(tmp_path / "own", originals, **{"policy.zip": foreign(canary)})
    assert Policy(path, trust=True).act(np.zeros((1, 23))).shape == (1, 11)
    assert not canary.exists()


ACTORS: dict[str, tuple[Callable[[Originals], bytes], str]] = {
    "nan": (lambda o: changed(o, weight_1=SQUARE * np.nan), "a number that is not finite"),
    "shapes": (lambda o: changed(o, weight_1=SQUARE[:, :3]), "do not fit together"),
    "transposed": (lambda o: changed(o, weight_0=o.actor["weight_0"].T), "do not fit together"),
    "doubles": (lambda o: changed(o, bias_0=np.zeros(256)), "not numbers of single precision"),
    "missing": (lambda o: changed(o, bias_1=None), "'bias_1' is missing or too much"),
    "objects": (lambda o: changed(o, bias_0=np.array([None])), "numbers and words alone are read"),
    "beyond": (lambda o: changed(o, bias_0=SQUARE[0] + np.float32(1e30)), "it holds a number beyond 100000"),
    "no distance": (lambda o: changed(o, reach=np.zeros(23, np.float32)), "bounds without a distance"),
    "activation": (lambda o: changed(o, activation="x\ny"), r"its activation is 'x\ny'"),
    "truncated": (lambda o: o.policy[0][:-1000], "File is not a zip file"),
    "flipped": (lambda o: o.policy[0][:3000] + b"\xff\xff" + o.policy[0][3002:], "is it whole"),
    "declares 10 GB": (
        lambda o: declared("weight_0.npy", 10**10),
        "it declares 1 arrays of 10000000000 bytes",
    ),
    "unpacks to 200 MB": (lambda o: o.zeros, "it declares 1 arrays of 200000128 bytes"),
    "a shape of 10^12": (
        lambda o: npz(o.actor).replace(b"(256, 256), }          ", b"(1000000, 1000000), }  "),
        "is it whole",
    ),
}


@pytest.mark.study(beyond=12)
@pytest.mark.parametrize("name", ACTORS)
def test_a_damaged_actor_is_one_sentence(
    name: str, tmp_path: Path, originals: Originals, capsys: Captured
) -> None:
    make, words = ACTORS[name]
    path = policy(tmp_path / "p", originals, **{"actor.npz": make(originals)})
    line = f"evaluate Reach {path} --episodes 1 --no-baselines --option n_steps=2"
    assert main(line.split()) == 2
    said = capsys.readouterr().err
    assert words in said
    assert len(said.splitlines()) == 1
    assert "Traceback" not in said


CONFIGS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "list": (lambda c: c.update(plan=[]), "Expected `object`, got `array`"),
    "no plan": (lambda c: c.pop("plan"), "it lacks 'plan'"),
    "env": (lambda c: c["plan"].update(env=[1]), "Expected `str`, got `array`"),
    "options": (lambda c: c["plan"].update(options=None), "Expected `object`, got `null`"),
    "n_envs": (
        lambda c: c["plan"].update(n_envs=10**12),
        "n_envs is 1000000000000; it must be a whole number from 1 to 1000000",
    ),
    "algorithm": (lambda c: c["plan"].update(algorithm="pp0"), "did you mean 'ppo'?"),
    "unknown key": (
        lambda c: c["plan"].update(curiculum=1.0),
        "unknown key 'curiculum'; did you mean 'curriculum'?",
    ),
    "seconds": (lambda c: c["state"].update(seconds=float("nan")), "it says that nan s are done"),
    "gamma": (setting(gamma="x"), "setting 'gamma' of ppo is 'x'"),
    "large gamma": (setting(gamma=5.0), "'gamma' of ppo is 5.0; it must be a"),
    "n_epochs": (setting(n_epochs="x"), "'n_epochs' of ppo is 'x'; it must"),
    "n_steps": (setting(n_steps=10**7), "'n_steps' of ppo is 10000000"),
    "no setting": (setting(gama=0.9), "no setting 'gama'; did you mean 'gamma'?"),
    "network": (
        setting(policy_kwargs={"net_arch": {"pi": [10**9]}}),
        "it must be a list of at most 16 whole numbers from 1 to 4096, the widths of its layers",
    ),
    "log_std_init": (
        setting(policy_kwargs={"log_std_init": "x"}),
        "setting 'log_std_init' of ppo is 'x'; it must be a number from -20 to 20",
    ),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_a_damaged_config_is_one_sentence(name: str, tmp_path: Path, originals: Originals) -> None:
    change, words = CONFIGS[name]
    config = json.loads(originals.policy[1])
    change(config)
    path = policy(tmp_path / "p", originals, **{"config.json": json.dumps(config).encode()})
    with pytest.raises((InputError, UnknownNameError)) as caught:
        Policy(find("Reach", str(path)))
    assert words in str(caught.value)
    assert "config.json" in str(caught.value)


def text_of(n: int) -> bytes:
    return b"v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\n" + b"f 1 2 3\n" * n


def glb(*, views: int = 1, accessors: int = 1, **others: Any) -> bytes:
    """100 triangles; `others` of its view, `attributes` beside its position."""
    numbers = np.eye(300, 3, dtype=np.float32).tobytes()
    extra = {f"_{k}": 0 for k in range(others.pop("attributes", 0))}
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(numbers)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(numbers), **others}] * views,
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 300, "type": "VEC3"}] * accessors,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, **extra}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    parts = ((b"JSON", text), (b"BIN\0", numbers))
    rest = b"".join(len(part).to_bytes(4, "little") + kind + part for kind, part in parts)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(rest)).to_bytes(4, "little") + rest


SMALL_FILE, FEW_FACES, NINE_FACES = MeshLimits(n_bytes=500), MeshLimits(n_faces=99), MeshLimits(n_faces=9)
MESHES: dict[str, tuple[Any, ...]] = {
    "archive": ("a.zip", b"PK", "has the unknown suffix '.zip'"),
    "collada": ("a.dae", b"<COLLADA/>", "An archive, or a scene that refers to other files, is not read"),
    "gltf": ("a.gltf", b"{}", "known: glb, obj, off, ply, stl."),
    "bytes": (
        "a.obj",
        text_of(100),
        "has 828 bytes, more than 500; mesh(..., limits=MeshLimits(n_bytes=",
        SMALL_FILE,
    ),
    "faces": (
        "a.obj",
        text_of(100),
        "has 100 faces, more than 99; mesh(..., limits=MeshLimits(n_faces=",
        FEW_FACES,
    ),
    "long polygon": (
        "a.obj",
        text_of(1) + b"f " + b"1 2 3 " * 2000,
        "has a line of 12002 bytes, more than 10000",
    ),
    "polygon": (
        "a.off",
        b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n300 " + b"0 1 2 " * 100,
        "has 298 faces, more than 9",
        NINE_FACES,
    ),
    "seconds": (
        "a.obj",
        text_of(600_000),
        "was not read within 0.001 s; mesh(..., limits=MeshLimits(seconds=",
        MeshLimits(seconds=1e-3),
    ),
    "memory": (
        "a.obj",
        text_of(600_000),
        "needs more than 150000000 bytes of memory to be read",
        MeshLimits(memory=150_000_000, seconds=300.0),
    ),
    "cut": (
        "a.stl",
        bytes(80) + (5).to_bytes(4, "little") + bytes(249),
        "declares 5 faces, which take 334 bytes, and it has 333",
    ),
    "no faces": ("a.stl", b"", "is empty: it has 0 bytes"),
    "no body": ("a.obj", b"v 0 0 0\n", "mesh file 'a.obj' has no faces"),
    "long view": (
        "a.glb",
        glb(byteLength=10**12),
        "a view of it takes 1000000000000 bytes from 0 on, of 3600",
    ),
    "late view": ("a.glb", glb(byteOffset=1), "a view of it takes 3600 bytes from 1 on, of 3600"),
    "other buffer": ("a.glb", glb(buffer=1), "refers to buffer 1, and it has one"),
    "wide steps": ("a.glb", glb(byteStride=13), "300 elements of 12 bytes, and its view has 3600"),
    "no steps": ("a.glb", glb(byteStride=0), "begins at 0, with steps of 0 bytes"),
    "views": ("a.glb", glb(views=10_000), "more than 16 times its"),
    "accessors": ("a.glb", glb(accessors=10_000), "more than 16 times its"),
    "declared": (
        "a.ply",
        b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n0\n",
        "its header declares 1000000000000 elements, which take 2000000000000 bytes, and 13 follow it",
    ),
    "far": ("a.obj", text_of(1).replace(b"0.1", b"1e300"), "has a vertex 1e+300 m from its origin"),
}
"""File, what it holds, the sentence, and limits where they are not the usual."""


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.study(beyond=12)
def test_a_mesh_beyond_the_limits_is_refused_in_a_sentence(
    name: str, tmp_path: Path, capfd: Captured
) -> None:
    file, content, words, *limits = MESHES[name]
    (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError) as caught:
        mesh(tmp_path / file, limits=limits[0] if limits else None)
    assert words in str(caught.value)
    assert str(caught.value).isprintable()
    assert capfd.readouterr() == ("", "")


def test_attributes_beside_the_position_cost_nothing(tmp_path: Path) -> None:
    for n in (0, 20_000):
        (tmp_path / f"{n}.glb").write_bytes(glb(attributes=n))
    plain = read_mesh(tmp_path / "0.glb", MeshLimits())  # trimesh is imported now
    tracemalloc.start()
    many = read_mesh(tmp_path / "20000.glb", MeshLimits())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10_000_000  # of 100 MB with each of them copied
    for mine, its in zip(many, plain, strict=True):
        np.testing.assert_array_equal(mine, its)


@pytest.mark.study
def test_a_file_that_is_read_apart_is_the_same(
    tmp_path: Path, monkeypatch: Any, originals: Originals
) -> None:
    (tmp_path / "ball.stl").write_bytes(originals.meshes["mesh stl"])
    here = mesh(tmp_path / "ball.stl")
    monkeypatch.setattr("fastrod.contact.meshfile._SMALL", 1000)
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)  # with it numpy writes to a pipe
    apart = mesh(tmp_path / "ball.stl", limits=MeshLimits(seconds=300.0))
    np.testing.assert_array_equal(apart.vertices[apart.faces], here.vertices[here.faces])


def test_a_mesh_opens_no_other_file_and_logs_nothing(
    tmp_path: Path, capfd: Captured, originals: Originals
) -> None:
    opened: list[str] = []
    watching = True

    def watch(event: str, given: tuple[Any, ...]) -> None:
        if watching and event == "open" and isinstance(given[0], str) and given[0].startswith(str(tmp_path)):
            opened.append(Path(given[0]).name)

    for name in ("secret.mtl", "secret.png", "secret.bin"):
        (tmp_path / name).write_text("newmtl a\nmap_Kd secret.png\n", encoding="ascii")
    (tmp_path / "a.obj").write_bytes(b"mtllib secret.mtl\nusemtl a\n" + originals.meshes["mesh obj"])
    # trimesh logs a traceback and goes on
    broken = originals.meshes["mesh stl text"].replace(b"facet normal", b"facet normal x", 1)
    (tmp_path / "a.stl").write_bytes(broken)
    sys.addaudithook(watch)
    try:
        assert mesh(tmp_path / "a.obj").closed
        assert mesh(tmp_path / "a.stl").closed
    finally:
        watching = False
    assert set(opened) == {"a.obj", "a.stl"}
    assert capfd.readouterr() == ("", "")
    assert not logging.getLogger("trimesh.util").filters


@pytest.mark.study
@pytest.mark.parametrize(
    ("file", "words"), [("rows", "declares 160000000 values"), ("words", "of 100000000000 bytes of text")]
)
def test_a_small_parquet_that_unpacks_to_much_is_refused(
    file: str, words: str, tmp_path: Path, originals: Originals
) -> None:
    path = tmp_path / "log.parquet"
    path.write_bytes(getattr(originals, file))
    with pytest.raises(LogError, match=words):
        read_log(path, PROTOTYPE)


PIPES: dict[str, Callable[[Path], object]] = {
    "log.csv": lambda path: read_log(path, PROTOTYPE),
    "log": lambda path: read(path, PROTOTYPE),
    "log.parquet": lambda path: read_log(path, PROTOTYPE),
    "robot.toml": load_robot,
    "hardware.toml": load_hardware,
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize("name", PIPES)
def test_a_pipe_that_nobody_writes_into_is_refused(name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(FastrodError, match=r"cannot be read: it is no file\.$"):
        PIPES[name](tmp_path / name)


def test_a_csv_has_a_most_of_bytes(tmp_path: Path, monkeypatch: Any, originals: Originals) -> None:
    (tmp_path / "log.csv").write_bytes(originals.log[0])
    monkeypatch.setattr("fastrod.logs.table._MOST_BYTES", 100)
    with pytest.raises(LogError, match=r"log\.csv has \d+ bytes; a log may have 100\. Cut it in parts\.$"):
        read_log(tmp_path / "log.csv", PROTOTYPE)


def test_a_refusal_quotes_libraries_in_one_line(tmp_path: Path, originals: Originals) -> None:
    data = originals.log[1]
    for k in range(0, len(data), 97):  # pyarrow's sentences hold line breaks
        (tmp_path / "log.parquet").write_bytes(data[:k] + b"\x00\xff" + data[k + 2 :])
        said = ""
        try:
            read_log(tmp_path / "log.parquet", PROTOTYPE)
        except FastrodError as error:
            said = str(error)
        assert said.isprintable()
    assert str(InputError("a\nb\x1b[2J\u2028c")) == "a b [2J c"
    assert str(UnknownNameError("no\nsuch")) == "no such"


DRUM = "drum_radius = 0.008     # m"
TABLES: dict[str, tuple[str, str, str]] = {
    "denormal drum": (DRUM, "drum_radius = 1e-320", "is 1e-320 m; it must be a number from 0.0001 to 0.1 m"),
    "huge gear": (DRUM, "drum_radius = 0.008\ngear = 1e308", "gear is 1e+308; it must be a number from"),
    "digits": (DRUM, f"drum_radius = 0.008\ncounts_per_turn = {'9' * 400}", "drive 1"),
    "tiny limit": ("tension = 15.0", "tension = 1e-320", "Limits.tension is 1e-320 N; it must be"),
    "huge limit": (
        "curvature = 16.0",
        "curvature = 1e308",
        "Limits.curvature is 1e+308 1/m; it must be a number from 1e-09 to 1e+09 1/m.",
    ),
    "huge matrix": (
        "[800.0, 0.0, 319.5]",
        "[1e308, 0.0, 319.5]",
        "its numbers must be between -1e+06 and 1e+06",
    ),
    "huge picture": ("size = [640, 480]", "size = [640000, 480]", "whole numbers from 16 to 20000 [px]"),
    "tiny rate": (
        "rate = 15.0",
        "rate = 1e-320",
        "Camera.rate is 1e-320 Hz; it must be a number from 0.01 to 100000 Hz",
    ),
    "tiny marker": (
        "size = 0.018",
        "size = 1e-320",
        "Marker.size is 1e-320 m; it must be a number from 0.0001 to 1 m",
    ),
    "deep": ('robot = "prototype"', "robot = " + "[" * 100_000, "its tables stand too deep in one another"),
    "long key": ('robot = "prototype"', "a." * 20_000 + "a = 1", "it has a key of more than 50 words"),
    "large": ('robot = "prototype"', "#" * 1_000_001, "it has more than 1000000 bytes"),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_hardware_file_has_bounds(name: str, tmp_path: Path) -> None:
    old, new, words = TABLES[name]
    text = SHIPPED.read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "mine.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FastrodError) as caught:
        load_hardware(tmp_path / "mine.toml")
    assert words in str(caught.value)
    assert len(str(caught.value)) < 500


def test_numbers_that_a_float_can_hold_and_their_squares_cannot(tmp_path: Path, originals: Originals) -> None:
    cells = originals.log[0].decode().splitlines()
    for column in (6, 7):  # a tip's coordinate
        row = cells[3].split(",")
        row[column] = "1e300"
        lines = [*cells[:3], ",".join(row), *cells[4:]]
        (tmp_path / "log.csv").write_text("\n".join(lines), encoding="utf-8")
        with pytest.raises(LogError, match="row 2"):
            read_log(tmp_path / "log.csv", PROTOTYPE)


def test_a_robot_file_has_the_same_bounds(tmp_path: Path) -> None:
    for text, words in (
        ("a." * 20_000 + "a = 1", "a key of more than 50 words"),
        ("#" * 1_000_001, "more than 1000000 bytes"),
    ):
        (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
        with pytest.raises(RobotError, match=words):
            load_robot(tmp_path / "mine.toml")
