"""Pack trained policies and part of their dataset into the small assets that the demo uses."""

from pathlib import Path

from metagcttt_core import DatasetError, TrajectoryDataset
from metagcttt_core.config import Settings
from metagcttt_core.data.npz import write_arrays
import numpy as np
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse

_DESCRIPTION = """Pack trained policies and part of their dataset into the assets of the demo.

Example: metagcttt pack-assets --preset pointmaze-medium-navigate-cpu
Checkpoints lose their optimiser state, which is twice as large as the weights, unless
--optimizer-state keeps that of pre-training; --half-weights rounds the weights to 3 digits. The
dataset keeps its first trajectories, in half precision (1.6 cm at 20 m) and without the
simulator's own state, to be small enough for a repository."""

_DATASET = 'dataset.npz'


class PackSettings(Settings):
    """Settings of the program."""

    base: Path = Field(Path('out/pretrain/checkpoint'), description='pre-trained policy')
    meta: Path = Field(Path('out/meta/checkpoint'), description='post-trained policy')
    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='their dataset (npz)'
    )
    episodes: int = Field(500, ge=1, description='trajectories to keep')
    optimizer_state: bool = Field(
        False, description='keep the optimiser state of pre-training, for test-time training'
    )
    half_weights: bool = Field(False, description='weights in half precision, half as large')
    out: Path = Field(Path('assets/pointmaze-medium-navigate'), description='folder to write')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(PackSettings, _DESCRIPTION, 'pack-assets', argv)
    from metagcttt_core import CheckpointError, load_checkpoint, save_checkpoint
    from metagcttt_core.training.checkpoint import has_checkpoint

    try:
        agents = {name: load_checkpoint(getattr(settings, name)) for name in ('base', 'meta')}
        dataset = TrajectoryDataset.load(settings.dataset)
        packed = settings.out / _DATASET
        if packed.exists() and not has_checkpoint(settings.out / 'base'):
            fail(f'{packed} exists and was not packed here: choose another --out')
        for name, agent in agents.items():
            if not settings.optimizer_state:
                agent.optimizer_state = None
            save_checkpoint(agent.half() if settings.half_weights else agent, settings.out / name)
        pack_dataset(dataset, settings)
    except (DatasetError, CheckpointError) as error:
        fail(str(error))
    for path in sorted(settings.out.rglob('*')):
        if path.is_file():
            print(f'{path.stat().st_size / 1e6:6.2f} MB  {path}')


def pack_dataset(dataset: TrajectoryDataset, settings: PackSettings) -> None:
    """Write the first trajectories of `dataset` to `dataset.npz`."""
    rows = int(dataset.episode_ends[min(settings.episodes, dataset.num_episodes) - 1]) + 1
    write_arrays(
        settings.out / _DATASET,
        {
            **dataset.about,
            'observations': dataset.observations[:rows].astype(np.float16),
            'actions': dataset.actions[:rows].astype(np.float16),
            'terminals': dataset.terminals[:rows],
        },
    )
