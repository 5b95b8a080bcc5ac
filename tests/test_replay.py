import copy
import pickle
from collections import deque

import numpy as np
import pytest
import tensorflow as tf
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from scipy import stats

from dqn_keras import Experience, ReplayMemory
from dqn_keras.replay import unpack


class MemoryAgainstDeque(RuleBasedStateMachine):
    """After any appends and draws, the ring holds the same as a bounded deque, in the same order."""

    @initialize(size=st.integers(1, 12), features=st.integers(1, 3), seed=st.integers(0, 99))
    def start(self, size, features, seed):
        self.memory, self.model = ReplayMemory(size, (features,)), deque(maxlen=size)
        self.features, self.numbers = features, np.random.default_rng(seed)

    @rule()
    def append(self):
        state, next_state = self.numbers.normal(size=(2, self.features)).astype(np.float32)
        transition = Experience(state, 3, np.float32(self.numbers.normal()), next_state, bool(self.numbers.integers(2)))
        self.memory.append(transition)
        self.model.append(transition._replace(state=state.copy()))
        state += 1  # the memory must have kept the value, not the array

    @rule(seed=st.integers(0, 99), data=st.data())
    def sample(self, seed, data):
        if self.model:
            batch_size = data.draw(st.integers(1, len(self.model)))
            batch = self.memory.sample(batch_size, np.random.default_rng(seed))
            chosen = np.random.default_rng(seed).choice(len(self.model), batch_size, replace=False)
            assert len(set(chosen)) == batch_size
            for values, name in zip(batch, Experience._fields, strict=True):
                np.testing.assert_array_equal(values, np.array([getattr(self.model[i], name) for i in chosen]))

    @invariant()
    def same_length(self):
        assert not hasattr(self, "memory") or len(self.memory) == len(self.model)


MemoryAgainstDeque.TestCase.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)
TestMemoryAgainstDeque = MemoryAgainstDeque.TestCase


def filled(size, count):
    memory = ReplayMemory(size, (1,))
    for i in range(count):
        memory.append(Experience([i], i % 2, i, [i + 1], 0))
    return memory


def test_a_batch_has_no_repeats_and_is_uniform(rng):
    memory, counts = filled(100, 150), np.zeros(150)
    for _ in range(2000):
        drawn = memory.sample(10, rng).reward.astype(int)
        assert len(set(drawn)) == 10
        counts[drawn] += 1
    assert not counts[:50].any()  # forgotten
    assert stats.chisquare(counts[50:]).pvalue > 1e-4


def test_a_batch_has_the_dtypes_that_learn_wants(rng):
    batch = filled(8, 8).sample(4, rng)
    assert [x.dtype for x in batch] == [np.float32, np.int32, np.float32, np.float32, np.float32]
    assert [x.shape for x in batch] == [(4, 1), (4,), (4,), (4, 1), (4,)]


def test_rows_unpack_alike_in_numpy_and_tensorflow():
    rows = filled(8, 8).rows
    for array, tensor in zip(unpack(rows, (1,)), unpack(tf.constant(rows), (1,)), strict=True):
        np.testing.assert_array_equal(array, tensor.numpy())
        assert array.dtype == tensor.numpy().dtype


def test_a_memory_of_images_takes_only_whole_numbers_that_a_byte_holds():
    memory = ReplayMemory(2, (2,), np.uint8)
    memory.append(Experience([0, 255], 0, 1.0, np.zeros(2), 0))
    for bad in ([0.5, 0], [0, 256], [-1, 0], [np.nan, 0]):
        with pytest.raises(ValueError, match=r"^state must be whole numbers from 0 to 255"):
            memory.append(Experience(bad, 0, 1.0, np.zeros(2), 0))
    assert len(memory) == 1


def test_a_batch_larger_than_the_memory_is_refused(rng):
    with pytest.raises(ValueError, match=r"^batch_size must be at most 3, .* got 4"):
        filled(8, 3).sample(4, rng)


def test_an_action_is_stored_as_the_whole_number_it_is(rng):
    memory = ReplayMemory(1, (1,))
    for action in (2, np.int64(2), np.array(2), tf.constant(2)):
        memory.append(Experience([0.0], action, 0.0, [0.0], False))
        assert memory.sample(1, rng).action == 2


@pytest.mark.parametrize("make", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_of_a_memory_stores_in_its_own_rows(make):
    memory = ReplayMemory(3, (2,))
    memory.append(Experience([1.0, 2.0], 1, 3.0, [4.0, 5.0], False))
    other = make(memory)
    other.append(Experience([6.0, 7.0], 0, 8.0, [9.0, 10.0], True))
    assert (len(memory), len(other)) == (1, 2)
    np.testing.assert_array_equal(other.rows[1], [6, 7, 9, 10, 0, 8, 1])
    np.testing.assert_array_equal(other.rows[0], memory.rows[0])
