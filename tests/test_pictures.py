import io

import gymnasium as gym
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from dqn_keras import (
    Config,
    animate,
    evaluate,
    make_q_network,
    plot_q,
    plot_rewards,
    plot_run,
    record_episode,
    save_animation,
    train,
)

mpl.use("Agg")


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


def test_the_curve_shows_the_rewards_and_their_mean_over_the_last_twenty():
    rewards = np.arange(30.0)
    ax = plot_rewards(rewards)
    raw, smoothed = ax.get_lines()
    np.testing.assert_array_equal(raw.get_ydata(), rewards)
    np.testing.assert_array_equal(smoothed.get_xdata(), np.arange(19, 30))
    np.testing.assert_allclose(smoothed.get_ydata(), [rewards[k - 19 : k + 1].mean() for k in range(19, 30)])
    assert ax.get_xlabel() == "Episode"
    assert "Reward" in ax.get_ylabel()


def test_the_curve_of_a_short_run_has_no_mean():
    assert len(plot_rewards([1.0, 2.0]).get_lines()) == 1


def test_the_curve_is_drawn_in_the_given_axes():
    _, ax = plt.subplots()
    assert plot_rewards([1.0], ax) is ax


def test_bad_rewards_and_windows_are_refused():
    with pytest.raises(ValueError, match=r"^rewards must have one axis, got shape \(1, 2\)"):
        plot_rewards([[1.0, 2.0]])
    with pytest.raises(ValueError, match=r"^window"):
        plot_rewards([1.0], window=0)


def test_a_recorded_episode_is_the_first_that_evaluate_plays():
    env, network = gym.make("CartPole-v1", render_mode="rgb_array"), make_q_network(4, 2, seed=0)
    frames = record_episode(env, network, seed=3)
    assert len(frames) == evaluate(env, network, 1, seed=3)[0] + 1
    assert frames[0].shape == (400, 600, 3)
    assert not np.array_equal(frames[0], frames[-1])


def test_recording_without_frames_says_how_to_get_them(cartpole):
    with pytest.raises(ValueError, match='env must be made with render_mode="rgb_array", got None'):
        record_episode(cartpole, make_q_network(4, 2))


@pytest.fixture
def frames():
    """Returns nine frames of a white square that moves over black."""
    pictures = np.zeros((9, 40, 60, 3), np.uint8)
    for k, picture in enumerate(pictures):
        picture[10:20, 5 * k : 5 * k + 10] = 255
    return list(pictures)


@pytest.mark.parametrize("suffix", ["gif", "png"])
def test_an_animation_plays_every_second_frame_in_the_episodes_time(frames, suffix, tmp_path):
    save_animation(frames, tmp_path / f"square.{suffix}", fps=50, width=30)
    with Image.open(tmp_path / f"square.{suffix}") as picture:
        assert (picture.n_frames, picture.size, picture.info["loop"]) == (5, (30, 20), 0)
        assert picture.info["duration"] == 40


def test_an_inline_animation_is_an_animated_png(frames):
    shown = animate(frames)
    assert shown.format == "png"
    assert b"acTL" in shown.data[:200]  # the chunk that marks an animated PNG


@pytest.mark.parametrize("suffix", ["gif", "png"])
def test_a_colour_that_comes_late_is_shown(frames, suffix, tmp_path):
    for frame in frames[4:]:
        frame[30:] = (255, 0, 0)
    save_animation(frames, tmp_path / f"square.{suffix}", width=60)
    with Image.open(tmp_path / f"square.{suffix}") as picture:
        picture.seek(picture.n_frames - 1)
        red, green, _ = picture.convert("RGB").getpixel((30, 38))
    assert red > 200 > 50 > green


def test_bad_frames_are_refused(frames, tmp_path):
    target = tmp_path / "nothing.gif"
    with pytest.raises(ValueError, match="at least one frame"):
        save_animation([], target)
    with pytest.raises(ValueError, match=r"frames must be \[H, W, 3\] uint8, got \(40, 60\)"):
        save_animation([frame[..., 0] for frame in frames], target)
    with pytest.raises(ValueError, match=r"^frames must have one size"):
        save_animation([*frames, frames[0][:20]], target)
    with pytest.raises(ValueError, match=r"^file must end in .png or .gif if there is no format, got 'square.txt'"):
        save_animation(frames, "square.txt")
    with pytest.raises(ValueError, match=r"^file must end in .png or .gif if there is no format, got <_io.BytesIO"):
        save_animation(frames, io.BytesIO())
    for fps in (0, -5):
        with pytest.raises(ValueError, match=r"^fps must be a whole number"):
            save_animation(frames, target, fps=fps)


@pytest.mark.parametrize("speed", [True, False])
def test_a_run_at_a_glance_shows_its_history(cartpole, speed):
    run = train(cartpole, Config(num_episodes=25, batch_size=16), seed=0, verbose=0)
    rewards, *panels = plot_run(run, speed)
    shown = [["mean_q", "max_q", "q_bound"], ["td_error"], ["terminal_share"], ["steps_per_second"]][: 3 + speed]
    np.testing.assert_array_equal(rewards.get_lines()[0].get_ydata(), run.rewards)
    for ax, names in zip(panels, shown, strict=True):
        for line, name in zip(ax.get_lines(), names, strict=True):
            scale = 100 if name == "terminal_share" else 1
            np.testing.assert_array_equal(line.get_ydata(), scale * np.array(run.history[name]))
        assert ax.get_title() and ax.get_ylabel()  # noqa: PT018


def _linear_q_network():
    """Returns a network with Q(s, 0) = s[1] and Q(s, 1) = 2 s[3]."""
    network = make_q_network(4, 2, hidden_units=(8,), seed=0)
    first, second = np.zeros((4, 8)), np.zeros((8, 2))
    for entry, unit, sign in ((1, 0, 1), (1, 1, -1), (3, 2, 1), (3, 3, -1)):  # x = relu(x) - relu(-x)
        first[entry, unit] = sign
        second[unit, entry // 2] = sign * (1 if entry == 1 else 2)
    network.set_weights([first, np.zeros(8), second, np.zeros(2)])
    return network


def test_q_is_plotted_over_two_entries_of_the_state():
    ax = plot_q(_linear_q_network(), x=(1, -1, 1), y=(3, 0, 2))
    image, *actions = ax.collections
    xs, ys = np.meshgrid(np.linspace(-1, 1, 61), np.linspace(0, 2, 61))
    np.testing.assert_allclose(image.get_array(), np.maximum(xs, 2 * ys), atol=1e-5)
    assert image.norm.vmin == pytest.approx(0, abs=1e-5)
    assert image.norm.vmax == pytest.approx(4)
    (of_action_1,) = actions
    assert list(of_action_1.hatches) == ["//"]
    (path,) = of_action_1.get_paths()
    assert path.contains_point((0.1, 0.9))  # Q(s, 1) = 1.8 is higher than Q(s, 0) = 0.1
    assert not path.contains_point((0.9, 0.1))  # Q(s, 1) = 0.2 is lower than Q(s, 0) = 0.9


def test_where_two_actions_meet_no_other_is_plotted_between_them():
    network = make_q_network(2, 3, hidden_units=(2,), seed=0)
    weights = [[1, -1], [0, 0]], [0, 0], [[1, 0, 0], [0, 0, 1]], [0, -1, 0]
    network.set_weights([np.array(x) for x in weights])  # Q = relu(x), -1, relu(-x)
    _, of_action_1, of_action_2 = plot_q(network, x=(0, -1, 1), y=(1, -1, 1)).collections
    assert sum(len(path) for path in of_action_1.get_paths()) == 0
    assert of_action_2.get_paths()[0].contains_point((-0.5, 0))


def test_the_other_entries_of_the_state_stay_as_they_are():
    _, ax = plt.subplots()
    assert plot_q(_linear_q_network(), x=(0, -1, 1), y=(2, -1, 1), state=[0, 5, 0, 1], ax=ax, limits=(0, 9)) is ax
    np.testing.assert_allclose(ax.collections[0].get_array(), 5, rtol=1e-6)
    assert (ax.collections[0].norm.vmin, ax.collections[0].norm.vmax) == (0, 9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x": (4, 0, 1)}, r"^x\[0\] must be an index of the state's 4 entries, got 4"),
        ({"x": (0, 1, 1)}, r"^x must have its lowest value before its highest"),
        ({"y": (0, 0, 1)}, r"^x and y must be different entries of the state, got 0 for both"),
        ({"y": (1, 0)}, r"^y must be an index, a lowest and a highest value"),
        ({"state": [0.0]}, r"^state must have 4 entries, the input size of q_network, got 1"),
        ({"limits": (2, 1)}, r"^limits must be two Q-values, the lower first"),
    ],
)
def test_a_plot_of_q_that_makes_no_sense_is_an_error(arguments, message):
    with pytest.raises(ValueError, match=message):
        plot_q(make_q_network(4, 2, seed=0), **{"x": (0, 0, 1), "y": (1, 0, 1)} | arguments)
