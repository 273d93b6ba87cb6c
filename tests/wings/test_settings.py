"""Settings of `fastrod train --set`: an algorithm's settings, checked before anything is made."""

import inspect
import re

import pytest

pytest.importorskip(
    "stable_baselines3", reason="stable-baselines3 is not installed: pip install 'fastrod[rl]'"
)

from fastrod.commands.cli import main
from fastrod_envs.learning.presets import _SETTINGS, ALGORITHMS, settings_of
from fastrod_envs.learning.training import algorithm_class

WRONG = [
    ("ppo", "lr=3", r"ppo has no setting 'lr'; did you mean 'learning_rate'\?"),
    ("ppo", "learning_rat=3e-4", r"did you mean 'learning_rate'\?"),
    ("ppo", "buffer_size=100", "ppo has no setting 'buffer_size'; "),
    ("sac", "clip_range=0.2", "sac has no setting 'clip_range'; "),
    ("ppo", "learning_rate=abc", "'learning_rate' of ppo is 'abc'; it must be a number from 0 to 1, above 0"),
    ("ppo", "learning_rate=-0.001", "learning_rate.* is -0.001; it must be a number"),
    ("ppo", "learning_rate=NaN", "learning_rate.* is nan; it must be a number"),
    ("td3", "learning_rate=0", "above 0"),
    ("ppo", "n_epochs=2.5", "'n_epochs' of ppo is 2.5; it must be a whole number from 1"),
    ("ppo", "n_steps=abc", "'n_steps' of ppo is 'abc'; it must be a whole number from 2"),
    ("ppo", "normalize_advantage=1", "it must be true or false"),
    ("sac", "ent_coef=automatic", "'ent_coef' of sac is 'automatic'; it must be a number"),
    ("ppo", "gamma=[1, 2]", r"'gamma' of ppo is \[1, 2\]; it must be a number"),
    ("ppo", "policy_kwargs=3", "ppo has no setting 'policy_kwargs'"),
]


@pytest.mark.parametrize(("algorithm", "pair", "sentence"), WRONG)
def test_a_setting_that_cannot_be_is_a_sentence(algorithm, pair, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "Reach", "--algo", algorithm, "--set", pair]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert re.search(sentence, said), said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_setting_is_one_of_the_algorithm(algorithm: str) -> None:
    known = inspect.signature(algorithm_class(algorithm)).parameters
    assert set(_SETTINGS[algorithm]) <= set(known)
    assert set(settings_of(algorithm, 8, 40, 1000, {})) <= set(_SETTINGS[algorithm])
    for name in _SETTINGS[algorithm]:  # what the class has by itself may be given
        default = known[name].default
        if not isinstance(default, tuple):
            assert settings_of(algorithm, 8, 40, 1000, {name: default})[name] == default


def test_words_of_sac_are_taken() -> None:
    for value in ("auto", "auto_0.1", 0.2):
        assert settings_of("sac", 8, 40, 1000, {"ent_coef": value})["ent_coef"] == value
