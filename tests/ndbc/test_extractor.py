"""NDBCNet inside stock Stable-Baselines3 algorithms."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.preprocessing import preprocess_obs

from sb3_tbc.ndbc.extractor import NDBCExtractor


def test_stock_sac_trains_saves_and_loads_with_it(tmp_path) -> None:
    kwargs = {
        "features_extractor_class": NDBCExtractor,
        "features_extractor_kwargs": {"features_dim": 8, "wiring": {"inter": 6, "command": 5, "motor": 3}},
        "net_arch": [8],
    }
    model = SAC("MlpPolicy", gym.make("Pendulum-v1"), policy_kwargs=kwargs, learning_starts=20, batch_size=16, seed=0)
    before = model.policy.critic.features_extractor.net.cell.raw_leak.detach().clone()
    model.learn(40)
    assert not th.equal(before, model.policy.critic.features_extractor.net.cell.raw_leak)
    model.save(tmp_path / "model")
    observation = np.array([0.3, -0.9, 4.0], dtype=np.float32)
    loaded = SAC.load(tmp_path / "model")
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )


def test_dict_observations_are_joined_and_scaled_by_their_bounds() -> None:
    space = spaces.Dict({"a": spaces.Box(-4.0, 2.0, (2,)), "b": spaces.Box(-np.inf, np.inf, (3,))})
    extractor = NDBCExtractor(space, features_dim=5)
    np.testing.assert_allclose(extractor.net.input_gain.numpy(), [0.25, 0.25, 1.0, 1.0, 1.0])
    parts = {"a": th.randn(7, 2), "b": th.randn(7, 3)}
    th.testing.assert_close(extractor(parts), extractor.net(th.cat([parts["a"], parts["b"]], dim=1))[0])
    with pytest.raises(ValueError, match="Box"):
        NDBCExtractor(spaces.Discrete(3))


def test_dict_observations_are_joined_in_the_order_of_the_space() -> None:
    """Environments give their keys in any order, vectors of environments in that of the space."""
    space = spaces.Dict({"b": spaces.Box(-1.0, 1.0, (3,)), "a": spaces.Box(-4.0, 2.0, (2,))})
    extractor = NDBCExtractor(space, features_dim=5)
    parts = {"b": th.randn(7, 3), "a": th.randn(7, 2)}
    turned = {"a": parts["a"], "b": parts["b"]}
    th.testing.assert_close(extractor(parts), extractor(turned), rtol=0, atol=0)


def test_images_are_scaled_once() -> None:
    space = spaces.Box(0, 255, (3, 6, 6), np.uint8)
    extractor = NDBCExtractor(space, features_dim=5)
    given = preprocess_obs(th.full((1, 3, 6, 6), 255), space)
    assert float((given.flatten() * extractor.net.input_gain).max()) == 1.0  # type: ignore[union-attr]


@pytest.mark.parametrize("rule", [True, {"refresh_every": 5}])
def test_a_step_rule_that_would_never_look_again_is_refused(rule) -> None:
    with pytest.raises(ValueError, match="NDBCSAC take it"):
        NDBCExtractor(spaces.Box(-1.0, 1.0, (3,)), adaptive_step=rule)
    NDBCExtractor(spaces.Box(-1.0, 1.0, (3,)), adaptive_step=False)
