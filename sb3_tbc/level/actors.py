"""Actors of one level: an MLP, the NDBC circuit, or a GRU as a control for its memory.

Every actor names its parameters as :class:`.Block` objects: which parameters lie side by side in the flat storage of
:mod:`sb3_tbc.level.storage`, and the shape under which one matrix product uses them all. It also has its forward pass
as a function of those blocks, which is what the update differentiates.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor
from torch import nn
from torch.nn import functional

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.level.storage import Block, linear_layers
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import WIRING_KEYS, NDBCWiring

SQUASH_EPSILON = 1e-6
"""Added inside the logarithm of tanh's derivative, as SB3 does."""
HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)


class GaussianHead:
    """Bounds of a squashed Gaussian's parameters before squashing.

    :param mean_bound: the mean is clamped to ``[-mean_bound, mean_bound]`` (HiTS: 3), None for no bound
    :param log_std_bounds: bounds of the logarithm of the standard deviation (SB3: -20, 2)
    :raises ValueError: if a bound is empty
    """

    def __init__(self, mean_bound: float | None, log_std_bounds: tuple[float, float]) -> None:
        if mean_bound is not None and mean_bound <= 0:
            raise ValueError(f"mean_bound must be positive or None, got {mean_bound}")
        if not log_std_bounds[0] < log_std_bounds[1]:
            raise ValueError(f"log_std_bounds must be (low, high) with low < high, got {tuple(log_std_bounds)}")
        self.mean_bound = mean_bound
        self.log_std_bounds = (float(log_std_bounds[0]), float(log_std_bounds[1]))

    def __call__(self, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Split a network's outputs ``(batch, 2 * action_dim)`` into mean and log_std, both bounded."""
        mean, log_std = outputs.chunk(2, dim=-1)
        if self.mean_bound is not None:
            mean = mean.clamp(-self.mean_bound, self.mean_bound)
        return mean, log_std.clamp(*self.log_std_bounds)


def squash(mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Squashed Gaussian sample ``(batch, action_dim)`` and its log-probability ``(batch, 1)``, from given noise."""
    # u = mean + std * noise, a = tanh(u); log pi(a) = log N(u; mean, std) - sum log(1 - tanh(u)^2)
    # (appendix C of arXiv 1801.01290). With u standardised, log N is a function of the noise alone.
    actions = th.tanh(mean + log_std.exp() * noise)
    log_prob = -0.5 * noise.square() - log_std - HALF_LOG_TAU - th.log(1 - actions.square() + SQUASH_EPSILON)
    return actions, log_prob.sum(dim=-1, keepdim=True)


class MLPActor(Actor):
    """SB3's SAC actor with bounds on its head and the stepwise interface of circuit actors (state of width 0).

    :param mean_bound: see :class:`GaussianHead`
    :param log_std_bounds: see :class:`GaussianHead`
    :param kwargs: arguments of SB3's ``Actor``
    """

    state_dim = 0
    sub_steps = 0

    def __init__(
        self,
        *,
        mean_bound: float | None = None,
        log_std_bounds: tuple[float, float] = (LOG_STD_MIN, LOG_STD_MAX),
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.head = GaussianHead(mean_bound, log_std_bounds)
        self.activation = self.activation_fn()

    def step(self, obs: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Mean and log_std ``(batch, action_dim)`` for observations ``(batch, n)``; the empty state is passed on."""
        latent = self.latent_pi(obs)
        mean, log_std = self.head(th.cat((self.mu(latent), self.log_std(latent)), dim=-1))  # type: ignore[operator]
        return mean, log_std, state

    def constants(self) -> list[th.Tensor]:
        """None: an MLP has no tensors besides its parameters."""
        return []

    def blocks(self) -> list[Block]:
        """Layers' weights and biases; mean and log_std share one output layer."""
        blocks = [Block(tuple(p.shape), (p,)) for layer in linear_layers(self.latent_pi) for p in layer.parameters()]
        mean, log_std = self.mu, self.log_std
        if not isinstance(mean, nn.Linear) or not isinstance(log_std, nn.Linear):
            raise TypeError("an actor with state-dependent exploration cannot be a level; pass use_sde=False")
        outputs = 2 * mean.out_features
        return [
            *blocks,
            Block((outputs, mean.in_features), (mean.weight, log_std.weight)),
            Block((outputs,), (mean.bias, log_std.bias)),
        ]

    def step_blocks(
        self, blocks: Sequence[th.Tensor], constants: Sequence[th.Tensor], obs: th.Tensor, state: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """:meth:`step` as a function of the parameter blocks."""
        hidden = obs
        for weight, bias in zip(blocks[:-2:2], blocks[1:-2:2], strict=True):
            hidden = self.activation(functional.linear(hidden, weight, bias))
        return *self.head(functional.linear(hidden, blocks[-2], blocks[-1])), state

    def get_action_dist_params(self, obs: Any) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """Mean and log_std as SB3's SAC asks for them."""
        features = self.extract_features(obs, self.features_extractor)
        mean, log_std, _ = self.step(features, features.new_zeros((len(features), 0)))
        return mean, log_std, {}


class GRUNet(nn.Module):
    """A gated recurrent unit with a linear readout.

    :param n_inputs: number of inputs
    :param n_outputs: number of outputs
    :param hidden_size: width of the state
    :param input_scale: what inputs are divided by
    """

    sub_steps = 0

    def __init__(self, n_inputs: int, n_outputs: int, hidden_size: int, input_scale: Sequence[float]) -> None:
        super().__init__()
        self.state_dim = hidden_size
        self.input_gain: th.Tensor
        self.register_buffer("input_gain", 1.0 / th.tensor(input_scale, dtype=th.float32))
        self.cell, self.readout = nn.GRUCell(n_inputs, hidden_size), nn.Linear(hidden_size, n_outputs)

    def forward(self, inputs: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Outputs ``(batch, n_outputs)`` and the next state ``(batch, hidden_size)``."""
        state = self.cell(inputs * self.input_gain, state)
        return self.readout(state), state

    def initial_state(self, batch_size: int) -> th.Tensor:
        """Zeros."""
        return self.readout.weight.new_zeros((batch_size, self.state_dim))

    def after_update(self, n_updates: int) -> None:
        """Nothing depends on the weights."""


class MemoryActor(BasePolicy):
    """Squashed Gaussian actor whose mean and log_std are read out of a network with a state.

    :param settings: of the network, see :meth:`make_net`
    :param mean_bound: see :class:`GaussianHead`
    :param log_std_bounds: see :class:`GaussianHead`
    """

    action_space: spaces.Box

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        features_extractor: nn.Module,
        features_dim: int,
        settings: PlainMapping,
        mean_bound: float | None = None,
        log_std_bounds: tuple[float, float] = (LOG_STD_MIN, LOG_STD_MAX),
        normalize_images: bool = True,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.settings = dict(settings)
        self.net = self.make_net(features_dim, 2 * get_action_dim(action_space))
        self.state_dim = int(self.net.state_dim)
        self.head = GaussianHead(mean_bound, log_std_bounds)
        self.action_dist = SquashedDiagGaussianDistribution(get_action_dim(action_space))

    def _get_constructor_parameters(self) -> Plain:
        bounds = {"mean_bound": self.head.mean_bound, "log_std_bounds": self.head.log_std_bounds}
        return {**super()._get_constructor_parameters(), "settings": self.settings, **bounds}

    @abstractmethod
    def make_net(self, n_inputs: int, n_outputs: int) -> Any:
        """The network, with the interface of :class:`GRUNet`; its weights are drawn from torch's generator."""

    def step(self, obs: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """One control step: mean and log_std ``(batch, action_dim)`` and the next state ``(batch, state_dim)``."""
        outputs, next_state = self.net(obs, state)
        return *self.head(outputs), next_state

    @property
    def sub_steps(self) -> int:
        """Sub-steps of a control step, K; the circuit's step-size rule may change it between bursts of updates."""
        return int(self.net.sub_steps)

    def blocks(self) -> list[Block]:
        """One block per parameter of the network."""
        return [Block(tuple(p.shape), (p,)) for p in self.net.parameters()]

    def constants(self) -> list[th.Tensor]:
        """Tensors of the network that are not trained, such as scales."""
        return list(self.net.buffers())

    def step_blocks(
        self, blocks: Sequence[th.Tensor], constants: Sequence[th.Tensor], obs: th.Tensor, state: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """:meth:`step` as a function of the parameter blocks."""
        tensors = dict(zip((name for name, _ in self.net.named_parameters()), blocks, strict=True))
        tensors.update(zip((name for name, _ in self.net.named_buffers()), constants, strict=True))
        outputs, next_state = th.func.functional_call(self.net, tensors, (obs, state))
        return *self.head(outputs), next_state

    def get_action_dist_params(self, obs: Any) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """Mean and log_std from a network at rest, as SB3's SAC asks for them."""
        features = self.extract_features(obs, self.features_extractor)
        mean, log_std, _ = self.step(features, self.net.initial_state(len(features)))
        return mean, log_std, {}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Squashed action from a network at rest."""
        mean, log_std, _ = self.get_action_dist_params(obs)
        return self.action_dist.actions_from_params(mean, log_std, deterministic=deterministic)

    def action_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Sampled action and its log-probability from a network at rest."""
        mean, log_std, _ = self.get_action_dist_params(obs)
        return self.action_dist.log_prob_from_params(mean, log_std)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.forward(observation, deterministic)


class NDBCActor(MemoryActor):
    """The NDBC circuit as an actor.

    Its settings are the wiring's numbers (``inter``, ``command``, ``motor``, fan-outs, ``seed`` of the wiring) and the
    network's options (``sub_steps``, ``dynamics``, ``input_scale``, ...).
    """

    net: NDBCNet

    def make_net(self, n_inputs: int, n_outputs: int) -> Any:
        """The circuit, a :class:`~sb3_tbc.ndbc.NDBCNet`."""
        wiring = NDBCWiring(n_inputs, **{k: v for k, v in self.settings.items() if k in WIRING_KEYS})
        return NDBCNet(n_inputs, n_outputs, wiring, **{k: v for k, v in self.settings.items() if k not in WIRING_KEYS})


class GRUActor(MemoryActor):
    """A gated recurrent unit as an actor; its settings are ``hidden_size`` and ``input_scale``."""

    net: GRUNet

    def make_net(self, n_inputs: int, n_outputs: int) -> Any:
        """The :class:`GRUNet`."""
        return GRUNet(n_inputs, n_outputs, **self.settings)
