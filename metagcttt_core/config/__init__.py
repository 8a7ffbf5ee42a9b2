"""Typed, validated settings."""

from metagcttt_core.config.assets import assets_dir
from metagcttt_core.config.settings import error_lines, Settings

__all__ = ['Settings', 'assets_dir', 'error_lines']
