"""The manifest of a study: which policies there are, and which files hold their results."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Self

from metagcttt_core.config import error_lines, Settings
from metagcttt_core.files import write_json
from pydantic import Field, ValidationError

BASE = 'base'
FILE = 'manifest.json'


class Policy(Settings):
    """A policy of a study."""

    checkpoint: Path = Field(description='its folder')
    arm: str = Field(description='how it was post-trained; `base` before that')
    seed: int = Field(ge=0, description='training seed')
    fraction: float = Field(ge=0, le=1, description='of the outer steps; 0 for a base policy')


class Evaluation(Settings):
    """The results of some policies with one way to adapt."""

    file: str = Field(description='name of the file in the folder of the study')
    policies: tuple[Policy, ...] = Field(description='in the order of the results')


class Manifest(Settings):
    """The contents of a study; `metagcttt report` finds all results through it."""

    format: Literal['metagcttt-study'] = 'metagcttt-study'
    version: Literal[1] = 1
    settings: dict[str, Any] = Field(description='settings of the sweep')
    commit: str = Field('unknown', description='version of the code')
    versions: dict[str, str] = Field({}, description='versions of packages')
    adaptations: dict[str, Evaluation] = Field(description='by name of the adaptation')
    curve: Evaluation | None = Field(None, description='of policies along post-training')

    def write(self, folder: Path) -> None:
        """Write the manifest of the study in `folder`."""
        write_json(folder / FILE, self.model_dump(mode='json'))

    @classmethod
    def read(cls, folder: Path) -> Self:
        """The manifest of the study in `folder`.

        Raises:
            ValueError: If there is none, or it is damaged; names the file.
        """
        path = folder / FILE
        try:
            return cls.model_validate_json(path.read_bytes())
        except (FileNotFoundError, NotADirectoryError) as error:
            raise ValueError(f'{path} does not exist: run metagcttt sweep first') from error
        except ValidationError as error:
            raise ValueError(f'{path}: {"; ".join(error_lines(error))}') from error


def checkpoints(policies: Sequence[Policy]) -> tuple[Path, ...]:
    """The folders of policies."""
    return tuple(policy.checkpoint for policy in policies)
