"""A dataset is described in words, with the names of the contract."""

from pathlib import Path

from metagcttt_core import TrajectoryDataset
from metagcttt_tools.main import main
import numpy as np
import pytest
from tests.core.builders import DATA, terminals_of
from tests.core.robot.messages import DRIVE
from tests.tools.robots.bags import drive, write


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    rng = np.random.default_rng(0)
    observations = rng.uniform(0, 0.5, (20, 4))
    observations[:, 1] = 3.0
    actions = rng.uniform(-0.5, 0.5, (20, 2))
    actions[:5, 0] = 1.0
    data = TrajectoryDataset.from_arrays(observations, actions, terminals_of([10, 10]))
    data.save(tmp_path / 'cart.npz')
    (tmp_path / 'cart.yaml').write_text(DRIVE)
    return str(tmp_path / 'cart.npz'), str(tmp_path / 'cart.yaml')


def test_findings_are_in_words(files, tmp_path, capsys):
    data, contract = files
    picture = tmp_path / 'coverage.png'
    main(['inspect', data, '--contract', contract, '--out', str(picture)])
    text = capsys.readouterr().out
    assert '2 trajectories of 9 to 9 transitions (median 9)' in text
    assert 'y never changes' in text
    assert 'linear.x is at a limit in 28% of the transitions' in text
    assert 'yaw.cos' in text
    assert picture.stat().st_size > 1000


def test_columns_have_numbers_without_a_contract(files, tmp_path, capsys):
    main(['inspect', files[0], '--out', str(tmp_path / 'c.png')])
    assert 'observation 1 never changes' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('arguments', 'error'),
    [
        (['--coverage', '0', '4'], 'coverage must be two of the observed values 0 to 3'),
        (['--contract', 'none.yaml'], 'none.yaml: cannot be read'),
    ],
)
def test_what_does_not_fit_is_refused(files, tmp_path, capsys, arguments, error):
    with pytest.raises(SystemExit, match='2'):
        main(['inspect', files[0], '--out', str(tmp_path / 'c.png'), *arguments])
    assert error in capsys.readouterr().err


def inspected(tmp_path: Path, data: Path, *more: str) -> None:
    main(['inspect', str(data), '--out', str(tmp_path / 'c.png'), *more])


def test_bags_are_inspected_by_their_contract(files, tmp_path, capsys):
    bag = write(tmp_path / 'bag', drive(30))
    inspected(tmp_path, bag, '--contract', files[1])
    text = capsys.readouterr().out
    assert ['odom', '30', '10.0', '0'] in [line.split() for line in text.splitlines()]
    assert '1 trajectories of 29 to 29 transitions' in text
    out = str(tmp_path / 'imported.npz')
    main(['import-bags', '--contract', files[1], '--bags', str(bag), '--out', out])
    inspected(tmp_path, Path(out), '--contract', files[1])
    assert '10 Hz by the contract; a gap ends a trajectory' in capsys.readouterr().out
    with pytest.raises(SystemExit, match='2'):
        inspected(tmp_path, bag)
    assert 'a bag takes a contract: give --contract' in capsys.readouterr().err
    short = write(tmp_path / 'short', drive(30)[::2])
    with pytest.raises(SystemExit, match='2'):
        inspected(tmp_path, short, '--contract', files[1])
    assert 'cmd_vel: not in the bag' in capsys.readouterr().err


def test_tables_are_inspected_by_their_column_map(tmp_path, capsys):
    table, columns = tmp_path / 'drive.csv', tmp_path / 'columns.yaml'
    table.write_text('t,x,v\n0,1,5\n0.5,2,5\n1,3,7\n3,4,9\n')
    columns.write_text('{observations: [x, v], actions: [v], time: t, cut: {file: true}}')
    inspected(tmp_path, table, '--columns', str(columns))
    text = capsys.readouterr().out
    assert '2 Hz; 98 % of the steps take 0.5 to 1.97 s; 1 gaps, the longest of 2 s after' in text
    assert 'v: 5 to 9 became -1 to 1' in text
    with pytest.raises(SystemExit, match='2'):
        inspected(tmp_path, table)
    assert 'a table takes a column map: give --columns' in capsys.readouterr().err


def test_lerobot_folders_are_inspected_as_they_are(tmp_path, capsys):
    inspected(tmp_path, DATA / 'lerobot_pusht')
    text = capsys.readouterr().out
    assert '3 trajectories of 4 to 8 transitions (median 6)' in text
    assert '10 Hz; 98 % of the steps take 0.1 to 0.1 s; no gaps' in text
    (tmp_path / 'columns.yaml').write_text('{observations: [action, action], actions: [action]}')
    inspected(tmp_path, DATA / 'lerobot_pusht', '--columns', str(tmp_path / 'columns.yaml'))
    assert 'motor_1 has the values of motor_1' in capsys.readouterr().out
