# %% [markdown]
# # Does it need this?
#
# DQN is Q-learning with a network and two additions: a replay memory and a target network. Others have added more:
# Double DQN, a Huber loss, clipped gradients, other numbers. Which of them matter here? We take one away, or add one,
# and train a hundred seeds each. With compiled episodes, that takes a few minutes.
#
# Reading takes about ten minutes. The lesson ([deep_q_network.ipynb](deep_q_network.ipynb)) explains the replay memory,
# the target network and the numbers. *Double DQN* lets $Q$ choose the next action and $\hat Q$ value it. The *Huber
# loss* is quadratic for errors below 1, and grows in a straight line above. *Clipping* shortens a gradient whose length
# (norm) is above 1.

# %%
import os

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # otherwise TensorFlow logs into the notebook

from dataclasses import replace

from dqn_keras import Config, double_td_targets, plot_sweep, sweep, sweep_table
from dqn_keras.environments import CartPole

original = Config(num_episodes=500)
original

# %% [markdown]
# ## The settings
#
# *Original* is the lesson's `Config()`, with at most 500 episodes. Each other setting differs from it in what its name
# says. A run ends when the mean of the last 50 rewards is above 225, which counts as *solved*, or after 500 episodes.

# %%
import keras
import numpy as np
from IPython.display import Markdown

settings = {
    "original": original,
    "no target network": replace(original, tau=1.0),
    "no replay": replace(original, memory_size=original.batch_size),
    "neither": replace(original, tau=1.0, memory_size=original.batch_size),
    "Double DQN": {"config": original, "targets": double_td_targets},
    "Huber loss": {"config": original, "loss": "huber"},
    "gradients clipped to a norm of 1": {
        "config": original,
        "optimizer": lambda: keras.optimizers.Adam(original.alpha, global_clipnorm=1.0),
    },
    "gamma 0.99": replace(original, gamma=0.99),
    "recommended": replace(original, tau=0.05, gamma=0.99, epsilon_min=0.01),
}

# %% [markdown]
# "No target network" means $\tau = 1$: after each update, $\hat Q$ equals $Q$. "No replay" is a memory of only 64
# transitions, which is one batch: each update learns from the last 64 steps. "Recommended" takes the numbers that the
# package recommends for CartPole (`presets["CartPole-v1"]`), with the original's bar of 225.
#
# ## Predict
#
# How many of a hundred seeds will be solved by episode 500? Replace each `None` by a number before you scroll down: the
# results are already there. (In JupyterLab: Edit, Clear Outputs of All Cells.) For the original,
# [it was 90](../results/reproduction.md).

# %%
prediction = {
    "original": 90,
    "no target network": None,
    "no replay": None,
    "neither": None,
    "Double DQN": None,
    "Huber loss": None,
    "gradients clipped to a norm of 1": None,
    "gamma 0.99": None,
    "recommended": None,
}

# %% [markdown]
# ## Run it

# %%
outcome = sweep(CartPole(), settings, seeds=range(100), evaluate_on=CartPole(), verbose=0)  # verbose=1 shows a bar
Markdown(sweep_table(outcome))

# %% [markdown]
# How to read the table:
#
# - *Solved* is the share of seeds that are solved by episode 500. That is what you predicted.
# - *Late or never* is the rest, since these runs end at episode 500.
# - *Median episodes*: half of the seeds are solved earlier. Seeds that are not solved count as 500, so a median of 500
#   means 500 or more.
# - *Greedy return* is the mean reward of 100 episodes after training, without random actions.
# - In brackets are *95 % intervals*: other seeds would give other numbers, and the interval says where the number for
#   all seeds probably lies.
#
# The picture shows the same. Its left panel, "Not solved by episode 500", is *late or never*: 100 % minus *solved*.

# %% tags=["save-does_it_need_this"]
axes = plot_sweep(outcome)

# %%
for name, study in outcome.items():
    solved = np.isfinite(study.solved_at).sum()
    print(
        f"{name:33} {solved:3} of 100 solved by episode 500",
        "" if prediction[name] is None else f"(predicted: {prediction[name]})",
    )

# %% [markdown]
# ## What it shows
#
# Where two intervals overlap widely, a hundred seeds do not show which setting is better.
#
# - **No target network**: the trained networks play better, and the median is lower. On this task, the slow copy is no
#   help. (More seeds are solved, too: over a thousand seeds, that difference is clear,
#   [results/ablation.md](../results/ablation.md).)
# - **No replay**: three of four seeds are not solved by episode 500. Replay seems to be the part that matters most.
# - **Neither**: a surprise. If only replay is missing, 24 of 100 seeds are solved; if the slow target is missing, too,
#   91 are. So replay is needed most where the target is slow. Without a slow target, it still helps: a median of 269
#   episodes ("no target network") against 399 ("neither"). The effect of one part depends on the others, so test them
#   together, too.
# - **Double DQN**: no difference is shown.
# - **Huber loss**: hardly a seed is solved. (With 2,000 episodes, three of four are:
#   [results/ablation.md](../results/ablation.md).)
# - **Clipped gradients**: the trained networks play worse.
# - **Gamma 0.99**: the median and the greedy return are close to the original's.
# - **Recommended**: the trained networks play better than the original's, but the median is a little higher.
#
# All this holds for CartPole, a network with one hidden layer, and the original's other numbers. Change one of them and
# ask again.
