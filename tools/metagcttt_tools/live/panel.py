"""The panel beside the scene: what the robot does, the health of its nodes, and the controls."""

from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import viser

from metagcttt_tools.live.scene import AFTER, BEFORE, Color, DATA, GOAL, RETRIEVED, ROBOT

_LEVELS: tuple[Color, ...] = ((0, 158, 115), (230, 159, 0), (200, 0, 0), (200, 0, 0))
_FIRST, _LAST = -1000.0, 1000.0  # of viser's order; controls lie between
_LEGEND = {
    'robot': ROBOT,
    'goal': GOAL,
    'data': DATA,
    'retrieved': RETRIEVED,
    'actions before': BEFORE,
    'and after adapting': AFTER,
}


@dataclass(frozen=True)
class Controls:
    """What the panel asks of the graph; called in threads of the server.

    Attributes:
        cancel: Cancel the goal under way.
        set_steps: Adapt by so many gradient steps K from the next goal on; 0: base policy.
        change_policy: Take another checkpoint.
        record: Begin or end a recording.
    """

    cancel: Callable[[], None]
    set_steps: Callable[[int], None]
    change_policy: Callable[[str], None]
    record: Callable[[bool], None]


class Panel:
    """The texts, the losses and the health; controls stand between the first two."""

    def __init__(self, gui: viser.GuiApi, hint: str) -> None:
        """Create the panel.

        Args:
            gui: Of the server.
            hint: What to do first.
        """
        self._hint = hint
        self._state = gui.add_markdown('', order=_FIRST)
        self._message = gui.add_markdown(hint, order=_FIRST)
        with gui.add_folder('Loss over K steps', order=_LAST):
            self._losses = gui.add_uplot(
                (np.zeros(1), np.zeros(1)),
                ({'label': 'step'}, {'label': 'loss', 'stroke': '#009E73', 'width': 2}),
                scales={'x': {'time': False}},
                height=170,
            )
        with gui.add_folder('Nodes', order=_LAST):
            self._health = gui.add_html('')
        legend = ' '.join(_dot(color) + name for name, color in _LEGEND.items())
        gui.add_html(_html(legend), order=_LAST)

    def say(self, text: str) -> None:
        """Show a message, such as why a request failed."""
        self._message.content = text

    def take_back(self, text: str) -> None:
        """Show the hint again in place of this message, unless another one has come."""
        if self._message.content == text:
            self._message.content = self._hint

    def show_state(self, text: str) -> None:
        """Show what the robot is doing."""
        _set(self._state, 'content', text)

    def show_health(self, health: Sequence[tuple[str, int, str]]) -> None:
        """Show name, level and message of each node."""
        lines = [
            f'{_dot(_LEVELS[level])}<b>{escape(name)}</b>: {escape(text)}'
            for name, level, text in health
        ]
        _set(self._health, 'content', _html('<br>'.join(lines) or 'none heard of'))

    def show_losses(self, losses: Sequence[float]) -> None:
        """Draw the loss of each gradient step."""
        self._losses.data = np.arange(1.0, len(losses) + 1), np.array(losses)


class GraphControls:
    """What is asked of a running graph; the values follow the graph."""

    def __init__(self, gui: viser.GuiApi, controls: Controls) -> None:
        """Create the controls.

        Args:
            gui: Of the server.
            controls: What to do at a click.
        """
        cancel = gui.add_button('Cancel goal')
        self._adapt = gui.add_checkbox('Test-time training', True)
        self._steps = gui.add_number('K (gradient steps)', 10, min=1, max=10000, step=1)
        self._checkpoints: dict[str, Path] = {}
        self._policy = gui.add_dropdown('Policy', ('',))
        self._record = gui.add_checkbox('Record', False)

        async def ask_steps(event: viser.GuiEvent) -> None:
            if event.client is not None:  # else it is the value that the graph has
                controls.set_steps(int(self._steps.value) if self._adapt.value else 0)

        cancel.on_click(lambda _: controls.cancel())
        self._adapt.on_update(ask_steps)
        self._steps.on_update(ask_steps)
        self._policy.on_update(
            _by_hand(lambda name: controls.change_policy(str(self._checkpoints[name])))
        )
        self._record.on_update(_by_hand(controls.record))

    def show_settings(self, steps: int, checkpoint: Path) -> None:
        """Show the policy node's K and checkpoint, and those beside it, to which it can change."""
        _set(self._adapt, 'value', steps > 0)
        if steps:
            _set(self._steps, 'value', steps)
        beside = [found.parent for found in checkpoint.parent.glob('*/checkpoint.json')]
        self._checkpoints = {path.name: path for path in sorted({*beside, checkpoint})}
        _set(self._policy, 'options', tuple(self._checkpoints))
        _set(self._policy, 'value', checkpoint.name)

    def show_recording(self, recording: bool) -> None:
        """Show whether a recording is under way."""
        _set(self._record, 'value', recording)


class Player:
    """The controls of a replay."""

    def __init__(
        self, gui: viser.GuiApi, duration_s: float, seek: Callable[[float], None]
    ) -> None:
        """Create the controls.

        Args:
            gui: Of the server.
            duration_s: Length of the recording.
            seek: Called with the time that was chosen by hand.
        """
        self._time = gui.add_slider('Time (s)', 0.0, max(round(duration_s, 1), 0.1), 0.1, 0.0)
        self._play = gui.add_checkbox('Play', True)
        self._speed = gui.add_dropdown(
            'Speed', ('0.25', '0.5', '1', '2', '5', '10'), initial_value='1'
        )
        self._time.on_update(_by_hand(seek))

    @property
    def playing(self) -> bool:
        """Whether time goes on."""
        return self._play.value

    @property
    def speed(self) -> float:
        """Seconds of the recording per second."""
        return float(self._speed.value)

    def show(self, time_s: float) -> None:
        """Show the time."""
        _set(self._time, 'value', round(time_s, 1))


def _by_hand(
    ask: Callable[[Any], None],
) -> Callable[[viser.GuiEvent], Coroutine[Any, Any, None]]:
    """Ask for a value that a browser set, not for one that the program shows.

    A coroutine, since viser calls functions later, in a thread: by then the program may have
    shown the value that the graph still has.
    """

    async def at_once(event: viser.GuiEvent) -> None:
        if event.client is not None:
            ask(event.target.value)

    return at_once


def _set(handle: Any, name: str, value: Any) -> None:
    """Set an attribute of a handle when it differs: every change travels to the browsers."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _html(text: str) -> str:
    return f'<div style="font-size: 0.85em; padding: 0 0.8em">{text}</div>'


def _dot(color: Color) -> str:
    return f'<span style="color: rgb{color}">&#9679;</span>&nbsp;'
