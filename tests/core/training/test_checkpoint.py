"""Checkpoints: everything comes back, every fault is refused by name, crashes are harmless."""

from contextlib import contextmanager
import hashlib
from itertools import count
import json
from pathlib import Path
import threading
from typing import Any

from metagcttt_core import CheckpointError, files, load_checkpoint, save_checkpoint
from metagcttt_core.training.checkpoint import has_checkpoint, load_training_state, TrainingState
from metagcttt_core.training.optimizers import pretrained_state
import pytest
import safetensors.torch
from tests.core.builders import assert_bit_equal, EVERY_AGENT, tiny_agent, weights_of
import torch

METADATA = {'environment': 'pointmaze-medium-v0', 'history': [{'stage': 'pretrain', 'seed': 3}]}


def saved_agent(folder: Path, seed: int = 0, training: TrainingState | None = None, **settings):
    agent = tiny_agent(seed=seed, **settings)
    agent.metadata = dict(METADATA)
    save_checkpoint(agent, folder, training)
    return agent


def training_state(step: int = 7) -> TrainingState:
    moments = {
        number: {'step': torch.tensor(7.0), 'exp_avg': torch.arange(4.0) + number}
        for number in (0, 3)
    }
    return TrainingState('pretrain', step, {'lr': 0.1, 'hidden': [6]}, moments)


def change_index(folder: Path, **changes: Any) -> None:
    """Edit checkpoint.json; a value of None removes the key."""
    path = folder / 'checkpoint.json'
    values = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in values.items() if value is not None}))


def change_weights(folder: Path, change) -> None:
    """Rewrite the weights file, under a name that fits its content."""
    (path,) = folder.glob('weights-*.safetensors')
    tensors = safetensors.torch.load(path.read_bytes())
    change(tensors)
    replace_weights(folder, safetensors.torch.save(tensors))


def replace_weights(folder: Path, content: bytes) -> None:
    for old in folder.glob('weights-*.safetensors'):
        old.unlink()
    name = f'weights-{hashlib.sha256(content).hexdigest()[:16]}.safetensors'
    (folder / name).write_bytes(content)
    change_index(folder, weights=name)


@EVERY_AGENT
@pytest.mark.parametrize('const_std', [True, False])
def test_agent_comes_back_bit_equal(name, const_std, tmp_path):
    agent = tiny_agent(name, obs_dim=3, act_dim=1, const_std=const_std, discount=0.95)
    agent.metadata = METADATA
    save_checkpoint(agent, tmp_path / 'run' / 'checkpoint')
    loaded = load_checkpoint(tmp_path / 'run' / 'checkpoint')
    assert type(loaded) is type(agent)
    assert_bit_equal(loaded, weights_of(agent))
    assert loaded.settings == agent.settings
    assert (loaded.obs_dim, loaded.act_dim) == (3, 1)
    assert loaded.metadata == METADATA
    trained = [name for name, weight in agent.named_parameters() if weight.requires_grad]
    assert [name for name, weight in loaded.named_parameters() if weight.requires_grad] == trained


def test_checkpoint_is_json_and_safetensors_only(tmp_path):
    saved_agent(tmp_path, training=training_state())
    index, weights = sorted(tmp_path.iterdir())
    assert index.name == 'checkpoint.json'
    values = json.loads(index.read_text())
    assert values['format'] == 'metagcttt-checkpoint'
    assert values['version'] == 1
    assert (values['agent'], values['obs_dim'], values['act_dim']) == ('gcbc', 2, 2)
    assert values['metadata'] == METADATA
    assert values['settings']['hidden'] == [6]
    assert values['weights'] == weights.name
    tensors = safetensors.torch.load(weights.read_bytes())
    assert {name.split('.')[0] for name in tensors} == {'agent', 'optimizer'}


def test_path_of_the_index_file_loads_too(tmp_path):
    agent = saved_agent(tmp_path)
    assert_bit_equal(load_checkpoint(tmp_path / 'checkpoint.json'), weights_of(agent))


def test_saving_replaces_the_old_weights(tmp_path):
    saved_agent(tmp_path, seed=1)
    agent = saved_agent(tmp_path, seed=2)
    assert len(list(tmp_path.iterdir())) == 2
    assert_bit_equal(load_checkpoint(tmp_path), weights_of(agent))
    saved_agent(tmp_path, seed=2)
    assert_bit_equal(load_checkpoint(tmp_path), weights_of(agent))


def test_saving_leaves_the_agent_alone(tmp_path):
    agent = tiny_agent()
    weights = weights_of(agent)
    save_checkpoint(agent, tmp_path)
    loaded = load_checkpoint(tmp_path)
    with torch.no_grad():
        loaded.actor.mean.bias.add_(1)
    loaded.metadata['more'] = 1
    assert_bit_equal(agent, weights)
    assert agent.metadata == {}


def test_training_state_comes_back(tmp_path):
    state = training_state()
    saved_agent(tmp_path, training=state)
    loaded = load_training_state(tmp_path)
    assert (loaded.stage, loaded.step, loaded.settings) == ('pretrain', 7, state.settings)
    assert loaded.optimizer.keys() == {0, 3}
    for number in (0, 3):
        for key, tensor in state.optimizer[number].items():
            assert torch.equal(loaded.optimizer[number][key], tensor)
            assert loaded.optimizer[number][key].dtype == tensor.dtype


def adam_state(agent, value: float) -> dict[int, dict[str, torch.Tensor]]:
    return {
        number: {
            'step': torch.tensor(value),
            'exp_avg': torch.full_like(weight, value),
            'exp_avg_sq': torch.full_like(weight, value + 1),
        }
        for number, weight in enumerate(agent.trained_parameters())
    }


def assert_same_state(state, expected):
    assert state.keys() == expected.keys()
    for number, moments in expected.items():
        assert state[number].keys() == moments.keys()
        assert all(torch.equal(state[number][name], moments[name]) for name in moments)


@EVERY_AGENT
@pytest.mark.parametrize('stage', [None, 'pretrain', 'post_train'])
def test_optimizer_state_of_pretraining_comes_back_with_the_agent(name, stage, tmp_path):
    """Also beside the state of the outer Adam, by which a post-training run is resumed."""
    agent = tiny_agent(name)
    agent.optimizer_state = adam_state(agent, 5.0)
    outer = agent.optimizer_state if stage == 'pretrain' else adam_state(agent, 2.0)
    training = stage and TrainingState(stage, 7, {}, outer)
    save_checkpoint(agent, tmp_path, training)
    loaded = load_checkpoint(tmp_path)
    assert_same_state(loaded.optimizer_state, agent.optimizer_state)
    assert_bit_equal(loaded, weights_of(agent))
    if stage:
        assert_same_state(load_training_state(tmp_path).optimizer, outer)
    (weights,) = tmp_path.glob('*.safetensors')
    groups = {name.split('.')[0] for name in safetensors.torch.load(weights.read_bytes())}
    expected = {None: {'pretraining'}, 'pretrain': {'optimizer'}}
    assert groups == {'agent'} | expected.get(stage, {'pretraining', 'optimizer'})


def test_policy_without_optimizer_state_has_none(tmp_path):
    saved_agent(tmp_path)
    loaded = load_checkpoint(tmp_path)
    assert loaded.optimizer_state is None
    with pytest.raises(ValueError, match=rf'{tmp_path}: has no optimiser state of pre-training;'):
        pretrained_state(loaded)


def test_state_of_the_outer_adam_is_not_that_of_pretraining(tmp_path):
    agent = tiny_agent()
    save_checkpoint(agent, tmp_path, TrainingState('post_train', 3, {}, adam_state(agent, 2.0)))
    assert load_checkpoint(tmp_path).optimizer_state is None


def test_checkpoint_without_a_training_state_cannot_be_resumed(tmp_path):
    saved_agent(tmp_path)
    with pytest.raises(CheckpointError, match='saved without a training state, cannot be resumed'):
        load_training_state(tmp_path)


def test_presence(tmp_path):
    assert not has_checkpoint(tmp_path)
    assert not has_checkpoint(tmp_path / 'absent')
    saved_agent(tmp_path)
    assert has_checkpoint(tmp_path)


def test_missing_checkpoint_is_refused(tmp_path):
    (tmp_path / 'file').write_text('not a folder')
    for path in (tmp_path, tmp_path / 'absent', tmp_path / 'file'):
        message = rf'{path}: no checkpoint there \(checkpoint.json is missing\)'
        with pytest.raises(CheckpointError, match=message):
            load_checkpoint(path)


@pytest.mark.parametrize('content', [b'', b'{"format": ', b'\xff\xfe', b'{} trailing'])
def test_index_that_is_no_json_is_refused(content, tmp_path):
    saved_agent(tmp_path)
    (tmp_path / 'checkpoint.json').write_bytes(content)
    with pytest.raises(CheckpointError, match=r'checkpoint\.json: not valid JSON'):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('[]', 'must hold a JSON object, got list'),
        ('3', 'must hold a JSON object, got int'),
        ('{}', 'not a checkpoint of this proj'),
        ('{"format": "other", "version": 1}', 'not a checkpoint of this proj'),
    ],
)
def test_json_of_another_kind_is_refused(content, message, tmp_path):
    saved_agent(tmp_path)
    (tmp_path / 'checkpoint.json').write_text(content)
    with pytest.raises(CheckpointError, match=rf'checkpoint\.json: {message}'):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize('version', [0, 2, '1'])
def test_other_version_is_refused_by_number(version, tmp_path):
    saved_agent(tmp_path)
    change_index(tmp_path, version=version)
    message = f'is of format version {version!r}; this program reads version 1'
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'agent': 'dqn'}, "unknown agent 'dqn'; known: crl, gcbc, gciql, saw"),
        ({'agent': None}, 'agent: Field required'),
        ({'obs_dim': 0}, 'obs_dim: Input should be greater than or equal to 1, got 0'),
        ({'act_dim': 'two'}, "act_dim: Input should be a valid integer.*, got 'two'"),
        ({'settings': {'hidden': 5}}, 'settings: hidden: Input should be a valid tuple, got 5'),
        ({'settings': {'hidden': [-1]}}, 'settings: hidden.0: Input should be greater than 0'),
        ({'settings': {'hiden': [6]}}, "settings: .*no setting 'hiden'; did you mean 'hidden'"),
        ({'settings': {'seed': 1}}, "settings: .*no setting 'seed'"),
        ({'settings': {'obs_dim': 1}}, "settings: .*no setting 'obs_dim'"),
        ({'weights': '../../elsewhere.safetensors'}, 'weights: String should match pattern'),
        ({'weights': '/etc/passwd'}, 'weights: String should match pattern'),
        ({'metadata': 3}, 'metadata: Input should be a valid dictionary'),
        ({'metadata': {'contract': 5}}, 'contract: Input should be a valid dictionary'),
        ({'extra': 1}, "no setting 'extra'"),
        ({'training': {'stage': 'x', 'step': -1, 'settings': {}}}, 'training.step: .*got -1'),
    ],
)
def test_wrong_index_is_refused_by_name(changes, message, tmp_path):
    saved_agent(tmp_path)
    change_index(tmp_path, **changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize(
    'changes',
    [
        {'obs_dim': 10**10},
        {'act_dim': 10**10},
        {'obs_dim': 10**6, 'settings': {'hidden': [10**6] * 9}},
        {'settings': {'hidden': [10**8, 10**8]}},
        {'settings': {'hidden': [1] * 10**5}},
    ],
)
def test_index_that_announces_huge_networks_takes_no_memory(changes, tmp_path, bounded_memory):
    saved_agent(tmp_path)
    change_index(tmp_path, **changes)
    with pytest.raises(CheckpointError, match=r'equal to 1000000|ask for|at most 64|do not fit'):
        load_checkpoint(tmp_path)


def test_other_environment_is_refused_by_name(tmp_path):
    saved_agent(tmp_path)
    assert load_checkpoint(tmp_path, environment='pointmaze-medium-v0').obs_dim == 2
    message = "trained for environment 'pointmaze-medium-v0', not for 'antmaze-medium-v0'"
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path, environment='antmaze-medium-v0')


def test_missing_weights_file_is_refused_by_name(tmp_path):
    saved_agent(tmp_path)
    (weights,) = tmp_path.glob('weights-*')
    weights.unlink()
    with pytest.raises(CheckpointError, match=f'{weights.name}: is missing'):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize('damage', ['flip', 'truncate', 'append', 'empty'])
def test_damaged_weights_are_refused(damage, tmp_path):
    saved_agent(tmp_path)
    (weights,) = tmp_path.glob('weights-*')
    content = weights.read_bytes()
    flipped = bytes([content[-1] ^ 1])
    weights.write_bytes(
        {
            'flip': content[:-1] + flipped,
            'truncate': content[:-1],
            'append': content + b'x',
            'empty': b'',
        }[damage]
    )
    message = f'{weights.name}: is damaged, its content does not match the hash in its name'
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize('content', [b'', b'no tensors here', b'\xff' * 64])
def test_weights_that_are_no_safetensors_are_refused(content, tmp_path):
    saved_agent(tmp_path)
    replace_weights(tmp_path, content)
    with pytest.raises(CheckpointError, match='is not a safetensors file'):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (
            lambda t: t.pop('agent.actor.fc0.bias'),
            r"missing \['actor.fc0.bias'\], unknown \[\]",
        ),
        (
            lambda t: t.update({'agent.actor.fc1.bias': torch.zeros(6)}),
            r"missing \[\], unknown \['actor.fc1.bias'\]",
        ),
        (
            lambda t: t.update({'agent.actor.mean.bias': torch.zeros(3)}),
            r'weight actor.mean.bias has shape \(3,\), the settings ask for \(2,\)',
        ),
        (
            lambda t: t['agent.actor.mean.bias'].fill_(float('nan')),
            'weight actor.mean.bias holds a non-finite value',
        ),
        (
            lambda t: t['agent.actor.fc0.weight'][0].fill_(float('-inf')),
            'weight actor.fc0.weight holds a non-finite value',
        ),
        (
            lambda t: t.update({'agent.actor.mean.bias': torch.zeros(2, dtype=torch.float64)}),
            'weight actor.mean.bias is torch.float64, expected float32 or float16',
        ),
        (lambda t: t.update({'actor.mean.bias': torch.zeros(2)}), 'unknown tensor actor.mean'),
    ],
    ids=['missing', 'extra', 'shape', 'nan', 'inf', 'dtype', 'name'],
)
def test_weights_that_do_not_fit_are_refused_by_name(change, message, tmp_path):
    saved_agent(tmp_path)
    change_weights(tmp_path, change)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda t: t.update({'optimizer.x': torch.zeros(1)}), 'unknown tensor optimizer.x'),
        (lambda t: t.update({'other.0.step': torch.zeros(1)}), 'unknown tensor other.0.step'),
        (
            lambda t: t['optimizer.3.exp_avg'].fill_(float('nan')),
            'optimizer.3.exp_avg holds a non-',
        ),
        (
            lambda t: t.update({'optimizer.0.step': torch.zeros(()).to(torch.float8_e4m3fn)}),
            'optimizer.0.step is torch.float8_e4m3fn, expected float32',
        ),
        (
            lambda t: t.update({'optimizer.3.exp_avg_sq': -torch.ones(2)}),
            'optimizer.3.exp_avg_sq holds a negative value',
        ),
        (
            lambda t: t.update({f'optimizer.{"9" * 30}.step': torch.zeros(())}),
            'unknown tensor optimizer.9',
        ),
    ],
    ids=['name', 'group', 'nan', 'dtype', 'negative', 'number'],
)
def test_wrong_optimizer_state_is_refused_by_name(change, message, tmp_path):
    saved_agent(tmp_path, training=training_state())
    change_weights(tmp_path, change)
    for load in (load_training_state, load_checkpoint):
        with pytest.raises(CheckpointError, match=message):
            load(tmp_path)


def test_non_finite_agent_is_not_saved_over_a_good_checkpoint(tmp_path):
    good = saved_agent(tmp_path)
    bad = tiny_agent(seed=9)
    with torch.no_grad():
        bad.actor.mean.bias[1] = float('inf')
    with pytest.raises(CheckpointError, match=r'not saved, weight actor\.mean\.bias holds'):
        save_checkpoint(bad, tmp_path)
    assert_bit_equal(load_checkpoint(tmp_path), weights_of(good))


def test_non_finite_optimizer_state_is_not_saved(tmp_path):
    agent = tiny_agent()
    agent.optimizer_state = adam_state(agent, float('nan'))
    with pytest.raises(CheckpointError, match=r'not saved, pretraining\.0\.step holds'):
        save_checkpoint(agent, tmp_path)
    assert not has_checkpoint(tmp_path)


class Crash(BaseException):
    """The process dies: nothing below may catch this."""


@pytest.mark.parametrize('completed', [0, 1], ids=['first-write', 'between-writes'])
@pytest.mark.parametrize('moment', ['before', 'during'])
def test_crash_while_saving_leaves_the_old_checkpoint(completed, moment, tmp_path, monkeypatch):
    old = saved_agent(tmp_path, seed=1, training=training_state(step=5))
    writes, atomic_write = [], files.atomic_write

    class Dying:
        def __init__(self, file):
            self.file = file

        def write(self, content):
            self.file.write(content[: len(content) // 2])
            raise Crash

    @contextmanager
    def dying_write(path):
        writes.append(path)
        if len(writes) > completed and moment == 'before':
            raise Crash
        with atomic_write(path) as file:
            yield file if len(writes) <= completed else Dying(file)

    monkeypatch.setattr(files, 'atomic_write', dying_write)
    with pytest.raises(Crash):
        saved_agent(tmp_path, seed=2, training=training_state(step=6))
    assert len(writes) == completed + 1
    assert_bit_equal(load_checkpoint(tmp_path), weights_of(old))
    assert load_training_state(tmp_path).step == 5
    monkeypatch.undo()
    new = saved_agent(tmp_path, seed=2)
    assert_bit_equal(load_checkpoint(tmp_path), weights_of(new))
    assert len(list(tmp_path.iterdir())) == 2


def test_crash_before_the_first_checkpoint_leaves_none(tmp_path, monkeypatch):
    def die(*args, **kwargs):
        raise Crash

    monkeypatch.setattr(files, 'write_json', die)
    with pytest.raises(Crash):
        saved_agent(tmp_path)
    assert not has_checkpoint(tmp_path)
    with pytest.raises(CheckpointError, match='no checkpoint there'):
        load_checkpoint(tmp_path)


def test_changed_settings_replace_the_saved_ones(tmp_path):
    agent = tiny_agent('gciql', actor_loss='ddpgbc')
    save_checkpoint(agent, tmp_path)
    changed = load_checkpoint(tmp_path, changes={'actor_loss': 'bc'})
    assert changed.settings == agent.settings.model_copy(update={'actor_loss': 'bc'})
    assert_bit_equal(changed, weights_of(agent))
    with pytest.raises(CheckpointError, match='actor_loss: Input should be'):
        load_checkpoint(tmp_path, changes={'actor_loss': 'sac'})
    save_checkpoint(tiny_agent('gcbc'), tmp_path)
    with pytest.raises(CheckpointError, match="GCBCSettings has no setting 'actor_loss'"):
        load_checkpoint(tmp_path, changes={'actor_loss': 'bc'})


def test_reader_sees_one_save_while_others_replace_it(tmp_path):
    agents = [tiny_agent(seed=seed) for seed in range(2)]
    for agent, name in zip(agents, 'ab', strict=True):
        agent.metadata = {'name': name}
    save_checkpoint(agents[0], tmp_path)
    stop = threading.Event()

    def replace():
        for number in count():
            if stop.is_set():
                return
            save_checkpoint(agents[number % 2], tmp_path)

    writer = threading.Thread(target=replace)
    writer.start()
    try:
        for _ in range(150):
            agent = load_checkpoint(tmp_path)
            assert_bit_equal(agent, weights_of(agents['ab'.index(agent.metadata['name'])]))
    finally:
        stop.set()
        writer.join()
