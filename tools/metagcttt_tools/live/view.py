"""The live view: what the graph says goes into the scene, what is clicked goes to the graph."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, UTC
from functools import partial
import os
from pathlib import Path
import queue
import socket
import time

from metagcttt.commander import NoAnswerError
from metagcttt.signals import ignore_signals, stop_on_signals
from metagcttt_core.config.assets import checkpoint_path
from metagcttt_interfaces.msg import AdaptationReport, PolicyStatus
import rclpy
from rclpy.signals import SignalHandlerOptions
import torch
import viser

from metagcttt_tools.graph.process import NodeFailedError, NodeProcess
from metagcttt_tools.live.panel import Controls, Panel
from metagcttt_tools.live.picture import Picture
from metagcttt_tools.live.scene import floor_point
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


class LiveView:
    """Shows one robot in a browser until it is stopped; browsers and nodes may come and go."""

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
        self._pool = ThreadPoolExecutor(1)
        with socket.create_server((host, 0)):
            pass  # viser would wait forever at an address that this machine does not have
        self._watch = Watch(namespace=robot, while_waiting=self._while_waiting)
        self._server = _Server(host, port, label='Meta-GC-TTT', verbose=False)
        self.url = f'http://{host}:{self._server.get_port()}'
        self._server.gui.configure_theme(
            control_layout='fixed', show_logo=False, show_share_button=False
        )
        ask = self._jobs.put
        self._panel = Panel(
            self._server.gui,
            Controls(
                cancel=lambda: ask(self._watch.cancel_goals),
                set_steps=lambda steps: ask(partial(self._watch.set_policy, adapt_steps=steps)),
                change_policy=lambda path: ask(partial(self._watch.change_checkpoint, path)),
                record=lambda on: ask(partial(self._record, on)),
            ),
        )
        self._server.scene.on_click()(
            lambda event: ask(
                partial(self._send, floor_point(event.ray_origin, event.ray_direction))
            )
        )
        self._next_refresh_s = self._next_settings_s = 0.0
        self._recorder: NodeProcess | None = None
        self._picture: Picture | None = None
        self._losses_of: AdaptationReport | None = None

    def run(self) -> None:
        """Show the graph until an exception ends it, such as that of a signal."""
        while True:
            self._watch.spin(0.05)
            self._while_waiting()
            if time.monotonic() > self._next_settings_s:
                self._do(self._watch.read_settings)
                self._next_settings_s = time.monotonic() + _SETTINGS_S
            while not self._jobs.empty():
                self._do(self._jobs.get())
                self._next_settings_s = 0.0

    def close(self) -> None:
        """Leave the graph, end a recording and stop the server."""
        if self._recorder is not None:
            self._recorder.stop()
        if self._picture is not None:
            self._picture.close()
        self._pool.shutdown()
        self._server.stop()
        self._watch.destroy_node()

    # --- from the browser --------------------------------------------------------------------

    def _do(self, job: Callable[[], None]) -> None:
        """Do what was asked; that a node refuses it or is gone is shown and ends nothing."""
        try:
            job()
        except (NoAnswerError, RefusedError, NodeFailedError) as error:
            self._panel.say(f'⚠️ {error}')

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
        watch, panel = self._watch, self._panel
        policy = watch.policy
        if policy:
            panel.show_settings(policy['adapt_steps'], checkpoint_path(policy['checkpoint']))
        actor = 'adapted policy' if watch.status.adapted else 'base policy'
        phase = _PHASES[watch.status.phase].format(s=watch.status, policy=actor)
        panel.show_state(f'**{phase}**\n\n{watch.news}')
        panel.show_health(watch.health())
        panel.show_recording(self._recorder is not None)
        if watch.report is not None and watch.report is not self._losses_of:
            self._losses_of = watch.report
            panel.show_losses(watch.report.train_losses)
        if watch.grid is not None:
            if self._picture is None or self._picture.grid is not watch.grid:
                if self._picture is not None:
                    self._picture.close()
                self._picture = Picture(self._server, watch, self._pool)
            with self._server.atomic():
                self._picture.refresh()
            if self._picture.fault:
                panel.say(f'⚠️ {self._picture.fault}')
                self._picture.fault = ''


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
