"""The quadruped's scenes can fail, and hold at other time steps."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod_scenes.a1 import look, push
from fastrod_scenes.a1.quadruped import MOUNT, standing
from fastrod_scenes.scene import SceneError


@pytest.mark.study
@pytest.mark.parametrize("dt", [0.002, 0.01])
def test_push_holds_at_other_time_steps(dt, monkeypatch):
    monkeypatch.setattr(push.NeckPush, "dt", dt)
    monkeypatch.setattr(push, "FOLLOWS", 0.15)  # the cube follows the tip one step behind
    figures = push.NeckPush().check()
    assert figures["cube moved, m"] == pytest.approx(0.174, abs=0.003)
    assert figures["balance of the cube's momentum, N s"] < 1e-12


@pytest.mark.study
@pytest.mark.parametrize(
    ("scene", "setting", "value", "sentence"),
    [
        (
            push.NeckPush,
            "PLACE",
            (0.36, 0.3, push.SIZE / 2),
            r"neck_push: the cube moved .* m; the neck is to push it farther than it is wide\.$",
        ),
        (
            look.NeckLook,
            "CORNERS",
            ((1, 1), (1, -1), (-1, 1), (-30, -1)),
            "neck_look: 3 of 4 corners were seen",
        ),
        (look.NeckLook, "MIDDLE", (0.77, 0.0), r"neck_look: .*the neck "),
    ],
    ids=["a push that misses", "a look that sees nothing", "a neck that touches the wall"],
)
def test_what_fails_is_reported(scene, setting, value, sentence, monkeypatch):
    monkeypatch.setattr(sys.modules[scene.__module__], setting, value)
    with pytest.raises(SceneError, match=f"^scene {sentence}"):
        scene().check()


def test_neck_stands_on_the_head_with_its_axes_as_stated():
    world, mount = standing(0.005, 0.5)
    pose, trunk = mount.motion().pose, world.getBasePositionAndOrientation(mount.body)
    axes = np.array(world.getMatrixFromQuaternion(np.roll(pose[3:], -1).tolist())).reshape(3, 3)
    # the trunk stands level to that
    assert_allclose(axes[:, 2], [np.cos(0.5), 0.0, np.sin(0.5)], atol=0.01)
    assert_allclose(axes[:, 1], [0.0, -1.0, 0.0], atol=0.01)
    assert np.abs(pose[:2] - np.array(trunk[0])[:2] - MOUNT[:2]).max() < 0.02
    assert max(abs(v) for v in world.getBaseVelocity(mount.body)[0]) < 0.01
