"""SAC with memory: SB3's own algorithm on sequences, whose actor remembers in a circuit or another recurrent cell."""

from __future__ import annotations

import io
import pathlib
from typing import Annotated, Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BaseModel, BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_tbc.aliases import Plain, PlainMapping, Space
from sb3_tbc.arrays import AnyArray
from sb3_tbc.errors import ConfigError
from sb3_tbc.ndbc.extractor import input_scale_of
from sb3_tbc.recurrent.cells import NDBCCell, make_cell
from sb3_tbc.recurrent.sequences import SequenceReplayBuffer, Sequences, flat, flat_space, refuse_non_finite
from sb3_tbc.settings import Range, hints, read_partial
from sb3_tbc.smdp.goal_spaces import box_problems
from sb3_tbc.tbc_hrl.arguments import SB3Arguments
from sb3_tbc.tbc_hrl.checks import episode_starts
from sb3_tbc.tbc_hrl.config import FlatConfig
from sb3_tbc.tbc_hrl.last_step import KeepsLastStep
from sb3_tbc.tbc_hrl.saving import PlainAlgorithm

State = tuple[AnyArray, ...]
"""Memory ``(n_envs, state_dim)`` and last action in [-1, 1], ``(n_envs, action_dim)``."""
NOT_TAKEN: Plain = {"use_sde": False, "optimize_memory_usage": False, "n_steps": 1}
"""Parameters of SAC that have no meaning here, and the only value that each may have."""

SETTINGS: Plain = {
    **{
        name: hints(FlatConfig)[name]
        for name in ("batch_size", "gamma", "tau", "ent_coef", "target_entropy", "buffer_size", "learning_starts")
    },
    **{name: hints(SB3Arguments)[name] for name in ("seed", "verbose", "stats_window_size")},
    "learning_rate": Annotated[float, Range(0)],
    "gradient_steps": Annotated[int, Range(-1)],
    "target_update_interval": Annotated[int, Range(1)],
}
"""Parameters of SAC that SB3 takes as they are given, and what each may be; a learning rate may also be a function."""
MEMORY_SETTINGS: Plain = {"hidden_size": Annotated[int, Range(1, 16_384)], "n_critics": Annotated[int, Range(1, 1000)]}
"""Likewise of its policy."""

NO_EXTRACTOR: Plain = {
    "share_features_extractor": False,
    "features_extractor_class": FlattenExtractor,
    "features_extractor_kwargs": None,
}
"""Parameters of SB3's policy that have no meaning beside memories, and the value that SB3 itself hands on."""


class MemoryExtractor(BaseFeaturesExtractor):
    """Features of a step: what a cell remembers of all steps up to it, beside the step's own inputs.

    :param observation_space: of the environment
    :param action_dim: width of actions, which are inputs, too
    :param cell: see :func:`~sb3_tbc.recurrent.cells.make_cell`
    :param hidden_size: width of what is read from the cell
    :param cell_kwargs: further arguments of the cell
    """

    def __init__(
        self, observation_space: Space, action_dim: int, cell: str, hidden_size: int, cell_kwargs: PlainMapping
    ) -> None:
        scale = [*input_scale_of(flat_space(observation_space)), *[1.0] * action_dim]
        super().__init__(observation_space, hidden_size + len(scale))
        self.cell = make_cell(cell, len(scale), hidden_size, scale, cell_kwargs)

    def forward(self, observations: Sequences) -> th.Tensor:
        """Features ``(n_kept, features_dim)`` of the steps that are learnt from, or of the steps after them."""
        state = self.cell.unroll(observations.inputs, observations.starts)[observations.kept]
        if observations.later is None:
            return self.features(observations.inputs[observations.kept], state)
        return self.features(observations.later, self.cell(observations.later, state))

    def features(self, inputs: th.Tensor, state: th.Tensor) -> th.Tensor:
        """Features ``(n, features_dim)`` of a step, from its inputs and the state after it."""
        return th.cat((self.cell.read(state), inputs), dim=-1)


class _OnSequences(BaseModel):
    """A network of SB3 that takes sequences, or features that are known already, in place of observations."""

    def extract_features(self, obs: Any, features_extractor: Any) -> th.Tensor:
        """Features ``(n, features_dim)``."""
        features: th.Tensor = features_extractor(obs) if isinstance(obs, Sequences) else obs
        return features


class RecurrentActor(_OnSequences, Actor):
    """SB3's actor behind a memory."""

    features_extractor: MemoryExtractor


class RecurrentCritic(_OnSequences, ContinuousCritic):
    """SB3's critics behind one memory."""

    def forward(self, obs: Any, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Values ``(n, 1)`` of each critic."""
        # Where the actions carry a gradient, only the way through them is wanted: the actor's loss.
        with th.set_grad_enabled(th.is_grad_enabled() and not actions.requires_grad):
            features = self.extract_features(obs, self.features_extractor)
        return super().forward(features, actions)


class RecurrentSACPolicy(SACPolicy):
    """Actor and critics of SAC, each with a memory of its own.

    :param observation_space: vectors, or dictionaries of them
    :param action_space: a Box
    :param lr_schedule: learning rate of actor and critics
    :param cell: the actor's memory: ``"ndbc"``, ``"gru"``, or ``"ltc"`` and ``"cfc"`` of ncps
    :param hidden_size: width of what is read from a memory
    :param cell_kwargs: settings of the actor's cell; of the circuit those of
        :class:`~sb3_tbc.tbc_hrl.level_config.CircuitConfig`
    :param critic_cell: the critics' memory; it is needed for training alone
    :param kwargs: see SB3's ``SACPolicy``
    :raises ConfigError: for another cell, settings that it does not have, features extractors of SB3, or observations
        that are no vectors
    """

    actor: RecurrentActor
    critic: RecurrentCritic
    critic_target: RecurrentCritic

    def __init__(
        self,
        observation_space: Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *args: Any,
        cell: str = "ndbc",
        hidden_size: int = 32,
        cell_kwargs: PlainMapping | None = None,
        critic_cell: str = "gru",
        **kwargs: Any,
    ) -> None:
        given = {"hidden_size": hidden_size, **kwargs}
        read_partial({name: given[name] for name in MEMORY_SETTINGS if name in given}, MEMORY_SETTINGS, "policy_kwargs")
        for name, default in NO_EXTRACTOR.items():
            if kwargs.get(name, default) not in (default, None, {}):
                raise ConfigError(
                    f"actor and critics have a memory each, which extracts their features: leave policy_kwargs "
                    f"{name}={kwargs[name]!r} out; cell, hidden_size and critic_cell shape the memories"
                )
        self.memory_kwargs: Plain = {
            "cell": cell,
            "hidden_size": hidden_size,
            "cell_kwargs": dict(cell_kwargs or {}),
            "critic_cell": critic_cell,
        }
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)

    def _get_constructor_parameters(self) -> Plain:
        return {**super()._get_constructor_parameters(), **self.memory_kwargs}

    def _extractor(self, cell: str, cell_kwargs: PlainMapping) -> MemoryExtractor:
        hidden_size, action_dim = self.memory_kwargs["hidden_size"], get_action_dim(self.action_space)
        return MemoryExtractor(self.observation_space, action_dim, cell, hidden_size, cell_kwargs)

    def make_actor(self, features_extractor: Any = None) -> RecurrentActor:
        """Build the actor with its memory."""
        extractor = self._extractor(self.memory_kwargs["cell"], self.memory_kwargs["cell_kwargs"])
        return RecurrentActor(**self._update_features_extractor(self.actor_kwargs, extractor)).to(self.device)

    def make_critic(self, features_extractor: Any = None) -> RecurrentCritic:
        """Build the critics with their memory."""
        extractor = self._extractor(self.memory_kwargs["critic_cell"], {})
        return RecurrentCritic(**self._update_features_extractor(self.critic_kwargs, extractor)).to(self.device)

    def predict(
        self,
        observation: Any,
        state: State | None = None,
        episode_start: AnyArray | None = None,
        deterministic: bool = False,
    ) -> tuple[AnyArray, State]:
        """Actions, and the state that the next call is to be given.

        :param observation: of one environment, or of several with a leading dimension
        :param state: what the last call returned; None where episodes begin
        :param episode_start: ``(n_envs,)``, in which environments an episode begins; by default in none
        :param deterministic: the squashed mean in place of a sample
        :raises ValueError: if observation or state do not fit
        :raises NonFiniteError: if observation or state are NaN or infinite
        """
        self.set_training_mode(False)
        flat_observation = self._flat(observation)
        refuse_non_finite("observation", flat_observation)
        memory, last_action = self._checked(state, len(flat_observation))
        if episode_start is not None:
            fresh = episode_starts(episode_start, len(memory))[:, None]
            memory, last_action = np.where(fresh, 0.0, memory), np.where(fresh, 0.0, last_action)
        refuse_non_finite("memory", memory)
        refuse_non_finite("last action", last_action)
        inputs = np.concatenate([flat_observation, last_action], axis=1, dtype=np.float32)
        unit, memory = self._act(inputs, memory.astype(np.float32), deterministic)
        actions = self.unscale_action(unit.reshape(-1, *(self.action_space.shape or ())))
        return actions if self._is_several(observation) else actions[0], (memory, unit)

    def _act(self, inputs: AnyArray, memory: AnyArray, deterministic: bool) -> tuple[AnyArray, AnyArray]:
        """Unit actions ``(n, action_dim)`` and the memory after the step."""
        extractor = self.actor.features_extractor
        with th.no_grad():
            given, before = (th.as_tensor(x, device=self.device) for x in (inputs, memory))
            after = extractor.cell(given, before)
            unit = self.actor(extractor.features(given, after), deterministic)
        return unit.cpu().numpy(), after.cpu().numpy()

    def _blank(self, n: int) -> State:
        state_dim, action_dim = self.actor.features_extractor.cell.state_dim, get_action_dim(self.action_space)
        return np.zeros((n, state_dim)), np.zeros((n, action_dim))

    def _checked(self, state: State | None, n: int) -> State:
        """A state for ``n`` environments: that given, or where there is none, that of episodes that begin.

        :raises ValueError: if it does not fit; NumPy would spread a narrower one over all environments
        """
        blank = self._blank(n)
        if state is None:
            return blank
        if not isinstance(state, tuple | list) or len(state) != len(blank):
            raise ValueError(
                "state must be what predict returned (memory, last action), or None where episodes begin; got "
                f"{type(state).__name__}"
            )
        memory, last_action = (np.asarray(part) for part in state)
        if memory.ndim and len(memory) != n:
            raise ValueError(f"state is of {len(memory)} environments, the observation of {n}")
        for name, part, own in zip(("memory", "last action"), (memory, last_action), blank, strict=True):
            if part.shape != own.shape:
                raise ValueError(
                    f"state's {name} is of shape {own.shape} here, got {part.shape}: is it of another agent?"
                )
        return memory, last_action

    def _flat(self, observation: Any) -> AnyArray:
        if isinstance(observation, tuple):
            raise ValueError("the observation is a tuple: use obs, info = env.reset() and pass obs alone")
        try:
            return flat(observation, self.observation_space)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ValueError(f"the observation does not fit {self.observation_space}: {error}") from error

    def _is_several(self, observation: Any) -> bool:
        """Whether the observation has a leading dimension."""
        space = self.observation_space
        if isinstance(space, spaces.Dict):
            key = next(iter(space.spaces))
            return np.ndim(observation[key]) > len(space[key].shape or ())
        return np.ndim(observation) > len(space.shape or ())


class NDBCSAC(PlainAlgorithm, KeepsLastStep, SAC):
    """Recurrent SAC for tasks whose observation hides a part of the state: SB3's SAC, learning from sequences.

    The actor's memory is an NDBC circuit, or a GRU, LTC or CfC cell; it also sees its last action. Memories are
    unrolled through the sequences that are replayed and learn by backpropagation through time. Use it as any SB3
    algorithm, passing the state on when acting::

        model = NDBCSAC("MlpPolicy", env, replay_buffer_kwargs={"sequence_length": 16, "burn_in": 8}).learn(20_000)
        action, state = model.predict(obs, state, episode_start=dones, deterministic=True)

    :param policy: ``"MlpPolicy"`` or ``"MultiInputPolicy"``, which are the same :class:`RecurrentSACPolicy`
    :param env: environment with observations that are vectors, or dictionaries of them
    :param learning_rate: of actor, critics and temperature
    :param batch_size: sequences of each update
    :param replay_buffer_class: :class:`.SequenceReplayBuffer`, or a class of your own that is derived from it
    :param replay_buffer_kwargs: see :class:`.SequenceReplayBuffer`
    :param policy_kwargs: see :class:`RecurrentSACPolicy`
    :param kwargs: other parameters of SB3's SAC
    :raises ConfigError: for parameters of SAC that it does not have (``use_sde``, ``optimize_memory_usage``,
        ``n_steps``), and for observations that are no vectors
    """

    policy: RecurrentSACPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": RecurrentSACPolicy,
        "MultiInputPolicy": RecurrentSACPolicy,
    }
    _state: State | None = None

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        *,
        batch_size: int = 32,
        replay_buffer_class: type[ReplayBuffer] | None = SequenceReplayBuffer,
        **kwargs: Any,
    ) -> None:
        own = {"learning_rate": learning_rate, "batch_size": batch_size, "replay_buffer_class": replay_buffer_class}
        self._refuse({**kwargs, **own})
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate,
            batch_size=batch_size,
            replay_buffer_class=replay_buffer_class,
            **kwargs,
        )

    @staticmethod
    def _refuse(given: PlainMapping) -> None:
        """Refuse arguments of SAC that have no meaning here.

        :raises ConfigError: naming the only value, or kind of value, that one may have
        """
        for name, default in NOT_TAKEN.items():
            if given.get(name, default) != default:
                raise ConfigError(f"NDBCSAC has no {name}; leave it at its default, {default}")
        read_partial({name: given[name] for name in SETTINGS if name in given and not callable(given[name])}, SETTINGS)
        buffer = given.get("replay_buffer_class", SequenceReplayBuffer)
        if buffer is None or not issubclass(buffer, SequenceReplayBuffer):
            raise ConfigError(
                f"NDBCSAC learns from sequences, replay_buffer_class must be a SequenceReplayBuffer, got {buffer}"
            )

    @classmethod
    def _changes(cls, given: PlainMapping, data: PlainMapping) -> Plain:
        cls._refuse(given)
        return super()._changes({name: value for name, value in given.items() if name not in NOT_TAKEN}, data)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """A vector of environments, see SB3.

        :raises ConfigError: for actions that a squashed Gaussian cannot give
        """
        venv = SAC._wrap_env(env, verbose, monitor_wrapper)
        actions = venv.action_space
        problems = box_problems(actions) if isinstance(actions, spaces.Box) else []
        if not problems and isinstance(actions, spaces.Box) and not (actions.low < actions.high).all():
            problems = [f"its lowest actions must be below its highest, got {actions}: leave out what never changes"]
        if problems:
            raise ConfigError(f"NDBCSAC cannot act in this environment: {problems[0]}")
        return venv

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if self._vec_normalize_env is not None and isinstance(self.observation_space, spaces.Dict):
            raise ValueError(
                "NDBCSAC takes VecNormalize around a Box alone, not around a Dict: normalise in the environment, or "
                "flatten its observations with gymnasium.wrappers.FlattenObservation"
            )
        return super()._setup_learn(*args, **kwargs)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[AnyArray, AnyArray]:
        starts = self._last_episode_starts
        assert starts is not None
        state = None if starts.all() else self._state
        actions, (memory, unit) = self.policy.predict(self._last_obs, state, starts)
        if self.num_timesteps < learning_starts:
            unit = self.policy.scale_action(np.array([self.action_space.sample() for _ in range(n_envs)]))
        if action_noise is not None:
            unit = unit.reshape(n_envs, -1)
            noise = np.asarray(action_noise(), dtype=np.float32)
            if noise.size != unit.size:
                raise ConfigError(f"action_noise must give {unit.size} numbers, one for each action, got {noise.size}")
            refuse_non_finite("action noise", noise.reshape(unit.shape))
            unit = unit + noise.reshape(unit.shape)
        unit = np.clip(unit, -1.0, 1.0).astype(np.float32)
        self._state = memory, unit.reshape(n_envs, -1)
        return self.policy.unscale_action(unit.reshape(actions.shape)), unit

    def _store_transition(
        self, replay_buffer: ReplayBuffer, buffer_action: AnyArray, new_obs: Any, reward: Any, dones: Any, infos: Any
    ) -> None:
        assert isinstance(replay_buffer, SequenceReplayBuffer)
        assert self._last_episode_starts is not None
        replay_buffer.note_starts(self._last_episode_starts)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._last_episode_starts = np.asarray(dones, dtype=bool)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update, see SB3; circuits with an adaptive step then look at their weights."""
        super().train(gradient_steps, batch_size)
        for network in (self.actor, self.critic, self.critic_target):
            cell = network.features_extractor.cell
            if isinstance(cell, NDBCCell):
                cell.net.after_update(gradient_steps)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_state"]

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Write the replay buffer to one file of plain arrays.

        :param path: where to, or an open file
        """
        self._sequences().save(path)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Read what :meth:`save_replay_buffer` wrote; nothing is unpickled.

        :param path: where from, or an open file
        :param truncate_last_traj: SB3's; it has no effect here
        :raises ValueError: if it does not fit this agent's
        """
        self._sequences().load(path)

    def _sequences(self) -> SequenceReplayBuffer:
        if not isinstance(self.replay_buffer, SequenceReplayBuffer):
            raise ValueError("there is no replay buffer: pass env when loading the agent")
        return self.replay_buffer
