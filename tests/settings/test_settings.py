"""One field is a setting everywhere: it is found in all that is derived; values are checked by type and domain."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
import math
import re
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pytest
import yaml
from corridor import Corridor
from torch import nn

from sb3_tbc import HAC, TBCHRL, HiTS
from sb3_tbc.errors import ConfigError
from sb3_tbc.settings import Increasing, Prefixed, Range, SettingError, Settings, describe, entries, read
from sb3_tbc.tbc_hrl.config import FlatConfig, HACConfig, HiTSConfig, TBCConfig
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.tbc_hrl.idle_settings import warn_of_idle_settings
from sb3_tbc.tbc_hrl.level_config import HighConfig, LowConfig, LowPolicyConfig
from sb3_tbc.zoo import schema
from sb3_tbc.zoo.algorithms import algorithm
from sb3_tbc.zoo.config import CONFIGS, load_config, nested, parse_overrides
from sb3_tbc.zoo.environments import task_names
from sb3_tbc.zoo.settings_page import settings_markdown, settings_text

ALL = {"tbc-hrl": TBCConfig, "hits": HiTSConfig, "hac": HACConfig, "sac": FlatConfig}


@dataclass(frozen=True, kw_only=True)
class CuriousLow(LowConfig):
    """A level with one setting more."""

    boredom: Annotated[float, Range(0, 1)] = 0.25
    """How soon the low level
    looks elsewhere."""


@dataclass(frozen=True, kw_only=True)
class CuriousConfig(TBCConfig):
    """An agent with one setting more on each place."""

    curiosity: Annotated[int, Range(1, 9)] = 3
    """How far the agent looks."""
    low: CuriousLow = CuriousLow()


class Curious(TBCHRL):
    config_class: ClassVar[type[TBCConfig]] = CuriousConfig


@pytest.fixture
def curious(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(schema.CONFIG_CLASSES, "tbc-hrl", CuriousConfig)


def make(algo: type[TBCHRL] = Curious, **settings: Any) -> TBCHRL:
    level = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}}
    return algo("MultiInputPolicy", Corridor(), max_options=5, compile=False, high=level, low=level, **settings)


class TestOneFieldIsEnough:
    """What a field is declared with is found wherever a user looks or writes."""

    def test_in_the_signature(self) -> None:
        parameters = inspect.signature(Curious).parameters
        assert parameters["curiosity"].default == 3
        assert parameters["curiosity"].annotation is int
        assert "curiosity" not in inspect.signature(TBCHRL).parameters

    def test_in_the_checks(self) -> None:
        assert make(curiosity=4).config.curiosity == 4  # type: ignore[attr-defined]
        with pytest.raises(ConfigError, match=r"curiosity must be a whole number from 1 to 9, got 10"):
            make(curiosity=10)
        with pytest.raises(ConfigError, match=r"unknown setting 'curiosty'; did you mean 'curiosity'"):
            make(curiosty=4)
        with pytest.raises(ConfigError, match=r"low\.boredom must be a number from 0 to 1, got nan"):
            Curious("MultiInputPolicy", Corridor(), low={"boredom": math.nan})

    def test_in_the_zip(self, tmp_path: Path) -> None:
        make(curiosity=5).save(tmp_path / "agent")
        loaded = Curious.load(tmp_path / "agent")
        assert loaded.config.curiosity == 5  # type: ignore[attr-defined]
        assert loaded.config.low.boredom == 0.25  # type: ignore[attr-defined]
        assert Curious.load(tmp_path / "agent", curiosity=6).config.curiosity == 6  # type: ignore[attr-defined]

    @pytest.mark.usefixtures("curious")
    def test_in_configurations(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.yml"
        path.write_text("default: {n_timesteps: 10, curiosity: 7, low: {boredom: 5e-1}}")
        assert load_config("tbc-hrl", "T", path=path).model == {"curiosity": 7, "low": {"boredom": 0.5}}
        path.write_text("default: {n_timesteps: 10, low: {boredom: 2}}")
        with pytest.raises(ConfigError, match=r"mine\.yml, section default: low\.boredom must be a number from 0"):
            load_config("tbc-hrl", "T", path=path)

    @pytest.mark.usefixtures("curious")
    def test_on_the_command_line(self) -> None:
        run = load_config("tbc-hrl", "Pendulum", overrides={"low": {"boredom": 0.5}, "curiosity": 2})
        assert (run.model["curiosity"], run.model["low"]["boredom"]) == (2, 0.5)

    @pytest.mark.usefixtures("curious")
    def test_in_help_and_documentation(self) -> None:
        text = settings_text("tbc-hrl")
        assert "curiosity: 3\n    How far the agent looks. Allowed: a whole number from 1 to 9." in text
        assert "low.boredom: 0.25\n    How soon the low level looks elsewhere." in text
        page = settings_markdown({"tbc-hrl": CuriousConfig})
        assert "- **`curiosity`** (`3`): How far the agent looks. *Allowed: a whole number from 1 to 9.*" in page
        assert page.index("### Low level: `low`") < page.index("- **`boredom`** (`0.25`)")


@pytest.mark.parametrize("config", ALL.values(), ids=list(ALL))
def test_every_setting_has_help_and_a_default_that_is_allowed(config: type[Settings]) -> None:
    for entry in entries(config):
        assert entry.text.endswith("."), f"{entry.name}: {entry.text!r}"
        assert entry.allowed
    settings = config()
    assert config.from_dict(settings.to_dict()) == settings
    assert config.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings
    assert config.from_dict(yaml.safe_load(yaml.safe_dump(settings.to_dict()))) == settings
    assert config.from_dict(dict.fromkeys(settings.to_dict())).to_dict().keys() == settings.to_dict().keys()


NONSENSE: dict[str, list[Any]] = {
    "low.tau": [0, 2, -0.1, "big", math.nan],
    "high.tau": [1.5],
    "low.gamma": [2, -1, math.inf, True],
    "high.gamma": [1.5, "one", [0.9]],
    "low.batch_size": [0, -1, 2.5, 1e12, "many", True],
    "high.buffer_size": [0, 1e15, 0.5, 10**400],
    "low.learning_rate": [0, -1e-3, "cos_1e-3", "lin_", "lin_-1", math.nan, math.inf],
    "low.ent_coef": [-1, "auto_", "auto_0", "automatic"],
    "low.target_entropy": ["low", math.nan],
    "low.n_hindsight_goals": [-1, math.nan, "some"],
    "low.goal_strategy": ["event", "future"],
    "low.average_decay": [1.0, -0.1],
    "high.n_hindsight_goals": [3],
    "low.policy_kwargs.net_arch": [[0], [-1], [2.5], ["64"], 64, {"pi": [4], "vf": [4]}, [10**9]],
    "low.policy_kwargs.netarch": [[64]],
    "low.policy_kwargs.mean_bound": [0, -1, math.nan],
    "low.policy_kwargs.log_std_bounds": [[1, 0], [1], [0, math.nan], 3],
    "low.policy_kwargs.activation_fn": ["softplus", nn.Softplus],
    "low.policy_kwargs.n_critics": [0],
    "low.policy_kwargs.features_extractor_class": [object],
    "low.policy_kwargs.ndbc.inter": [0, -3, 2.5, 10**9],
    "low.policy_kwargs.ndbc.interr": [3],
    "low.policy_kwargs.ndbc.sub_steps": [0, 10**9, 2.7],
    "low.policy_kwargs.ndbc.dynamics": ["euler"],
    "low.policy_kwargs.ndbc.readout": ["none"],
    "low.policy_kwargs.ndbc.max_rho": [0.9, 2],
    "low.policy_kwargs.ndbc.adaptive_step": [{"etta": 1}, {"delta_min": 0.5, "delta_max": 0.1}, {"delta_min": 1e-9}, 3],
    "low.policy_kwargs.ndbc.sensory_to": [["motor"], []],
    "low": [[1], 3, "fast"],
    "max_options": [0, -1, 2.5, "ten", True],
    "dt_min": [-1, math.nan],
    "dt_max": [0, -2, math.nan, 0.5],
    "duration": ["free", 1],
    "fixed_duration": [0, 5],
    "kappa": [0, -1, math.nan],
    "duration_loss_coef": [-1, math.nan],
    "decision_cost": [math.nan, -1, math.inf, 1e300],
    "duration_cost": [math.nan, -1],
    "completion_bonus": [math.nan, -1],
    "testing_penalty": [1, math.nan],
    "testing_fraction": [1.5, -0.1],
    "random_fraction": [2],
    "relabel_tolerance": [-0.1, math.nan],
    "n_hindsight_goals": [2.5, -1, "3"],
    "goal_strategy": ["final"],
    "gradient_ratio": [1e300, -1, math.nan],
    "learning_starts": [-1, 0.5],
    "memory": ["forever", None.__class__],
    "sequence_length": [0, 10**9, 2],
    "compile": ["yes", 1],
    "window_end": ["soon"],
    "on_bad_step": ["never", True],
    "hindsight_goals": ["asked"],
    "low.near_misses": [0.5],
    "high.learning_rate": [10**400],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in NONSENSE.items() for value in values])
def test_nonsense_is_one_clear_error(name: str, value: Any) -> None:
    with pytest.raises(ConfigError) as told:
        TBCHRL("MultiInputPolicy", Corridor(), **nested({name: value}))
    first, *others = str(told.value).splitlines()
    assert not others
    assert name.split(".")[-1] in first


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, vs in NONSENSE.items() for v in vs if not callable(v)])
def test_nonsense_in_a_file_or_command_is_told_before_anything_is_written(name: str, value: Any) -> None:
    def read_and_build() -> None:
        model = load_config("tbc-hrl", "Other-v0", overrides=nested({name: value})).model
        TBCConfig.from_dict({key: value for key, value in model.items() if key != "policy"})

    with pytest.raises(ConfigError):
        read_and_build()


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ("n_envs:1e9", "n_envs must be a whole number from 1 to 4,096, got 1000000000.0"),
        ("n_timesteps:-5", "n_timesteps must be a whole number from 1"),
        ("env_kwargs:3", "env_kwargs must be a section"),
        ("policy:MlpPolicy", "policy must be 'MultiInputPolicy', got 'MlpPolicy'"),
        ("low:{policy_kwargs: {net_arch: {pi: [4], vf: [4]}}}", "unknown setting 'low.policy_kwargs.net_arch.vf'"),
        ("gradient_ratio:1e300", "gradient_ratio must be a number from 0 to 1,000"),
    ],
)
def test_keys_of_the_runner(item: str, message: str) -> None:
    with pytest.raises(ConfigError) as told:
        parse_overrides([item])
    assert message in str(told.value)


def test_a_replay_buffer_below_one_batch_is_told_before_learning() -> None:
    model = TBCHRL("MultiInputPolicy", Corridor(), compile=False, low={"buffer_size": 100, "batch_size": 128})
    with pytest.warns(UserWarning, match=r"the low level is never updated: low\.buffer_size=100 holds"):
        model.learn(10)


@pytest.mark.parametrize("name", ["gamma", "tau", "batch_size", "buffer_size", "learning_rate", "policy_kwargs"])
def test_settings_of_a_level_belong_to_a_level(name: str) -> None:
    for algo in (TBCHRL, HiTS, HAC):
        with pytest.raises(ConfigError, match=rf"{name} belongs to a level, .* use low={{'{name}': ...}} and high="):
            algo("MultiInputPolicy", Corridor(), **{name: 1})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"device": "gpu"}, "device must be 'cpu', or 'auto', which is the same, got 'gpu'"),
        ({"device": "cuda"}, "got 'cuda': both levels act and learn on the CPU"),
        ({"seed": -1}, "seed must be a whole number from 0 to"),
        ({"verbose": 7}, "verbose must be a whole number from 0 to 2"),
        ({"subgoals": [1.0]}, "subgoals must be a SubgoalSpace or null"),
    ],
)
def test_arguments_of_the_constructor(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TBCHRL("MultiInputPolicy", Corridor(), **given)


def test_flat_mistakes_are_told_likewise() -> None:
    for given, message in (
        ({"gamma": 2}, r"gamma must be a number from 0 to 1, got 2"),
        ({"max_options": 3}, r"unknown setting 'max_options'"),
        ({"policy_kwargs": {"netarch": [3]}}, r"unknown setting 'policy_kwargs\.netarch'; did you mean 'net_arch'"),
        ({"n_hindsight_goals": 2.5}, r"n_hindsight_goals must be a whole number"),
        ({"device": "gpu"}, r"device must be 'auto', 'cpu', 'cuda' or 'cuda:<number>', got 'gpu'"),
    ):
        with pytest.raises(ConfigError, match=message):
            FlatSAC("MultiInputPolicy", Corridor(), **given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "positive"),
    [
        ({"target": "smdp", "completion_bonus": 1.0, "decision_cost": 1.0}, False),
        ({"target": "smdp", "completion_bonus": 1.5, "decision_cost": 1.0}, True),
        ({"target": "decision", "completion_bonus": 0.25}, True),
        ({"target": "decision"}, False),
    ],
)
def test_a_bonus_and_a_critic_that_cannot_be_positive_exclude_each_other(given: dict[str, Any], positive: bool) -> None:
    model = TBCHRL("MultiInputPolicy", Corridor(), compile=False, **given)
    assert model.high.policy.critic.negative is not positive
    high = {"policy_kwargs": {"negative_critic": True}}
    if positive:
        with pytest.raises(ConfigError, match=r"completion_bonus of .* makes rewards above zero"):
            TBCHRL("MultiInputPolicy", Corridor(), high=high, **given)
    else:
        assert TBCHRL("MultiInputPolicy", Corridor(), high=high, compile=False, **given).high.policy.critic.negative


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"low": {"policy_kwargs": {"ndbc": None}}, "memory": "window"}, "memory='window' .* is an MLP"),
        ({"reconsider_margin": 0.5}, "reconsider_margin=0.5 .* window_end='timed'"),
        ({"hindsight_cuts_fraction": 0.3}, "hindsight_cuts_fraction=0.3 has no effect"),
        ({"testing_fraction": 0.0, "testing_penalty": -1.0}, "testing_penalty has no effect"),
        ({"testing_fraction": 0.0, "deterministic_testing": True}, "deterministic_testing has no effect"),
        (
            {"low": {"policy_kwargs": {"ndbc": {"adaptive_step": {"relative_tolerance": 0.1}}}}},
            "adaptive_step.relative_tolerance=0.1 .* half_step_check",
        ),
        ({"low": {"policy_kwargs": {"ndbc": None, "gru": 4}}, "memory": "window"}, ""),
        ({"window_end": "reconsider", "reconsider_margin": 0.5, "testing_penalty": -1.0}, ""),
    ],
)
def test_settings_that_change_nothing_are_named_before_learning(given: dict[str, Any], named: str) -> None:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_idle_settings(TBCConfig.from_dict(given))
    assert len(said) == bool(named)
    assert all(re.search(named, str(warning.message)) for warning in said)


@pytest.mark.parametrize("algo", ["tbc-hrl", "hits", "hac"])
def test_no_shipped_setting_changes_nothing(algo: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for task, config in itertools.product((*task_names(), "PointMaze"), CONFIGS):
            settings = {k: v for k, v in load_config(algo, task, config).model.items() if k != "policy"}
            warn_of_idle_settings(algorithm(algo).config_class.from_dict(settings))  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"low": {"buffer_size": 49, "batch_size": 8}}, r"low\.buffer_size of 49 .* 50 transitions"),
        ({"high": {"buffer_size": 24, "batch_size": 8}}, r"high\.buffer_size of 24 .* 25 transitions"),
    ],
)
def test_buffers_that_an_episode_may_overflow_are_refused_before_any_step(given: dict[str, Any], message: str) -> None:
    model = TBCHRL("MultiInputPolicy", Corridor(), max_options=5, compile=False, **given)
    with pytest.raises(ConfigError, match=message):
        model.learn(10)
    assert model.num_timesteps == 0


def test_the_fullest_episode_fits_the_smallest_buffers() -> None:
    """Each option a failed test, nothing reached, time used up: the most rows that there can be."""
    sizes = {level: {"buffer_size": size, "batch_size": 8} for level, size in (("high", 30), ("low", 50))}
    env = Corridor(goal=5.0)
    tested: dict[str, Any] = {"duration": "fixed", "testing_fraction": 1.0, "keep_original": True, **sizes}
    model = TBCHRL("MultiInputPolicy", env, max_options=5, goal_strategy="episode", gradient_ratio=0.0, **tested)
    model.learn(150)
    assert model.num_timesteps == 150
    assert all(buffer.full for buffer in model.replay_buffer)


@pytest.mark.parametrize("reward", ["sparse", "dense", "step"])
def test_a_low_level_that_is_rewarded_has_no_negative_critic(reward: str) -> None:
    given = {"low_reward": reward, "low": {"policy_kwargs": {"negative_critic": True}}}
    if reward == "step":
        assert TBCConfig.from_dict(given).low.policy_kwargs.negative_critic
        return
    with pytest.raises(ConfigError, match=rf"low.policy_kwargs.negative_critic keeps .* low_reward='{reward}'"):
        TBCConfig.from_dict(given)


def test_mappings_dataclasses_and_numpy_numbers_are_taken() -> None:
    low = LowConfig(gamma=0.9, policy_kwargs=LowPolicyConfig(net_arch=(8,), ndbc=None))
    model = TBCHRL("MultiInputPolicy", Corridor(), low=low, high=HighConfig(batch_size=8), max_options=np.int64(5))
    assert (model.low.gamma, model.low.state_dim, model.config.high.batch_size) == (0.9, 0, 8)
    assert type(model.config.max_options) is int
    again = TBCHRL("MultiInputPolicy", Corridor(), **model.settings)
    assert again.config == model.config
    partly = HiTS("MultiInputPolicy", Corridor(), low={"policy_kwargs": {"ndbc": {"inter": 3}}})
    assert partly.config.low.policy_kwargs.ndbc is not None
    assert (partly.config.low.policy_kwargs.ndbc.inter, partly.config.low.policy_kwargs.ndbc.command) == (3, 6)


def test_none_stands_for_the_default() -> None:
    model = HAC("MultiInputPolicy", Corridor(), window_end=None, duration=None, low=None, high=None)  # type: ignore[arg-type]
    assert model.config == HACConfig()


@pytest.mark.parametrize("name", ["circuit", "readout", "adaptive_step"])
def test_options_of_the_circuit_reach_it_from_the_command_line(name: str) -> None:
    given = {
        "circuit": ("low.policy_kwargs.ndbc.dynamics:dissipative", "low.policy_kwargs.ndbc.max_rho:0.9"),
        "readout": ("low.policy_kwargs.ndbc.readout:motor",),
        "adaptive_step": ("low.policy_kwargs.ndbc.adaptive_step:{eta: 1e0, delta_min: 1e-1}",),
    }[name]
    model = TBCHRL("MultiInputPolicy", Corridor(), compile=False, **parse_overrides(given))
    net = model.low.policy.actor.net  # type: ignore[union-attr]
    if name == "circuit":
        assert net.certificate().rho < 0.9 + 1e-6
    elif name == "readout":
        assert net.read_from > 0
    else:
        assert (net.step_rule.eta, net.step_rule.delta_min) == (1.0, 0.1)


def test_types_in_words() -> None:
    assert describe(Annotated[float, Range(0, 1, above=True)]) == "a number above 0 and at most 1"
    assert describe(Annotated[float, Range(1, also=(-1,))]) == "a number of at least 1 or -1"
    assert describe(Literal["a", "b"] | None) == "one of 'a', 'b' or null"
    assert describe(Annotated[str, Prefixed("lin_", Range(0, above=True))]) == "'lin_<number above 0>'"
    assert describe(Annotated[tuple[float, float], Increasing()]) == "a list of 2 numbers in rising order"


def test_text_that_looks_like_a_number_is_named_as_text() -> None:
    with pytest.raises(SettingError, match=r"x must be a number, got '3' \(text\)"):
        read("3", float, "x")


def test_fields_cannot_be_changed_afterwards() -> None:
    config = TBCConfig()
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.low.gamma = 0.5  # type: ignore[misc]
    assert dataclasses.replace(config.low, gamma=0.5).gamma == 0.5
    with pytest.raises(SettingError, match="gamma"):
        dataclasses.replace(config.low, gamma=5)


def test_type_checkers_know_every_argument(tmp_path: Path) -> None:
    """The constructor's type is the settings class's own."""
    pytest.importorskip("mypy")
    script = tmp_path / "user.py"
    script.write_text(
        "from sb3_tbc import TBCHRL\n"
        'TBCHRL("MultiInputPolicy", "x", max_options=3, low={"gamma": 0.9}, seed=1)\n'
        'TBCHRL("MultiInputPolicy", env="x", max_options=3)\n'
        'TBCHRL("MultiInputPolicy", "x", max_options="3")\n'
        'TBCHRL("MultiInputPolicy", "x", max_option=3)\n'
        'TBCHRL("MultiInputPolicy", "x", window_end="soon")\n'
    )
    command = [sys.executable, "-m", "mypy", "--no-error-summary", "--follow-imports=silent", str(script)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert "user.py:2" not in done.stdout
    assert "user.py:3" not in done.stdout
    for line, part in ((4, "max_options"), (5, 'Unexpected keyword argument "max_option"'), (6, "window_end")):
        assert any(f"user.py:{line}:" in told and part in told for told in done.stdout.splitlines())
