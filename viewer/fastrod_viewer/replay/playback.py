"""A measured log beside the model, worked out once, so that a page can run through it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fastrod.errors import FastrodError, InputError, LogError
from fastrod.identification.log.replay import replay
from fastrod.loading import load_robot
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.types import Flags, Floats, Ints
from fastrod_scenes.measured import detect, read

FRAMES = 1500
"""Most rows of a log whose whole shape is kept."""
POINTS_PER_SEGMENT = 20
BEFORE = "base model, its own parameters fitted"
SWITCHED_OFF = "model without its effects"
_LONG = 30.0  # usual steps: a longer pause is closed up
_EVERY_FOURTH = "every fourth of "  # how a report says that nobody named what is held out

Progress = Callable[[int, int], None]


class PlayedShapes(NamedTuple):
    """The rod at the kept frames, in the frame of the log's tip: as the camera sees it, where the model has
    one. Fields are named as in
    `State`, with frames in the place of robots."""

    position: Floats
    """(m, n_points, 3) backbone [m], POINTS_PER_SEGMENT points a segment and one more; nan where the model
    did not converge."""
    rotation: Floats
    """(m, n_points, 3, 3) log_from_material."""
    arclength: Floats
    """(m, n_points) [m]."""
    tip_position: Floats
    """(m, 3) what the camera should see of the tip [m]; off the backbone's end by the marker's offset, where
    the model has one."""
    ok: Flags
    """(m,) the model converged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlayedTrack:
    """Prediction of one model for the log. The row axis is that of `Playback.log`; residual = measured -
    predicted."""

    label: str
    robot: Robot
    tip_position: Floats
    """(n, 3) predicted, frame of the log [m]; nan where nothing was measured or the model did not
    converge."""
    points: Floats | None
    """(n, k, 3) predicted further points [m], where the log measured some."""
    residual: Floats
    """(n,) distance between measured and predicted tip [m]; nan where either is missing."""
    rms: float
    """Rms of `residual` over the whole log [m]."""
    shapes: PlayedShapes


@dataclass(frozen=True, kw_only=True)
class Findings:
    """Verdict of an identification about the log."""

    verdict: str
    summary: str
    effects: tuple[str, ...]
    """Names of the effects that `after` has and `before` has not."""
    held_out: tuple[str, ...]
    """Rows that no fit saw, in words."""
    held_out_rms: tuple[float, float]
    """Before and after, on what no fit saw, outliers left out, as the report has it [m]."""
    source: str
    """Source: a folder, or 'this session'."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Playback:
    """A log, one or two models beside it, and a clock that runs through both. Lengths in metres, in the frame
    of the log's tip."""

    log: RunLog
    """Rows with a time and all inputs, run after run."""
    nominal: Robot
    """Options that an identification of the log starts from."""
    origin: Ints
    """(n,) their rows in the log that was given."""
    time: Floats
    """(n,) from 0, non-decreasing, with the pauses between runs, and long ones inside of them, closed up
    [s]."""
    breaks: Ints
    """Rows before which a run begins or a pause was closed up: curves are interrupted there."""
    frames: Ints
    """(m,) rows whose shapes are kept, evenly spread; the first and the last are among them."""
    before: PlayedTrack
    after: PlayedTrack | None
    findings: Findings | None = None
    tested: Flags | None = None
    """(n,) rows that no fit saw, where an identification says so."""

    @staticmethod
    def of(
        log: RunLog,
        before: Robot,
        after: Robot | None = None,
        *,
        labels: Sequence[str] = ("model", "after"),
        nominal: Robot | None = None,
        findings: Findings | None = None,
        frames: int = FRAMES,
        progress: Progress | None = None,
    ) -> Playback:
        """The playback of `log` with one model or two; `labels` name them, `frames` is the most that keep
        their shape, `progress` is called with how much is done of how much. `nominal` is what a later
        identification starts from (default: `before`).

        Raises `LogError` for a log without a row to compare, `InputError` for a robot that lengths do not
        drive.
        """
        if frames < 2:
            raise InputError(f"frames is {frames!r}; a playback keeps 2 at least.")
        samples = _samples(log)
        repeated = log.measured[samples.origin] & ~samples.log.measured  # by a camera that is slower
        shown = np.flatnonzero(~repeated[samples.given])
        log, n = samples.log.rows(samples.given), len(samples.given)
        time, breaks = _clock(log)
        most = min(frames, len(shown))
        kept = shown[np.linspace(0, len(shown) - 1, most).round().astype(np.int64)]
        robots = [before] if after is None else [before, after]
        tracks = []
        each = n + len(kept)
        for k, robot in enumerate(robots):

            def notify(done: int, _: int, start: int = k * each) -> None:
                if progress is not None:
                    progress(start + min(int(done), n), each * len(robots))

            tracks.append(_track(log, robot, kept, labels[k], notify))
            if progress is not None:
                progress((k + 1) * each, each * len(robots))
        return Playback(
            log=log,
            nominal=nominal or before,
            origin=samples.origin[samples.given],
            time=time,
            breaks=breaks,
            frames=kept,
            before=tracks[0],
            after=tracks[1] if len(tracks) > 1 else None,
            findings=findings,
            tested=_tested(samples, findings),
        )

    @cached_property
    def frame_time(self) -> Floats:
        """(m,) time of each frame [s]."""
        return np.asarray(self.time[self.frames])

    @property
    def duration(self) -> float:
        """Duration of the whole playback [s]."""
        return float(self.time[-1])

    @property
    def measured_tip(self) -> Floats:
        """(n, 3) [m]; nan where it is missing."""
        return self.log.tip_position

    @cached_property
    def base_quaternion(self) -> Floats:
        """(m, 4) world_from_base at each frame, w x y z: the direction of up."""
        if self.log.base_quaternion is not None:
            return self.log.base_quaternion[self.frames]
        return np.tile(np.array(self.before.robot.base_quaternion), (len(self.frames), 1))

    @property
    def tracks(self) -> tuple[PlayedTrack, ...]:
        """`before`, and `after` where there is one."""
        return (self.before,) if self.after is None else (self.before, self.after)

    def at(self, time: float) -> int:
        """The frame that is shown at `time` [s]: the last one that is not later; times outside are those of
        the ends."""
        return int(np.clip(np.searchsorted(self.frame_time, time, side="right") - 1, 0, len(self.frames) - 1))

    def run_at(self, frame: int) -> str:
        """Label of the run that a frame belongs to; '' where the log names none."""
        return str(self.log.run[self.frames[frame]])


def load(
    path: str | Path,
    robot: str | Path | Robot | None = None,
    *,
    identified: str | Path | None = None,
    frames: int = FRAMES,
    progress: Progress | None = None,
) -> Playback:
    """The playback of the log at `path`: the identified model, where LOG_identified/ beside the log (or here,
    or the folder `identified`) holds one, beside the same model without the effects that were found;
    otherwise `robot` alone.

    `robot` is a shipped name, a path to a .toml or a Robot. Without it, a raw file of a measured set brings
    its own, and else it is that of identified.toml beside the log or in LOG_identified/. Raises `InputError`
    where none of these is there, or where `identified` is not of this log; `LogError` for a log that does not
    fit.
    """
    path = Path(path)
    given = None if robot is None else robot if isinstance(robot, Robot) else load_robot(robot)
    found = _identification(path, None if identified is None else Path(identified), given)
    log, nominal = _read(path, given, found)
    if found is None:
        label = "model with effects" if nominal.effects else "model"
        return Playback.of(log, nominal, labels=(label,), frames=frames, progress=progress)
    if found.findings.effects:
        stripped = replace(
            found.robot,
            effects=tuple(e for e in found.robot.effects if e["name"] not in found.findings.effects),
        )
        labels: tuple[str, ...] = (SWITCHED_OFF, with_effects(found.findings.effects))
        both: tuple[Robot, Robot | None] = (stripped, found.robot)
    else:
        labels, both = (BEFORE,), (found.robot, None)
    return Playback.of(
        log, *both, labels=labels, nominal=nominal, findings=found.findings, frames=frames, progress=progress
    )


def identify(
    playback: Playback,
    *,
    held_out: Sequence[str] = (),
    frames: int = FRAMES,
    progress: Callable[[str, int, int], None] | None = None,
) -> Playback:
    """Look for what the model lacks, in this thread (seconds to minutes): the playback of the base model with
    its own parameters fitted, beside the model with what was found; one model where nothing was. `progress`
    is called with what is done, and how far of how much.

    Raises what `fastrod.identification.attribution.identify` raises.
    """
    from fastrod.identification import attribution

    # A Result has the base model's prediction but not its robot, whose shape is drawn here: without effects,
    # `identified` is that robot.
    base = attribution.identify(playback.log, playback.nominal, held_out=held_out, max_effects=0)
    result = attribution.identify(playback.log, playback.nominal, held_out=held_out, progress=progress)
    findings = Findings(
        verdict=result.verdict,
        summary=result.summary,
        effects=tuple(effect.name for effect in result.effects),
        held_out=tuple(result.held_out),
        held_out_rms=(result.test.before, result.test.after),
        source="this session",
    )
    made = Playback.of(
        playback.log,
        base.identified,
        result.identified if findings.effects else None,
        labels=(BEFORE, with_effects(findings.effects)),
        nominal=playback.nominal,
        findings=findings,
        frames=frames,
    )
    return replace(made, origin=playback.origin[made.origin])


def with_effects(names: Sequence[str]) -> str:
    """The label of a model with these effects."""
    words = [name.replace("_", " ") for name in names]
    return (
        f"with {', '.join(words[:-1])} and {words[-1]}"
        if len(words) > 1
        else f"with {words[0]}"
        if words
        else "with no effect"
    )


class _Found(NamedTuple):
    robot: Robot
    findings: Findings


def _identification(path: Path, folder: Path | None, given: Robot | None) -> _Found | None:
    """The identification in `folder`, or else the first of this log, and of the robot `given`, that lies
    where the command puts it."""
    if folder is not None:
        found = _report(folder, path)
        if found is None:
            raise InputError(
                f"folder {str(folder)!r} lacks report.json and identified.toml of log {path.stem!r}; "
                "fastrod identify writes them."
            )
        if given is not None and given.n_tendons != found.robot.n_tendons:
            raise InputError(
                f"robot {given.name!r} has {given.n_tendons} tendons, the one of {str(folder)!r} has "
                f"{found.robot.n_tendons}; "
                "leave --robot out to take the identified one."
            )
        return found
    for place in dict.fromkeys((path.parent / f"{path.stem}_identified", Path(f"{path.stem}_identified"))):
        found = _report(place, path)
        if found is not None and (
            given is None or (given.name, given.n_tendons) == (found.robot.name, found.robot.n_tendons)
        ):
            return found
    return None


def _report(folder: Path, path: Path) -> _Found | None:
    """Return what report.json and identified.toml in `folder` say about the log at `path`; None where they
    are not there, or of another log."""
    report, robot = folder / "report.json", folder / "identified.toml"
    if not (report.is_file() and robot.is_file()):
        return None
    try:
        data: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))
        errors = data["error"]["held_out"]
        nan = float("nan")
        findings = Findings(
            verdict=str(data["verdict"]),
            summary=str(data.get("summary", "")),
            effects=tuple(str(e["name"]) for e in data["effects"]),
            held_out=tuple(map(str, data["held_out"])),
            source=str(folder),
            held_out_rms=tuple(
                nan if errors[key] is None else float(errors[key]) for key in ("before_rms_m", "after_rms_m")
            ),  # type: ignore[arg-type]
        )
        named = data["log"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{str(report)!r} is not a report of fastrod identify: {error or type(error).__name__}."
        ) from error
    return _Found(load_robot(robot), findings) if named == path.stem else None


def _read(path: Path, given: Robot | None, found: _Found | None) -> tuple[RunLog, Robot]:
    """The log at `path`, and the robot that an identification starts from."""
    if detect(path):
        return read(path, given)
    beside = path.parent / "identified.toml"
    robot = (
        given
        or (None if found is None else found.robot)
        or (load_robot(beside) if path.is_file() and beside.is_file() else None)
    )
    if robot is None and not path.is_file():
        raise LogError(f"log {str(path)!r} cannot be read: there is no such file.")
    return read(path, robot)


def _samples(log: RunLog) -> Any:
    from fastrod.identification.log.samples import sample  # loads numba

    if not log.measured.any():
        raise LogError(
            f"log {log.name!r} has no row in which every input and the tip are there; there is "
            "nothing to compare."
        )
    return sample(log)


def _tested(samples: Any, findings: Findings | None) -> Flags | None:
    """(n,) rows that no fit saw, by the words of a report; None where they do not fit the log."""
    if findings is None:
        return None
    from fastrod.identification.log.split import held_out_rows

    words = (
        []
        if len(findings.held_out) == 1 and findings.held_out[0].startswith(_EVERY_FOURTH)
        else list(findings.held_out)
    )
    try:
        held: Flags = held_out_rows(samples, words)[0][samples.given]
        return held
    except FastrodError:
        return None  # the report is of several logs, whose runs have other names there


def _clock(log: RunLog) -> tuple[Floats, Ints]:
    """(n,) time of the playback [s], and the rows before which it leaves time out."""
    step = np.diff(log.t)
    new_run = log.run[1:] != log.run[:-1]
    inside = step[~new_run & (step > 0.0)]
    usual = float(np.median(inside)) if len(inside) else 1.0
    cut = new_run | (step > _LONG * usual)
    return np.concatenate([[0.0], np.cumsum(np.where(cut, usual, step))]), np.flatnonzero(cut) + 1


def _track(log: RunLog, robot: Robot, frames: Ints, label: str, progress: Progress) -> PlayedTrack:
    answer = replay(log, robot, progress=progress)
    residual = np.asarray(np.linalg.norm(answer.residual, axis=1))
    return PlayedTrack(
        label=label,
        robot=robot,
        tip_position=answer.tip_position,
        points=answer.points,
        residual=residual,
        rms=answer.rms,
        shapes=_shapes(log, robot, frames),
    )


def _shapes(log: RunLog, robot: Robot, frames: Ints) -> PlayedShapes:
    """The rod that `replay` solves, whole: with effects, the one of `forward.predict`, and its camera sees
    the backbone too."""
    from fastrod.identification.log import forward
    from fastrod.identification.log.inputs import base_of, inputs
    from fastrod.identification.log.samples import sample
    from fastrod.identification.log.unknowns import known_model
    from fastrod.simulator import Simulator

    bare, cut = replace(robot, effects=()), log.rows(frames)
    base, origin = base_of(cut, robot)
    if not robot.effects:
        given: dict[str, Any] = dict(inputs(cut, robot))
        state = Simulator(bare, n_robots=len(frames), points_per_segment=POINTS_PER_SEGMENT).settle(**given)
        position, rotation, arclength = state.position, state.rotation, state.arclength
    else:
        model = known_model(robot)
        samples = sample(log)
        place = forward.prepare_log(samples.on(samples.given[frames]), robot, model.wiring)
        effects = forward.effects_at(model, np.zeros(0))
        sim = Simulator(bare, n_robots=len(frames), points_per_segment=forward.N_STEPS)
        _, opened, _ = place.solve(effects, forward.PredictedRod(place.samples, robot), robot)
        state = sim.settle_ports(*place.kernel(opened), forward.TOLERANCE * robot.length)
        arclength = _finer(state.arclength, robot.n_segments)
        fine = sim.shape(arclength)
        position, rotation = fine.position, fine.rotation
    into = np.swapaxes(base, 1, 2)
    position = np.einsum("nij,nkj->nki", into, position - origin)
    rotation = into[:, None] @ rotation
    tip = position[:, -1]
    if robot.effects:
        seen = place.see(forward.PredictedPose(tip, rotation[:, -1], position, state.ok), effects)
        rotated = seen.rotation @ np.swapaxes(rotation[:, -1], 1, 2)
        tip, position, rotation = seen.position, seen.points, rotated[:, None] @ rotation
    for array in (tip, position, rotation):
        array[~state.ok] = np.nan
    return PlayedShapes(position, rotation, arclength, tip, state.ok)


def _finer(arclength: Floats, n_segments: int) -> Floats:
    """(m, n_segments * POINTS_PER_SEGMENT + 1) arclengths, even within each segment, from the nodes of a
    coarser rod."""
    ends = arclength[:, :: (arclength.shape[1] - 1) // n_segments]
    fraction = np.linspace(0.0, 1.0, POINTS_PER_SEGMENT, endpoint=False)
    inner = ends[:, :-1, None] + np.diff(ends, axis=1)[:, :, None] * fraction
    return np.concatenate([inner.reshape(len(ends), -1), ends[:, -1:]], axis=1)
