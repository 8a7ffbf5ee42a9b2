"""Bags as recorded by ROS: folders, .mcap, .db3, split or compressed. No ROS."""

from bisect import bisect_right
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from metagcttt_core.robot import Contract
from metagcttt_core.robot.types import FieldType
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

from metagcttt_tools.common.bags import open_any_bag, reading

CLOCK = '/clock'


class Recorded(NamedTuple):
    """A message with its topic, as the contract names it, and the time of its reception."""

    topic: str
    message: Any
    received_ns: int


class Definitions:
    """The message types that a bag, or by default ROS 2 Jazzy, defines."""

    def __init__(self, types: Typestore | None = None) -> None:
        """Use the types of a bag, or the standard ones."""
        self._types = types or get_typestore(Stores.ROS2_JAZZY)

    def __call__(self, type_name: str) -> Mapping[str, FieldType]:
        """The fields of a message type by name; raises KeyError for an unknown one."""
        _, fields = self._types.fielddefs[type_name]
        return {name: _field_type(kind, content) for name, (kind, content) in fields}


class Bag:
    """An open bag, seen through a contract.

    Attributes:
        types: The type of each topic of the contract that is in the bag.
        definitions: The message types that the bag defines.
    """

    def __init__(self, path: Path, reader: AnyReader, contract: Contract, namespace: str) -> None:
        """Find the topics of a contract in an open bag."""
        self._path = path
        topics = [topic.topic for topic in contract.topics]
        names = {resolved(topic, namespace): topic for topic in topics}
        self._reader = reader
        self._connections = {
            connection.id: (names[connection.topic], connection)
            for connection in reader.connections
            if connection.topic in names
        }
        self._names = names
        self.types = {topic: each.msgtype for topic, each in self._connections.values()}
        self.all_topics = {each.topic: each.msgtype for each in reader.connections}
        self.definitions = Definitions(reader.typestore)

    def messages(self) -> Iterator[Recorded]:
        """The messages of the contract's topics in the order of reception.

        In a bag with `/clock` the time of reception is the simulated one: between two messages of
        the clock in proportion to the recorded time. What came before the first is left out.
        """
        connections = [connection for _, connection in self._connections.values()]
        if not connections:
            return
        with reading(self._path):
            clock = self._clock()
            for connection, received_ns, data in self._reader.messages(connections):
                if clock:
                    if received_ns < clock[0][0]:
                        continue
                    received_ns = _simulated(clock, received_ns)
                message = self._reader.deserialize(data, connection.msgtype)
                yield Recorded(self._names[connection.topic], message, received_ns)

    def _clock(self) -> list[tuple[int, int]]:
        """Recorded and simulated times of `/clock`, nanoseconds; empty without it."""
        clocks = [c for c in self._reader.connections if c.topic == CLOCK]
        times = []
        for connection, recorded_ns, data in self._reader.messages(clocks) if clocks else ():
            message: Any = self._reader.deserialize(data, connection.msgtype)
            times.append((recorded_ns, message.clock.sec * 10**9 + message.clock.nanosec))
        return times


def _simulated(clock: list[tuple[int, int]], recorded_ns: int) -> int:
    """The simulated time of a recorded one, by the messages of the clock around it."""
    after = bisect_right(clock, recorded_ns, key=lambda times: times[0])
    recorded, simulated = clock[after - 1]
    if after == len(clock):
        return simulated
    share = (recorded_ns - recorded) / (clock[after][0] - recorded)
    return simulated + round(share * (clock[after][1] - simulated))


def resolved(topic: str, namespace: str) -> str:
    """The full name of a topic; relative ones are below the namespace."""
    if topic.startswith('/'):
        return topic
    namespace = namespace.strip('/')
    return f'/{namespace}/{topic}' if namespace else f'/{topic}'


@contextmanager
def open_bag(path: Path, contract: Contract, namespace: str = '') -> Iterator[Bag]:
    """A bag while it is read.

    Args:
        path: Folder with `metadata.yaml`, or an .mcap or .db3 file. Bags of Humble hold no
            definitions of types; the standard ones of Humble stand in.
        contract: The contract, whose topics are wanted.
        namespace: Namespace of the robot in the bag.

    Raises:
        DatasetError: If the bag is missing or damaged, also while it is read.
    """
    with open_any_bag(path) as reader:
        with reading(path):
            bag = Bag(path, reader, contract, namespace)
        yield bag


def _field_type(kind: Nodetype, content: Any) -> FieldType:
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        (inner, name), _ = content
        return FieldType(_field_type(inner, name).name, is_array=True)
    return FieldType(content if kind == Nodetype.NAME else content[0])
