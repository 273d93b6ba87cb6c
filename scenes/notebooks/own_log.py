# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # From a log of your own to a report
# The log here is made up: a robot with 0.4 mm of play in its drives, seen by a camera with 0.2 mm of noise. Its
# columns are what a lab would write: milliseconds, degrees of the motors, millimetres.

# %%
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import fastrod
from fastrod.commands.cli import main
from fastrod.model.routing import route

folder = Path(tempfile.mkdtemp())
robot = replace(fastrod.load_robot("tdcr_b"), effects=({"name": "backlash", "half_width": 2e-4},))
t = np.arange(0.0, 60.0, 0.1)
waves = np.sin(np.outer(t, [0.7, 0.45, 0.31, 0.53]))
bend = 0.5 * (waves + 0.5 * np.sin(np.outer(t, [1.9, 1.1, 1.3, 0.9]))).reshape(-1, 2, 2)
dl = route(robot).tendon_change(bend)
sim = fastrod.Simulator(robot, dt=0.1)
tip = np.array([sim.step(robot.rest_tendon_length + row).tip_position[0] for row in dl])
tip += 2e-4 * np.random.default_rng(0).standard_normal(tip.shape)
names = ["time_ms", *(f"motor{k}_deg" for k in range(1, 7)), "cam_X_mm", "cam_Y_mm", "cam_Z_mm"]
table = np.column_stack([1e3 * t, np.degrees(dl / 0.012), 1e3 * tip])
np.savetxt(folder / "lab.csv", table, delimiter=",", header=",".join(names), comments="", fmt="%.6f")

# %% [markdown]
# ## Describe the robot
# `fastrod new` guesses columns and units from the log's header. In a terminal it asks for what is missing.

# %%
command = f"new {folder}/mine.toml --log {folder}/lab.csv --segments 2 --tendons 3 --length 100 --offset 8,6"
main([*command.split(), "--angle", "90", "--drum-radius", "12"])
print((folder / "mine.toml").read_text()[-420:])

# %% [markdown]
# ## Look at the log before anything is fitted
# The tendons of this robot go round the other way than `new` took them. `check` finds that and writes it.

# %%
main(
    [
        "check",
        str(folder / "lab.csv"),
        "--robot",
        str(folder / "mine.toml"),
        "--out",
        str(folder / "matched.toml"),
    ]
)

# %% [markdown]
# ## What does the model lack?

# %%
result = fastrod.identify(folder / "lab.csv", folder / "matched.toml")
print(result.summary)
result.plot()
result
