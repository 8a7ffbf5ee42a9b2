import json
from pathlib import Path

from metagcttt_tools.benchmarks import audience, ros
from metagcttt_tools.benchmarks.state_source import Answers
from metagcttt_tools.main import main
import numpy as np
import pytest
from tests.tools.tables import squeezed

pytestmark = pytest.mark.ros


def test_latency_and_missed_deadlines_by_hand() -> None:
    answers = Answers(
        sent={1: 0.00, 2: 0.02, 3: 0.04, 4: 0.06}, first={1: 0.005, 2: 0.05, 4: 0.065}
    )
    np.testing.assert_allclose(answers.latencies_ms(), [5.0, 30.0, 5.0])
    assert answers.missed(0.02) == 2, 'the late one and the one that never came'


@pytest.mark.slow
def test_benchmark_measures_a_policy_process(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(ros, '_AUDIENCE_ARRIVES_S', 1.0)
    out = tmp_path / 'bench'
    main(
        [
            *('benchmark', 'ros'),
            *('--out', str(out), '--duration-s', '2', '--idle-s', '1', '--goal-every-s', '0.5'),
            *('--hidden', '16', '16', '--steps', '1', '5', '--repeats', '2'),
            *('--stepping', 'lockstep', '--audience', 'reader'),
        ]
    )
    report = json.loads((out / 'ros.json').read_text())
    idle, adapting, watched = report['results']['latency']
    names = [row['policy'] for row in (idle, adapting, watched)]
    assert names == ['idle', 'adapting', 'adapting, reader']
    assert min(adapting['states'], watched['states']) > 50
    assert 0 < idle['median'] <= idle['p99'] <= idle['maximum']
    costs = report['results']['goal_to_action']
    assert [cost['K'] for cost in costs] == [1, 5]
    for cost in costs:
        assert cost['async: first action'] <= cost['async: first adapted']
        # In hold there is no action before the expert's.
        assert cost['hold: first action'] == cost['hold: first adapted']
    assert report['settings']['hidden'] == [16, 16]
    printed = squeezed(capsys.readouterr().out)
    assert '| adapting |' in printed
    assert '| K |' in printed


def test_browser_that_is_not_there_is_named(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv('PATH', str(tmp_path))
    with (
        pytest.raises(FileNotFoundError, match='chromium'),
        audience.watching('browser', tmp_path),
    ):
        pass


def test_wrong_setting_is_refused(capsys) -> None:
    with pytest.raises(SystemExit):
        main(['benchmark', 'ros', '--stepping', 'fast'])
    assert 'realtime' in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.mujoco
def test_benchmark_restarts_and_ends_every_node(tmp_path: Path, capsys) -> None:
    main(['benchmark', 'restarts', '--out', str(tmp_path), '--repeats', '1'])
    rows = json.loads((tmp_path / 'restarts.json').read_text())['results']['seconds']
    assert [row['node'] for row in rows] == ['sim_bridge_node', 'goal_node', 'policy_node']
    for row in rows:
        assert 0 < row['restart (s)'] == row['longest']
        assert 0 < row['end (s)'] == row['longest end']
    assert '| policy_node |' in squeezed(capsys.readouterr().out)
