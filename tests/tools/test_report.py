"""Tables and figures of studies, from results written by hand."""

import json

from metagcttt_tools import report
from metagcttt_tools.common.differences import differences, paired_difference
from metagcttt_tools.common.manifest import Evaluation, Manifest, Policy
from metagcttt_tools.report import format_report, read_study
import pytest
from tests.tools.tables import squeezed

RATES = {
    'base-0': [0.2, 0.6, 0.8],
    'base-1': [0.4, 0.8, 1.0],
    'reptile-0': [0.8, 0.9, 1.0],
    'reptile-1': [0.6, 0.9, 1.0],
    'fomaml-k1-0': [0.0, 0.8, 0.8],
}


def policies(runs, fraction=1.0):
    """The policies of runs called ARM-SEED."""
    found = []
    for run in runs:
        arm, seed = run.rsplit('-', 1)
        share = 0 if arm == 'base' else fraction
        found.append(Policy(checkpoint=f'out/{run}', arm=arm, seed=seed, fraction=share))
    return found


def results(rates, budgets):
    return [
        {
            'checkpoint': f'out/{run}',
            'curve': [{'budget': b, 'success': s} for b, s in zip(budgets, row, strict=True)],
        }
        for run, row in rates.items()
    ]


@pytest.fixture
def study(tmp_path):
    settings = {'base': 'some-preset', 'out': 'out/study'}
    evaluation = {'results': results(RATES, [0, 10, 20])}
    (tmp_path / 'evaluation-ttt.json').write_text(json.dumps(evaluation))
    half = {'reptile-0': [0.5, 0.7], 'reptile-1': [0.3, 0.9]}
    curve = {'results': results(half, [0, 20])}
    (tmp_path / 'curve.json').write_text(json.dumps(curve))
    trained = Evaluation(file='evaluation-ttt.json', policies=policies(RATES))
    along = Evaluation(file='curve.json', policies=policies(half, fraction=0.5))
    Manifest(settings=settings, adaptations={'ttt': trained}, curve=along).write(tmp_path)
    return tmp_path


def test_means_errors_auc_and_efficiency_by_hand(study):
    arms = read_study(study)['adaptations']['ttt']
    base, reptile, single = arms['base'], arms['reptile'], arms['fomaml-k1']
    assert base['success'] == pytest.approx([0.3, 0.7, 0.9])
    # The population standard deviation of (0.2, 0.4) is 0.1; over the square root of two.
    assert base['standard_error'] == pytest.approx([0.1 / 2**0.5] * 3)
    # Seed 0: (0.2 + 0.6) / 2 x 10 + (0.6 + 0.8) / 2 x 10 = 11 of 20; seed 1: 15 of 20.
    assert base['auc_per_seed'] == pytest.approx([0.55, 0.75])
    assert base['auc'] == pytest.approx(0.65)
    assert base['auc_error'] == pytest.approx(0.1 / 2**0.5)
    assert base['efficiency'] == 1  # itself
    assert reptile['efficiency'] == 2  # 20 steps against 10
    assert single['seeds'] == [0]
    assert single['standard_error'] == [0, 0, 0]
    assert single['efficiency'] == 2  # the base policy of seed 0 needs 20 steps


def test_an_arm_that_needs_no_step_says_so_in_words(study):
    arms = read_study(study, threshold=0.7)['adaptations']['ttt']
    assert arms['reptile']['efficiency'] == 'no step needed'
    assert json.loads(json.dumps(arms, allow_nan=False)) == arms


def test_curve_goes_from_the_base_policy_to_the_post_trained_one(study):
    points = read_study(study)['curve']['reptile']
    assert list(points) == [0.0, 0.5, 1.0]
    assert points[0.0]['success'] == pytest.approx([0.3, 0.9])
    assert points[0.5]['success'] == pytest.approx([0.4, 0.8])
    assert points[1.0]['success'] == pytest.approx([0.7, 1.0])


def test_paired_difference_by_hand():
    # Differences .5 and .1: mean .3, standard error .2; t of one degree of freedom is 12.7062.
    difference = paired_difference([0.2, 0.4], [0.7, 0.5])
    assert difference.mean == pytest.approx(0.3)
    assert difference.half_width == pytest.approx(0.2 * 12.7062, rel=1e-5)
    assert str(difference) == '+0.300 ± 2.541'
    assert paired_difference([0.2], [0.1]) == (pytest.approx(-0.1), None)
    assert str(paired_difference([0.1, 0.2, 0.3], [0.4, 0.5, 0.7])) == '+0.333 ± 0.143*'


def test_each_arm_is_paired_with_the_base_policies_of_its_seeds():
    base = {'seeds': [0, 1], 'budgets': [0, 50, 200], 'per_seed': [[0.2, 0.4], [0.8, 0.6], [1, 1]]}
    arm = {'seeds': [1], 'budgets': [0, 50, 200], 'per_seed': [[0.5], [0.9], [1]]}
    found, efficiency = differences(base, arm, threshold=0.8)
    assert list(found) == ['K = 0', 'K = 50', 'K = 200', 'AUC to 50', 'AUC to 200']
    assert found['K = 0'].mean == pytest.approx(0.1)
    # To 50: .7 against .5; to 200: (35 + 142.5) / 200 against (25 + 120) / 200.
    assert found['AUC to 50'].mean == pytest.approx(0.2)
    assert found['AUC to 200'].mean == pytest.approx(32.5 / 200)
    assert efficiency == [4]


def test_interquartile_means_and_improvement_where_tasks_are_told_apart(study, capsys):
    path = study / 'evaluation-ttt.json'
    evaluation = json.loads(path.read_text())
    for result in evaluation['results']:
        for point in result['curve']:
            rate = point['success']
            point['per_task'] = {'1': 0.0, '2': rate, '3': rate, '4': 1.0}
    path.write_text(json.dumps(evaluation))
    report.main([str(study)])
    base, reptile = (read_study(study)['adaptations']['ttt'][arm] for arm in ('base', 'reptile'))
    # Two seeds and four tasks: of 0, 0, .2, .2, .4, .4, 1, 1 the middle four count.
    assert base['robust']['interquartile_mean'][0] == pytest.approx((0.3, 0.2, 0.4))
    assert 'improvement' not in base['robust']
    # Draws on tasks 1 and 4; on 2 and 3 both seeds are above both of the base.
    assert reptile['robust']['improvement'][0] == pytest.approx((0.75, 0.75, 0.75))
    text = squeezed(capsys.readouterr().out)
    assert '| base | 2 | 0.30 [0.20, 0.40] |' in text
    assert '| 0.70 [0.60, 0.80], P 0.75 [0.75, 0.75] |' in text
    assert (study / 'report-iqm.png').read_bytes().startswith(b'\x89PNG')


def test_curve_ends_at_the_evaluated_snapshot(study):
    path = study / 'manifest.json'
    manifest = json.loads(path.read_text())
    for policy in manifest['adaptations']['ttt']['policies']:
        if policy['arm'] == 'reptile':
            policy['fraction'] = 0.25
    path.write_text(json.dumps(manifest))
    points = read_study(study)['curve']['reptile']
    assert list(points) == [0.0, 0.25, 0.5]
    assert points[0.25]['success'] == pytest.approx([0.7, 1.0])


def test_tables_show_every_arm(study):
    text = squeezed(format_report(read_study(study)))
    assert '| base | 2 | 0.30 ± 0.07 | 0.70 ± 0.07 | 0.90 ± 0.07 | 0.650 ± 0.071 |' in text
    assert '| 0.550, 0.750 | 1x |' in text
    assert '| fomaml-k1 | 1 | 0.00 ± 0.00 | 0.80 ± 0.00 | 0.80 ± 0.00 |' in text
    assert '| reptile | 50% | 0.40 ± 0.07 | 0.80 ± 0.07 |' in text
    assert 'metagcttt sweep --preset some-preset' in text
    # At K = 0 +.6 and +.2: standard error .2, times 12.706.
    assert (
        '| reptile | 2 | +0.400 ± 2.541 | +0.200 ± 1.271 | +0.100 ± 1.271 | no step needed, 1x |'
        in text
    )
    assert '| fomaml-k1 | 1 | -0.200 | +0.200 | +0.000 | 2x |' in text


def test_the_tool_writes_tables_and_figures(study, tmp_path, capsys):
    out = tmp_path / 'results' / 'study'
    report.main([str(study), '--out', str(out)])
    assert out.with_suffix('.md').read_text() in capsys.readouterr().out
    assert json.loads(out.with_suffix('.json').read_text())['threshold'] == 0.8
    for name in ('study.png', 'study-curve.png'):
        assert (out.parent / name).read_bytes().startswith(b'\x89PNG')


def test_unfinished_study_names_what_is_missing(study, capsys):
    (study / 'evaluation-ttt.json').unlink()
    with pytest.raises(SystemExit, match='2'):
        report.main([str(study)])
    error = capsys.readouterr().err
    assert 'evaluation-ttt.json does not exist' in error
    assert 'metagcttt sweep' in error


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (None, 'manifest.json does not exist: run metagcttt sweep first'),
        ('{}', 'manifest.json: settings: Field required'),
        ('{"format": "other"}', "format: Input should be 'metagcttt-study'"),
        ('[1', 'manifest.json: Invalid JSON'),
    ],
)
def test_folder_without_a_manifest_is_refused(tmp_path, content, message, capsys):
    if content is not None:
        (tmp_path / 'manifest.json').write_text(content)
    with pytest.raises(SystemExit, match='2'):
        report.main([str(tmp_path)])
    assert message in capsys.readouterr().err
