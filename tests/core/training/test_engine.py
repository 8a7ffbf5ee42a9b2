"""Every engine equals the eager one over K steps, and gives way to it where it must."""

import copy

from metagcttt_core import adapt, kernels
from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_core.agents import GCBC
from metagcttt_core.training.engine import make_engine
from metagcttt_core.training.optimizers import make_optimizer
import numpy as np
import pytest
from tests.core.adaptation.test_adapt import GOAL, quick, support_of
from tests.core.adaptation.test_inner_loop import batches_for
from tests.core.agents.test_analytic import LEARNERS
from tests.core.builders import assert_bit_equal, random_dataset, tiny_agent, weights_of
import torch

STEPS = 10


def largest_difference(first, second) -> float:
    return max(
        (a - b).abs().max().item()
        for a, b in zip(first.agent.parameters(), second.agent.parameters(), strict=True)
    )


ENGINES = pytest.mark.parametrize('engine', ['kernels', 'analytic'])


@ENGINES
@LEARNERS
@pytest.mark.parametrize('actor_only', [False, True])
@pytest.mark.parametrize('early_stopping', [False, True])
@pytest.mark.parametrize(('optimizer', 'lr'), [('adam', 1e-3), ('sgd', 0.02)])
def test_steps_equal_the_eager_engine_s(
    name, settings, actor_only, early_stopping, optimizer, lr, engine
):
    base = tiny_agent(name, hidden=(40, 32), **settings)
    weights = weights_of(base)
    batches = batches_for(base, STEPS, size=32)
    shared = {'lr': lr, 'optimizer': optimizer, 'actor_only': actor_only}
    if early_stopping:
        (shared['test_batch'],) = batches_for(base, 1, size=20, seed=9)
    eager = run_inner_loop(base, batches, **shared)
    result = run_inner_loop(base, batches, engine=engine, **shared)
    assert_bit_equal(base, weights)
    assert largest_difference(result, eager) < 0.02 * lr * STEPS
    np.testing.assert_allclose(result.train_losses, eager.train_losses, rtol=1e-4)
    np.testing.assert_allclose(result.test_losses, eager.test_losses, rtol=1e-4)
    assert result.best_step == eager.best_step > 0
    assert all(weight.grad is None for weight in result.agent.parameters())


@LEARNERS
@pytest.mark.parametrize('actor_only', [False, True])
@pytest.mark.parametrize('engine', ['kernels', 'analytic', 'eager'])
def test_products_in_bfloat16_follow_float32(name, settings, actor_only, engine):
    base = tiny_agent(name, hidden=(40, 32), **settings)
    batches = batches_for(base, STEPS, size=32)
    shared = {'lr': 1e-3, 'actor_only': actor_only, 'engine': engine}
    exact = run_inner_loop(base, batches, **shared)
    rounded = run_inner_loop(base, batches, precision='bfloat16', **shared)
    np.testing.assert_allclose(rounded.train_losses, exact.train_losses, rtol=0.05)
    assert rounded.train_losses != exact.train_losses
    assert all(weight.dtype == torch.float32 for weight in rounded.agent.parameters())


@pytest.mark.parametrize('early_stopping', [False, True])
@pytest.mark.parametrize('name', ['gcbc', 'gciql', 'saw'])
def test_adapt_draws_the_same_batches_for_both(name, early_stopping):
    dataset, agent = random_dataset([30, 30]), tiny_agent(name)
    results = [
        adapt(
            agent,
            dataset,
            support_of(range(40)),
            GOAL,
            quick(engine=engine, early_stopping=early_stopping, lr=1e-3),
            seed=5,
        )
        for engine in ('auto', 'eager')
    ]
    assert results[0].best_step == results[1].best_step
    np.testing.assert_allclose(results[0].train_losses, results[1].train_losses, rtol=1e-4)
    np.testing.assert_allclose(results[0].test_losses, results[1].test_losses, rtol=1e-4)
    assert largest_difference(*results) < 1e-4


def engine_of(agent, name='auto'):
    parameters = list(agent.trained_parameters())
    return make_engine(name, agent, make_optimizer('adam', parameters, 0.1), parameters).name


def test_agents_without_a_loss_written_out_run_eagerly():
    class Other(GCBC):
        pass

    for name in ('kernels', 'analytic', 'eager'):
        assert engine_of(tiny_agent(), name) == name
    assert engine_of(tiny_agent()) == 'kernels'
    assert engine_of(tiny_agent(const_std=False)) == 'eager'
    other = tiny_agent()
    other.__class__ = Other
    assert engine_of(other) == 'eager'
    with pytest.raises(ValueError, match='engine kernels: agent gcbc has no loss written out'):
        engine_of(other, 'kernels')


@pytest.mark.parametrize('engine', ['kernels', 'analytic'])
def test_steps_begin_with_the_moments_of_pre_training(engine):
    base = tiny_agent()
    batches = batches_for(base, STEPS, size=32)
    parameters = list(base.clone().trained_parameters())
    pretraining = make_optimizer('adam', parameters, 1e-3)
    for parameter in parameters:
        parameter.grad = torch.full_like(parameter, 0.5)
    for _ in range(3):
        pretraining.step()
    state = pretraining.state_dict()['state']
    before = copy.deepcopy(state)
    eager, result = (
        run_inner_loop(base, batches, lr=1e-3, optimizer_state=state, engine=name)
        for name in ('eager', engine)
    )
    assert largest_difference(result, eager) < 1e-5
    torch.testing.assert_close(state, before, rtol=0, atol=0)


@pytest.fixture
def cache_folder(tmp_path, monkeypatch):
    """An empty cache of compiled kernels, which nothing has looked for yet."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    kernels._find.cache_clear()
    yield tmp_path / 'metagcttt'
    kernels._find.cache_clear()


def test_a_machine_without_a_compiler_takes_tensor_operations(cache_folder, monkeypatch):
    monkeypatch.setenv('PATH', str(cache_folder))
    assert engine_of(tiny_agent()) == 'analytic'
    with pytest.raises(ValueError, match=r'engine kernels: no C compiler \(cc, gcc, clang\)'):
        engine_of(tiny_agent(), 'kernels')


@pytest.mark.parametrize(
    ('compiler', 'reason'),
    [('false', 'exit status 1'), ('no-such-compiler', 'No such file'), ('true', 'No such file')],
)
def test_a_compiler_that_fails_is_named_and_asked_once(
    cache_folder, compiler, reason, monkeypatch
):
    monkeypatch.setenv('CC', compiler)
    assert engine_of(tiny_agent()) == 'analytic'
    with pytest.raises(kernels.KernelsUnavailable, match=f'{compiler}: .*{reason}'):
        kernels.load_kernels()


def test_a_library_is_compiled_once_and_again_when_it_is_damaged(cache_folder, monkeypatch):
    kernels.load_kernels()
    (library,) = cache_folder.iterdir()
    content = library.read_bytes()
    compiled = []
    compile_now = kernels._compiled
    monkeypatch.setattr(kernels, '_compiled', lambda *a: compiled.append(a) or compile_now(*a))
    for damage in (None, b'', content[: len(content) // 2], b'\0' * len(content)):
        if damage is not None:
            library.unlink()  # a library that is loaded must not change
            library.write_bytes(damage)
        (cache_folder / f'.{library.name}.killed').write_bytes(content[:100])
        compiled.clear()
        kernels._find.cache_clear()
        assert engine_of(tiny_agent()) == 'kernels'
        assert len(compiled) == (damage is not None)
        assert library.read_bytes() == content


def test_a_cache_that_cannot_be_written_is_done_without(cache_folder):
    cache_folder.touch()  # no folder: root may write everywhere
    assert engine_of(tiny_agent()) == 'kernels'
    assert cache_folder.is_file()
