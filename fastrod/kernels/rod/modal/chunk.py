"""One chunk of robots of modes: brought to rest, or one step further in time, and what it then shows."""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import Floats, Ints

from ...jit import kernel
from ..lanes import W, read, write
from .balance import demands_of_stations
from .fields import G_ON, L_CORRECTION, L_COUNT, L_DONE, P_L, P_UNEVEN, ModalWork, one_task
from .follower import follow
from .gather import (
    ModalBatch,
    gather_command,
    gather_loads,
    gather_lumps,
    gather_material,
    gather_pieces,
    gather_points,
)
from .host import no_host, note_momentum, start_host
from .motion import (
    BDF1,
    REST,
    ModalMotion,
    Scheme,
    base_soon,
    begin_step,
    curvature_counted_from,
    end_step,
    note_accelerations,
    start_from_rest,
)
from .newton import hold, minimise
from .output import ModalOutput, show_chunk, show_places


class ModalRun(NamedTuple):
    """The robots of a call, and how far their Newton's method goes."""

    robots: Ints
    """(n_rows,)"""
    jump: Floats
    """(n_robots,) 1 where the inputs have jumped since the last step."""
    command: Floats
    """(n_tasks, 4, n_tendons * LANES) room for `gather_command`."""
    lanes: Floats
    """(n_tasks, 2, LANES) room for jumps and zeros."""
    iterations: Ints
    """(n_robots,) out: Newton steps that were taken; below 0 where they did not end."""
    kind: int
    """REST, or the scheme of the step."""
    dt: float
    rho: float
    tolerance: float
    """Change of bend [rad] by the last Newton step."""
    least: int
    most: int
    remembers: int
    """Scheme for which a robot that was brought to rest starts to remember."""
    given: Floats
    """(n_robots, n_q) unknowns at which the robots are held, of length 0 where Newton's method finds them."""
    ends: bool
    """Whether what was found is where the robots go on from."""


@kernel
def gather_all(robots: Ints, batch: ModalBatch, command: Floats, work: ModalWork) -> None:
    """Everything of a chunk but its motion."""
    gather_pieces(robots, batch.params, batch.ports, batch.pieces, batch.basis, work)
    gather_material(robots, batch.ports, batch.pieces, batch.basis, work)
    gather_loads(robots, batch.ports, batch.pieces, batch.basis, work)
    gather_command(robots, batch.layout, batch.params, batch.ports, command)
    gather_lumps(robots, batch.pieces, work)
    gather_points(robots, batch.points, work)


@kernel
def start_settling(robots: Ints, motion: ModalMotion, work: ModalWork) -> None:
    """Start from the q that the robots have, without inertia."""
    for w in range(W):
        work.scheme[w], work.scheme[W + w] = 0.0, 0.0
        for a in range(motion.q.shape[1]):
            write(work.q, a, w, motion.q[robots[w], a])
            write(work.q_history, a, w, motion.q[robots[w], a])


@kernel
def note_done(robots: Ints, n_robots: int, iterations: Ints, residual: Floats, work: ModalWork) -> None:
    """Newton steps of each robot, below 0 where they did not end; and the last one, at the length of the
    robot."""
    for w in range(n_robots):
        size, length = read(work.newton, L_CORRECTION, w), 0.0
        for p in range(work.piece.shape[0]):
            length += read(work.piece[p], P_L, w)
        ended = read(work.newton, L_DONE, w) > 0.0 and size >= 0.0
        taken = int(read(work.newton, L_COUNT, w))
        iterations[robots[w]] = taken if ended else -taken
        residual[robots[w]] = size * length


@kernel
def pass_of_modes(
    robots: Ints,
    n_robots: int,
    task: int,
    run: ModalRun,
    batch: ModalBatch,
    output: ModalOutput,
    every: ModalWork,
) -> None:
    """Bring a chunk to rest, or one step further in time; where an input has jumped, its accelerations are
    measured first, by a step of BDF1: as exact as generalized-alpha needs them, and without the frequencies
    that dt does not resolve (one 1,000 times shorter gave a rod whose tendons jump by 20 N 200 times the
    energy)."""
    # sliced here, without reference counts, and not by the caller, which has them
    work, command = one_task(every, task), run.command[task]
    motion, b = batch.motion, batch.basis
    jump, zero = run.lanes[task, 0], run.lanes[task, 1]
    scheme, short = Scheme(run.kind, run.dt, run.rho), Scheme(BDF1, run.dt, run.rho)
    gather_all(robots, batch, command, work)
    jumped = False
    for w in range(W):
        jump[w] = run.jump[robots[w]] if run.kind != REST else 0.0
        zero[w] = 0.0
        jumped = jumped or jump[w] > 0.0
    for stage in range(0 if jumped else 1, 2):
        if stage == 0:
            begin_step(robots, motion, short, zero, work)
            base_soon(robots, motion, short, run.dt, work.base)
            start_host(robots, batch.host, motion, short, zero, work)
        elif run.kind == REST:
            start_settling(robots, motion, work)
            no_host(work)
        else:
            begin_step(robots, motion, scheme, jump, work)
            start_host(robots, batch.host, motion, scheme, jump, work)
        if work.piece[0, P_UNEVEN * W] > 0.0:
            curvature_counted_from(b, work)
        least, most = (run.least, max(2, run.least)) if stage == 0 else (run.least, run.most)
        first = batch.pieces.first_tendon
        if len(run.given) > 0:
            hold(robots, run.given, b, first, command, work, run.ends)
            if not run.ends:
                show_places(robots, n_robots, batch, output, work, False)
                return
        else:
            minimise(b, first, command, work, run.tolerance, least, most, robots, batch.host, motion)
        follow(work)
        for p in range(work.piece.shape[0]):
            demands_of_stations(p, b, work)
        if stage == 0:
            note_accelerations(robots, n_robots, motion, short, jump, work)
            gather_loads(robots, batch.ports, batch.pieces, b, work)
            continue
        note_done(robots, n_robots, run.iterations, output.shape.residual, work)
        for w in range(n_robots if run.ends else 0):
            if run.iterations[robots[w]] > 0 and run.kind == REST:
                start_from_rest(w, robots[w], motion, run.remembers, work)
            elif run.iterations[robots[w]] > 0:
                if read(work.host, G_ON, w) > 0.0:
                    note_momentum(w, robots[w], batch.host, b, motion, work)
                end_step(w, robots[w], motion, scheme, jump[w], work)
    show_chunk(robots, n_robots, batch, output, work)
