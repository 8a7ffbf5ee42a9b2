"""The metadata.yaml of a bag folder, as rosbag2 of Jazzy writes it (version 9)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import QoSProfile
import yaml

VERSION = 9
NAME = 'metadata.yaml'


@dataclass
class Span:
    """The messages of a file or a bag.

    Attributes:
        count: Their number.
        begin_ns: When the first one was received, nanoseconds since 1970; 0 without one.
        end_ns: When the last one was received.
    """

    count: int = 0
    begin_ns: int = 0
    end_ns: int = 0

    def add(self, received_ns: int) -> None:
        """Count one more."""
        self.begin_ns = min(self.begin_ns, received_ns) if self.count else received_ns
        self.end_ns = max(self.end_ns, received_ns)
        self.count += 1

    def as_yaml(self) -> dict[str, Any]:
        """Its entries."""
        return {
            'starting_time': {'nanoseconds_since_epoch': self.begin_ns},
            'duration': {'nanoseconds': self.end_ns - self.begin_ns},
            'message_count': self.count,
        }


@dataclass
class Topic:
    """A recorded topic.

    Attributes:
        type_name: Its type.
        offered: The qualities of service of its publishers.
        type_hash: The hash of its type, such as `RIHS01_...`; empty if not known.
        count: Number of its messages.
    """

    type_name: str
    offered: Sequence[QoSProfile] = ()
    type_hash: str = ''
    count: int = field(default=0, compare=False)

    def as_yaml(self, name: str) -> dict[str, Any]:
        """Its entry."""
        return {
            'topic_metadata': {
                'name': name,
                'type': self.type_name,
                'serialization_format': 'cdr',
                'offered_qos_profiles': [qos_as_yaml(profile) for profile in self.offered],
                'type_description_hash': self.type_hash,
            },
            'message_count': self.count,
        }


def bag_metadata(files: Mapping[str, Span], bag: Span, topics: Mapping[str, Topic]) -> str:
    """The text of metadata.yaml.

    Args:
        files: The files by name, in order.
        bag: All messages.
        topics: The topics by name.
    """
    information = {
        'version': VERSION,
        'storage_identifier': 'mcap',
        **bag.as_yaml(),
        'topics_with_message_count': [topic.as_yaml(name) for name, topic in topics.items()],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': list(files),
        'files': [{'path': name, **span.as_yaml()} for name, span in files.items()],
        'custom_data': None,
        'ros_distro': 'jazzy',
    }
    return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=False)


def qos_as_yaml(profile: QoSProfile) -> dict[str, Any]:
    """A quality of service in rosbag2's words."""
    return {
        'history': profile.history.name.lower(),
        'depth': profile.depth,
        'reliability': profile.reliability.name.lower(),
        'durability': profile.durability.name.lower(),
        'deadline': _time(profile.deadline),
        'lifespan': _time(profile.lifespan),
        'liveliness': profile.liveliness.name.lower(),
        'liveliness_lease_duration': _time(profile.liveliness_lease_duration),
        'avoid_ros_namespace_conventions': profile.avoid_ros_namespace_conventions,
    }


def _time(duration: Duration) -> dict[str, int]:
    seconds, nanoseconds = divmod(duration.nanoseconds, 10**9)
    return {'sec': seconds, 'nsec': nanoseconds}
