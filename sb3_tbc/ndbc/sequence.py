"""Unrolled conductance cell with its own backward pass: what makes sequences fast without a compiler."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch as th
from torch.nn import functional

from sb3_tbc.ndbc.cell import ConductanceCell


class UnrolledCell(th.autograd.Function):
    """All sub-steps of a sequence of control steps as one node of the autograd graph.

    The state is carried as the argument of the logistic, ``z = gain V - threshold``, and with the batch last, so that a
    sub-step is five tensor operations forward and ten backward, all on contiguous memory that fits the cache. First
    derivatives only; asking for more raises. ``torch.func`` (``vmap``, ``jacrev``) and ``torch.jit.script`` do not know
    functions with a backward pass of their own and say so; they all work on single steps.

    Forward, per sub-step, with released transmitter r, conductances G (2N, P) and inertia C/dt (paper, section 4.3):

        r = sigmoid(z[:P])                       (P, batch)
        w | g = input_terms + G r                (N, batch) each: folded numerator, denominator
        z' = (w + z C/dt) / g

    Backward, for dL/dz' = q g: ``dL/dw = q``, ``dL/dg = -q z'``, ``dL/dz = q C/dt``, and through the synapses
    ``dL/dr = G_w' q - G_g' (q z')``. Both halves of G are one product because ``back`` carries the minus sign, which is
    taken out of the gradients of G and of the input terms once, after the loop.
    """

    @staticmethod
    def forward(
        ctx: Any,
        input_terms: th.Tensor,
        state: th.Tensor,
        mask: th.Tensor | None,
        rest: th.Tensor,
        recurrent: th.Tensor,
        inertia: th.Tensor,
        sub_steps: int,
    ) -> th.Tensor:
        """Logistic arguments after every control step, ``(N, time, batch)``.

        :param input_terms: constant part of numerator | denominator, ``(2 N, time, batch)``
        :param state: logistic arguments to start from, ``(N, batch)``
        :param mask: False where the state is reset before a step, ``(time, batch)``, or None
        :param rest: logistic arguments of potential zero, ``(N, 1)``
        :param recurrent: ``(2 N, P)`` for P presynaptic neurons, the first ones of the state
        :param inertia: ``C / dt``, ``(N, 1)``
        :param sub_steps: K
        """
        saved = []
        trace = []
        presynaptic = recurrent.shape[1]
        for t, terms in enumerate(input_terms.unbind(1)):
            if mask is not None:
                state = th.where(mask[t], state, rest)  # a product would keep a state that is NaN
            saved.append(state)
            for _ in range(sub_steps):
                released = th.sigmoid(state[:presynaptic])
                weighted, total = th.addmm(terms, recurrent, released).chunk(2)
                state = th.addcmul(weighted, state, inertia) / total
                saved += [released, total, state]
            trace.append(state)
        ctx.sub_steps, ctx.has_mask = sub_steps, mask is not None
        ctx.save_for_backward(recurrent, inertia, *([] if mask is None else [mask]), *saved)
        return th.stack(trace, dim=1)

    @staticmethod
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Gradients of all tensors :meth:`forward` takes, the mask excepted.

        :raises RuntimeError: if a graph of the gradients is asked for (``create_graph=True``)
        """
        # once_differentiable alone notices this only where the incoming gradient has a graph itself: for a sum of the
        # outputs it does not, and the second derivative would silently be wrong.
        if th.is_grad_enabled():
            raise RuntimeError(
                "NDBCNet has no second derivatives of sequences (create_graph=True): call it step by step, "
                "net(inputs[:, t], state), whose derivatives of any order are right"
            )
        return _backward(ctx, grad)


def _backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
    """The equations of :class:`UnrolledCell` from the last sub-step to the first."""
    recurrent, inertia, *saved = ctx.saved_tensors
    mask = saved.pop(0) if ctx.has_mask else None
    n = len(recurrent) // 2
    sign = th.cat((recurrent.new_ones(n, 1), -recurrent.new_ones(n, 1)))
    k, presynaptic, back = ctx.sub_steps, recurrent.shape[1], (recurrent * sign).t().contiguous()
    steps_of_time = grad.unbind(1)
    grad_state = th.zeros_like(steps_of_time[0])
    grad_inertia, grad_rest = th.zeros_like(grad_state), th.zeros_like(grad_state)
    grad_recurrent, grad_terms = th.zeros_like(recurrent), []
    for t in reversed(range(len(steps_of_time))):
        grad_state = grad_state + steps_of_time[t]
        before, *steps = saved[t * (3 * k + 1) : (t + 1) * (3 * k + 1)]
        pulls = th.zeros(0)
        for s in reversed(range(k)):
            released, total, after = steps[3 * s : 3 * s + 3]
            start = steps[3 * s - 1] if s else before
            quotient = grad_state / total
            pull = th.cat((quotient, quotient * after))  # d weighted | -d total
            excite = th.ops.aten.sigmoid_backward(back @ pull, released)
            grad_state = quotient * inertia
            grad_state[:presynaptic].add_(excite)
            grad_inertia.addcmul_(quotient, start)
            grad_recurrent.addmm_(pull, released.t())
            pulls = pulls + pull if s < k - 1 else pull
        grad_terms.append(pulls)
        if mask is not None:
            grad_rest += grad_state.masked_fill(mask[t], 0.0)
            grad_state = grad_state.masked_fill(~mask[t], 0.0)
    grad_terms.reverse()
    grad_rest, grad_inertia = grad_rest.sum(dim=1, keepdim=True), grad_inertia.sum(dim=1, keepdim=True)
    stacked = th.stack(grad_terms, dim=1)
    stacked[n:].neg_()
    return stacked, grad_state, None, grad_rest, grad_recurrent * sign, grad_inertia, None


class Unrolled(NamedTuple):
    """A sequence's states as logistic arguments ``z = gain V - threshold``, batch last."""

    arguments: th.Tensor  # (N, time, batch)
    gain: th.Tensor  # (N,); one where a neuron projects nowhere and has no logistic
    threshold: th.Tensor  # (N,); zero there

    def potentials(self) -> th.Tensor:
        """Potentials after every control step, ``(batch, time, N)``."""
        return (self.arguments.permute(2, 1, 0) + self.threshold) / self.gain

    def last(self) -> th.Tensor:
        """Potentials after the last step, ``(batch, N)``."""
        return (self.arguments[:, -1].t() + self.threshold) / self.gain

    def read(self, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
        """``weight V + bias`` for weights ``(outputs, N)``, ``(batch, time, outputs)``."""
        _, time, batch = self.arguments.shape
        scaled = weight / self.gain
        shift = bias + scaled @ self.threshold
        outputs = th.addmm(shift.unsqueeze(-1), scaled, self.arguments.flatten(1))
        return outputs.view(len(weight), time, batch).permute(2, 1, 0)


def unroll(
    cell: ConductanceCell,
    inputs: th.Tensor,
    input_gain: th.Tensor,
    state: th.Tensor,
    mask: th.Tensor | None,
    sub_steps: int,
) -> Unrolled:
    """Run a sequence.

    :param cell: the cell
    :param inputs: ``(batch, time, n_inputs)``
    :param input_gain: what inputs are multiplied by, ``(n_inputs,)``
    :param state: potentials to start from, ``(batch, N)``
    :param mask: 0 where potentials are reset before a step, ``(batch, time)``, or None
    :param sub_steps: K, sub-steps per control step
    """
    arrays, n = cell.arrays(), cell.n_neurons
    batch, time, _ = inputs.shape
    if mask is not None and time:  # a state that is NaN would reach the gain's gradient, as 0 x NaN
        state = th.where(mask[:, :1] != 0, state, 0.0)
    silent = n - cell.n_presynaptic
    gain = functional.pad(arrays.gain, (0, silent), value=1.0)
    threshold = functional.pad(cell.threshold, (0, silent))

    def fold(matrix: th.Tensor) -> th.Tensor:
        """From numerators of V to numerators of z: ``gain x numerator - threshold x denominator``; transposed."""
        weighted, total = matrix.chunk(2, dim=-1)
        return th.cat((weighted * gain - total * threshold, total), dim=-1).t()

    # One tanh for sensory neurons and input currents; the logistic's halves are in the matrices, see `excitation`.
    excite, shift = cell.excitation(arrays)
    excite, shift = excite * input_gain.unsqueeze(-1), shift.unsqueeze(-1)
    sources = th.tanh(th.addmm(shift, excite.t(), inputs.permute(2, 1, 0).reshape(cell.n_inputs, -1)))
    sensory, current = th.split(arrays.from_inputs, [cell.n_sensory_synapsing, cell.n_driven])
    inertia = arrays.capacitance * sub_steps
    rest = fold((arrays.rest + 0.5 * sensory.sum(dim=0)).unsqueeze(0)) + functional.pad(inertia, (n, 0)).unsqueeze(-1)
    terms = th.addmm(rest, fold(th.cat((0.5 * sensory, current))), sources).view(2 * n, time, batch)
    arguments = UnrolledCell.apply(  # type: ignore[no-untyped-call]
        terms, (state * gain - threshold).t(), None if mask is None else mask.t() != 0, -threshold.unsqueeze(-1),
        fold(arrays.recurrent), inertia.unsqueeze(-1), sub_steps,
    )  # fmt: skip
    return Unrolled(arguments, gain, threshold)
