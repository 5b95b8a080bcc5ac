"""A second implementation of the original's algorithm: plain, eager, slow, and independent of the package.

It reads like the original: a deque of named tuples, a Keras call per state, a tf.function with the networks in
its closure. What the original left to chance comes in as arguments, so that two programs can be given the same:
the networks with their weights, the random generator, and the seed of each episode's reset.
"""

from collections import deque, namedtuple

import numpy as np
import tensorflow as tf
from keras.losses import mean_squared_error
from keras.optimizers import Adam

MEMORY_SIZE = 50_000
STEPS_PER_UPDATE = 4
ALPHA = 0.001
GAMMA = 0.95
TAU = 0.01
BATCH_SIZE = 64
DECAY = 0.995
EPSILON_MIN = 0.1
MAX_STEPS = 1_000

Transition = namedtuple("Transition", "state action reward next_state terminal_state")


def run(
    env,
    q_network,
    q_hat_network,
    rng,
    reset_seed,
    memory_size=MEMORY_SIZE,
    steps_per_update=STEPS_PER_UPDATE,
    alpha=ALPHA,
    gamma=GAMMA,
    tau=TAU,
    batch_size=BATCH_SIZE,
    epsilon=1.0,
    decay=DECAY,
    epsilon_min=EPSILON_MIN,
    max_steps=MAX_STEPS,
    *,
    learning_starts=0,
    steps_count_from="episode",
    gradient_steps=1,
    gradient_steps_per_target=1,
    epsilon_steps=None,
):
    """Yield (step's action, reward, episode ended) for ever; the networks learn on the way.

    The arguments by keyword are not the original's; they make the rhythm of other published DQNs.
    """
    optimizer = Adam(learning_rate=alpha)
    optimizer.build(q_network.trainable_variables)

    @tf.function
    def learn(states, actions, rewards, next_states, terminal_states, tau):
        with tf.GradientTape() as tape:
            best_next = tf.reduce_max(q_hat_network(next_states), axis=-1)
            y = rewards + (1 - terminal_states) * gamma * best_next
            pairs = tf.stack([tf.range(batch_size), actions], axis=1)
            loss = mean_squared_error(y, tf.gather_nd(q_network(states), pairs))
        weights = q_network.trainable_variables
        optimizer.apply_gradients(zip(tape.gradient(loss, weights), weights, strict=True))
        for q_hat, q in zip(q_hat_network.weights, q_network.weights, strict=True):
            q_hat.assign(tau * q + (1 - tau) * q_hat)

    memory = deque(maxlen=memory_size)
    episode = step = num_learned = 0
    first_epsilon = epsilon
    while True:
        state, _ = env.reset(seed=reset_seed(episode))
        for t in range(max_steps):
            if epsilon_steps:
                epsilon = max(epsilon_min, first_epsilon - (first_epsilon - epsilon_min) / epsilon_steps * step)
            chance = 1 if step < learning_starts else epsilon
            values = q_network(np.expand_dims(state, axis=0))
            a = rng.integers(values.shape[1]) if rng.random() < chance else np.argmax(values)
            next_state, reward, terminated, truncated, _ = env.step(a)
            memory.append(Transition(state, a, reward, next_state, terminated))
            count = t if steps_count_from == "episode" else step
            step += 1
            is_update = count % steps_per_update == 0 and len(memory) >= batch_size and step > learning_starts
            for _ in range(gradient_steps if is_update else 0):
                chosen = rng.choice(len(memory), size=batch_size, replace=False)
                batch = [memory[i] for i in chosen]
                num_learned += 1
                learn(
                    tf.constant(np.array([x.state for x in batch], np.float32)),
                    tf.constant(np.array([x.action for x in batch], np.int32)),
                    tf.constant(np.array([x.reward for x in batch], np.float32)),
                    tf.constant(np.array([x.next_state for x in batch], np.float32)),
                    tf.constant(np.array([x.terminal_state for x in batch], np.float32)),
                    tf.constant(tau if num_learned % gradient_steps_per_target == 0 else 0, tf.float32),
                )
            state = next_state.copy()
            yield int(a), float(reward), terminated or truncated or t + 1 == max_steps
            if terminated or truncated:
                break
        if epsilon > epsilon_min:
            epsilon = max(epsilon * decay, epsilon_min)
        episode += 1
