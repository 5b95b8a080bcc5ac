"""What the user passes in is what runs: nothing lost, nothing replaced."""

import gymnasium as gym
import keras
import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import Config, double_td_targets, learn, td_targets, train
from dqn_keras.environments import CartPole
from tests.helpers import parts
from tests.helpers.parts import NETWORKS, dense, sequential
from tests.helpers.short_runs import BOTH_LOOPS, QUICK, Settings, fresh, learned, sgd, trained, weights_of

# Values outside a configuration are kept


def test_normalization_scales_in_acting_learning_and_q_hat():
    network = NETWORKS["Normalization, adapted"]()
    far = np.full((1, 4), 1e4, np.float32)
    plain = keras.Sequential(network.layers[1:])
    run = train(
        gym.make("CartPole-v1"), Config(num_episodes=1, max_steps=2, batch_size=2), 0, q_network=network, verbose=0
    )
    assert abs(network(far) - plain(far)).numpy().max() > 100
    np.testing.assert_allclose(run.q_hat_network(far), network(far), rtol=1e-2)


@pytest.mark.slow
def test_exclusions_from_weight_decay_hold_in_train():
    decaying = [keras.optimizers.AdamW(0.001, weight_decay=100.0) for _ in range(2)]
    decaying[1].exclude_from_weight_decay(var_names=["kernel", "bias"])
    norms = [np.linalg.norm(trained(optimizer=x, config=QUICK)) for x in decaying]
    assert norms[0] < 0.9 * norms[1]


@pytest.mark.slow
def test_an_own_optimizer_without_a_configuration_trains():
    assert np.isfinite(trained(optimizer=parts.SignDescent(2.0))).all()
    assert not np.array_equal(trained(optimizer=parts.SignDescent(2.0)), trained(optimizer=parts.SignDescent(0.1)))


@pytest.mark.slow
@BOTH_LOOPS
def test_own_schedules_and_lambda_layers_train(make_env):
    network = sequential(dense(8), keras.layers.Lambda(lambda x: tf.sin(x)))
    assert np.isfinite(
        trained(make_env, q_network=network, optimizer=keras.optimizers.SGD(parts.HalvingSchedule()))
    ).all()


@pytest.mark.slow
def test_a_learning_rate_that_is_a_python_function_is_called_once_with_a_warning():
    with pytest.warns(UserWarning, match=r"the learning rate of 'sgd.*' is a Python function, .* it stays at 0.03"):
        trained(optimizer=keras.optimizers.SGD(lambda: 0.03))


def test_learn_calls_a_learning_rate_that_is_a_python_function_at_each_step(random_batch):
    now = [0.1]
    networks, optimizer, batch = fresh(), keras.optimizers.SGD(lambda: now[0]), random_batch(8)
    learn(batch, 0.9, *networks, optimizer)
    now[0] = 0.0
    before = networks[0].get_weights()
    np.testing.assert_array_equal(before[0], learned(batch, networks, optimizer)[0])


class Forgetful(keras.layers.Layer):
    """Multiplies by a factor that is neither in its configuration nor a plain attribute."""

    def __init__(self, held=None, **kwargs):
        super().__init__(**kwargs)
        self.held = held or Settings()

    def call(self, inputs):
        return inputs * self.held.factor

    def get_config(self):
        return {"name": self.name}


def test_a_layer_whose_copy_differs_is_an_error_that_names_it():
    held = Settings()
    held.factor = 7.0
    network = sequential(dense(8), Forgetful(held, name="forgetful"))
    with pytest.raises(
        ValueError, match=r"^q_network cannot be copied for Q-hat: the copy of layer 'forgetful' \(Forgetful\)"
    ):
        train(CartPole(), QUICK, q_network=network, verbose=0)


def test_a_layer_that_cannot_be_copied_is_an_error_that_names_it():
    class Demanding(keras.layers.Layer):
        def __init__(self, factor):
            super().__init__(name="demanding")
            self.factor = factor

        def call(self, inputs):
            return inputs * self.factor

    with pytest.raises(ValueError, match=r"^q_network cannot be copied for Q-hat: layer 'demanding' .* get_config\(\)"):
        train(CartPole(), QUICK, q_network=sequential(Demanding(2.0)), verbose=0)


# Regularization, loss scaling, inference mode


@pytest.mark.slow
@BOTH_LOOPS
def test_regularization_is_part_of_the_loss(make_env):
    norms = []
    for factor in (0.0, 100.0):
        regularizer = keras.regularizers.L2(factor)
        network = sequential(dense(8, "relu", kernel_regularizer=regularizer))
        run = train(
            make_env(),
            QUICK,
            seed=0,
            q_network=network,
            optimizer=sgd() if not factor else keras.optimizers.SGD(1e-3),
            verbose=0,
        )
        norms.append(np.linalg.norm(run.q_network.get_weights()[0]))
    assert norms[1] < 0.5 * norms[0]


def test_one_warning_names_the_layers_that_differ_in_training(cartpole):
    network = sequential(dense(8, "relu"), keras.layers.Dropout(0.5, name="drop"))
    with pytest.warns(UserWarning, match=r"q_network is called in inference mode.*: drop \(Dropout\)") as caught:
        train(cartpole, QUICK, seed=0, q_network=network, verbose=0)
    assert len([w for w in caught if "inference mode" in str(w.message)]) == 1


@pytest.mark.slow
@BOTH_LOOPS
def test_after_a_run_with_ema_the_network_holds_the_averages_as_after_fit(make_env):
    optimizer = keras.optimizers.SGD(0.1, use_ema=True, ema_momentum=0.99)
    run = train(make_env(), QUICK, seed=0, optimizer=optimizer, verbose=0)
    averages = optimizer._model_variables_moving_average
    for weight, average in zip(run.q_network.trainable_variables, averages, strict=True):
        np.testing.assert_array_equal(weight, average)
    plain = train(make_env(), QUICK, seed=0, optimizer=sgd(), verbose=0)
    assert not np.array_equal(weights_of(plain.q_network), weights_of(run.q_network))


# Which optimizer, loss and targets are used


@pytest.mark.slow
@BOTH_LOOPS
def test_a_compiled_network_brings_its_optimizer_and_loss(make_env):
    def network():
        return NETWORKS["dense"]()

    compiled = network()
    compiled.compile(keras.optimizers.AdamW(3e-4, clipnorm=1), loss="huber")
    optimizer, config = compiled.optimizer, compiled.get_compile_config()
    ours = trained(make_env, q_network=compiled)
    own = trained(make_env, q_network=network(), optimizer=keras.optimizers.AdamW(3e-4, clipnorm=1), loss="huber")
    np.testing.assert_array_equal(ours, own)
    assert not np.array_equal(ours, trained(make_env, q_network=network()))
    assert compiled.optimizer is optimizer
    assert compiled.loss == "huber"
    assert compiled.get_compile_config().keys() == config.keys()


@pytest.mark.slow
def test_arguments_win_over_what_a_network_was_compiled_with_and_callbacks_see_the_optimizer_in_use():
    network, optimizer, seen = NETWORKS["dense"](), sgd(), []
    network.compile(keras.optimizers.AdamW(3e-4), loss="huber")
    owners = network.optimizer
    see = keras.callbacks.LambdaCallback(on_epoch_end=lambda epoch, logs: seen.append(see.model.optimizer))
    ours = trained(q_network=network, optimizer=optimizer, loss="mae", callbacks=see)
    assert all(x is optimizer for x in seen)
    assert network.optimizer is owners
    np.testing.assert_array_equal(ours, trained(q_network=NETWORKS["dense"](), optimizer=sgd(), loss="mae"))


@pytest.mark.slow
def test_a_network_that_train_compiled_itself_starts_the_next_run_with_a_new_adam():
    network = NETWORKS["dense"]()
    train(CartPole(), QUICK, seed=0, q_network=network, verbose=0)
    start = network.get_weights()
    first = trained(q_network=network, config=Config(**{**vars(QUICK), "alpha": 0.01}))
    network.set_weights(start)
    second = trained(q_network=network, config=Config(**{**vars(QUICK), "alpha": 0.01}))
    np.testing.assert_array_equal(first, second)


def test_alpha_and_an_optimizer_with_another_learning_rate_are_refused(cartpole):
    config = Config(alpha=0.01)
    with pytest.raises(ValueError, match=r"^alpha must be left at its default of 0.001 with an optimizer .*, got 0.01"):
        train(cartpole, config, optimizer=sgd())
    network = NETWORKS["dense"]()
    network.compile("adam", loss="mse")
    with pytest.raises(ValueError, match=r"^alpha must be left"):
        train(cartpole, config, q_network=network)
    train(cartpole, Config(num_episodes=2, alpha=0.01, batch_size=8), optimizer=keras.optimizers.SGD(0.01), verbose=0)


def test_parts_of_compile_that_are_not_used_are_named(cartpole):
    network = NETWORKS["dense"]()
    network.compile("adam", loss="mse", metrics=["mae"], run_eagerly=True)
    with pytest.warns(UserWarning, match=r"^metrics, run_eagerly of q_network.compile are not used by train"):
        train(cartpole, QUICK, q_network=network, verbose=0)


WRONG = {
    "an optimizer's name": ({"optimizer": "adam"}, TypeError, r"^optimizer must be a Keras optimizer .*, got 'adam'"),
    "a loss that Keras does not know": ({"loss": "msee"}, ValueError, r"^loss must be a name that Keras knows.*'msee'"),
    "a loss that is a number": ({"loss": 1}, TypeError, r"^loss must be a name .*, got 1"),
    "a class of losses": ({"loss": keras.losses.Huber}, TypeError, r"^loss must be a name"),
    "targets that are a name": ({"targets": "double"}, TypeError, r"^targets must be a function like td_targets"),
    "a loss over pairs": (
        {"loss": lambda y, q: y[:, None] - q},
        ValueError,
        r"^loss must return a scalar tensor, or one",
    ),
    "a loss that is no tensor": ({"loss": lambda y, q: None}, ValueError, r"^loss must return .*, got None"),
    "targets of two arguments": (
        {"targets": lambda batch, gamma: batch.reward},
        TypeError,
        r"^targets must be a function of \(experiences, gamma, q_network, q_hat_network\), got .*: too many",
    ),
    "a loss of one argument": ({"loss": lambda y: y}, TypeError, r"^loss must be a function of \(y, q\), got .*: too"),
    "a loss without q": (
        {"loss": lambda y, q: tf.reduce_mean(y)},
        ValueError,
        r"^loss must depend on q through operations that TensorFlow can differentiate",
    ),
    "targets for every action": (
        {"targets": lambda batch, gamma, q, q_hat: q_hat(batch.next_state)},
        ValueError,
        r"^targets must return a float32 tensor of shape \[B\].*, got float32 of shape",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_part_is_an_error_that_names_it_in_train_and_in_learn(case, cartpole, random_batch):
    own, error, message = WRONG[case]
    with pytest.raises(error, match=message):
        train(cartpole, QUICK, seed=0, verbose=0, **own)
    own = {"optimizer": sgd(), **own}
    with pytest.raises(error, match=message):
        learn(random_batch(), 0.9, *fresh(), own.pop("optimizer"), **own)


def test_an_optimizer_of_another_run_is_refused(cartpole):
    optimizer = sgd()
    train(cartpole, QUICK, seed=0, optimizer=optimizer, verbose=0)
    with pytest.raises(ValueError, match=r"^optimizer must be new or built for this q_network, got"):
        train(cartpole, QUICK, seed=0, optimizer=optimizer, verbose=0)


# Double DQN


@pytest.mark.slow
@BOTH_LOOPS
def test_double_targets_equal_own_targets_that_do_the_same(make_env):
    def by_hand(experiences, gamma, q_network, q_hat_network):
        best = tf.one_hot(tf.argmax(q_network(experiences.next_state), axis=1), 2)
        values = tf.reduce_sum(best * q_hat_network(experiences.next_state), axis=1)
        return experiences.reward + (1 - experiences.terminal_state) * gamma * values

    config = Config(num_episodes=40, batch_size=8, alpha=0.01, solved_reward=1e6)
    ours, own, plain = (trained(make_env, config, targets=x) for x in (double_td_targets, by_hand, td_targets))
    np.testing.assert_allclose(ours, own, atol=1e-4)
    assert not np.array_equal(ours, plain)


def test_no_gradient_flows_through_the_targets(random_batch):
    def through_q(experiences, gamma, q_network, q_hat_network):
        return td_targets(experiences, gamma, q_hat_network, q_network)  # Q takes the place of Q-hat

    def cut(*arguments):
        return tf.stop_gradient(through_q(*arguments))

    batch = random_batch(8)
    results = [learned(batch, fresh(), sgd(), targets=x) for x in (through_q, cut)]
    assert all(map(np.array_equal, *results))


def test_the_logged_td_error_is_of_the_targets_in_use(cartpole):
    def far(experiences, gamma, q_network, q_hat_network):
        return td_targets(experiences, gamma, q_network, q_hat_network) + 100.0

    config = Config(num_episodes=3, batch_size=8, max_steps=20, alpha=1e-6)
    run = train(cartpole, config, seed=0, targets=far, verbose=0)
    assert 99 < run.history["td_error"][-1] < 102


# Networks that cannot be learned with


def two_outputs():
    inputs = keras.Input((4,))
    return keras.Model(inputs, [dense(2)(inputs), dense(2)(inputs)])


def in_float64():
    return keras.Sequential([keras.Input((4,), dtype="float64"), dense(2, dtype="float64")])


REFUSED = {
    "two outputs": (two_outputs, "must have one output, got 2"),
    "two inputs": (
        lambda: keras.Model([a := keras.Input((4,)), b := keras.Input((4,))], dense(2)(a + b)),
        "must have one input, got 2",
    ),
    "float64": (in_float64, "must give float32 values, got float64"),
    "a dictionary of outputs": (
        lambda: keras.Model(a := keras.Input((4,)), {"q": dense(2)(a)}),
        r"must give Q-values of shape \[B, A\]",
    ),
    "a sequence of values": (
        lambda: keras.Sequential([keras.Input((4, 1)), dense(2)]),
        r"must give Q-values of shape \[B, A\]",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_network_of_another_form_is_refused_in_one_line(case, random_batch, cartpole):
    make, message = REFUSED[case]
    with pytest.raises(ValueError, match=f"^q_network {message}"):
        learn(random_batch(), 0.9, make(), make(), sgd())
    with pytest.raises(ValueError, match=f"^q_network {message}"):
        train(cartpole, q_network=make())


def test_what_xla_cannot_compile_is_an_error_that_says_what_to_do(random_batch):
    def printing(y, q):
        tf.raw_ops.PrintV2(input=tf.strings.as_string(y[0]))
        return tf.reduce_mean(tf.square(y - q))

    with pytest.raises(ValueError, match=r"^jit_compile must be False for this .* XLA cannot compile .*AsString"):
        learn(random_batch(), 0.9, *fresh(), sgd(), loss=printing)


# Calls of the user's, EMA, copies and compiled networks


class Clipped(keras.Sequential):
    def call(self, inputs, training=None, mask=None):
        return tf.clip_by_value(super().call(inputs), -50.0, 50.0)


def instance_with_a_call():
    network = sequential(dense(8))
    network.call = lambda inputs, training=None, mask=None: 0 * inputs[:, :2]
    return network


@pytest.mark.parametrize(
    "make", [lambda: Clipped([keras.Input((4,)), dense(2)]), instance_with_a_call], ids=["a subclass", "an instance"]
)
def test_a_network_with_a_call_of_its_own_is_refused_where_q_hat_would_lose_it(make, cartpole):
    with pytest.raises(ValueError, match=r"^q_network cannot be copied for Q-hat: .* has a `call` of its own"):
        train(cartpole, QUICK, q_network=make(), verbose=0)


def test_a_lambda_over_the_weights_of_another_layer_is_refused(cartpole):
    layer = dense(8)
    tied = keras.layers.Lambda(lambda x: x @ tf.transpose(layer.kernel))
    network = sequential(layer, tied)
    before = network.get_weights()
    with pytest.raises(ValueError, match=r"^q_network cannot be copied for Q-hat: a layer uses weights that are not"):
        train(cartpole, QUICK, q_network=network, verbose=0)
    assert all(map(np.array_equal, before, network.get_weights()))


def test_averages_of_no_update_do_not_become_the_network(cartpole):
    optimizer = keras.optimizers.SGD(0.1, use_ema=True)
    with pytest.warns(UserWarning, match="without an update"):
        run = train(cartpole, Config(num_episodes=2, max_steps=40), seed=0, optimizer=optimizer, verbose=0)
    assert np.abs(run.q_network.get_weights()[0]).sum() > 1


def test_a_compiled_network_with_a_list_of_losses_is_refused(cartpole):
    network = NETWORKS["dense"]()
    network.compile(sgd(), loss=["mse"])
    with pytest.raises(ValueError, match=r"^q_network must be compiled with one loss, got "):
        train(cartpole, QUICK, q_network=network, verbose=0)


@pytest.mark.slow
def test_a_function_of_the_users_can_still_be_differentiated_after_a_run():
    @tf.custom_gradient
    def clipped(x):
        return tf.identity(x), lambda dy: tf.clip_by_value(dy, -1.0, 1.0)

    @tf.function
    def loss(y, q):
        return tf.reduce_sum(clipped(y - q) * 5)

    trained(loss=loss)
    y, q = tf.zeros([8]), tf.zeros([8])
    with tf.GradientTape() as tape:
        tape.watch(q)
        value = loss(y, q)
    np.testing.assert_array_equal(tape.gradient(value, q), -np.ones(8))


@pytest.mark.slow
@BOTH_LOOPS
def test_averages_replace_the_weights_before_on_train_end_is_called(make_env, tmp_path):
    optimizer, seen, best = keras.optimizers.SGD(0.1, use_ema=True, ema_momentum=0.99), [], []

    class Restoring(keras.callbacks.Callback):
        def on_epoch_end(self, epoch, logs=None):
            best.append(self.model.get_weights())

        def on_train_end(self, logs=None):
            seen.append(self.model.get_weights())
            self.model.set_weights(best[0])

    run = train(make_env(), QUICK, seed=0, optimizer=optimizer, callbacks=Restoring(), verbose=0)
    averages = optimizer._model_variables_moving_average
    assert all(map(np.array_equal, seen[0], averages))
    assert all(map(np.array_equal, run.q_network.get_weights(), best[0]))


@pytest.mark.slow
def test_a_run_with_averages_and_callbacks_is_resumed_bit_for_bit(tmp_path):
    def run(num_episodes, **more):
        optimizer = keras.optimizers.SGD(0.1, use_ema=True, ema_momentum=0.9)
        config = Config(num_episodes=num_episodes, batch_size=8, solved_reward=1e6)
        return trained(config=config, optimizer=optimizer, callbacks=keras.callbacks.LambdaCallback(), **more)

    whole = run(9)
    run(5, checkpoint=tmp_path)
    np.testing.assert_array_equal(whole, run(9, checkpoint=tmp_path, resume=True))
    np.testing.assert_array_equal(whole, run(9, checkpoint=tmp_path, resume=True))  # a finished run


@pytest.mark.slow
def test_a_network_is_compiled_with_the_loss_and_optimizer_that_it_learns_with(tmp_path):
    save = keras.callbacks.ModelCheckpoint(tmp_path / "network.keras")
    train(CartPole(), QUICK, 0, q_network=NETWORKS["dense"](), loss="huber", callbacks=save, verbose=0)
    assert keras.saving.load_model(tmp_path / "network.keras").loss == "huber"
    optimizer = keras.optimizers.AdamW(0.01)
    run = train(CartPole(), QUICK, 0, optimizer=optimizer, loss="mae", verbose=0)
    before = int(optimizer.iterations)
    train(CartPole(), QUICK, 0, q_network=run.q_network, verbose=0)
    assert int(optimizer.iterations) == 2 * before
    assert run.q_network.loss == "mae"


AXIS_LOSSES = ["mse", "mae", "huber", "kl_divergence", "cosine_similarity", "categorical_hinge", "log_cosh"]


@pytest.mark.parametrize("loss", AXIS_LOSSES)
def test_the_name_of_a_loss_means_the_same_as_in_compile(loss, random_batch):
    batch = [np.abs(x) for x in random_batch(8)]
    q_network, q_hat_network = fresh()
    value = float(learn(batch, 0.0, q_network, q_hat_network, keras.optimizers.SGD(0.0), loss=loss))
    values = keras.Sequential([keras.Input((1,)), keras.layers.Identity()])
    values.compile("sgd", loss=loss)
    q = np.take_along_axis(q_network(batch[0]).numpy(), batch[1][:, None], axis=1)
    assert value == pytest.approx(values.evaluate(q, batch[2][:, None], batch_size=8, verbose=0), rel=1e-5)


class Scaling(keras.layers.Layer):
    """Keeps a function that uses its own weight."""

    def build(self, shape):
        self.scale = self.add_weight(shape=(), initializer="ones")
        self.function = lambda x: x * self.scale

    def call(self, inputs):
        return self.function(inputs)


def test_a_function_that_a_layer_makes_for_itself_is_made_again_in_the_copy(cartpole):
    run = train(cartpole, QUICK, 0, q_network=sequential(dense(8), Scaling()), verbose=0)
    layer = run.q_hat_network.layers[1]
    layer.scale.assign(0.0)
    assert not layer(np.ones((1, 8), np.float32)).numpy().any()
