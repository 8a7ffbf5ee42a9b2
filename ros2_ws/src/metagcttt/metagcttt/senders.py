"""Who is heard where only one may speak. No ROS in here."""

HEARD_S = 1.0


class Senders:
    """Tells senders apart by the numbers that they have drawn."""

    def __init__(self) -> None:
        """Nobody was heard yet."""
        self._heard_s: dict[int, float] = {}

    def hear(self, instance: int, now_s: float) -> None:
        """A message of one came at `now_s`, seconds of a clock that only goes forward."""
        self._heard_s[instance] = now_s

    def count(self, now_s: float) -> int:
        """How many were heard within the last second."""
        self._heard_s = {
            instance: time_s
            for instance, time_s in self._heard_s.items()
            if now_s - time_s <= HEARD_S
        }
        return len(self._heard_s)
