# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Environments, and training on them
# A batch of environments steps in one call. `fastrod envs Reach` describes every number of a task.

# %%
import numpy as np

import fastrod_envs
from fastrod_envs.vector import BatchEnv

print(fastrod_envs.names())
batch = BatchEnv("Reach", 256)
observation, _ = batch.reset(seed=0)
rng = np.random.default_rng(0)
for _ in range(20):
    observation, reward, ended, cut, info = batch.step(rng.uniform(-1.0, 1.0, (256, 11)))
print(observation.shape, reward.mean().round(3))
batch.close()

# %% [markdown]
# ## With stable-baselines3
# 4,000 steps show that it runs. A policy that reaches its goals takes some millions: `fastrod train Reach`.

# %%
from stable_baselines3 import PPO

import fastrod_envs.sb3

envs = fastrod_envs.sb3.make("Reach", 32)
policy = PPO("MlpPolicy", envs, n_steps=64, batch_size=512, device="cpu", verbose=0)
policy.learn(4000)
envs.close()

# %% [markdown]
# ## A robot of your own in a task
# Goals are drawn where that robot's tip can be.

# %%
own = BatchEnv("Reach", 4, robot="tdcr_b")
print(own.reset(seed=0)[0].shape)
own.close()
