"""Which states may be acted on, by their numbers. No ROS in here."""

RESTART_STATES = 3


class StateOrder:
    """Refuses states that are older than what was seen, unless their source has begun anew.

    A simulator that was restarted counts from 1 again. Its states are told from stray ones by
    following one another: the third of them is taken.
    """

    def __init__(self) -> None:
        """Take whatever comes first."""
        self._newest: tuple[int, int] | None = None
        self._older: tuple[int, int] | None = None
        self._num_older = 0

    def refusal(self, episode_id: int, step: int) -> str:
        """Why a state is out of order; empty when it is taken. The same one again is taken."""
        number = (episode_id, step)
        if self._newest is None or number >= self._newest:
            return self._take(number)
        follows = self._older is not None and number > self._older
        self._num_older = self._num_older + 1 if follows else 1
        self._older = number
        if self._num_older >= RESTART_STATES:
            return self._take(number)
        newest_episode, newest_step = self._newest
        return (
            f'state {step} of episode {episode_id} came after state {newest_step} of episode '
            f'{newest_episode}'
        )

    def _take(self, number: tuple[int, int]) -> str:
        self._newest, self._older, self._num_older = number, None, 0
        return ''
