"""Deep Q-Network (DQN) in Keras on Gymnasium: a notebook's algorithm as a package.

The public names are listed in `__init__.pyi`, and imported when they are first used: TensorFlow takes seconds, which
`dqn-keras --help` need not wait for. `dqn_keras.learn` is the function; the module of the same name holds it together
with its two parts: `from dqn_keras.learn import learn, loss_values, update_q_hat`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
