"""The paper's presets against Table 3 and the pre-training settings, written out here again."""

from metagcttt_tools import show_presets as presets
from metagcttt_tools.common.cli import preset_values
from metagcttt_tools.common.paper import table3
from metagcttt_tools.common.presets import load_preset
from metagcttt_tools.evaluate import EvaluateSettings
from metagcttt_tools.generate import GenerateSettings
from metagcttt_tools.meta_train import MetaTrainSettings
from metagcttt_tools.sweep import Study, SweepSettings
import pytest
from sim_bridge.registry import environment_names
from tests.tools.tables import squeezed

# Section, algorithm, actor loss, inner LR, meta LR, inner steps, TTT LR, checkpoint, early stop.
TABLE_3 = """
pointmaze_expert    | CONTINUAL-TTT | BC      | 3e-5 | 3e-4 | 100 | 3e-4 | 30k | Yes
pointmaze_expert    | TT-FOMAML     | BC      | 3e-5 | 3e-4 | 100 | 3e-4 | 35k | Yes
pointmaze_expert    | TT-REPTILE    | BC      | 3e-5 | 0.01 | 100 | 3e-4 | 45k | Yes
antmaze_expert      | CONTINUAL-TTT | BC      | 3e-5 | 3e-4 | 100 | 3e-4 | 10k | Yes
antmaze_expert      | TT-FOMAML     | BC      | 3e-5 | 3e-4 | 100 | 3e-4 | 35k | Yes
antmaze_expert      | TT-REPTILE    | BC      | 3e-4 | 0.5  | 100 | 3e-4 | 5k  | Yes
humanoidmaze_expert | CONTINUAL-TTT | BC      | 3e-5 | 3e-4 | 100 | 3e-5 | 25k | Yes
humanoidmaze_expert | TT-FOMAML     | BC      | 3e-5 | 3e-4 | 100 | 3e-4 | 40k | Yes
humanoidmaze_expert | TT-REPTILE    | BC      | 3e-5 | 0.5  | 100 | 3e-5 | 50k | Yes
pointmaze_stitch    | CONTINUAL-TTT | BC      | 3e-3 | 3e-4 | 200 | 3e-3 | 30k | Yes
pointmaze_stitch    | TT-FOMAML     | BC      | 3e-3 | 3e-4 | 1   | 3e-3 | 5k  | No
pointmaze_stitch    | TT-REPTILE    | BC      | 3e-3 | 1e-4 | 10  | 3e-3 | 40k | No
pointmaze_stitch    | CONTINUAL-TTT | DDPG-BC | 5e-3 | 3e-4 | 50  | 5e-3 | 35k | No
pointmaze_stitch    | TT-FOMAML     | DDPG-BC | 5e-3 | 3e-4 | 10  | 5e-3 | 5k  | No
pointmaze_stitch    | TT-REPTILE    | DDPG-BC | 5e-3 | 0.1  | 1   | 5e-3 | 20k | No
antmaze_stitch      | CONTINUAL-TTT | DDPG-BC | 3e-5 | 3e-4 | 100 | 1e-3 | 25k | Yes
antmaze_stitch      | TT-FOMAML     | DDPG-BC | 3e-5 | 3e-4 | 100 | 1e-3 | 15k | Yes
antmaze_stitch      | TT-REPTILE    | DDPG-BC | 3e-5 | 0.1  | 100 | 1e-3 | 5k  | Yes
humanoidmaze_stitch | CONTINUAL-TTT | DDPG-BC | 3e-4 | 3e-4 | 20  | 3e-4 | 10k | No
humanoidmaze_stitch | TT-FOMAML     | DDPG-BC | 3e-4 | 3e-4 | 1   | 3e-4 | 50k | No
humanoidmaze_stitch | TT-REPTILE    | DDPG-BC | 3e-4 | 0.1  | 200 | 3e-4 | 10k | Yes
"""
PRETRAINING = """
pointmaze-medium-navigate-v0    | gcbc  |       | 0.99  | 0
antmaze-medium-navigate-v0      | gcbc  |       | 0.99  | 0
humanoidmaze-medium-navigate-v0 | gcbc  |       | 0.99  | 0
pointmaze-medium-stitch-v0      | gciql | 0.003 | 0.99  | 0.5
antmaze-medium-stitch-v0        | gciql | 0.3   | 0.99  | 0.5
humanoidmaze-medium-stitch-v0   | gciql | 0.1   | 0.995 | 0.5
"""
ALGORITHMS = {'CONTINUAL-TTT': 'continual', 'TT-FOMAML': 'fomaml', 'TT-REPTILE': 'reptile'}


def cells(table):
    return [[cell.strip() for cell in line.split('|')] for line in table.strip().splitlines()]


def published_rows():
    for section, algorithm, loss, inner, meta, steps, ttt, checkpoint, early in cells(TABLE_3):
        maze, data = section.split('_')
        data = {'expert': 'navigate', 'stitch': 'stitch'}[data]
        loss = {'BC': 'bc', 'DDPG-BC': 'ddpgbc'}[loss]
        yield {
            'preset': f'paper-{maze}-{data}-{loss}-{ALGORITHMS[algorithm]}',
            'actor loss': loss,
            'inner lr': float(inner),
            'meta lr': float(meta),
            'inner steps': int(steps),
            'ttt lr': float(ttt),
            'checkpoint': 1000 * int(checkpoint.removesuffix('k')),
            'of outer steps': 50_000,
            'early stop': early.lower(),
            'horizon': 100 if data == 'stitch' else 'episode',
        }


def test_post_training_settings_are_those_of_table_3():
    shown = [
        {key: float(value) if key.endswith(' lr') else value for key, value in row.items()}
        for row in presets.table3_rows()
    ]
    assert shown == list(published_rows())


def test_pretraining_settings_are_the_paper_s():
    rows = [list(row.values()) for row in presets.pretraining_rows()]
    assert [row[:5] for row in rows] == cells(PRETRAINING)
    assert all(row[5:] == ['512 512 512', 1024, '0.0003', 400_000] for row in rows)


def test_tables_are_printed(capsys):
    presets.main([])
    printed = squeezed(capsys.readouterr().out)
    assert (
        '| paper-antmaze-navigate-bc-reptile | bc | 0.0003 | 0.5 | 100 | 0.0003 | 5,000 | 50,000 '
        '| yes | episode |'
    ) in printed
    assert '| antmaze-medium-stitch-v0 | gciql | 0.3 | 0.99 | 0.5 | 512 512 512 |' in printed


@pytest.mark.parametrize('name', [row.name for row in table3()])
def test_tools_of_a_preset_fit_together(name):
    data = GenerateSettings.model_validate(preset_values(name, 'generate'))
    pretrain = presets.PretrainSettings.model_validate(preset_values(name, 'pretrain'))
    training = MetaTrainSettings.model_validate(preset_values(name, 'meta_train'))
    evaluation = EvaluateSettings.model_validate(preset_values(name, 'evaluate'))
    assert data.environment == pretrain.environment
    assert data.environment in environment_names()
    assert pretrain.dataset == training.dataset == evaluation.dataset
    assert training.checkpoint == pretrain.checkpoint_folder == evaluation.checkpoints[0]
    snapshot = evaluation.checkpoints[1]
    assert snapshot.parent == training.out / 'snapshots'
    assert int(snapshot.name) % training.snapshot_every == 0
    assert int(snapshot.name) <= training.meta.outer_steps
    assert training.meta.algorithm == name.split('-')[-1]
    assert training.actor_loss == evaluation.actor_loss
    assert (training.actor_loss is None) == (pretrain.agent == 'gcbc')
    assert (evaluation.ttt.batch_size, training.meta.batch_size) == (1024, 1024)
    assert evaluation.filter.variant == training.meta.filter.variant == 'gcttt'
    assert max(evaluation.budgets) == (50 if 'navigate' in name else 200)


@pytest.mark.parametrize('name', sorted({row.study for row in table3()}))
def test_study_of_a_maze_holds_its_three_rows(name):
    study = Study(SweepSettings.model_validate(load_preset(name)['sweep']))
    rows = {row.algorithm: row for row in table3() if row.study == name}
    assert [run.seed for run in study.pretraining] == [0, 1, 2]
    assert len(rows) == 3
    for arm, run in study.post_training:
        row = load_preset(rows[arm].name)
        assert run.meta == MetaTrainSettings.model_validate(row['meta_train']).meta
        assert run.checkpoint in [base.checkpoint_folder for base in study.pretraining]
    evaluated = {}
    for key, (run, policies) in study.evaluations.items():
        assert run.ttt.optimizer_state == key.split('-')[0]
        for policy in policies:
            if policy.fraction:
                evaluated[policy.arm] = (run.ttt.lr, round(50_000 * policy.fraction))
                kept = policy.checkpoint.parent.name == 'snapshots'
                assert kept == (policy.fraction < 1)
    assert evaluated == {arm: (row.ttt_lr, row.checkpoint) for arm, row in rows.items()}


def test_preset_is_the_caller_s_own():
    name = 'paper-pointmaze-navigate-bc-fomaml'
    load_preset(name)['meta_train']['meta']['algorithm'] = 'changed'
    assert load_preset(name)['meta_train']['meta']['algorithm'] == 'fomaml'


def test_misspelt_name_gets_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'paper-antmaze-stitch-ddpgbc-fomaml'"):
        load_preset('paper-antmaze-stitch-ddpg-fomaml')
