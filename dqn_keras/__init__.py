"""Deep Q-Network (DQN) in Keras on Gymnasium: a notebook's algorithm as a package.

`__init__.pyi` lists the public names. Each is imported at its first use: TensorFlow takes seconds to import, and
`dqn-keras --help` should not wait for it. `dqn_keras.learn` is the function; to import other names from the module
`learn`, write `from dqn_keras.learn import learn, loss_values, update_q_hat`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
