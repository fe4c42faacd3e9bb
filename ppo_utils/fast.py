"""Fast paths for a CPU: each computes what a plainer line would, in less time (benchmarks/train_sps.py).

Shape letters: T steps of a rollout, N environments, B samples, S sequences, L steps of the longest, I inputs and D
width of a recurrent layer, P hidden vectors of a sequence.
"""

import math
from collections import defaultdict
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHUNK = 256  # 2,048 images at once take 1.2 to 1.5 times as long on a CPU, for its caches


def in_chunks(network: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Apply a network that reads or makes images to x (B, ...): on a CPU chunk by chunk."""
    if x.device.type != "cpu" or len(x) <= CHUNK:
        return network(x)
    return torch.cat([network(part) for part in x.split(CHUNK)])


# ---- equal observations once ----
def first_occurrences(obs: dict[str, Tensor]) -> Tensor | None:
    """Return, for each observation of a rollout, parts (T, N, ...), the flat index (T * N,) of the first equal one.

    Equal are those whose bytes have the same 64-bit hash. Returns None where finding them does not pay: without images,
    which are most of the work of an encoder, and on a GPU.
    """
    if any(part.device.type != "cpu" for part in obs.values()) or all(part.ndim < 5 for part in obs.values()):
        return None
    first: dict[int, int] = {}
    samples = zip(*(part.flatten(0, 1).numpy() for part in obs.values()), strict=True)
    hashes = (hash(tuple(part.tobytes() for part in sample)) for sample in samples)
    return torch.tensor([first.setdefault(each, index) for index, each in enumerate(hashes)])


def encode(encoder: nn.Module, obs: dict[str, Tensor], index: Tensor, first_occurrence: Tensor | None) -> Tensor:
    """Encode the observations of a rollout, parts (T, N, ...), at flat indices (B,): (B, I), equal ones once.

    In grid tasks most images repeat. The gradient is the same, up to rounding. first_occurrence is what
    `first_occurrences` found; with None, every observation is encoded.
    """
    inverse = None
    if first_occurrence is not None:
        index, inverse = first_occurrence[index].unique(return_inverse=True)
    count = len(index)
    if torch.is_autocast_enabled("cpu"):
        # Kernels for bfloat16 are compiled for every batch size, which can take longer than running them.
        index = F.pad(index, (0, -count % 16))
    x = encoder({name: part.flatten(0, 1).index_select(0, index) for name, part in obs.items()})[:count]
    return x if inverse is None else x.index_select(0, inverse)


# ---- a GRU without padding ----
def packed_gru(rnn: nn.GRU, x: Tensor, lengths: Tensor, hidden: Tensor) -> Tensor:
    """Run a GRU over sequences of these lengths (S,): x (B, I), one sequence after the other, to (B, D).

    hidden (S, P, D): the states that they begin with. Computes what `rnn` does with padded sequences. The order is that
    of torch's PackedSequence: the first step of all sequences, the longest first, then the second step of those that
    have one, and so on.
    """
    column = torch.cat([torch.arange(length) for length in lengths.tolist()])  # (B,) of the step in its sequence
    longest_first = lengths.argsort(descending=True)
    rank = longest_first.argsort().repeat_interleave(lengths)  # (B,) of the step's sequence
    order = (column * len(longest_first) + rank).argsort()
    sizes = column.bincount().tolist()  # (L,) number of sequences that have a first step, a second ...
    y, hidden = x[order], hidden[longest_first].transpose(0, 1)  # (B, I), (P, S, D)
    with torch.autocast("cpu", enabled=False):
        for first, (w_input, w_hidden, b_input, b_hidden) in zip(hidden, rnn.all_weights, strict=True):
            y = GRUScan.apply(F.linear(y, w_input, b_input), first, w_hidden, b_hidden, sizes)
    return y[order.argsort()]


class GRUScan(torch.autograd.Function):
    """One layer of `nn.GRU` over packed sequences, for the update on a CPU, where the library's own is slower.

    Takes the projected inputs (B, 3D), the first states (S, D), the recurrent weight and bias, and the number of
    sequences that go on at each step; returns the states (B, D), all in packed order. What it saves: there is no
    padding, the weight is transposed once instead of at every step, and its gradient is one product over all steps
    instead of a sum of L small ones. The gates r, z and n are those of torch's documentation of nn.GRU.
    """

    @staticmethod
    def forward(ctx, inputs: Tensor, first: Tensor, weight: Tensor, bias: Tensor, sizes: list[int]) -> Tensor:
        """Run the recurrence, keeping every gate for the backward pass."""
        width = first.shape[1]
        gates = inputs.clone()  # (B, 3D) the projected inputs, overwritten step by step with r, z and n
        states, before, candidates = (inputs.new_empty(len(inputs), width) for _ in range(3))  # (B, D) each
        transposed, state = weight.T.contiguous(), first
        steps = zip(*(each.split(sizes) for each in (gates, before, candidates, states)), strict=True)
        for gate, previous, candidate, now in steps:
            previous.copy_(state[: len(now)])
            hidden = torch.addmm(bias, previous, transposed)  # (sequences that go on, 3D)
            rz, n = gate.split((2 * width, width), -1)
            rz.add_(hidden[:, : 2 * width]).sigmoid_()
            candidate.copy_(hidden[:, 2 * width :])  # the recurrent part of n
            n.addcmul_(rz[:, :width], candidate).tanh_()
            state = torch.lerp(n, previous, rz[:, width:], out=now)
        ctx.save_for_backward(before, gates, candidates, weight)
        ctx.sizes = sizes
        return states

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Go back through the steps; only what depends on the later states is left to the loop."""
        before, gates, candidates, weight = ctx.saved_tensors
        r, z, n = gates.chunk(3, -1)  # (B, D) each
        to_n = (1 - z) * (1 - n.square())  # what a state's gradient is multiplied with on its way to n's argument
        to_z = (before - n) * z * (1 - z)
        to_r = candidates * r * (1 - r)  # from n's argument on
        grad_hidden = torch.empty_like(gates)  # (B, 3D) of the recurrent product
        grad_n = torch.empty_like(n)
        carried = grad.new_zeros(0, grad.shape[1])  # the gradient that the later steps send back
        end = len(grad)
        for size in reversed(ctx.sizes):
            now, end = slice(end - size, end), end - size
            total = grad[now].clone()
            total[: len(carried)] += carried
            part_r, part_z, part_n = grad_hidden[now].chunk(3, -1)
            torch.mul(total, to_n[now], out=grad_n[now])
            torch.mul(grad_n[now], to_r[now], out=part_r)
            torch.mul(total, to_z[now], out=part_z)
            torch.mul(grad_n[now], r[now], out=part_n)
            carried = torch.addmm(total.mul_(z[now]), grad_hidden[now], weight)
        grad_weight = grad_hidden.T @ before  # (3D, D)
        grad_bias = grad_hidden.sum(0)
        grad_hidden.chunk(3, -1)[2].copy_(grad_n)  # the inputs' gradient differs in n alone
        return grad_hidden, carried, grad_weight, grad_bias, None


# ---- Muon in float32 ----
class Muon(torch.optim.Muon):
    """`torch.optim.Muon`, with all its matrices of one shape at once, and in float32, on a CPU.

    The library orthogonalizes in bfloat16, for which most CPUs have no instructions. Its momentum is Nesterov's, its
    rate that of adjust_lr_fn="match_rms_adamw", and it has one group of parameters; no other is needed here.
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:
        """Make a step along the orthogonalized momentum of each matrix that has a gradient."""
        (group,) = self.param_groups
        weights = [weight for weight in group["params"] if weight.grad is not None]
        if any(weight.device.type != "cpu" for weight in weights):
            return super().step()
        by_shape = defaultdict(list)
        for weight in weights:
            by_shape[weight.shape].append(weight)
        for (rows, columns), members in by_shape.items():
            directions = []
            for weight in members:
                if not self.state[weight]:
                    self.state[weight]["momentum_buffer"] = torch.zeros_like(weight)
                momentum = self.state[weight]["momentum_buffer"]
                momentum.lerp_(weight.grad, 1 - group["momentum"])
                directions.append(weight.grad.lerp(momentum, group["momentum"]))
            updates = orthogonalize(torch.stack(directions), group["ns_coefficients"], group["ns_steps"])
            rate = group["lr"] * 0.2 * math.sqrt(max(rows, columns))  # an update's root mean square is 0.2, as AdamW's
            for weight, update in zip(members, updates, strict=True):
                weight.mul_(1 - group["lr"] * group["weight_decay"]).sub_(update, alpha=rate)


def orthogonalize(matrices: Tensor, coefficients: tuple[float, float, float], steps: int) -> Tensor:
    """Return about the nearest orthogonal matrices to some (B, rows, columns), by Newton-Schulz iterations."""
    a, b, c = coefficients
    is_tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.mT if is_tall else matrices
    x = x / torch.linalg.matrix_norm(x, keepdim=True).clamp(min=1e-7)  # no singular value is above 1
    for _ in range(steps):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if is_tall else x
