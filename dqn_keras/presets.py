"""Settings that work, for each environment by its own threshold. results/presets.md says how they were measured."""

from dqn_keras.config import Config

presets: dict[str, Config] = {
    "CartPole-v1": Config(tau=0.05, gamma=0.99, epsilon_min=0.01, solved_reward=475),
}
"""For the id of an environment, parameters that solve it: `train(gymnasium.make(id), presets[id])`."""
