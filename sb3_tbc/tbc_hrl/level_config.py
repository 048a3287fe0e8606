"""Settings of one level: SAC's own under Stable-Baselines3's names, those of its networks, and those of the circuit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_tbc.aliases import Plain
from sb3_tbc.level.update import AVERAGE_DECAY
from sb3_tbc.ndbc.stepping import StepRule
from sb3_tbc.settings import Increasing, Prefixed, Range, SettingError, Settings

Fraction = Annotated[float, Range(0, 1)]
Positive = Annotated[float, Range(0, above=True)]
NotNegative = Annotated[float, Range(0)]
Price = Annotated[float, Range(0, 1e6)]
LearningRate = Positive | Annotated[str, Prefixed("lin_", Range(0, above=True))]
Temperature = NotNegative | Literal["auto"] | Annotated[str, Prefixed("auto_", Range(0, above=True))]
UpdateRatio = Annotated[float, Range(0, 1000)]
PositiveRange = Annotated[tuple[Positive, Positive], Increasing()]
Neurons = Annotated[int, Range(1, 1024)]
Fan = Annotated[int, Range(1, 4096)]
Width = Annotated[int, Range(1, 16384)]

MOST_SUB_STEPS = 64
"""Sub-steps of a control step beyond which nothing is gained and much time is lost."""


def learning_rate_of(value: float | str) -> float | LinearSchedule:
    """A constant learning rate, or ``"lin_<rate>"``: one that falls linearly to zero at the end of training."""
    return LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0) if isinstance(value, str) else value


ACTIVATION_NAMES: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU, "elu": nn.ELU}
"""Activation functions that a level can act with, see :data:`sb3_tbc.level.acting.ACTIVATIONS`."""


@dataclass(frozen=True, kw_only=True)
class NetArch(Settings):
    """Hidden layers of actor and critics where they differ."""

    pi: tuple[Width, ...] = (64, 64)
    """Neurons of the actor's hidden layers, input side first."""
    qf: tuple[Width, ...] = (64, 64)
    """Neurons of each critic's hidden layers, input side first."""


@dataclass(frozen=True, kw_only=True)
class PolicyConfig(Settings):
    """Networks of a level; names as in Stable-Baselines3's ``policy_kwargs``."""

    net_arch: tuple[Width, ...] | NetArch = (64, 64)
    """Neurons of each hidden layer, for actor and critics alike, or ``pi`` and ``qf`` where they differ."""
    activation_fn: Literal["relu", "tanh", "silu", "elu"] | type[nn.Module] = "relu"
    """Activation function of the hidden layers, by name; in Python also the torch class."""
    n_critics: Annotated[int, Range(1, 100)] = 2
    """Number of critics; the lowest of their values counts."""
    negative_critic: bool | None = None
    """Keep the critics' values below zero (HiTS's force_negative), for rewards that are never positive; null: yes on
    the high level unless ``completion_bonus`` is more than a decision costs, on the low level only with
    ``low_reward: step``."""
    mean_bound: Positive | None = 3.0
    """The actor's mean is clamped to plus or minus this before squashing, as in HiTS; null: it is not clamped."""
    log_std_bounds: Annotated[tuple[float, float], Increasing()] = (-6.9, 1.8)
    """Bounds of the logarithm of the actor's standard deviation; the default allows 0.001 to 6, as in HiTS."""

    def __post_init__(self) -> None:
        """Name the activation function, so that settings stay plain data."""
        if isinstance(self.activation_fn, type):
            names = {activation: name for name, activation in ACTIVATION_NAMES.items()}
            if self.activation_fn not in names:
                allowed = ", ".join(map(repr, ACTIVATION_NAMES))
                raise SettingError("activation_fn", f"must be one of {allowed}, got {self.activation_fn!r}")
            object.__setattr__(self, "activation_fn", names[self.activation_fn])
        super().__post_init__()

    def to_kwargs(self) -> Plain:
        """As keyword arguments of :class:`~sb3_tbc.level.policies.LevelPolicy`."""
        return {**self.to_dict(), "activation_fn": ACTIVATION_NAMES[str(self.activation_fn)]}


@dataclass(frozen=True, kw_only=True)
class TimeConstants(Settings):
    """Initial time constants of each layer of the circuit, in control steps, drawn evenly on a logarithmic scale."""

    inter: PositiveRange | None = None
    """Range of the inter neurons' time constants; null: about 0.1 to 0.3, so that they forget within a control step."""
    command: PositiveRange | None = None
    """Range of the command neurons' time constants; null: about 0.1 to 0.3."""
    motor: PositiveRange | None = None
    """Range of the motor neurons' time constants; null: about 0.1 to 0.3."""


@dataclass(frozen=True, kw_only=True)
class CircuitConfig(Settings):
    """NDBCNet, the low level's actor: who is wired to whom (table A1), and how potentials move (section 4.3)."""

    inter: Neurons = 8
    """Number of inter neurons."""
    command: Neurons = 6
    """Number of command neurons."""
    motor: Neurons | None = None
    """Number of motor neurons; null: one for each dimension of the action."""
    sensory_fanout: Fan = 4
    """Number of inter neurons that each sensory neuron projects to; at most all of them."""
    inter_fanout: Fan = 5
    """Number of command neurons that each inter neuron projects to."""
    recurrent_command_synapses: Annotated[int, Range(0, 1_000_000)] = 3
    """Number of synapses among the command neurons, in all."""
    motor_fanin: Fan = 5
    """Number of command neurons that each motor neuron listens to."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the wiring."""
    sub_steps: Annotated[int, Range(1, MOST_SUB_STEPS)] = 3
    """Number of sub-steps in a control step, K; three let a signal pass from sensory to motor neurons."""
    dynamics: Literal["conductance", "dissipative"] = "conductance"
    """Neuron model. ``conductance``: membrane potentials with conductances. ``dissipative``: the cell of equations 20
    and 21."""
    synapses: Literal["paper", "lean"] = "paper"
    """Synapse model. ``paper``: a conductance and a reversal potential for each synapse. ``lean``: one parameter for
    each synapse, and inputs act through the input current alone."""
    sensory_to: tuple[Literal["inter", "command", "motor"], ...] = ("inter",)
    """Layers that sensory neurons project to, ``inter`` first; further ones add reflexes, which skip layers."""
    time_constants: TimeConstants | None = None
    """Initial time constants of each layer, for circuits that are to remember; null: all neurons are fast."""
    initial_gains: PositiveRange | None = None
    """Range of the initial gains (steepness) of the neurons' logistic functions; null: 2 to 4."""
    input_scale: tuple[Positive, ...] | None = None
    """Fixed scales that inputs are divided by, one for each; null: those of the task."""
    readout: Literal["all", "motor"] = "all"
    """Neurons that actions are read from. ``all``: all of them, as in the paper's equation. ``motor``: the motor
    neurons."""
    max_rho: Annotated[float, Range(0, 1, above=True)] | None = None
    """Largest contraction factor of a sub-step of the dissipative cell, enforced during training; null: no limit."""
    adaptive_step: bool | StepRule = False
    """Choose the number of sub-steps by the step-size rule (equation 17): true, or a section with its settings."""

    def check(self) -> None:
        """Refuse what cannot be meant together."""
        if self.sensory_to != ("inter", "command", "motor")[: len(self.sensory_to)] or not self.sensory_to:
            raise SettingError(
                "sensory_to", f"must name layers in order, beginning with 'inter', got {list(self.sensory_to)}"
            )
        if isinstance(self.adaptive_step, StepRule) and self.adaptive_step.max_sub_steps > MOST_SUB_STEPS:
            raise SettingError(
                "adaptive_step.delta_min",
                f"must be at least 1 / {MOST_SUB_STEPS}, its inverse is the most sub-steps there are; got "
                f"{self.adaptive_step.delta_min:g}",
            )
        if self.synapses == "lean" and self.dynamics != "conductance":
            raise SettingError("synapses", f"'lean' needs dynamics='conductance', got dynamics={self.dynamics!r}")
        for name in ("time_constants", "initial_gains"):
            if getattr(self, name) is not None and self.dynamics != "conductance":
                raise SettingError(name, f"needs dynamics='conductance', got dynamics={self.dynamics!r}")
        if self.max_rho is not None and self.dynamics != "dissipative":
            raise SettingError("max_rho", f"needs dynamics='dissipative', got dynamics={self.dynamics!r}")


@dataclass(frozen=True, kw_only=True)
class LowPolicyConfig(PolicyConfig):
    """Networks of the low level."""

    ndbc: CircuitConfig | None = CircuitConfig()
    """The circuit that acts; null: an MLP acts in its place."""
    gru: Annotated[int, Range(1, 4096)] | None = None
    """Width of a gated recurrent unit that acts where ``ndbc`` is null, a control for the circuit's memory; null: none.
    It can be neither exported nor interpreted."""
    critic_memory: bool = False
    """Whether critics see the actor's memory beside the observation. For tasks whose observations hide something; needs
    an actor with a memory."""

    def check(self) -> None:
        """Refuse what cannot be meant together."""
        super().check()
        if self.gru is not None and self.ndbc is not None:
            raise SettingError("gru", f"of {self.gru} needs ndbc: null, as one network acts, not two")
        if self.critic_memory and self.ndbc is None and self.gru is None:
            raise SettingError("critic_memory", "needs an actor with a memory: a circuit (ndbc) or a gru")


@dataclass(frozen=True, kw_only=True)
class LevelConfig(Settings):
    """Settings that both levels have; names as in Stable-Baselines3's SAC."""

    learning_rate: LearningRate = 2e-3
    """Learning rate of critics, actor and temperature; ``lin_<rate>`` falls linearly to zero at the end of training."""
    actor_learning_rate: LearningRate | None = None
    """Learning rate of the actor; null: ``learning_rate``. Circuits need larger ones than critics."""
    ent_coef_learning_rate: Positive | None = None
    """Learning rate of the automatic temperature; null: ``learning_rate``."""
    average_decay: Annotated[float, Range(0, 1, below=True)] = AVERAGE_DECAY
    """Decay per update of the averaged actor, which acts where deterministic actions are asked for; 0: no average."""
    batch_size: Annotated[int, Range(1, 1_000_000)] = 256
    """Number of transitions in each update."""
    gradient_ratio: UpdateRatio | None = None
    """Updates of this level per environment step; null: the agent's ``gradient_ratio``."""
    gamma: Fraction = 0.99
    """Discount: of the high level per decision, of the low level per environment step."""
    tau: Annotated[float, Range(0, 1, above=True)] = 0.0125
    """Polyak factor of the target critics."""
    ent_coef: Temperature = "auto"
    """Temperature: a fixed one, ``auto``, or ``auto_<number>`` that starts there."""
    target_entropy: float | Literal["auto"] = "auto"
    """Entropy that an automatic temperature aims at; auto: minus the number of action dimensions."""
    buffer_size: Annotated[int, Range(1, 1_000_000_000)] = 1_000_000
    """Largest number of transitions in the replay buffer."""
    target_bounds: Literal["auto", "none"] | Annotated[tuple[float, float], Increasing()] = "none"
    """How the critics' targets are clipped. ``auto``: to the lowest and highest return that rewards, penalties and
    discount allow, with room for the temperature's share above. ``[low, high]``: to these. ``none``: not at all."""
    critic_norm: Literal["none", "layer", "batch"] = "none"
    """Normalisation of the critics' layers. ``none``: no normalisation. ``layer``: layer normalisation. ``batch``:
    batch normalisation without target networks (CrossQ)."""
    actor_q: Literal["min", "mean", "max"] | Fraction = "min"
    """Which of the critics' values the actor maximises. ``min``: the smallest, as in SAC. ``mean``: their mean.
    ``max``: the largest. A number: between the smallest (0) and the largest (1). Small actors learn less from the
    smallest."""
    policy_kwargs: PolicyConfig = PolicyConfig()
    """Networks of the level."""


@dataclass(frozen=True, kw_only=True)
class HighConfig(LevelConfig):
    """The high level, which chooses subgoals and time budgets."""

    learning_rate: LearningRate = 3e-3
    """Learning rate of critics, actor and temperature; ``lin_<rate>`` falls linearly to zero at the end of training."""
    ent_coef: Temperature = 1.0
    """Temperature: a fixed one, ``auto``, or ``auto_<number>`` that starts there. The default, as large as the price of
    a decision, keeps the level exploring."""


@dataclass(frozen=True, kw_only=True)
class LowConfig(LevelConfig):
    """The low level, which executes subgoals."""

    n_hindsight_goals: Annotated[float, Range(0, 1e6)] | None = None
    """Number of hindsight subgoals for each transition, may be fractional; null: the agent's ``n_hindsight_goals``."""
    goal_strategy: Literal["future", "episode"] | None = None
    """Where hindsight subgoals come from; null: as the agent's ``goal_strategy``, but ``future`` where that is
    ``event``. For ``low_reward: step`` only."""
    policy_kwargs: LowPolicyConfig = LowPolicyConfig()
    """Networks of the level; the circuit among them."""
