"""Cutting a rollout into pieces, padding them, and taking them apart again."""

import itertools

import pytest
import torch

from ppo_gru import Args, Memory, Pieces

# Environment 0 ends an episode at step 2, environment 1 at steps 0 and 4 (the rollout's last).
DONE = torch.tensor([[0, 1], [0, 0], [1, 0], [0, 0], [0, 1]], dtype=torch.bool)


def pieces_of(memory, done):
    pieces = memory.cut(done)
    return list(zip(pieces.first.tolist(), pieces.length.tolist(), strict=True))


def test_pieces_end_where_episodes_do():
    memory = Memory(Args(hidden_size=4), 4)
    assert pieces_of(memory, DONE) == [(0, 3), (6, 2), (1, 1), (3, 4)]


def test_pieces_end_after_seq_len_steps_counted_from_the_episode_s_first():
    memory = Memory(Args(hidden_size=4, seq_len=2), 4)
    assert pieces_of(memory, DONE) == [(0, 2), (4, 1), (6, 2), (1, 1), (3, 2), (7, 2)]


def test_without_memory_every_step_is_a_piece():
    memory = Memory(Args(hidden_size=4, memory="none"), 4)
    assert pieces_of(memory, DONE) == [(t * 2 + n, 1) for n in (0, 1) for t in range(5)]


def test_flat_index_lists_the_pieces_steps_in_order():
    pieces = Pieces(torch.tensor([6, 1, 3]), torch.tensor([2, 1, 4]), num_envs=2)
    assert pieces.flat_index().tolist() == [6, 8, 1, 3, 5, 7, 9]


def test_the_drawn_example():
    """What the docstring of Pieces draws."""
    done = torch.zeros(5, 2, dtype=torch.bool)
    done[2, 0] = True
    pieces = Memory(Args(hidden_size=4), 4).cut(done)
    assert (pieces.first.tolist(), pieces.length.tolist()) == ([0, 6, 1], [3, 2, 5])
    assert pieces.flat_index().tolist() == [0, 2, 4, 6, 8, 1, 3, 5, 7, 9]
    x = pieces.flat_index()[:, None].float() + 1
    padded = pieces.pad(x)
    assert padded[..., 0].tolist() == [[1, 3, 5, 0, 0], [7, 9, 0, 0, 0], [2, 4, 6, 8, 10]]
    assert pieces.unpad(padded).equal(x)


@pytest.mark.parametrize("seq_len", [0, 1, 7, 500])
def test_minibatches_deal_every_step_once(seq_len):
    torch.manual_seed(0)
    done = torch.rand(64, 8) < 0.05
    pieces = Memory(Args(hidden_size=4, seq_len=seq_len), 4).cut(done)
    minibatches = list(pieces.minibatches(4))
    steps = torch.cat([minibatch.flat_index() for minibatch in minibatches])
    assert sorted(steps.tolist()) == list(range(64 * 8))
    sizes = [int(minibatch.length.sum()) for minibatch in minibatches]
    assert max(sizes) - min(sizes) <= 2 * pieces.length.max()
    assert pieces.length.max() <= (seq_len or 64)
    order = [minibatch.first.tolist() for minibatch in pieces.minibatches(4)]
    assert order != [minibatch.first.tolist() for minibatch in minibatches], "the pieces are shuffled again"


@pytest.mark.parametrize(("num_envs", "num_steps", "ends"), [(32, 512, 0.01), (8, 128, 0.0), (8, 128, 0.02)])
def test_minibatches_have_the_same_number_of_steps_on_average(num_envs, num_steps, ends):
    """None of them is larger because of its place in the epoch."""
    torch.manual_seed(0)
    memory, sizes = Memory(Args(hidden_size=4), 4), []
    for _ in range(400):
        pieces = memory.cut(torch.rand(num_steps, num_envs) < ends)
        sizes.append([int(minibatch.length.sum()) for minibatch in pieces.minibatches(8)])
    sizes = torch.tensor(sizes, dtype=torch.float64)
    deviation = (sizes.mean(0) - num_envs * num_steps / 8).abs()
    assert (deviation <= 4 * sizes.std(0) / 400**0.5).all(), sizes.mean(0)


def test_one_long_piece_beside_many_short_ones():
    """Minibatches have as many steps, not as many pieces: the one with the long piece has few others."""
    torch.manual_seed(0)
    length = torch.tensor([64, *[1] * 192])
    pieces = Pieces(length.cumsum(0) - length, length, num_envs=1)
    for _ in range(20):
        for minibatch in pieces.minibatches(4):
            assert abs(int(minibatch.length.sum()) - 64) <= 64
            if minibatch.length.max() == 64:
                assert len(minibatch.length) <= 65, "the steps of another minibatch, and half of it on each side"
        sizes = [len(minibatch.length) for minibatch in pieces.minibatches(4)]
        assert max(sizes) - min(sizes) >= 32, "as many pieces each would be 48"


def test_no_minibatch_is_empty_at_the_limit_of_check_minibatches():
    memory = Memory(Args(hidden_size=4), 4)
    for seed, rate in itertools.product(range(30), (0.0, 0.1, 0.5)):
        torch.manual_seed(seed)
        pieces = memory.cut(torch.rand(16, 8) < rate)
        assert all(len(minibatch.first) for minibatch in pieces.minibatches(8))


def test_no_piece_spans_an_episode_s_end():
    torch.manual_seed(1)
    done = torch.rand(50, 6) < 0.1
    pieces = Memory(Args(hidden_size=4, seq_len=9), 4).cut(done)
    for first, length in zip(pieces.first.tolist(), pieces.length.tolist(), strict=True):
        assert not done.flatten()[[first + i * 6 for i in range(length - 1)]].any()


@pytest.mark.parametrize("seq_len", [0, 8])
def test_padded_length_is_the_longest_piece(seq_len, monkeypatch):
    memory = Memory(Args(hidden_size=4, memory="lstm", seq_len=seq_len), 4)
    seen = []
    recur = memory.recur
    monkeypatch.setattr(memory, "recur", lambda x, hidden: (seen.append(x.shape), recur(x, hidden))[1])
    done = torch.zeros(32, 3, dtype=torch.bool)
    done[[4, 20]] = True
    pieces = memory.cut(done)
    y = memory.unroll(memory.begin_rollout(memory.initial(3, torch.device("cpu")), 32), torch.randn(96, 4), pieces)
    assert seen == [(len(pieces.length), seq_len or 16, 4)], "the recurrent layers run once, padded no further"
    assert y.shape == (96, 4)
