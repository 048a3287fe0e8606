"""Subgoal spaces: which points count as reached."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_tbc.smdp.spaces import SubgoalSpace


def make(groups: Sequence[Sequence[int]] | None, thresholds: Sequence[float]) -> SubgoalSpace:
    return SubgoalSpace.from_slices(
        [-1, -1], [1, 1], thresholds, local_scale=np.ones(1), names=["x", "y"], groups=groups
    )


@pytest.mark.parametrize(
    ("groups", "thresholds"), [(None, [0.01, 0.5]), ([[0], [1]], [0.01, 0.5]), ([[1], [0]], [0.5, 0.01])]
)
def test_each_coordinate_has_the_threshold_of_its_group(
    groups: Sequence[Sequence[int]] | None, thresholds: list[float]
) -> None:
    space = make(groups, thresholds)
    points = np.array([[0.1, 0.0], [0.0, 0.1], [0.005, 0.4], [0.0, 0.6]])
    assert space.tolerance.tolist() == [0.01, 0.5]
    assert space.reached(points, np.zeros(2)).tolist() == [False, True, True, False]


def test_a_group_may_not_be_empty() -> None:
    with pytest.raises(ValueError, match=r"groups must use each of the 2 coordinates once, got \(\(\), \(0, 1\)\)"):
        make([[], [0, 1]], [0.1, 0.1])


def box(*shape: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float64)


def test_maps_take_batches() -> None:
    space = spaces.Dict({"observation": box(4), "achieved_goal": box(2), "desired_goal": box(2)})
    for dim in (1, 2, 3):

        def first(observation: Any, dim: int = dim) -> Any:
            return observation["observation"][:dim]

        def last_axis(observation: Any, dim: int = dim) -> Any:
            return observation["observation"][..., :dim]

        for achieved in (first, last_axis):
            names = ["x", "y", "z"][:dim]
            made = SubgoalSpace(
                [-1] * dim, [1] * dim, [0.1] * dim, achieved, lambda o: o["observation"], np.ones(4), names
            )
            if achieved is last_axis:
                made.check_fits(space)
                continue
            with pytest.raises(
                ValueError, match=rf"achieved map gives .* of \d observations at once, \(\d, {dim}\) is due"
            ):
                made.check_fits(space)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"low": [-np.inf]}, "bounds must be two vectors of finite numbers"),
        ({"local_scale": [0.0]}, "local_scale must be a vector of finite numbers above 0"),
        ({"local_scale": [np.inf]}, "local_scale must"),
        ({"local_scale": 2.0}, "local_scale must"),
        ({"groups": [[0.0]]}, "whole numbers"),
        ({"event": True}, "event must be the index"),
    ],
)
def test_what_would_fail_or_mislead_later_is_refused(given: dict[str, Any], message: str) -> None:
    usual: dict[str, Any] = {"low": [-1], "high": [1], "thresholds": [0.1], "local_scale": [1.0], "names": ["x"]}
    SubgoalSpace.from_slices(**usual)
    with pytest.raises(ValueError, match=message):
        SubgoalSpace.from_slices(**{**usual, **given})


def test_an_event_is_an_entry_of_the_observation() -> None:
    space = spaces.Dict({"observation": box(4), "achieved_goal": box(1), "desired_goal": box(1)})
    for event in (3, 4):
        made = SubgoalSpace.from_slices([-1], [1], [0.1], local_scale=np.ones(4), names=["x"], event=event)
        if event == 3:
            made.check_fits(space)
            continue
        with pytest.raises(
            ValueError, match="event is the index of a flag in the observation, which has 4 entries; got 4"
        ):
            made.check_fits(space)
