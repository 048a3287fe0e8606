"""Saving agents in a form that can be loaded without running code, and loading it."""

from __future__ import annotations

import contextlib
import copy
import io
import pathlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TensorDict

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.files import save_atomic
from sb3_tbc.settings import SettingError, Settings, hints, plain
from sb3_tbc.smdp.episode_limit import with_episode_limit
from sb3_tbc.smdp.faults import named_reset
from sb3_tbc.tbc_hrl.archive import check_entries, pickled_keys, policy_of, read_bytes, read_data, unpickled, with_plain
from sb3_tbc.tbc_hrl.checks import device_here, without_sb3_names
from sb3_tbc.tbc_hrl.plain import NotPlainError, encode

SelfPlain = TypeVar("SelfPlain", bound="PlainAlgorithm")

ENT_COEF = "ent_coef"
PARTS = (ENT_COEF, "duration", "fixed_duration", "duration_loss_coef")
"""Settings that decide which parts an agent has, such as an optimizer. They are changed after it was loaded."""
LEVELS = ("high", "low")
TEMPERATURE = ("ent_coef_optimizer", "log_ent_coef", "ent_coef_tensor")
"""Where SB3's SAC keeps what an ``ent_coef`` has become."""
SHAPES = frozenset({"duration", "window_end", "remaining_time", "critic_norm", "policy_kwargs", "subgoals"})
"""Settings, or sections of them, that shape the networks."""
LIBRARIES = ("stable_baselines3.", "sb3_contrib.", "sbx.")
"""Modules below these are not a user's own."""
UNFIT = (
    "cannot be changed when an agent is loaded: the saved weights do not fit the networks it would have; leave it out, "
    "or train a new agent"
)


class PlainAlgorithm(BaseAlgorithm):
    """An SB3 algorithm whose ``.zip`` holds, besides what SB3 pickles, the same as plain JSON, from which it loads.

    SB3's own functions read the file as any other.
    """

    config_class: ClassVar[type[Settings]] = Settings
    """The agent's settings; none of its own where the algorithm takes SB3's."""
    more_changes: ClassVar[tuple[str, ...]] = ()
    """What loading can change, or explains, besides settings and what the file holds."""

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Write the agent to a ``.zip``, see SB3; a file that is there is replaced at once or not at all.

        :raises WriteError: if it cannot be written
        """
        buffer = io.BytesIO()
        super().save(buffer, exclude, include)
        content = buffer.getvalue()
        content = with_plain(content, self._plain(content))
        if not isinstance(path, str | pathlib.Path):
            path.write(content)
            return
        target = pathlib.Path(path)
        target = target if target.suffix or not target.name else target.with_suffix(".zip")
        save_atomic(lambda name: pathlib.Path(name).write_bytes(content), target)

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """Take over copies of parameters, see SB3."""
        # torch's optimizers keep the very moments that they are given: two agents would go on to share them
        super().set_parameters(copy.deepcopy(load_path_or_dict), exact_match, device)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        """Begin to learn, see SB3; an environment that fails or hangs at its first reset is named."""
        resets = reset_num_timesteps or self._last_obs is None
        if self.env is not None:
            with_episode_limit(self.env)
        with named_reset(self.env) if resets and self.env is not None else contextlib.nullcontext():
            return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)

    def _plain(self, content: bytes) -> Plain:
        """What SB3 has pickled, as far as it has a plain form; the rest needs ``trust=True`` when it is loaded."""
        plain = {}
        for key in pickled_keys(read_data(content, type(self).__name__)):
            try:
                plain[key] = encode(getattr(self, key))
            except NotPlainError:
                continue
        return plain

    @classmethod
    def _changes(cls, given: PlainMapping, data: PlainMapping) -> Plain:
        """Attributes that loading is to change.

        :param given: the changes asked for, by name
        :param data: what the file holds
        :raises SettingError: for what SB3 would take without a word and never use, naming the nearest known name
        """
        own = hints(cls.config_class)
        changes = {name: plain(value) if name in own else value for name, value in given.items()}
        if own:
            changes = without_sb3_names(changes)
        known = {*data, *own, *cls.more_changes}
        for name in changes:
            if name not in known:
                public = (other for other in known if not other.startswith("_"))
                raise SettingError(name, f"is nothing that loading can change; {nearest(name, public)}")
        return changes

    @classmethod
    def _check_policy(cls, policy: object, name: str) -> None:
        """Refuse an agent of another algorithm, whose policy this one cannot hold.

        :param policy: the class of the saved policy, or the name of its module if it is known only when unpickled
        :param name: of the file
        :raises ConfigError: if it is no policy of this algorithm
        """
        own = tuple(cls.policy_aliases.values())
        if isinstance(policy, type):
            kind = "" if issubclass(policy, own) else f"a {policy.__name__}"
        else:
            known = str(policy).startswith(LIBRARIES) and str(policy) not in {alias.__module__ for alias in own}
            kind = f"from {policy}" if known else ""
        if kind:
            raise ConfigError(
                f"{name} holds an agent whose policy is {kind}, where {cls.__name__} has a {own[0].__name__}: load it "
                "with the class that saved it"
            )

    @classmethod
    def load(
        cls: type[SelfPlain],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: Plain | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trust: bool = False,
        **kwargs: Any,
    ) -> SelfPlain:
        """Load an agent, see SB3, without running any code from the file.

        Settings given here replace those that it was saved with; what a section, as ``low``, does not name stays so.
        A temperature with another ``ent_coef`` begins anew.

        :param path: the agent's ``.zip``, or an open file
        :param env: an environment to learn in; to act the agent needs none
        :param trust: also unpickle what has no plain form, as SB3 always does: agents saved by development versions of
            0.1.0, policy classes and subgoal functions of your own. Use it only for files whose origin you trust:
            unpickling can run any code.
        :raises UntrustedError: if the file holds something that must be unpickled, unless ``trust`` is given
        :raises ConfigError: if the file is damaged, or no agent of this class
        :raises SettingError: on an unknown setting, a value that it cannot have, or one that the weights do not fit
        """
        device = device_here(device)
        name = str(path) if isinstance(path, str | pathlib.Path) else "the agent"
        content = read_bytes(path)
        data, given = read_data(content, name), dict(custom_objects or {})
        cls._check_policy(given.get("policy_class", policy_of(data, trust)), name)
        values = {} if trust else unpickled(data, name, given, env is not None)
        check_entries({**data, **values, **given}, name)
        changes = cls._changes(kwargs, data)
        now, later = parted(changes)
        try:
            model = super().load(
                io.BytesIO(content), env, device, {**values, **given}, print_system_info, force_reset, **now
            )
            model._change_parts(later)
        except RuntimeError as error:
            if "state_dict" not in str(error):  # torch's word for weights that do not fit
                raise
            if changes:
                raise SettingError(named(changes), UNFIT) from error
            raise ConfigError(
                f"the weights in {name} do not fit the networks of {cls.__name__}: load it with the class that saved it"
            ) from error
        return model

    def _change_parts(self, given: PlainMapping) -> None:
        """Change settings in :data:`PARTS`: what they bring in begins anew, the rest keeps its parameters.

        :param given: settings by dotted name
        """
        changed = {name: value for name, value in given.items() if recursive_getattr(self, name) != value}
        if not changed:
            return
        saved = self.get_parameters()
        tensors = {name: recursive_getattr(self, name) for name in self._get_torch_save_params()[1]}
        levels = [name.removesuffix(ENT_COEF) for name in changed if name.endswith(ENT_COEF)]
        anew = {level + part for level in levels for part in TEMPERATURE}
        self._drop_parts()
        for name, value in changed.items():
            section, _, key = name.rpartition(".")
            vars(self).update({section: {key: value}} if section else {key: value})
        self._setup_model()
        fresh = self.get_parameters()
        kept = {name: state for name, state in saved.items() if name in fresh and name not in anew}
        self.set_parameters({**fresh, **kept})  # type: ignore[dict-item]
        for name in self._get_torch_save_params()[1]:
            if name not in anew:
                recursive_setattr(self, f"{name}.data", tensors[name].data)

    def _drop_parts(self) -> None:
        """Forget what :meth:`_setup_model` would otherwise keep, or touch, of the parts that there are."""
        vars(self).update(dict.fromkeys(TEMPERATURE))


def parted(given: PlainMapping, where: str = "") -> tuple[Plain, Plain]:
    """Changes without those in :data:`PARTS`, and the latter by dotted name.

    :param given: values by name
    :param where: the level they belong to, with a dot
    """
    now: Plain = {}
    later: Plain = {}
    for name, value in given.items():
        if name in PARTS:
            later[where + name] = value
        elif name in LEVELS and isinstance(value, Mapping):
            now[name], inside = parted(value, f"{where}{name}.")
            later |= inside
        else:
            now[name] = value
    return now, later


def named(changes: PlainMapping) -> str:
    """What was to be changed, for a message: settings that shape networks, else all."""
    names = list(leaves(changes))
    return ", ".join([name for name in names if set(name.split(".")) & SHAPES] or names)


def leaves(given: PlainMapping, where: str = "") -> Iterator[str]:
    """Dotted names of settings, those of sections within sections, too."""
    for name, value in given.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{where}{name}.")
        else:
            yield where + name
