"""Files of every kind that are read: fine ones, and how they are spoilt (`python perf/fuzz_files.py`)."""

from __future__ import annotations

import base64
import io
import json
import os
import pickle
import re
import struct
import zipfile
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

_MESHES = ("stl", "stl text", "obj", "ply", "ply text", "off", "glb")
KINDS = ("policy", "robot", "hardware", "log csv", "log parquet", *(f"mesh {name}" for name in _MESHES))
"""Readers, and their formats: file number k is of kind k modulo their number."""
_SUFFIX = {"robot": "toml", "hardware": "toml"}
Rng = np.random.Generator
Spoil = Callable[[bytes, Rng], bytes]

_NUMBERS = "nan inf -inf 1e400 1e308 -1e308 1e-320 0 -0.0 -1 1e9 2147483648 -9223372036854775809"
_OTHERS = 'true "" "x\\ny" [] {} [[1]] \'\' 0x1p3 1_0 7.5 null'
_ODD = (*_NUMBERS.split(), "9" * 40, "9" * 5000, *_OTHERS.split())
"""Values that may stand in place of a number."""


class Originals:
    """Fine files of every kind, made once."""

    @cached_property
    def log(self) -> tuple[bytes, bytes]:
        """Return the prototype's log as CSV and as Parquet."""
        import pyarrow
        import pyarrow.parquet

        names = ["t", "run", *(f"dl_{k}" for k in range(1, 5)), "tip_x", "tip_y", "tip_z", "payload"]
        t = np.arange(40) * 0.05
        tip = 0.01 * np.sin(t), 0.01 * np.cos(t), 0.068 + 0 * t
        numbers = [t, *(0.002 * np.sin(t + k) for k in range(4)), *tip, 0 * t + 0.005]
        columns: dict[str, Any] = dict(zip([name for name in names if name != "run"], numbers, strict=True))
        columns["run"] = ["a"] * 20 + ["b"] * 20
        rows = "\n".join(",".join(str(columns[name][i]) for name in names) for i in range(len(t)))
        out = io.BytesIO()
        pyarrow.parquet.write_table(pyarrow.table(columns), out)
        return f"# a comment\n{','.join(names)}\n{rows}\n".encode(), out.getvalue()

    @cached_property
    def meshes(self) -> Mapping[str, bytes]:
        """By kind."""
        import trimesh

        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
        cube = trimesh.creation.box(extents=(0.01, 0.01, 0.01)).apply_translation((0.1, 0.0, 0.0))
        two = trimesh.Scene([ball, cube])
        made = {
            "mesh stl": ball.export(file_type="stl"),
            "mesh stl text": ball.export(file_type="stl_ascii"),
            "mesh obj": ball.export(file_type="obj"),
            "mesh ply": ball.export(file_type="ply"),
            "mesh ply text": ball.export(file_type="ply", encoding="ascii"),
            "mesh off": ball.export(file_type="off"),
            "mesh glb": two.export(file_type="glb"),
        }
        return {kind: data if isinstance(data, bytes) else data.encode() for kind, data in made.items()}

    @cached_property
    def tables(self) -> Mapping[str, tuple[bytes, ...]]:
        """TOML texts by kind."""
        from fastrod.model.robotfile import robot_names

        folder = files("fastrod") / "robots"
        full = (folder / "prototype.toml").read_text(encoding="utf-8") + (
            '\n[[effect]]\nname = "backlash"\nhalf_width = 0.0002\n[fit]\n"tendon.*.offset" = { sd = 0.001, '
            "shared = true }\n[sensor]\nnoise = [0.001, 0.001, 0.001]\n"
        )
        hardware = (files("fastrod_device") / "prototype.toml").read_bytes()
        wide = b"gear = 21.0\ncounts_per_turn = 4096\ntorque_constant = 0.0251\n"
        wide += b"rated_torque = 0.054\nefficiency = 0.8\n"
        shipped = tuple((folder / f"{name}.toml").read_bytes() for name in robot_names())
        return {"robot": (*shipped, full.encode()), "hardware": (hardware, hardware + wide)}

    @cached_property
    def policy(self) -> tuple[bytes, bytes]:
        """actor.npz and config.json of the shipped Reach."""
        folder = files("fastrod_envs") / "trained" / "Reach"
        return (folder / "actor.npz").read_bytes(), (folder / "config.json").read_bytes()

    @cached_property
    def actor(self) -> Mapping[str, np.ndarray]:
        """Its arrays, by name."""
        with np.load(io.BytesIO(self.policy[0]), allow_pickle=False) as held:
            return dict(held)

    @cached_property
    def zeros(self) -> bytes:
        """An array file of 200 MB that a zip holds in 200 kB."""
        return npz({"weight_0": np.zeros(50_000_000, np.float32)}, compress=True)

    @cached_property
    def rows(self) -> bytes:
        """Parquet: eight columns of 20 million equal numbers, in a few kB."""
        return _many_rows()

    @cached_property
    def words(self) -> bytes:
        """Parquet: a word of 1 MB in 100,000 rows."""
        return _long_words()


def write_fine(kind: str, path: Path, originals: Originals) -> Path:
    """Write a file, or of a policy a folder, that is whole, at `path` and a suffix; where it is."""
    if kind == "policy":
        path.mkdir()
        for name, data in zip(("actor.npz", "config.json"), originals.policy, strict=True):
            (path / name).write_bytes(data)
        return path
    target = _target(kind, path)
    target.write_bytes(_original(kind, 0, originals))
    return target


def _original(kind: str, number: int, originals: Originals) -> bytes:
    if kind in originals.tables:
        return originals.tables[kind][number % len(originals.tables[kind])]
    return originals.meshes[kind] if kind in originals.meshes else originals.log[kind == "log parquet"]


def _target(kind: str, path: Path) -> Path:
    return path.with_suffix("." + _SUFFIX.get(kind, kind.removesuffix(" text").rpartition(" ")[2]))


def write_case(kind: str, rng: Rng, path: Path, canary: Path, originals: Originals) -> tuple[Path, str]:
    """Write one file, or of a policy a folder, at `path` and a suffix; where it is, and how it was spoilt.
    Code in it makes `canary`."""
    if kind == "policy":
        return path, _policy(rng, path, canary, originals)
    data = _original(kind, int(rng.integers(1000)), originals)
    hostile = _hostile(kind, data, canary, originals)
    own = sorted(hostile)
    if rng.random() < 0.1:
        attack = own[rng.integers(len(own))]
        data = hostile[attack]()
    else:
        data, attack = spoilt(data, rng, text=kind not in ("log parquet", "mesh stl", "mesh ply", "mesh glb"))
    target = _target(kind, path)
    target.write_bytes(data)
    return target, attack


def spoilt(data: bytes, rng: Rng, *, text: bool) -> tuple[bytes, str]:
    """`data` after one to three changes, and what they were; now and then after none."""
    if rng.random() < 0.02:
        return data, "nothing"
    spoilers: dict[str, Spoil] = _TEXT if text or rng.random() < 0.2 else _BYTES
    names = [sorted(spoilers)[rng.integers(len(spoilers))] for _ in range(1 + int(rng.integers(6) // 4))]
    for name in names:
        data = spoilers[name](data, rng)
    return data, ", ".join(names)


def _span(data: bytes, rng: Rng) -> tuple[int, int]:
    start = int(rng.integers(len(data) + 1))
    return start, min(len(data), start + int(rng.integers(1, 65)))


def _truncate(data: bytes, rng: Rng) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def _flip(data: bytes, rng: Rng) -> bytes:
    made = bytearray(data)
    for place in rng.integers(max(1, len(made)), size=2 ** rng.integers(5)).tolist() if made else ():
        made[place] ^= 1 << int(rng.integers(8))
    return bytes(made)


def _flip_early(data: bytes, rng: Rng) -> bytes:
    """In the first bytes, where headers are."""
    return _flip(data[:200], rng) + data[200:]


def _insert(data: bytes, rng: Rng) -> bytes:
    start, _ = _span(data, rng)
    return data[:start] + rng.bytes(int(rng.integers(1, 65))) + data[start:]


def _cut(data: bytes, rng: Rng) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def _double(data: bytes, rng: Rng) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:end] * int(rng.integers(1, 9)) + data[end:]


def _large(data: bytes, rng: Rng) -> bytes:
    """Four or eight bytes become the largest or the most negative number there is."""
    start, _ = _span(data, rng)
    whole = b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8
    most = (*whole, b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f")
    piece = most[rng.integers(len(most))]
    return data[:start] + piece + data[start + len(piece) :]


def _odd_number(data: bytes, rng: Rng) -> bytes:
    """A number, or a word, becomes an odd one."""
    found = list(re.finditer(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?" if rng.random() < 0.9 else rb"\w+", data))
    if not found:
        return data
    word = found[rng.integers(len(found))]
    return data[: word.start()] + _ODD[rng.integers(len(_ODD))].encode() + data[word.end() :]


def _lines(data: bytes, rng: Rng) -> bytes:
    """Two lines change places, or one goes, or comes twice."""
    lines = data.split(b"\n")
    i, j = rng.integers(len(lines), size=2).tolist()
    choice = rng.integers(3)
    if choice == 0:
        lines[i], lines[j] = lines[j], lines[i]
    elif choice == 1:
        del lines[i]
    else:
        lines.insert(j, lines[i])
    return b"\n".join(lines)


def _fields(data: bytes, rng: Rng) -> bytes:
    """Two words of a line change places, or a separator becomes another."""
    lines = data.split(b"\n")
    i = int(rng.integers(len(lines)))
    words = re.split(rb"([ ,=]+)", lines[i])
    j, k = rng.integers(len(words), size=2).tolist()
    words[j], words[k] = words[k], words[j]
    lines[i] = b"".join(words)
    return b"\n".join(lines)


def _breaks(data: bytes, rng: Rng) -> bytes:
    """A word takes a line break, an escape or what is no text."""
    start, _ = _span(data, rng)
    odd = (b"\\n", b"\r", b"\x1b[2J", b"\x00", b"\xff\xfe", "\u2028".encode(), b"\xef\xbb\xbf")
    return data[:start] + odd[rng.integers(len(odd))] + data[start:]


def _swap(data: bytes, rng: Rng) -> bytes:
    (a, b), (c, d) = sorted([_span(data, rng), _span(data, rng)])
    return data if b > c else data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


_BYTES: dict[str, Spoil] = {
    "truncated": _truncate,
    "flipped bits": _flip,
    "flipped header": _flip_early,
    "inserted bytes": _insert,
    "cut bytes": _cut,
    "doubled bytes": _double,
    "largest numbers": _large,
    "swapped bytes": _swap,
}
_TEXT: dict[str, Spoil] = {
    **_BYTES,
    "odd number": _odd_number,
    "odd numbers": lambda data, rng: _odd_number(_odd_number(data, rng), rng),
    "lines": _lines,
    "fields": _fields,
    "line breaks": _breaks,
}


class _Code:
    """Makes a folder when it is unpickled."""

    def __init__(self, canary: Path) -> None:
        self.canary = str(canary)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.canary,)


def npz(arrays: Mapping[str, Any], *, compress: bool = False) -> bytes:
    """A .npz of arrays, of objects too."""
    out = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(out, allow_pickle=True, **arrays)
    return out.getvalue()


def foreign(canary: Path) -> bytes:
    """A file of stable-baselines3 whose pickles make `canary`."""
    word = {":type:": "<class 'x'>", ":serialized:": base64.b64encode(pickle.dumps(_Code(canary))).decode()}
    names, out = ("policy_class", "observation_space", "action_space", "policy_kwargs"), io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("data", json.dumps(dict.fromkeys(names, word)))
        archive.writestr("policy.pth", pickle.dumps(_Code(canary)))
    return out.getvalue()


def _hostile(kind: str, data: bytes, canary: Path, originals: Originals) -> dict[str, Callable[[], bytes]]:
    """Files that are made to harm, by name."""
    made: dict[str, Callable[[], bytes]] = {
        "empty": lambda: b"",
        "pickle": lambda: pickle.dumps(_Code(canary)),
        "pickled arrays": lambda: npz({"t": np.array([_Code(canary)])}),
        "zeros": lambda: bytes(100_000),
        "deep": lambda: b"x = " + b"[" * 100_000,
        "deep tables": lambda: b"[" + b"a." * 20_000 + b"a]",
        "archive": lambda: npz({"a": np.zeros(10)}),
    }
    if kind == "log parquet":
        made |= {"many rows": lambda: originals.rows, "long words": lambda: originals.words}
    if kind == "mesh glb":
        made |= {name: partial(_glb, data, change) for name, change in _GLB.items()}
    if kind.startswith("mesh"):
        bombs = _BOMBS.get(kind.removeprefix("mesh ").removesuffix(" text"), {})
        made |= {name: partial(text.encode) for name, text in bombs.items()}
    return made


_CORNERS = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\n"
_HEAD = (
    "format ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement "
    "face {}\n"
)
_BOMBS: Mapping[str, Mapping[str, str]] = {
    "obj": {
        "one polygon": _CORNERS + "f " + "1 2 3 " * 300_000,
        "many materials": _CORNERS + "usemtl a\no b\ng c\nf 1 2 3\n" * 20_000,
        "other file": "mtllib ../../secret.mtl\n" + _CORNERS + "f 1 2 3\n",
    },
    "stl": {
        "many solids": "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0.1 0 0\nvertex 0 0.1 "
        "0\nendloop\nendfacet\nendsolid\n" * 5000,
        "half a facet": "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0\n",
    },
    "ply": {
        "declares much": "ply\n" + _HEAD.format(10**12, 1) + "property list uchar int "
        "vertex_indices\nend_header\n0 0 0\n",
        "declares faces": "ply\n" + _HEAD.format(3, 10**9) + "property list uchar int "
        "vertex_indices\nend_header\n0 0 0\n",
        "odd list": "ply\n" + _HEAD.format(3, 1) + "property list double double x\nend_header\n0 0 0\n1 0 "
        "0\n0 1 0\n3 0 1 2\n",
    },
    "off": {
        "declares much": "OFF\n999999999999 999999999999 0\n",
        "one polygon": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n600000 " + "0 1 2 " * 200_000,
    },
}


def _glb(data: bytes, change: Callable[[dict[str, Any]], None]) -> bytes:
    """A .glb whose description was changed, and whose lengths fit it."""
    length = struct.unpack("<I", data[12:16])[0]
    tree, rest = json.loads(data[20 : 20 + length]), data[20 + length :]
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def _many_nodes(tree: dict[str, Any]) -> None:
    tree["nodes"] = [{"mesh": 0} for _ in range(100_000)]
    tree["scenes"] = [{"nodes": list(range(100_000))}]


def _cycle(tree: dict[str, Any]) -> None:
    tree["nodes"] = [{"mesh": 0, "children": [1]}, {"mesh": 0, "children": [0]}]
    tree["scenes"] = [{"nodes": [0]}]


_GLB: Mapping[str, Callable[[dict[str, Any]], None]] = {
    "many instances": _many_nodes,
    "cycle of nodes": _cycle,
    "outside buffer": lambda tree: tree["buffers"][0].update(uri="../../secret.bin"),
    "huge accessor": lambda tree: tree["accessors"][0].update(count=10**12),
    "no numbers": lambda tree: [
        tree["accessors"][0].pop("bufferView"),
        tree["accessors"][0].update(count=10**9),
    ],
    "wrong type": lambda tree: tree.update(nodes=7),
    "packed": lambda tree: tree.update(extensionsRequired=["KHR_draco_mesh_compression"]),
}


def _many_rows() -> bytes:
    import pyarrow
    import pyarrow.parquet

    one, out = pyarrow.array(np.zeros(20_000_000, np.int8)), io.BytesIO()
    names = ("t", "tip_x", "tip_y", "tip_z", "dl_1", "dl_2", "dl_3", "dl_4")
    pyarrow.parquet.write_table(pyarrow.table(dict.fromkeys(names, one)), out)
    return out.getvalue()


def _long_words() -> bytes:
    import pyarrow
    import pyarrow.parquet

    places, words = pyarrow.array(np.zeros(100_000, np.int32)), pyarrow.array(["x" * 1_000_000])
    zeros, out = pyarrow.array(np.zeros(100_000, np.int8)), io.BytesIO()
    columns = {"run": pyarrow.DictionaryArray.from_arrays(places, words)}
    columns |= dict.fromkeys(("t", "tip_x", "tip_y", "tip_z"), zeros)
    pyarrow.parquet.write_table(pyarrow.table(columns), out)
    return out.getvalue()


def _policy(rng: Rng, path: Path, canary: Path, originals: Originals) -> str:
    """A folder of a policy with actor.npz or config.json spoilt; how."""
    actor, config = originals.policy
    choice = rng.random()
    if choice < 0.4:
        actor, attack = spoilt(actor, rng, text=False)
        attack = f"actor: {attack}"
    elif choice < 0.6:
        config, attack = spoilt(config, rng, text=True)
        attack = f"config: {attack}"
    elif choice < 0.7:
        names = sorted(_CONFIGS)
        attack = names[rng.integers(len(names))]
        config = _CONFIGS[attack](config)
    elif choice < 0.95:
        arrays: dict[str, Any] = dict(originals.actor)
        names = sorted(_ARRAYS)
        attack = names[rng.integers(len(names))]
        made = _ARRAYS[attack](arrays, rng, canary)
        actor = originals.zeros if attack == "bomb" else npz(arrays) if made is None else made
    else:
        attack = "no actor, a pickle of stable-baselines3"
        actor = b""
    path.mkdir()
    (path / "config.json").write_bytes(config)
    if actor:
        (path / "actor.npz").write_bytes(actor)
    if not actor or rng.random() < 0.3:
        for name in ("policy.zip", "checkpoint.zip", "checkpoint.npz", "replay.npz", "replay.pkl"):
            (path / name).write_bytes(foreign(canary))
    return attack


def _plan(change: Callable[[dict[str, Any]], Any]) -> Callable[[bytes], bytes]:
    def changed(config: bytes) -> bytes:
        held = json.loads(config)
        change(held["plan"])
        return json.dumps(held).encode()

    return changed


_CONFIGS: Mapping[str, Callable[[bytes], bytes]] = {
    "config: empty": lambda _: b"",
    "config: deep": lambda _: b"[" * 200_000,
    "config: a list": lambda _: b"[]",
    "config: digits": lambda _: b'{"plan": ' + b"9" * 100_000 + b"}",
    "config: large": lambda _: b" " * 3_000_000,
    "plan: env is a list": _plan(lambda plan: plan.update(env=[1])),
    "plan: unknown task": _plan(lambda plan: plan.update(env="Reech")),
    "plan: options is none": _plan(lambda plan: plan.update(options=None)),
    "plan: odd observation": _plan(lambda plan: plan["options"].update(observation="x\ny")),
    "plan: other observation": _plan(lambda plan: plan["options"].update(observation="goal")),
    "plan: odd action": _plan(lambda plan: plan["options"].update(action={"a": 1})),
    "plan: n_envs": _plan(lambda plan: plan.update(n_envs=10**30)),
    "plan: one more": _plan(lambda plan: plan.update(more=1)),
    "plan: one less": _plan(lambda plan: plan.pop("seed")),
}


def _spoil_array(arrays: dict[str, Any], rng: Rng, change: Callable[[np.ndarray], Any]) -> None:
    names = sorted(name for name in arrays if arrays[name].size > 1)
    name = names[rng.integers(len(names))]
    arrays[name] = change(np.array(arrays[name]))


def _with(value: float) -> Callable[[dict[str, Any], Rng, Path], None]:
    def change(arrays: dict[str, Any], rng: Rng, _: Path) -> None:
        def put(a: np.ndarray) -> np.ndarray:
            a.flat[int(rng.integers(a.size))] = value
            return a

        _spoil_array(arrays, rng, put)

    return change


def _header(arrays: dict[str, Any], rng: Rng, _: Path) -> bytes:
    """A zip that is whole, with a header of an array that is not."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, a in arrays.items():
            held = io.BytesIO()
            np.save(held, a)
            data, spoil = held.getvalue(), _TEXT[sorted(_TEXT)[rng.integers(len(_TEXT))]]
            archive.writestr(f"{name}.npy", spoil(data[:128], rng) + data[128:])
    return out.getvalue()


def _huge(arrays: dict[str, Any], _: Rng, __: Path) -> bytes:
    """A header that declares a million million numbers."""
    return npz(arrays).replace(b"'shape': (256, 256), }          ", b"'shape': (1000000, 1000000), }  ")


def _drop(arrays: dict[str, Any], rng: Rng, _: Path) -> None:
    del arrays[sorted(arrays)[rng.integers(len(arrays))]]


_ARRAYS: Mapping[str, Callable[[dict[str, Any], Rng, Path], bytes | None]] = {
    "nan": _with(float("nan")),
    "inf": _with(float("inf")),
    "large": _with(3e38),
    "header": _header,
    "huge shape": _huge,
    "missing": _drop,
    "objects": lambda arrays, rng, canary: _spoil_array(arrays, rng, lambda _: np.array([_Code(canary)])),
    "doubles": lambda arrays, rng, _: _spoil_array(arrays, rng, lambda a: a.astype(float)),
    "words": lambda arrays, rng, _: _spoil_array(arrays, rng, lambda a: a.astype(str)),
    "shape": lambda arrays, rng, _: _spoil_array(arrays, rng, lambda a: a[:-1]),
    "turned": lambda arrays, rng, _: _spoil_array(arrays, rng, lambda a: a.T[None]),
    "no width": lambda arrays, rng, _: _spoil_array(arrays, rng, lambda a: a[:0]),
    "one more": lambda arrays, _, __: arrays.update(weight_9=np.zeros(3)),
    "activation": lambda arrays, _, __: arrays.update(activation="x\ny"),
    "squashed": lambda arrays, _, __: arrays.update(squashed=np.zeros((2, 2))),
    "bomb": lambda *_: None,
    "no reach": lambda arrays, _, __: arrays.update(reach=np.zeros_like(arrays["reach"])),
    "many": lambda arrays, _, __: arrays.update({f"a{k}": np.zeros(1) for k in range(1100)}),
    "pickle": lambda _, __, canary: pickle.dumps(_Code(canary)),
}
