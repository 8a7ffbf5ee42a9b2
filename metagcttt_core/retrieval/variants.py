"""The selection rules: the sub-trajectories of the dataset that fit a state and a goal.

Each rule cuts at most one sub-trajectory [start, stop) out of a trajectory, scores it, and keeps
the best. A trajectory and its cut, by row of the dataset:

    first ......... start ................ end ......... last
      |               |                     |             |
    episode_starts  nearest to s     best for g, stop - 1   episode_ends

The last row has no next state, so a cut that ends there stops before it.
"""

from typing import NamedTuple

import numpy as np

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.retrieval.config import FilterConfig
from metagcttt_core.retrieval.peaks import high_rows, ranges, RowValues
from metagcttt_core.retrieval.spatial_index import Ball

# The published GC-TTT code turns V into a step distance with this discount, whatever the agent's.
_GCTTT_DISCOUNT = 0.99
_GCTTT_NUM_SELECTED = 10


class Task(NamedTuple):
    """A query as the rules see it.

    Attributes:
        dataset: The offline dataset D.
        near_state: Rows within epsilon of s.
        near_goal: Rows within epsilon of g.
        value: V(. | g) of rows, or None without a critic.
        value_known: V of every row is known: rows cost nothing.
    """

    dataset: TrajectoryDataset
    near_state: Ball
    near_goal: Ball
    value: RowValues | None
    value_known: bool = False


class Candidates(NamedTuple):
    """Scored sub-trajectories, in ascending order.

    Attributes:
        num_relevant: Trajectories that pass near s.
        episodes, starts, stops, scores: (n,) each, by sub-trajectory.
        keep: Positions of the chosen ones in these arrays, ascending.
    """

    num_relevant: int
    episodes: np.ndarray
    starts: np.ndarray
    stops: np.ndarray
    scores: np.ndarray
    keep: np.ndarray


class PerEpisode(NamedTuple):
    """One row and its value for each trajectory that has any, ascending; (n,) each."""

    episodes: np.ndarray
    rows: np.ndarray
    values: np.ndarray


def paper(task: Task, config: FilterConfig) -> Candidates:
    """Appendix A: relevant by equation 10, scored by equation 11 or 12, the top p percent kept."""
    start = _nearest(task, task.near_state)
    if task.value is None:
        end = _closest_to_goal(task, start.episodes, start.rows)
    else:
        end = _highest_value(task, start.episodes, start.rows, config)
    starts = start.rows[np.searchsorted(start.episodes, end.episodes)]
    scores = -end.values
    return Candidates(
        num_relevant=len(start.episodes),
        episodes=end.episodes,
        starts=starts,
        stops=_stops_after(task, end),
        scores=scores,
        keep=_best(scores, config),
    )


def gcttt(task: Task, config: FilterConfig) -> Candidates:
    """The published GC-TTT implementation, with its own ranking, padding and strict radius."""
    return _gcttt_by_steps(task, config) if task.value is None else _gcttt_by_value(task, config)


def random(task: Task, config: FilterConfig) -> Candidates:
    """Ablation: whole trajectories drawn at random, blind to state and goal."""
    data = task.dataset
    episodes = np.arange(data.num_episodes)
    scores = np.random.default_rng(config.seed).random(len(episodes))
    return Candidates(
        num_relevant=len(episodes),
        episodes=episodes,
        starts=data.episode_starts,
        stops=data.episode_ends,
        scores=scores,
        keep=_best(scores, config),
    )


def relevance_only(task: Task, config: FilterConfig) -> Candidates:
    """Ablation: random relevant trajectories, from the state nearest to s to their end."""
    start = _nearest(task, task.near_state)
    scores = np.random.default_rng(config.seed).random(len(start.episodes))
    return Candidates(
        num_relevant=len(start.episodes),
        episodes=start.episodes,
        starts=start.rows,
        stops=task.dataset.episode_ends[start.episodes],
        scores=scores,
        keep=_best(scores, config),
    )


def score_only(task: Task, config: FilterConfig) -> Candidates:
    """Ablation: the best trajectories for the goal, from their beginning, wherever s is."""
    data = task.dataset
    episodes = np.arange(data.num_episodes)
    if task.value is None:
        end = _closest_to_goal(task, episodes, data.episode_starts)
    else:
        end = _highest_value(task, episodes, data.episode_starts, config)
    scores = -end.values
    return Candidates(
        num_relevant=len(episodes),
        episodes=end.episodes,
        starts=data.episode_starts[end.episodes],
        stops=_stops_after(task, end),
        scores=scores,
        keep=_best(scores, config),
    )


def smallest_per_episode(episodes: np.ndarray, rows: np.ndarray, values: np.ndarray) -> PerEpisode:
    """The row of the smallest value in each trajectory, the first on ties.

    Args:
        episodes: (n,) trajectory of each row.
        rows: (n,) rows, in any order.
        values: (n,) what to minimise.
    """
    if not len(rows):
        return PerEpisode(episodes, rows, values)
    keys = values.astype(np.float64)  # of one type with `smallest`, else numpy casts one by one
    smallest = np.full(episodes.max() + 1, np.inf)
    np.minimum.at(smallest, episodes, keys)
    hits = np.flatnonzero(keys == smallest[episodes])
    hits = hits[np.argsort(rows[hits])]  # few: one per trajectory, and ties
    firsts = hits[np.flatnonzero(np.diff(episodes[hits], prepend=-1))]
    return PerEpisode(episodes[firsts], rows[firsts], values[firsts])


def _stops_after(task: Task, end: PerEpisode) -> np.ndarray:
    """Stops of cuts that include their end, unless that is a last row."""
    return np.minimum(end.rows + 1, task.dataset.episode_ends[end.episodes])


def _closest_to_goal(task: Task, episodes: np.ndarray, starts: np.ndarray) -> PerEpisode:
    """Per trajectory the state closest to g from its start on, where that is within epsilon."""
    data = task.dataset
    first_usable = np.full(data.num_episodes, data.num_rows)
    first_usable[episodes] = starts
    return _nearest(task, task.near_goal, first_usable)


def _nearest(task: Task, ball: Ball, first_usable: np.ndarray | None = None) -> PerEpisode:
    """Per trajectory the state closest to the ball's point, from its first usable row on."""
    found = ball.nearest_per_episode(first_usable)
    if found is not None:
        return PerEpisode(*found)
    rows, distances = ball()
    episodes = task.dataset.episode_of(rows)
    if first_usable is not None:
        usable = np.flatnonzero(rows >= first_usable[episodes])
        episodes, rows, distances = episodes[usable], rows[usable], distances[usable]
    return smallest_per_episode(episodes, rows, distances)


def _highest_value(
    task: Task, episodes: np.ndarray, starts: np.ndarray, config: FilterConfig
) -> PerEpisode:
    """Per trajectory the state of highest V from its start on, as the smallest of -V.

    It may be too low a state for a trajectory that is not among the best.
    """
    count = _number_kept(len(episodes), config)
    rows, values = _high_rows(task, starts, task.dataset.episode_ends[episodes] + 1, count)
    return smallest_per_episode(task.dataset.episode_of(rows), rows, -values)


def _high_rows(
    task: Task, starts: np.ndarray, stops: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    assert task.value is not None, 'only the critic-based rules ask for values'
    if task.value_known:
        rows = ranges(starts, stops)
        return rows, task.value(rows)
    return high_rows(task.value, starts, stops, count)


def _best(scores: np.ndarray, config: FilterConfig) -> np.ndarray:
    """Positions of the best scores, ascending: the top k, or p percent; ties to the earlier."""
    return np.sort(np.argsort(-scores, kind='stable')[: _number_kept(len(scores), config)])


def _number_kept(scored: int, config: FilterConfig) -> int:
    if config.top_k is not None:
        return config.top_k
    return max(1, int(np.ceil(config.top_percent * scored / 100)))


def _gcttt_by_steps(task: Task, config: FilterConfig) -> Candidates:
    """Rank by the fewest steps from a match of s to the first later match of g.

    Matches are rows within epsilon. Of each trajectory the pair of matches with the fewest steps
    in between is cut, with `slack` more steps behind the goal:

        ... s ... s --- steps --> g --- slack --> stop ...
                start
    """
    data = task.dataset
    near_s = np.sort(task.near_state(strict=True).rows)
    near_g = np.sort(task.near_goal(strict=True).rows)
    near_g = near_g[data.episode_starts[data.episode_of(near_g)] != near_g]  # never a first row
    episodes = data.episode_of(near_s)
    num_relevant = int(np.count_nonzero(np.diff(episodes, prepend=-1)))
    if not len(near_g):
        near_s, episodes = near_s[:0], episodes[:0]
    slot = np.searchsorted(near_g, near_s)
    arrival = near_g[np.minimum(slot, len(near_g) - 1)] if len(near_g) else near_s
    usable = (slot < len(near_g)) & (data.episode_of(arrival) == episodes) & (arrival > near_s)
    steps = (arrival - near_s)[usable]
    best = smallest_per_episode(episodes[usable], near_s[usable], steps)
    stops = np.minimum(
        best.rows + best.values + config.slack, data.episode_ends[best.episodes] + 1
    )
    keep = np.empty(0, np.int64)
    if len(best.rows):
        keep = np.flatnonzero(best.values <= np.quantile(best.values, config.top_percent / 100))
    scores = -best.values.astype(np.float64)
    return Candidates(num_relevant, best.episodes, best.rows, stops, scores, keep)


def _gcttt_by_value(task: Task, config: FilterConfig) -> Candidates:
    """Rank by the smallest step distance log(1 + (1 - discount) V) / log(discount)."""
    data = task.dataset
    near_s = np.sort(task.near_state(strict=True).rows)
    near_episodes = data.episode_of(near_s)
    first_slots = np.flatnonzero(np.diff(near_episodes, prepend=-1))
    relevant, firsts = near_episodes[first_slots], near_s[first_slots]
    eligible = firsts + config.min_steps <= data.episode_ends[relevant]
    episodes, firsts = relevant[eligible], firsts[eligible]
    kept = config.model_copy(update={'top_k': config.top_k or _GCTTT_NUM_SELECTED})
    rows, values = _high_rows(
        task,
        firsts + config.min_steps,
        data.episode_ends[episodes] + 1,
        _number_kept(len(episodes), kept),
    )
    inside = 1 + (1 - _GCTTT_DISCOUNT) * values.astype(np.float64)
    steps = np.log(np.where(inside > 0, inside, 1)) / np.log(_GCTTT_DISCOUNT)
    distances = np.where(inside > 0, steps, np.finfo(np.float64).max)  # V below -100: far away
    best = smallest_per_episode(data.episode_of(rows), rows, distances)
    keep = _best(-best.values, kept)
    return Candidates(len(relevant), episodes, firsts, best.rows, -best.values, keep)
