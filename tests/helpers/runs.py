"""Short runs, and a digest to compare them."""

import hashlib

import keras
import numpy as np

from dqn_keras import Config

QUICK = Config(num_episodes=30, batch_size=16, solved_reward=1000)


def fingerprint(run):
    """Returns a digest of networks, optimizer and rewards."""
    arrays = [*run.q_network.get_weights(), *run.q_hat_network.get_weights()]
    arrays += [v.numpy() for v in run.agent.optimizer.variables]
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in [*arrays, run.rewards])).hexdigest()


class Tape(keras.callbacks.Callback):
    """Records its calls, and stops the run after the episode `stop_after`."""

    def __init__(self, stop_after=None):
        super().__init__()
        self.stop_after, self.calls = stop_after, []

    def on_train_begin(self, logs=None):
        self.calls.append("train begins")

    def on_epoch_begin(self, epoch, logs=None):
        self.calls.append(("begins", epoch))

    def on_epoch_end(self, epoch, logs=None):
        self.calls.append(("ends", epoch))
        self.logs = logs
        self.model.stop_training = epoch == self.stop_after

    def on_train_end(self, logs=None):
        self.calls.append("train ends")


class SpoiledVelocity(keras.callbacks.Callback):
    """Makes one weight NaN at the next update, whose loss is still finite."""

    def on_epoch_begin(self, epoch, logs=None):
        if epoch == 12:
            velocity = self.model.optimizer.variables[3]
            velocity.assign(np.where(np.arange(velocity.shape[1]) == 5, np.nan, velocity.numpy()))
