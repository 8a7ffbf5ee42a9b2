"""Named settings: YAML files beside this one, and the paper's."""

from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

from metagcttt_core.config.yaml_file import read_yaml

from metagcttt_tools.common.paper import paper_presets


def _preset_files() -> dict[str, Any]:
    folder = files('metagcttt_tools') / 'presets'
    return {
        entry.name.removesuffix('.yaml'): entry
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.name)
        if entry.name.endswith('.yaml')
    }


def preset_names() -> list[str]:
    """Names that `load_preset` accepts, sorted."""
    return sorted([*_preset_files(), *paper_presets()])


def presets_with(section: str) -> list[str]:
    """The names of the presets with values for a program, which are under `section`."""
    return [name for name in preset_names() if section in load_preset(name)]


def load_preset(name_or_path: str | Path) -> dict[str, Any]:
    """The settings of one preset, as nested dictionaries keyed by tool.

    Args:
        name_or_path: A name from `preset_names`, or the path of a YAML file (ending in .yaml or
            .yml).

    Raises:
        ValueError: If there is no such preset or file, or it holds no mapping of settings.
    """
    if str(name_or_path).endswith(('.yaml', '.yml')):
        source: Any = Path(name_or_path)
        if not source.is_file():
            raise ValueError(f'preset file {source} does not exist')
    else:
        presets, from_paper = _preset_files(), paper_presets()
        if name_or_path in from_paper:
            return from_paper[str(name_or_path)]
        if name_or_path not in presets:
            close = get_close_matches(str(name_or_path), preset_names(), n=1)
            hint = f'; did you mean {close[0]!r}?' if close else ''
            raise ValueError(
                f'no preset {str(name_or_path)!r}{hint} (known: {", ".join(presets)} '
                'and those of metagcttt presets)'
            )
        source = presets[str(name_or_path)]
    return read_yaml(source)[1]
