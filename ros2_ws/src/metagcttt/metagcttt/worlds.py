"""Worlds, episodes and steps: which states and starts of episodes belong to the present."""

from typing import NamedTuple

RESTART_STATES = 3


class Moment(NamedTuple):
    """A control step of an episode of a world.

    A world is one run of a simulator or robot bridge. It draws `world_id` at random when it
    starts, because its episodes count from 1 every time; 0 stands for a source that draws none.
    """

    world_id: int
    episode_id: int
    step: int = 0

    def __str__(self) -> str:
        """The moment in words."""
        world = f' in world {self.world_id:x}' if self.world_id else ''
        return f'state {self.step} of episode {self.episode_id}{world}'


class WorldOrder:
    """Follows a source of states through its steps, episodes and worlds.

    In a world, time does not run backwards: what is older than the newest state is refused.
    Another world replaces the present one unless it was published before it. A source without
    identity shows only by older numbers that it has begun again, which stray states have too. So
    they count as another world once `restart_states` of them follow one another. So do, once there
    are `RESTART_STATES`, those of a world whose clock is behind that of the one before it, on
    another computer or set back, where only late messages would be expected.

    Attributes:
        now: The newest moment; None before the first.
        num_worlds: Number of worlds so far.
    """

    def __init__(self, restart_states: int = RESTART_STATES) -> None:
        """Accept any first moment."""
        self.now: Moment | None = None
        self.num_worlds = 0
        self._restart_states = restart_states
        self._published_ns = 0
        self._has_started = False  # whether the start of the present episode was announced
        self._older: Moment | None = None
        self._num_older = 0

    def refuse_state(self, state: Moment, published_ns: int) -> str:
        """Go to the moment of a state; the reason if it is not of the present, else empty.

        Args:
            state: Its moment.
            published_ns: Time of its publication, nanoseconds.
        """
        if self.now is None or state.world_id != self.now.world_id:
            refusal = self._enter_other(state, published_ns)
            if not refusal or self._follows(state, may_repeat=True) < RESTART_STATES:
                return refusal
            return self._enter(state, published_ns)
        if state >= self.now:
            return self._go_to(state, published_ns)
        if state.world_id or published_ns < self._published_ns:
            return self._refusal(state)
        if self._follows(state) < self._restart_states:
            return self._refusal(state)
        return self._enter(state, published_ns)

    def refuse_start(self, start: Moment, published_ns: int) -> str:
        """Go to the start of an episode, which may come before or after its first state.

        Args:
            start: Its moment, with step 0.
            published_ns: Time of the publication of the event, nanoseconds.

        Returns:
            The reason if it is not of the present or was announced before, else empty.
        """
        if self.now is None or start.world_id != self.now.world_id:
            refusal = self._enter_other(start, published_ns)
        elif start.episode_id > self.now.episode_id:
            refusal = self._go_to(start, published_ns)
        elif start.episode_id == self.now.episode_id and not self._begins_again(published_ns):
            refusal = f'{start} was announced before' if self._has_started else ''
        elif start.world_id or published_ns < self._published_ns:
            refusal = self._refusal(start)
        else:
            refusal = self._enter(start, published_ns)
        self._has_started |= not refusal
        return refusal

    def _follows(self, state: Moment, *, may_repeat: bool = False) -> int:
        """The number of states outside the present, up to this one, that follow one another."""
        older, self._older = self._older, state
        same = older is not None and older.world_id == state.world_id
        if older is None or not same or state < older or (state == older and not may_repeat):
            self._num_older = 0
        self._num_older += 1
        return self._num_older

    def _begins_again(self, published_ns: int) -> bool:
        """True for the start of the present episode by a source without identity, after steps."""
        assert self.now is not None
        return not self.now.world_id and self.now.step > 0 and published_ns > self._published_ns

    def _enter_other(self, moment: Moment, published_ns: int) -> str:
        if published_ns < self._published_ns:
            return self._refusal(moment)
        return self._enter(moment, published_ns)

    def _enter(self, moment: Moment, published_ns: int) -> str:
        self.num_worlds += 1
        self._has_started = False
        self._published_ns = published_ns
        return self._go_to(moment, published_ns)

    def _go_to(self, moment: Moment, published_ns: int) -> str:
        if self.now is not None and moment[:2] != self.now[:2]:
            self._has_started = False
        self.now, self._published_ns = moment, max(published_ns, self._published_ns)
        self._older, self._num_older = None, 0
        return ''

    def _refusal(self, moment: Moment) -> str:
        return f'{moment} came after {self.now}'
