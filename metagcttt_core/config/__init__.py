"""Typed, validated settings and the presets."""

from metagcttt_core.config.assets import assets_dir
from metagcttt_core.config.presets import load_preset, preset_names
from metagcttt_core.config.settings import error_lines, Settings

__all__ = ['Settings', 'assets_dir', 'error_lines', 'load_preset', 'preset_names']
