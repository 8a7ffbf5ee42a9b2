"""Whole datasets: the same bytes whatever the way there, and nothing lost on it."""

from collections.abc import Callable
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from metagcttt_core.data import TrajectoryDataset
from metagcttt_core.files import claim_folder
import numpy as np
from ogbench.utils import load_dataset
import pytest
from sim_bridge.controllers import ControllerError
from sim_bridge.generation import plan as plan_module
from sim_bridge.generation.chunks import GenerationError, plan_chunks
from sim_bridge.generation.generate import generate, Progress
from sim_bridge.generation.plan import GenerationPlan, plan_dataset

pytestmark = pytest.mark.mujoco
MAZE = 'pointmaze-medium-v0'


def small(episodes: int = 5, seed: int = 0, rows: int = 21) -> GenerationPlan:
    return plan_dataset(MAZE, 'navigate', seed=seed, episodes=episodes, rows_per_episode=rows)


@pytest.fixture(autouse=True)
def two_episodes_per_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan_module, 'CHUNK_ROWS', 42)


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_files_have_ogbenchs_format_and_nothing_else_is_left(tmp_path: Path) -> None:
    statistics = generate(small(), tmp_path / 'maze.npz')
    assert sorted(contents(tmp_path)) == ['maze-val.npz', 'maze.json', 'maze.npz']
    with np.load(tmp_path / 'maze.npz', allow_pickle=False) as arrays:
        types = {name: (arrays[name].dtype, arrays[name].shape) for name in arrays.files}
    assert types == {
        'observations': (np.float32, (105, 2)),
        'actions': (np.float32, (105, 2)),
        'terminals': (np.bool_, (105,)),
        'qpos': (np.float32, (105, 2)),
        'qvel': (np.float32, (105, 2)),
    }
    assert (statistics.rows, statistics.validation_rows) == (105, 21)
    assert 0 < statistics.coverage < 1


def test_ogbenchs_reader_and_ours_understand_the_file(tmp_path: Path) -> None:
    generate(small(), tmp_path / 'maze.npz')
    theirs = load_dataset(tmp_path / 'maze.npz', add_info=True)
    ours = TrajectoryDataset.load(tmp_path / 'maze.npz')
    assert theirs['observations'].shape == (100, 2)
    assert theirs['terminals'].sum() == ours.num_episodes == 5
    np.testing.assert_array_equal(ours.episode_ends, [20, 41, 62, 83, 104])
    np.testing.assert_array_equal(theirs['next_observations'][:20], ours.observations[1:21])


def test_number_of_processes_does_not_matter(tmp_path: Path) -> None:
    for processes in (1, 2):
        (tmp_path / str(processes)).mkdir()
        generate(small(9), tmp_path / str(processes) / 'maze.npz', processes=processes)
    assert contents(tmp_path / '1') == contents(tmp_path / '2')


def test_longer_run_begins_with_the_shorter_one(tmp_path: Path) -> None:
    generate(small(3), tmp_path / 'short.npz')
    generate(small(30), tmp_path / 'long.npz')
    for short, long in (('short', 'long'), ('short-val', 'long-val')):
        first = TrajectoryDataset.load(tmp_path / f'{short}.npz')
        second = TrajectoryDataset.load(tmp_path / f'{long}.npz')
        assert second.num_episodes > first.num_episodes
        for name in ('observations', 'actions', 'terminals'):
            array = getattr(first, name)
            np.testing.assert_array_equal(array, getattr(second, name)[: len(array)])


def test_seeds_and_splits_differ(tmp_path: Path) -> None:
    generate(small(1), tmp_path / 'a.npz')
    generate(small(1, seed=1), tmp_path / 'b.npz')
    files = [tmp_path / f'{name}.npz' for name in ('a', 'a-val', 'b', 'b-val')]
    starts = {TrajectoryDataset.load(file).observations[0].tobytes() for file in files}
    assert len(starts) == 4


def test_sidecar_holds_settings_versions_and_statistics(tmp_path: Path) -> None:
    statistics = generate(small(seed=7), tmp_path / 'maze.npz')
    sidecar = json.loads((tmp_path / 'maze.json').read_text())
    assert sidecar['statistics'] == vars(statistics)
    assert sidecar['environment'] == MAZE
    assert sidecar['seed'] == 7
    assert {'format_version', 'mujoco_version', 'numpy_version', 'ogbench_version'} <= set(sidecar)


def test_statistics_count_goals_and_cells(tmp_path: Path) -> None:
    statistics = generate(small(8, rows=601), tmp_path / 'maze.npz')
    assert 3 < statistics.goals_per_episode < 9  # OGBench's own script: 8.7 in 1000 steps
    assert statistics.coverage == 1


def test_progress_counts_up_to_all_episodes(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    generate(
        small(5), tmp_path / 'maze.npz', progress=lambda done, total: calls.append((done, total))
    )
    assert calls == [(0, 6), (2, 6), (4, 6), (5, 6), (6, 6)]


class Interrupted(Exception):
    """Stands for whatever ends a run."""


def interrupt_after(done_episodes: int) -> Progress:
    def progress(done: int, total: int) -> None:
        if done >= done_episodes:
            raise Interrupted

    return progress


@pytest.fixture
def unfinished(tmp_path: Path) -> Path:
    """A run of `small(9)` that was interrupted after four episodes."""
    with pytest.raises(Interrupted):
        generate(small(9), tmp_path / 'maze.npz', progress=interrupt_after(4))
    return tmp_path / 'maze.npz'


def test_resume_records_only_what_is_missing_and_gives_the_same_files(
    unfinished: Path, tmp_path: Path
) -> None:
    assert sorted(contents_of_partial(unfinished)) == [
        'settings.json',
        'train-000000-000002.npz',
        'train-000002-000004.npz',
    ]
    done: list[int] = []
    generate(small(9), unfinished, resume=True, progress=lambda now, total: done.append(now))
    assert done[0] == 4
    (tmp_path / 'whole').mkdir()
    generate(small(9), tmp_path / 'whole' / 'maze.npz')
    resumed = {file.name: file.read_bytes() for file in tmp_path.glob('maze*')}
    assert resumed == contents(tmp_path / 'whole')


def contents_of_partial(output: Path) -> list[str]:
    names = {file.name for file in output.with_suffix('.partial').iterdir()}
    return sorted(names - {'.made-by-metagcttt'})


def test_unfinished_dataset_is_not_touched_without_being_told(unfinished: Path) -> None:
    with pytest.raises(GenerationError, match=r'maze\.partial holds an unfinished dataset'):
        generate(small(9), unfinished)
    assert len(contents_of_partial(unfinished)) == 3


@pytest.mark.parametrize(
    ('asked', 'message'),
    [
        (small(9, seed=1), 'generated with seed 0, not 1'),
        (small(8), 'generated with episodes 9, not 8'),
        (small(9, rows=22), 'generated with rows_per_episode 21, not 22'),
    ],
)
def test_resume_with_other_settings_is_refused_by_name(
    unfinished: Path, asked: GenerationPlan, message: str
) -> None:
    with pytest.raises(GenerationError, match=message):
        generate(asked, unfinished, resume=True)


def test_walking_to_the_goals_is_another_dataset(tmp_path: Path) -> None:
    plan = plan_dataset(MAZE, 'navigate', episodes=EPISODES, rows_per_episode=21)
    generate(plan, tmp_path / 'maze.npz')
    assert 'to_goal' not in json.loads((tmp_path / 'maze.json').read_text())
    with pytest.raises(GenerationError, match='to_goal'):
        generate(plan.model_copy(update={'to_goal': True}), tmp_path / 'maze.npz', resume=True)


def test_resume_with_other_physics_is_refused_by_name(unfinished: Path) -> None:
    settings = unfinished.with_suffix('.partial') / 'settings.json'
    stored = json.loads(settings.read_text())
    settings.write_text(json.dumps({**stored, 'mujoco_version': '0.1'}))
    with pytest.raises(GenerationError, match=r"generated with mujoco_version '0\.1'"):
        generate(small(9), unfinished, resume=True)


def test_overwrite_starts_anew(unfinished: Path) -> None:
    done: list[int] = []
    generate(
        small(2, seed=4), unfinished, overwrite=True, progress=lambda now, total: done.append(now)
    )
    assert done[0] == 0
    assert TrajectoryDataset.load(unfinished).num_episodes == 2


def test_finished_dataset_is_refused_or_left_as_it_is(tmp_path: Path) -> None:
    output = tmp_path / 'maze.npz'
    statistics = generate(small(), output)
    before = contents(tmp_path)
    with pytest.raises(GenerationError, match=r'maze\.npz exists: overwrite it or choose another'):
        generate(small(), output)
    with pytest.raises(GenerationError, match=r'maze\.json was generated with seed 0, not 1'):
        generate(small(seed=1), output, resume=True)
    assert generate(small(), output, resume=True) == statistics
    assert contents(tmp_path) == before


def test_folder_without_settings_is_begun_anew(tmp_path: Path) -> None:
    claim_folder(tmp_path / 'maze.partial')  # the disk was full when they were to be written
    generate(small(3), tmp_path / 'maze.npz')
    assert not (tmp_path / 'maze.partial').exists()
    assert (tmp_path / 'maze.npz').exists()


def test_foreign_sidecar_is_refused(tmp_path: Path) -> None:
    (tmp_path / 'maze.json').write_text('[1, 2]')
    with pytest.raises(GenerationError, match='describes no generated dataset'):
        generate(small(), tmp_path / 'maze.npz', resume=True)


def test_damaged_chunk_is_named(unfinished: Path) -> None:
    chunk = unfinished.with_suffix('.partial') / 'train-000002-000004.npz'
    chunk.write_bytes(chunk.read_bytes()[:100])
    with pytest.raises(GenerationError, match=r'train-000002-000004\.npz is damaged'):
        generate(small(9), unfinished, resume=True)
    chunk.unlink()
    generate(small(9), unfinished, resume=True)


def test_chunks_hold_every_episode_once() -> None:
    chunks = plan_chunks(small(25))
    for validation, total in ((False, 25), (True, 2)):
        numbers = [
            number
            for chunk in chunks
            if chunk.validation == validation
            for number in range(chunk.start, chunk.stop)
        ]
        assert numbers == list(range(total))


def test_bad_requests_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(GenerationError, match=r'must end in \.npz, got .*maze\.zip'):
        generate(small(), tmp_path / 'maze.zip')
    with pytest.raises(GenerationError, match='processes must be at least 1, got 0'):
        generate(small(), tmp_path / 'maze.npz', processes=0)
    with pytest.raises(ControllerError, match='nowhere: no direction controller'):
        generate(
            plan_dataset('humanoidmaze-medium-v0', 'navigate'),
            tmp_path / 'maze.npz',
            controller=tmp_path / 'nowhere',
        )
    assert contents(tmp_path) == {}


EPISODES = 150
SCRIPT = f"""
if __name__ == '__main__':
    from pathlib import Path
    import sys
    from sim_bridge.generation import plan
    from sim_bridge.generation.generate import generate

    plan.CHUNK_ROWS = 42
    asked = plan.plan_dataset('{MAZE}', 'navigate', episodes={EPISODES}, rows_per_episode=21)
    generate(asked, Path(sys.argv[1]), processes=2)
"""


def signal_in_the_middle(output: Path, number: signal.Signals) -> tuple[list[int], str]:
    """Start a run on two processes and end it after some chunks.

    Returns:
        Process numbers of the run's children when the signal was sent, and what it all printed to
        standard error.
    """
    output.parent.mkdir()
    script = output.parent.with_suffix('.py')
    script.write_text(SCRIPT)
    root = Path(plan_module.__file__).parents[2]
    process = subprocess.Popen(
        [sys.executable, str(script), str(output)],
        env={**os.environ, 'PYTHONPATH': str(root), 'OMP_NUM_THREADS': '1'},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Background jobs may inherit an ignored SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    chunks = output.with_suffix('.partial')
    try:
        wait_until(lambda: len(list(chunks.glob('train-*.npz'))) >= 3 or process.poll())
        children = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text().split()
    except BaseException:
        process.kill()
        raise
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
    else:
        process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    return [int(child) for child in children], errors


def wait_until(condition: Callable[[], object], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, 'timed out'
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != 'Z'


@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='looks for children in /proc')
@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGINT], ids=['kill', 'ctrl_c'])
def test_end_in_the_middle_leaves_no_worker_and_resume_gives_the_same_files(
    tmp_path: Path, number: signal.Signals
) -> None:
    output = tmp_path / 'ended' / 'maze.npz'
    children, errors = signal_in_the_middle(output, number)
    wait_until(lambda: not any(is_running(pid) for pid in children), timeout_s=60)
    assert not output.exists()
    # Workers are silent. (glfw, while imported, asks for its version in a script of its own.)
    tracebacks = errors.split('Traceback (most recent call last)')[1:]
    ours = [text for text in tracebacks if 'File "<string>"' not in text]
    assert len(ours) == (1 if number == signal.SIGINT else 0), errors

    asked = plan_dataset(MAZE, 'navigate', episodes=EPISODES, rows_per_episode=21)
    done: list[int] = []
    generate(asked, output, resume=True, progress=lambda now, total: done.append(now))
    assert 6 <= done[0] < EPISODES + EPISODES // 10
    (tmp_path / 'whole').mkdir()
    generate(asked, tmp_path / 'whole' / 'maze.npz')
    assert contents(output.parent) == contents(tmp_path / 'whole')


def test_files_of_somebody_else_are_not_overwritten(tmp_path: Path) -> None:
    output = tmp_path / 'maze.npz'
    (tmp_path / 'maze.partial').mkdir()
    (tmp_path / 'maze.partial' / 'thesis').write_text('four years of work')
    for flags in ({}, {'resume': True}, {'overwrite': True}):
        with pytest.raises(GenerationError, match=r'maze\.partial'):
            generate(small(9), output, **flags)
    assert (tmp_path / 'maze.partial' / 'thesis').exists()
    (tmp_path / 'maze.json').write_text('{"mine": true}')
    (tmp_path / 'maze.partial' / 'thesis').unlink()
    (tmp_path / 'maze.partial').rmdir()
    with pytest.raises(GenerationError, match=r'maze\.json describes no generated dataset'):
        generate(small(9), output, overwrite=True)
    assert (tmp_path / 'maze.json').read_text() == '{"mine": true}'
