"""The live view of a running graph, in a browser."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from metagcttt_core.config import Settings
from metagcttt_core.data import DatasetError
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse

_DESCRIPTION = """Watch a running robot in a browser, and send it goals by a click on the floor.

Example: metagcttt view
Shows the maze, the robot, the data, what was retrieved for the goal, the policy's actions before
and after the adaptation, its losses and the health of the nodes. Ctrl-C ends it. With --replay a
recording of recorder_node or ros2 bag record is shown instead, to be played and searched."""


class ViewSettings(Settings):
    """Settings of the program."""

    host: str = Field(
        '127.0.0.1', description='address to listen on; 0.0.0.0 lets other machines in'
    )
    port: int = Field(8080, ge=1, le=65535, description='port, or the next free one')
    robot: str = Field('', description='namespace of the robot, such as /robot1')
    out: Path = Field(Path('out/view'), description='folder for recordings')
    replay: Path | None = Field(None, description='recording to show instead of a running graph')
    checkpoint: str = Field(
        '', description='with --replay: policy that acted; empty: the committed one'
    )
    dataset: str = Field(
        '', description='with --replay: dataset it adapted on; empty: the committed one'
    )


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(ViewSettings, _DESCRIPTION, 'view', argv)
    from metagcttt_tools.live.replay import Replay
    from metagcttt_tools.live.view import show, show_replay

    listen: dict[str, Any] = {'host': settings.host, 'port': settings.port}
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        if settings.replay is None:
            show(robot=settings.robot, out=settings.out, **listen)
        else:
            files = (settings.replay, settings.robot, settings.checkpoint, settings.dataset)
            show_replay(Replay(*files), **listen)
    except DatasetError as error:
        fail(str(error))
    except OSError as error:
        fail(f'cannot listen on {settings.host}: {error}')
