import gymnasium as gym
import pytest

from dqn_keras import Config, presets, train
from dqn_keras.environments import TWINS


@pytest.mark.parametrize("env_id", presets)
def test_a_preset_stops_at_gymnasiums_own_threshold(env_id):
    assert isinstance(presets[env_id], Config)
    assert presets[env_id].solved_reward == gym.spec(env_id).reward_threshold
    assert presets[env_id].solved_window == 100


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [env_id for env_id in presets if env_id in TWINS])
def test_a_preset_solves_its_environment(env_id):
    runs = (train(TWINS[env_id](), presets[env_id], seed, verbose=0) for seed in range(2))
    assert any(run.solved_at is not None for run in runs)  # of 20 seeds, all were solved: results/presets.md
