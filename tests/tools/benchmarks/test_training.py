"""The benchmark of training: what it times is the step and the products of that step."""

import json

from metagcttt_core import make_agent
from metagcttt_tools.benchmarks.training import (
    LEARNERS,
    median_ms,
    products_of,
    random_batch,
    TrainingBenchmark,
    update_of,
)
import pytest
from tests.core.builders import assert_changed, weights_of
from tests.tools.tables import squeezed


def shapes_of(name, batch_size, **settings):
    agent = make_agent(name, obs_dim=3, act_dim=2, hidden=(7, 5), **settings)
    batch = random_batch(agent, batch_size)
    products = products_of(update_of(agent, batch, 'float32', compiled=False))
    return [(*first.shape, second.shape[1]) for first, second in products]


def test_products_of_cloning_are_those_of_the_layers_forward_and_backward():
    forward = [(11, 6, 7), (11, 7, 5), (11, 5, 2)]
    inputs = [(11, 2, 5), (11, 5, 7)]  # the first layer's input needs no gradient
    shapes = shapes_of('gcbc', 11)
    assert shapes[:3] == forward
    # A weight's gradient, out by in, or its transpose.
    weights = sorted((*sorted((m, n)), k) for m, k, n in shapes if k == 11)
    assert weights == [(2, 5, 11), (5, 7, 11), (6, 7, 11)]
    assert sorted(shapes[3:]) == sorted(inputs + [shape for shape in shapes if shape[1] == 11])


@pytest.mark.parametrize(
    ('actor_loss', 'products'),
    # Three layers: 3 products forward, 5 backward (3 + 2 without the input's). Value 8 and
    # 3 for V(s'); targets 3 each; critics 8 each; actor 8. ddpgbc: 3 + 3 for each critic, to the
    # action; awr: 3 for each critic and for V.
    [('bc', 41), ('ddpgbc', 41 + 12), ('awr', 41 + 9)],
)
def test_no_product_of_gciql_is_computed_in_vain(actor_loss, products):
    assert len(shapes_of('gciql', 11, actor_loss=actor_loss)) == products


@pytest.mark.parametrize('learner', LEARNERS, ids=str)
def test_update_is_a_training_step(learner):
    agent = make_agent(learner.agent, obs_dim=2, act_dim=2, hidden=(6,), **learner.settings)
    before = weights_of(agent)
    update_of(agent, random_batch(agent, 8), 'float32', compiled=False)()
    assert_changed(agent, before)


def test_ways_take_turns_and_the_median_is_told():
    calls = []
    times = median_ms({'a': lambda: calls.append('a'), 'b': lambda: calls.append('b')}, 5)
    assert calls == ['a'] * 3 + ['b'] * 3 + ['a', 'b'] * 5
    assert times.keys() == {'a', 'b'}


def test_report_holds_every_agent_size_and_precision(tmp_path, capsys):
    out = tmp_path / 'training.json'
    TrainingBenchmark(
        out=out, sizes=((8, 2, 16), (4, 2, 16)), threads=(1,), compiled=False, repeats=3
    ).run()
    report = json.loads(out.read_text())
    rows = report['results']['updates']
    assert len(rows) == 2 * 5 * 2
    assert {row['hidden'] for row in rows} == {'8 x 2', '4 x 2'}
    for row in rows:
        assert row['update / products'] == row['update'] / row['products']
    table = squeezed(capsys.readouterr().out)
    assert '| gciql ddpgbc | 8 x 2 | 16 | 1 | bfloat16 |' in table
