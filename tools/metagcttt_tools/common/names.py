"""The names of observed and commanded values."""

from metagcttt_core import TrajectoryDataset
from metagcttt_core.data import DatasetError
from metagcttt_core.robot import Contract


def names_of(dataset: TrajectoryDataset, contract: Contract | None) -> tuple[list[str], list[str]]:
    """The names of observed and commanded values of a dataset.

    Raises:
        DatasetError: If the dataset is not of the contract.
    """
    if contract is None:
        return (
            [f'observation {i}' for i in range(dataset.obs_dim)],
            [f'action {i}' for i in range(dataset.act_dim)],
        )
    sizes = (dataset.obs_dim, dataset.act_dim)
    if sizes != (contract.obs_dim, contract.act_dim):
        raise DatasetError(
            f'{dataset.source}: {sizes[0]} observed and {sizes[1]} commanded values; the contract '
            f'of {contract.robot} has {contract.obs_dim} and {contract.act_dim}'
        )
    return contract.columns, commanded_names(contract)


def commanded_names(contract: Contract) -> list[str]:
    """The names of the values of an action, such as `linear.x` and `elbow.data`."""
    return [
        f'{joint}.{value.field}' if joint else _numbered(value.field, number, value.size)
        for topic in contract.act
        for value in topic.values
        for number, joint in enumerate(value.joints or [''] * value.num_values)
    ]


def _numbered(field: str, number: int, size: int | None) -> str:
    return field if size is None else f'{field}.{number}'
