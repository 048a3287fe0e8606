"""The paper's figures, shipped with the package, for comparison with ours."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import NamedTuple

import yaml


class Figure(NamedTuple):
    """A success rate of the paper, 0 to 1, with the standard deviation over its ten seeds."""

    mean: float
    sd: float


class Paper(NamedTuple):
    """Tables 1 to 3 and the published HiTS policies, from ``paper.yml``."""

    source: str
    steps: Mapping[str, int]
    figures: Mapping[str, Mapping[str, tuple[float, float]]]
    public_hits: Mapping[str, float]

    def success(self, task: str, method: str) -> Figure | None:
        """The paper's figure for one of our rows; ``None`` if the paper has none."""
        percent = self.figures.get(task, {}).get(method)
        return None if percent is None else Figure(percent[0] / 100, percent[1] / 100)


def load_paper() -> Paper:
    """Read ``paper.yml``."""
    text = resources.files("sb3_tbc.report").joinpath("paper.yml").read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    return Paper(data["source"], data["training_steps"], data["success_percent"], data["public_hits"])
