# %% [markdown]
# # From a table to a network
#
# A DQN (Deep Q-Network) is Q-learning with a network in place of a table. This notebook begins with the table, and
# shows how it fills. Then it takes the same steps with a network, and gets the same numbers. Then it gives the network
# a hidden layer, and something new happens. Reading takes about twenty minutes. The first half needs only Python and
# NumPy; the second half uses Keras.

# %%
import os

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # otherwise TensorFlow logs into the notebook

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

# %% [markdown]
# ## A lake
#
# [FrozenLake](https://gymnasium.farama.org/environments/toy_text/frozen_lake/) is a field of 4 × 4 cells. **S** is the
# start, **G** the goal, **H** a hole, **F** is frozen and safe. A *state* is a cell, 0 to 15, row by row. In each state
# there are four *actions*: left (0), down (1), right (2), up (3). A step to the goal gives a *reward* of 1, every other
# step 0. Goal and holes are *terminal*: there the *episode* is over. It also ends after 100 steps.

# %%
env = gym.make("FrozenLake-v1", is_slippery=False)  # each step goes in the chosen direction
field = env.unwrapped.desc.astype(str)  # [4, 4] letters
print("\n".join(" ".join(row) for row in field))

# %% [markdown]
# ## The table
#
# $Q(s, a)$ is the sum of rewards that one can expect from action $a$ in state $s$ on, if the best actions follow. The
# reward of $a$ itself counts fully; each later one counts less, by a factor $\gamma$ for each step. There are 16 states
# and 4 actions, so $Q$ is a table of 64 numbers. At the beginning all are 0.
#
# Each step gives a better guess of one of them. The step leads from state $s$ with action $a$ to state $s'$ and gives
# the reward $r$. The guess is the reward, plus $\gamma$ times the highest number in the row of $s'$ (the *discounted*
# value of $s'$). If $s'$ is terminal, nothing follows, and the guess is $r$ alone.
#
# $$y = r + \gamma \max_{a'} Q(s', a') \qquad\qquad Q(s, a) \leftarrow Q(s, a) + \alpha \, \bigl(y - Q(s, a)\bigr)$$
#
# $y$ is the *target*; $\alpha$ says how far the old number moves towards it. To try all actions, the agent takes a
# random one with probability $\varepsilon$; otherwise it takes the one with the highest number. That is all of
# **Q-learning** ([Watkins and Dayan 1992](https://link.springer.com/article/10.1007/BF00992698)):

# %%
gamma, alpha, epsilon = 0.9, 0.5, 0.5


def q_learning(env, num_episodes, seed=0, alpha=alpha):
    """Fills a table [16, 4]; yields it at the start and after each episode."""
    q, rng = np.zeros((16, 4)), np.random.default_rng(seed)
    yield q
    for episode in range(num_episodes):
        (s, _), is_over = env.reset(seed=seed if episode == 0 else None), False
        while not is_over:
            best = rng.choice(np.flatnonzero(q[s] == q[s].max()))  # if several are highest, a random one of them
            a = int(rng.integers(4)) if rng.random() < epsilon else int(best)
            next_s, r, terminated, truncated, _ = env.step(a)
            y = r + (1 - terminated) * gamma * q[next_s].max()
            q[s, a] += alpha * (y - q[s, a])
            s, is_over = next_s, terminated or truncated
        yield q


# %% [markdown]
# Here is the table after 0, 120, 240, 260 and 1,000 episodes. Each cell shows its highest Q-value (the higher, the
# darker), and an arrow for the action that has it (no arrow while all four are equal).


# %% tags=["folded"]
def draw(ax, q, title):
    """Draws a table [16, 4] on the lake: the highest value of each cell, and the action that has it."""
    values = q.max(axis=1).reshape(4, 4)
    ax.imshow(values, cmap="Greys", vmin=0, vmax=1.6)  # at most middle grey, so that black text is readable
    for (row, column), letter in np.ndenumerate(field):
        if letter in "HG":
            ax.text(column, row, {"H": "hole", "G": "goal"}[letter], ha="center", va="center", style="italic")
            continue
        of_cell = q[4 * row + column]
        ax.text(column, row + 0.28, f"{of_cell.max():.2f}", ha="center", va="center", fontsize=9)
        if of_cell.max() > of_cell.min():
            x, y = [(-1, 0), (0, 1), (1, 0), (0, -1)][of_cell.argmax()]
            ax.annotate(
                "", (column + 0.22 * x, row - 0.14 + 0.22 * y), (column - 0.22 * x, row - 0.14 - 0.22 * y),
                arrowprops={"arrowstyle": "->", "lw": 1.6},
            )  # fmt: skip
    ax.set(xticks=np.arange(-0.5, 4), yticks=np.arange(-0.5, 4), xticklabels=[], yticklabels=[], title=title)
    ax.tick_params(length=0)
    ax.grid(color="black", linewidth=0.6)


# %% tags=["picture-table"]
shown = (0, 120, 240, 260, 1_000)
tables = [q.copy() for q in q_learning(env, 1_000)]
figure, axes = plt.subplots(1, 5, figsize=(15, 3.3), layout="constrained")
for ax, n in zip(axes, shown, strict=True):
    draw(ax, tables[n], f"after {n:,} episodes")
plt.show()
print("the goal is reached for the first time in episode", next(n for n, q in enumerate(tables) if q.any()))

# %% [markdown]
# For a long time there is nothing to learn from: the agent finds the goal by chance alone. Then the values spread from
# the goal backwards, since a cell can only learn from the cells that follow it. In the end they say how far the goal
# is: a cell that is $k$ steps away from it has the value $\gamma^{k-1}$. (The top right cell is not quite there: 0.65,
# where $0.9^4 = 0.66$. With 2,000 episodes, it is.) The start is six steps away. Its value:

# %%
q = tables[-1]
print(f"{q[0].max():.4f}, and 0.9^5 = {0.9**5:.4f}")
assert np.isclose(q[0].max(), 0.9**5)

# %% [markdown]
# *A remark.* By default, FrozenLake's ice is slippery: one step of three goes where it is meant to go, the others go
# sideways. So the same action gives different targets. How often does the agent reach the goal, if it always takes the
# best action of the table? Here are two values of $\alpha$, with three seeds each:


# %%
def share_of_goals(env, q, num_episodes=500, seed=1):
    """Returns how often the goal is reached by the best actions of a table."""
    goals = 0.0
    for episode in range(num_episodes):
        (s, _), is_over = env.reset(seed=seed if episode == 0 else None), False
        while not is_over:
            s, r, terminated, truncated, _ = env.step(int(q[s].argmax()))
            goals, is_over = goals + r, terminated or truncated
    return goals / num_episodes


slippery = gym.make("FrozenLake-v1", is_slippery=True)
for name, lake, step in (("firm ice", env, 0.5), ("slippery ice", slippery, 0.5), ("slippery ice", slippery, 0.05)):
    filled = [list(q_learning(lake, 2_000, seed, step))[-1] for seed in range(3)]
    shares = ", ".join(f"{share_of_goals(lake, table):.0%}" for table in filled)
    print(f"{name}, alpha {step}: the goal is reached in {shares} of 500 episodes")

# %% [markdown]
# On slippery ice, the smaller $\alpha$ plays better with each of these seeds.

# %% [markdown]
# ## The same with a network
#
# A table with 16 rows is also a network. Give it the state as 16 numbers: a 1 at the place of the cell, and 0
# everywhere else (*one-hot*). A layer `Dense(4)` without bias multiplies this by its kernel [16, 4], and so picks out
# one row: the kernel *is* the table.
#
# Then the update above is one step of gradient descent on the squared error $(y - Q(s, a))^2$. The derivative with
# respect to $Q(s, a)$ is $-2 \, (y - Q(s, a))$; with respect to all other numbers of the table it is 0. A step with
# learning rate $\eta$ adds $2 \eta \, (y - Q(s, a))$. With $\eta = \alpha / 2$, that is the update of the table. ($y$
# counts as a fixed number, although $Q$ is in it.)
#
# From here on, $y$ comes from the package's function `td_targets`. Its arguments are a batch of steps, $\gamma$, and
# two networks: $Q$, and $\hat Q$, which gives the values of the next states. The targets need only $\hat Q$, so
# `target` passes it twice. Until the end of this notebook, $\hat Q$ is the network that learns; there, we see what a
# second one is good for. `make_q_network` makes a network with hidden layers. A `GradientTape` records what is computed
# inside its block, so that TensorFlow can differentiate it; `tf.function` only makes it faster.

# %%
from dqn_keras import make_q_network, td_targets

import keras  # isort: skip  (after dqn_keras, which keeps TensorFlow from logging)
import tensorflow as tf  # isort: skip


def one_hot(s):
    """Returns a state as a row of 16 numbers, [1, 16]."""
    return np.eye(16, dtype=np.float32)[[s]]


@tf.function
def gradient_step(q_network, optimizer, state, a, y):
    """Takes one step on the squared error of one transition."""
    with tf.GradientTape() as tape:
        loss = (y - q_network(state)[0, a]) ** 2
    weights = q_network.trainable_variables
    optimizer.apply_gradients(zip(tape.gradient(loss, weights), weights, strict=True))


def target(q_hat_network, s, a, r, next_s, terminated):
    """Returns y of one transition."""
    batch = (one_hot(s), [a], [r], one_hot(next_s), [float(terminated)])
    return td_targets(batch, gamma, q_hat_network, q_hat_network)[0]


def update(q_network, optimizer, s, a, y):
    """Moves Q(s, a) towards y."""
    gradient_step(q_network, optimizer, tf.constant(one_hot(s)), tf.constant(a), tf.constant(y, tf.float32))


# %% [markdown]
# Table and network learn from the same 500 steps: random actions in random cells.


# %%
def new_linear_network():
    """Returns a network that is a table of zeros, and an optimizer for it."""
    layer = keras.layers.Dense(4, use_bias=False, kernel_initializer="zeros")
    network, optimizer = keras.Sequential([keras.Input((16,)), layer]), keras.optimizers.SGD(alpha / 2)
    optimizer.build(network.trainable_variables)
    return network, optimizer


linear, sgd = new_linear_network()
table, rng = np.zeros((16, 4), np.float32), np.random.default_rng(0)
for _ in range(500):
    s, a = rng.integers(16), rng.integers(4)
    [(_, next_s, r, terminated)] = env.unwrapped.P[s][a]  # what the step gives
    y = np.float32(r) + np.float32((1 - terminated) * gamma) * table[next_s].max()
    table[s, a] += np.float32(alpha) * (y - table[s, a])
    update(linear, sgd, s, a, target(linear, s, a, r, next_s, terminated))

kernel = linear.get_weights()[0]
print(f"{table.size} numbers, {np.sum(table != 0)} of them not 0, {np.sum(kernel != table)} of them different")
np.testing.assert_array_equal(kernel, table)

# %% [markdown]
# No number is different. So the algorithm is the same: this network is just a slower table.
#
# ## A hidden layer
#
# In CartPole, the task of the lesson, a state is four real numbers. A table would need a row for each state, and hardly
# a state comes twice. A network with a hidden layer gives values also for states that it has never seen, because
# **states share weights**. The price: an update of one state changes the values of others. Here both networks learn the
# step from cell 14 to the goal, ten times. (The one without a hidden layer is the one from above. It has nearly learned
# this step already, so its number changes little.) Look at the *other* numbers:


# %%
def new_network():
    """Returns a network with a hidden layer of 32 units, and an optimizer for it."""
    network, optimizer = make_q_network(16, 4, hidden_units=(32,), seed=0), keras.optimizers.SGD(0.1)
    optimizer.build(network.trainable_variables)
    return network, optimizer


hidden, sgd_of_hidden = new_network()
cells = np.eye(16, dtype=np.float32)  # all states
for name, network, optimizer in (("no hidden layer", linear, sgd), ("a hidden layer ", hidden, sgd_of_hidden)):
    before = network(cells).numpy()
    for _ in range(10):
        update(network, optimizer, s=14, a=2, y=1.0)
    change = network(cells).numpy() - before
    others = np.delete(change.ravel(), 4 * 14 + 2)
    print(f"{name}: Q(14, right) changes by {change[14, 2]:+.3f};", end=" ")
    print(f"{np.sum(others != 0)} of the other 63 numbers change, at most by {np.abs(others).max():.3f}")

# %% [markdown]
# This causes two difficulties that a table does not have.
#
# **The order matters.** We teach the right values of all 64 numbers to new networks, each value 50 times: first cell
# after cell, as an agent would meet them that stays long in one part of the lake; then the same values shuffled.

# %%
right = np.zeros((16, 4), np.float32)
for s, a in np.ndindex(16, 4):
    [(_, next_s, r, terminated)] = env.unwrapped.P[s][a]
    right[s, a] = r + (1 - terminated) * gamma * q[next_s].max()
in_order = [(s, a) for s in range(16) for _ in range(50) for a in range(4)]
shuffled = np.random.default_rng(0).permutation(in_order).tolist()
for name, make, pairs in (
    ("no hidden layer, cell after cell", new_linear_network, in_order),
    ("a hidden layer, cell after cell ", new_network, in_order),
    ("a hidden layer, shuffled        ", new_network, shuffled),
):
    network, optimizer = make()
    for s, a in pairs:
        update(network, optimizer, s, a, right[s, a])
    error = np.abs(network(cells).numpy() - right).mean(axis=1)
    print(f"{name}: mean error {error.mean():.3f}; in the last cell {error[15]:.3f}, in the worst {error.max():.3f}")

# %% [markdown]
# With a hidden layer, the order decides: cell after cell, the network learns the last cell and forgets others.
#
# **The target moves.** The target of the step from cell 13 to cell 14 is $\gamma \max_{a'} Q(14, a')$. Twenty updates
# move $Q(13, \text{right})$ towards it, and nothing else is learned. Does the target stay where it was?


# %%
def copy_of(network):
    """Returns a network with the same weights."""
    copied = keras.models.clone_model(network)
    copied.set_weights(network.get_weights())
    return copied


def show_targets(name, network, q_hat_network, learning_rate):
    """Prints the target before the first and after the last update."""
    optimizer = keras.optimizers.SGD(learning_rate)
    optimizer.build(network.trainable_variables)
    for k in range(21):
        y = target(q_hat_network, s=13, a=2, r=0.0, next_s=14, terminated=False)
        if k in (0, 20):
            value = float(network(one_hot(13))[0, 2])
            print(f"{name}, after {k:2} updates: Q(13, right) {value:.3f}, its target {y:.3f}")
        update(network, optimizer, 13, 2, y)


other, frozen = copy_of(hidden), copy_of(hidden)
show_targets("no hidden layer         ", linear, linear, alpha / 2)
show_targets("a hidden layer          ", hidden, hidden, 0.1)
show_targets("a hidden layer and Q-hat", other, frozen, 0.1)

# %% [markdown]
# With a hidden layer, the target has moved along, to 1.121. That is too high: the right value is 0.9, and no value here
# can be above 1. In the last two lines, the target comes from $\hat Q$, a copy of the network that stays as it was:
# this target does not move.
#
# DQN adds two ideas to Q-learning, one for each difficulty: a **replay memory**, from which the steps are drawn in
# random order, and a **target network**, the copy. (Whether a task needs both is a question for measurements:
# [Does it need this?](does_it_need_this.ipynb).) The lesson, [deep_q_network.ipynb](deep_q_network.ipynb), builds both,
# for a task with too many states for a table.
