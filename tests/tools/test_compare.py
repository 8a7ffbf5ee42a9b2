"""Evaluations in one table and picture: what is averaged, what differs, what is refused."""

import json

from matplotlib.figure import Figure
from metagcttt_tools import compare
from metagcttt_tools.common import plots
import pytest
from tests.tools.tables import squeezed

GCBC = {
    'settings': {'out': 'a.json', 'budgets': [0, 50], 'ttt': {'lr': 3e-4, 'steps': 10}},
    'results': [
        {'checkpoint': 'out/base-0/checkpoint', 'curve': [(0, 0.1), (50, 0.2)]},
        {'checkpoint': 'out/base-1/checkpoint', 'curve': [(0, 0.3), (50, 0.6)]},
        {'checkpoint': 'out/reptile-0/checkpoint', 'curve': [(0, 1.0), (50, 1.0)]},
    ],
}
SAW = {
    'settings': {'out': 'b.json', 'budgets': [0, 10], 'ttt': {'lr': 3e-5}, 'standing': False},
    'results': [{'checkpoint': 'out/base-0/checkpoint', 'curve': [(0, 0.7), (10, 0.8)]}],
}


@pytest.fixture
def write(tmp_path):
    def written(name, contents):
        results = [
            {**result, 'curve': [{'budget': k, 'success': rate} for k, rate in result['curve']]}
            for result in contents['results']
        ]
        path = tmp_path / name
        path.write_text(json.dumps({**contents, 'results': results}))
        return str(path)

    return written


@pytest.fixture
def arguments(write, tmp_path):
    files = ['GCBC', write('gcbc.json', GCBC), 'SAW', write('saw.json', SAW)]
    return ['--evaluations', *files, '--out', str(tmp_path / 'agents')]


def test_the_table_has_means_of_the_chosen_policies_and_what_differs(arguments, tmp_path, capsys):
    compare.main([*arguments, '--policies', 'base'])
    printed = squeezed(capsys.readouterr().out)
    # Standard deviations .1 and .2 over two policies: standard errors .07 and .14.
    assert '| GCBC | 2 | 0.20 ± 0.07 | | 0.40 ± 0.14 |' in printed
    assert '| SAW | 1 | 0.70 ± 0.00 | 0.80 ± 0.00 | |' in printed
    differs = printed.partition('They differ in:')[2]
    assert '| ttt.lr | 0.0003 | 3e-05 |' in differs
    assert not any(name in differs for name in ('ttt.steps', 'standing', 'budgets', '| out'))
    lines = json.loads((tmp_path / 'agents.json').read_text())['results']['lines']
    assert lines['GCBC']['per_policy'] == [[0.1, 0.3], [0.2, 0.6]]
    assert (tmp_path / 'agents.png').read_bytes().startswith(b'\x89PNG')


def test_each_line_has_its_budgets_on_one_axis(arguments, monkeypatch):
    seen = []
    monkeypatch.setattr(plots, 'save', lambda figure, path: seen.append(figure))
    compare.main(arguments)
    (figure,) = seen
    assert isinstance(figure, Figure)
    (axes,) = figure.axes
    gcbc, saw = axes.lines
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ['0', '10', '50']
    assert (list(gcbc.get_xdata()), list(saw.get_xdata())) == ([0, 2], [0, 1])


@pytest.mark.parametrize(
    ('change', 'flags', 'message'),
    [
        ({'results': []}, [], "no policy has '' in its path: the file has none"),
        (
            {},
            ['--policies', 'fomaml'],
            "no policy has 'fomaml' in its path: out/base-0/checkpoint",
        ),
        (
            {'results': [*GCBC['results'], {'checkpoint': 'short', 'curve': [(0, 1.0)]}]},
            [],
            'short has the budgets [0], out/base-0/checkpoint [0, 50]',
        ),
        ({'results': [{'checkpoint': 'a', 'curve': [(0, 1.5)]}]}, [], 'less than or equal to 1'),
    ],
)
def test_what_cannot_be_compared_is_refused(write, capsys, change, flags, message):
    path = write('changed.json', {**GCBC, **change})
    with pytest.raises(SystemExit, match='2'):
        compare.main(['--evaluations', 'GCBC', path, *flags])
    assert message in capsys.readouterr().err


def test_without_evaluations_it_says_how_to_name_them(capsys):
    with pytest.raises(SystemExit, match='2'):
        compare.main([])
    assert '--evaluations NAME FILE' in capsys.readouterr().err
