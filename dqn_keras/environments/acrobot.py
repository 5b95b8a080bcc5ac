"""Acrobot-v1 (Sutton 1996) with Gymnasium's constants and the dynamics of Sutton and Barto's book."""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.tensorflow import tf

GRAVITY = 9.8  # m/s^2
MASS, LENGTH, CENTRE, INERTIA = 1.0, 1.0, 0.5, 1.0  # of each link: kg, m, m, kg m^2
MAX_VELOCITIES = (4 * math.pi, 9 * math.pi)  # rad/s
DT = 0.2  # s, one step


class Acrobot(FuncEnv):
    """A double pendulum with a motor at its elbow. The state, [4] float64: both angles, both angular velocities.

    The episode terminates when the tip is one length above the joint, and is truncated after 500 steps. Every step
    gives a reward of -1, except the step that terminates, which gives 0.
    """

    _high = np.array([1, 1, 1, 1, *MAX_VELOCITIES], np.float32)
    observation_space = spaces.Box(-_high, _high)
    action_space = spaces.Discrete(3)
    max_episode_steps = 500

    def initial(self, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns a start state: all four numbers uniform in [-0.1, 0.1)."""
        return tf.cast(tf.random.stateless_uniform([4], rng, -0.1, 0.1, alg="philox"), tf.float64)

    def transition(self, state: tf.Tensor, action: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns the next state: a fourth-order Runge-Kutta step with a torque of -1 (0), 0 (1) or 1 (2) N m."""
        torque = tf.cast(action - 1, tf.float64)
        k1 = _derivative(state, torque)
        k2 = _derivative(state + DT / 2 * k1, torque)
        k3 = _derivative(state + DT / 2 * k2, torque)
        k4 = _derivative(state + DT * k3, torque)
        state = state + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        angles = state[:2] - 2 * math.pi * tf.round(state[:2] / (2 * math.pi))  # into [-pi, pi]
        limits = tf.constant(MAX_VELOCITIES, tf.float64)
        return tf.concat([angles, tf.clip_by_value(state[2:], -limits, limits)], axis=0)

    def observation(self, state: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns cosine and sine of the first angle, then of the second, then both velocities, [6] float32."""
        cos, sin = tf.cos(state[:2]), tf.sin(state[:2])
        return tf.cast(tf.stack([cos[0], sin[0], cos[1], sin[1], state[2], state[3]]), tf.float32)

    def reward(
        self, state: tf.Tensor, action: tf.Tensor, next_state: tf.Tensor, rng: tf.Tensor, params: Any = None
    ) -> tf.Tensor:
        """Returns -1, or 0 for the step that reaches the height."""
        return tf.where(self.terminal(next_state, rng), 0.0, -1.0)

    def terminal(self, state: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns whether the tip is high enough."""
        return -tf.cos(state[0]) - tf.cos(state[0] + state[1]) > 1.0


def _derivative(state: tf.Tensor, torque: tf.Tensor) -> tf.Tensor:
    angle_1, angle_2, velocity_1, velocity_2 = tf.unstack(state)
    cos_2, sin_2 = tf.cos(angle_2), tf.sin(angle_2)
    d_1 = MASS * CENTRE**2 + MASS * (LENGTH**2 + CENTRE**2 + 2 * LENGTH * CENTRE * cos_2) + 2 * INERTIA
    d_2 = MASS * (CENTRE**2 + LENGTH * CENTRE * cos_2) + INERTIA
    phi_2 = MASS * CENTRE * GRAVITY * tf.cos(angle_1 + angle_2 - math.pi / 2)
    coupling = MASS * LENGTH * CENTRE * sin_2
    phi_1 = (
        -coupling * tf.square(velocity_2)
        - 2 * coupling * velocity_2 * velocity_1
        + (MASS * CENTRE + MASS * LENGTH) * GRAVITY * tf.cos(angle_1 - math.pi / 2)
        + phi_2
    )
    acceleration_2 = (torque + d_2 / d_1 * phi_1 - coupling * tf.square(velocity_1) - phi_2) / (
        MASS * CENTRE**2 + INERTIA - tf.square(d_2) / d_1
    )
    acceleration_1 = -(d_2 * acceleration_2 + phi_1) / d_1
    return tf.stack([velocity_1, velocity_2, acceleration_1, acceleration_2])
