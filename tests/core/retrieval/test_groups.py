"""Reductions over the rows of each trajectory."""

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core.retrieval.groups import smallest_per_episode
import numpy as np


@given(st.lists(st.lists(st.integers(0, 3), max_size=6), max_size=6), st.randoms())
def test_first_row_of_the_smallest_value_of_each_trajectory(values, random):
    episodes = [number for number, group in enumerate(values) for _ in group]
    flat = [value for group in values for value in group]
    rows = [10 + 2 * number for number in range(len(flat))]
    order = list(range(len(rows)))
    random.shuffle(order)
    best = smallest_per_episode(
        np.array(episodes, np.int64)[order],
        np.array(rows, np.int64)[order],
        np.array(flat, np.float64)[order],
    )
    kept = [(number, group) for number, group in enumerate(values) if group]
    assert best.episodes.tolist() == [number for number, _ in kept]
    assert best.values.tolist() == [min(group) for _, group in kept]
    offsets = np.cumsum([0, *(len(group) for group in values)])
    assert best.rows.tolist() == [
        rows[offsets[number] + group.index(min(group))] for number, group in kept
    ]
