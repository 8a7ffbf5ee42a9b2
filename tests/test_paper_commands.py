"""The commands of paper.yaml, as they stand there, on studies in miniature."""

from collections.abc import Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
import shlex
from typing import Any

from metagcttt_tools import evaluate, sweep
from metagcttt_tools.common.evidence import read_evidence
from metagcttt_tools.common.presets import load_preset
from metagcttt_tools.jobs.scheduler import Job
from metagcttt_tools.main import main
import pytest
from sim_bridge.mazes import ogbench, ogbench_layouts
import yaml

ARTEFACTS = read_evidence(Path(__file__).parents[1] / 'docs/results/paper.yaml').artefacts
COMMANDS = list(dict.fromkeys(line for artefact in ARTEFACTS for line in artefact.command))
STUDIES = sorted({artefact.preset for artefact in ARTEFACTS if artefact.preset})


def in_miniature(study: str, file: Path) -> dict[str, Any]:
    """The preset of a study, small: one seed, and the arms that commands name, else the first."""
    preset = load_preset(study)
    arms = preset['sweep'].get('arms', {})
    named = [arm for arm in arms if any(f'/{arm}-0' in line for line in COMMANDS)]
    preset['generate'] |= {'episodes': 30, 'rows_per_episode': 60, 'processes': 1}
    preset['pretrain'] |= {'hidden': [8]}
    preset['pretrain']['training'] |= {'steps': 2, 'batch_size': 16}
    if 'snapshot_every' in preset['pretrain']:
        preset['pretrain']['snapshot_every'] = 1
    preset['meta_train'].setdefault('meta', {}).update(
        {'outer_steps': 4, 'inner_steps': 2, 'batch_size': 16}
    )
    preset['meta_train']['log_every'] = 1
    preset['evaluate'] |= {'budgets': [0, 2], 'episodes': 1, 'processes': 1}
    if 'curve' in preset['sweep']:
        preset['sweep'] |= {'curve': [0.25], 'curve_budgets': [0, 2]}
    preset['sweep'] |= {'base': str(file), 'seeds': [0], 'processes': 1}
    preset['sweep']['arms'] = {arm: arms[arm] for arm in named or list(arms)[:1]}
    return preset


class Here(Executor):
    """Calls functions in this process: a study starts dozens, and each imports PyTorch."""

    def __init__(self, *_: Any, initializer: Any = None, initargs: Any = (), **__: Any) -> None:
        if initializer:
            initializer(*initargs)

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(function(*arguments))
        return done


class JobsHere(Here):
    """The same for the runs of a study."""

    def submit(self, job: Job) -> Future[None]:
        return super().submit(
            main, [job.invocation.program, '--preset', str(job.invocation.preset)]
        )

    def stop(self) -> None:
        raise AssertionError('a run failed')


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Everything happens in this process, and episodes have an end soon."""
    monkeypatch.setattr(sweep, 'LocalScheduler', JobsHere)
    monkeypatch.setattr(evaluate, 'ProcessPoolExecutor', Here)
    monkeypatch.setattr(evaluate, 'end_with_parent', lambda: None)
    monkeypatch.setitem(ogbench_layouts.ROBOTS['pointmaze'].max_episode_steps, 'medium', 25)
    assert ogbench_layouts.ROBOTS['antmaze'].max_episode_steps['medium'] == 25
    ogbench.describe.cache_clear()
    yield
    ogbench.describe.cache_clear()


def test_every_command_belongs_to_a_study() -> None:
    assert all(sum(study in line for study in STUDIES) == 1 for line in COMMANDS)
    assert len(COMMANDS) >= 9


@pytest.mark.mujoco
@pytest.mark.timeout(900)
@pytest.mark.parametrize('study', STUDIES)
def test_commands_run(
    study: str, tmp_path: Path, brief: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / f'{study}.yaml'
    file.write_text(yaml.safe_dump(in_miniature(study, file)))
    lines = [
        line.replace(f'--preset {study}', f'--preset {file}')
        .replace('{0,1,2}', '0')
        .replace('--budgets 0 200 --episodes 3', '--budgets 0 2 --episodes 1')
        for line in COMMANDS
        if study in line
    ]
    (tmp_path / 'docs' / 'results').mkdir(parents=True)
    for line in [f'metagcttt generate --preset {file}', *lines]:
        program, *arguments = shlex.split(line)
        assert program == 'metagcttt'
        main(arguments)
    results = tmp_path / 'docs' / 'results'
    made = {str(path.relative_to(results)) for path in results.rglob('*')}
    for artefact in ARTEFACTS:
        if artefact.preset == study:
            assert {name for name in artefact.files if study in name} <= made
