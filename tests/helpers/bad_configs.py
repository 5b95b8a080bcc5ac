"""Values that no field of Config accepts."""

import numpy as np
import pytest
from hypothesis import strategies as st

from dqn_keras import Config

COUNTS = [
    *("memory_size", "steps_per_update", "batch_size", "num_episodes", "max_steps", "solved_window"),
    *("gradient_steps", "gradient_steps_per_target"),
]
SHARES = ["alpha", "gamma", "tau", "epsilon", "decay", "epsilon_min"]


def refused(name, value):
    with pytest.raises((TypeError, ValueError)) as caught:
        Config(**{name: value})
    message = str(caught.value)
    assert message.startswith(name), message
    assert repr(value)[:100] in message, message


not_numbers = st.sampled_from([None, "64", b"1", True, False, np.True_, [1], (), {}, 1j, object()])
not_finite = st.sampled_from([float("nan"), float("inf"), -float("inf"), np.float32("nan"), np.float64("inf")])


bad_counts = st.one_of(not_numbers, not_finite, st.floats(), st.integers(max_value=0), st.just(2**31))
bad_shares = st.one_of(
    not_numbers, not_finite, st.floats(max_value=-1e-300), st.floats(min_value=1.0001), st.just(10**400)
)
bad_hidden_units = st.one_of(not_finite, st.lists(bad_counts, min_size=1, max_size=3).map(tuple))
bad_fields = st.one_of(
    st.tuples(st.sampled_from(COUNTS), bad_counts),
    st.tuples(st.sampled_from(SHARES), bad_shares),
    st.tuples(st.just("solved_reward"), st.one_of(not_numbers.filter(lambda x: x is not None), not_finite)),
    st.tuples(st.sampled_from(["num_steps", "epsilon_steps"]), bad_counts.filter(lambda x: x is not None)),
    st.tuples(st.just("learning_starts"), bad_counts.filter(lambda x: x != 0 or x is False)),
    st.tuples(st.just("steps_count_from"), st.sampled_from([None, "Episode", "", "update", 1, b"run", ["run"]])),
    st.tuples(st.just("jit_compile"), st.sampled_from([1, 0, None, "yes", 1.0, np.int64(1)])),
)
