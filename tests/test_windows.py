"""The Transformer-XL memory: its band attention against a loop over samples, its window's edges, its encodings."""

import functools
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from enjoy import attention_weights
from ppo_trxl import Args, Attention, Memory, attended_keys, attention_mask, sinusoid

ENCODINGS = ["absolute", "learned", "relative", "none"]
STEPS, LANES, WIDTH = 24, 3, 8


def make_memory(**changes):
    """A small memory in float64 whose parameters are all random: zeros would hide a missing term."""
    small = {"trxl_dim": WIDTH, "trxl_num_heads": 2, "trxl_num_layers": 2, "trxl_memory_length": 5, "num_steps": STEPS}
    torch.manual_seed(0)
    memory = Memory(Args(**{**small, "trxl_segment_length": 8, **changes}), WIDTH).double()
    for parameter in memory.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return memory


def fresh(memory, num_envs=LANES, num_steps=STEPS):
    """The memory of fresh episodes in float64."""
    carry = memory.initial(num_envs, torch.device("cpu"))
    return memory.begin_rollout(carry | {"hidden": carry["hidden"].double()}, num_steps)


def take_step(memory, state, x):
    """Take a step, and store what it leaves; return the output."""
    y, hidden = memory.step(state, x)
    memory.advance(state, hidden)
    return y


def begin_rollout(memory, state):
    """Begin the next rollout."""
    return memory.begin_rollout(memory.carry(state), STEPS)


def make_timeline(memory, seed=1):
    """Random hidden states, and steps of episodes that end at random; in environment 0 one ends before the rollout."""
    generator = torch.Generator().manual_seed(seed)
    rows = memory.window + STEPS
    hidden = torch.randn(rows, LANES, len(memory.blocks), WIDTH, dtype=torch.float64, generator=generator)
    ends = torch.rand(rows, LANES, generator=generator) < 0.15
    ends[memory.window, 0] = True
    steps = torch.zeros(rows, LANES, dtype=torch.int64)
    for row in range(1, rows):
        steps[row] = (steps[row - 1] + 1).masked_fill(ends[row], 0)
    return replace(fresh(memory), now=rows, hidden=hidden, row_step=steps)


def encoded(memory, step):
    """The encoding of a step, or the learned one."""
    if memory.encoding == "learned":
        return memory.table[min(step, len(memory.table) - 1)]
    return sinusoids(step)


@functools.cache
def sinusoids(step):
    """The encoding of a step, number by number (2.57, 2.58)."""
    angles = [step / 10000 ** (2 * (i // 2) / WIDTH) for i in range(WIDTH)]
    return torch.tensor([math.cos(a) if i % 2 else math.sin(a) for i, a in enumerate(angles)], dtype=torch.float64)


def normed(layer, x):
    """What a layer norm makes of x (..., D), or x where there is none."""
    if isinstance(layer, torch.nn.Identity):
        return x
    x = x - x.mean(-1, keepdim=True)
    return x / (x.square().mean(-1, keepdim=True) + 1e-5).sqrt() * layer.weight + layer.bias


def merged(merge, x, y):
    """The sum of x and y, or what a gate makes of them (Parisotto et al., 2020)."""
    if merge is torch.add:
        return x + y
    r = torch.sigmoid(merge.reset_y.weight @ y + merge.reset_x.weight @ x)
    z = torch.sigmoid(merge.update_y.weight @ y + merge.update_x.weight @ x - merge.bias)
    return (1 - z) * x + z * torch.tanh(merge.candidate_y.weight @ y + merge.candidate_x.weight @ (r * x))


def naive(memory, x, row, lane, stored, own=None):
    """One sample: gather its window, project it, attend with a softmax that is written out.

    own: the blocks' inputs at the segment's earlier steps, which take the place of what is stored; this step's are
    appended.
    """
    step = int(stored.row_step[row, lane])
    window = min(step, memory.window)
    at = torch.arange(row - window, row)
    added = torch.zeros_like(x)
    if memory.blocks[0].adds_position:
        added = added + encoded(memory, step)
    inputs = []
    for k, block in enumerate(memory.blocks):
        attention = block.attention
        inputs.append(x)
        attended_to = stored.hidden[at, lane, k]
        if own:
            recent = torch.stack([each[k] for each in own])[-window or len(own) :]
            attended_to = torch.cat([attended_to[: window - len(recent)], recent])
        if memory.encoding in ("absolute", "learned") and window:
            steps = stored.row_step[at, lane].tolist()
            attended_to = attended_to + torch.stack([encoded(memory, each) for each in steps])
        keys_of = normed(block.norm_memory, attended_to)
        query = normed(block.norm_query, x + added if k == 0 else x)
        heads, size = [], WIDTH // attention.num_heads
        for h in range(attention.num_heads):
            of = slice(h * size, (h + 1) * size)
            w_q, w_k, w_v = (layer.weight[of].T for layer in (attention.query, attention.key, attention.value))
            scores = query @ w_q @ (keys_of @ w_k).T
            if memory.encoding == "relative" and window:  # the four terms of (2.61)
                r = torch.stack([encoded(memory, age) for age in (row - at).tolist()])
                u, v = attention.content_bias, attention.position_bias
                scores = scores + query @ w_q @ (r @ w_k).T + u @ w_q @ (keys_of @ w_k).T + v @ w_q @ (r @ w_k).T
            heads.append((scores / math.sqrt(size)).softmax(-1) @ (keys_of @ w_v))
        attended = torch.zeros_like(x)
        if window:
            attended = attention.output.weight @ torch.cat(heads) + attention.output.bias
        x = normed(block.after_attention, merged(block.merge_attention, x, attended))
        projected = F.relu(block.projection.weight @ normed(block.norm_projection, x) + block.projection.bias)
        x = normed(block.after_projection, merged(block.merge_projection, x, projected))
    if own is not None:
        own.append(inputs)
    return x


VARIANTS = [
    {"trxl_positional_encoding": encoding, "trxl_gate": gate, "trxl_memory_length": window}
    for encoding, (gate, window) in itertools.product(ENCODINGS, [("none", 1), ("gru", 5), ("gru", 13), ("none", 40)])
] + [
    {"trxl_positional_encoding": encoding, **changes}
    for encoding in ENCODINGS
    for changes in (
        {"trxl_query_position": True},
        {"trxl_query_position": True, "trxl_layer_norm": "post"},
        {"trxl_gate": "gru", "trxl_layer_norm": "post"},
    )
]


@pytest.mark.parametrize("changes", VARIANTS)
def test_unroll_equals_a_window_gathered_for_every_sample(changes):
    memory = make_memory(**changes)
    stored = make_timeline(memory)
    order = torch.randperm(LANES * math.ceil(STEPS / 8), generator=torch.Generator().manual_seed(2))
    pieces = memory.cut(torch.zeros(STEPS, LANES, dtype=torch.bool))
    pieces.first, pieces.length = pieces.first[order[:5]], pieces.length[order[:5]]
    pieces.length[2] = 3  # padding
    flat = pieces.flat_index().tolist()
    x = torch.randn(len(flat), WIDTH, dtype=torch.float64, requires_grad=True)
    wanted = torch.stack(
        [naive(memory, x[i], memory.window + at // LANES, at % LANES, stored) for i, at in enumerate(flat)]
    )
    found = memory.unroll(stored, x, pieces)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-10)
    weight = torch.randn_like(wanted)
    inputs = [x, *memory.parameters()]
    gradients = [torch.autograd.grad((y * weight).sum(), inputs, allow_unused=True) for y in (found, wanted)]
    for got, want in zip(*gradients, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-10)


@pytest.mark.parametrize("changes", VARIANTS)
def test_the_gradient_through_a_segment_equals_a_loop_s(changes):
    """The loop takes one step after the other, and keeps what each block was given, with its gradient."""
    memory = make_memory(trxl_memory_gradient=True, trxl_num_layers=3, **changes)
    stored = make_timeline(memory)
    pieces = memory.cut(torch.zeros(STEPS, LANES, dtype=torch.bool))
    some = [0, 2, 4, 6]  # of each environment, and of each third of the rollout
    pieces.first, pieces.length = pieces.first[some], pieces.length[some]
    pieces.length[1] = 3  # padding
    flat = pieces.flat_index().tolist()
    x = torch.randn(len(flat), WIDTH, dtype=torch.float64, requires_grad=True)
    wanted, steps = [], iter(zip(x, flat, strict=True))
    for length in pieces.length.tolist():
        own = []
        for each, at in itertools.islice(steps, length):
            wanted.append(naive(memory, each, memory.window + at // LANES, at % LANES, stored, own))
    wanted, found = torch.stack(wanted), memory.unroll(stored, x, pieces)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-10)
    weight = torch.randn_like(wanted)
    gradients = [
        torch.autograd.grad((y * weight).sum(), [x, *memory.parameters()], allow_unused=True) for y in (found, wanted)
    ]
    for got, want in zip(*gradients, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-9)


@pytest.mark.parametrize("gate", ["none", "gru"])
def test_how_far_the_gradient_reaches(gate):
    """To the segment's first step, within the window of each block and the episode."""
    memory = make_memory(trxl_memory_gradient=True, trxl_gate=gate, trxl_memory_length=2, trxl_num_layers=3)
    stored = make_timeline(memory)
    stored.row_step[:] = torch.arange(100, 100 + len(stored.row_step))[:, None]  # an episode that goes on
    stored.row_step[memory.window + 12 :, 1] -= 100 + memory.window + 12  # in environment 1, one begins at step 12
    pieces = memory.cut(torch.zeros(STEPS, LANES, dtype=torch.bool))
    x = torch.randn(STEPS * LANES, WIDTH, dtype=torch.float64, requires_grad=True)
    y = memory.unroll(stored, x, pieces)
    flat = pieces.flat_index()

    def reached(t, lane):
        """The steps that get gradient from the output at step t."""
        (gradient,) = torch.autograd.grad(y[flat == t * LANES + lane].sum(), x, retain_graph=True)
        touched = flat[gradient.abs().sum(1) > 0]
        assert (touched % LANES == lane).all()
        return sorted((touched // LANES).tolist())

    assert reached(15, 0) == [9, 10, 11, 12, 13, 14, 15], "three blocks, each with a window of 2"
    assert reached(11, 0) == [8, 9, 10, 11], "the segment of 8 steps begins at 8"
    assert reached(14, 1) == [12, 13, 14], "another episode"
    assert reached(12, 1) == [12]
    plain = make_memory(trxl_gate=gate, trxl_memory_length=2, trxl_num_layers=3)
    y = plain.unroll(stored, x, pieces)
    assert reached(15, 0) == [15]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("window", [3, 40])
def test_playing_equals_unrolling(encoding, window):
    """Three rollouts: an episode of environment 0 spans them all, others end inside them."""
    memory = make_memory(trxl_positional_encoding=encoding, trxl_memory_length=window)
    state, generator = fresh(memory), torch.Generator().manual_seed(3)
    for _ in range(3):
        x = torch.randn(STEPS, LANES, WIDTH, dtype=torch.float64, generator=generator)
        done = torch.rand(STEPS, LANES, generator=generator) < 0.1
        done[:, 0] = False
        played = []
        with torch.no_grad():
            state = begin_rollout(memory, state)
            for t in range(STEPS):
                played.append(take_step(memory, state, x[t]))
                memory.reset(state, done[t])
        pieces = memory.cut(done)
        index = pieces.flat_index()
        unrolled = memory.unroll(state, x.flatten(0, 1)[index], pieces)
        torch.testing.assert_close(unrolled, torch.stack(played).flatten(0, 1)[index], rtol=0, atol=1e-10)
        with torch.no_grad():
            for parameter in memory.parameters():
                parameter.mul_(0.9)  # the cache has to be computed again
    assert state.episode_step[0] == 3 * STEPS


def test_window_edges():
    age = torch.arange(-1, 8)
    for step, seen in {
        0: [],
        1: [1],
        4: [1, 2, 3, 4],
        5: [1, 2, 3, 4, 5],
        6: [1, 2, 3, 4, 5],
        99: [1, 2, 3, 4, 5],
    }.items():
        assert age[attention_mask(age, torch.tensor(step), 5)].tolist() == seen


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_attention_weights_are_those_that_were_used(encoding):
    torch.manual_seed(0)
    attention = Attention(WIDTH, 2, encoding == "relative").double()
    x, keys, values = (torch.randn(4, length, WIDTH, dtype=torch.float64) for length in (3, 6, 6))
    age = 3 + torch.arange(3)[:, None] - torch.arange(6)
    seen = attention_mask(age, torch.tensor([0, 1, 2, 3])[:, None, None] + torch.arange(3)[:, None], 4)
    weights = attention_weights(attention, x, keys, age, seen)
    assert weights[0, :, 0].eq(0).all(), "the first step of an episode looks at nothing"
    torch.testing.assert_close(weights.sum(-1)[1:], torch.ones(3, 2, 3, dtype=torch.float64))
    assert (weights > 0).equal(seen[:, None].expand_as(weights))
    heads = (weights @ attention.split(values)).transpose(1, 2).flatten(2)
    used = attention(x, keys, values, age, seen)
    torch.testing.assert_close(attention.output(heads)[seen.any(-1)], used[seen.any(-1)], rtol=0, atol=1e-12)
    assert used[~seen.any(-1)].eq(0).all()


def test_attention_equals_the_library_s():
    torch.manual_seed(0)
    attention, library = Attention(WIDTH, 2, False), torch.nn.MultiheadAttention(WIDTH, 2, batch_first=True)
    parts = (attention.query.weight, attention.key.weight, attention.value.weight)
    library.load_state_dict(
        {
            "in_proj_weight": torch.cat(parts),
            "in_proj_bias": torch.zeros(3 * WIDTH),
            "out_proj.weight": attention.output.weight,
            "out_proj.bias": attention.output.bias,
        }
    )
    x, items = torch.randn(2, 3, WIDTH), torch.randn(2, 7, WIDTH)
    seen = torch.rand(3, 7) < 0.5
    seen[:, 0] = True
    wanted, weights = library(x, items, items, attn_mask=~seen, average_attn_weights=False)
    age, seen = torch.ones(3, 7, dtype=torch.int64), seen.expand(2, 3, 7)
    torch.testing.assert_close(attention(x, attention.key(items), attention.value(items), age, seen), wanted)
    torch.testing.assert_close(attention_weights(attention, x, attention.key(items), age, seen), weights)


def test_the_drawn_example():
    """What the docstring of `attended_keys` draws."""
    keys, age, mask = attended_keys(torch.tensor([[5, 6, 0, 1]]), 3, torch.device("cpu"))
    assert keys.tolist() == [-3, -2, -1, 0, 1, 2]
    assert age[:, 3].tolist() == [0, 1, 2, 3]
    assert mask[0].int().tolist() == [[1, 1, 1, 0, 0, 0], [0, 1, 1, 1, 0, 0], [0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1]]


@pytest.mark.parametrize(("steps", "before"), [([0, 0], 1), ([0, 2], 2), ([9, 1], 5)])
def test_the_window_while_acting(steps, before):
    """Queries of one step: keys as far back as the longest episode reaches, at most the window, and at least one."""
    keys, age, mask = attended_keys(torch.tensor(steps)[:, None], 5, torch.device("cpu"))
    assert keys.tolist() == [*range(-before, 0)]
    assert age.tolist() == [[*range(before, 0, -1)]]
    assert mask.sum(-1)[:, 0].tolist() == [min(step, 5) for step in steps]


@pytest.mark.parametrize("fill", [1e6, math.nan])
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("flag", ["trxl_memory_gradient", "trxl_query_position"])
def test_what_is_not_seen_changes_nothing(encoding, fill, flag):
    memory = make_memory(trxl_positional_encoding=encoding, **{flag: True})
    stored = make_timeline(memory)
    pieces = memory.cut(torch.zeros(STEPS, LANES, dtype=torch.bool))
    x = torch.randn(STEPS * LANES, WIDTH, dtype=torch.float64)

    def learn():
        memory.zero_grad()
        y = memory.unroll(stored, x, pieces)
        y.square().sum().backward()
        return [y.detach(), *(parameter.grad for parameter in memory.parameters())]

    clean = learn()
    stored.hidden[: memory.window, 0] = fill
    for lane in range(LANES):
        ends = (stored.row_step[1:, lane] == 0).nonzero()[:, 0]
        stored.hidden[ends[ends >= memory.window], lane] = fill  # no query attends to an episode's last step
    assert (stored.hidden != stored.hidden.clamp(-1e5, 1e5)).sum() > 50
    for got, want in zip(learn(), clean, strict=True):
        assert got.equal(want)


def test_a_forgotten_episode_leaves_nothing_in_the_cache():
    """The other episode goes on, so that all of the forgotten one is still within the window."""
    memory = make_memory()
    state, x = fresh(memory, 2), torch.randn(2, WIDTH).double()
    with torch.no_grad():
        for _ in range(4):
            take_step(memory, state, torch.stack([torch.full_like(x[0], math.nan), x[1]]))
        memory.reset(state, torch.tensor([True, False]))
        for _ in range(7):
            assert take_step(memory, state, x).isfinite().all()


def test_a_step_stores_the_inputs_of_its_blocks():
    memory, inputs = make_memory(), []
    for block in memory.blocks:
        block.register_forward_pre_hook(lambda _, given: inputs.append(given[0]))
    state, x = fresh(memory), torch.randn(LANES, WIDTH).double()
    for _ in range(3):
        inputs.clear()
        with torch.no_grad():
            y, hidden = memory.step(state, x)
        assert hidden.equal(torch.cat(inputs, 1))
        memory.advance(state, hidden)
        assert state.hidden[state.now - 1].equal(hidden)
        x = y


def test_a_step_that_is_not_stored_changes_nothing():
    """As is done to value an observation that is not acted on, the one after the rollout's last step included."""
    memory = make_memory()
    state, again = fresh(memory), fresh(memory)
    with torch.no_grad():
        for _ in range(STEPS):
            x, other = torch.randn(2, LANES, WIDTH).double()
            memory.step(again, other)
            assert take_step(memory, state, x).equal(take_step(memory, again, x))
        memory.step(again, other)
        for name, part in vars(state).items():
            other = getattr(again, name)
            assert part == other if name == "now" else all(map(torch.equal, part, other)), name
        state, again = begin_rollout(memory, state), begin_rollout(memory, again)
        assert memory.step(state, x)[0].equal(memory.step(again, x)[0])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_episodes_longer_than_a_learned_encoding(encoding):
    """Steps beyond the table of six have the encoding of step 6, what follows an episode of six steps."""
    memory = make_memory(trxl_positional_encoding=encoding)
    if encoding == "learned":
        memory.table = torch.nn.Parameter(memory.table[:7].detach())
    at = memory.key_position(torch.tensor([4, 5, 6, 7, 5000]), torch.zeros((), dtype=torch.float64))
    assert np.shape(at) == ((5, WIDTH) if encoding in ("absolute", "learned") else ())
    if encoding == "learned":
        assert at.equal(memory.table[[4, 5, 6, 6, 6]])
    elif encoding == "absolute":
        assert at.equal(sinusoid(torch.tensor([4, 5, 6, 7, 5000]), WIDTH)), "beyond the table"
    state = fresh(memory, 1)
    with torch.no_grad():
        for _ in range(9):
            assert take_step(memory, state, torch.randn(1, WIDTH).double()).isfinite().all()


@pytest.mark.parametrize("step", [0, 1023, 1024, 1025, 5000])
def test_steps_beyond_the_table_of_sinusoids_are_encoded_alike(step):
    memory = make_memory()
    for step_now in (step, step + 1):  # an episode goes on
        at = memory.key_position(torch.tensor([step_now]), torch.zeros((), dtype=torch.float64))
        assert at.equal(sinusoid(torch.tensor([step_now]), WIDTH))
    assert "sinusoids" not in memory.state_dict()


def test_sinusoid():
    at = sinusoid(torch.tensor([0, 1, 5000]), 4)
    assert at[0].tolist() == [0, 1, 0, 1]
    angles = [5000, math.cos(5000), 5000 / 100]
    torch.testing.assert_close(
        at[2], torch.tensor([math.sin(angles[0]), angles[1], math.sin(angles[2]), math.cos(angles[2])]).double()
    )


@pytest.mark.parametrize("gate", ["none", "gru"])
def test_initialization(gate):
    """Xavier's uniform distribution for every matrix, those of gates too; biases are 0 (table 6.1)."""
    torch.manual_seed(0)
    block = Memory(Args(trxl_num_layers=2, trxl_gate=gate, trxl_gate_bias=0.0), 384).blocks[1]
    layers = [layer for layer in block.modules() if isinstance(layer, torch.nn.Linear)]
    assert len(layers) == (5 if gate == "none" else 17)
    for layer in layers:
        assert layer.weight.std().item() == pytest.approx(384**-0.5, rel=0.02)
        kurtosis = (layer.weight / layer.weight.std()).pow(4).mean().item()
        assert kurtosis == pytest.approx(1.8, rel=0.05), "a normal distribution has 3"
        assert layer.bias is None or layer.bias.eq(0).all()
