"""Rendering: the frames of an episode, and an animation of them, without a window, a display or a video encoder."""

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import gymnasium as gym
import numpy as np
from PIL import Image

from dqn_keras._engine.numpy_acting import q_function
from dqn_keras._engine.tensorflow import keras
from dqn_keras.checks.environments import CheckedEnv
from dqn_keras.checks.networks import check_fits
from dqn_keras.checks.numbers import check_count, check_path, check_sequence, shown
from dqn_keras.seeding import checked_seed, evaluation_seed

if TYPE_CHECKING:
    import IPython.display


def record_episode(
    env: gym.Env, q_network: keras.Model, seed: int | None = None, max_steps: int = 1_000
) -> list[np.ndarray]:
    """Plays one greedy episode and returns a frame [H, W, 3] uint8 of every state, the first and the last included.

    It is the first episode of `evaluate(env, q_network, seed=seed)`. The environment must be made with
    `render_mode="rgb_array"`, which needs no display; otherwise ValueError is raised.
    """
    checked_env = CheckedEnv(env)
    check_fits(q_network, checked_env.spaces.state_shape, checked_env.spaces.num_actions)
    if env.render_mode != "rgb_array":
        raise ValueError(f'env must be made with render_mode="rgb_array", got {env.render_mode!r}')
    max_steps, seed = check_count("max_steps", max_steps), checked_seed(seed)
    q_values = q_function(q_network)
    state = checked_env.reset(evaluation_seed(seed, 0), episode=0)
    frames = [np.asarray(env.render())]
    for _ in range(max_steps):
        state, _, terminated, truncated = checked_env.step(int(q_values(state).argmax()))
        frames.append(np.asarray(env.render()))
        if terminated or truncated:
            break
    return frames


def save_animation(
    frames: Sequence[np.ndarray],
    file: str | Path | BinaryIO,
    fps: int = 50,
    width: int = 300,
    format: str | None = None,
) -> None:
    """Saves every second frame as an animation that loops and plays at the speed of the episode.

    Args:
        frames: the frames of an episode, each [H, W, 3] uint8.
        file: a path that ends in .png or .gif, or an open binary file.
        fps: frames per second of the episode (50 for CartPole).
        width: width in pixels; the height follows from it.
        format: "PNG" or "GIF"; by default, the suffix of the path decides.

    Raises:
        TypeError, ValueError: an argument is wrong; the message names it.
    """
    frames, fps, width = _check_frames(frames), check_count("fps", fps), check_count("width", width)
    file, format = _check_target(file, format)
    height, full_width = frames[0].shape[:2]
    size = (width, max(1, round(height * width / full_width)))
    images = [Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS) for frame in frames[::2]]
    # One palette for all frames, made from about eight of them, so that frames differ only where something moves.
    palette = Image.fromarray(np.concatenate([np.asarray(x) for x in images[:: max(1, len(images) // 8)]])).quantize(
        colors=32
    )
    first, *rest = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    first.save(file, format=format, save_all=True, append_images=rest, duration=round(2000 / fps), loop=0)


def _check_frames(frames: Any) -> list[np.ndarray]:
    frames = list(frames) if isinstance(frames, np.ndarray) and frames.ndim else frames
    frames = check_sequence("frames", frames, "frames, each [H, W, 3] uint8")
    if not frames:
        raise ValueError("frames must hold at least one frame, got none")
    for frame in frames:
        if not isinstance(frame, np.ndarray):
            raise TypeError(f"frames must be arrays, each [H, W, 3] uint8, got {shown(frame)}")
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8 or not frame.size:
            raise ValueError(f"frames must be [H, W, 3] uint8, got {frame.shape} {frame.dtype}")
        if frame.shape != frames[0].shape:
            raise ValueError(f"frames must have one size, got {frames[0].shape} and {frame.shape}")
    return frames


def _check_target(file: Any, format: Any) -> tuple[Any, str]:
    """Returns the path or open binary file, and the format to write in."""
    is_open = hasattr(file, "write") and not isinstance(file, io.TextIOBase | type)
    if not (is_open or isinstance(file, str | os.PathLike)):
        raise TypeError(f"file must be a path or an open binary file, got {shown(file)}")
    if format is not None and not (isinstance(format, str) and format.upper() in _FORMATS):
        raise ValueError(f'format must be "PNG" or "GIF", got {shown(format)}')
    name = getattr(file, "name", "") if is_open else check_path("file", file)
    suffix = Path(str(name)).suffix[1:].upper()
    if format is None and suffix not in _FORMATS:
        raise ValueError(f"file must end in .png or .gif if there is no format, got {shown(file)}")
    return file, format or suffix


_FORMATS = ("PNG", "GIF")


def animate(frames: Sequence[np.ndarray], fps: int = 50, width: int = 300) -> "IPython.display.Image":
    """Returns an animation for a notebook: an animated PNG that is stored in the .ipynb and plays in any browser."""
    try:
        from IPython.display import Image as InlineImage  # only notebooks need it
    except ImportError as error:
        raise ImportError('animate needs IPython: pip install "dqn_keras[notebooks]"') from error
    buffer = io.BytesIO()
    save_animation(frames, buffer, fps, width, format="PNG")
    return InlineImage(data=buffer.getvalue(), format="png")
