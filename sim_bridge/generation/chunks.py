"""Resumable storage of a dataset in progress: finished chunks in a folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
import zipfile

from metagcttt_core.files import atomic_write, claim_folder, read_json, remove_claimed, write_json
import numpy as np

from sim_bridge.generation.episodes import Episode
from sim_bridge.generation.plan import GenerationPlan

PER_ROW = ('observations', 'actions', 'qpos', 'qvel', 'terminals')
_SETTINGS = 'settings.json'


class GenerationError(ValueError):
    """A dataset that cannot be generated or resumed; the message says what to do."""


def refuse_difference(path: Path, stored: dict[str, Any], asked: dict[str, Any]) -> None:
    """Refuse to resume a dataset with other settings.

    Raises:
        GenerationError: If a setting differs; names the first one, both values and the path.
    """
    for key in {**asked, **stored}:
        was, now = stored.get(key), asked.get(key)
        if was != now:
            raise GenerationError(
                f'{path} was generated with {key} {was!r}, not {now!r}: use the same settings, '
                'choose another output, or overwrite it'
            )


@dataclass(frozen=True, order=True)
class Chunk:
    """Training or validation episodes [start, stop)."""

    validation: bool
    start: int
    stop: int

    @property
    def file_name(self) -> str:
        """Name of the file that holds the chunk."""
        split = 'validation' if self.validation else 'train'
        return f'{split}-{self.start:06d}-{self.stop:06d}.npz'


def plan_chunks(plan: GenerationPlan) -> list[Chunk]:
    """Split a dataset into chunks, independently of the number of processes."""
    return [
        Chunk(validation, start, min(start + plan.chunk_episodes, total))
        for validation, total in ((False, plan.episodes), (True, plan.validation_episodes))
        for start in range(0, total, plan.chunk_episodes)
    ]


class ChunkFolder:
    """Folder of the chunks finished so far, with the settings that produced them.

    A chunk file is complete or absent, whenever the process that writes it dies.
    """

    def __init__(self, path: Path) -> None:
        """Refer to a folder, which need not exist."""
        self.path = path

    def open(self, settings: dict[str, Any]) -> None:
        """Create the folder, or reopen it if its settings are the same.

        Raises:
            GenerationError: If its settings differ; names the first that does.
        """
        file = self.path / _SETTINGS
        if file.exists():
            refuse_difference(self.path, self.settings(), settings)
            return
        try:
            claim_folder(self.path)
        except FileExistsError as error:
            raise GenerationError(str(error)) from error
        write_json(file, settings)

    def settings(self) -> dict[str, Any]:
        """The settings of the chunks.

        Raises:
            GenerationError: If their file is damaged.
        """
        file = self.path / _SETTINGS
        try:
            return read_json(file)
        except ValueError as error:
            raise GenerationError(f'{file} is damaged ({error}): remove {self.path}') from error

    def exists(self) -> bool:
        """True if a dataset is in progress here."""
        return (self.path / _SETTINGS).exists()

    def has(self, chunk: Chunk) -> bool:
        """True if a chunk is finished."""
        return (self.path / chunk.file_name).exists()

    def write(self, chunk: Chunk, episodes: list[Episode]) -> None:
        """Store a finished chunk."""
        arrays = {
            name: np.concatenate([getattr(episode, name) for episode in episodes])
            for name in PER_ROW
        }
        goals = np.array([episode.goals_reached for episode in episodes])
        with atomic_write(self.path / chunk.file_name) as file:
            np.savez(file, allow_pickle=False, goals_reached=goals, **arrays)

    def read(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """Load a finished chunk.

        Raises:
            GenerationError: If the file is damaged.
        """
        path = self.path / chunk.file_name
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in (*PER_ROW, 'goals_reached')}
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise GenerationError(f'{path} is damaged ({error}): remove it and resume') from error

    def remove(self) -> None:
        """Delete the folder if it exists.

        Raises:
            GenerationError: If it was not made by `open`.
        """
        try:
            remove_claimed(self.path)
        except FileExistsError as error:
            raise GenerationError(str(error)) from error
