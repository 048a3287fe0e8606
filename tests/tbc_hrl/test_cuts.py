"""Agents whose high level learns from episodes that are cut anew."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from corridor import Corridor

from sb3_tbc import TBCHRL
from sb3_tbc.tbc_hrl import assembly

LEVEL: dict[str, Any] = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}}


def make(**kwargs: Any) -> TBCHRL:
    given = {"high": LEVEL, "low": LEVEL, "max_options": 6, "gradient_ratio": 0.1, "compile": False, "seed": 0}
    return TBCHRL("MultiInputPolicy", Corridor(30), **{**given, **kwargs})


@pytest.mark.parametrize(
    ("settings", "lengths"),
    [
        ({}, (1, 5)),
        ({"dt_min": 2.0, "dt_max": 4.5}, (2, 5)),
        ({"dt_min": 2.2, "dt_max": 4.4, "whole_budgets": True}, (2, 4)),
        ({"duration": "fixed", "target": "decision"}, (5, 5)),
        ({"duration": "fixed", "fixed_duration": 3.5, "target": "decision"}, (4, 4)),
    ],
)
def test_windows_are_as_long_as_the_high_level_may_choose_them(
    settings: dict[str, Any], lengths: tuple[int, int]
) -> None:
    model = make(**settings)
    assert assembly.cut_lengths(model.config, model.rules) == lengths


def test_the_high_level_has_more_to_learn_from() -> None:
    without, with_cuts = (make(n_hindsight_cuts=cuts).learn(60).replay_buffer.high for cuts in (0, 4))
    assert with_cuts.size() > 2 * without.size()
    assert np.isfinite(with_cuts.data["actions"][: with_cuts.size()]).all()


def test_a_small_buffer_takes_as_much_of_the_cuts_as_it_holds() -> None:
    model = make(high={**LEVEL, "buffer_size": 6 * 5}, n_hindsight_cuts=20).learn(60)
    assert model.replay_buffer.high.size() == 30


def test_cuts_end_after_their_share_of_the_training() -> None:
    """Corridor's episodes end one by one, so that rows per option tell when cuts were made."""

    def rows_in(fraction: float, steps: tuple[int, int]) -> int:
        model, sizes = make(n_hindsight_cuts=4, hindsight_cuts_fraction=fraction), []

        def note(local: Any, _: Any) -> bool:
            sizes.append(local["replay_buffer"].high.size())
            return True

        model.learn(240, callback=note)
        return sizes[steps[1] - 1] - sizes[steps[0] - 1]

    always, early, never = (rows_in(fraction, (120, 240)) for fraction in (1.0, 0.5, 0.0))
    assert early < always / 2
    assert never < always / 2
    assert rows_in(0.5, (1, 120)) == rows_in(1.0, (1, 120))
