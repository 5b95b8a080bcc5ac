# %% [markdown]
# # Explore
#
# Move a slider, and see how eight training runs and the pole change. Each move trains eight new agents, which takes a
# second or two. Only a new value of `steps_per_update` takes some seconds more, because it compiles a new program.
#
# The sliders need a running notebook and `pip install "dqn_keras[explore]"`. Without them, call the function yourself:
# `explore(gamma=0.99)`. The lesson ([deep_q_network.ipynb](deep_q_network.ipynb)) explains the parameters.

# %%
import os

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # otherwise TensorFlow logs into the notebook
os.environ["SDL_VIDEODRIVER"] = "dummy"  # pictures are drawn without a display
os.environ["TF_NUM_INTRAOP_THREADS"] = "1"  # faster, since the network is small

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

from dqn_keras import Config, animate, record_episode, train
from dqn_keras.environments import CartPole

env, picture_env = CartPole(), gym.make("CartPole-v1", render_mode="rgb_array")


# %%
def explore(gamma=0.95, tau=0.01, alpha=0.001, decay=0.995, epsilon_min=0.1, steps_per_update=4):
    """Trains eight seeds, and shows their learning curves and the first agent's pole."""
    config = Config(
        gamma=gamma,
        tau=tau,
        alpha=alpha,
        decay=decay,
        epsilon_min=epsilon_min,
        steps_per_update=steps_per_update,
        num_episodes=500,
    )
    runs = [train(env, config, seed, verbose=0) for seed in range(8)]
    _, ax = plt.subplots(figsize=(8, 3.5), layout="constrained")
    for seed, run in enumerate(runs):
        ax.plot(run.history["average_reward"], alpha=0.8, label=f"seed {seed}")
    ax.axhline(config.solved_reward, color="gray", linestyle=":")
    solved = [run.solved_at for run in runs if run.solved_at is not None]
    median = f", in a median of {np.median(solved):.0f} episodes" if solved else ""
    ax.set(title=f"{len(solved)} of 8 seeds solved{median}", xlim=(0, config.num_episodes), ylim=(0, 260))
    ax.set(xlabel="Episode", ylabel="Mean reward of the last 50")
    ax.legend(loc="upper left", ncols=2, fontsize="small")
    ax.grid(alpha=0.3)
    plt.show()
    display(animate(record_episode(picture_env, runs[0].q_network, seed=0, max_steps=250)))


explore()

# %% [markdown]
# A curve ends where its run is solved, or after 500 episodes. The pole is balanced by the network of seed 0, without
# random actions, for at most 250 steps. Some questions:
#
# - What is the smallest `gamma` with which a seed is solved? And the largest?
# - What does a slow target network (`tau` 0.002) do to the curves? And what if there is none (`tau` 1)?
# - With which values of `alpha` do the seeds fail? Do they fail in the same way with low and with high values?
# - What if exploration ends early (`decay` 0.95)? What if it hardly ends (`epsilon_min` 0.5)?

# %% tags=["sliders"]
try:
    import ipywidgets as widgets
except ImportError:
    print('The sliders need ipywidgets: pip install "dqn_keras[explore]"')
else:

    def slider(kind, value, **options):
        """Returns a slider that reports its value when it is released."""
        options |= {"layout": {"width": "420px"}, "style": {"description_width": "130px"}}
        return kind(value=value, continuous_update=False, **options)

    number, power, choice = widgets.FloatSlider, widgets.FloatLogSlider, widgets.SelectionSlider
    sliders = {
        "gamma": slider(number, 0.95, min=0.5, max=0.999, step=0.001, readout_format=".3f"),
        "tau": slider(power, 0.01, min=-3, max=0, step=0.1, readout_format=".3f"),
        "alpha": slider(power, 0.001, min=-5, max=-1, step=0.1, readout_format=".5f"),
        "decay": slider(number, 0.995, min=0.9, max=0.999, step=0.001, readout_format=".3f"),
        "epsilon_min": slider(number, 0.1, min=0, max=0.5, step=0.01),
        "steps_per_update": slider(choice, 4, options=[1, 2, 4, 8]),
    }
    output = widgets.Output()

    def redraw(_):
        """Explores with the values of all sliders."""
        with output:
            output.clear_output(wait=True)
            explore(**{name: widget.value for name, widget in sliders.items()})

    for name, widget in sliders.items():
        widget.description = name
        widget.observe(redraw, "value")
    display(widgets.VBox([*sliders.values(), output]))
