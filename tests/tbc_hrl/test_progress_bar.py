"""What SB3's progress bar says before the first step."""

import pytest
from corridor import Corridor
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback

from sb3_tbc import TBCHRL
from sb3_tbc.level.level import SACLevel
from sb3_tbc.tbc_hrl.diagnostics import described, progress_bar_of


class Bar:
    """Notes what it is told to show."""

    def __init__(self) -> None:
        self.shown: list[str | None] = []

    def set_description(self, text: str | None) -> None:
        self.shown.append(text)


def test_bar_is_found_in_nested_callbacks() -> None:
    progress = ProgressBarCallback()
    progress.pbar = bar = Bar()
    assert progress_bar_of(CallbackList([CallbackList([]), CallbackList([progress])])) is bar
    assert progress_bar_of(CallbackList([CallbackList([])])) is None


def test_description_goes_away_again() -> None:
    bar = Bar()
    with pytest.raises(KeyError), described(bar, "busy"):
        raise KeyError
    assert bar.shown == ["busy", None]
    with described(None, "busy"):
        pass
    with described(bar, ""):
        pass
    assert bar.shown == ["busy", None]


def test_learning_says_that_it_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    bar, seen = Bar(), []

    def prepare(level: SACLevel, batch_size: int, compile: bool | str | None = None) -> float:
        seen.append(bar.shown[-1])
        return 0.0

    class Shown(ProgressBarCallback):
        def _on_training_start(self) -> None:
            self.pbar = bar

        def _on_step(self) -> bool:
            return True

        _on_training_end = BaseCallback._on_training_end

    monkeypatch.setattr(SACLevel, "prepare", prepare)
    model = TBCHRL("MultiInputPolicy", Corridor(), compile=True, gradient_ratio=0.0)
    model.learn(20, callback=Shown())
    assert seen == ["compiling the high level's update", "compiling the low level's update"]
    assert bar.shown[-1] is None
