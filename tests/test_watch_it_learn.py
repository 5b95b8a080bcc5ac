"""The page "Watch it learn": its data, and in headless Chromium its JavaScript against the package."""

import importlib.util
import os
import re
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import Config, evaluate, make_q_network
from dqn_keras.environments import CartPole
from dqn_keras.policy import epsilon_of_next_episode

DOCS = Path(__file__).parent.parent / "docs"
PAGE = DOCS / "watch_it_learn.md"
LOADED = [DOCS / path for path in re.findall(r'(?:src|href)="(assets/\S+)"', PAGE.read_text())]
NUM_STEPS = 1_000


def load(name):
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


snapshots = load("snapshots")
RUN = snapshots.read()


def network_of(weights):
    network = make_q_network(4, 2)
    network.set_weights([np.array(array, np.float32) for array in weights])
    return network


# The data


def test_the_data_is_of_one_solved_run_of_seed_0_at_the_defaults():
    config, rewards, last = Config(), np.array(RUN["rewards"]), len(RUN["rewards"]) - 1
    means = np.convolve(rewards, np.full(config.solved_window, 1 / config.solved_window), mode="valid")
    assert (means > config.solved_reward).nonzero()[0].tolist() == [len(means) - 1]
    assert (RUN["seed"], RUN["solved_at"]) == (0, last)
    for name in ("gamma", "solved_reward", "solved_window"):
        assert RUN[name] == getattr(config, name)
    assert [x["episode"] for x in RUN["snapshots"]] == [*range(0, last, 10), last]
    assert RUN["starts"] == [snapshots.start_state(k) for k in range(10)]


def test_each_snapshot_has_the_epsilon_of_its_episode_and_the_weights_of_the_packages_network():
    shapes = [array.shape for array in make_q_network(4, 2).get_weights()]
    epsilon, epsilons = Config().epsilon, []
    for _ in RUN["rewards"]:
        epsilons.append(epsilon)
        epsilon = epsilon_of_next_episode(epsilon, Config())
    for snapshot in RUN["snapshots"]:
        assert snapshot["epsilon"] == pytest.approx(epsilons[snapshot["episode"]], abs=5e-5)
        assert [np.shape(array) for array in snapshot["weights"]] == shapes


def test_the_page_names_its_run_and_is_small():
    assert f"solved at\nepisode {RUN['solved_at']}." in PAGE.read_text()
    assert sum(path.stat().st_size for path in LOADED) < 300_000
    assert {path.suffix for path in LOADED} == {".js", ".css"}


def shape_of(contents):
    """What stays the same if another kind of processor trains: all but the numbers, and how many episodes it takes."""
    first, *_ = contents["snapshots"]
    weights = [np.shape(array) for array in first["weights"]]
    return {name: type(value) for name, value in contents.items()}, first.keys(), weights, contents["starts"]


@pytest.mark.slow
def test_the_command_writes_such_a_file_and_rounding_hardly_changes_q(tmp_path, rng):
    contents, exact = snapshots.record()
    snapshots.write(contents, tmp_path / "snapshots.js")
    written = snapshots.read(tmp_path / "snapshots.js")
    assert written == contents
    assert shape_of(written) == shape_of(RUN)
    states = rng.uniform([-2.4, -2, -0.2, -2], [2.4, 2, 0.2, 2], size=(NUM_STEPS, 4)).astype(np.float32)
    for snapshot in contents["snapshots"]:
        weights = exact[snapshot["episode"]]
        for array, rounded in zip(weights, snapshot["weights"], strict=True):
            np.testing.assert_allclose(rounded, array, rtol=5.1e-5)
        change = network_of(snapshot["weights"])(states) - network_of(weights)(states)
        assert np.abs(change).max() < 0.001  # of Q-values up to 20; the page shows two decimals


# In the browser


def unavailable(reason):
    """Skips the test; fails where a browser is required."""
    (pytest.fail if os.environ.get("REQUIRE_BROWSER") == "1" else pytest.skip)(reason)


@pytest.fixture(scope="module")
def browser():
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        unavailable("needs the extra docs: pip install -e '.[docs]'")
    check = load("check")
    chromium = check.find_chromium()
    if chromium is None:
        unavailable("there is no Chromium (apt-get install chromium)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=check.QUIET)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def scripts(browser):
    """An empty page with the physics, the network and the data."""
    page = browser.new_page()
    for name in ("snapshots", "cartpole"):
        page.add_script_tag(path=DOCS / "assets" / f"{name}.js")
    return page


@pytest.fixture
def watch_page(browser, tmp_path):
    """A function: (reduced_motion) -> the page, opened from a folder; to a browser, Markdown around HTML is text."""
    file = tmp_path / "watch_it_learn.html"
    file.write_text(f"<!doctype html><meta charset=utf-8>{PAGE.read_text()}")
    shutil.copytree(DOCS / "assets", tmp_path / "assets")
    pages, problems = [], []

    def open_page(reduced_motion="reduce"):
        page = browser.new_page(reduced_motion=reduced_motion)
        page.on("pageerror", lambda error: problems.append(error))
        page.on("request", lambda request: request.url.startswith("file:") or problems.append(request.url))
        page.goto(file.as_uri())
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert not problems


@pytest.fixture(scope="module")
def gymnasium_steps():
    """A thousand steps of random actions in Gymnasium: states, actions, next states, terminated."""
    env, rng, steps = gym.make("CartPole-v1").unwrapped, np.random.default_rng(0), []
    env.reset(seed=0)
    for _ in range(NUM_STEPS):
        state, a = np.array(env.state), int(rng.integers(2))
        _, _, terminated, _, _ = env.step(a)
        steps.append((state, a, env.state, terminated))
        if terminated:
            env.reset()
            env.state = rng.uniform([-2.4, -3, -0.2, -3], [2.4, 3, 0.2, 3])
    return [np.array(x) for x in zip(*steps, strict=True)]


def test_a_thousand_steps_of_the_javascript_are_gymnasiums_and_the_packages(scripts, gymnasium_steps):
    states, actions, next_states, terminated = gymnasium_steps
    ours, ends = scripts.evaluate(
        """([states, actions]) => {
            const nextStates = states.map((state, i) => transition(state, forceOf(actions[i])));
            return [nextStates, nextStates.map(isTerminal)];
        }""",
        [states.tolist(), actions.tolist()],
    )
    twin = CartPole()
    theirs = [twin.transition(tf.constant(s), tf.constant(a), None) for s, a in zip(states, actions, strict=True)]
    np.testing.assert_allclose(ours, next_states, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours, np.array(theirs), rtol=0, atol=1e-12)
    assert ends == terminated.tolist()
    assert 50 < terminated.sum() < NUM_STEPS / 2
    assert {bool(x) for x in np.abs(next_states[terminated][:, 0]) > 2.4} == {True, False}  # both ends occur


def test_the_q_values_of_the_javascript_equal_keras(scripts, gymnasium_steps):
    states = gymnasium_steps[0].astype(np.float32)
    for number, snapshot in enumerate(RUN["snapshots"]):
        ours, actions = scripts.evaluate(
            """([states, number]) => {
                const q = states.map((state) => qValues(RUN.snapshots[number].weights, state));
                return [q, q.map(greedyAction)];
            }""",
            [states.tolist(), number],
        )
        theirs = network_of(snapshot["weights"])(states).numpy()
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-5)
        assert actions == np.argmax(ours, axis=1).tolist()


@pytest.mark.parametrize("number", [0, 17, -1])
def test_the_javascript_plays_the_episodes_that_evaluate_plays(scripts, number, cartpole):
    weights = RUN["snapshots"][number]["weights"]
    lengths = scripts.evaluate(
        """(weights) => RUN.starts.map((state) => {
            for (let numSteps = 1; ; numSteps++) {
                state = transition(state, forceOf(greedyAction(qValues(weights, state))));
                if (isTerminal(state) || numSteps === MAX_STEPS) return numSteps;
            }
        })""",
        weights,
    )
    assert lengths == evaluate(cartpole, network_of(weights), num_episodes=10, seed=0).tolist()


def text(page, selector):
    return page.locator(selector).inner_text()


def choose(page, episode):
    page.locator("#episode").evaluate(
        "(slider, episode) => { slider.value = episode; slider.dispatchEvent(new Event('input')); }", episode
    )


def result(page):
    page.wait_for_function("document.querySelector('#result').textContent", timeout=120_000)
    return text(page, "#result")


def test_the_page_says_what_evaluate_returns(watch_page, cartpole):
    page = watch_page()
    choose(page, 170)
    page.locator("#play").click()
    (steps,) = evaluate(cartpole, network_of(RUN["snapshots"][17]["weights"]), num_episodes=1, seed=0)
    assert result(page) == f"Network of episode 170: the pole fell after {steps:.0f} steps."


@pytest.mark.parametrize("by", ["key", "button", "picture"])
def test_a_push_that_is_held_throws_the_pole_over(watch_page, by):
    page = watch_page()
    page.locator("#episode").press("End")
    if by == "key":
        page.locator("#scene").press("Shift")  # gives it the focus
        page.keyboard.down("d")
    else:
        target = page.locator("#push-right" if by == "button" else "#scene")
        box = target.bounding_box()
        target.hover(position={"x": 0.9 * box["width"], "y": 0.5 * box["height"]})
        page.mouse.down()
    q_network, state, steps = network_of(RUN["snapshots"][-1]["weights"]), RUN["starts"][0], 0
    env = gym.make("CartPole-v1").unwrapped
    env.reset()
    terminated = False
    while not terminated:
        pushes_right = q_network(np.array([state], np.float32)).numpy().argmax() == 1
        env.force_mag, env.state = 20.0 if pushes_right else 0.0, state
        _, _, terminated, _, _ = env.step(1)
        state, steps = env.state, steps + 1
    assert result(page) == f"Network of episode {RUN['solved_at']}: the pole fell after {steps} steps."


def test_the_slider_its_keys_and_the_curve_choose_a_network_and_end_the_film(watch_page):
    page = watch_page()
    slider = page.locator("#episode")
    assert page.locator("#film").is_checked()
    slider.press("ArrowRight")
    assert not page.locator("#film").is_checked()
    seen = [text(page, "#chosen")]
    for key in ("ArrowUp", "ArrowLeft", "Home", "ArrowLeft", "End", "ArrowRight", "ArrowDown"):
        slider.press(key)
        seen.append(text(page, "#chosen"))
    assert seen == ["10", "20", "10", "0", "0", "296", "296", "290"]
    for episode in (148, 293):
        choose(page, episode)
        assert text(page, "#chosen") == slider.input_value() == str(round(episode, -1))
    page.locator("#curve").click()  # in its middle
    snapshot = RUN["snapshots"][15]
    assert slider.get_attribute("aria-valuetext") == f"episode {snapshot['episode']}"
    assert text(page, "#reward") == str(RUN["rewards"][150])
    assert text(page, "#epsilon") == f"{100 * snapshot['epsilon']:.0f} %"


def test_the_film_takes_the_next_network_after_each_episode(watch_page):
    page = watch_page("no-preference")
    page.wait_for_function("document.querySelector('#chosen').textContent === '20'", timeout=120_000)
    assert page.locator("#film").is_checked()


def test_nothing_moves_by_itself_for_a_reader_who_wants_less_motion(watch_page):
    assert text(watch_page("reduce"), "#play") == "Play"
    assert text(watch_page("no-preference"), "#play") == "Pause"


def test_play_pause_reset_and_space(watch_page):
    page = watch_page()
    page.locator("#episode").press("End")
    page.locator("#play").click()
    page.wait_for_function("parseInt(document.querySelector('#step').textContent) > 3")
    page.locator("#scene").press(" ")
    assert text(page, "#play") == "Play"
    page.locator("#reset").click()
    assert text(page, "#step") == "0 / 500"
    assert text(page, "#position") == f"{RUN['starts'][0][0]:.2f}"


def test_the_bars_and_the_map_show_the_network(watch_page):
    page = watch_page()
    page.locator("#episode").press("End")
    network = network_of(RUN["snapshots"][-1]["weights"])
    q = network(np.array([RUN["starts"][0]], np.float32)).numpy()[0]
    assert [text(page, "#q-left .value"), text(page, "#q-right .value")] == [f"{value:.2f}" for value in q]
    size = int(page.locator("#map").get_attribute("width"))
    angles, velocities = np.radians(np.linspace(-12, 12, size)), np.linspace(3, -3, size)
    states = np.array([[0, 0, angle, velocity] for velocity in velocities for angle in angles], np.float32)
    pixels = """() => {
        const canvas = document.querySelector("#map");
        return [...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data];
    }"""
    highest = network(states).numpy().max(1)
    colours = np.array(page.evaluate(pixels)).reshape(-1, 4)
    green = colours[:, 1]  # grows with Q in viridis
    assert np.corrcoef(green, highest.clip(0, 20))[0, 1] > 0.95
    page.locator("[value=action]").check()
    red = np.array(page.evaluate(pixels)).reshape(-1, 4)[:, 0]
    right = network(states).numpy().argmax(1) == 1
    assert len(set(red[right])) == len(set(red[~right])) == 1
    assert red[right][0] > red[~right][0]
