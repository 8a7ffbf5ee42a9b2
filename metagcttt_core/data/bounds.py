"""Bounds on what a file announces, checked before memory is taken for it."""

import os

from metagcttt_core.data.errors import DatasetError

MOST_EXPANSION = 1032
"""Bytes that deflate makes of one at most."""


def check_announced(num_bytes: int, stored_bytes: int, what: str) -> None:
    """Refuse arrays that are larger than what is stored can unpack to.

    Args:
        num_bytes: What the header announces.
        stored_bytes: What the file holds of it, compressed or not.
        what: File and array, for the message.

    Raises:
        DatasetError: With the bytes announced and those that there are.
    """
    if num_bytes > MOST_EXPANSION * stored_bytes:
        raise DatasetError(
            f'{what} announces {num_bytes} bytes, more than can be in the {stored_bytes} stored'
        )


def check_memory(num_bytes: int, what: str) -> None:
    """Refuse to read what no memory of this machine holds.

    Raises:
        DatasetError: With the bytes needed and those of the machine.
    """
    memory = os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES')
    if num_bytes > memory:
        raise DatasetError(f'{what} takes {num_bytes} bytes of memory, this machine has {memory}')
