"""Networks, optimizers and losses of Keras users, by name, and an eager Keras step to compare with."""

import keras
import numpy as np
import tensorflow as tf
from keras import layers

SOME_STATES = np.random.default_rng(7).normal(3.0, 2.0, (200, 4)).astype(np.float32)


def dense(units, *args, **kwargs):
    return layers.Dense(units, *args, kernel_initializer=keras.initializers.GlorotUniform(seed=units), **kwargs)


def sequential(*inner):
    return keras.Sequential([keras.Input((4,)), *inner, dense(2)])


def functional(make_outputs):
    inputs = keras.Input((4,))
    return keras.Model(inputs, make_outputs(inputs))


def adapted(**kwargs):
    layer = layers.Normalization(**kwargs)
    layer.adapt(SOME_STATES)
    return layer


def dueling(inputs):
    hidden = dense(8, "relu")(inputs)
    value, advantages = dense(1)(hidden), dense(2)(hidden)
    return value + advantages - keras.ops.mean(advantages, axis=-1, keepdims=True)


def shared(inputs):
    layer = dense(4, "tanh")
    return dense(2)(layers.Concatenate()([layer(inputs), layer(layer(inputs))]))


class Scaled(layers.Layer):
    """Multiplies by an attribute that is not in its configuration."""

    factor = 1.0

    def call(self, inputs):
        return inputs * self.factor


class Configured(layers.Layer):
    """Has its own weights and an argument."""

    def __init__(self, power, **kwargs):
        super().__init__(**kwargs)
        self.power = power

    def build(self, shape):
        self.scale = self.add_weight(shape=(shape[-1],), initializer="ones")

    def call(self, inputs):
        return self.scale * inputs**self.power

    def get_config(self):
        return {**super().get_config(), "power": self.power}


def with_attribute():
    layer = Scaled()
    layer.factor = 3.0
    return sequential(dense(8, "relu"), layer)


def with_activation_set_later():
    network = sequential(dense(8, "relu"))
    network.layers[0].activation = bent
    return network


def bent(x):
    return tf.where(x > 0, x, 0.3 * tf.sin(x))


def frozen():
    network = sequential(dense(8, "relu"))
    network.layers[0].trainable = False
    return network


def mixed_precision():
    policy = keras.mixed_precision.DTypePolicy("mixed_float16")
    return keras.Sequential([keras.Input((4,)), dense(8, "relu", dtype=policy), dense(2, dtype="float32")])


NETWORKS = {
    "dense": lambda: sequential(dense(8, "relu")),
    "no hidden layer": lambda: sequential(),
    "Normalization, adapted": lambda: sequential(adapted(), dense(8, "relu")),
    "Normalization, of one axis less": lambda: sequential(adapted(axis=None), dense(8, "tanh")),
    "Normalization, given": lambda: sequential(layers.Normalization(mean=1.0, variance=4.0), dense(8, "relu")),
    "Normalization in a nested model": lambda: sequential(keras.Sequential([keras.Input((4,)), adapted()]), dense(8)),
    "Rescaling": lambda: sequential(layers.Rescaling(0.1, offset=1.0), dense(8, "relu")),
    "LayerNormalization": lambda: sequential(dense(8), layers.LayerNormalization(), layers.ReLU()),
    "GroupNormalization": lambda: sequential(dense(8), layers.GroupNormalization(2)),
    "UnitNormalization": lambda: sequential(dense(8), layers.UnitNormalization()),
    "PReLU": lambda: sequential(dense(8), layers.PReLU()),
    "Discretization and Embedding": lambda: sequential(
        layers.Discretization(bin_boundaries=[-1.0, 0.0, 1.0]),
        layers.Embedding(4, 3, embeddings_initializer=keras.initializers.RandomUniform(seed=1)),
        layers.Flatten(),
    ),
    "LSTM": lambda: sequential(layers.Reshape((4, 1)), layers.LSTM(5)),
    "GRU": lambda: sequential(layers.Reshape((4, 1)), layers.GRU(5)),
    "Bidirectional": lambda: sequential(layers.Reshape((4, 1)), layers.Bidirectional(layers.SimpleRNN(3))),
    "Conv1D": lambda: sequential(layers.Reshape((4, 1)), layers.Conv1D(3, 2, activation="relu"), layers.Flatten()),
    "Conv2D": lambda: sequential(layers.Reshape((2, 2, 1)), layers.Conv2D(3, 2, activation="relu"), layers.Flatten()),
    "TimeDistributed": lambda: sequential(
        layers.Reshape((4, 1)), layers.TimeDistributed(dense(3, "tanh")), layers.Flatten()
    ),
    "MultiHeadAttention": lambda: functional(
        lambda x: dense(2)(
            layers.Flatten()(layers.MultiHeadAttention(2, 3)(layers.Reshape((4, 1))(x), layers.Reshape((4, 1))(x)))
        )
    ),
    "dueling": lambda: functional(dueling),
    "shared layers": lambda: functional(shared),
    "nested Sequential": lambda: sequential(keras.Sequential([keras.Input((4,)), dense(6, "relu"), dense(3)])),
    "nested functional": lambda: sequential(functional(lambda x: layers.Add()([dense(4, "relu")(x), x]))),
    "Lambda of a lambda": lambda: sequential(dense(8), layers.Lambda(lambda x: tf.sin(x) * 2)),
    "Lambda of a function": lambda: sequential(dense(8), layers.Lambda(bent)),
    "a layer with an attribute set later": with_attribute,
    "a layer with a configuration": lambda: sequential(dense(8, "relu"), Configured(2)),
    "an activation of one's own": lambda: sequential(dense(8, bent)),
    "a lambda as activation": lambda: sequential(dense(8, lambda x: tf.tanh(2 * x))),
    "an activation of one's own in a wrapper": lambda: sequential(
        layers.Reshape((4, 1)), layers.TimeDistributed(dense(3, bent)), layers.Flatten()
    ),
    "an activation of one's own in a nested model": lambda: sequential(
        keras.Sequential([keras.Input((4,)), dense(6, bent)])
    ),
    "a regularizer of one's own": lambda: sequential(dense(8, kernel_regularizer=lambda w: tf.reduce_sum(w**4))),
    "an activation set later": with_activation_set_later,
    "a frozen layer": frozen,
    "mixed precision": mixed_precision,
    "kernel regularizer": lambda: sequential(dense(8, "relu", kernel_regularizer=keras.regularizers.L2(0.5))),
    "bias regularizer": lambda: sequential(
        dense(8, "relu", bias_regularizer="l1", bias_initializer=keras.initializers.RandomUniform(seed=3))
    ),
    "activity regularizer": lambda: sequential(
        dense(8, "relu", activity_regularizer=keras.regularizers.L1L2(0.1, 0.2))
    ),
    "constraint": lambda: sequential(dense(8, "relu", kernel_constraint=keras.constraints.MaxNorm(0.5))),
    "constraints on all": lambda: sequential(dense(8, kernel_constraint="unit_norm", bias_constraint="non_neg")),
}

INFERENCE_ONLY = {
    "Dropout": lambda: sequential(dense(8, "relu"), layers.Dropout(0.5, seed=0)),
    "BatchNormalization": lambda: sequential(dense(8), layers.BatchNormalization()),
    "GaussianNoise": lambda: sequential(layers.GaussianNoise(0.5, seed=0), dense(8)),
    "SpectralNormalization": lambda: sequential(layers.SpectralNormalization(dense(8))),
    "LSTM with dropout": lambda: sequential(layers.Reshape((4, 1)), layers.LSTM(3, dropout=0.2, seed=0)),
}


ALL_NETWORKS = NETWORKS | INFERENCE_ONLY


def two_of(make_network):
    """Returns two separately made networks with equal weights."""
    first, second = make_network(), make_network()
    second.set_weights(first.get_weights())
    return first, second


def excluding():
    optimizer = keras.optimizers.AdamW(0.01, weight_decay=0.5)
    optimizer.exclude_from_weight_decay(var_names=["bias"])
    return optimizer


class HalvingSchedule(keras.optimizers.schedules.LearningRateSchedule):
    """Has no configuration."""

    def __call__(self, step):
        return 0.1 * 0.5 ** tf.cast(step, tf.float32)


class SignDescent(keras.optimizers.SGD):
    """Has no configuration of its own."""

    def __init__(self, sharpness):
        super().__init__(0.01)
        self.sharpness = sharpness

    def update_step(self, gradient, variable, learning_rate):
        super().update_step(tf.tanh(self.sharpness * gradient), variable, learning_rate)


opt, rates = keras.optimizers, keras.optimizers.schedules
OPTIMIZERS = {
    "SGD": lambda: opt.SGD(0.05),
    "SGD, momentum and Nesterov": lambda: opt.SGD(0.05, momentum=0.9, nesterov=True),
    "SGD, weight decay": lambda: opt.SGD(0.05, weight_decay=0.1),
    "RMSprop": lambda: opt.RMSprop(0.01),
    "RMSprop, centered": lambda: opt.RMSprop(0.01, momentum=0.5, centered=True),
    "Adam": lambda: opt.Adam(0.01),
    "Adam, other betas": lambda: opt.Adam(0.01, beta_1=0.5, beta_2=0.9, epsilon=1e-3),
    "Adam, amsgrad": lambda: opt.Adam(0.01, amsgrad=True),
    "AdamW": lambda: opt.AdamW(0.01, weight_decay=0.3),
    "AdamW, biases excluded": excluding,
    "Adadelta": lambda: opt.Adadelta(1.0),
    "Adagrad": lambda: opt.Adagrad(0.05),
    "Adamax": lambda: opt.Adamax(0.01),
    "Adafactor": lambda: opt.Adafactor(0.01),
    "Nadam": lambda: opt.Nadam(0.01),
    "Ftrl": lambda: opt.Ftrl(0.05),
    "Lion": lambda: opt.Lion(0.001),
    "Lamb": lambda: opt.Lamb(0.01),
    "Muon": lambda: opt.Muon(0.01),
    "EMA": lambda: opt.Adam(0.01, use_ema=True, ema_momentum=0.5, ema_overwrite_frequency=2),
    "accumulation": lambda: opt.Adam(0.01, gradient_accumulation_steps=2),
    "clipnorm": lambda: opt.Adam(0.01, clipnorm=0.1, epsilon=0.1),
    "clipvalue": lambda: opt.SGD(0.1, clipvalue=0.01),
    "global_clipnorm": lambda: opt.SGD(0.1, global_clipnorm=0.1),
    "loss_scale_factor": lambda: opt.SGD(0.05, loss_scale_factor=1024.0),
    "LossScaleOptimizer": lambda: opt.LossScaleOptimizer(opt.SGD(0.05), dynamic_growth_steps=2),
    "ExponentialDecay": lambda: opt.SGD(rates.ExponentialDecay(0.1, 1, 0.5)),
    "CosineDecay": lambda: opt.Adam(rates.CosineDecay(0.0, 4, warmup_target=0.02, warmup_steps=2)),
    "PiecewiseConstantDecay": lambda: opt.SGD(rates.PiecewiseConstantDecay([2, 3], [0.1, 0.01, 0.001])),
    "a schedule of one's own": lambda: opt.SGD(HalvingSchedule()),
    "a callable learning rate": lambda: opt.SGD(lambda: 0.03),
    "an optimizer of one's own": lambda: SignDescent(2.0),
}

LOSSES = {
    "mse": "mse",
    "mae": "mae",
    "huber": "huber",
    "log_cosh": "log_cosh",
    "Huber(0.3)": keras.losses.Huber(delta=0.3),
    "the sum": keras.losses.MeanSquaredError(reduction="sum"),
    "one value each": keras.losses.MeanAbsoluteError(reduction=None),
    "a function to a scalar": lambda y, q: tf.reduce_mean(tf.abs(y - q) ** 3),
    "a function to a vector": lambda y, q: tf.square(y - q) + 0.1 * tf.square(q),
}


def in_keras_words(loss, y, q):
    """Returns the scalar loss that `compile(loss=loss)` computes from [B] values."""
    if callable(loss) and not isinstance(loss, keras.losses.Loss):
        return tf.reduce_mean(loss(y, q))
    loss = keras.losses.get(loss)
    return tf.reduce_mean(loss(y[:, None], q[:, None]))


def eager_step(batch, gamma, tau, q_network, q_hat_network, optimizer, loss="mse"):
    """Takes one step as `model.fit` does, op by op, and the soft update, without the package."""
    states, actions, rewards, next_states, terminal_states = map(tf.constant, batch)
    y = rewards + (1 - terminal_states) * gamma * tf.reduce_max(q_hat_network(next_states), axis=1)
    with tf.GradientTape() as tape:
        q = tf.reduce_sum(q_network(states) * tf.one_hot(actions, 2), axis=1)
        value = in_keras_words(loss, y, q)
        value += sum(q_network.losses)
        scaled = optimizer.scale_loss(value)
    weights = q_network.trainable_variables
    optimizer.apply_gradients(zip(tape.gradient(scaled, weights), weights, strict=True))
    for q_hat, q in zip(q_hat_network.weights, q_network.weights, strict=True):
        if "float" in q.dtype:
            q_hat.assign(tau * q + (1 - tau) * q_hat)
    return float(value)
