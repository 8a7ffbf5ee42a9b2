import json
from pathlib import Path

from metagcttt_tools.benchmarks.adapter import AdapterBenchmark
from metagcttt_tools.benchmarks.fleet_robot import Outcome
from metagcttt_tools.main import main
import pytest
from tests.tools.tables import squeezed

pytestmark = pytest.mark.ros


def test_row_by_hand() -> None:
    outcomes = [
        Outcome('expert', 0, 10.0, wait_ms=1.0, digest='a'),
        Outcome('expert', 1, 30.0, wait_ms=2.0, digest='a'),
        Outcome('refused', 0, 4.0, reason='full', unanswered=2),
        Outcome('lost', 0, 60000.0),
        Outcome('failed', 0, 5.0, reason='out of memory'),
    ]
    row = AdapterBenchmark()._row(2, 4.0, 1, outcomes, ['a', 'b'])
    assert row == {
        'robots': 2,
        'a goal every (s)': 4.0,
        'queue': 1,
        'requests': 5,
        'experts': 2,
        'refused': 1,
        'failed': 1,
        'lost': 1,
        'repeated': 2,
        'other bits': 1,
        'median (ms)': 20.0,
        'p99 (ms)': pytest.approx(29.8),
        'in the queue, p99 (ms)': pytest.approx(1.99),
        'refusal, p99 (ms)': 4.0,
    }


@pytest.mark.slow
def test_robots_of_their_own_processes_get_experts(tmp_path: Path, capsys) -> None:
    command = ['benchmark', 'adapter', '--out', str(tmp_path), '--robots', '2', '--hidden', '16']
    main([*command, '--duration-s', '1', '--goal-every-s', '0.5', '--rush-queue', '2'])
    rows = json.loads((tmp_path / 'adapter.json').read_text())['results']['stretches']
    assert [row['robots'] for row in rows] == [1, 2, 2]
    for row in rows:
        assert row['experts'] == row['requests'] > 0
        assert row['refused'] == row['lost'] == row['failed'] == row['other bits'] == 0
        assert 0 < row['median (ms)'] <= row['p99 (ms)']
    assert '| robots |' in squeezed(capsys.readouterr().out)
