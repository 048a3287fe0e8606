"""Unrolled conductance cell with its own backward pass: what makes sequences fast without a compiler."""

from __future__ import annotations

from typing import Any

import torch as th
from torch.autograd.function import once_differentiable
from torch.nn import functional

from sb3_tbc.ndbc.cell import ConductanceArrays, ConductanceCell


class UnrolledCell(th.autograd.Function):
    """All sub-steps of a sequence of control steps as one node of the autograd graph.

    The state is carried as the argument of the logistic, ``z = gain V - threshold``, and with the batch last, so that a
    sub-step is five tensor operations forward and ten backward, all on contiguous memory that fits the cache. First
    derivatives only.
    """

    @staticmethod
    def forward(
        ctx: Any,
        drive: th.Tensor,
        state: th.Tensor,
        mask: th.Tensor | None,
        rest: th.Tensor,
        recurrent: th.Tensor,
        pace: th.Tensor,
        sub_steps: int,
    ) -> th.Tensor:
        """Logistic arguments after every control step, ``(time, N, batch)``.

        :param drive: constant part of numerator | denominator, ``(time, 2 N, batch)``
        :param state: logistic arguments to start from, ``(N, batch)``
        :param mask: 0 where the state is reset before a step, ``(time, batch)``, or None
        :param rest: logistic arguments of potential zero, ``(N, 1)``
        :param recurrent: ``(2 N, P)`` for P presynaptic neurons, the first ones of the state
        :param pace: ``C / dt``, ``(N, 1)``
        :param sub_steps: K
        """
        saved = []
        trace = []
        presynaptic = recurrent.shape[1]
        for t, drive_t in enumerate(drive.unbind(0)):
            if mask is not None:
                state = rest + (state - rest) * mask[t]
            saved.append(state)
            for _ in range(sub_steps):
                released = th.sigmoid(state[:presynaptic])
                weighted, total = th.addmm(drive_t, recurrent, released).chunk(2)
                state = th.addcmul(weighted, state, pace) / total
                saved += [released, total, state]
            trace.append(state)
        ctx.sub_steps, ctx.has_mask = sub_steps, mask is not None
        ctx.save_for_backward(recurrent, pace, *([] if mask is None else [mask]), *saved)
        return th.stack(trace)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Gradients of all tensors :meth:`forward` takes, the mask excepted."""
        recurrent, pace, *saved = ctx.saved_tensors
        mask = saved.pop(0) if ctx.has_mask else None
        k, presynaptic, back = ctx.sub_steps, recurrent.shape[1], recurrent.t().contiguous()
        grad_state = th.zeros_like(grad[0])
        grad_pace, grad_rest = th.zeros_like(grad_state), th.zeros_like(grad_state)
        grad_recurrent, grad_drive = th.zeros_like(recurrent), []
        for t in reversed(range(len(grad))):
            grad_state = grad_state + grad[t]
            before, *steps = saved[t * (3 * k + 1) : (t + 1) * (3 * k + 1)]
            pulls = th.zeros(0)
            for s in reversed(range(k)):
                released, total, after = steps[3 * s : 3 * s + 3]
                start = steps[3 * s - 1] if s else before
                quotient = grad_state / total
                pull = th.cat((quotient, (quotient * after).neg_()))  # d weighted | d total
                excite = th.ops.aten.sigmoid_backward(back @ pull, released)
                grad_state = quotient * pace
                grad_state[:presynaptic] += excite
                grad_pace = grad_pace.addcmul_(quotient, start)
                grad_recurrent = grad_recurrent.addmm_(pull, released.t())
                pulls = pulls + pull if s < k - 1 else pull
            grad_drive.append(pulls)
            if mask is not None:
                grad_rest += grad_state * (1.0 - mask[t])
                grad_state = grad_state * mask[t]
        grad_drive.reverse()
        grad_rest, grad_pace = grad_rest.sum(dim=1, keepdim=True), grad_pace.sum(dim=1, keepdim=True)
        return th.stack(grad_drive), grad_state, None, grad_rest, grad_recurrent, grad_pace, None


def unroll(
    cell: ConductanceCell,
    arrays: ConductanceArrays,
    inputs: th.Tensor,
    state: th.Tensor,
    mask: th.Tensor | None,
    sub_steps: int,
) -> th.Tensor:
    """Potentials after every control step, ``(batch, time, N)``.

    :param cell: the cell
    :param arrays: from ``cell.arrays()``
    :param inputs: scaled inputs, ``(batch, time, n_inputs)``
    :param state: potentials to start from, ``(batch, N)``
    :param mask: 0 where potentials are reset before a step, ``(batch, time)``, or None
    :param sub_steps: K, sub-steps per control step
    """
    n = cell.n_neurons
    silent = n - len(arrays.gain)  # the last neurons may project nowhere: their logistic is the identity's stand-in
    gain, threshold = functional.pad(arrays.gain, (0, silent), value=1.0), functional.pad(cell.threshold, (0, silent))

    def fold(matrix: th.Tensor) -> th.Tensor:
        """From numerators of V to numerators of z: ``gain x numerator - threshold x denominator``."""
        weighted, total = matrix.chunk(2, dim=-1)
        return th.cat((weighted * gain - total * threshold, total), dim=-1).transpose(-1, -2)

    pace = arrays.capacitance * sub_steps
    constant = fold(arrays.rest.unsqueeze(0))
    sources = _sources(cell, arrays, inputs.permute(1, 2, 0).contiguous())
    drive = fold(arrays.from_inputs) @ sources + (constant + functional.pad(pace, (n, 0)).unsqueeze(-1))
    arguments = UnrolledCell.apply(  # type: ignore[no-untyped-call]
        drive, (state * gain - threshold).t(), None if mask is None else mask.t(), -threshold.unsqueeze(-1),
        fold(arrays.recurrent), pace.unsqueeze(-1), sub_steps,
    )  # fmt: skip
    return (arguments.permute(2, 0, 1) + threshold) / gain  # type: ignore[no-any-return]


def _sources(cell: ConductanceCell, arrays: ConductanceArrays, inputs: th.Tensor) -> th.Tensor:
    """What sensory neurons release and the potentials of the input currents, ``(time, n_inputs + n_inter, batch)``."""
    sensed = th.sigmoid(inputs * arrays.sensory_gain.unsqueeze(-1) - cell.sensory_threshold.unsqueeze(-1))
    current = th.tanh(arrays.current_weight.t() @ inputs + cell.current_bias.unsqueeze(-1))
    return th.cat((sensed, current), dim=1)
