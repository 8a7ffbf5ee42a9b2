"""What a report says of its data and policies."""

from metagcttt_core import save_checkpoint
from metagcttt_tools.common.sources import fingerprints, identities, unchanged
import pytest
from tests.core.builders import random_dataset, tiny_agent


@pytest.fixture
def files(tmp_path):
    random_dataset().save(tmp_path / 'data.npz')
    save_checkpoint(tiny_agent(), tmp_path / 'policy')
    return tmp_path / 'data.npz', [tmp_path / 'policy']


def test_data_and_policies_that_stay_are_named(files):
    with unchanged(*files) as known:
        pass
    assert known == identities(*files)
    assert known['fingerprints'] == {
        'dataset': random_dataset().fingerprint,
        'policies': [tiny_agent().fingerprint()],
    }


def test_policy_that_is_replaced_meanwhile_is_refused(files):
    with (
        pytest.raises(ValueError, match=f'^{files[1][0]}: is of other policies, was '),
        unchanged(*files),
    ):
        save_checkpoint(tiny_agent(seed=1), files[1][0])


@pytest.mark.parametrize('change', [{'seed': 1}, {'obs_dim': 3}])
def test_data_that_are_replaced_meanwhile_are_refused(change, files):
    with pytest.raises(ValueError, match='is of other dataset, was '), unchanged(*files):
        random_dataset(**change).save(files[0])


def test_data_for_another_policy_have_no_identities_with_it(files):
    random_dataset(obs_dim=3).save(files[0])
    with pytest.raises(ValueError, match=f'^{files[1][0]} is for observations of 2 and actions'):
        identities(*files)
    assert list(fingerprints(*files)) == ['dataset', 'policies']
