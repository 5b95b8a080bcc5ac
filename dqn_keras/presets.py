"""Settings that solve an environment by its own threshold. results/presets.md says how they were measured."""

from dqn_keras.config import Config

presets: dict[str, Config] = {
    "CartPole-v1": Config(
        tau=0.05,
        gamma=0.99,
        epsilon_min=0.01,
        solved_reward=475,
        solved_window=100,
    ),
    "Acrobot-v1": Config(
        alpha=0.0015,
        gamma=0.99,
        tau=0.05,
        decay=0.93,
        epsilon_min=0.01,
        hidden_units=(128,),
        solved_reward=-100,
        solved_window=100,
    ),
    "MountainCar-v0": Config(
        steps_per_update=2,
        alpha=0.0005,
        gamma=0.99,
        tau=0.005,
        epsilon=0.1,
        epsilon_min=0.01,
        epsilon_steps=10_000,
        num_episodes=5_000,
        hidden_units=(64, 64),
        solved_reward=-110,
        solved_window=100,
    ),
    "LunarLander-v3": Config(
        alpha=0.001,
        gamma=0.99,
        tau=0.005,
        memory_size=100_000,
        decay=0.99,
        epsilon_min=0.01,
        hidden_units=(128, 128),
        solved_reward=200,
        solved_window=100,
    ),
}
"""Parameters that solve an environment, by its id: `train(gymnasium.make(id), presets[id])`. Solved means, as in
Gymnasium, that the mean reward of 100 episodes is above the environment's `reward_threshold`."""
