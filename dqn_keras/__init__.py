"""Deep Q-Network (DQN) in Keras on Gymnasium: a notebook's algorithm as a package.

`dqn_keras.learn` is the function; the module of the same name holds it together with its two parts:
`from dqn_keras.learn import learn, loss_values, update_q_hat`.
"""

from dqn_keras._tensorflow import require_tensorflow_backend

require_tensorflow_backend()

from dqn_keras.agent import Agent, Episode, episode_seed
from dqn_keras.config import Config
from dqn_keras.evaluation import evaluate
from dqn_keras.learn import learn, loss_values, update_q_hat
from dqn_keras.networks import make_networks, make_q_network
from dqn_keras.plotting import plot_rewards
from dqn_keras.policy import action, decay_epsilon
from dqn_keras.rendering import animate, record_episode, save_animation
from dqn_keras.replay import Experience, ReplayMemory
from dqn_keras.training import Run, train
from dqn_keras.version import __version__

__all__ = [
    "Agent",
    "Config",
    "Episode",
    "Experience",
    "ReplayMemory",
    "Run",
    "__version__",
    "action",
    "animate",
    "decay_epsilon",
    "episode_seed",
    "evaluate",
    "learn",
    "loss_values",
    "make_networks",
    "make_q_network",
    "plot_rewards",
    "record_episode",
    "save_animation",
    "train",
    "update_q_hat",
]
