"""NDBCNet as a features extractor of any Stable-Baselines3 policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_tbc.aliases import PlainMapping, Space
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring


class NDBCExtractor(BaseFeaturesExtractor):
    """Features read out of an NDBC circuit that starts at rest for every observation.

    SB3's extractors have no memory: the K sub-steps are all the time the circuit gets. For memory between steps use
    :class:`NDBCNet` itself, or the low level of ``TBCHRL``.

    Use it as ``policy_kwargs={"features_extractor_class": NDBCExtractor, "features_extractor_kwargs": {...}}``.

    :param observation_space: a Box, or a Dict of Boxes, whose entries are joined in the order of the space's keys
    :param features_dim: number of features
    :param wiring: the wiring's numbers, as :class:`NDBCWiring` takes them, without ``n_inputs``
    :param input_scale: fixed scales the joined observation is divided by; by default the largest finite bound of each
        entry, and 1 where there is none
    :param kwargs: further options of :class:`NDBCNet`, but for ``adaptive_step``
    :raises ValueError: for other spaces, and for ``adaptive_step``
    """

    def __init__(
        self,
        observation_space: Space,
        features_dim: int = 32,
        wiring: PlainMapping | None = None,
        input_scale: Sequence[float] | None = None,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("adaptive_step", False) is not False:  # K would stay that of the first weights for ever
            raise ValueError(
                "adaptive_step looks at the weights after updates, of which SB3 tells no features extractor: leave it "
                "out and choose sub_steps; NDBCNet itself and NDBCSAC take it"
            )
        super().__init__(observation_space, features_dim)
        is_dict = isinstance(observation_space, spaces.Dict)
        self.keys = list(observation_space.spaces) if is_dict else []  # type: ignore[attr-defined]
        parts = [observation_space[key] for key in self.keys] if is_dict else [observation_space]  # type: ignore[index]
        boxes = [part for part in parts if isinstance(part, spaces.Box)]
        if len(boxes) < len(parts):
            raise ValueError(f"NDBCExtractor takes a Box or a Dict of Boxes, got {observation_space}")
        natural = [number for box in boxes for number in input_scale_of(box)]
        drawn = NDBCWiring(len(natural), **(DEFAULT_NUMBERS | dict(wiring or {})))
        scale = natural if input_scale is None else input_scale
        self.net = NDBCNet(len(natural), features_dim, drawn, input_scale=scale, **kwargs)

    def forward(self, observations: th.Tensor | dict[str, th.Tensor]) -> th.Tensor:
        """Features ``(batch, features_dim)``."""
        if isinstance(observations, dict):
            observations = th.cat([observations[key].flatten(1) for key in self.keys], dim=1)
        features: th.Tensor = self.net(observations.flatten(1))[0]
        return features


def input_scale_of(box: spaces.Box) -> list[float]:
    """What each number of an observation is divided by: its largest bound, or 1 where it has no sensible one.

    Images are divided by 1, as SB3's policies have divided them by 255 already.
    """
    if is_image_space(box):
        return [1.0] * int(np.prod(box.shape))
    bounds = np.maximum(np.abs(box.low), np.abs(box.high)).ravel()
    usable = np.isfinite(bounds) & (bounds > 0) & (bounds < 1e6)
    scale: list[float] = np.where(usable, bounds, 1.0).tolist()
    return scale


DEFAULT_NUMBERS = {
    "inter": 12, "command": 10, "motor": 8,
    "sensory_fanout": 5, "inter_fanout": 8, "recurrent_command_synapses": 2, "motor_fanin": 6,
}  # fmt: skip
"""Table A1's largest wiring, AntFourRooms."""
