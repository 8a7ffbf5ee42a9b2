"""Studies: what they plan, and a whole one in miniature."""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from metagcttt_tools import sweep
from metagcttt_tools.common.manifest import Manifest
from metagcttt_tools.common.presets import load_preset, preset_names
from metagcttt_tools.sweep import is_evaluated, Study, SweepSettings
import pytest
from tests.core.builders import maze_walks
from tests.tools.tables import squeezed
import yaml

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def preset(tmp_path):
    """A study of two seeds and two arms that takes seconds."""
    dataset = tmp_path / 'walks.npz'
    maze_walks().save(dataset)
    path = tmp_path / 'preset.yaml'
    meta = {'outer_steps': 4, 'inner_steps': 2, 'batch_size': 16}
    values = {
        'sweep': {
            'base': str(path),
            'seeds': [0, 1],
            'arms': {
                'reptile': {'meta': {'algorithm': 'reptile', 'meta_lr': 0.1}},
                'one-step': {'meta': {'inner_steps': 1, 'early_stopping': False}, 'seeds': [1]},
            },
            'adaptations': {'full': {}, 'slow': {'ttt': {'lr': 1e-5}}},
            'curve': [0.5],
            'curve_budgets': [0],
            'out': str(tmp_path / 'study'),
        },
        'pretrain': {
            'dataset': str(dataset),
            'hidden': [16],
            'training': {'steps': 20, 'batch_size': 32},
        },
        'meta_train': {'dataset': str(dataset), 'meta': meta},
        'evaluate': {'dataset': str(dataset), 'budgets': [0, 1], 'episodes': 1, 'seeds': [0]},
    }
    path.write_text(yaml.safe_dump(values, sort_keys=False))
    return path


@pytest.mark.parametrize('name', [name for name in preset_names() if 'sweep' in load_preset(name)])
def test_study_of_every_preset_can_be_run(name):
    study = Study(SweepSettings.model_validate(load_preset(name)['sweep']))
    assert len(study.pretraining) == (1 if name == 'quick' else 3)
    assert study.evaluations


def study_of(preset, **different):
    values = yaml.safe_load(preset.read_text())['sweep']
    return Study(SweepSettings.model_validate(values | different))


def test_a_fraction_before_the_first_outer_step_is_refused(preset):
    arms = {'short': {'meta': {'outer_steps': 4}}}
    with pytest.raises(ValueError, match=r'arms.short: 0.1 of 4 outer steps is before the first'):
        study_of(preset, arms=arms, curve=[0.1, 0.5], curve_budgets=[0, 1])
    with pytest.raises(ValueError, match=r'arms.short: 0.01 of 4 outer steps is before the first'):
        study_of(preset, arms={'short': {**arms['short'], 'snapshot': 0.01}})


def test_budgets_along_the_curve_are_those_of_its_end(preset):
    with pytest.raises(ValueError, match=r'curve_budgets: 7 is not among .* \(0, 1\)'):
        study_of(preset, curve_budgets=[0, 7])


def test_each_run_differs_only_where_the_study_says(preset):
    study = study_of(preset)
    assert [run.seed for run in study.pretraining] == [0, 1]
    names = [run.out.name for _, run in study.post_training]
    assert names == ['reptile-0', 'reptile-1', 'one-step-1']
    (_, reptile), _, (_, one_step) = study.post_training
    assert (reptile.meta.algorithm, reptile.meta.meta_lr) == ('reptile', 0.1)
    assert (reptile.meta.inner_steps, reptile.meta.early_stopping) == (2, True)
    assert (one_step.meta.inner_steps, one_step.meta.early_stopping) == (1, False)
    assert one_step.checkpoint == study.pretraining[1].checkpoint_folder
    assert reptile.snapshot_every == 2
    full, slow = study.evaluations['full'][0], study.evaluations['slow'][0]
    assert slow.ttt == full.ttt.model_copy(update={'lr': 1e-5})
    assert [path.parent.name for path in full.checkpoints] == ['base-0', 'base-1', *names]
    snapshots = study.curve[0].checkpoints
    assert [path.parts[-3:] for path in snapshots] == [
        ('reptile-0', 'snapshots', '000002'),
        ('reptile-1', 'snapshots', '000002'),
    ]


def test_manifest_names_every_policy_and_its_results(preset, tmp_path):
    study = study_of(preset)
    study.manifest().write(tmp_path)
    manifest = Manifest.read(tmp_path)
    found = [(p.arm, p.seed, p.fraction) for p in manifest.adaptations['full'].policies]
    assert found == [
        *(('base', 0, 0), ('base', 1, 0)),
        *(('reptile', 0, 1), ('reptile', 1, 1), ('one-step', 1, 1)),
    ]
    assert [p.checkpoint for p in manifest.adaptations['full'].policies] == list(
        study.evaluations['full'][0].checkpoints
    )
    assert manifest.adaptations['slow'].file == 'evaluation-slow.json'
    assert [(p.arm, p.seed, p.fraction) for p in manifest.curve.policies] == [
        ('reptile', 0, 0.5),
        ('reptile', 1, 0.5),
    ]


def test_an_arm_holds_settings_of_every_stage(preset):
    arms = {
        'plain': {},
        'near': {
            'meta': {'outer_steps': 8, 'filter': {'slack': 10}},
            'evaluate': {'ttt': {'lr': 0.5}, 'filter': {'slack': 10}, 'budgets': [0, 3]},
            'snapshot': 0.75,
            'seeds': [1],
        },
    }
    study = study_of(preset, arms=arms)
    near = next(run for name, run in study.post_training if name == 'near')
    assert (near.meta.outer_steps, near.meta.inner_steps, near.meta.filter.slack) == (8, 2, 10)
    assert near.snapshot_every == 2  # for half and three quarters of 8
    assert list(study.evaluations) == ['full', 'full-near', 'slow', 'slow-near']
    together, policies = study.evaluations['full']
    assert {policy.arm for policy in policies} == {'base', 'plain'}
    alone, policies = study.evaluations['full-near']
    assert [(policy.arm, policy.fraction) for policy in policies] == [
        *(('base', 0.0), ('base', 0.0)),
        ('near', 0.75),
    ]
    assert policies[-1].checkpoint.parts[-3:] == ('near-1', 'snapshots', '000006')
    assert (alone.ttt.lr, alone.filter.slack, alone.budgets) == (0.5, 10, (0, 3))
    assert (together.filter.slack, together.budgets) == (5, (0, 1))
    assert study.evaluations['slow-near'][0].ttt.lr == 1e-5  # the adaptation has the last word


def test_an_actor_loss_for_each_stage(preset):
    values = yaml.safe_load(preset.read_text())
    values['pretrain']['agent'] = 'gciql'
    preset.write_text(yaml.safe_dump(values))
    study = study_of(
        preset, arms={'bc': {'actor_loss': 'bc'}}, adaptations={'awr': {'actor_loss': 'awr'}}
    )
    assert [run.actor_loss for _, run in study.post_training] == ['bc', 'bc']
    assert study.evaluations['awr'][0].actor_loss == 'awr'


@pytest.mark.mujoco
def test_dry_run_lists_what_is_left_and_runs_nothing(preset, tmp_path, capsys):
    sweep.main(['--preset', str(preset), '--dry-run'])
    text = squeezed(capsys.readouterr().out)
    assert '| pretrain base-0 | 20 |' in text
    assert '| meta-train one-step-1 | 4 |' in text
    # 5 policies x 2 budgets x 5 tasks x 1 episode.
    assert '| evaluate evaluation-full | 50 |' in text
    assert 'hours of one core at most' in text
    assert not (tmp_path / 'study').exists()


@pytest.mark.parametrize(
    ('arm', 'message'),
    [({'algorithm': 'reptil'}, 'algorithm'), ({'inner_step': 3}, "did you mean 'inner_steps'")],
)
def test_a_wrong_arm_is_refused_before_anything_runs(preset, arm, message):
    with pytest.raises(ValueError, match=message):
        study_of(preset, arms={'typo': {'meta': arm}})


def test_an_adaptation_cannot_set_steps_that_budgets_set(preset):
    with pytest.raises(ValueError, match="TTTSettings has no setting 'steps'"):
        study_of(preset, adaptations={'long': {'ttt': {'steps': 200}}})


def test_curve_must_fit_the_snapshots(preset):
    with pytest.raises(ValueError, match='multiples of its first fraction'):
        study_of(preset, curve=[0.5, 0.75])


@pytest.mark.parametrize(
    ('different', 'message'),
    [
        ({'arms': {'base': {}}}, 'base-0: two runs would go there'),
        ({'seeds': [0, 0]}, 'base-0: two runs would go there; seeds and names must differ'),
        ({'arms': {'../theirs': {}}}, 'theirs-0: names of arms and adaptations must be plain'),
        ({'adaptations': {'a/b': {}}}, 'b.json: names of arms and adaptations must be plain'),
        (
            {'arms': {'x': {'evaluate': {'episodes': 2}}}, 'adaptations': {'a': {}, 'a-x': {}}},
            'adaptations: a-x is that of a for arm x',
        ),
    ],
)
def test_runs_that_would_share_a_place_are_refused(preset, different, message):
    with pytest.raises(ValueError, match=message):
        study_of(preset, **different)


def test_names_with_points_have_presets_of_their_own(preset):
    study = study_of(preset, arms={'lr0.5': {}, 'lr0.25': {}}, seeds=[0])
    runs = [run for _, run in study.post_training]
    study.settings.out.mkdir()
    jobs = [*sweep._jobs('meta_train', runs), *sweep._jobs('evaluate', study._not_evaluated())]
    assert [job.invocation.preset.name for job in jobs] == [
        'lr0.5-0.yaml',
        'lr0.25-0.yaml',
        'evaluation-full.yaml',
        'evaluation-slow.yaml',
        'curve.yaml',
    ]
    assert [job.invocation.log.name for job in jobs[:2]] == ['lr0.5-0.log', 'lr0.25-0.log']


def test_results_of_other_policies_are_put_aside_and_evaluated_anew(preset, monkeypatch):
    study = study_of(preset)
    evaluation, _ = study.evaluations['full']
    evaluation.out.parent.mkdir()
    report = {
        'settings': evaluation.model_dump(mode='json'),
        'fingerprints': {'dataset': 'd', 'policies': ['a', 'b']},
    }
    evaluation.out.write_text(json.dumps(report))
    for policies, left in ((['a', 'b'], False), (['a', 'c'], True)):
        now = {'dataset': 'd', 'policies': policies}
        monkeypatch.setattr(sweep, 'fingerprints', lambda *_, now=now: now)
        assert (evaluation in study._to_evaluate()) == left
        assert evaluation.out.exists() != left
    outdated = evaluation.out.with_name('evaluation-full.outdated.json')
    assert json.loads(outdated.read_text()) == report
    evaluation.out.write_text(json.dumps(report))
    assert evaluation in study._to_evaluate()
    assert outdated.with_name('evaluation-full.outdated-2.json').exists()
    assert outdated.exists()


def test_a_run_that_fails_ends_the_study_with_its_message(preset, capsys):
    values = yaml.safe_load(preset.read_text())
    values['pretrain']['dataset'] = 'missing.npz'
    preset.write_text(yaml.safe_dump(values))
    with pytest.raises(SystemExit, match='2'):
        sweep.main(['--preset', str(preset)])
    assert 'missing.npz: no such file' in capsys.readouterr().err


def test_a_study_out_of_time_asks_to_be_queued_again(preset, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        sweep.main(['--preset', str(preset), '--time-limit', '1e-9'])
    assert ended.value.code == 75
    assert 'run the same command to continue' in capsys.readouterr().err
    assert not (tmp_path / 'study' / 'evaluation-full.json').exists()


def test_an_evaluation_is_done_once_it_is_there_with_the_same_settings(preset):
    evaluation, _ = study_of(preset).evaluations['full']
    assert not is_evaluated(evaluation)
    evaluation.out.parent.mkdir()
    elsewhere = evaluation.model_copy(update={'processes': 7})
    evaluation.out.write_text(json.dumps({'settings': elsewhere.model_dump(mode='json')}))
    assert is_evaluated(evaluation)
    assert not is_evaluated(evaluation.model_copy(update={'episodes': 2}))


@pytest.mark.mujoco
@pytest.mark.slow
def test_interrupted_study_goes_on_and_evaluates_every_policy(preset, tmp_path, monkeypatch):
    values = yaml.safe_load(preset.read_text())
    values['sweep'] |= {'seeds': [0], 'adaptations': {'ttt': {}}, 'curve': [], 'processes': 1}
    del values['sweep']['arms']['one-step']
    preset.write_text(yaml.safe_dump(values))
    study = tmp_path / 'study'
    command = [sys.executable, '-m', 'metagcttt_tools', 'sweep', '--preset', str(preset)]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not (study / 'base-0' / 'checkpoint').exists():
        assert process.poll() is None, f'ended with status {process.returncode}'
        assert time.monotonic() < deadline, 'no checkpoint within two minutes'
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(60) == 130
    assert not (study / 'evaluation-ttt.json').exists()

    monkeypatch.chdir(ROOT)
    sweep.main(['--preset', str(preset)])
    results = json.loads((study / 'evaluation-ttt.json').read_text())['results']
    evaluated = [Path(result['checkpoint']).parent.name for result in results]
    assert evaluated == ['base-0', 'reptile-0']
    assert [point['budget'] for point in results[1]['curve']] == [0, 1]
