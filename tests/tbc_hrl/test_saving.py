"""Settings that loading changes: what follows from them begins anew, what the weights do not fit is refused."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from corridor import Corridor
from stable_baselines3 import PPO

from sb3_tbc import NDBCSAC, TBCHRL
from sb3_tbc.errors import ConfigError, WriteError
from sb3_tbc.settings import SettingError
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.tbc_hrl.level_config import LowConfig
from sb3_tbc.tbc_hrl.saving import PlainAlgorithm

LEVEL: dict[str, Any] = {"batch_size": 8, "buffer_size": 500, "policy_kwargs": {"net_arch": [8]}}


def agent(**settings: Any) -> TBCHRL:
    given = {"high": LEVEL, "low": LEVEL, "max_options": 5, "gradient_ratio": 0.2, "compile": False, "seed": 0}
    return TBCHRL("MultiInputPolicy", Corridor(20), **{**given, **settings})


def saved(model: PlainAlgorithm) -> io.BytesIO:
    file = io.BytesIO()
    model.save(file)  # type: ignore[arg-type]
    return file


@pytest.fixture(scope="module")
def taught() -> TBCHRL:
    return agent().learn(60)


def temperature(level: Any) -> float:
    return float(level.ent_coef_tensor if level.log_ent_coef is None else level.log_ent_coef.detach().exp())


@pytest.mark.parametrize(
    ("level", "ent_coef", "begins"),
    [
        ("low", 0.1, 0.1),
        ("low", "auto_0.25", 0.25),
        ("low", "auto", None),
        ("high", "auto", 1.0),
        ("high", 0.2, 0.2),
        ("high", 1.0, 1.0),
    ],
)
def test_another_temperature_begins_anew(taught: TBCHRL, level: str, ent_coef: Any, begins: float | None) -> None:
    file = saved(taught)
    model = TBCHRL.load(file, env=Corridor(20), **{level: {"ent_coef": ent_coef, "batch_size": 4}})  # type: ignore[arg-type]
    expected = temperature(taught.low) if begins is None else begins
    assert temperature(getattr(model, level)) == pytest.approx(expected)
    other = "low" if level == "high" else "high"
    assert temperature(getattr(model, other)) == temperature(getattr(taught, other))
    assert model.settings[level]["ent_coef"] == ent_coef
    assert model.settings[level]["batch_size"] == 4
    for name in ("high", "low"):
        old, new = getattr(taught, name), getattr(model, name)
        for key, value in old.policy.state_dict().items():
            np.testing.assert_array_equal(new.policy.state_dict()[key].numpy(), value.numpy(), err_msg=key)
        th.testing.assert_close(new.critic.optimizer.state_dict(), old.critic.optimizer.state_dict())
    model.learn(40, reset_num_timesteps=False)
    again = TBCHRL.load(saved(model))  # type: ignore[arg-type]
    assert temperature(getattr(again, level)) == temperature(getattr(model, level))


@pytest.mark.parametrize(
    ("duration", "changes", "estimates"),
    [
        ("joint", {"duration_loss_coef": 1.0}, True),
        ("fixed", {"duration": "rule"}, True),
        ("rule", {"duration": "fixed", "fixed_duration": 3}, False),
    ],
)
def test_the_reachability_estimate_comes_and_goes(duration: str, changes: Any, estimates: bool) -> None:
    model = TBCHRL.load(saved(agent(duration=duration)), env=Corridor(20), **changes)  # type: ignore[arg-type]
    assert (model.reachability is not None) == estimates
    assert changes.items() <= model.settings.items()
    model.learn(40)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"duration": "rule"}, "duration"),
        ({"low": {"critic_norm": "layer", "batch_size": 4}}, "low.critic_norm"),
        ({"high": {"critic_norm": "batch"}}, "high.critic_norm"),
        ({"low": {"policy_kwargs": {"n_critics": 3}}, "max_options": 3}, "low.policy_kwargs.n_critics"),
        ({"low": {"policy_kwargs": {"ndbc": None}, "ent_coef": 0.1}}, "low.policy_kwargs.ndbc"),
        ({"low": {"policy_kwargs": {"ndbc": {"seed": 1}}}}, "low.policy_kwargs.ndbc.seed"),
        ({"low": {"policy_kwargs": {"ndbc": {"synapses": "lean"}}}}, "low.policy_kwargs.ndbc.synapses"),
    ],
)
def test_what_the_weights_do_not_fit_is_refused_by_name(taught: TBCHRL, changes: Any, named: str) -> None:
    with pytest.raises(SettingError, match=f"^{named} cannot be changed when an agent is loaded: the saved weights"):
        TBCHRL.load(saved(taught), env=Corridor(20), **changes)  # type: ignore[arg-type]


def test_another_scale_of_inputs_is_refused(taught: TBCHRL) -> None:
    """The scale is saved with the weights, so that of the settings would never be used."""
    scale = (1.0 / taught.low.policy.actor.net.input_gain).tolist()  # type: ignore[union-attr]
    low: Any = {"policy_kwargs": {"net_arch": [8], "ndbc": {"input_scale": scale}}}
    TBCHRL.load(saved(taught), low=low)  # type: ignore[arg-type]
    low["policy_kwargs"]["ndbc"]["input_scale"] = [9.0] * len(scale)
    with pytest.raises(SettingError, match=r"^low\.policy_kwargs\.ndbc\.input_scale cannot be changed when an agent"):
        TBCHRL.load(saved(taught), low=low)  # type: ignore[arg-type]


def test_what_is_not_named_within_a_section_stays() -> None:
    """As in configuration files; the bound of means, which no weight shows, fell back to the default in silence."""
    kwargs: Any = {**LEVEL["policy_kwargs"], "mean_bound": 2.0, "ndbc": {"seed": 3}}
    model = TBCHRL("MultiInputPolicy", Corridor(20), low={**LEVEL, "policy_kwargs": kwargs})
    changes: Any = {"policy_kwargs": {"log_std_bounds": (-4.0, 1.0), "ndbc": {"sub_steps": 5}}}
    loaded = TBCHRL.load(saved(model), low=changes)
    settings = loaded.config.low.policy_kwargs
    assert (settings.mean_bound, settings.log_std_bounds, settings.net_arch) == (2.0, (-4.0, 1.0), (8,))
    assert (settings.ndbc.seed, settings.ndbc.sub_steps) == (3, 5)  # type: ignore[union-attr]
    assert loaded.low.policy.actor.net.sub_steps == 5  # type: ignore[union-attr]


def test_a_level_may_be_given_as_settings_and_neutral_arguments_of_sb3_pass(taught: TBCHRL) -> None:
    low = LowConfig(batch_size=4, buffer_size=300, policy_kwargs=LEVEL["policy_kwargs"])
    model = TBCHRL.load(saved(taught), env=Corridor(20), low=low, use_sde=False)  # type: ignore[arg-type]
    assert (model.config.low.batch_size, model.config.low.buffer_size) == (4, 300)
    with pytest.raises(SettingError, match="use_sde is not taken"):
        TBCHRL.load(saved(taught), use_sde=True)  # type: ignore[arg-type]


def test_an_agent_of_another_algorithm_is_refused_by_its_policy(taught: TBCHRL) -> None:
    files: list[tuple[type[PlainAlgorithm], io.BytesIO]] = [
        (TBCHRL, saved(taught)),
        (FlatSAC, saved(FlatSAC("MultiInputPolicy", Corridor(20), buffer_size=500))),
        (NDBCSAC, saved(NDBCSAC("MultiInputPolicy", Corridor(20), buffer_size=500))),
    ]
    for algorithm, _ in files:
        for saver, file in files:
            file.seek(0)
            if algorithm is saver:
                assert isinstance(algorithm.load(file), algorithm)  # type: ignore[arg-type]  # SB3 names no open files
                continue
            with pytest.raises(ConfigError, match=f"{algorithm.__name__} has a .*: load it with the class"):
                algorithm.load(file)  # type: ignore[arg-type]


@pytest.mark.parametrize("trust", [False, True])
def test_an_agent_of_stable_baselines3_is_refused_before_trust_is_asked_for(taught: TBCHRL, trust: bool) -> None:
    file = io.BytesIO()
    PPO("MultiInputPolicy", Corridor(20), n_steps=8, batch_size=8).save(file)  # type: ignore[arg-type]
    for kind in (TBCHRL, FlatSAC, NDBCSAC):
        with pytest.raises(ConfigError, match=r"where .* has a .*: load it with the class that saved it"):
            kind.load(file, trust=trust)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="policy is a TBCPolicy"):
        FlatSAC.load(saved(taught), trust=trust)  # type: ignore[arg-type]


def test_odd_arguments_of_loading_and_saving_are_refused_in_one_line(taught: TBCHRL) -> None:
    for path in (None, 3, ["a"]):
        with pytest.raises(TypeError, match=r"from the path of its \.zip, or from an open file"):
            TBCHRL.load(path)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="device must be"):
        TBCHRL.load(saved(taught), device="tpu")  # type: ignore[arg-type]
    with pytest.raises(WriteError, match="it is a folder"):
        taught.save("")


def changed(file: io.BytesIO, change: Callable[[dict[str, Any]], object]) -> Any:
    """The file with another table ``data``."""
    new = io.BytesIO()
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(new, "w") as archive:
        for name in old.namelist():
            content = old.read(name)
            if name == "data":
                data = json.loads(content)
                change(data)
                content = json.dumps(data).encode()
            archive.writestr(name, content)
    return new


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("policy_kwargs", "x", "its entry policy_kwargs must be dict, got 'x'"),
        ("num_timesteps", None, "its entry num_timesteps must be int, got None"),
        ("_owed", [], "its entry _owed must be dict or int or float"),
        ("subgoals", "x", "its entry subgoals must be SubgoalSpace or null"),
        ("action_noise", -1, "its entry action_noise must be ActionNoise or null"),
        ("use_sde", "x", "its entry use_sde must be bool"),
        ("observation_space", -1, "its entry observation_space must be Space"),
        ("ep_info_buffer", "x", "its entry ep_info_buffer must be deque or null"),
    ],
)
def test_entries_of_another_kind_are_named(taught: TBCHRL, name: str, value: Any, message: str) -> None:
    file = changed(saved(taught), lambda data: data.update({name: value}))
    with pytest.raises(ConfigError, match=f"the agent is damaged: {message}"):
        TBCHRL.load(file)


@pytest.mark.parametrize("name", ["observation_space", "action_space", "policy_class"])
@pytest.mark.parametrize("trust", [True, False])
def test_entries_that_are_missing_are_named(taught: TBCHRL, name: str, trust: bool) -> None:
    file = changed(saved(taught), lambda data: data.pop(name))
    with pytest.raises(ConfigError, match=f"the agent is damaged: it has no entry {name}"):
        TBCHRL.load(file, trust=trust)
