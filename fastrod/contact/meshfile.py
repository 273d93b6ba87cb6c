"""Mesh files from anywhere: `MeshLimits`, what a file declares, and its reading within time and memory."""

from __future__ import annotations

import io
import json
import mmap
import os
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from fastrod.checks import POSITIVE, Bound, check
from fastrod.contact import trimesh_reader
from fastrod.errors import InputError, nearest, shown
from fastrod.reading import reading
from fastrod.types import Floats, Ints

_SMALL, _FEW = 4_000_000, 100  # bytes and bodies up to which a file is read in this process: at worst 2 s
_DESCRIPTION = 16_000_000  # bytes of the JSON of a .glb
_OVERLAP = 16  # times its size that a .glb may read: 2 of what trimesh writes, some more of interleaved views
_LINE = 10_000  # bytes of a line of an .obj or .off
_HEADER = 65_536  # bytes in which the header of a .ply or .off ends


@dataclass(frozen=True, kw_only=True)
class MeshLimits:
    """Limits on the cost of reading a mesh file, for `fastrod.contact.mesh`. Raises `InputError` for one that
    is not positive.

    >>> MeshLimits(n_faces=5_000_000, seconds=60.0).n_bytes
    256000000
    """

    n_bytes: Annotated[int, Bound(least=1)] = 256_000_000
    """Largest size of the file [bytes]."""
    n_faces: Annotated[int, Bound(least=1)] = 1_000_000
    """Triangles of all its bodies, with each instance counted."""
    seconds: Annotated[float, POSITIVE] = 10.0
    """Until a file of more than 4 MB, or of more than 100 bodies, must be read; smaller ones take less."""
    memory: Annotated[int, Bound(least=1)] = 2_000_000_000
    """Memory of the process that reads such a file [bytes]."""

    def __post_init__(self) -> None:
        check(self)


class _Declared(NamedTuple):
    """Size that a file declares."""

    faces: int
    vertices: int
    bodies: int


def read_mesh(path: Path, limits: MeshLimits) -> tuple[Floats, Ints]:
    """Vertices (n, 3) and triangles (m, 3) of all bodies of a mesh file of one of `FORMATS`, untouched.

    Nothing but the file itself is opened. Raises `InputError` where it is no such file, or beyond `limits`.
    """
    where, kind = f"mesh file {path.name!r}", path.suffix[1:].lower()
    if kind not in FORMATS:
        raise InputError(
            f"{where} has the unknown suffix {path.suffix!r}; {nearest(kind, FORMATS)} "
            "An archive, or a scene that refers to other files, is not read: save it as one of these."
        )
    hint = "; is it whole, and of that format?"
    with reading(path, where, InputError, f"cannot be read as {kind}", most=sys.maxsize, hint=hint):
        size = path.stat().st_size
        _within(where, "bytes", size, "n_bytes", limits.n_bytes)
        with path.open("rb") as file:
            declared = _DECLARED[kind](file.fileno(), size) if size else None
    if declared is None:
        raise InputError(f"{where} is empty: it has 0 bytes.")
    _within(where, "faces", declared.faces, "n_faces", limits.n_faces)
    _within(where, "vertices", declared.vertices, "n_faces", 3 * limits.n_faces)
    vertices, faces = (_here if size <= _SMALL and declared.bodies <= _FEW else _apart)(
        where, path, kind, limits
    )
    _within(where, "faces", len(faces), "n_faces", limits.n_faces)
    if not len(faces):
        raise InputError(f"{where} has no faces; give a surface of triangles.")
    return vertices, faces


def _within(where: str, what: str, number: int, name: str, most: float) -> None:
    if number > most:
        raise InputError(
            f"{where} has {number} {what}, more than {most:.0f}; mesh(..., "
            f"limits=MeshLimits({name}=...)) allows more."
        )


def _here(where: str, path: Path, kind: str, _: MeshLimits) -> tuple[Floats, Ints]:
    try:
        with np.errstate(all="ignore"):  # of numbers that a float cannot hold, which `mesh` refuses
            return trimesh_reader.read(str(path), kind)
    except ImportError as error:
        raise InputError(
            "meshes need the package trimesh, which is not installed; install it, or give (vertices, faces)."
        ) from error
    except Exception as error:  # every loader of trimesh raises its own
        raise InputError(
            f"{where} cannot be read as {kind}: {shown(error)}; is it whole, and of that format?"
        ) from error


def _apart(where: str, path: Path, kind: str, limits: MeshLimits) -> tuple[Floats, Ints]:
    """In a process of its own, which ends at the limits."""
    command = [
        sys.executable,
        "-P",
        trimesh_reader.__file__,
        str(path.absolute()),
        kind,
        str(int(limits.memory)),
    ]
    own = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "OPENBLAS_NUM_THREADS": "1",  # each reserves memory, which the limit counts
    }
    try:
        done = subprocess.run(
            command,
            env=own,
            capture_output=True,
            timeout=limits.seconds,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(
            f"{where} was not read within {limits.seconds:g} s; mesh(..., limits=MeshLimits(seconds=...)) "
            "allows more."
        ) from error
    why = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    if done.returncode == 2:
        raise InputError(
            f"{where} cannot be read as {kind}: {shown(why)[1:-1]}; is it whole, and of that format?"
        )
    if done.returncode:
        raise InputError(
            f"{where} needs more than {limits.memory:.0f} bytes of memory to be read; mesh(..., "
            "limits=MeshLimits(memory=...)) allows more."
        )
    out = io.BytesIO(done.stdout)
    return np.load(out, allow_pickle=False), np.load(out, allow_pickle=False)


def _mapped(file: int) -> mmap.mmap:
    return mmap.mmap(file, 0, access=mmap.ACCESS_READ)


def _stl(file: int, size: int) -> _Declared:
    with _mapped(file) as data:
        n = int.from_bytes(data[80:84], "little")
        if size >= 84 and size == 84 + 50 * n:
            return _Declared(n, 3 * n, 1)
        if not re.match(rb"\s*solid", data[:_HEADER], re.IGNORECASE):
            raise ValueError(
                f"its header declares {n} faces, which take {84 + 50 * n} bytes, and it has {size}"
            )
        corners = _count(data, rb"vertex")
        return _Declared(corners // 3, corners, 1)


def _obj(file: int, _: int) -> _Declared:
    with _mapped(file) as data:
        _check_lines(data)
        return _Declared(_count(data, rb"^[ \t]*f[ \t]"), _count(data, rb"^[ \t]*v[ \t]"), 1)


def _check_lines(data: mmap.mmap) -> None:
    """Raises `ValueError` for a line that only a face of thousands of corners has: it would be cut into as
    many triangles."""
    ends = np.flatnonzero(np.frombuffer(data[:], np.uint8) == ord("\n"))
    longest = int(np.diff(ends, prepend=-1, append=len(data)).max()) - 1
    if longest > _LINE:
        raise ValueError(
            f"it has a line of {longest} bytes, more than {_LINE}, so a face with too many corners"
        )


def _count(data: mmap.mmap, pattern: bytes) -> int:
    return sum(1 for _ in re.finditer(pattern, data, re.IGNORECASE | re.MULTILINE))


def _off(file: int, size: int) -> _Declared:
    with _mapped(file) as data:
        _check_lines(data)
        head = re.sub(rb"#[^\n]*", b" ", data[:_HEADER]).split(maxsplit=4)
    if not head or head[0].upper() != b"OFF":
        raise ValueError("it does not begin with OFF")
    n_vertices, n_faces = _whole(head[1]), _whole(head[2])
    if 6 * n_vertices + 8 * n_faces > size + 64:  # "0 0 0" and "3 0 1 2", each with its line break
        raise ValueError(f"it declares {n_vertices} vertices and {n_faces} faces, and has {size} bytes")
    return _Declared(n_faces, n_vertices, 1)


def _whole(word: bytes) -> int:
    if not re.fullmatch(rb"\d{1,18}", word):
        raise ValueError(f"{shown(word.decode(errors='replace'), 40)} is no number of vertices or faces")
    return int(word)


_WIDTH = {
    **dict.fromkeys((b"char", b"uchar", b"int8", b"uint8"), 1),
    **dict.fromkeys((b"short", b"ushort", b"int16", b"uint16"), 2),
    **dict.fromkeys((b"int", b"uint", b"float", b"int32", b"uint32", b"float32"), 4),
    **dict.fromkeys((b"double", b"float64", b"int64", b"uint64"), 8),
}


def _ply(file: int, size: int) -> _Declared:
    with _mapped(file) as data:
        head = data[:_HEADER]
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        raise ValueError("it does not begin with ply and a header of at most 64 kB")
    text, least, width, count = False, 0, 0, 0
    counts: dict[bytes, int] = {}
    for line in head[:end].splitlines():
        words = line.split()
        if words[:1] == [b"format"]:
            text = words[1] == b"ascii"
        elif words[:1] == [b"element"]:
            least, width, count = least + count * width, 0, _whole(words[2])
            counts[words[1]] = counts.get(words[1], 0) + count
        elif words[:1] == [b"property"]:
            kind = words[2] if words[1] == b"list" else words[1]
            width += 2 if text else _WIDTH[kind]  # of a list its length alone
    least += count * width
    if least > size - end or any(n > size for n in counts.values()):
        raise ValueError(
            f"its header declares {sum(counts.values())} elements, which take {least} bytes, "
            f"and {size - end} follow it"
        )
    return _Declared(counts.get(b"face", 0), counts.get(b"vertex", 0), 1)


_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}


def _glb(file: int, size: int) -> _Declared:
    with _mapped(file) as data:
        if data[:4] != b"glTF" or int.from_bytes(data[8:12], "little") != size or data[16:20] != b"JSON":
            raise ValueError("its header is none of a glb of its length")
        if (length := int.from_bytes(data[12:16], "little")) > _DESCRIPTION:
            raise ValueError(f"its description takes {length} bytes, more than {_DESCRIPTION}")
        tree = json.loads(data[20 : 20 + length])
        chunk = data[20 + length : 28 + length]
    held = int.from_bytes(chunk[:4], "little") if chunk[4:] == b"BIN\0" else 0
    if packed := [
        name for name in tree.get("extensionsRequired", []) if "compression" in name or "meshopt" in name
    ]:
        raise ValueError(f"it is packed by {shown(packed[0], 60)}, which is not read; save it without")
    if any("uri" in buffer for buffer in tree.get("buffers", [])):
        raise ValueError("it refers to another file for its numbers; save it as one file")
    taken = sum(_view(view, held) for view in tree.get("bufferViews", []))
    accessors = []
    for accessor in tree.get("accessors", []):
        count, width = _accessor(tree, accessor)
        accessors.append(count)
        taken += count * width
    if taken > _OVERLAP * size:  # each is copied
        raise ValueError(f"its views and accessors take {taken} bytes, more than {_OVERLAP} times its {size}")
    faces, corners = [], []
    for mesh in tree.get("meshes", []):
        used = [
            accessors[_index(p.get("indices", p["attributes"]["POSITION"]), accessors)]
            for p in mesh["primitives"]
        ]
        points = [accessors[_index(p["attributes"]["POSITION"], accessors)] for p in mesh["primitives"]]
        strips = [p.get("mode", 4) in (5, 6) for p in mesh["primitives"]]
        faces.append(sum(n if strip else n // 3 for n, strip in zip(used, strips, strict=True)))
        corners.append(sum(points))
    nodes = tree.get("nodes", [])
    below = [_index(child, nodes) for node in nodes for child in node.get("children", [])]
    if len(set(below)) < len(below):  # a node below two others is drawn twice, and below itself without end
        raise ValueError("one of its nodes stands below two others")
    shown_ = [_index(node["mesh"], faces) for node in nodes if "mesh" in node]
    n_pieces = sum(len(mesh["primitives"]) for mesh in tree.get("meshes", []))
    return _Declared(sum(faces[k] for k in shown_), sum(corners[k] for k in shown_), len(nodes) + n_pieces)


def _view(view: Mapping[str, Any], held: int) -> int:
    """Its length, where the `held` bytes of the file's numbers have it. Raises `ValueError`."""
    start, length = view.get("byteOffset", 0), view["byteLength"]
    if not (isinstance(start, int) and isinstance(length, int) and 0 <= start <= start + length <= held):
        raise ValueError(
            f"a view of it takes {shown(length, 40)} bytes from {shown(start, 40)} on, of {held}"
        )
    if view["buffer"] != 0:
        raise ValueError(f"a view of it refers to buffer {shown(view['buffer'], 40)}, and it has one")
    return length


def _accessor(tree: Mapping[str, Any], accessor: Mapping[str, Any]) -> tuple[int, int]:
    """Its count and the bytes of an element, where its view has as many. Raises `ValueError`."""
    count, width = accessor["count"], _COMPONENTS[accessor["type"]] * _BYTES[accessor["componentType"]]
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"an accessor of it has {shown(count, 40)} elements")
    if "bufferView" not in accessor or "sparse" in accessor:
        raise ValueError("an accessor of it has no numbers, or sparse ones, which is not read")
    views = tree["bufferViews"]
    view = views[_index(accessor["bufferView"], views)]
    start, step, length = accessor.get("byteOffset", 0), view.get("byteStride", width), view["byteLength"]
    if not (isinstance(start, int) and isinstance(step, int) and start >= 0 and step > 0):
        raise ValueError(
            f"an accessor of it begins at {shown(start, 40)}, with steps of {shown(step, 40)} bytes"
        )
    if max(count * width, start + (count - 1) * step + width) > length:
        raise ValueError(
            f"an accessor of it declares {count} elements of {width} bytes, and its view has {length}"
        )
    return count, width


def _index(number: object, into: list[Any]) -> int:
    if not isinstance(number, int) or not 0 <= number < len(into):
        raise ValueError(f"it refers to number {shown(number, 40)} of {len(into)}")
    return number


_DECLARED: Mapping[str, Callable[[int, int], _Declared]] = {
    "glb": _glb,
    "obj": _obj,
    "off": _off,
    "ply": _ply,
    "stl": _stl,
}
FORMATS = tuple(_DECLARED)
"""Suffixes of the formats that are read: each is one file that refers to no other for its shape."""
