"""Deep Q-Network (DQN) in Keras on Gymnasium: a notebook's algorithm as a package.

`dqn_keras.learn` is the function; the module of the same name holds it together with its two parts:
`from dqn_keras.learn import learn, loss_values, update_q_hat`.
"""

from dqn_keras._tensorflow import require_tensorflow_backend

require_tensorflow_backend()

from dqn_keras.agent import Agent, Episode, episode_seed
from dqn_keras.checkpoint import load_agent
from dqn_keras.config import Config
from dqn_keras.evaluation import evaluate
from dqn_keras.learn import learn, loss_values, update_q_hat
from dqn_keras.networks import make_networks, make_q_network
from dqn_keras.plotting import plot_rewards, plot_study
from dqn_keras.policy import action, decay_epsilon
from dqn_keras.rendering import animate, record_episode, save_animation
from dqn_keras.replay import Experience, ReplayMemory
from dqn_keras.study import Study, compare, load_study, study, summarize
from dqn_keras.training import Run, train
from dqn_keras.version import __version__

__all__ = [
    "Agent",
    "Config",
    "Episode",
    "Experience",
    "ReplayMemory",
    "Run",
    "Study",
    "__version__",
    "action",
    "animate",
    "compare",
    "decay_epsilon",
    "episode_seed",
    "evaluate",
    "learn",
    "load_agent",
    "load_study",
    "loss_values",
    "make_networks",
    "make_q_network",
    "plot_rewards",
    "plot_study",
    "record_episode",
    "save_animation",
    "study",
    "summarize",
    "train",
    "update_q_hat",
]
