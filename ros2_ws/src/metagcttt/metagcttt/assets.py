"""The files that a node uses unless it is told otherwise. No ROS in here."""

from pathlib import Path

from metagcttt_core.config.assets import assets_dir

ASSETS = 'pointmaze-medium-navigate'


def checkpoint_path(path: str) -> Path:
    """`path`, or the committed post-trained policy when it is empty."""
    return Path(path).expanduser() if path else assets_dir() / ASSETS / 'meta'


def dataset_path(path: str) -> Path:
    """`path`, or the committed dataset when it is empty."""
    return Path(path).expanduser() if path else assets_dir() / ASSETS / 'dataset.npz'
