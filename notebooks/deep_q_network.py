# %% [markdown]
# # Deep Q-Network
#
# A pole stands on a cart. Left alone, it falls. Fifty times a second, we may push the cart to the left or to the right.
# Nobody tells the program how to balance the pole. It sees four numbers, and it gets a reward of 1 for each step until
# the pole falls.
#
# In this notebook, a small neural network learns it by *Q-learning*, with the two ideas that made Q-learning work with
# networks: a *replay memory* and a *target network* ([Mnih et al. 2015](https://www.nature.com/articles/nature14236)).
# Each part is written out in a few lines, and a check compares it with the package `dqn_keras`. The package reproduces
# an older notebook, called *the original* here; the numbers in `Config()` are its numbers. Change a part, and see what
# happens.
#
# You need to know Python, a little Keras, and what a gradient is; nothing of reinforcement learning.
# [From a table to a network](from_a_table.ipynb) is a gentler start.
#
# The main path ends after "What it has learned" and takes about half an hour. The sections after it, "Going further",
# take about a quarter of an hour more; you may skip any of them. (These are estimates: 200 words a minute, and one
# minute for each code cell. Typing the code yourself takes longer.) "S&B" is
# [Sutton and Barto's book](http://incompleteideas.net/book/the-book-2nd.html), second edition.

# %%
import os

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # otherwise TensorFlow logs into the notebook
os.environ["SDL_VIDEODRIVER"] = "dummy"  # pictures are drawn without a display

# %% [markdown]
# The next cell installs the package if it is missing. (In Colab, first clone the repository and go to its folder
# `notebooks` with `%cd`.)

# %%
import importlib.util

from IPython import get_ipython

if importlib.util.find_spec("dqn_keras") is None:
    get_ipython().run_line_magic("pip", 'install --quiet "..[notebooks]"')

# Imported before Keras, the package keeps TensorFlow's messages out of the notebook.
import dqn_keras
from dqn_keras import Config, Experience, ReplayMemory, make_networks, make_q_network, train

print("dqn_keras", dqn_keras.__version__)

# %%
import gymnasium as gym
import keras
import matplotlib.pyplot as plt
import numpy as np
import tensorflow as tf

# %% [markdown]
# ## Parameters
#
# All numbers of the algorithm are in one object. You need not understand them yet: most are explained where they are
# used. `alpha` is the learning rate of the optimizer Adam. Those after `hidden_units` do not matter here. The seed
# decides everything random: the same seed gives the same run.

# %%
config = Config()
seed = 0
config

# %% [markdown]
# ## The environment
#
# This is Gymnasium's [CartPole-v1](https://gymnasium.farama.org/environments/classic_control/cart_pole/). A *state* $s$
# is four numbers: position and velocity of the cart, angle and angular velocity of the pole. There are two *actions*
# $a$: push left (0) and push right (1). Each step gives a reward $r = 1$.
#
# An episode is **terminated** when the pole leans more than 12° or the cart is more than 2.4 units from the middle.
# After 500 steps, it is **truncated**: time is up, but nothing has fallen.

# %%
env = gym.make("CartPole-v1")
state, _ = env.reset(seed=seed)
next_state, reward, terminated, truncated, info = env.step(0)
print("observation space:", env.observation_space)
print("action space:     ", env.action_space)
print("state:            ", state)
print("next state:       ", next_state)
print("reward:", reward, " terminated:", terminated, " truncated:", truncated)

# %% [markdown]
# ## What Q is
#
# This section is the theory. If a formula stops you, read only the text around it and go on: the code below needs just
# the last two paragraphs.
#
# A *policy* $\pi$ says which action to take in each state. The *return* is the sum of all later rewards, in which a
# reward $k$ steps ahead is multiplied by $\gamma^k$. The *action value* $Q^\pi(s, a)$ is the mean return after action
# $a$ in state $s$, **if the policy $\pi$ acts from then on** (S&B, section 3.5):
#
# $$Q^\pi(s, a) = \mathbb{E}_\pi \Bigl[\, \sum_{k \ge 0} \gamma^k \, r_{t+k} \;\Big|\; s_t = s,\ a_t = a \Bigr]$$
#
# $\mathbb{E}_\pi$ stands for this mean: over all that can happen when $\pi$ acts. The best policy has the highest
# values, $Q^*(s, a) = \max_\pi Q^\pi(s, a)$. They satisfy the *Bellman optimality equation* (S&B, equation 3.20):
#
# $$Q^*(s, a) = \mathbb{E} \bigl[\, r + \gamma \max_{a'} Q^*(s', a') \bigr]$$
#
# An action is worth its reward $r$, plus $\gamma$ times the value of the best action $a'$ in the next state $s'$.
# ($\gamma$ is 0.95 here: a reward ten steps ahead counts $0.95^{10} \approx 60\,\%$.)
#
# If we knew $Q^*$, acting would be easy: take the action with the highest value, the *greedy* action. *Q-learning*
# (S&B, section 6.5) starts with any $Q$ and moves $Q(s, a)$ towards the right side of that equation, again and again.
# It is *off-policy*: it learns the values of the best policy, while another policy, which also tries things out,
# collects the experience.

# %% [markdown]
# ## Two networks
#
# The network takes a state and gives one value for each action. We keep **two** of them. $Q$ learns. $\hat Q$, the
# *target network*, is a copy that follows $Q$ slowly, and $Q$ learns from its values. If $Q$ learned from its own
# values, each learning step would also move the target, as if the goal ran away from the runner.

# %%
q_network, q_hat_network = make_networks(num_features=4, num_actions=2, hidden_units=config.hidden_units, seed=seed)
for weights in q_network.weights:
    print(weights.path, tuple(weights.shape))
print("Q    :", q_network(state[None]).numpy())
print("Q-hat:", q_hat_network(state[None]).numpy(), "(equal at the start)")

# %% [markdown]
# ## Experience
#
# One step of the environment is one *transition*: state, action, reward, next state, and whether the next state was
# terminal. In code, the last is `terminal_state`, 1 or 0. A batch of $B$ transitions has the same five fields, each
# with $B$ rows.
#
# Only *terminated* counts as terminal. If time ran out, the pole still stood, and the future was still worth something.
#
# Here is a batch of random numbers, to try out the next parts:

# %%
rng = np.random.default_rng(seed)
batch = Experience(
    state=rng.normal(size=(64, 4)).astype(np.float32),
    action=rng.integers(2, size=64).astype(np.int32),
    reward=np.ones(64, np.float32),
    next_state=rng.normal(size=(64, 4)).astype(np.float32),
    terminal_state=rng.integers(2, size=64).astype(np.float32),
)
print("shapes of a made-up batch:", {name: values.shape for name, values in batch._asdict().items()})

# %% [markdown]
# ## The targets
#
# The target $y$ of a transition is the right side of the Bellman equation, with $\hat Q$ in place of $Q^*$. After a
# terminal state there are no rewards, so its value is 0:
#
# $$y = \begin{cases} r & s' \text{ terminal} \\ r + \gamma \max_{a'} \hat Q(s', a') & \text{otherwise} \end{cases}$$
#
# (`q_network` is not used here. Other formulas need it, such as Double DQN's in the exercises.)


# %%
def my_targets(experiences, gamma, q_network, q_hat_network):
    _, _, rewards, next_states, terminal_states = experiences
    best_values = tf.reduce_max(q_hat_network(next_states), axis=-1)  # [B]
    return rewards + (1 - terminal_states) * gamma * best_values


arguments = batch, config.gamma, q_network, q_hat_network
np.testing.assert_allclose(my_targets(*arguments), dqn_keras.td_targets(*arguments), rtol=1e-6)
for terminal, y in list(zip(batch.terminal_state, my_targets(*arguments)))[8:12]:
    print(f"terminal {terminal:.0f}: target {y:.3f}")

# %% [markdown]
# ## The loss
#
# The *temporal-difference error* (TD error) $y - Q(s, a)$ says how much better or worse a step went than $Q$ had
# expected. The loss is the mean of its square over the batch; $\theta$ are the weights of $Q$, and $\hat\theta$ those
# of $\hat Q$:
#
# $$L(\theta) = \frac{1}{B} \sum_{i=1}^{B} \bigl(y_i - Q(s_i, a_i; \theta)\bigr)^2$$


# %%
def my_loss(y, experiences, q_network):
    q_values = q_network(experiences.state)  # [B, A]
    q = tf.gather(q_values, experiences.action, batch_dims=1)  # [B]: only the action that was taken
    return tf.reduce_mean((y - q) ** 2)


loss = my_loss(my_targets(*arguments), batch, q_network)
np.testing.assert_allclose(loss, dqn_keras.loss_values(*arguments), rtol=1e-6)
print(f"loss: {loss:.4f}")

# %% [markdown]
# ## The soft update
#
# After each learning step, $\hat Q$ moves a hundredth of the way towards $Q$
# ([Lillicrap et al. 2015](https://arxiv.org/abs/1509.02971), algorithm 1):
#
# $$\hat\theta \leftarrow \tau\,\theta + (1 - \tau)\,\hat\theta, \qquad \tau = 0.01$$


# %%
def my_update(q_network, q_hat_network, tau):
    for weights, hat_weights in zip(q_network.weights, q_hat_network.weights):
        hat_weights.assign(tau * weights + (1 - tau) * hat_weights)


mine, packages = make_q_network(4, 2, seed=1), make_q_network(4, 2, seed=1)
my_update(q_network, mine, config.tau)
dqn_keras.update_q_hat(q_network, packages, config.tau)
for my_weights, their_weights in zip(mine.get_weights(), packages.get_weights()):
    np.testing.assert_allclose(my_weights, their_weights, rtol=1e-5, atol=1e-7)
print("the same weights after the update")

# %% [markdown]
# ## One learning step
#
# One learning step does three things. It computes the gradient of the loss with respect to the weights of $Q$ alone,
# takes one step of the optimizer, and makes one soft update. A `GradientTape` records what is computed inside its
# block, so that TensorFlow can differentiate it. The targets are computed outside: they count as fixed numbers. The
# check takes the same step with the package's `learn`, from the same start, and compares all weights of both networks.


# %%
def my_learn(experiences, gamma, q_network, q_hat_network, optimizer, tau):
    y = my_targets(experiences, gamma, q_network, q_hat_network)  # outside the tape: no gradient flows through it
    with tf.GradientTape() as tape:
        loss = my_loss(y, experiences, q_network)
    weights = q_network.trainable_variables
    optimizer.apply_gradients(zip(tape.gradient(loss, weights), weights))
    my_update(q_network, q_hat_network, tau)
    return loss


mine, packages = make_networks(4, 2, seed=1), make_networks(4, 2, seed=1)
my_learn(batch, config.gamma, *mine, keras.optimizers.Adam(config.alpha), config.tau)
dqn_keras.learn(batch, config.gamma, *packages, keras.optimizers.Adam(config.alpha), config.tau)
for my_network, their_network in zip(mine, packages):
    for my_weights, their_weights in zip(my_network.get_weights(), their_network.get_weights()):
        np.testing.assert_allclose(my_weights, their_weights, rtol=1e-3, atol=1e-6)
print("the same weights after the step")

# %% [markdown]
# ## The policy
#
# An agent that always takes the greedy action never learns what the others are worth. So with probability
# $\varepsilon$ the action is random (*epsilon-greedy*; S&B, section 2.2). $\varepsilon$ starts at 1, because $Q$ knows
# nothing, and falls after each episode:
#
# $$\varepsilon \leftarrow \max(0.995 \, \varepsilon,\; 0.1)$$


# %%
def my_action(q_values, epsilon, rng):
    if rng.random() < epsilon:
        return int(rng.integers(len(q_values)))
    return int(np.argmax(q_values))


def my_decay(epsilon):
    return max(config.decay * epsilon, config.epsilon_min)


q_values = np.array([0.1, 0.7])
mine = [my_action(q_values, 0.5, np.random.default_rng(k)) for k in range(20)]
packages = [dqn_keras.action(q_values, 0.5, np.random.default_rng(k)) for k in range(20)]
np.testing.assert_equal(mine, packages)
np.testing.assert_allclose(my_decay(0.5), dqn_keras.decay_epsilon(0.5, config))
print("20 actions at epsilon 0.5:", *mine)

# %% [markdown]
# Action 1 is greedy. On average, half of the actions are random, and half of these are 1, too. So about three in four
# are 1 (here 15 of 20).

# %% [markdown]
# ## The replay memory
#
# Successive steps resemble each other. A network that learns them in order may forget the rest
# ([From a table to a network](from_a_table.ipynb) shows an example), so batches should be mixed, as when training data
# are shuffled. The last 50,000 transitions are kept, and each learning step draws 64 of them at random. `ReplayMemory`
# is a table with one row for each transition; when it is full, a new transition replaces the oldest.

# %%
memory = ReplayMemory(config.memory_size, state_shape=(4,))
for k in range(100):
    memory.append(Experience(np.full(4, k), 0, 1.0, np.full(4, k + 1), 0.0))
print("the first numbers of 10 sampled states:", memory.sample(10, rng).state[:, 0])

# %% [markdown]
# ## Training
#
# All parts in their order. In each step, the agent acts and stores the transition. At every fourth step
# (`steps_per_update`), it draws a batch and learns, as soon as the memory holds 64 transitions. After each episode,
# $\varepsilon$ falls. (`state[None]` is a batch of one state; `[0]` takes the one row of the result.) This is the whole
# algorithm:

# %%
from dqn_keras.seeding import acting_rng, episode_seed, weights_seed  # the same random numbers as `train`


def my_train(env, config, seed, num_episodes):
    q_network, q_hat_network = make_networks(4, 2, config.hidden_units, weights_seed(seed))
    optimizer, rng = keras.optimizers.Adam(config.alpha), acting_rng(seed)
    memory, epsilon, rewards = ReplayMemory(config.memory_size, state_shape=(4,)), config.epsilon, []
    for episode in range(num_episodes):
        state, _ = env.reset(seed=episode_seed(seed, episode))
        rewards.append(0.0)
        for t in range(config.max_steps):
            action = my_action(q_network(state[None])[0].numpy(), epsilon, rng)
            next_state, reward, terminated, truncated, _ = env.step(action)
            memory.append(Experience(state, action, reward, next_state, terminated))
            rewards[-1] += reward
            if t % config.steps_per_update == 0 and len(memory) >= config.batch_size:
                batch = memory.sample(config.batch_size, rng)
                my_learn(batch, config.gamma, q_network, q_hat_network, optimizer, config.tau)
            state = next_state
            if terminated or truncated:
                break
        epsilon = my_decay(epsilon)
    return rewards


my_rewards = my_train(env, config, seed, num_episodes=30)
print("rewards of the first episodes:", *(f"{reward:.0f}" for reward in my_rewards))

# %% [markdown]
# The package's `train` does the same, only faster. It trains until the mean of the last 50 rewards is above 225, or
# 2,000 episodes are over. (225 is the original notebook's bar. Gymnasium's own is a mean of 475 over 100 episodes.)
# A Keras callback, which `train` calls after each episode, keeps the weights of some episodes for pictures further
# down.


# %%
class Snapshots(keras.callbacks.Callback):
    def on_train_begin(self, logs=None):
        self.weights = {"start": self.model.get_weights()}

    def on_epoch_end(self, epoch, logs=None):  # an epoch is an episode
        if epoch + 1 in (50, 100, 150, 200):
            self.weights[f"{epoch + 1} episodes"] = self.model.get_weights()

    def on_train_end(self, logs=None):
        self.weights["end"] = self.model.get_weights()


snapshots = Snapshots()
run = train(env, config, seed, callbacks=[snapshots])
assert run.solved_at is not None, "this seed was not solved within 2,000 episodes"
np.testing.assert_equal(run.rewards[:30], my_rewards)
print("The first 30 rewards are the same as yours.")

# %% tags=["save-rewards"]
ax = dqn_keras.plot_rewards(run.rewards, window=config.solved_window)
_ = ax.axhline(config.solved_reward, color="gray", linestyle=":")
for k in (50, 100, 150, 200, 250):
    print(f"mean of the last 50 rewards after {k} episodes: {run.rewards[k - 50 : k].mean():.0f}")

# %% [markdown]
# For about 170 episodes nothing seems to happen; the mean even sinks from 19 to 15. (The log prints the mean of the
# last 100 rewards; the curve is the mean of the last 50.) Then the curve climbs, though not smoothly. The dotted line
# is the bar of 225.
#
# The original notebook reports its run as solved in 293 episodes. That is one seed, and so is this one.
#
# `train` also takes your formula for the targets. With the same formula, it is the same run.
#
# Now break it. In "The targets", leave out `(1 - terminal_states) *` and run that cell; its check fails, as it should.
# Then come back and run the cell below. What do you expect? (A run that does not learn goes on for 2,000 episodes;
# `verbose=1` shows how far it is.) Afterwards, repair it and run its cell again.
#
# We tried it with `Config(num_episodes=400)`: it is not solved, and its last 50 episodes have 10 steps on average.

# %%
own_run = train(env, config, seed, targets=my_targets, verbose=0)
print(own_run)
print("the same rewards as before:", np.array_equal(own_run.rewards, run.rewards))

# %% [markdown]
# ## What it has learned
#
# How good is the network without random actions ($\varepsilon = 0$)? It plays 100 episodes greedily, from starts that
# training has not seen:

# %%
returns = dqn_keras.evaluate(env, run.q_network, num_episodes=100, seed=seed)
assert returns.mean() > 100, "greedy play should be far better than the 20 or so of random actions"
print(
    f"rewards of a greedy episode: mean {returns.mean():.1f}, lowest {returns.min():.0f}, highest {returns.max():.0f}"
)
print(f"mean of the last 50 training episodes: {run.rewards[-50:].mean():.1f}")
print(f"epsilon of the last episode: {run.history['epsilon'][-1]:.2f}")

# %% [markdown]
# In training, nearly one action in four was still random at the end. And the mean is over 50 episodes, in which the
# network went on learning.

# %% [markdown]
# Three policies from the same start. From left to right: random pushes, a rule written by hand (push to the side to
# which the pole leans and moves), and the trained network.


# %%
def play(policy):
    picture_env = gym.make("CartPole-v1", render_mode="rgb_array")
    state, _ = picture_env.reset(seed=1)
    states, frames, done = [state], [picture_env.render()], False
    while not done:
        state, _, terminated, truncated, _ = picture_env.step(policy(state))
        states.append(state)
        done = terminated or truncated
        if done or len(states) % 2:  # every second picture is enough
            frames.append(picture_env.render())
    return np.array(states), frames


policies = {
    "random": lambda state: int(rng.integers(2)),
    "by hand": lambda state: int(state[2] + state[3] > 0),
    "trained": lambda state: int(np.argmax(run.q_network(state[None]))),
}
episodes = {name: play(policy) for name, policy in policies.items()}
print("rewards:", {name: len(states) - 1 for name, (states, _) in episodes.items()})
longest = max(len(frames) for _, frames in episodes.values())
columns = [frames + frames[-1:] * (longest - len(frames)) for _, frames in episodes.values()]
side_by_side = [np.hstack([np.pad(frame, ((0, 0), (0, 4), (0, 0))) for frame in frames]) for frames in zip(*columns)]
dqn_keras.animate(side_by_side, fps=25, width=660)

# %% [markdown]
# From this start, the rule by hand is even better: 500 steps, and the network's cart leaves the track after 480. But
# the rule needs someone who knows what the four numbers mean. The network has found its own rule from rewards alone.
#
# **Here the main path ends.** Where to go from here:
#
# - [Exercises](exercises.ipynb): write the parts yourself, with checks that say what is wrong.
# - [Does it need this?](does_it_need_this.ipynb): take parts away, and predict what happens to a hundred seeds.
# - [Explore](explore.ipynb): sliders for the numbers.
# - [How reliable is it?](how_reliable.ipynb): a hundred seeds, the ones that fail, and why.
# - [Your own environment](your_own_environment.ipynb): from an idea to a trained agent in ten cells.

# %% [markdown]
# ## Going further
#
# Each of the following sections asks one question about the run above. Read those that interest you.

# %% [markdown]
# ### Why does the loss rise?
#
# In this run, the loss rises for most of the training (second panel below). How can that be, if the agent learns? First
# a simpler question: does the loss fall if the same batch is learned again and again? Here are 1,000 steps, once with
# the soft update and once with a $\hat Q$ that stays as it is ($\tau = 0$).

# %%
for tau in (0.0, config.tau):
    networks, optimizer = make_networks(4, 2, seed=seed), keras.optimizers.Adam(config.alpha)
    losses = [dqn_keras.learn(batch, config.gamma, *networks, optimizer, tau) for _ in range(1_000)]
    print(f"tau {tau}: loss of steps 0, 100, 200, ...:", *(f"{loss:.3f}" for loss in losses[::100]))

# %% [markdown]
# With fixed targets, the loss falls towards 0. With the soft update, the targets move while $Q$ learns them: the loss
# falls, rises and falls again. So a rising loss need not mean that something is wrong.
#
# The next panels show what the run recorded for each episode. "TD error" is its mean size, without the sign. After
# about 170 episodes, they become longer. So the share of terminal transitions in the memory falls, and so does the
# median age (in episodes) of the experience from which the agent learns.


# %%
def median_age(steps):
    """Returns, for each episode, how many episodes ago the median transition of the memory was stored."""
    total = np.cumsum(steps)  # transitions so far, [episodes]
    kept = np.minimum(total, config.memory_size)
    return np.arange(len(steps)) - np.searchsorted(total, total - kept / 2)


history = run.history
panels = {
    "Epsilon": history["epsilon"],
    "Loss": history["loss"],
    "TD error": history["td_error"],
    "Mean over the batches of max Q": history["mean_q"],
    "Terminal transitions (%)": 100 * np.array(history["terminal_share"]),
    "Median age of the memory (episodes)": median_age(history["steps"]),
}
_, axes = plt.subplots(2, 3, figsize=(12, 5.5), layout="constrained", sharex=True)
for ax, (title, values) in zip(axes.flat, panels.items()):
    ax.plot(values)
    ax.set(title=title, ylim=(0, None))
    ax.grid(alpha=0.3)
for ax in axes[1]:
    ax.set_xlabel("Episode")
for k in (50, 100, 200, run.solved_at):
    share = history["td_error"][k] / history["mean_q"][k]
    print(f"episode {k}: loss {history['loss'][k]:.2f}, TD error {share:.0%} of the mean of max Q")

# %% [markdown]
# **The loss does not tell how well the agent acts.** It falls for about 25 episodes. Then it rises while the rewards
# stay low, and goes on rising for most of their climb. (Single episodes are noisy, as the printed ones: look at the
# curve.) Meanwhile $Q$ grows towards 20, the highest possible value: $\sum_k \gamma^k \cdot 1 = 1 / (1 - 0.95) = 20$.
# Relative to $Q$, the TD error falls.

# %% [markdown]
# ### What does Q believe?
#
# The colours are $\max_a Q(s, a)$ over the angle and the angular velocity of the pole, with the cart at rest in the
# middle. Where it is hatched, the greedy action is to push right; elsewhere it is to push left. **Each panel has its
# own scale**: compare patterns between panels, not colours.

# %%
_, axes = plt.subplots(2, 3, figsize=(10, 5.5), layout="constrained", sharex=True, sharey=True)
picture_network = make_q_network(4, 2, config.hidden_units)
for ax, (title, weights) in zip(axes.flat, snapshots.weights.items()):
    picture_network.set_weights(weights)
    dqn_keras.plot_q(picture_network, x=(2, -0.21, 0.21), y=(3, -2.0, 2.0), ax=ax)
    ax.figure.colorbar(ax.collections[0], ax=ax)
    ax.set_title(title.capitalize())
for ax in axes[1]:
    ax.set_xlabel("Angle (rad)")
for ax in axes[:, 0]:
    ax.set_ylabel("Angular velocity (rad/s)")

# %% [markdown]
# The colour bars show how the values grow. When the pole moves to the right, the cart has to move to the right, too.
# For 100 episodes, the network pushes the wrong way in most of these states; at 150, it pushes left nearly everywhere.
# At 200, the two sides are right. In the end, the values also tell safe states (the bright band) from lost ones (the
# dark corners: the pole leans to one side and moves further that way).

# %% [markdown]
# ### Is Q right?
#
# What did $Q$ expect at each step of the trained agent's episode, and what did the episode then bring: the sum of its
# discounted rewards from that step on?

# %%
states, _ = episodes["trained"]
expected = run.q_network(states[:-1]).numpy().max(axis=-1)
brought = np.zeros(len(states))
for t in reversed(range(len(states) - 1)):
    brought[t] = 1 + config.gamma * brought[t + 1]
_, ax = plt.subplots(figsize=(8, 3.5), layout="constrained")
ax.plot(expected, label="expected: max over a of Q(s, a)")
ax.plot(brought[:-1], "--", label="brought: discounted return")
ax.set(xlabel="Step of the episode", ylabel="Return from here on")
ax.legend(loc="lower left")
ax.grid(alpha=0.3)
print(f"last step: expected {expected[-1]:.1f}, brought {brought[-2]:.1f}; the cart ends at {states[-1][0]:.2f}")

# %% [markdown]
# $Q$ is nearly right for most of the episode. It is wrong at the end: it falls when the edge of the track comes near,
# but not nearly as far as it should.

# %% [markdown]
# ### Why does the cart drift off?
#
# Here is the first of the 100 greedy episodes.

# %% tags=["save-pole"]
picture_env = gym.make("CartPole-v1", render_mode="rgb_array")
dqn_keras.animate(dqn_keras.record_episode(picture_env, run.q_network, seed=seed))

# %% [markdown]
# Balance is no problem here. The episode ends because the cart drifts to the side until it leaves the track. Is the
# agent short-sighted? With $\gamma = 0.95$, a reward a hundred steps ahead counts $0.95^{100} \approx 0.6\,\%$ of one
# now. To test this, we need many seeds.
#
# Many seeds need a fast program. If the environment is written in TensorFlow, too, XLA, TensorFlow's compiler, can
# compile whole episodes. After some seconds of compiling, a training takes about a tenth of a second
# ([results/speed.md](../results/speed.md)). The algorithm, the networks and the optimizer are the same. The run ends
# at another episode, because a compiled program draws its random numbers with another generator than NumPy's.

# %%
from dqn_keras.environments import CartPole

compiled_run = train(CartPole(), config, seed, verbose=0)
print(compiled_run)

# %% [markdown]
# Seed 0 is slow here; [How reliable is it?](how_reliable.ipynb) shows how many seeds are.
#
# Does a larger $\gamma$ keep the cart on the track? We change $\gamma$ alone, in two settings: the original's, and the
# *preset* for CartPole, which are numbers that are known to work. The preset has $\gamma = 0.99$, a faster target
# network and less exploration in the end, and trains up to a mean of 475 over 100 episodes. `sweep` trains eight seeds
# of each for at most 600 episodes; each then plays 100 episodes greedily.

# %%
from dataclasses import replace

preset = dqn_keras.presets["CartPole-v1"]
settings = {
    "original, gamma 0.95": replace(config, num_episodes=600),
    "original, gamma 0.99": replace(config, num_episodes=600, gamma=0.99),
    "preset, gamma 0.95": replace(preset, num_episodes=600, gamma=0.95),
    "preset, gamma 0.99": replace(preset, num_episodes=600),
}
outcome = dqn_keras.sweep(CartPole(), settings, seeds=range(8), evaluate_on=CartPole(), verbose=0)
for name, study in outcome.items():
    print(f"{name}: mean reward of a greedy episode {dqn_keras.summarize(study).greedy_return}")
assert outcome["preset, gamma 0.99"].greedy_returns.mean() > 450

# %% [markdown]
# 500 is the most that is possible. In brackets are *95 % intervals*: with other seeds, the mean would differ; the
# interval says where the mean over all seeds probably lies.
#
# With the original's other numbers, a larger $\gamma$ alone makes no difference that can be seen. With the preset's, it
# makes a large one: 0.99 plays nearly to the end, and 0.95 plays worse than the original. So $\gamma$ matters, but its
# effect depends on the other numbers. (Over a thousand seeds, it helps a little with the original's numbers, too:
# [results/ablation.md](../results/ablation.md).)
#
# The table shows rewards only: it does not say which episodes ended at the edge of the track. Exercise 8 of
# [Exercises](exercises.ipynb) counts them.

# %% [markdown]
# ### What does the climb wait for?
#
# What made the rewards climb after 170 episodes: that the memory held enough, or that the network had learned often
# enough? Over a hundred seeds, the climb does not come earlier if the memory already holds 5,000 random transitions.
# With more frequent updates it does: with one at every 1, 2, 4 or 8 steps, the curve climbs after 83, 114, 186 or 359
# episodes. So here the climb waits for learning, not for a fuller memory.
#
# This holds with $\varepsilon$ falling from 1. With $\varepsilon = 0.1$ from the start, the random transitions do help:
# 259 episodes instead of 384. (All are medians, from [results/climb.md](../results/climb.md), by
# `python -m benchmarks.climb`.)

# %% [markdown]
# ### What can go wrong?
#
# DQN does three things at once. It learns from its own estimates (*bootstrapping*). It learns about one policy from the
# actions of another (off-policy). And it uses a network instead of a table. Together, these can make the values
# *diverge*: grow without end. Sutton and Barto call them the *deadly triad* (section 11.3). Whether a slow $\hat Q$
# helps on this task is a question for measurements; [How reliable is it?](how_reliable.ipynb) asks it.
