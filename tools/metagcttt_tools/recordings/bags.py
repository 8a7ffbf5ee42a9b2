"""Recordings in any form: an MCAP file, a bag folder or a .db3 file. No ROS."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from mcap.records import Message
from metagcttt_core.config.yaml_file import read_yaml, SettingsFileError
from metagcttt_core.data.errors import DatasetError

from metagcttt_tools.common.bags import open_any_bag, reading
from metagcttt_tools.recordings.mcap import Clocks, read_messages, Recorded, RecordedMessages


def read_bag(path: Path, type_names: Collection[str]) -> RecordedMessages:
    """All messages of some types of a recording, decoded.

    The files of a folder are read one by one where they are plain MCAP, so that one whose recorder
    was killed is read up to its end. A .db3 file has no times of publication and no order but that
    of reception, which stands in; one of Humble has no definitions of our messages.

    Args:
        path: What recorder_node or `ros2 bag record` wrote: an .mcap or .db3 file, or a folder.
        type_names: The types, such as `metagcttt_interfaces/msg/MazeState`.

    Raises:
        DatasetError: If it is missing, is no recording or is damaged.
    """
    if path.is_dir() and (files := _mcap_files(path)):
        return _joined([read_messages(file, type_names) for file in files])
    if path.is_dir() or path.suffix == '.db3':
        return _read_any(path, type_names)
    return read_messages(path, type_names)


def _mcap_files(folder: Path) -> list[Path]:
    """The MCAP files of a bag in order; empty when it has other files."""
    names = [file.name for file in folder.iterdir() if file.suffix == '.mcap']
    metadata = folder / 'metadata.yaml'
    if metadata.exists():
        try:
            names = read_yaml(metadata)[1]['rosbag2_bagfile_information']['relative_file_paths']
        except (SettingsFileError, LookupError, TypeError) as error:
            raise DatasetError(f'{metadata}: cannot be read ({error})') from error
    else:  # the recorder was killed
        names.sort(key=lambda name: (len(name), name))  # NAME_10 after NAME_9
    files = [folder / Path(str(name)).name for name in names or ()]
    return files if all(file.suffix == '.mcap' for file in files) else []


def _joined(parts: Sequence[RecordedMessages]) -> RecordedMessages:
    """The files of one recording as one, with a jump between two that do not go on."""
    messages: list[Recorded] = []
    stretch = 0
    for index, part in enumerate(parts):
        if index:
            before = parts[index - 1]
            stretch += before.num_stretches - before.goes_on_in(part)
        messages += [replace(each, stretch=each.stretch + stretch) for each in part.messages]
    return RecordedMessages(
        messages=messages,
        topics={topic: kind for part in parts for topic, kind in part.topics.items()},
        complete=all(part.complete for part in parts),
        begin_ns=parts[0].begin_ns,
        end_ns=parts[-1].end_ns,
        num_stretches=stretch + parts[-1].num_stretches,
    )


def _read_any(path: Path, type_names: Collection[str]) -> RecordedMessages:
    clocks = Clocks()
    messages: list[Recorded] = []
    with open_any_bag(path) as reader, reading(path):
        for connection, received_ns, data in reader.messages():
            wanted = connection.msgtype in type_names
            record = Message(
                channel_id=connection.id,
                log_time=received_ns,
                publish_time=received_ns,
                sequence=0,
                data=b'',
            )
            stretch = clocks.stretch(record, wanted=wanted)
            if wanted:
                content = reader.deserialize(data, connection.msgtype)
                recorded = (connection.topic, connection.msgtype, received_ns, content, stretch)
                messages.append(Recorded(*recorded))
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
    return RecordedMessages(
        *(messages, topics, True), clocks.begin_ns, clocks.end_ns, clocks.num_stretches
    )
