# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Contact
# Obstacles are simple shapes or meshes. The step finds the contact forces together with the rod.

# %%
import numpy as np

import fastrod
from fastrod.contact import box, sphere
from fastrod.model.routing import route

robot = fastrod.load_robot("five_segment_reacher")
ball = sphere(0.04, position=(0.22, 0.0, 0.33), name="ball", friction=0.3)
floor = box((1.0, 1.0, 0.02), position=(0.0, 0.0, -0.05), name="floor")
sim = fastrod.Simulator(robot, contact=fastrod.ContactScene(obstacles=[ball, floor]))

# %% [markdown]
# ## Bend toward the ball, and press on it

# %%
rest = robot.rest_tendon_length
far = route(robot).tendon_change(np.tile([0.0, 0.35], (5, 1)))
for fraction in np.linspace(0.0, 1.0, 30):
    state = sim.step(rest + fraction * far)
print("touches the ball:", state.contacts.in_contact("ball"), "solved:", state.ok)

# %% [markdown]
# ## The force on the ball balances what the base feels

# %%
print("force on the ball [N]:", state.contacts.wrench[0, 0, :3].round(3))
print("force on the base [N]:", state.base_wrench[0, :3].round(3))
state.plot()
