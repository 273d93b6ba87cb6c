"""`Policy`: what `fastrod train` writes and what ships with the package, loaded and asked."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any, final

import numpy as np

from fastrod.errors import InputError
from fastrod.types import Floats
from fastrod_envs.learning.actor import Actor, actor_of, load_actor
from fastrod_envs.learning.training import ACTOR, CONFIG, FOREIGN, TrainingPlan, load_foreign, read_config
from fastrod_envs.registration import name_of
from fastrod_envs.vector import BatchEnv

SHIPPED = "shipped"


def shipped() -> tuple[str, ...]:
    """Names of the tasks whose trained policy comes with the package."""
    folder = files("fastrod_envs") / "trained"
    return (
        tuple(sorted(entry.name for entry in folder.iterdir() if (entry / ACTOR).is_file()))
        if folder.is_dir()
        else ()
    )


def find(env: str, given: str) -> Path:
    """The folder of a policy: one that `fastrod train` wrote (or a policy.zip in it), or `shipped` for the
    one that comes with the package. Raises `InputError`."""
    path = Path(given)
    if given == SHIPPED:
        name = name_of(env)
        if name not in shipped():
            raise InputError(
                f"no policy is shipped for {env!r}; there are those of {', '.join(shipped()) or 'none'}."
            )
        return Path(str(files("fastrod_envs") / "trained" / name))
    folder = path.parent if path.suffix == ".zip" else path
    if not (folder / CONFIG).is_file():
        raise InputError(
            f"{given!r} holds no policy; give the folder that `fastrod train` wrote, or 'shipped'."
        )
    return folder


@final
class Policy:
    """A trained policy without its noise."""

    def __init__(self, folder: Path, *, trust: bool = False) -> None:
        """Read actor.npz, which a training has from its first checkpoint on.

        A folder that has a file of stable-baselines3 in its place is read with `trust` alone, as that runs
        code of whoever made it. Raises `InputError` where the folder holds neither.
        """
        self.plan: TrainingPlan = read_config(folder)[0]
        if (folder / ACTOR).is_file():
            self._actor: Actor = load_actor(folder / ACTOR)
            return
        path = next((folder / name for name in FOREIGN if (folder / name).is_file()), None)
        if path is None:
            raise InputError(f"{str(folder)!r} holds no {ACTOR}; the training has not written one yet.")
        model = load_foreign(path, self.plan.algorithm, trust=trust)
        try:
            self._actor = actor_of(model)
        except Exception as error:  # of a network that is built otherwise
            raise InputError(
                f"the network in {str(path)!r} is not built as `fastrod train` builds one: {error!r}."
            ) from error

    @property
    def options(self) -> dict[str, Any]:
        """Options of the environment on which its observations and actions depend."""
        return {
            name: self.plan.options[name]
            for name in ("observation", "action", "n_steps", "grip")
            if name in self.plan.options
        }

    def check(self, env: BatchEnv) -> None:
        """Raises `InputError` where the policy was trained for other observations or actions."""
        n_obs, n_actions = len(self._actor.middle), len(self._actor.biases[-1])
        given = env.single_observation_space.shape, env.single_action_space.shape
        if given != ((n_obs,), (n_actions,)):
            raise InputError(
                f"the policy was trained on {self.plan.env} with {n_obs} observations and {n_actions} "
                "actions; here they are "
                f"{given[0]} and {given[1]}."
            )

    def act(self, observation: Floats | np.ndarray) -> Floats:
        """(n, n_actions) from -1 to 1."""
        return self._actor.act(np.asarray(observation))
