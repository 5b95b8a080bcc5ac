"""Runs with a limit of environment steps, and runs without a stop rule."""

import warnings

import keras
import numpy as np
import pytest

from dqn_keras import Config, plot_run, train
from dqn_keras.environments import CartPole
from tests.helpers.environments import Corridor
from tests.helpers.runs import Tape, fingerprint

PUBLISHED = Config(
    num_steps=604,
    learning_starts=100,
    steps_count_from="run",
    gradient_steps=2,
    gradient_steps_per_target=7,
    tau=1.0,
    epsilon_steps=300,
    batch_size=16,
    solved_reward=None,
)


@pytest.fixture(params=["Gymnasium", "compiled"])
def env(request, cartpole):
    return cartpole if request.param == "Gymnasium" else CartPole()


def test_the_run_ends_at_num_steps_and_a_cut_episode_has_no_reward(env):
    run = train(env, PUBLISHED, seed=0, verbose=0)
    assert sum(episode.steps for episode in run.episodes) == run.agent.memory.num_appended == 604
    assert np.isnan(run.rewards[-1])
    np.testing.assert_array_equal(run.rewards[:-1], [episode.steps for episode in run.episodes[:-1]])
    assert run.history["average_reward"][-1] == pytest.approx(run.rewards[:-1][-50:].mean())
    assert run.solved_at is None


def test_an_episode_that_ends_with_the_steps_is_whole(env):
    whole = train(env, PUBLISHED, seed=0, verbose=0)
    num_steps = 604 - whole.episodes[-1].steps
    run = train(env, Config(**{**vars(PUBLISHED), "num_steps": num_steps}), seed=0, verbose=0)
    np.testing.assert_array_equal(run.rewards, whole.rewards[:-1])


def test_a_time_limit_at_the_last_step_is_no_cut():
    config = Config(num_steps=12, batch_size=2, max_steps=4)
    for corridor in (Corridor(length=100), Corridor(length=100, limit=4)):
        assert train(corridor, config, seed=0, verbose=0).rewards.tolist() == [4.0, 4.0, 4.0]


def test_callbacks_see_every_episode_and_change_nothing(env):
    tape = Tape()
    run = train(env, PUBLISHED, seed=0, verbose=0, callbacks=[tape])
    numbers = [call[1] for call in tape.calls if call[0] == "ends"]
    assert numbers == list(range(len(run.episodes)))
    assert tape.calls[-1] == "train ends"
    assert np.isnan(tape.logs["reward"])
    assert fingerprint(run) == fingerprint(train(env, PUBLISHED, seed=0, verbose=0))


def test_a_resume_is_exact_and_a_finished_run_stays_as_it_is(env, tmp_path):
    whole = train(env, PUBLISHED, seed=0, verbose=0)
    train(env, PUBLISHED, seed=0, verbose=0, checkpoint=tmp_path, checkpoint_every=3, callbacks=[Tape(stop_after=10)])
    for _ in range(2):
        run = train(env, PUBLISHED, seed=0, verbose=0, checkpoint=tmp_path, checkpoint_every=3, resume=True)
        assert fingerprint(run) == fingerprint(whole)
        assert run.agent.num_updates == whole.agent.num_updates


def test_without_a_stop_rule_the_run_continues(env):
    easy = {"num_episodes": 8, "solved_window": 2, "batch_size": 8}
    assert train(env, Config(**easy, solved_reward=1), seed=0, verbose=0).solved_at == 1
    run = train(env, Config(**easy, solved_reward=None), seed=0, verbose=0)
    assert (len(run.episodes), run.solved_at) == (8, None)


def test_a_limit_of_episodes_before_the_limit_of_steps_is_a_warning(env):
    with pytest.warns(UserWarning, match="num_episodes=5 episodes and .* of num_steps=5000"):
        train(env, Config(num_episodes=5, num_steps=5_000, batch_size=8), seed=0, verbose=0)
    with warnings.catch_warnings(action="error"):
        train(env, Config(num_episodes=5, batch_size=8), seed=0, verbose=0)


def test_the_bar_counts_steps_and_the_lines_leave_out_a_cut_episode(env, capsys):
    train(env, PUBLISHED, seed=0, verbose=2)
    out, err = capsys.readouterr()
    assert "604/604" in err
    assert "nan" not in out


def test_a_csv_log_and_the_curves_of_a_cut_run(env, tmp_path):
    run = train(env, PUBLISHED, seed=0, verbose=0, callbacks=[keras.callbacks.CSVLogger(tmp_path / "log.csv")])
    assert len((tmp_path / "log.csv").read_text().splitlines()) == 1 + len(run.episodes)
    assert "Solved" not in [text.get_text() for text in plot_run(run)[0].get_legend().get_texts()]
