"""CSV and parquet files become datasets by a column map; what does not fit is named."""

import os
from pathlib import Path

from metagcttt_core import TrajectoryDataset
from metagcttt_tools.main import main
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

MAP = """
observations: [{column: x, origin: 500000}, y]
actions: [{column: v, low: -0.5, high: 1.5}, w]
position: [y, x]
time: t
cut: {episode: run}
"""


def table(**changes: object) -> pa.Table:
    """Two runs, of four and three rows, at 10 Hz."""
    columns = {
        't': [0.0, 0.1, 0.2, 0.3, 10.0, 10.1, 10.2],
        'run': ['a'] * 4 + ['b'] * 3,
        'x': [500000.25 + 0.001 * i for i in range(7)],
        'y': [float(i) for i in range(7)],
        'v': [-0.5, 1.5, 0.5, 0.0, 0.5, 0.5, 0.5],
        'w': [0.1 * i for i in range(7)],
    }
    return pa.table({**columns, **changes})


def write(folder: Path, content: pa.Table, suffix: str = '.csv', name: str = 'drive') -> Path:
    path = folder / f'{name}{suffix}'
    (pa.csv.write_csv if suffix == '.csv' else pq.write_table)(content, path)
    return path


def convert(folder: Path, *tables: Path, columns: str = MAP, more: tuple[str, ...] = ()):
    (folder / 'columns.yaml').write_text(columns)
    out = folder / 'out.npz'
    arguments = ['--tables', *map(str, tables), '--columns', str(folder / 'columns.yaml'), *more]
    main(['import-table', *arguments, '--out', str(out), '--overwrite'])
    return TrajectoryDataset.load(out)


def complaint(capsys: pytest.CaptureFixture, folder: Path, *tables: Path, columns=MAP) -> str:
    with pytest.raises(SystemExit, match='2'):
        convert(folder, *tables, columns=columns)
    return capsys.readouterr().err


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_rows_become_trajectories(tmp_path, capsys, suffix):
    dataset = convert(tmp_path, write(tmp_path, table(), suffix))
    assert dataset.episode_ends.tolist() == [3, 6]
    # The origin is taken off before single precision, which has steps of 0.03 at 500000.
    np.testing.assert_allclose(dataset.observations[:, 0], 0.25 + 0.001 * np.arange(7), atol=1e-7)
    np.testing.assert_allclose(dataset.actions[:4, 0], [-1, 1, 0, -0.5], atol=1e-6)
    np.testing.assert_allclose(dataset.actions[:, 1], 0.1 * np.arange(7), atol=1e-6)
    np.testing.assert_allclose(dataset.extras['time_s'][:4], [0, 0.1, 0.2, 0.3])
    text = capsys.readouterr().out
    assert 'cut where run changes, a file ends' in text
    assert 'v: -0.5 to 1.5 became -1 to 1' in text
    assert 'position is y, x: --filter.position-dims 1 0' in text


@pytest.mark.parametrize(
    ('cut', 'ends'),
    [
        ('{episode: run}', [3, 6, 10, 13]),
        ('{gap_s: 1}', [3, 6, 10, 13]),
        ('{file: true}', [6, 13]),
        ('{last: done}', [1, 6, 8, 13]),
        ('{last: done, episode: run}', [1, 3, 6, 8, 10, 13]),
    ],
)
def test_cuts_are_those_of_the_map_and_no_others(tmp_path, cut, ends):
    content = table(done=[False, True] + [False] * 5)
    files = [write(tmp_path, content, name=name) for name in ('one', 'two')]
    columns = MAP.replace('{episode: run}', cut)
    assert convert(tmp_path, *files, columns=columns).episode_ends.tolist() == ends


def test_single_rows_are_left_out_and_counted(tmp_path, capsys):
    dataset = convert(tmp_path, write(tmp_path, table(run=[0, 0, 0, 1, 2, 2, 2])))
    assert dataset.episode_ends.tolist() == [2, 5]
    assert 'left out: 1 trajectories of a single row' in capsys.readouterr().out


def test_lists_times_of_any_unit_and_limits_of_the_data(tmp_path, capsys):
    content = pa.table(
        {
            'state': [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]],
            'u': [300.0, 100.0],
            't': pa.array([10**18, 10**18 + 5 * 10**7], pa.timestamp('ns')),
        }
    )
    columns = """{observations: [{column: state, values: [2, 0]}], actions: [u], time: t,
        cut: {file: true}, position: [state.0]}"""
    more = ('--limits-from-data',)
    file = write(tmp_path, content, '.parquet')
    dataset = convert(tmp_path, file, columns=columns, more=more)
    assert dataset.observations.tolist() == [[2, 0], [5, 3]]
    assert dataset.actions.tolist() == [[1], [-1]]
    assert dataset.extras['time_s'] == pytest.approx([0, 0.05])
    assert 'u: 100 to 300 became -1 to 1' in capsys.readouterr().out
    error = complaint(capsys, tmp_path, file, columns=columns)
    assert f'{file}: u is 300 in row 0, beyond -1 to 1: give low and high' in error


def test_dataset_says_which_files_it_was_made_from(tmp_path, capsys):
    files = [write(tmp_path, table(), name=name) for name in ('one', 'two')]
    made_from = convert(tmp_path, *files).made_from
    assert made_from['program'] == 'import-table'
    columns, one, two = made_from['sources']
    assert (columns['name'], one['name'], two['name']) == ('columns.yaml', 'one.csv', 'two.csv')
    assert one['bytes'] == files[0].stat().st_size
    assert one['fingerprint'] == two['fingerprint'] != columns['fingerprint']  # equal content
    write(tmp_path, table(w=[0.5] * 7), name='two')
    again = convert(tmp_path, *files).made_from['sources']
    assert again[:2] == [columns, one]
    assert again[2]['fingerprint'] != two['fingerprint']
    main(['inspect', str(tmp_path / 'out.npz'), '--out', str(tmp_path / 'c.png')])
    assert f'made by import-table from columns.yaml ({columns["fingerprint"]}), one.csv' in (
        capsys.readouterr().out
    )


def test_commands_with_a_reach_lead_what_is_measured(tmp_path, capsys):
    lead = MAP.replace('low: -0.5, high: 1.5', 'measured: y, reach: 2')
    assert lead != MAP
    content = table(y=[9.0] * 7, v=[8.0, 9.0, 10.0, 11.0, 7.0, 9.0, 9.0])
    file = write(tmp_path, content)
    assert convert(tmp_path, file, columns=lead).actions[:4, 0].tolist() == [-0.5, 0, 0.5, 1]
    nearer = lead.replace('reach: 2', 'reach: 1')
    error = complaint(capsys, tmp_path, file, columns=nearer)
    assert 'v less its measured value is 2 in row 3, beyond -1 to 1' in error
    nobody = lead.replace('measured: y', 'measured: z')
    error = complaint(capsys, tmp_path, file, columns=nobody)
    assert 'no observed value is named z (there are: ' in error
    error = complaint(capsys, tmp_path, file, columns=lead.replace(', reach: 2', ''))
    assert 'give measured and reach, or neither' in error


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'x': [1.0, None, 3.0, 4.0, 5.0, 6.0, 7.0]}, 'x has no value in row 1'),
        ({'x': ['1', '2', 'three', '4', '5', '6', '7']}, "x must hold numbers, got 'three' in ro"),
        ({'y': [0.0, float('inf'), 0, 0, 0, 0, 0]}, 'observations is inf in row 1'),
        ({'v': [1.6, 0, 0, 0, 0, 0, 0]}, 'v is 1.6 in row 0, beyond -0.5 to 1.5'),
        ({'run': [1, 1, 2, 2, 1, 1, 1]}, 'the run of row 4 was there before'),
        ({'run': [1, 1, 2, None, 3, 3, 3]}, 'run has no value in row 3'),
        ({'t': [0.0, 0.2, 0.1, 0.3, 4, 5, 6]}, 'the time is 0.1 s in row 2, after 0.2 s'),
        ({'t': [0.0, float('nan'), 0.1, 0.3, 4, 5, 6]}, 't is nan in row 1'),
        ({'x': [[]] * 7}, 'x has no values, its lists are empty'),
        ({'run': list(range(7))}, 'no transitions, every trajectory is a single row'),
    ],
)
def test_rows_that_do_not_fit_are_named(tmp_path, capsys, changes, error):
    file = write(tmp_path, table(**changes), '.parquet')
    assert f'{file}: {error}' in complaint(capsys, tmp_path, file)


@pytest.mark.parametrize(
    ('old', 'new', 'error'),
    [
        ('cut: {episode: run}', '', 'where do trajectories end? Give cut'),
        ('{episode: run}', '{}', ':6: cut: say where trajectories are cut'),
        ('time: t\n', 'cut: {gap_s: 1}\n#', 'cut by gap_s takes a column of times'),
        ('y]\na', 'z]\na', "has no column 'z' (there are: 't', 'run', 'x', 'y', 'v', 'w')"),
        ('low: -0.5, ', '', ':3: actions.0: give low and high, or neither'),
        ('low: -0.5', 'low: 2', ':3: actions.0: low must be below high'),
        ('position: [y', 'position: [z', 'position: no observed value is named z'),
        ('time: t', 'times: t', "did you mean 'time'?"),
        ('episode: run', 'last: y', 'y must be true or false, 0 or 1, got 2 in row 2'),
        ('w]', '{column: w, values: [1]}]', 'w has no value 1; it has: w'),
    ],
)
def test_maps_that_do_not_fit_are_named(tmp_path, capsys, old, new, error):
    assert old in MAP
    file = write(tmp_path, table())
    assert error in complaint(capsys, tmp_path, file, columns=MAP.replace(old, new, 1))


def test_files_that_are_none_are_named(tmp_path, capsys):
    assert 'none.csv: no such file' in complaint(capsys, tmp_path, tmp_path / 'none.csv')
    assert 'none.parquet: no such file' in complaint(capsys, tmp_path, tmp_path / 'none.parquet')
    ragged = tmp_path / 'ragged.csv'
    ragged.write_text('t,run,x,y,v,w\n1,2\n')
    assert f'{ragged}: cannot be read as CSV' in complaint(capsys, tmp_path, ragged)
    ragged.write_text('')
    assert f'{ragged}: cannot be read as CSV' in complaint(capsys, tmp_path, ragged)
    (tmp_path / 'sheet.xlsx').touch()
    error = complaint(capsys, tmp_path, tmp_path / 'sheet.xlsx')
    assert 'sheet.xlsx: expected a .csv or a .parquet file' in error
    other = write(tmp_path, table(y=[[0.0, 1.0]] * 7), '.parquet', 'other')
    error = complaint(capsys, tmp_path, write(tmp_path, table()), other)
    assert f'{other}: has other values than' in error


def test_damage_to_parquet_is_named(tmp_path, capsys):
    file = write(tmp_path, table(), '.parquet')
    whole = file.read_bytes()
    file.write_bytes(whole[:-20])
    assert f'{file}: has no footer: its recording was inter' in complaint(capsys, tmp_path, file)
    file.write_text('version https://git-lfs.github.com/spec/v1\n')
    assert 'run git lfs pull' in complaint(capsys, tmp_path, file)
    file.write_bytes(whole[:4] + b'\xff' * (len(whole) - 12) + whole[-8:])
    assert f'{file}: is no parquet file, or damaged' in complaint(capsys, tmp_path, file)


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_column_that_is_there_twice_is_named(tmp_path, capsys, suffix):
    content = table()
    twice = content.append_column('x', content['y'])
    file = write(tmp_path, twice, suffix)
    assert f"{file}: has several columns named 'x'" in complaint(capsys, tmp_path, file)


def test_few_bytes_that_announce_more_than_memory_are_refused(tmp_path, capsys, monkeypatch):
    file = write(tmp_path, pa.table({name: [0.0] * 10**5 for name in 'txyvw'}), '.parquet')
    assert file.stat().st_size < 10_000
    monkeypatch.setattr(os, 'sysconf', lambda _: 1000)  # a machine of a megabyte
    columns = MAP.replace('episode: run', 'file: true')
    error = complaint(capsys, tmp_path, file, columns=columns)
    assert f'{file} takes 12000000 bytes of memory, this machine has 1000000' in error


def test_existing_dataset_stays(tmp_path, capsys):
    file = write(tmp_path, table())
    convert(tmp_path, file)
    with pytest.raises(SystemExit, match='2'):
        main(['import-table', '--tables', str(file), '--out', str(tmp_path / 'out.npz')])
    assert 'give --overwrite' in capsys.readouterr().err
    with pytest.raises(SystemExit, match='2'):
        main(['import-table', '--out', str(tmp_path / 'new.npz')])
    assert 'no tables were given' in capsys.readouterr().err
