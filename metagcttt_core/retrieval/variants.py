"""The selection rules: which sub-trajectories of the dataset fit a state and a goal."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.retrieval.config import FilterConfig
from metagcttt_core.retrieval.groups import Best, smallest_per_episode
from metagcttt_core.retrieval.spatial_index import Neighbours

RowValues = Callable[[np.ndarray], np.ndarray]
Ball = Callable[..., Neighbours]

# The published GC-TTT code turns V into a step distance with this discount, whatever the agent's.
_GCTTT_DISCOUNT = 0.99
_GCTTT_NUM_SELECTED = 10


class Task(NamedTuple):
    """What a rule may look at; `value` gives V(row | g) or is None without a critic."""

    dataset: TrajectoryDataset
    near_state: Ball
    near_goal: Ball
    value: RowValues | None


class Candidates(NamedTuple):
    """Scored sub-trajectories [start, stop), ascending; `keep` numbers the chosen ones."""

    num_relevant: int
    episodes: np.ndarray
    starts: np.ndarray
    stops: np.ndarray
    scores: np.ndarray
    keep: np.ndarray


def paper(task: Task, config: FilterConfig) -> Candidates:
    """Appendix A: relevant by equation 10, scored by equation 11 or 12, the top p percent kept."""
    near = task.near_state()
    start = smallest_per_episode(task.dataset.episode_of(near.rows), *near)
    if task.value is None:
        end = _closest_to_goal(task, start.episodes, start.rows)
    else:
        end = _highest_value(task, start.episodes, start.rows)
    starts = start.rows[np.searchsorted(start.episodes, end.episodes)]
    # The last row of a trajectory has no next state to learn from.
    stops = np.minimum(end.rows + 1, task.dataset.episode_ends[end.episodes])
    scores = -end.values
    return Candidates(
        len(start.episodes), end.episodes, starts, stops, scores, _best(scores, config)
    )


def gcttt(task: Task, config: FilterConfig) -> Candidates:
    """The published GC-TTT implementation, with its own ranking, padding and strict radius."""
    return _gcttt_by_steps(task, config) if task.value is None else _gcttt_by_value(task, config)


def random(task: Task, config: FilterConfig) -> Candidates:
    """Ablation: whole trajectories drawn at random, blind to state and goal."""
    data = task.dataset
    episodes = np.arange(data.num_episodes)
    scores = np.random.default_rng(config.seed).random(len(episodes))
    keep = _best(scores, config)
    return Candidates(
        len(episodes), episodes, data.episode_starts, data.episode_ends, scores, keep
    )


def relevance_only(task: Task, config: FilterConfig) -> Candidates:
    """Ablation: random relevant trajectories, from the state nearest to s to their end."""
    near = task.near_state()
    start = smallest_per_episode(task.dataset.episode_of(near.rows), *near)
    scores = np.random.default_rng(config.seed).random(len(start.episodes))
    stops = np.maximum(task.dataset.episode_ends[start.episodes], start.rows)
    return Candidates(
        len(start.episodes), start.episodes, start.rows, stops, scores, _best(scores, config)
    )


def score_only(task: Task, config: FilterConfig) -> Candidates:
    """Ablation: the best trajectories for the goal, from their beginning, wherever s is."""
    data = task.dataset
    episodes = np.arange(data.num_episodes)
    find_end = _closest_to_goal if task.value is None else _highest_value
    end = find_end(task, episodes, data.episode_starts)
    stops = np.minimum(end.rows + 1, data.episode_ends[end.episodes])
    scores = -end.values
    return Candidates(
        len(episodes),
        end.episodes,
        data.episode_starts[end.episodes],
        stops,
        scores,
        _best(scores, config),
    )


VARIANTS: dict[str, Callable[[Task, FilterConfig], Candidates]] = {
    rule.__name__: rule for rule in (paper, gcttt, random, relevance_only, score_only)
}


def _closest_to_goal(task: Task, episodes: np.ndarray, starts: np.ndarray) -> Best:
    """Per trajectory the state closest to g from its start on, where that is within epsilon."""
    near = task.near_goal()
    data = task.dataset
    first_usable = np.full(data.num_episodes, data.num_rows)
    first_usable[episodes] = starts
    near_episodes = data.episode_of(near.rows)
    usable = np.flatnonzero(near.rows >= first_usable[near_episodes])
    return smallest_per_episode(near_episodes[usable], near.rows[usable], near.distances[usable])


def _highest_value(task: Task, episodes: np.ndarray, starts: np.ndarray) -> Best:
    """Per trajectory the state of highest V from its start on, as the smallest of -V."""
    rows = _ranges(starts, task.dataset.episode_ends[episodes] + 1)
    return smallest_per_episode(task.dataset.episode_of(rows), rows, -_values(task, rows))


def _values(task: Task, rows: np.ndarray) -> np.ndarray:
    assert task.value is not None, 'only the critic-based rules ask for values'
    return task.value(rows)


def _best(scores: np.ndarray, config: FilterConfig) -> np.ndarray:
    """Ascending numbers of the best scores: the top k, or p percent; ties to the earlier one."""
    if config.top_k is not None:
        count = config.top_k
    else:
        count = max(1, int(np.ceil(config.top_percent * len(scores) / 100)))
    return np.sort(np.argsort(-scores, kind='stable')[:count])


def _gcttt_by_steps(task: Task, config: FilterConfig) -> Candidates:
    """Rank by the fewest steps from a match of s to the first later match of g."""
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
    rows = _ranges(firsts + config.min_steps, data.episode_ends[episodes] + 1)
    inside = 1 + (1 - _GCTTT_DISCOUNT) * _values(task, rows).astype(np.float64)
    steps = np.log(np.where(inside > 0, inside, 1)) / np.log(_GCTTT_DISCOUNT)
    distances = np.where(inside > 0, steps, np.finfo(np.float64).max)  # V below -100: far away
    best = smallest_per_episode(data.episode_of(rows), rows, distances)
    keep = _best(
        -best.values, config.model_copy(update={'top_k': config.top_k or _GCTTT_NUM_SELECTED})
    )
    return Candidates(len(relevant), episodes, firsts, best.rows, -best.values, keep)


def _ranges(starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """The rows of all [start, stop), in order."""
    counts = stops - starts
    if not len(counts):
        return np.empty(0, np.int64)
    offsets = np.repeat(starts - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
    return offsets + np.arange(counts.sum())
