"""Evaluation: whose episodes they are, what the figures mean, what is written."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip(
    "stable_baselines3", reason="stable-baselines3 is not installed: pip install 'fastrod[rl]'"
)

from rich.console import Console

from fastrod.commands.cli import main
from fastrod.errors import InputError
from fastrod_envs.describe import describe, summary
from fastrod_envs.learning.evaluation import Trial, correlation, evaluate, figures, table, write
from fastrod_envs.registration import names
from fastrod_envs.single import SingleEnv


def test_the_baseline_beats_those_that_do_not_look() -> None:
    result = evaluate("Reach", None, episodes=20, seed=5)
    reported = figures(result)
    assert list(reported) == ["baseline", "goal-blind", "random", "still"]
    assert reported["baseline"]["success"] == 1.0
    assert reported["baseline"]["distance_mean_m"] < 1e-3
    assert min(reported["baseline"]["correlation"]) > 0.99
    for blind in ("goal-blind", "random", "still"):
        assert reported[blind]["distance_mean_m"] > 0.05
        assert reported[blind]["success"] < 0.1


def test_episode_k_is_that_of_its_seed() -> None:
    result = evaluate("Reach", None, episodes=3, seed=11, options={"n_steps": 12})
    env = SingleEnv("Reach", n_steps=12)
    for k in range(3):
        env.reset(seed=11 + k)
        done, returned = False, 0.0
        while not done:
            _, reward, terminated, truncated, info = env.step(env.baseline())
            done, returned = terminated or truncated, returned + reward
        trial = result.trials["baseline"]
        assert trial.distance[k] == pytest.approx(info["distance"], abs=1e-9)
        assert trial.returned[k] == pytest.approx(returned, abs=1e-6)
        assert_allclose(trial.desired[k], info["desired"], atol=0.0)


def test_correlation_is_of_axes_on_which_goals_differ() -> None:
    rng = np.random.default_rng(0)
    desired = np.column_stack([rng.uniform(size=50), rng.uniform(size=50), np.full(50, 0.1)])
    position = np.column_stack([2.0 * desired[:, 0], rng.permutation(desired[:, 1]), rng.uniform(size=50)])
    zeros, flags = np.zeros(50), np.zeros(50, bool)
    r = correlation(Trial(zeros, flags, flags, flags, position, desired, zeros, zeros, {}))
    assert r[0] == pytest.approx(1.0)
    assert abs(r[1]) < 0.5
    assert np.isnan(r[2])


@pytest.mark.study
def test_table_and_files(tmp_path: Path) -> None:
    result = evaluate("Track", None, episodes=2, options={"n_steps": 40})
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(table(result))
    text = console.export_text()
    assert "goal-blind" in text
    assert "mae_floor" in text
    paths = write(result, tmp_path / "out")
    held = json.loads(paths[0].read_text())
    assert held["env"] == "fastrod/Track-v0"
    assert held["agents"]["baseline"]["episodes"] == 2
    assert paths[1].read_bytes()[:4] == b"\x89PNG"


@pytest.mark.study
def test_the_command_lists_describes_and_evaluates(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["envs"]) == 0
    listed = capsys.readouterr().out
    assert all(f"fastrod/{name}-v0" in listed for name in names())
    assert main(["envs", "Reach", "--option", "observation=goal"]) == 0
    assert "0..2  goal" in capsys.readouterr().out
    assert main(["evaluate", "Reach", "none", "--episodes", "2", "--option", "n_steps=3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["still"]["steps_mean"] == 3.0
    assert main(["evaluate", "Reach", "none", "--episodes", "0"]) == 2
    assert "episodes is 0" in capsys.readouterr().err
    assert main(["train", "Reach", "--option", "n_steps"]) == 2
    assert "give NAME=VALUE" in capsys.readouterr().err
    assert main(["train"]) == 2
    assert main(["train", "--resume"]) == 2
    assert "--resume needs --out" in capsys.readouterr().err


def test_documentation_names_every_number() -> None:
    text = describe("Reach")
    assert "12..22  posture" in text
    assert "reward = 'paper'" in text
    assert len(summary().splitlines()) == len(names())


def test_a_policy_for_other_observations_is_refused() -> None:
    from fastrod_envs.learning.policies import Policy, find, shipped

    if "Reach" not in shipped():
        pytest.skip("no policy of Reach is shipped")
    with pytest.raises(InputError, match="was trained on fastrod/Reach-v0 with 23 observations"):
        evaluate("Track", Policy(find("Reach", "shipped")), episodes=1)
