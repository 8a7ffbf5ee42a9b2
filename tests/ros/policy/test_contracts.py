"""Policies, data and robots of different contracts are kept apart, by name."""

from pathlib import Path

from metagcttt.deployment import load_deployment
from metagcttt_core import save_checkpoint, TrajectoryDataset
from metagcttt_core.retrieval import FilterSettings
import numpy as np
import pytest
from tests.core.builders import tiny_agent
from tests.core.robot.messages import contract, DRIVE

OTHER = DRIVE.replace('robot: cart', 'robot: van').replace('high: 2', 'high: 3')
FAR = DRIVE + 'retrieval: {values: [yaw.sin, x], epsilon: 0.3}\n'


def files(folder: Path, policy: str, data: str) -> tuple[str, str]:
    agent = tiny_agent(obs_dim=4, act_dim=2)
    if policy:
        agent.metadata['contract'] = contract(policy).identity
    save_checkpoint(agent, folder / 'policy')
    rows = np.random.default_rng(0).uniform(-1, 1, (20, 4))
    identity = contract(data).identity if data else None
    TrajectoryDataset.from_arrays(rows, rows[:, :2], np.arange(20) == 19, contract=identity).save(
        folder / 'data.npz'
    )
    return str(folder / 'policy'), str(folder / 'data.npz')


@pytest.mark.parametrize(('policy', 'data'), [(DRIVE, DRIVE), (DRIVE, ''), ('', DRIVE), ('', '')])
def test_same_or_no_contract_is_used(policy: str, data: str, tmp_path: Path) -> None:
    deployment = load_deployment(*files(tmp_path, policy, data), FilterSettings())
    mine, other = contract().identity['fingerprint'], contract(OTHER).identity['fingerprint']
    assert deployment.contract_fault('') == deployment.contract_fault(mine) == ''
    fault = deployment.contract_fault(other)
    if policy or data:
        assert fault.startswith(f'the policy was made for cart (contract {mine}), not for')
        assert other in fault
    else:
        assert fault == ''


def test_data_of_another_contract_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r'data.npz was made for van .*, not for cart .* high 3'):
        load_deployment(*files(tmp_path, DRIVE, OTHER), FilterSettings())


@pytest.mark.parametrize(('policy', 'data'), [(FAR, FAR), (FAR, ''), ('', FAR), (DRIVE, FAR)])
def test_contract_decides_about_distances(policy: str, data: str, tmp_path: Path) -> None:
    given = files(tmp_path, policy, data)
    found = load_deployment(*given, FilterSettings()).trajectory_filter.config
    assert (found.position_dims, found.epsilon) == ((3, 0), 0.3)
    found = load_deployment(*given, FilterSettings(epsilon=2.0)).trajectory_filter.config
    assert (found.position_dims, found.epsilon) == ((3, 0), 2.0)
