"""Opening of bags as recorded by ROS: folders, .mcap, .db3, split or compressed. No ROS."""

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from pathlib import Path

from metagcttt_core.data import DatasetError
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

from metagcttt_tools.common.unpacking import bound_rosbags

bound_rosbags()


@contextmanager
def open_any_bag(path: Path) -> Iterator[AnyReader]:
    """A bag while it is read; whatever is taken from it belongs into `reading`.

    Args:
        path: Folder with `metadata.yaml`, or an .mcap or .db3 file. Bags of Humble hold no
            definitions of types; the standard ones of Humble stand in.

    Raises:
        DatasetError: If the bag is missing or damaged; those raised meanwhile name it, too.
    """
    humble = get_typestore(Stores.ROS2_HUMBLE)
    with ExitStack() as stack:
        with reading(path):
            reader = stack.enter_context(AnyReader([path], default_typestore=humble))
        try:
            yield reader
        except DatasetError as error:
            named = str(error).startswith(str(path))
            raise error if named else DatasetError(f'{path}: {error}') from error


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Where packages read a bag, which raise errors of any kind for damaged files.

    Raises:
        DatasetError: Instead of those; names the bag.
    """
    try:
        yield
    except DatasetError as error:
        named = str(error).startswith(str(path))
        raise error if named else DatasetError(f'{path}: {error}') from error
    except FileNotFoundError as error:
        raise DatasetError(f'{path}: no such bag ({error})') from error
    except Exception as error:
        raise DatasetError(f'{path}: cannot be read as a bag ({error!r})') from error
