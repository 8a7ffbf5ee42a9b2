"""Parameters of the reference implementation become checkpoints that act as it does."""

from metagcttt_core import load_checkpoint
from metagcttt_tools import convert as convert_checkpoint
import numpy as np
import pytest
from tests.core.builders import assert_bit_equal, DATA, tiny_agent, weights_of


def as_ogbench_names(arrays):
    """The arrays as OGBench's own parameter tree names and stacks them."""
    layers = len({name for name in arrays if name.startswith('actor.fc') and 'kernel' in name})

    def layer(name, head):
        for index in range(layers):
            name = name.replace(f'fc{index}.', f'Dense_{index}.')
            name = name.replace(f'ln{index}.', f'LayerNorm_{index}.')
        return name.replace(f'{head[0]}.', head[1])

    renamed = {}
    for name, array in arrays.items():
        net, _, rest = name.partition('.')
        if net == 'actor':
            own = rest == 'log_stds' or rest.startswith('mean.')
            inner = rest.replace('mean.', 'mean_net.') if own else f'actor_net.{layer(rest, "_.")}'
            renamed[f'modules_actor.{inner}'] = array
            continue
        inner = f'value_net.{layer(rest, ("out", f"Dense_{layers}."))}'
        if net == 'value':
            renamed[f'modules_value.{inner}'] = array
        elif net.endswith('1'):
            stacked = np.stack([array, arrays[f'{net[:-1]}2.{rest}']])
            kind = {'critic1': 'critic', 'target1': 'target_critic'}[net]
            renamed[f'modules_{kind}.{inner}'] = stacked
    return renamed


def as_names_of_saw(arrays):
    """The arrays as the authors' SAW names and stacks them, from three hidden layers."""

    def numbered(rest, head):
        for index in range(3):
            rest = rest.replace(f'fc{index}.', f'Dense_{index}.')
            rest = rest.replace(f'ln{index}.', f'LayerNorm_{index}.')
        return rest.replace('out.', head)

    renamed = {}
    for name, array in arrays.items():
        net, _, rest = name.partition('.')
        if net == 'value_rep':
            renamed[f'modules_goal_rep.layers_0.{numbered(rest, "Dense_3.")}'] = array
        elif rest.startswith('goal_rep.'):
            inner = numbered(rest.removeprefix('goal_rep.'), 'Dense_3.')
            renamed[f'modules_actor_goal_rep_def.layers_0.{inner}'] = array
        elif net in ('actor', 'subpolicy'):
            own = rest == 'log_stds' or rest.startswith('mean.')
            inner = (
                rest.replace('mean.', 'mean_net.') if own else f'actor_net.{numbered(rest, "")}'
            )
            renamed[f'modules_{"actor" if net == "actor" else "low_actor"}.{inner}'] = array
        elif net.endswith('1'):
            kind = {'value1': 'value', 'target1': 'target_value'}[net]
            stacked = np.stack([array, arrays[f'{net[:-1]}2.{rest}']])
            renamed[f'modules_{kind}.value_net.{numbered(rest, "Dense_3.")}'] = stacked
    return renamed


def as_ogbench_names_of_crl(arrays):
    """The arrays as OGBench's CRL names and stacks them, from three hidden layers."""
    renamed = {}
    for name, array in arrays.items():
        net, _, rest = name.partition('.')
        for index in range(3):
            rest = rest.replace(f'fc{index}.', f'Dense_{index}.')
            rest = rest.replace(f'ln{index}.', f'LayerNorm_{index}.')
        if net == 'actor':
            own = rest == 'log_stds' or rest.startswith('mean.')
            inner = rest.replace('mean.', 'mean_net.') if own else f'actor_net.{rest}'
            renamed[f'modules_actor.{inner}'] = array
            continue
        rest = rest.replace('out.', 'Dense_3.')
        if net == 'value':
            renamed[f'modules_value.{rest}'] = array
        elif net == 'critic1':
            renamed[f'modules_critic.{rest}'] = np.stack(
                [array, arrays[name.replace('critic1', 'critic2')]]
            )
    return renamed


def save(path, arrays):
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize('maze', ['pm', 'ant'])
@pytest.mark.parametrize('name', ['gcbc', 'gciql'])
def test_golden_parameters_act_as_the_reference(name, maze, tmp_path, capsys):
    file = DATA / f'nets_{name}_{maze}.npz'
    arguments = [str(file), '--agent', name, '--prefix', 'init', '--out', str(tmp_path)]
    convert_checkpoint.main([*arguments, '--environment', 'antmaze-medium-v0'])
    agent = load_checkpoint(tmp_path, environment='antmaze-medium-v0')
    with np.load(file) as golden:
        actions = agent.act(golden['batch.observations'], golden['batch.actor_goals'])
        key = 'out.eval_action' if name == 'gcbc' else 'out.pi_action'
        np.testing.assert_allclose(actions, golden[key], rtol=1e-5, atol=5e-5)
        if name == 'gciql':
            values = agent.value_fn(golden['batch.observations'], golden['batch.value_goals'][0])
            assert values[0] == pytest.approx(golden['out.v'][0], rel=1e-5, abs=5e-5)
        assert agent.settings.hidden == tuple(golden['meta.hidden_dims'])
    assert '32 x 32 x 32 units' in capsys.readouterr().out


@pytest.mark.parametrize('name', ['gcbc', 'gciql'])
@pytest.mark.parametrize('const_std', [True, False])
@pytest.mark.parametrize('rename', [dict, as_ogbench_names])
def test_exported_agent_comes_back_under_either_names(name, const_std, rename, tmp_path):
    agent = tiny_agent(name, obs_dim=3, act_dim=2, hidden=(6, 5, 4), const_std=const_std)
    file = save(tmp_path / 'params.npz', rename(agent.export_reference_parameters()))
    convert_checkpoint.main([str(file), '--agent', name, '--out', str(tmp_path / 'converted')])
    converted = load_checkpoint(tmp_path / 'converted')
    assert_bit_equal(converted, weights_of(agent))
    assert converted.settings == agent.settings
    assert (converted.obs_dim, converted.act_dim) == (3, 2)


@pytest.mark.parametrize('const_std', [True, False])
@pytest.mark.parametrize('rename', [dict, as_names_of_saw])
def test_exported_saw_comes_back_under_either_names(const_std, rename, tmp_path):
    usual = dict.fromkeys(('alpha', 'subpolicy_alpha', 'waypoint_alpha'), 3.0)
    agent = tiny_agent('saw', obs_dim=3, act_dim=2, hidden=(6, 5, 4), const_std=const_std, **usual)
    file = save(tmp_path / 'params.npz', rename(agent.export_reference_parameters()))
    convert_checkpoint.main([str(file), '--agent', 'saw', '--out', str(tmp_path / 'converted')])
    converted = load_checkpoint(tmp_path / 'converted')
    assert_bit_equal(converted, weights_of(agent))
    assert converted.settings == agent.settings
    assert (converted.obs_dim, converted.act_dim) == (3, 2)


@pytest.mark.parametrize('actor_loss', ['ddpgbc', 'awr'])
@pytest.mark.parametrize('rename', [dict, as_ogbench_names_of_crl])
def test_exported_crl_comes_back_under_either_names(actor_loss, rename, tmp_path):
    usual = {'latent_dim': 512, 'actor_loss': actor_loss}
    agent = tiny_agent('crl', obs_dim=3, act_dim=2, hidden=(6, 5, 4), **usual)
    file = save(tmp_path / 'params.npz', rename(agent.export_reference_parameters()))
    out = ['--out', str(tmp_path / 'converted'), '--actor-loss', actor_loss]
    convert_checkpoint.main([str(file), '--agent', 'crl', *out])
    converted = load_checkpoint(tmp_path / 'converted')
    assert_bit_equal(converted, weights_of(agent))
    assert converted.settings == agent.settings


def test_ogbench_names_stack_the_twin_critics(tmp_path):
    arrays = as_ogbench_names(tiny_agent('gciql').export_reference_parameters())
    assert arrays['modules_critic.value_net.Dense_0.kernel'].shape == (2, 6, 6)
    assert arrays['modules_target_critic.value_net.LayerNorm_0.scale'].shape == (2, 6)
    assert arrays['modules_value.value_net.Dense_1.bias'].shape == (1,)
    assert arrays['modules_actor.mean_net.kernel'].shape == (6, 2)
    assert len(arrays) == 4 + 3 * 6


def test_settings_for_further_training_are_kept(tmp_path):
    file = save(tmp_path / 'p.npz', tiny_agent('gciql').export_reference_parameters())
    further = ['--alpha', '0.003', '--actor-loss', 'awr', '--discount', '0.995']
    convert_checkpoint.main(
        [str(file), '--agent', 'gciql', '--out', str(tmp_path / 'o'), *further]
    )
    settings = load_checkpoint(tmp_path / 'o').settings
    assert (settings.alpha, settings.actor_loss, settings.discount) == (0.003, 'awr', 0.995)


def drop(name):
    return lambda arrays: arrays.pop(name)


def put(name, array):
    return lambda arrays: arrays.update({name: array})


@pytest.mark.parametrize(
    ('agent', 'change', 'message'),
    [
        ('gciql', drop('critic2.out.bias'), "missing ['critic2.out.bias'], unknown none"),
        ('gciql', put('value.fc9.bias', np.zeros(1)), "unknown ['value.fc9.bias']"),
        ('gcbc', dict, "unknown ['critic1.fc0.bias'"),
        ('gciql', drop('actor.mean.kernel'), 'the actor needs kernels actor.fc0.kernel'),
        (
            'gciql',
            put('actor.fc0.kernel', np.zeros(3)),
            'of two dimensions; found: actor.fc0.bias',
        ),
        (
            'gciql',
            put('value.fc0.kernel', np.zeros((4, 5))),
            'value.fc0.kernel must have shape (4, 6), got (4, 5)',
        ),
        ('gciql', put('value.out.bias', np.array([np.nan])), 'value.out.bias holds a non-finite'),
        (
            'gciql',
            put('modules_critic.value_net.Dense_0.bias', np.zeros((3, 6))),
            'Dense_0.bias must hold two networks along its first axis, got (3, 6)',
        ),
    ],
)
def test_arrays_that_do_not_fit_are_named(agent, change, message, tmp_path, capsys):
    arrays = tiny_agent('gciql').export_reference_parameters()
    change(arrays)
    file = save(tmp_path / 'params.npz', arrays)
    with pytest.raises(SystemExit, match='2'):
        convert_checkpoint.main([str(file), '--agent', agent, '--out', str(tmp_path / 'out')])
    assert message in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_extra_settings_of_another_agent_are_refused(tmp_path, capsys):
    file = save(tmp_path / 'p.npz', tiny_agent('gcbc').export_reference_parameters())
    with pytest.raises(SystemExit, match='2'):
        convert_checkpoint.main([str(file), '--alpha', '1', '--out', str(tmp_path / 'out')])
    assert "GCBCSettings has no setting 'alpha'" in capsys.readouterr().err


def test_pickles_missing_files_and_existing_checkpoints_are_refused(tmp_path, capsys):
    np.savez(tmp_path / 'objects.npz', **{'actor.fc0.kernel': np.array([{}], dtype=object)})
    file = save(tmp_path / 'p.npz', tiny_agent().export_reference_parameters())
    out = ['--out', str(tmp_path / 'out')]
    for name, message in (('none.npz', 'no such file'), ('objects.npz', 'actor.fc0.kernel')):
        with pytest.raises(SystemExit, match='2'):
            convert_checkpoint.main([str(tmp_path / name), *out])
        assert message in capsys.readouterr().err
    convert_checkpoint.main([str(file), *out])
    with pytest.raises(SystemExit, match='2'):
        convert_checkpoint.main([str(file), *out])
    assert 'holds a checkpoint: choose another --out' in capsys.readouterr().err
