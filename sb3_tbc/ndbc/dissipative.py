"""The dissipative cell, its bounded-input bounded-state certificate, and how training keeps it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_tbc.ndbc.cell import inverse_softplus, uniform
from sb3_tbc.ndbc.wiring import NDBCWiring


class DissipativeArrays(NamedTuple):
    """Masked weights, derived once per call (N neurons, I inputs)."""

    input_weight: th.Tensor  # W, (I, N)
    recurrent: th.Tensor  # U, (N, N), [presynaptic, postsynaptic]
    damping: th.Tensor  # diagonal of K, (N,)


class Certificate(NamedTuple):
    """``||x'|| <= rho ||x|| + c ||u|| + d`` per sub-step (equation 21), in the Euclidean norm.

    The state stays bounded for bounded inputs if ``rho < 1``.
    """

    rho: float
    c: float
    d: float

    def state_bound(self, input_norm: float, initial_norm: float = 0.0) -> float:
        """Bound on ``||x||`` at all times, for inputs with ``||u|| <= input_norm``; infinite unless ``rho < 1``."""
        if self.rho >= 1.0:
            return float("inf")
        return max(initial_norm, (self.c * input_norm + self.d) / (1.0 - self.rho))


class DissipativeCell(nn.Module):
    """``x' = (I + eta K)^-1 [x + eta tanh(W u + U x + b)]`` on the same wiring, diagonal K > 0 (equation 20).

    The contraction factor of equation 21, ``rho = ||(I + eta K)^-1|| (1 + eta L ||U||)`` with L = 1 for tanh, holds for
    this form, with the bracket around both terms. Weights carry their synapse's polarity.

    :param wiring: who is wired to whom, with polarities
    :param generator: source of the initial values; torch's global one if None
    :param max_rho: if given, U is scaled down in every call so that rho stays below it; needs ``max_rho < 1``
    :param min_damping: smallest entry of K
    :raises ValueError: if ``max_rho`` is not between 0 and 1 or ``min_damping`` is negative
    """

    def __init__(
        self,
        wiring: NDBCWiring,
        generator: th.Generator | None = None,
        max_rho: float | None = None,
        min_damping: float = 0.5,
    ) -> None:
        super().__init__()
        if max_rho is not None and not 0.0 < max_rho < 1.0:
            raise ValueError(f"max_rho must lie between 0 and 1 to bound the state, got {max_rho}")
        if min_damping < 0.0:
            raise ValueError(f"min_damping must not be negative, got {min_damping}")
        self.n_inputs, self.n_neurons = wiring.n_inputs, wiring.n_neurons
        self.max_rho, self.min_damping = max_rho, min_damping
        self.input_sign: th.Tensor
        self.input_index: th.Tensor
        self.sign: th.Tensor
        self.index: th.Tensor
        for name, signs in {"input_": wiring.sensory, "": wiring.recurrent}.items():
            pre, post = np.nonzero(signs)
            self.register_buffer(f"{name}sign", th.as_tensor(signs[pre, post].astype(np.float32)))
            self.register_buffer(f"{name}index", th.as_tensor(pre * self.n_neurons + post))
        spread = max(1.0, len(self.input_index) / wiring.inter) ** 0.5
        self.raw_input_weight = nn.Parameter(
            inverse_softplus(uniform(len(self.input_index), 1.0, 4.0, generator) / spread)
        )
        self.raw_weight = nn.Parameter(inverse_softplus(uniform(len(self.index), 0.3, 2.0, generator)))
        self.raw_damping = nn.Parameter(inverse_softplus(uniform(self.n_neurons, 1.0, 3.0, generator)))
        self.bias = nn.Parameter(uniform(self.n_neurons, -0.3, 0.3, generator))

    def arrays(self) -> DissipativeArrays:
        """Masked signed weights and damping from the current free parameters; differentiable."""
        n = self.n_neurons
        damping = functional.softplus(self.raw_damping) + self.min_damping
        zeros = self.bias.new_zeros
        weight, index = functional.softplus(self.raw_weight) * self.sign, self.index
        recurrent = zeros(n * n).scatter(0, index, weight).view(n, n)
        drawn = functional.softplus(self.raw_input_weight) * self.input_sign
        input_weight = zeros(self.n_inputs * n).scatter(0, self.input_index, drawn).view(self.n_inputs, n)
        return DissipativeArrays(input_weight, recurrent, damping)

    def step_terms(self, arrays: DissipativeArrays, dt: float | th.Tensor) -> th.Tensor:
        """``eta``, broadcast to ``(N,)`` or ``(batch, N)``."""
        return th.ones_like(arrays.damping) * dt

    def input_terms(self, inputs: th.Tensor, arrays: DissipativeArrays, step_terms: th.Tensor) -> th.Tensor:
        """``W u + b``, constant over the sub-steps of one control step, ``(..., n_neurons)``."""
        return inputs @ arrays.input_weight + self.bias

    def step(
        self, state: th.Tensor, input_terms: th.Tensor, arrays: DissipativeArrays, step_terms: th.Tensor
    ) -> th.Tensor:
        """One sub-step of equation 20 for states ``(batch, n_neurons)``."""
        recurrent = self.enforced(arrays, step_terms)
        heard = state @ recurrent if recurrent.dim() == 2 else (state.unsqueeze(1) @ recurrent).squeeze(1)
        return (state + step_terms * th.tanh(input_terms + heard)) / (1.0 + step_terms * arrays.damping)

    def enforced(self, arrays: DissipativeArrays, step_terms: th.Tensor) -> th.Tensor:
        """U, scaled down so that rho <= max_rho: ``||U|| <= (max_rho / ||(I + eta K)^-1|| - 1) / eta``.

        ``sqrt(||U||_1 ||U||_inf)`` stands for the spectral norm: never smaller, and cheap and differentiable.

        :return: ``(N, N)``, or ``(batch, N, N)`` where sub-steps differ in length: a short one leaves less room
        """
        if self.max_rho is None:
            return arrays.recurrent
        eta = step_terms.amax(dim=-1)
        room = (self.max_rho * (1.0 + eta * arrays.damping.min()) - 1.0).clamp(min=0.0) / eta
        size = arrays.recurrent.abs()
        norm = (size.sum(dim=0).max() * size.sum(dim=1).max()).sqrt()
        share = (room / (norm + 1e-12)).clamp(max=1.0)
        return arrays.recurrent * share[..., None, None]

    @th.no_grad()
    def certificate(self, dt: float, input_gain: th.Tensor | float = 1.0) -> Certificate:
        """The certificate of equation 21 for sub-steps of length ``dt``, from the exact spectral norms.

        :param input_gain: what inputs are multiplied by before they reach the cell, ``(n_inputs, 1)``; W includes it
        """
        arrays = self.arrays()
        step_terms = self.step_terms(arrays, dt)
        shrink = float(1.0 / (1.0 + dt * arrays.damping.min()))
        recurrent_norm = float(th.linalg.matrix_norm(self.enforced(arrays, step_terms).double(), 2))
        input_norm = float(th.linalg.matrix_norm((input_gain * arrays.input_weight).double(), 2))
        rho = shrink * (1.0 + dt * recurrent_norm)
        return Certificate(rho, shrink * dt * input_norm, shrink * dt * float(self.bias.norm()))
