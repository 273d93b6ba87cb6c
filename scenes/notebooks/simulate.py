# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Simulate and draw
# A robot is a frozen description, a simulator solves a batch of it, and a state holds what came out.

# %%
import numpy as np

import fastrod

robot = fastrod.load_robot("prototype")
sim = fastrod.Simulator(robot)
state = sim.settle(robot.rest_tendon_length + [-0.004, 0.0, 0.004, 0.0])  # m
state.plot()
state

# %% [markdown]
# ## A thousand at once
# The robot axis comes first. One number for all robots may be given once.

# %%
sim = fastrod.Simulator(robot, n_robots=1000)
pull = np.random.default_rng(0).uniform(-0.003, 0.003, (1000, 2))
state = sim.settle(robot.rest_tendon_length + np.column_stack([pull, -pull]))
print(state.ok.all(), (1e3 * state.tip_position.std(axis=0)).round(1), "mm")

# %% [markdown]
# ## In motion
# With inertia the rod rings. The ETH beam is pulled down at its tip and let go.

# %%
beam = fastrod.load_robot("ethz_beam")
sim = fastrod.Simulator(beam, dt=1e-3, dynamics=True)
sim.settle(tip_force=(-0.5, 0.0, 0.0))  # gravity points along -x
height = [float(sim.step().tip_position[0, 0]) for _ in range(400)]
print(f"the tip swings between {1e3 * min(height):.1f} and {1e3 * max(height):.1f} mm")

# %% [markdown]
# ## Sensitivities
# The Jacobian of the tip by tendon lengths comes from one solve, not from differences.

# %%
sim = fastrod.Simulator(robot)
sim.settle(robot.rest_tendon_length)
print(sim.jacobian()[0, :3, :4].round(2))
