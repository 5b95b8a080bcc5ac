import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import Config, action, decay_epsilon


class Tape(np.random.Generator):
    """A random generator that returns given numbers and records the calls."""

    def __init__(self, uniform, integer):
        super().__init__(np.random.PCG64())
        self.uniform, self.integer, self.calls = uniform, integer, []

    def random(self):
        self.calls.append("random()")
        return self.uniform

    def integers(self, n):
        self.calls.append(f"integers({n})")
        return np.int64(self.integer)


@pytest.mark.parametrize("q", [np.array([1.0, 5.0, 2.0]), np.array([[1.0, 5.0, 2.0]])])
def test_action_explores_below_epsilon_and_is_greedy_from_there_on(q):
    explore, greedy = Tape(0.29, 2), Tape(0.3, 2)
    assert action(q, 0.3, explore) == 2
    assert explore.calls == ["random()", "integers(3)"]
    assert action(q, 0.3, greedy) == 1
    assert greedy.calls == ["random()"]


def test_values_of_many_states_are_refused_and_tensors_are_taken(rng):
    with pytest.raises(ValueError, match="the values of one state"):
        action(np.zeros((10, 2)), 0.0, rng)
    assert action(tf.constant([[1.0, 3.0]]), 0.0, rng) == 1


def test_of_equal_values_the_first_is_taken(rng):
    assert action(np.zeros(3), 0.0, rng) == 0


def test_epsilon_one_is_uniform(rng):
    counts = np.bincount([action(np.array([9.0, 0, 0, 0]), 1.0, rng) for _ in range(4000)])
    assert abs(counts - 1000).max() < 5 * np.sqrt(4000 * 0.25 * 0.75)  # five standard deviations


def test_epsilon_falls_by_its_factor_and_stops_at_its_floor():
    config = Config()
    assert decay_epsilon(1.0, config) == 0.995
    assert decay_epsilon(0.1001, config) == 0.1
    assert decay_epsilon(0.1, config) == 0.1
