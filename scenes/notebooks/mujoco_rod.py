# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A rod in MuJoCo
# Two ways: mount fastrod's rod on a body of a MuJoCo model, or export the robot as a chain of joints.

# %%
import tempfile
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

import fastrod
from fastrod.hosts import MujocoRod, add_capsules
from fastrod.model.routing import route

robot = fastrod.load_robot("tdcr_b")
robot = replace(robot, segments=tuple(replace(s, line_density=0.3) for s in robot.segments))  # kg/m
spec = mujoco.MjSpec.from_string(
    """<mujoco><option timestep="0.002"/><worldbody><body name="hand" pos="0 0 1">
    <joint name="swing" type="hinge" axis="0 1 0" damping="0.02"/><geom type="box" size=".03 .03 .03" mass="0.2"/>
    </body></worldbody></mujoco>"""
)
add_capsules(spec, robot, "hand")
model = spec.compile()
data = mujoco.MjData(model)

# %% [markdown]
# ## Mount it
# Host and rod exchange momentum: the hand swings as the rod bends and falls to its side.

# %%
rod = MujocoRod(robot, model, data, "hand")
pull = robot.rest_tendon_length + route(robot).tendon_change(np.tile([0.0, 0.5], (2, 1)))
for _ in range(200):
    state = rod.step(tendon_length=pull)
print(f"after 0.4 s the hand has turned by {np.degrees(data.joint('swing').qpos[0]):.1f} degrees")

# %% [markdown]
# ## Or export it
# The file says how far its tip is from the rod's, at rest.

# %%
from fastrod.commands.cli import main

path = Path(tempfile.mkdtemp()) / "tdcr_b.xml"
main(["export", "prototype", "--mjcf", str(path)])
chain = mujoco.MjModel.from_xml_path(str(path))
print(chain.nbody, "bodies,", chain.ntendon, "tendons")
