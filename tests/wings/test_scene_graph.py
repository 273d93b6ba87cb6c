"""The viewer's drawing lies where the rod is; nothing here needs a browser."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod

import fastrod
from fastrod.errors import InputError
from fastrod.model.segment_actions import SegmentActions
from fastrod_scenes import load
from fastrod_viewer.picture import palette
from fastrod_viewer.picture.curves import tangents
from fastrod_viewer.picture.scene_graph import (
    SHAPES,
    Picture,
    Trail,
    ViewOptions,
    bounds,
    ghost,
    grid_places,
    legend,
)
from fastrod_viewer.worlds.world import Body, DrawnRods


def seen(robots, state, place=None):
    robots = robots if isinstance(robots, tuple) else (robots,)
    radius = tuple(segment.body_radius or 0.009 for segment in robots[0].segments)
    return DrawnRods(robots, state, np.zeros((len(state.ok), 3)) if place is None else place, radius)


def bent(name, n_robots=1, points=20, place=None):
    """Robots bent at random as they are drawn, their simulator and their state."""
    robot = fastrod.load_robot(name)
    simulator = fastrod.Simulator(robot, n_robots, points_per_segment=points)
    inputs = {}
    if robot.n_tendons:
        moves = np.random.default_rng(3).uniform(-0.004, 0.004, (n_robots, robot.n_segments, 3))
        inputs = SegmentActions(robot).inputs((moves * [0.0, 1.0, 1.0]).reshape(n_robots, -1))
    state = simulator.settle(**inputs)
    assert state.ok.all()
    return seen(robot, state, place), simulator, state


def drawn(rods, tip_force=None, **options):
    """The batches of one picture, each of them sound."""
    return check(Picture(rods, ViewOptions(**options)).frame(rods, tip_force=tip_force))


def lost(state, rows):
    """The state as it is when robots of these rows have no shape."""
    gone = {}
    for name in ("position", "rotation", "curvature", "arclength", "tension"):
        gone[name] = getattr(state, name).copy()
        gone[name][rows] = np.nan
    ok = np.ones(len(state.ok), bool)
    ok[rows] = False
    return replace(state, ok=ok, **gone)


def ends(batch):
    """Both ends of pieces along z, from their centres, orientations and lengths."""
    half = 0.5 * batch.scale[:, 2:] * tangents(batch.wxyz.astype(float))
    return batch.position - half, batch.position + half


def check(batches):
    for batch in batches.values():
        n = len(batch.position)
        arrays = (batch.position, batch.wxyz, batch.scale, batch.color)
        assert [a.shape for a in arrays] == [(n, 3), (n, 4), (n, 3), (n, 3)]
        assert [a.dtype for a in arrays] == [np.float32] * 3 + [np.uint8]
        assert all(np.isfinite(a).all() for a in batch[1:])
        assert_allclose(np.linalg.norm(batch.wxyz, axis=1), 1.0, atol=1e-6)
        assert (batch.scale >= 0.0).all()
    return batches


# the rod


def test_pieces_of_an_arc_lie_on_the_arc():
    robot = rod(compliance=0.0)  # tendons that do not stretch bend it by just the angle
    angle = 1.2
    state = fastrod.Simulator(robot).settle(bend(robot, 0.0, angle))
    body = drawn(seen(robot, state), tendons=False)["body"]
    n, length = 40, 0.07
    middle = (np.arange(n) + 0.5) / n * angle
    step = angle / n
    radius = length / angle * np.cos(step / 2)  # of the circle through the middles of chords of an arc
    arc = np.stack([length / angle - radius * np.cos(middle), 0.0 * middle, radius * np.sin(middle)], axis=1)
    assert_allclose(body.position, arc, atol=1e-5)
    direction = np.stack([np.sin(middle), 0.0 * middle, np.cos(middle)], axis=1)
    assert_allclose(tangents(body.wxyz.astype(float)), direction, atol=2e-4)


@pytest.mark.parametrize("name", fastrod.robot_names())
@pytest.mark.parametrize("points", [4, 10, 20])
def test_line_follows_the_rod(name, points):
    rods, simulator, state = bent(name, points=points)
    picture = Picture(rods)
    body, p = check(picture.frame(rods))["body"], picture.pieces
    at, joints = np.linspace(0.0, 1.0, p + 1), state.arclength[0, ::points]
    s = np.concatenate([a + at * (b - a) for a, b in itertools.pairwise(joints)])
    pose = simulator.shape(np.minimum(s, joints[-1]))
    on = pose.position[0].reshape(-1, p + 1, 3)
    tolerance, angle = (1e-4, 0.01) if points == 4 else (1e-5, 1e-3)
    middle = 0.5 * (on[:, 1:] + on[:, :-1])
    assert_allclose(body.position.reshape(-1, p, 3), middle, atol=tolerance * rods.robots[0].length)
    chord = on[:, 1:] - on[:, :-1]
    size = np.linalg.norm(chord, axis=-1, keepdims=True)
    assert_allclose(tangents(body.wxyz.astype(float)).reshape(-1, p, 3), chord / size, atol=angle)
    # neighbours overlap, by the radius times the angle between them, so that no wedge opens on the outside of
    # the bend
    over = body.scale[:, 2].reshape(-1, p, 1) - size
    tangent = pose.rotation[0, :, :, 2].reshape(-1, p + 1, 3)
    change = np.linalg.norm(tangent[:, 1:] - tangent[:, :-1], axis=-1, keepdims=True)
    # rotates evenly between nodes
    assert_allclose(over, picture.tube_radius[:, None, None] * change, atol=1e-2 * size.max())
    assert (over >= -1e-6).all()


def test_nodes_that_are_not_even_do_not_show():
    robot = fastrod.load_robot("tdcr_a")
    simulator = fastrod.Simulator(robot, points_per_segment=20)
    loads = [(0.133, (0.1, 0.0, 0.0)), (0.207, (0.0, 0.1, 0.0))]
    state = simulator.settle(robot.rest_tendon_length, point_force=loads)
    assert np.ptp(np.diff(state.arclength[0])) > 1e-3
    body = drawn(seen(robot, state))["body"]
    assert_allclose(np.linalg.norm(np.diff(body.position[:40], axis=0), axis=1), 0.2 / 40, rtol=1e-3)
    assert_allclose(body.position, simulator.shape((np.arange(80) + 0.5) * 0.4 / 80).position[0], atol=1e-5)


def test_tip_is_at_the_tip():
    rods, _, state = bent("five_segment_reacher", n_robots=3)
    tip = drawn(rods, body="skin")["tip"]
    assert tip.shape == "cap"
    assert_allclose(tip.position, state.tip_position, atol=1e-6)
    assert_allclose(tangents(tip.wxyz.astype(float)), state.tip_rotation[:, :, 2], atol=1e-6)
    assert_allclose(tip.scale, 0.012)


# what sits on it


@pytest.mark.parametrize("name", ["prototype", "tdcr_a", "tdcr_b", "five_segment_reacher"])
def test_tendons_run_at_their_offsets_and_are_as_long_as_they_are(name):
    rods, simulator, state = bent(name)
    robot, tendons = rods.robots[0], drawn(rods)["tendons"]
    first, last = ends(tendons)
    pieces = 10
    pairs = [(t, k) for t, end in enumerate(robot.tendon_segment) for k in range(end + 1)]
    assert len(tendons.position) == pieces * len(pairs)
    joints = state.arclength[0, ::20]
    total = np.zeros(robot.n_tendons)
    for i, (t, k) in enumerate(pairs):
        own = slice(pieces * i, pieces * (i + 1))
        s = joints[k] + np.linspace(0.0, 1.0, pieces + 1) * (joints[k + 1] - joints[k])
        pose = simulator.shape(np.minimum(s, joints[-1]))
        offset = np.array([*robot.tendons[t].position(int(robot.tendon_segment[t]) + 1)[k], 0.0])
        on = pose.position[0] + pose.rotation[0] @ offset
        assert_allclose(tendons.position[own], 0.5 * (on[1:] + on[:-1]), atol=2e-6)
        # a chain is as long as its tendon, so pieces are as long as their arcs
        assert_allclose(first[own], on[:-1], atol=3e-5)
        assert_allclose(last[own], on[1:], atol=3e-5)
        total[t] += tendons.scale[own, 2].sum(dtype=float)
    assert_allclose(total, state.path_length[0], rtol=1e-4)


def test_tendons_on_the_skin_are_on_its_surface():
    rods, _, _ = bent("tdcr_b")
    assert "tendons" not in drawn(rods, body="skin")
    found = drawn(rods, body="skin", color_by="tension", pieces=32)
    nearest = np.linalg.norm(found["tendons"].position[:, None] - found["body"].position, axis=2).min(1)
    assert_allclose(nearest, 0.012, atol=4e-4)


def test_a_spacer_stands_at_the_base_and_at_the_end_of_every_segment():
    rods, _, state = bent("five_segment_reacher")
    spacers = drawn(rods)["spacers"]
    assert spacers.shape == "disc"
    for k in range(6):
        away = np.linalg.norm(spacers.position - state.position[0, 20 * k], axis=1)
        assert away.min() < 1e-6
        at = int(away.argmin())
        assert spacers.scale[at, 2] > np.median(spacers.scale[:, 2])
        assert_allclose(tangents(spacers.wxyz[at].astype(float)), state.rotation[0, 20 * k, :, 2], atol=1e-5)
    steps = np.linalg.norm(np.diff(spacers.position, axis=0), axis=1)
    assert_allclose(steps, 1.6 * 0.012, rtol=0.2)
    assert (spacers.scale[1:, 0] == np.float32(0.012)).all()


def test_robot_without_tendons_is_its_body():
    rods, _, _ = bent("ethz_beam")
    options = ViewOptions(color_by="tension")
    picture = Picture(rods, options)
    found = check(picture.frame(rods))
    assert set(found) == {"body", "tip", "load_shafts", "load_heads"}
    assert_allclose(found["body"].scale[:, 0], 0.015)
    assert "no tendons" in legend(rods, options, picture).html()


# frames


@pytest.mark.parametrize(
    "options",
    [ViewOptions(frames=True), ViewOptions(color_by="strain", body="skin"), ViewOptions(color_by="tension")],
)
def test_counts_stay_over_a_rollout(options):
    robot = fastrod.load_robot("five_segment_reacher")
    actions = SegmentActions(robot)
    simulator = fastrod.Simulator(robot, 2, points_per_segment=10)
    picture, counts = None, []
    for k in range(20):
        rods = seen(robot, simulator.step(**actions.inputs(np.tile([0.0, 0.003 * k / 20, 0.001], 5))))
        picture = picture or Picture(rods, options)
        found = check(picture.frame(rods, tip_force=np.array([0.0, 0.01 * k, 0.0])))
        counts.append({name: len(batch.position) for name, batch in found.items()})
    assert all(count == counts[0] for count in counts)
    assert counts[0]["body"] == 2 * 5 * 40


@pytest.mark.parametrize("color_by", ["segment", "curvature", "tension"])
def test_batch_is_its_robots(color_by):
    place, options = grid_places(3, 0.5), ViewOptions(color_by=color_by)
    rods, _, state = bent("tdcr_a", n_robots=3, place=place)
    picture = Picture(rods, options)
    many = picture.frame(rods, tip_force=np.eye(3))
    along = [name for name, value in vars(state).items() if isinstance(value, np.ndarray)]
    for i in range(3):
        one = replace(state, **{name: getattr(state, name)[i : i + 1] for name in along})
        alone = seen(rods.robots, one, place[i : i + 1])
        single = Picture(alone, options)
        if picture.range is not None:
            single.range = picture.range
        for name, batch in single.frame(alone, tip_force=np.eye(3)[i]).items():
            n = len(batch.position)
            for mine, theirs in zip(batch[1:], many[name][1:], strict=True):
                assert_array_equal(mine, theirs[i * n : (i + 1) * n])


def test_place_moves_the_picture():
    rods, _, state = bent("prototype", n_robots=2)
    place = grid_places(2, 0.4)
    here, there = drawn(rods), drawn(seen(rods.robots, state, place))
    for name in here:
        if not here[name].scale.any():  # arrows of loads that are not there
            continue
        shift = there[name].position.reshape(2, -1, 3) - here[name].position.reshape(2, -1, 3)
        assert_allclose(shift, np.broadcast_to(place[:, None], shift.shape), atol=1e-7)


def test_many_robots_are_drawn_light():
    found = drawn(bent("prototype", n_robots=17, points=10)[0], tendons=True, spacers=True)
    assert set(found) == {"body", "tip", "load_shafts", "load_heads"}
    assert len(found["body"].position) == 17 * 10


def test_robot_that_is_lost_stays_and_is_red():
    rods, _, state = bent("prototype", n_robots=2)
    picture = Picture(rods)
    before, after = picture.frame(rods), check(picture.frame(seen(rods.robots, lost(state, [1]))))
    assert_array_equal(after["body"].position, before["body"].position)
    assert_array_equal(after["tendons"].position, before["tendons"].position)
    red = after["body"].color.reshape(2, -1, 3).astype(int)
    assert_array_equal(red[0], before["body"].color.reshape(2, -1, 3)[0])
    assert (red[1, :, 0] > red[1, :, 1] + 60).all()


def test_robot_that_was_never_there_is_straight():
    rods, _, state = bent("prototype")
    found = drawn(seen(rods.robots, lost(state, [0])))
    assert_allclose(found["body"].position[:, 2], (np.arange(40) + 0.5) * 0.07 / 40, atol=1e-7)


# colours


def test_segments_have_colours_of_their_own():
    color = drawn(bent("five_segment_reacher")[0])["body"].color.reshape(5, 40, 3)
    assert (color == color[:, :1]).all()
    assert len(np.unique(color[:, 0], axis=0)) == 5
    assert len(palette.SEGMENTS) >= 8
    assert min(np.abs(np.subtract(*pair)).sum() for pair in itertools.combinations(palette.SEGMENTS, 2)) > 60


def test_more_bend_is_brighter():
    robot = fastrod.load_robot("prototype")
    lengths = np.stack([bend(robot, 0.0, angle) for angle in (0.1, 0.5, 0.9, 1.3)])
    rods = seen(robot, fastrod.Simulator(robot, 4).settle(lengths))
    luminance, largest = np.array([0.2126, 0.7152, 0.0722]), 1.3 / 0.07
    for color_by in ("curvature", "strain"):
        color = drawn(rods, color_by=color_by)["body"].color.reshape(4, 40, 3)
        assert (np.diff(color.mean(1) @ luminance) > 10.0).all()
    assert (np.diff(palette.SEQUENTIAL @ luminance) > -0.8).all()  # of 255: rounding
    top = Picture(rods, ViewOptions(color_by="curvature")).range.see(np.array([largest]))
    assert largest <= top <= 1.5 * largest


def test_proximal_segment_has_its_own_curvature_up_to_the_joint():
    robot = fastrod.load_robot("tdcr_a")
    inputs = SegmentActions(robot).inputs([0.0, 0.008, 0.0, 0.0, -0.001, 0.0])
    state = fastrod.Simulator(replace(robot, gravity=(0.0, 0.0, 0.0))).settle(**inputs)
    color = drawn(seen(robot, state), color_by="curvature")["body"].color.reshape(2, 40, 3).astype(int)
    assert np.abs(np.diff(color[0], axis=0)).max() <= 4
    assert np.abs(color[0, -1] - color[1, 0]).max() > 60


def test_range_grows_and_does_not_shrink():
    scale = palette.Range(0.9)
    assert scale.top == 1.0
    assert scale.see(np.array([-2.4, 0.1])) == 3.0
    assert scale.see(np.array([0.1])) == 3.0
    assert scale.see(np.append(np.zeros(200), 1e9)) == 3.0  # an outlier
    scale.forget()
    assert scale.top == 1.0


def test_slack_tendon_is_light_and_thin():
    whole = rod("tendon_length")
    tendons = tuple(replace(tendon, unilateral=True) for tendon in whole.segments[0].tendons)
    robot = replace(whole, segments=(replace(whole.segments[0], tendons=tendons),))
    pulled = bend(robot, 0.0, 0.8) + np.array([-0.0001, 0.0001, 0.003, 0.0001])
    state = fastrod.Simulator(robot).settle(pulled)
    slack = state.tension[0] <= 1e-6
    assert slack.any()
    assert not slack.all()
    rods = seen(robot, state)
    picture = Picture(rods)
    tendons = picture.frame(rods)["tendons"]
    color, thick = tendons.color.reshape(4, -1, 3), tendons.scale[:, 0].reshape(4, -1)
    assert (color[slack] == palette.SLACK).all()
    assert (color[~slack] == palette.TAUT).all()
    assert thick[slack].max() < thick[~slack].min()
    assert "slack" in legend(rods, ViewOptions(), picture).html()
    assert "pushing" not in legend(rods, ViewOptions(), picture).html()


def test_pushing_rod_is_violet_and_tension_has_two_sides():
    robot = fastrod.load_robot("prototype")
    state = fastrod.Simulator(robot).settle(bend(robot, 0.0, 0.8))
    pull, push = int(state.tension[0].argmax()), int(state.tension[0].argmin())
    assert state.tension[0, push] < -0.01
    rods = seen(robot, state)
    color = drawn(rods)["tendons"].color.reshape(4, -1, 3)
    assert (color[push] == palette.PUSHING).all()
    assert (color[pull] == palette.TAUT).all()
    by = Picture(rods, ViewOptions(color_by="tension"))
    shown = by.frame(rods)
    color = shown["tendons"].color.reshape(4, -1, 3)[:, 0].astype(int)
    assert by.range.top >= state.tension.max()
    assert color[pull, 0] > color[pull, 2] + 30
    assert color[push, 2] > color[push, 0] + 30
    assert (shown["body"].color == palette.BODY).all()


# arrows


def test_contact_arrow_begins_on_the_wall_and_points_off_it():
    scene = load("wall")
    simulator = scene.simulator()
    picture, counts, drawn = None, set(), 0
    for k in range(101):
        state = simulator.step(**scene.inputs(k * scene.dt))
        rods = seen(simulator.robots, state)
        picture = picture or Picture(rods)
        found = check(picture.frame(rods))
        counts.add((len(found["contact_shafts"].position), len(found["contact_heads"].position)))
        there = found["contact_heads"].scale[:, 2] > 0.0
        n = int((np.linalg.norm(np.nan_to_num(state.contacts.force[0]), axis=-1) > 0.0).sum())
        assert there.sum() == n
        drawn += n
    assert counts == {(32, 32)}
    assert drawn > 40
    # the wall is free where x < 0.02: off it is -x
    head, shaft = (found[name] for name in ("contact_heads", "contact_shafts"))
    assert_allclose(tangents(head.wxyz[there].astype(float)), [[-1.0, 0.0, 0.0]] * n, atol=1e-6)
    start, end = (each[there] for each in ends(shaft))
    assert_allclose(start, state.contacts.point[0], atol=1e-6)
    assert_allclose(end, head.position[there], atol=1e-6)
    force, unit = np.linalg.norm(state.contacts.force[0], axis=-1), 0.0022 / 0.07**2
    size = shaft.scale[there, 2] + head.scale[there, 2]
    assert_allclose(size, 0.3 * 0.07 * force / (force + unit), rtol=1e-5)


def test_load_arrow_is_at_the_tip():
    rods, _, state = bent("prototype")
    for nothing in (None, np.array([np.nan, 0.0, 0.0])):
        assert not drawn(rods, tip_force=nothing)["load_heads"].scale.any()
    shafts = drawn(rods, tip_force=np.array([0.0, 0.0, -0.2]))["load_shafts"]
    assert_allclose(tangents(shafts.wxyz.astype(float)), [[0.0, 0.0, -1.0]], atol=1e-6)
    assert_allclose(ends(shafts)[0], state.tip_position, atol=1e-6)


def test_axes_of_the_tip():
    rods, _, state = bent("tdcr_a")
    found = drawn(rods, frames=True)["frames"]
    assert_allclose(tangents(found.wxyz.astype(float)), state.tip_rotation[0].T, atol=1e-5)
    assert_allclose(ends(found)[0], np.broadcast_to(state.tip_position, (3, 3)), atol=1e-5)
    assert_array_equal(found.color, palette.AXES)


def test_ghost_goes_through_its_points():
    points = np.random.default_rng(1).normal(size=(9, 3))
    points[3] = points[2] - [0.0, 0.0, 0.4]  # straight down, where the shortest rotation of z is not unique
    line = ghost(points, 0.001, (9, 9, 9))
    first, last = ends(line)
    assert_allclose(first, points[:-1], atol=1e-6)
    assert_allclose(last, points[1:], atol=1e-6)
    points[5] = np.nan
    line = check({"ghost": ghost(points, 0.001, (9, 9, 9))})["ghost"]
    assert_array_equal(line.scale[:, 2] > 0.0, [True] * 4 + [False] * 2 + [True] * 2)
    with pytest.raises(InputError, match=r"points has shape \(1, 3\); a ghost needs \(n, 3\)"):
        ghost(points[:1], 0.001, (9, 9, 9))


def test_trail_keeps_the_last_positions_and_fades():
    trail = Trail(4, 0.01)
    assert not check({"trail": trail.instances(0.001, (200, 0, 0))})["trail"].scale.any()
    for x in (0.0, 0.005, 0.02, np.nan, 0.04, 0.06, 0.08, 0.10):
        trail.add(np.array([x, 0.0, 0.0]))
    line = check({"trail": trail.instances(0.001, (200, 0, 0))})["trail"]
    assert len(trail) == 5
    assert_allclose(line.position[:, 0], [0.03, 0.05, 0.07, 0.09], atol=1e-7)
    assert (np.diff(line.color[:, 1].astype(int)) < 0).all()
    assert (np.diff(line.scale[:, 0]) > 0.0).all()
    assert tuple(line.color[-1]) == (200, 0, 0)
    trail.clear()
    assert len(trail) == 0
    with pytest.raises(InputError, match="a trail of 0 pieces"):
        Trail(0, 0.01)


# meshes, places, words


@pytest.mark.parametrize(
    ("name", "volume"), [("bar", np.pi), ("disc", np.pi), ("ball", 4.0 * np.pi / 3.0), ("cone", np.pi / 3.0)]
)
def test_closed_meshes_are_closed_and_outward(name, volume):
    mesh = SHAPES[name]
    edges = {(int(a), int(b)) for face in mesh.faces for a, b in zip(face, np.roll(face, -1), strict=True)}
    assert len(edges) == 3 * len(mesh.faces)
    assert {(b, a) for a, b in edges} == edges
    corners = mesh.vertices[mesh.faces].astype(float)
    signed = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert signed == pytest.approx(volume, rel=0.05)
    assert signed < volume


@pytest.mark.parametrize("name", ["tube", "thin_tube", "cap"])
def test_open_meshes_face_outward(name):
    mesh = SHAPES[name]
    corners = mesh.vertices[mesh.faces].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = corners.mean(1) * [1.0, 1.0, name == "cap"]
    assert (np.einsum("ij,ij->i", normal, outward) > 0.0).all()
    assert_allclose(np.linalg.norm(mesh.vertices[:, : 3 if name == "cap" else 2], axis=1), 1.0, atol=1e-6)


def test_bounds_hold_the_robots():
    place = grid_places(5, 0.7)
    rods, _, state = bent("five_segment_reacher", n_robots=5, place=place)
    centre, radius = bounds(rods)
    away = np.linalg.norm(state.position + place[:, None] - centre, axis=-1)
    assert away.max() < radius < 3.0
    nowhere = seen(rods.robots, replace(state, position=np.full_like(state.position, np.nan)), place)
    assert_allclose(bounds(nowhere)[0], [0.0, 0.0, 0.25], atol=1e-12)  # lost robots count as straight ones
    one = bent("tdcr_a")[0]
    assert bounds(one)[1] == pytest.approx(0.62 * 0.4)  # room to bend to both sides
    cube, far = np.array([[-1.0] * 3, [1.0] * 3], np.float32), np.array([[0.4, 0, 0, 1, 0, 0, 0]], float)
    wide = Body("floor", cube, np.zeros((0, 3), np.uint32), (0, 0, 0))
    near = wide._replace(name="box", vertices=0.05 * cube)
    # a floor is no reason to step back
    assert bounds(one, [wide], far)[1] == pytest.approx(0.62 * 0.4)
    centre, radius = bounds(one, [near], far)
    corners = np.array([[0.45, y, z] for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    assert (np.linalg.norm(corners - centre, axis=1) <= radius + 1e-12).all()


@pytest.mark.parametrize("color_by", ["segment", "curvature", "strain", "tension"])
def test_legend_says_what_colours_mean(color_by):
    rods, options = bent("tdcr_a")[0], ViewOptions(color_by=color_by)
    picture = Picture(rods, options)
    picture.frame(rods)
    found = legend(rods, options, picture)
    html = found.html()
    for tag in ("div", "span"):
        assert html.count(f"<{tag}") == html.count(f"</{tag}>")
    assert "class=" not in html
    if color_by == "segment":
        entries = [(f"Segment {k}", color) for k, color in enumerate(palette.SEGMENTS[:2], 1)]
        assert [(entry.name, entry.color) for entry in found.entries] == entries
        assert "Segment 2" in html
    else:
        assert found.ticks[-1].value == picture.range.top
        assert 3 <= len(found.ticks) <= 5
        assert "linear-gradient" in html
        assert f"[{found.unit}]" in html
    assert ("taut" in html) == (color_by != "tension")


def test_bad_option_is_one_sentence():
    with pytest.raises(InputError, match=r"^ViewOptions.color_by is 'curvatur'; did you mean 'curvature'\?$"):
        ViewOptions(color_by="curvatur")
    with pytest.raises(InputError, match=r"^ViewOptions.body is 'skins'; did you mean 'skin'\?$"):
        ViewOptions(body="skins")
    with pytest.raises(InputError, match=r"^ViewOptions.tendons is 1; it must be True or False\.$"):
        ViewOptions(tendons=1)
    sentence = r"^ViewOptions.pieces is 0; it must be a whole number, at least 1, or None\.$"
    with pytest.raises(InputError, match=sentence):
        ViewOptions(pieces=0)


def test_state_of_the_tip_only_is_refused():
    robot = fastrod.load_robot("prototype")
    state = fastrod.Simulator(robot, outputs="tip").settle(robot.rest_tendon_length)
    with pytest.raises(InputError, match="outputs='full'"):
        Picture(seen(robot, state))
