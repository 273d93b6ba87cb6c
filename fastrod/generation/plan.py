"""`Plan`: what a data set is, in words and numbers; written beside its shards, and known by its hash in each
of them."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias, final

from fastrod.checks import Bound, check_number
from fastrod.errors import FastrodError, InputError, shown
from fastrod.generation.rollouts import Rollouts
from fastrod.generation.shapes import Shapes
from fastrod.generation.sweep import Sweep
from fastrod.generation.trajectories import Trajectories

PLAN = "plan.json"
SHARDS = "shards"
"""The folder beside it that holds nothing but shards, so that readers of Parquet take it whole."""
Kind: TypeAlias = Shapes | Rollouts | Trajectories | Sweep
KINDS: dict[str, type[Kind]] = {
    "shapes": Shapes,
    "rollouts": Rollouts,
    "trajectories": Trajectories,
    "sweep": Sweep,
}


@final
@dataclass(frozen=True, kw_only=True)
class Plan:
    """A data set: `count` rows (or episodes) of `work`, in shards of `shard_rows`. Raises `InputError` where
    a number cannot be."""

    work: Kind
    count: int
    seed: int = 0
    shard_rows: int = 0
    """0 stands for the usual number."""
    version: str = ""
    """Version of fastrod; empty stands for this one."""

    def __post_init__(self) -> None:
        if not isinstance(self.work, tuple(KINDS.values())):
            raise InputError(
                f"work is {shown(self.work)}; give {', '.join(kind.__name__ for kind in KINDS.values())}."
            )
        check_number("count", self.count, Bound(least=1, most=10**12), whole=True)
        check_number("seed", self.seed, Bound(least=0, most=2**63), whole=True)
        if self.shard_rows == 0:
            object.__setattr__(self, "shard_rows", self.work.usual)
        check_number("shard_rows", self.shard_rows, Bound(least=1, most=10**7), whole=True)
        if not self.version:
            object.__setattr__(self, "version", version("fastrod"))

    @property
    def kind(self) -> str:
        """Its name."""
        return next(name for name, kind in KINDS.items() if isinstance(self.work, kind))

    @property
    def n_shards(self) -> int:
        """Files."""
        return -(-self.count // self.shard_rows)

    def rows(self, shard: int) -> range:
        """The rows (or episodes) of a shard."""
        return range(shard * self.shard_rows, min(self.count, (shard + 1) * self.shard_rows))

    @property
    def hash(self) -> str:
        """Hash of everything but the count: a data set may grow."""
        record = json.dumps({**self.record(), "count": None}, sort_keys=True)
        return hashlib.sha256(record.encode()).hexdigest()[:32]

    def record(self) -> dict[str, Any]:
        """Return the plan as JSON has it."""
        return {"kind": self.kind, **asdict(self)}


def read_plan(folder: str | Path) -> Plan | None:
    """The plan of a folder, or None where it has none, or an empty file that a lost machine left.

    Raises `InputError` for a file that is no plan.
    """
    path = Path(folder) / PLAN
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{str(path)!r} cannot be read: {getattr(error, 'strerror', None) or error}."
        ) from error
    if not text.strip("\0 \n"):
        return None
    try:
        record = json.loads(text)
        kind: Any = KINDS[record.pop("kind")]
        work = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in record.pop("work").items()
        }
        return Plan(work=kind(**work), **record)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, FastrodError) as error:
        raise InputError(
            f"{str(path)!r} is no plan of fastrod generate; give --out another folder."
        ) from error


def settle_plan(plan: Plan, folder: Path) -> None:
    """Write the plan into the folder, or find it there; a larger count lets the data set grow.

    Raises `InputError` where the folder holds shards of another plan, or of none.
    """
    for left in folder.glob(f"{PLAN}.*.part"):  # of a killed run; the folder is locked
        left.unlink(missing_ok=True)
    before = read_plan(folder)
    any_there = any((*folder.glob("*.parquet"), *folder.glob(f"{SHARDS}/*.parquet")))
    if before is None:
        # of an empty one, the shards themselves say whose they are
        if any_there and not (folder / PLAN).exists():
            raise InputError(
                f"folder {str(folder)!r} holds Parquet files and no {PLAN}; give --out a folder of its own."
            )
    elif any_there and (before.hash != plan.hash or before.count > plan.count):
        raise InputError(
            f"folder {str(folder)!r} holds another plan: {_difference(before, plan)}; give "
            "--out another folder."
        )
    if before != plan:
        partial = folder / f"{PLAN}.{os.getpid()}.part"
        try:
            with partial.open("w", encoding="utf-8") as file:
                file.write(json.dumps(plan.record(), indent=1) + "\n")
                file.flush()
                os.fsync(file.fileno())
            partial.replace(folder / PLAN)
        except OSError as error:
            raise OSError(
                error.errno or errno.EIO, error.strerror or str(error), str(folder / PLAN)
            ) from error
        finally:
            partial.unlink(missing_ok=True)


def _difference(before: Plan, now: Plan) -> str:
    """The first thing in which they differ, in words."""
    if before.kind != now.kind:
        return f"{before.kind}, not {now.kind}"
    for field in fields(before.work):
        there, here = getattr(before.work, field.name), getattr(now.work, field.name)
        if there != here:
            return (
                "another robot"
                if field.name == "robot"
                else (f"its {field.name} is {shown(there)}, not {shown(here)}")
            )
    for name in ("seed", "shard_rows", "version", "count"):
        if getattr(before, name) != getattr(now, name):
            return f"its {name} is {getattr(before, name)!r}, not {getattr(now, name)!r}"
    return "it is the same"
