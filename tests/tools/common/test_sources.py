"""What a report says of its data and policies."""

from metagcttt_core import save_checkpoint
from metagcttt_tools.common.sources import identities, unchanged
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


def test_data_that_are_replaced_meanwhile_are_refused(files):
    with pytest.raises(ValueError, match='is of other dataset, was '), unchanged(*files):
        random_dataset(seed=1).save(files[0])
