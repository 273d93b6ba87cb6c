"""Read a mesh file by trimesh, here or as a program of its own that its caller can end.

It needs nothing else of the package.
"""

from __future__ import annotations

import errno
import io
import json
import logging
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def read(path: str, kind: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (n, 3) and triangles (m, 3) of all bodies of a file of the format `kind`.

    No other file is opened, whatever it refers to. Raises what trimesh raises: each of its loaders has its
    own.
    """
    import trimesh

    data = _PLAIN.get(kind, bytes)(Path(path).read_bytes())
    # a stream has no folder in which materials or buffers would be looked for
    with _silent("trimesh", "trimesh.util"):
        made = trimesh.load_scene(
            io.BytesIO(data), file_type=kind, process=False, skip_materials=True
        ).to_mesh()
    return np.array(made.vertices, dtype=np.float64).reshape(-1, 3), np.array(
        made.faces, dtype=np.int64
    ).reshape(-1, 3)


def _plain_obj(data: bytes) -> bytes:
    """Positions and faces alone, as one body: the time that trimesh takes grows with the square of their
    number."""
    lines = re.findall(
        rb"^[ \t]*[vf][ \t][^\r\n]*", data.replace(b"\\\n", b"").replace(b"\r", b"\n"), re.MULTILINE
    )
    return re.sub(rb"/[^\s]*", b"", b"\n".join(line.strip() for line in lines)) + b"\n"


def _plain_stl(data: bytes) -> bytes:
    """All solids of a text as one, for the same reason; a binary file as it is."""
    if len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        return data
    return (
        b"solid\n"
        + re.sub(rb"^[ \t]*(end)?solid\b[^\r\n]*", b"", data, flags=re.IGNORECASE | re.MULTILINE)
        + b"\nendsolid\n"
    )


def _plain_glb(data: bytes) -> bytes:
    """Positions and faces alone: trimesh copies each further attribute, and any number of them may name the
    same numbers."""
    end = 20 + int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20:end])
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            primitive["attributes"] = {"POSITION": primitive["attributes"]["POSITION"]}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = len(text).to_bytes(4, "little") + b"JSON" + text + data[end:]
    return data[:8] + (12 + len(rest)).to_bytes(4, "little") + rest


_PLAIN: dict[str, Callable[[bytes], bytes]] = {"glb": _plain_glb, "obj": _plain_obj, "stl": _plain_stl}


@contextmanager
def _silent(*names: str) -> Iterator[None]:
    """Let these loggers write nothing from this thread: trimesh logs tracebacks of exceptions that it
    handles."""
    loggers, thread = [logging.getLogger(name) for name in names], threading.get_ident()

    def drop(record: logging.LogRecord) -> bool:
        return record.thread != thread

    for logger in loggers:
        logger.addFilter(drop)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeFilter(drop)


def _main(path: str, kind: str, memory: str) -> int:
    """Write both arrays to stdout as .npy, or the reason to stderr; the exit code."""
    with suppress(ImportError, ValueError, OSError):  # Windows has none, another may be lower
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    try:
        for array in read(path, kind):
            # numpy asks a stdout that is buffered for its place, and a pipe has none
            np.save(out := io.BytesIO(), array, allow_pickle=False)
            sys.stdout.buffer.write(out.getbuffer())
    except MemoryError:
        print("memory", file=sys.stderr)
        return 3
    except Exception as error:  # every loader of trimesh raises its own
        if isinstance(error, OSError) and error.errno == errno.ENOMEM:  # of a file that cannot be mapped
            print("memory", file=sys.stderr)
            return 3
        print(repr(error), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
