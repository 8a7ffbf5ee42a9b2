"""Opening of bags as recorded by ROS: folders, .mcap, .db3, split or compressed. No ROS."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import struct

from metagcttt_core.data import DatasetError
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag2 import ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import get_typestore, Stores


@contextmanager
def open_any_bag(path: Path) -> Iterator[AnyReader]:
    """A bag while it is read.

    Args:
        path: Folder with `metadata.yaml`, or an .mcap or .db3 file. Bags of Humble hold no
            definitions of types; the standard ones of Humble stand in.

    Raises:
        DatasetError: If the bag is missing or damaged, also while it is read.
    """
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except DatasetError as error:
        raise DatasetError(f'{path}: {error}') from error
    except FileNotFoundError as error:
        raise DatasetError(f'{path}: no such bag ({error})') from error
    # The packages below raise any of these for damaged files and messages.
    except (
        *(AnyReaderError, ReaderError, SerdeError, OSError, struct.error, RuntimeError),
        *(AssertionError, LookupError, OverflowError, MemoryError, UnicodeDecodeError),
    ) as error:
        raise DatasetError(f'{path}: cannot be read as a bag ({error})') from error
