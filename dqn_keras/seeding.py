"""Seeds: everything random in a run follows from one number."""

import numpy as np

from dqn_keras.checks.numbers import check_count


def checked_seed(seed: int | None) -> int:
    """`seed` as an int; a fresh random one for None."""
    if seed is None:
        return int(np.random.SeedSequence().generate_state(1)[0] >> 1)
    return check_count("seed", seed, at_least=0)


def episode_seed(seed: int, episode: int) -> int:
    """The seed of `env.reset` for one episode of a run, so that any episode can be begun again exactly."""
    return int(_derived(seed, 2, episode).generate_state(1)[0])


def evaluation_seed(seed: int, episode: int) -> int:
    """The same for an episode of `evaluate`, which so starts where no episode of `train` did."""
    return int(_derived(seed, 3, episode).generate_state(1)[0])


def draws_key(seed: int) -> np.int64:
    """The number that all draws of a compiled run follow from."""
    return _derived(seed, 4).generate_state(1, np.uint64).view(np.int64)[0]


def _derived(seed: int, *key: int) -> np.random.SeedSequence:
    """One of the independent streams that belong to `seed`."""
    return np.random.SeedSequence(seed, spawn_key=key)
