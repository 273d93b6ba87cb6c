"""A UR5 with a soft robot picks and places any cube, with its weight; the check fails where it must."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")

from fastrod.hosts import SoftManiSim
from fastrod_scenes.scene import SceneError
from fastrod_scenes.ur5.pick import PickGripper, PickSuction
from fastrod_scenes.ur5.picking import Cube, Picking


@pytest.mark.study
@pytest.mark.parametrize(("scene", "seed"), [(PickSuction, 1), (PickGripper, 2), (PickGripper, 3)])
def test_any_cube_ends_on_the_spot(scene: type[PickSuction | PickGripper], seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = np.array([0.5, -0.14]) + rng.uniform(-0.04, 0.04, 2)
    place = (float(start[0]), float(start[1]))
    cube = Cube(place, mass=rng.uniform(0.05, 0.1), friction=rng.uniform(0.4, 0.8))
    figures = scene(cube).check()
    assert figures["off the spot, m"] < scene.accuracy
    assert figures["displacement sideways, m"] == pytest.approx(0.16 - start[1], abs=2e-3)


def pull(stage: Picking) -> float:
    """Force that holds the cube up [N]: of the suction, or of friction and squeeze in all its contacts."""
    b = stage.world
    if not stage.fingers:
        return -float(b.getConstraintState(b.getConstraintUniqueId(0))[2])
    points = b.getContactPoints(bodyA=stage.cube)
    return float(sum(p[9] * p[7][2] + p[10] * p[11][2] + p[12] * p[13][2] for p in points))


@pytest.mark.study
@pytest.mark.parametrize("scene", [PickSuction, PickGripper])
def test_the_held_cube_has_its_weight(scene: type[PickSuction | PickGripper]) -> None:
    """The holding force is m (g + a), a by differences of its velocity; its mass is the given one."""
    stage = scene(Cube(mass=0.1)).stage()
    before, needed, found = 0.0, [], []
    for _ in scene().play(stage):
        rate = stage.world.getBaseVelocity(stage.cube)[0][2]
        if stage.phase.name == "lift":
            needed.append(0.1 * (9.81 + (rate - before) / scene.dt))
            found.append(pull(stage))
            assert stage.world.getDynamicsInfo(stage.cube, -1)[0] == 0.1
        if stage.phase.name == "carry":
            assert_allclose(stage.state.tip_position[0], stage.tip[0], atol=1e-6)
            break
        before = rate
    assert len(needed) == 70
    assert np.ptp(needed) > 0.2
    assert_allclose(found[5:], needed[5:], rtol=0.01)  # the first steps take it off the table


@pytest.mark.study
def test_without_suction_nothing_is_lifted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SoftManiSim, "suction_grasp", lambda self, enable=True: None)
    sentence = r"^scene pick_suction: at 1\.\d+ s the cube is 0\.00\d+ m from where it was held: not lifted"
    with pytest.raises(SceneError, match=sentence):
        PickSuction().check()


@pytest.mark.study
def test_a_slippery_cube_is_dropped() -> None:
    sentence = r"^scene pick_gripper: at \d\.\d+ s the cube is 0\.00\d+ m from where it was held"
    with pytest.raises(SceneError, match=sentence):
        # with less friction still, the fingers first press it into the table
        PickGripper(Cube(mass=0.1, friction=0.03)).check()
