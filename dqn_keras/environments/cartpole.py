"""CartPole-v1 (Barto, Sutton and Anderson 1983) with Gymnasium's constants and dynamics."""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.tensorflow import tf

GRAVITY = 9.8  # m/s^2
MASS_CART, MASS_POLE = 1.0, 0.1  # kg
TOTAL_MASS = MASS_CART + MASS_POLE
HALF_LENGTH = 0.5  # m
POLE_MOMENT = MASS_POLE * HALF_LENGTH  # kg m
FORCE = 10.0  # N
TAU = 0.02  # s, one step
MAX_ANGLE = 12 * 2 * math.pi / 360  # rad
MAX_POSITION = 2.4  # m


class CartPole(FuncEnv):
    """A pole on a cart. The state, [4] float64: position, velocity, angle, angular velocity.

    Every step gives a reward of 1. The episode terminates when the pole leans more than 12 degrees or the cart is more
    than 2.4 m from the middle, and is truncated after 500 steps.
    """

    _high = np.array([2 * MAX_POSITION, np.inf, 2 * MAX_ANGLE, np.inf], np.float32)
    observation_space = spaces.Box(-_high, _high)
    action_space = spaces.Discrete(2)
    max_episode_steps = 500

    def initial(self, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns a start state: all four numbers uniform in [-0.05, 0.05)."""
        return tf.random.stateless_uniform([4], rng, -0.05, 0.05, tf.float64, alg="philox")

    def transition(self, state: tf.Tensor, action: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns the next state: one Euler step with a push to the left (0) or to the right (1)."""
        _, velocity, angle, angular_velocity = tf.unstack(state)
        force = tf.where(action == 1, tf.constant(FORCE, tf.float64), -FORCE)
        cos, sin = tf.cos(angle), tf.sin(angle)
        push = (force + POLE_MOMENT * tf.square(angular_velocity) * sin) / TOTAL_MASS
        angular_acceleration = (GRAVITY * sin - cos * push) / (
            HALF_LENGTH * (4.0 / 3.0 - MASS_POLE * tf.square(cos) / TOTAL_MASS)
        )
        acceleration = push - POLE_MOMENT * angular_acceleration * cos / TOTAL_MASS
        return state + TAU * tf.stack([velocity, acceleration, angular_velocity, angular_acceleration])

    def observation(self, state: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns the state in float32."""
        return tf.cast(state, tf.float32)

    def reward(
        self, state: tf.Tensor, action: tf.Tensor, next_state: tf.Tensor, rng: tf.Tensor, params: Any = None
    ) -> tf.Tensor:
        """Returns 1, also for the step that ends the episode."""
        return tf.constant(1.0)

    def terminal(self, state: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns whether the cart has left the track or the pole has fallen."""
        return (tf.abs(state[0]) > MAX_POSITION) | (tf.abs(state[2]) > MAX_ANGLE)
