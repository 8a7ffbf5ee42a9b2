"""The live view: what the graph says goes into the scene, what is clicked goes to the graph."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from datetime import datetime, UTC
from functools import partial
import io
import os
from pathlib import Path
import queue
import socket
import time
from typing import Any

from metagcttt.commander import NoAnswerError
from metagcttt.signals import ignore_signals, stop_on_signals
from metagcttt_core.config.assets import checkpoint_path
from metagcttt_core.robot import ContractError
from metagcttt_interfaces.msg import PolicyStatus
import rclpy
from rclpy.signals import SignalHandlerOptions
from sim_bridge import MazeMap
import torch
import viser

from metagcttt_tools.graph.process import NodeFailedError, NodeProcess
from metagcttt_tools.live.panel import Controls, GraphControls, Panel, Player
from metagcttt_tools.live.picture import Picture
from metagcttt_tools.live.replay import Replay
from metagcttt_tools.live.scene import aim, floor_point, viewpoint
from metagcttt_tools.live.watch import RefusedError, Watch

_REFRESH_S = 0.1
_SETTINGS_S = 1.0
_PHASES = {
    PolicyStatus.IDLE: 'no goal',
    PolicyStatus.WAITING: 'waiting for a state',
    PolicyStatus.ADAPTING: 'adapting, {s.steps_done} of {s.steps} gradient steps',
    PolicyStatus.ACTING: 'driving, {policy}',
}


class _Server(viser.ViserServer):
    """A server that opens no public tunnel, which viser does for any browser that asks."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse."""


class Window:
    """A page in the browsers that shows what is known of a robot; they may come and go."""

    def __init__(self, *, host: str, port: int, hint: str) -> None:
        """Start the server.

        Args:
            host: Address to listen on.
            port: Port to listen on; the next free one when it is taken.
            hint: What to do first.

        Raises:
            OSError: If there is no such address.
        """
        self._pool = ThreadPoolExecutor(1)
        with socket.create_server((host, 0)):
            pass  # viser would wait forever at an address that this machine does not have
        with redirect_stdout(io.StringIO()):  # viser prints a box around what `url` says
            self.server = _Server(host, port, label='Meta-GC-TTT', verbose=False)
        self.url = f'http://{host}:{self.server.get_port()}'
        self.server.gui.configure_theme(
            control_layout='fixed', show_logo=False, show_share_button=False
        )
        self.panel = Panel(self.server.gui, hint)
        self._picture: Picture | None = None
        self._maze: MazeMap | None = None
        self._losses_of: Any = None
        self.server.on_client_connect(self._keep_all_in_view)

    def close(self) -> None:
        """Stop the server."""
        if self._picture is not None:
            self._picture.close()
        self._pool.shutdown()
        self.server.stop()

    def refresh(self, seen: Watch | Replay) -> None:
        """Show what is known now."""
        actor = 'adapted policy' if seen.status.adapted else 'base policy'
        phase = _PHASES[seen.status.phase].format(s=seen.status, policy=actor)
        self.panel.show_state(f'**{phase}**\n\n{seen.news}')
        self.panel.show_health(seen.health())
        if seen.report is not None and seen.report is not self._losses_of:
            self._losses_of = seen.report
            self.panel.show_losses(seen.report.train_losses)
        if seen.grid is None and seen.state is None:
            return
        if self._picture is None or self._picture.grid is not seen.grid:
            if self._picture is not None:
                self._picture.close()
            self._picture = Picture(self.server, seen, self._pool)
            self._show_all_of(self._picture.maze)
        with self.server.atomic():
            self._picture.refresh()
        if self._picture.fault:
            self.panel.say(f'⚠️ {self._picture.fault}')
            self._picture.fault = ''

    def _show_all_of(self, maze: MazeMap) -> None:
        """Turn every camera to another maze; one that was seen before stays as it was turned."""
        before, self._maze = self._maze, maze
        if before is None or before.extent != maze.extent:
            for client in self.server.get_clients().values():
                self._aim(client)

    def _keep_all_in_view(self, client: viser.ClientHandle) -> None:
        """Turn the camera of a browser to the maze now, and when its picture takes another shape.

        A browser reports the shape of an empty page before that of the scene.
        """
        aspect = 0.0

        def fit(camera: viser.CameraHandle) -> None:
            nonlocal aspect
            if camera.aspect != aspect:
                aspect = camera.aspect
                self._aim(client)

        client.camera.on_update(fit)
        fit(client.camera)

    def _aim(self, client: viser.ClientHandle) -> None:
        """Turn the camera of a browser so that all of the maze fits."""
        if self._maze is not None:
            aim(client.camera, *viewpoint(self._maze, client.camera.aspect))


class LiveView:
    """Shows one robot of a running graph until it is stopped; nodes may come and go."""

    def __init__(
        self,
        *,
        host: str,
        port: int,
        robot: str,
        out: Path,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Start the server and join the graph.

        Args:
            host: Address to listen on.
            port: Port to listen on; the next free one when it is taken.
            robot: Namespace of the robot; may be empty.
            out: Folder of the recordings.
            check: Called all the time; its exceptions end the view.

        Raises:
            OSError: If there is no such address.
        """
        self._robot_name, self._out, self._check = robot, out, check
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._window = Window(host=host, port=port, hint='Click on the floor to send a goal.')
        self._panel, self.url = self._window.panel, self._window.url
        self._watch = Watch(namespace=robot, while_waiting=self._while_waiting)
        ask = self._jobs.put
        self._controls = GraphControls(
            self._window.server.gui,
            Controls(
                cancel=lambda: ask(self._watch.cancel_goals),
                set_steps=lambda steps: ask(partial(self._watch.set_policy, adapt_steps=steps)),
                change_policy=lambda path: ask(partial(self._watch.change_checkpoint, path)),
                record=lambda on: ask(partial(self._record, on)),
            ),
        )
        self._window.server.scene.on_click()(
            lambda event: ask(
                partial(self._send, floor_point(event.ray_origin, event.ray_direction))
            )
        )
        self._next_refresh_s = self._next_settings_s = 0.0
        self._recorder: NodeProcess | None = None
        self._silence = ''

    def run(self) -> None:
        """Show the graph until an exception ends it, such as that of a signal."""
        while True:
            self._watch.spin(0.05)
            self._while_waiting()
            if time.monotonic() > self._next_settings_s:
                self._read_settings()
                self._next_settings_s = time.monotonic() + _SETTINGS_S
            while not self._jobs.empty():
                self._do(self._jobs.get())
                self._next_settings_s = 0.0

    def close(self) -> None:
        """Leave the graph, end a recording and stop the server."""
        if self._recorder is not None:
            self._recorder.stop()
        self._window.close()
        self._watch.destroy_node()

    # --- from the browser --------------------------------------------------------------------

    def _do(self, job: Callable[[], None]) -> str:
        """Do what was asked; that a node refuses it or is gone is shown and ends nothing.

        Returns:
            What is shown of that; empty when it was done.
        """
        try:
            job()
        except (NoAnswerError, RefusedError, NodeFailedError, ContractError) as error:
            self._panel.say(shown := f'⚠️ {error}')
            return shown
        return ''

    def _read_settings(self) -> None:
        """Read the nodes' settings; that one did not answer is forgotten once it does."""
        before, self._silence = self._silence, self._do(self._watch.read_settings)
        if before and not self._silence:
            self._panel.take_back(before)

    def _send(self, xy: tuple[float, float] | None) -> None:
        if xy is None:
            return
        self._panel.say(f'goal ({xy[0]:.1f}, {xy[1]:.1f}) m')
        sent = self._watch.send(xy)
        if not sent.accepted:
            raise RefusedError(f'goal rejected: {sent.result().error_msg}')

    def _record(self, on: bool) -> None:
        if self._recorder is not None:
            self._recorder.stop()
            self._recorder = None
        if on:
            path = self._out / f'rec-{datetime.now(UTC):%Y%m%d-%H%M%S}.mcap'
            remappings = {'__ns': self._robot_name, '/clock': 'clock'} if self._robot_name else {}
            self._recorder = NodeProcess(
                'recorder_node',
                {'output': str(path)},
                path.with_suffix('.log'),
                remappings=remappings,
            )
            self._panel.say(f'recording to {path}')

    # --- to the browser ----------------------------------------------------------------------

    def _while_waiting(self) -> None:
        self._check()
        if time.monotonic() > self._next_refresh_s:
            self._refresh()
            self._next_refresh_s = time.monotonic() + _REFRESH_S

    def _refresh(self) -> None:
        if policy := self._watch.policy:
            checkpoint = checkpoint_path(policy['checkpoint'])
            self._controls.show_settings(policy['adapt_steps'], checkpoint)
        self._controls.show_recording(self._recorder is not None)
        self._window.refresh(self._watch)


def show(
    *,
    host: str = '127.0.0.1',
    port: int = 8080,
    robot: str = '',
    out: Path,
    check: Callable[[], None] = lambda: None,
) -> None:
    """Show a robot until Ctrl-C or SIGTERM, which end the process; see `LiveView`."""
    stop_on_signals()
    os.nice(10)  # on a busy machine the robot's own nodes go first
    torch.set_num_threads(1)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    view = LiveView(host=host, port=port, robot=robot, out=out, check=check)
    try:
        print(f'live view: {view.url}', flush=True)
        view.run()
    finally:
        ignore_signals()
        view.close()
        rclpy.try_shutdown()


def show_replay(replay: Replay, *, host: str = '127.0.0.1', port: int = 8080) -> None:
    """Show a recording until Ctrl-C or SIGTERM, which end the process."""
    stop_on_signals()
    torch.set_num_threads(1)
    sought: queue.SimpleQueue[float] = queue.SimpleQueue()
    window = Window(host=host, port=port, hint='A recording; drag the time to look around.')
    player = Player(window.server.gui, replay.duration_s, sought.put)
    try:
        print(f'replay of {replay.duration_s:.1f} s: {window.url}', flush=True)
        before_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            if player.playing:
                replay.seek(replay.time_s + (now_s - before_s) * player.speed)
            before_s = now_s
            while not sought.empty():
                replay.seek(sought.get())
            player.show(replay.time_s)
            window.refresh(replay)
            time.sleep(_REFRESH_S)
    finally:
        ignore_signals()
        window.close()
