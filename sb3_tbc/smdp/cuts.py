"""Finished episodes cut into other windows, for the high level to learn from. NumPy only."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sb3_tbc.smdp.options import Episode, Option, TerminationReason
from sb3_tbc.smdp.spaces import SubgoalSpace


def cut_anew(episode: Episode, subgoals: SubgoalSpace, lengths: tuple[int, int], rng: np.random.Generator) -> Episode:
    """The same episode cut into other windows, none of which the high level chose.

    What the low level did between any two states is an option in hindsight, wherever the high level's own windows began
    and ended. Lengths are drawn uniformly; the first window begins within the shortest length, so up to that many steps
    are left out; the episode's end cuts the last one off, and the task's event ends a window as it always does. Not of
    the paper.

    :param episode: a finished one
    :param subgoals: the task's
    :param lengths: fewest and most steps of a window
    :param rng: draws the windows
    """
    shortest, longest = lengths
    rest = _without_first(episode, min(int(rng.integers(0, shortest)), episode.length - 1))
    drawn = rng.integers(shortest, longest, rest.length // shortest + 1, endpoint=True)
    events = 1 + np.flatnonzero(subgoals.happened(rest.seen(slice(1, None))))
    edges = np.unique(np.concatenate([[0], np.cumsum(drawn), events, [rest.length]]))
    nothing = np.full(subgoals.dim + 1, np.nan)  # was chosen
    options = tuple(
        Option(int(start), int(end - start), nothing, nothing[:-1], np.nan, False, False, TerminationReason.EXPIRED)
        for start, end in pairwise(edges[edges <= rest.length])
    )
    return rest._replace(options=options)


def _without_first(episode: Episode, steps: int) -> Episode:
    """An episode that begins some steps later."""
    per_step = (name for name in Episode._fields if isinstance(getattr(episode, name), np.ndarray))
    return episode._replace(**{name: getattr(episode, name)[steps:] for name in per_step})
