"""How many sub-steps a control step needs: the bounded, model-aware step-size rule and the half-step check."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch as th
from torch import nn

from sb3_tbc.ndbc.cell import Cell, ConductanceArrays


@dataclass(frozen=True)
class StepRule:
    """``delta = clip(eta / (L + epsilon), delta_min, delta_max)``, K = ceil(1 / delta) (paper, section 4.3).

    Lengths are in control steps. With the default bounds K lies between 3, the number of synaptic hops, and 6.

    :param eta: scale of the sub-step's length, without unit
    :param epsilon: added to L, so that the quotient stays finite
    :param delta_min: smallest sub-step; ``1 / delta_min`` is K_max
    :param delta_max: largest sub-step
    :param refresh_every: updates between two evaluations of the Lipschitz proxy L
    :param power_iterations: iterations per evaluation; they start where the last evaluation ended
    :param half_step_check: halve the sub-steps of samples that move further than the tolerances, up to K_max
    :param relative_tolerance: ``eps_rel``: a sub-step may move by ``eps_rel |z| + eps_abs``
    :param absolute_tolerance: ``eps_abs``
    :raises ValueError: if a number is out of its range
    """

    eta: float = 2.0
    epsilon: float = 1e-6
    delta_min: float = 1.0 / 6.0
    delta_max: float = 1.0 / 3.0
    refresh_every: int = 1000
    power_iterations: int = 3
    half_step_check: bool = False
    relative_tolerance: float = 0.5
    absolute_tolerance: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.delta_min <= self.delta_max <= 1.0:
            raise ValueError(f"need 0 < delta_min <= delta_max <= 1, got {self.delta_min} and {self.delta_max}")
        if self.eta <= 0.0 or self.epsilon < 0.0:
            raise ValueError(f"eta must be positive and epsilon not negative, got {self.eta} and {self.epsilon}")
        if self.refresh_every < 1 or self.power_iterations < 1:
            counts = (self.refresh_every, self.power_iterations)
            raise ValueError(f"refresh_every and power_iterations must be at least 1, got {counts}")
        if self.relative_tolerance < 0.0 or self.absolute_tolerance < 0.0:
            tolerances = (self.relative_tolerance, self.absolute_tolerance)
            raise ValueError(f"tolerances must not be negative, got {tolerances}")

    @property
    def max_sub_steps(self) -> int:
        """K_max."""
        return math.ceil(1.0 / self.delta_min - 1e-9)

    def sub_steps(self, lipschitz: float) -> int:
        """K for a value of the Lipschitz proxy."""
        delta = min(max(self.eta / (lipschitz + self.epsilon), self.delta_min), self.delta_max)
        return min(math.ceil(1.0 / delta - 1e-9), self.max_sub_steps)


class LipschitzProxy(nn.Module):
    """Spectral norm of the recurrent block's largest sensitivities, by power iterations with a warm start.

    For conductances the block is ``|w_ij E_ij| gain_j / (4 C_i)``, the steepest response of dV_i/dt to V_j; for the
    dissipative cell it is U.

    :param n_neurons: number of neurons with a state
    """

    def __init__(self, n_neurons: int) -> None:
        super().__init__()
        self.direction: th.Tensor
        self.register_buffer("direction", th.full((n_neurons,), n_neurons**-0.5), persistent=False)

    @th.no_grad()
    def evaluate(self, cell: Cell, iterations: int) -> float:
        """Estimate of the norm after some more iterations; from below, and better with every call."""
        block = recurrent_block(cell.arrays())
        for _ in range(iterations):
            image = block @ (block.t() @ self.direction)
            norm = image.norm()
            if norm == 0:
                return 0.0
            self.direction.copy_(image / norm)
        return float((block.t() @ self.direction).norm())


def recurrent_block(arrays: Any) -> th.Tensor:
    """The matrix whose spectral norm is the Lipschitz proxy, ``(N, N)``, [presynaptic, postsynaptic]."""
    if not isinstance(arrays, ConductanceArrays):
        recurrent: th.Tensor = arrays.recurrent
        return recurrent
    n = len(arrays.capacitance)
    block = arrays.recurrent[:, :n].abs() * (arrays.gain / 4.0).unsqueeze(-1) / arrays.capacitance
    return nn.functional.pad(block, (0, 0, 0, n - len(block)))


def advance_checked(
    cell: Cell, inputs: th.Tensor, state: th.Tensor, interval: th.Tensor, sub_steps: int, rule: StepRule
) -> th.Tensor:
    """One control step with the half-step check: samples that move too far in a sub-step run again with twice as many.

    :param cell: conductance or dissipative cell
    :param inputs: scaled inputs, ``(batch, n_inputs)``
    :param state: ``(batch, n_neurons)``
    :param interval: length of the control step, ``(batch, 1)``
    :param sub_steps: K to begin with
    :param rule: tolerances and K_max
    :return: the state one control step later
    """
    arrays = cell.arrays()
    step_terms = cell.step_terms(arrays, interval / sub_steps)
    input_terms = cell.input_terms(inputs, arrays, step_terms)
    current, too_far = state, th.zeros(len(state), dtype=th.bool, device=state.device)
    for _ in range(sub_steps):
        following = cell.step(current, input_terms, arrays, step_terms)
        allowed = rule.relative_tolerance * current.norm(dim=-1) + rule.absolute_tolerance
        too_far |= (following - current).norm(dim=-1) > allowed
        current = following
    if sub_steps >= rule.max_sub_steps or not bool(too_far.any()):
        return current
    rows = too_far.nonzero().squeeze(-1)
    finer = min(2 * sub_steps, rule.max_sub_steps)
    refined = advance_checked(cell, inputs[rows], state[rows], interval[rows], finer, rule)
    return current.index_copy(0, rows, refined)
