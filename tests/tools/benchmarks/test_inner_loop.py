"""The benchmark of the inner loop: every way is timed, and JAX takes the same steps."""

import json

from metagcttt_core import make_agent
from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_tools.benchmarks.inner_loop import _in_jax, _LR, InnerLoopBenchmark
from metagcttt_tools.benchmarks.training import random_batch
import numpy as np
import pytest


def test_report_holds_every_learner_and_way(tmp_path, capsys):
    out = tmp_path / 'inner-loop.json'
    InnerLoopBenchmark(out=out, sizes=((8, 2, 16), (4, 1, 8)), steps=2, repeats=3).run()
    rows = json.loads(out.read_text())['results']['ms_per_step']
    assert len(rows) == 5 * 2
    for row in rows:
        assert row['engine'] == 'kernels'
        assert row['eager / auto'] > 0
        assert min(row[way] for way in ('bfloat16', 'early stopping', 'products')) > 0
    assert 'auto / products' in capsys.readouterr().out
    assert out.with_suffix('.png').stat().st_size > 0


@pytest.mark.parametrize('name', ['gcbc', 'gciql'])
def test_jax_takes_the_same_steps(name):
    pytest.importorskip('jax')
    agent = make_agent(name, obs_dim=2, act_dim=2, hidden=(16, 16))
    batches = [random_batch(agent, 32)] * 5
    ours = run_inner_loop(agent, batches, lr=_LR).train_losses
    theirs = np.array(_in_jax(agent, batches)())
    share = agent.settings.alpha if name == 'gciql' else 1.0
    constant = share * np.log(2 * np.pi)  # of two actions, which JAX's loss leaves out
    np.testing.assert_allclose(theirs, np.subtract(ours, constant), rtol=1e-4)
