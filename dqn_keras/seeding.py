"""Seeds: one number determines everything random in a run."""

import numpy as np

from dqn_keras.checks.numbers import check_count


def checked_seed(seed: int | None) -> int:
    """Returns `seed` as an int; for None, a new random seed."""
    if seed is None:
        return int(np.random.SeedSequence().generate_state(1)[0] >> 1)
    return check_count("seed", seed, at_least=0)


def weights_seed(seed: int) -> np.random.SeedSequence:
    """Returns the seed of the initial weights."""
    return _derived(seed, 0)


def acting_rng(seed: int) -> np.random.Generator:
    """Returns the generator of all random draws for acting and sampling in a gymnasium.Env."""
    return np.random.default_rng(_derived(seed, 1))


def episode_seed(seed: int, episode: int) -> int:
    """Returns the seed of `env.reset` for one episode of a run; it repeats the start of that episode exactly."""
    seed, episode = check_count("seed", seed, at_least=0), check_count("episode", episode, at_least=0)
    return int(_derived(seed, 2, episode).generate_state(1)[0])


def evaluation_seed(seed: int, episode: int) -> int:
    """Returns the seed of `env.reset` for one episode of `evaluate`, which `train` does not use."""
    return int(_derived(seed, 3, episode).generate_state(1)[0])


def evaluation_key(seed: int) -> np.int64:
    """Returns the number that determines the start states of compiled greedy episodes."""
    return _derived(seed, 5).generate_state(1, np.uint64).view(np.int64)[0]


def draws_key(seed: int) -> np.int64:
    """Returns the number that determines all random draws of a compiled run."""
    return _derived(seed, 4).generate_state(1, np.uint64).view(np.int64)[0]


def _derived(seed: int, *key: int) -> np.random.SeedSequence:
    """Returns one of the independent random streams of `seed`."""
    return np.random.SeedSequence(seed, spawn_key=key)
