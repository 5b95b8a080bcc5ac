"""The parameters of a run: every number of the algorithm in one place, checked when a Config is made."""

import dataclasses
from typing import Any, Literal

from dqn_keras.checks.fields import hints_at_fields
from dqn_keras.checks.numbers import check_choice, check_count, check_counts, check_flag, check_number


@hints_at_fields
@dataclasses.dataclass(frozen=True)
class Config:
    """The parameters of a run. The defaults are the original notebook's.

    The fields up to `jit_compile` describe the original. The fields after it allow the update schedules of other
    published DQNs; their defaults keep the original's.

    NumPy scalars become Python numbers. Every field is checked: a value of the wrong type raises TypeError, a value
    out of range raises ValueError. The message names the field, the range and the value.
    """

    memory_size: int = 50_000
    """Number of transitions in the replay memory. When it is full, a new transition replaces the oldest."""
    steps_per_update: int = 4
    """Environment steps per update; with 4, an episode learns at its steps 0, 4, 8, ..."""
    alpha: float = 0.001
    """Adam's learning rate, in (0, 1]."""
    gamma: float = 0.95
    """Discount factor per environment step, in [0, 1]."""
    tau: float = 0.01
    """Share of Q that is mixed into Q-hat at each update, in (0, 1]."""
    batch_size: int = 64
    """Transitions per update; updates start when the memory holds this many."""
    epsilon: float = 1.0
    """Probability of a random action in the first episode."""
    decay: float = 0.995
    """Factor that multiplies epsilon after each episode, in (0, 1]."""
    epsilon_min: float = 0.1
    """Lowest value of epsilon, in [0, epsilon]."""
    num_episodes: int = 2_000
    """Maximum number of episodes; training ends after them, solved or not."""
    max_steps: int = 1_000
    """Maximum number of environment steps per episode."""
    solved_reward: float | None = 225.0
    """Training stops when the mean reward of the last `solved_window` episodes is above this. None: no stop rule."""
    solved_window: int = 50
    """Number of episodes in the mean for `solved_reward`; a run with fewer episodes does not count as solved."""
    hidden_units: tuple[int, ...] = (64,)
    """Number of units of each hidden layer; all layers use ReLU."""
    jit_compile: bool = True
    """Compile the learning step with XLA. Results are reproducible with and without it, but differ in the last bits."""

    num_steps: int | None = None
    """Maximum number of environment steps of the run. None: only `num_episodes` limits it.
    An episode that this limit cuts short has the reward NaN, because its full reward is unknown."""
    learning_starts: int = 0
    """Environment steps before the first update, all with random actions (Mnih et al. 2015, "replay start size")."""
    steps_count_from: Literal["episode", "run"] = "episode"
    """Where `steps_per_update` counts from: the start of each episode, or the start of the run."""
    gradient_steps: int = 1
    """Gradient steps per update, each on a new batch."""
    gradient_steps_per_target: int = 1
    """Gradient steps from one update of Q-hat to the next (C in Mnih et al. 2015, algorithm 1).
    With tau=1, each of these updates makes Q-hat a copy of Q."""
    epsilon_steps: int | None = None
    """Environment steps of the run over which epsilon falls linearly from `epsilon` to `epsilon_min`.
    None: epsilon is multiplied by `decay` after each episode."""

    def __post_init__(self) -> None:
        for name in _COUNTS:
            self._set(name, check_count(name, getattr(self, name)))
        for name in ("num_steps", "epsilon_steps"):
            if getattr(self, name) is not None:
                self._set(name, check_count(name, getattr(self, name)))
        self._set("learning_starts", check_count("learning_starts", self.learning_starts, at_least=0))
        check_choice("steps_count_from", self.steps_count_from, ("episode", "run"))
        self._set("alpha", check_number("alpha", self.alpha, above=0, at_most=1))
        self._set("gamma", check_number("gamma", self.gamma, at_least=0, at_most=1))
        self._set("tau", check_number("tau", self.tau, above=0, at_most=1))
        self._set("epsilon", check_number("epsilon", self.epsilon, at_least=0, at_most=1))
        self._set("decay", check_number("decay", self.decay, above=0, at_most=1))
        self._set("epsilon_min", check_number("epsilon_min", self.epsilon_min, at_least=0, at_most=self.epsilon))
        if self.solved_reward is not None:
            self._set("solved_reward", check_number("solved_reward", self.solved_reward))
        self._set("hidden_units", check_counts("hidden_units", self.hidden_units))
        self._set("jit_compile", check_flag("jit_compile", self.jit_compile))
        self._check_together()

    def _check_together(self) -> None:
        """Raises ValueError if two fields contradict each other."""
        if self.batch_size > self.memory_size:
            raise ValueError(
                f"batch_size must be at most memory_size={self.memory_size}, got {self.batch_size}: "
                "the memory would never hold a batch"
            )
        limits = {"num_episodes * max_steps": self.num_episodes * self.max_steps, "num_steps": self.num_steps}
        for what, limit in limits.items():
            for name, least in (("batch_size", self.batch_size), ("learning_starts", self.learning_starts + 1)):
                if limit is not None and least > limit:
                    raise ValueError(
                        f"{name} must be {'at most' if name == 'batch_size' else 'less than'} {what} = {limit}, "
                        f"got {getattr(self, name)}: the run would end before its first update"
                    )
        if self.epsilon_steps is not None and self.decay != Config.decay:
            raise ValueError(
                f"decay must be left at its default of {Config.decay} with epsilon_steps={self.epsilon_steps}, "
                f"because epsilon then falls linearly, got {self.decay}"
            )

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)  # how a frozen dataclass sets its own fields


_COUNTS = (
    "memory_size",
    "steps_per_update",
    "batch_size",
    "num_episodes",
    "max_steps",
    "solved_window",
    "gradient_steps",
    "gradient_steps_per_target",
)
