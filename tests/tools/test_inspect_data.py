"""A dataset is described in words, with the names of the contract."""

from pathlib import Path

from metagcttt_core import TrajectoryDataset
from metagcttt_tools.main import main
import numpy as np
import pytest
from tests.core.builders import terminals_of
from tests.core.robot.messages import DRIVE


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
