"""The benchmark of meta-post-training runs, and its parts are the whole."""

import json

from metagcttt_core import MetaConfig
from metagcttt_core.config import assets_dir
from metagcttt_tools.benchmarks.meta import MetaBenchmark
import pytest
from tests.tools.tables import squeezed
import torch


@pytest.fixture(autouse=True)
def threads():
    count = torch.get_num_threads()
    yield
    torch.set_num_threads(count)


def test_parts_add_up_and_every_way_is_measured(tmp_path, capsys):
    meta = MetaConfig(outer_steps=2, inner_steps=2, batch_size=8)
    out = tmp_path / 'meta.json'
    dataset = assets_dir() / 'pointmaze-medium-navigate' / 'dataset.npz'
    benchmark = MetaBenchmark(
        dataset=dataset, out=out, hidden=(8,), meta=meta, rounds=1, tasks=(2,)
    )
    benchmark.run()
    results = json.loads(out.read_text())['results']
    shares = {part['part']: part['ms'] for part in results['parts']}
    assert list(shares) == [
        'filter',
        'task',
        'batches',
        'inner steps',
        'test losses',
        'update',
        'rest',
    ]
    assert all(milliseconds > 0 for milliseconds in shares.values())
    assert results['outer_step']['ms'] == pytest.approx(
        1e3 / results['outer_step']['outer steps per second']
    )
    assert {row['tasks'] for row in results['meta_batches']} == {2}
    table = squeezed(capsys.readouterr().out)
    assert '| inner steps |' in table
    assert 'times faster' in table
