# %% [markdown]
# # Your own environment
#
# From an idea to a trained agent, in ten cells. The idea: balls fall from the sky, and a paddle on the ground catches
# them. An agent can learn from anything that has
#
# - an **observation**: some numbers that say how things are (here five),
# - a choice among a few **actions** (here three: left, stay, right),
# - a **reward** after each step: a number that says how good the step was.
#
# Gymnasium puts this into two methods, `reset` and `step`, and `dqn_keras` needs nothing else.

# %%
import os

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # otherwise TensorFlow logs into the notebook

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import check_env

from dqn_keras import Config, animate, evaluate, plot_run, record_episode, train

# %% [markdown]
# ## The environment
#
# The picture is 1 wide and 1 high. A ball starts at a random place at the top, drifts to one side and bounces off the
# walls. If the paddle catches it, the reward is 1, and the next ball falls. If not, the episode is over: `terminated`.
# All random numbers come from `self.np_random`, which `reset(seed=...)` seeds, so a run can be repeated exactly. The
# observation holds all that matters for what comes next, as numbers of about the size of 1, which suits networks.


# %%
class Catch(gym.Env):
    """A paddle that catches falling balls: a reward of 1 for each ball, until one is missed."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (5,), np.float32)  # see _observation
    action_space = gym.spaces.Discrete(3)  # left, stay, right
    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(self, paddle_width=0.2, render_mode=None):
        self.paddle_width, self.render_mode = paddle_width, render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.paddle = 0.5
        self._throw()
        return self._observation(), {}

    def step(self, action):
        self.paddle = float(np.clip(self.paddle + 0.04 * (action - 1), 0, 1))
        self.x, self.y = self.x + self.drift, self.y - 0.04
        if not 0 <= self.x <= 1:
            self.x, self.drift = float(np.clip(self.x, 0, 1)), -self.drift
        is_down, is_caught = self.y <= 0, abs(self.x - self.paddle) <= self.paddle_width / 2
        if is_down and is_caught:
            self._throw()
        return self._observation(), float(is_down and is_caught), is_down and not is_caught, False, {}

    def _throw(self):
        self.x, self.y = self.np_random.uniform(0, 1), 1.0
        self.drift = self.np_random.uniform(-0.02, 0.02)

    def _observation(self):  # the ball's place, height and drift; its distance from the paddle; the paddle's place
        return np.array([self.x, self.y, 50 * self.drift, self.x - self.paddle, self.paddle], np.float32)

    def render(self):
        picture = np.full((100, 100, 3), 255, np.uint8)
        for x, y, width, height, colour in [
            (self.paddle, 0, self.paddle_width, 0.04, (70, 70, 70)),
            (self.x, self.y, 0.06, 0.06, (214, 90, 30)),
        ]:
            left, right = (int(np.clip(100 * (x + side * width / 2), 0, 100)) for side in (-1, 1))
            top, bottom = (int(np.clip(100 * (1 - y - h), 0, 100)) for h in (height, 0))
            picture[top - 1 : bottom, left:right] = colour
        return picture


# %% [markdown]
# A first step by hand:

# %%
catch = Catch()
print(catch.reset(seed=0))
print(catch.step(2))

# %% [markdown]
# ## A name, and a time limit
#
# Once it is registered, `gym.make` makes it by its name, and Gymnasium adds a time limit: 250 steps, which is ten
# balls. The time limit is a *truncation*, not a termination: nothing is lost when time is up, so the targets still
# count the value of the last state.

# %%
gym.register("Catch-v0", entry_point=Catch, max_episode_steps=250)
env = gym.make("Catch-v0")

# %% [markdown]
# ## Does it follow the interface?
#
# Gymnasium's checker tries every method. Are the observations in the space? Are the types right? Does the same seed
# give the same episode? Does it render? The checker prints nothing if all is well.

# %%
check_env(gym.make("Catch-v0", render_mode="rgb_array").unwrapped)

# %% [markdown]
# ## Train
#
# The parameters are those of CartPole, except for the reward that counts as solved: a mean of nine balls of ten over
# fifty training episodes, random actions included.

# %%
config = Config(num_episodes=1_000, solved_reward=9)
run = train(env, config, seed=0)

# %% [markdown]
# ## What happened in training
#
# The upper panel shows the rewards, the lower ones what to look at if they do not rise. The Q-values stay under their
# bound: with the highest reward at every step, the return would be $r_{max} / (1 - \gamma) = 20$, and one ball in 25
# steps is worth far less. The TD error falls at once, and then stays below 0.05. The memory holds fewer and fewer ends
# of episodes, since fewer balls are missed.

# %% tags=["save-catch_run"]
axes = plot_run(run, speed=False)

# %% [markdown]
# ## How good is it?
#
# We compare greedy play (no random actions) with random actions alone:

# %%
returns = evaluate(env, run.q_network, num_episodes=100, seed=0)
env.action_space.seed(0)
by_chance = []
for episode in range(100):
    env.reset(seed=episode)
    reward, is_over = 0.0, False
    while not is_over:
        _, caught, terminated, truncated, _ = env.step(env.action_space.sample())
        reward, is_over = reward + caught, terminated or truncated
    by_chance.append(reward)
print(f"balls caught of ten: trained {returns.mean():.2f} (lowest {returns.min():.0f})")
print(f"by chance: {np.mean(by_chance):.2f}")

# %% tags=["save-catch"]
picture_env = gym.make("Catch-v0", render_mode="rgb_array")
animate(record_episode(picture_env, run.q_network, seed=1), fps=25, width=200)

# %% [markdown]
# The agent goes to where the ball *will* be, though nobody has told it about walls.
#
# What you can do next: train other seeds (`study(env, config, seeds=range(20))`), pass a network of your own
# (`train(env, q_network=...)`), or observe images instead of numbers. If you write the environment in TensorFlow, its
# episodes are compiled; `CartPole` in `dqn_keras/environments/` shows how.

# %%
assert run.solved_at is not None, "this seed was not solved within 1,000 episodes"
assert returns.mean() > 8 > 1 > np.mean(by_chance)
assert max(run.history["max_q"][-100:]) < run.history["q_bound"][-1]
