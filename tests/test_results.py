"""The evidence: what paper.yaml and the pages state agrees with the results and the presets."""

import json
from pathlib import Path
import re

from metagcttt_tools import report
from metagcttt_tools.common.differences import differences, paired_difference
from metagcttt_tools.common.evidence import format_evidence, read_evidence
from metagcttt_tools.common.presets import load_preset
from metagcttt_tools.common.resume import flat
from metagcttt_tools.evaluate_offline import correlation, read_success
import pytest
import yaml

from tests.tools.tables import squeezed

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / 'docs' / 'results'
EVIDENCE = read_evidence(RESULTS / 'paper.yaml')
WITH_RESULTS = [artefact for artefact in EVIDENCE.artefacts if artefact.files]
DIFFERENCE = re.compile(r'[+-]\d\.\d{3} ± \d\.\d{3}')


def read(name):
    return json.loads((RESULTS / name).read_text())


def test_every_artefact_of_the_paper_is_listed_once():
    listed = [artefact.id for artefact in EVIDENCE.artefacts]
    paper = ['T1', 'T2', 'T3', 'T4', 'F3', 'F4', 'F5', 'F6', 'F7', 'F8', 'F9', 'D', 'E']
    assert sorted(listed) == sorted([*paper, 'B'])


@pytest.mark.parametrize('artefact', WITH_RESULTS, ids=lambda artefact: artefact.id)
def test_settings_are_those_of_the_preset(artefact):
    preset = flat(load_preset(artefact.preset))
    assert artefact.settings
    assert {name: preset[name] for name in artefact.settings} == artefact.settings


@pytest.mark.parametrize('artefact', WITH_RESULTS, ids=lambda artefact: artefact.id)
def test_results_are_of_so_many_training_seeds(artefact):
    for name in artefact.files:
        results = read(name)
        if 'adaptations' in results:
            arms = [arm for arms in results['adaptations'].values() for arm in arms.values()]
            counts = {len(arm['seeds']) for arm in arms}
        else:
            settings = results['settings']
            several = settings.get('runs') or settings.get('checkpoints')
            counts = {len(several or [settings.get('run') or settings['checkpoint']])}
        assert artefact.seeds in counts, name


def test_results_come_from_committed_code():
    """Those of old that do not are listed, and no others."""
    names = {name for artefact in WITH_RESULTS for name in artefact.files}
    names |= {path.name for path in RESULTS.glob('*-cpu.json')}
    dirty = set()
    for name in names:
        results = read(name)
        commit = results.get('commit') or results['study']['commit']
        if commit == 'unknown' or commit.endswith('-dirty'):
            dirty.add(name)
    assert dirty == set(EVIDENCE.from_dirty_trees)


@pytest.mark.parametrize('artefact', WITH_RESULTS, ids=lambda artefact: artefact.id)
def test_differences_in_claims_are_those_of_the_results(artefact):
    stated = [text for claim in artefact.claims for text in DIFFERENCE.findall(claim.evidence)]
    known = set()
    for name in artefact.files:
        results = read(name)
        for arms in results.get('adaptations', {}).values():
            for arm in arms.values():
                found, _ = differences(arms['base'], arm, results['threshold'])
                known |= {str(difference).rstrip('*') for difference in found.values()}
    if artefact.id == 'T2':
        ways = read(artefact.files[0])['adaptations']
        areas = [ways[way]['base']['auc_per_seed'] for way in ('actor-only', 'full')]
        known.add(str(paired_difference(*areas)).rstrip('*'))
    assert set(stated) <= known
    assert stated or artefact.id not in ('T2', 'F3')


def test_pages_and_tables_are_those_of_the_results(tmp_path, capsys):
    """`metagcttt report --paper` rebuilds what is committed."""
    for path in [*RESULTS.rglob('*.json'), RESULTS / 'paper.yaml']:
        copy = tmp_path / path.relative_to(RESULTS)
        copy.parent.mkdir(exist_ok=True)
        copy.write_bytes(path.read_bytes())
    report.main(['--paper', '--out', str(tmp_path)])
    page = (tmp_path / 'paper.md').read_text()
    assert page == format_evidence(EVIDENCE)
    assert page in capsys.readouterr().out
    assert page == (RESULTS / 'paper.md').read_text()
    files = {name for artefact in WITH_RESULTS for name in artefact.files}
    studies = sorted(name for name in files if 'adaptations' in read(name))
    assert len(studies) >= 4
    for name in [study.removesuffix('.json') for study in studies]:
        assert (RESULTS / f'{name}.md').read_text() == (tmp_path / f'{name}.md').read_text()
        assert (tmp_path / f'{name}.png').read_bytes().startswith(b'\x89PNG')


TABLES = [
    ('docs/results/README.md', 'pointmaze-medium-navigate-study.json', 'ttt', {
        'base': 'base', 'continual': 'CONTINUAL-TTT', 'fomaml': 'TT-FOMAML',
        'reptile': 'TT-REPTILE', 'continual-far': 'CONTINUAL-TTT, far tasks',
        'fomaml-far': 'TT-FOMAML, far tasks', 'reptile-far': 'TT-REPTILE, far tasks',
    }),
    ('docs/results/README.md', 'antmaze-medium-navigate-study.json', 'ttt', {
        'base': 'base', 'continual': 'CONTINUAL-TTT', 'fomaml': 'TT-FOMAML',
        'reptile': 'TT-REPTILE',
    }),
    *(
        ('docs/results/README.md', 'pointmaze-medium-navigate-table3.json', state, {
            'base': f'base, {label}', 'continual': f'CONTINUAL-TTT, {label}',
            'fomaml': f'TT-FOMAML, {label}', 'reptile': f'TT-REPTILE, {label}',
        })
        for state, label in (('fresh', 'fresh'), ('pretrained', 'of pre-training'))
    ),
    ('docs/results/README.md', 'pointmaze-medium-stitch-study.json', 'full', {
        'base': 'actor and critic',
    }),
    ('docs/results/README.md', 'pointmaze-medium-stitch-study.json', 'actor-only', {
        'base': 'actor alone',
    }),
]  # fmt: skip


@pytest.mark.parametrize(('document', 'name', 'adaptation', 'labels'), TABLES)
def test_tables_of_studies_in_the_documents(document, name, adaptation, labels):
    text = squeezed((ROOT / document).read_text())
    arms = read(name)['adaptations'][adaptation]
    for arm, label in labels.items():
        summary = arms[arm]
        points = zip(summary['success'], summary['standard_error'], strict=True)
        cells = [f'{mean:.2f} ± {error:.2f}' for mean, error in points]
        area = f'{summary["auc"]:.3f} ± {summary["auc_error"]:.3f}'
        assert f'| {label} | {" | ".join(cells)} | {area} |' in text


def test_table_of_early_stopping():
    text = squeezed((RESULTS / 'README.md').read_text())
    arms = read('pointmaze-medium-navigate-stopping.json')['adaptations']['ttt']
    for label, suffix in (
        *((k, k) for k in ('1', '10', '50', '200')),
        ('up to 200, stopped early', 'stop'),
        *((f'the same at {rate}', rate) for rate in ('3e-5', '3e-3')),
    ):
        found = [arms.get(f'{name}-{suffix}') for name in ('continual', 'fomaml', 'reptile')]
        cells = [f'{arm["auc"]:.3f} ± {arm["auc_error"]:.3f}' if arm else '' for arm in found]
        assert f'| {" | ".join([label, *cells])} |'.replace('  ', ' ') in text


def test_table_of_the_small_policies_in_the_readme():
    text = squeezed((ROOT / 'README.md').read_text())
    results = read('pointmaze-medium-navigate-cpu.json')['results']
    for label, result in zip(
        ('base', 'post-trained (TT-REPTILE, far tasks)'), results, strict=True
    ):
        cells = [f'{p["success"]:.2f} ± {p["standard_error"]:.2f}' for p in result['curve']]
        assert f'| {label} | {" | ".join(cells)} | {result["auc"]:.3f} |' in text


def test_table_of_both_precisions_in_the_guide():
    text = squeezed((ROOT / 'docs/guide.md').read_text())
    for precision, name in (('float32', 'cpu'), ('bfloat16', 'bfloat16')):
        report = read(f'pointmaze-medium-navigate-{name}.json')
        assert report['settings']['ttt']['precision'] == precision
        for label, result in zip(('base', 'post-trained'), report['results'], strict=True):
            adapted = [p for p in result['curve'] if p['budget'] > 0]
            cells = [f'{p["success"]:.2f} ± {p["standard_error"]:.2f}' for p in adapted]
            assert f'| {label} | {precision} | {" | ".join(cells)} |' in text


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'verdict': 'proven'}, "verdict: Input should be 'holds', 'does not hold'"),
        ({'proof': 'x'}, "Claim has no setting 'proof'"),
    ],
)
def test_malformed_evidence_is_refused(tmp_path, change, message):
    claim = {'claim': 'a', 'verdict': 'holds', 'evidence': 'b'} | change
    path = tmp_path / 'paper.yaml'
    path.write_text(yaml.safe_dump({'artefacts': [{'id': 'T1', 'claims': [claim]}]}))
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read_evidence(path)
    assert str(path) in str(caught.value)


def test_agreement_of_offline_evaluation_is_that_of_both_results():
    """The page's table and rank correlations follow from the two files."""
    offline, page = read('offline.json'), (RESULTS / 'README.md').read_text()
    found = correlation(offline['results'], read_success(RESULTS / 'offline-simulation.json'))
    assert found == offline['against']
    cells = {f'{pair["error"]:.3f}, {pair["success"]:.2f}' for pair in found['pairs']}
    assert len(found['pairs']) == found['arms'] == 24
    assert all(f'| {cell} |' in page for cell in cells)
    for stated in (found['spearman'], found['within_mean']):
        low, high = f'({stated["low"]:.2f} to {stated["high"]:.2f}', f'{stated["mean"]:.2f}'
        assert low in page and high in page
