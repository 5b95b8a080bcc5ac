"""The progress bar, in a terminal or in a notebook."""

import warnings

from tqdm import TqdmWarning

with warnings.catch_warnings(action="ignore", category=TqdmWarning):  # without ipywidgets a notebook's bar is text
    from tqdm.auto import tqdm

__all__ = ["tqdm"]
