"""Paths of the committed checkpoints and datasets."""

import os
from pathlib import Path

_COMMITTED = 'pointmaze-medium-navigate'


def assets_dir() -> Path:
    """The folder of committed assets.

    `METAGCTTT_ASSETS` names it where the package is not installed from a checkout.

    Raises:
        FileNotFoundError: If there is no such folder.
    """
    override = os.environ.get('METAGCTTT_ASSETS')
    folder = Path(override) if override else Path(__file__).resolve().parents[2] / 'assets'
    if not folder.is_dir():
        raise FileNotFoundError(
            f'no assets folder at {folder}: install from a checkout (pip install -e .) '
            'or set METAGCTTT_ASSETS to the assets folder'
        )
    return folder


def checkpoint_path(path: str = '') -> Path:
    """`path` with `~` expanded, or the committed post-trained policy when it is empty."""
    return Path(path).expanduser() if path else assets_dir() / _COMMITTED / 'meta'


def dataset_path(path: str = '') -> Path:
    """`path` with `~` expanded, or the committed dataset when it is empty."""
    return Path(path).expanduser() if path else assets_dir() / _COMMITTED / 'dataset.npz'
