"""Files damaged at random: their content unchanged, or the promised error that names the file.

METAGCTTT_DAMAGE=3000 tries that many variants of each kind of file.
"""

from collections.abc import Callable
from dataclasses import dataclass
import json
import os
from pathlib import Path
import shutil
from typing import Any

import h5py
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer
from metagcttt_core import CheckpointError, DatasetError, load_checkpoint, TrajectoryDataset
from metagcttt_core.files import read_json_lines, write_json
from metagcttt_core.robot.errors import ContractError
from metagcttt_core.robot.yaml_file import load_contract
from metagcttt_core.training.checkpoint import load_training_state
from metagcttt_tools.common.evidence import read_evidence
from metagcttt_tools.common.job_log import JobLog
from metagcttt_tools.common.manifest import Evaluation, Manifest, Policy
from metagcttt_tools.common.presets import load_preset
from metagcttt_tools.common.resume import kept_in
from metagcttt_tools.recordings.trajectories import ACTION, read_recordings, STATE
from metagcttt_tools.report import read_study
from metagcttt_tools.robots.bag import open_bag
from metagcttt_tools.robots.episodes import read_episodes
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from sim_bridge.controllers import ControllerError, LearnedFollower
from sim_bridge.controllers.direction import BUNDLED

from tests.core.builders import random_dataset
from tests.core.robot.messages import contract, DRIVE
from tests.core.training.test_checkpoint import saved_agent, training_state
from tests.tools.recordings.test_trajectories import ACTION_TEXT, STATE_TEXT
from tests.tools.robots.bags import drive, write

ROOT = Path(__file__).parents[1]
VARIANTS = int(os.environ.get('METAGCTTT_DAMAGE', '60'))


@dataclass
class Kind:
    """A kind of file.

    Attributes:
        make: Writes one into an empty folder.
        read: Reads what is in the folder; its result compares equal to itself.
        error: What it may raise; the message names the folder.
        checked: The format has checksums, so that damage is noticed.
    """

    make: Callable[[Path], Any]
    read: Callable[[Path], Any]
    error: type[Exception]
    checked: bool = False


def rows(dataset: TrajectoryDataset) -> list[list[Any]]:
    return [dataset.observations.tolist(), dataset.actions.tolist(), dataset.terminals.tolist()]


def load(name: str) -> Callable[[Path], Any]:
    return lambda folder: rows(TrajectoryDataset.load(folder / name))


def save_npz(folder: Path) -> None:
    random_dataset([8] * 10).save(folder / 'data.npz')


def save_stored_npz(folder: Path) -> None:
    data = random_dataset([8] * 10)
    arrays = {name: getattr(data, name) for name in ('observations', 'actions', 'terminals')}
    np.savez(folder / 'data.npz', **arrays)


def save_minari(folder: Path) -> None:
    data = random_dataset([8] * 10)
    (folder / 'data').mkdir()
    with h5py.File(folder / 'data' / 'main_data.hdf5', 'w') as file:
        bounds = zip(data.episode_starts, data.episode_ends, strict=True)
        for number, (first, last) in enumerate(bounds):
            group = file.create_group(f'episode_{number}')
            group['observations/observation'] = data.observations[first : last + 1, 2:]
            group['observations/achieved_goal'] = data.observations[first : last + 1, :2]
            group.create_dataset(
                'actions', data=data.actions[first:last], compression='gzip', fletcher32=True
            )
            group['infos/qpos'] = data.observations[first : last + 1]
    metadata = {'dataset_id': 'x/y-v0', 'total_episodes': 10, 'requirements': []}
    (folder / 'data' / 'metadata.json').write_text(json.dumps(metadata))


def record(compression: CompressionType) -> Callable[[Path], None]:
    def save(folder: Path) -> None:
        with (folder / 'walk.mcap').open('wb') as file:
            writer = Writer(file, compression=compression, chunk_size=2000)
            state = writer.register_msgdef(STATE, STATE_TEXT)
            action = writer.register_msgdef(ACTION, ACTION_TEXT)
            for step in range(40):
                now_ns, place = 10**12 + step * 10**8, {'episode_id': 1, 'step': step}
                stamp = dict(zip(('sec', 'nanosec'), divmod(now_ns, 10**9), strict=True))
                header = {'stamp': stamp, 'frame_id': 'map'}
                states = {'header': header, **place, 'observation': [0.1 * step, 1.0]}
                writer.write_message('/state', state, states, now_ns, now_ns)
                actions = {**place, 'query_id': 1, 'instance': 7, 'values': [0.5, -0.5]}
                writer.write_message('/action', action, actions, now_ns + 1, now_ns + 1)
            writer.finish()

    return save


def record_bag(storage: StoragePlugin, compression: CompressionMode) -> Callable[[Path], None]:
    return lambda folder: write(folder / 'bag', drive(), storage, compression)


def read_bag(folder: Path) -> Any:
    with open_bag(folder / 'bag', contract()) as bag:
        episodes = read_episodes(contract(), bag.messages())
    return [part.tolist() for pair in episodes.trajectories for part in pair]


def save_study(folder: Path) -> None:
    policy = Policy(checkpoint=Path('base-0/checkpoint'), arm='base', seed=0, fraction=0.0)
    evaluation = Evaluation(file='evaluation.json', policies=(policy,))
    Manifest(settings={}, adaptations={'ttt': evaluation}).write(folder)
    curve = [{'budget': budget, 'success': 0.5} for budget in (0, 10)]
    write_json(folder / 'evaluation.json', {'settings': {}, 'results': [{'curve': curve}]})


def read_job_log(folder: Path) -> Any:
    log: JobLog[tuple[Any, ...]] = JobLog(
        folder / 'jobs.jsonl', {'decisive': {'a': 1}}, resume=True
    )
    log._file.close()
    return log.finished


def save_job_log(folder: Path) -> None:
    log: JobLog[tuple[Any, ...]] = JobLog(
        folder / 'jobs.jsonl', {'decisive': {'a': 1}}, resume=False
    )
    for budget in range(20):
        log.add(('path', 'maze', budget, 0, 1), 0.5)
    log._file.close()


def save_text(name: str, text: str) -> Callable[[Path], Any]:
    return lambda folder: (folder / name).write_text(text)


def weights(folder: Path) -> Any:
    agent = load_checkpoint(folder)
    return {name: tensor.tolist() for name, tensor in agent.state_dict().items()}


PRESET = (ROOT / 'tools/metagcttt_tools/presets/pointmaze-medium-navigate-study.yaml').read_text()
EVIDENCE = (ROOT / 'docs/results/paper.yaml').read_text()
NONE, FILES = CompressionMode.NONE, CompressionMode.FILE
KINDS = {
    'npz': Kind(save_npz, load('data.npz'), DatasetError, checked=True),
    'stored-npz': Kind(save_stored_npz, load('data.npz'), DatasetError, checked=True),
    'minari': Kind(save_minari, load('.'), DatasetError),
    'mcap': Kind(
        record(CompressionType.NONE),
        lambda folder: rows(read_recordings([folder / 'walk.mcap'])[0]),
        DatasetError,
    ),
    'mcap-lz4': Kind(
        record(CompressionType.LZ4),
        lambda folder: rows(read_recordings([folder / 'walk.mcap'])[0]),
        DatasetError,
    ),
    'mcap-zstd': Kind(
        record(CompressionType.ZSTD),
        lambda folder: rows(read_recordings([folder / 'walk.mcap'])[0]),
        DatasetError,
    ),
    'bag-mcap': Kind(record_bag(StoragePlugin.MCAP, NONE), read_bag, DatasetError),
    'bag-db3': Kind(record_bag(StoragePlugin.SQLITE3, NONE), read_bag, DatasetError),
    'bag-zstd': Kind(record_bag(StoragePlugin.SQLITE3, FILES), read_bag, DatasetError),
    'checkpoint': Kind(
        lambda folder: saved_agent(folder, training=training_state()),
        lambda folder: (weights(folder), load_training_state(folder).step),
        CheckpointError,
    ),
    'controller': Kind(
        lambda folder: shutil.copytree(BUNDLED / 'ant', folder, dirs_exist_ok=True),
        lambda folder: [weight.tolist() for weight in LearnedFollower.load(folder).weights],
        ControllerError,
        checked=True,
    ),
    'contract': Kind(
        save_text('robot.yaml', DRIVE),
        lambda folder: load_contract(folder / 'robot.yaml'),
        ContractError,
    ),
    'preset': Kind(
        save_text('study.yaml', PRESET), lambda folder: load_preset(folder / 'study.yaml'),
        ValueError,
    ),
    'evidence': Kind(
        save_text('paper.yaml', EVIDENCE), lambda folder: read_evidence(folder / 'paper.yaml'),
        ValueError,
    ),
    'settings-of-a-run': Kind(
        lambda folder: write_json(folder / 'settings.json', {'settings': {'seed': 1}}),
        lambda folder: kept_in(folder / 'settings.json'),
        ValueError,
    ),
    'metrics-of-a-run': Kind(
        save_text('metrics.jsonl', '{"step": 1, "loss": 0.5}\n' * 20),
        lambda folder: read_json_lines(folder / 'metrics.jsonl'),
        ValueError,
    ),
    'jobs-of-an-evaluation': Kind(save_job_log, read_job_log, ValueError),
    'study': Kind(save_study, lambda folder: read_study(folder), ValueError),
}  # fmt: skip


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    """Bits flipped, an end cut off, a block zeroed, four bytes made a large number, or a swap."""
    data = bytearray(content)
    at = int(rng.integers(len(data)))
    match rng.integers(5):
        case 0:
            for place in rng.integers(len(data), size=8):
                data[place] ^= 1 << int(rng.integers(8))
        case 1:
            del data[at:]
        case 2:
            data[at : at + 64] = bytes(len(data[at : at + 64]))
        case 3:
            data[at : at + 4] = int(rng.integers(2**32)).to_bytes(4, 'little')[: len(data) - at]
        case 4:
            other = int(rng.integers(len(data)))
            first, second = data[at : at + 4], data[other : other + 4]
            data[at : at + len(second)], data[other : other + len(first)] = second, first
    return bytes(data)


@pytest.mark.slow
@pytest.mark.filterwarnings('ignore')
@pytest.mark.parametrize('name', KINDS)
def test_damaged_file(tmp_path: Path, name: str, bounded_memory) -> None:
    kind, made = KINDS[name], tmp_path / 'made'
    made.mkdir()
    kind.make(made)
    folder = tmp_path / name
    shutil.copytree(made, folder)
    whole = kind.read(folder)
    files = [path.relative_to(made) for path in made.rglob('*') if path.stat().st_size]
    files = [file for file in files if (made / file).is_file()]
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(VARIANTS):
        shutil.rmtree(folder)
        shutil.copytree(made, folder)
        file = files[rng.integers(len(files))]
        (folder / file).write_bytes(damage((made / file).read_bytes(), rng))
        try:
            content = kind.read(folder)
        except kind.error as error:
            assert str(folder) in str(error), repr(error)
            refused += 1
        else:
            assert not kind.checked or content == whole
    assert refused > VARIANTS // 10
