"""The commands of paper.yaml, as they stand there, on studies in miniature."""

import os
from pathlib import Path
import subprocess
import sys
from typing import Any

from metagcttt_tools.common.evidence import read_evidence
from metagcttt_tools.common.presets import load_preset
import pytest
import yaml

ARTEFACTS = read_evidence(Path(__file__).parents[1] / 'docs/results/paper.yaml').artefacts
COMMANDS = list(dict.fromkeys(line for artefact in ARTEFACTS for line in artefact.command))
STUDIES = sorted({artefact.preset for artefact in ARTEFACTS if artefact.preset})


def in_miniature(study: str, file: Path) -> dict[str, Any]:
    """The preset of a study, with one seed and its first arm, that keeps everything else."""
    preset = load_preset(study)
    arms = list(preset['sweep'].get('arms', {}).items())
    preset['generate'] |= {'episodes': 30, 'rows_per_episode': 60, 'processes': 1}
    preset['pretrain'] |= {'hidden': [8]}
    preset['pretrain']['training'] |= {'steps': 2, 'batch_size': 16}
    if 'snapshot_every' in preset['pretrain']:
        preset['pretrain']['snapshot_every'] = 1
    preset['meta_train'].setdefault('meta', {}).update(
        {'outer_steps': 4, 'inner_steps': 2, 'batch_size': 16}
    )
    preset['evaluate'] |= {'budgets': [0, 2], 'episodes': 1, 'processes': 1}
    preset['sweep'] |= {'curve_budgets': [0, 2]} if 'curve' in preset['sweep'] else {}
    preset['sweep'] |= {'base': str(file), 'seeds': [0], 'arms': dict(arms[:1]), 'processes': 1}
    return preset


def test_every_command_belongs_to_a_study() -> None:
    assert all(sum(study in line for study in STUDIES) == 1 for line in COMMANDS)
    assert len(COMMANDS) >= 9


@pytest.mark.mujoco
@pytest.mark.timeout(900)
@pytest.mark.parametrize('study', STUDIES)
def test_commands_run(study: str, tmp_path: Path) -> None:
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
    path = f'{Path(sys.executable).parent}:{os.environ["PATH"]}'
    for line in [f'metagcttt generate --preset {file}', *lines]:
        done = subprocess.run(
            ['bash', '-c', line], cwd=tmp_path, env=os.environ | {'PATH': path},
            capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, f'{line}\n{done.stdout}\n{done.stderr}'
    made = {path.name for path in (tmp_path / 'docs' / 'results').iterdir()}
    for artefact in ARTEFACTS:
        if artefact.preset == study:
            assert {name for name in artefact.files if study in name} <= made
