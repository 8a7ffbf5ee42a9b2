"""The filters once more, slowly: one trajectory at a time, straight from their description."""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
import math

from metagcttt_core import FilterConfig, TrajectoryDataset
import numpy as np

ValueFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass
class Segment:
    """Rows start..last (included) of one trajectory, with its score."""

    episode: int
    start: int
    last: int
    score: float


@dataclass
class Answer:
    """What a query must return."""

    relevant: int
    scored: list[Segment]
    kept: list[Segment]


def distance(config: FilterConfig, state, other) -> float:
    """Euclidean over the position coordinates, each multiplied by its scale."""
    scale = config.scale or (1.0,) * len(config.position_dims)
    return math.sqrt(
        sum(
            ((float(state[dim]) - float(other[dim])) * factor) ** 2
            for dim, factor in zip(config.position_dims, scale, strict=True)
        )
    )


def best(segments: list[Segment], config: FilterConfig) -> list[Segment]:
    """The k best, or the best p percent (at least one); ties go to the earlier trajectory."""
    count = config.top_k
    if count is None:
        count = max(1, math.ceil(Fraction(config.top_percent) * len(segments) / 100))
    ranked = sorted(segments, key=lambda segment: (-segment.score, segment.episode))
    return sorted(ranked[:count], key=lambda segment: segment.episode)


def closest(rows: list[int], distances: list[float]) -> tuple[int, float]:
    """The first of the rows with the smallest distance."""
    smallest = min(distances)
    return rows[distances.index(smallest)], smallest


def end_and_score(
    dataset: TrajectoryDataset, config: FilterConfig, goal, rows: list[int], value_fn
) -> tuple[int, float] | None:
    """Where a sub-trajectory over `rows` ends and what it scores; None drops it."""
    if value_fn is not None:
        values = [float(v) for v in value_fn(dataset.observations[rows], goal)]
        highest = max(values)
        return rows[values.index(highest)], highest
    row, smallest = closest(
        rows, [distance(config, dataset.observations[row], goal) for row in rows]
    )
    return None if smallest > config.epsilon else (row, -smallest)


def paper(dataset, config, state, goal, value_fn=None, *, relevance=True) -> Answer:
    """Appendix A, steps 1 to 4; without `relevance`, every trajectory from its first row."""
    scored, relevant = [], 0
    for episode in range(dataset.num_episodes):
        rows = rows_of(dataset, episode)
        if relevance:
            near = [distance(config, dataset.observations[row], state) for row in rows]
            if min(near) > config.epsilon:
                continue
            relevant += 1
            rows = rows[near.index(min(near)) :]
        found = end_and_score(dataset, config, goal, rows, value_fn)
        if found is not None:
            last_with_successor = int(dataset.episode_ends[episode]) - 1
            scored.append(Segment(episode, rows[0], min(found[0], last_with_successor), found[1]))
    return Answer(relevant, scored, best(scored, config))


def gcttt_by_steps(dataset, config, state, goal) -> Answer:
    """The published critic-free filter."""
    scored, relevant = [], 0
    for episode in range(dataset.num_episodes):
        rows = rows_of(dataset, episode)
        near_s = [
            r for r in rows if distance(config, dataset.observations[r], state) < config.epsilon
        ]
        near_g = [
            r for r in rows[1:] if distance(config, dataset.observations[r], goal) < config.epsilon
        ]
        relevant += bool(near_s)
        candidates = []
        for start in near_s:
            arrivals = [r for r in near_g if r >= start]
            if arrivals and arrivals[0] > start:
                candidates.append((arrivals[0] - start, start))
        if candidates:
            steps, start = min(candidates)
            last = min(start + steps + config.slack, rows[-1] + 1) - 1
            scored.append(Segment(episode, start, last, -float(steps)))
    if not scored:
        return Answer(relevant, [], [])
    cutoff = np.quantile([-segment.score for segment in scored], config.top_percent / 100)
    return Answer(relevant, scored, [s for s in scored if -s.score <= cutoff])


def gcttt_by_value(dataset, config, state, goal, value_fn) -> Answer:
    """The published critic-based filter."""
    scored, relevant = [], 0
    for episode in range(dataset.num_episodes):
        rows = rows_of(dataset, episode)
        near_s = [
            r for r in rows if distance(config, dataset.observations[r], state) < config.epsilon
        ]
        relevant += bool(near_s)
        eligible = [r for r in rows if near_s and r >= near_s[0] + config.min_steps]
        if eligible:
            steps = [
                step_distance(float(v)) for v in value_fn(dataset.observations[eligible], goal)
            ]
            row, smallest = closest(eligible, steps)
            scored.append(Segment(episode, near_s[0], row - 1, -smallest))
    count = config.top_k or 10
    return Answer(relevant, scored, best(scored, config.model_copy(update={'top_k': count})))


def step_distance(value: float) -> float:
    """Steps to the goal that a discounted value stands for; huge where V is impossible."""
    inside = 1 + (1 - 0.99) * value
    return math.log(inside) / math.log(0.99) if inside > 0 else np.finfo(np.float64).max


def rows_of(dataset: TrajectoryDataset, episode: int) -> list[int]:
    """All rows of a trajectory."""
    return list(
        range(int(dataset.episode_starts[episode]), int(dataset.episode_ends[episode]) + 1)
    )
