"""CUDA graphs, as far as a CPU can tell: a replay does what the function does, and nothing in it waits or copies."""

import numpy as np
import pytest
import recorded
import torch

import ppo_gru
import ppo_trxl

MEMORIES = [
    {"memory": "gru"},
    {"memory": "lstm", "num_layers": 2},
    {"memory": "none"},
    {"script": ppo_trxl},
    {"script": ppo_trxl, "trxl_positional_encoding": "relative", "trxl_gate": "gru", "trxl_query_position": True},
]
TASKS = [
    {"env_id": "CueRecall-v0"},
    {"env_id": "MortarMayhemB-Grid-v0", "reconstruction_coef": 0.1, "ground_truth_coef": 0.1, "amp": True},
    {"env_id": "Endless-MortarMayhem-v0", "env_options": '{"max_steps": 5}', "bootstrap_truncated": True},
]
ITERATIONS = 4


@pytest.fixture
def as_on_a_gpu(tiny, monkeypatch):
    """Set up a training of some iterations with --cuda-graphs, but without a graph."""
    monkeypatch.setattr(ppo_trxl, "shapes_may_vary", lambda device: False)

    def make(script=ppo_gru, **changes):
        schedules = {"init_lr": 1e-2, "init_ent_coef": 0.1, "anneal_steps": 128}
        # As many levels as lanes, which a recording could take for its own.
        evaluation = {"eval_interval": 1, "eval_levels": 4, "eval_repeats": 1, "eval_max_steps": 20}
        args = tiny(script, **schedules, **evaluation, **changes)
        run = script.setup(args)
        run.rollout.alike, args.cuda_graphs = None, True
        return script, args, run

    return make


def train(script, args, run):
    """Train for some iterations; return the curves, a list by name."""
    logs = []
    for i in range(ITERATIONS):
        log, _ = script.iterate(args, run, 64 * i)
        logs.append(log | {"eval": script.evaluation(run, args)["return"].tolist()})
    return {name: [log.get(name) for log in logs] for name in logs[0]}


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("task", TASKS)
def test_replays_do_what_the_functions_do(as_on_a_gpu, monkeypatch, memory, task):
    """To the last bit: weights, memories, rates and draws go on from replay to replay, with evaluations between."""
    plain = train(*as_on_a_gpu(**memory, **task))
    script, args, run = as_on_a_gpu(**memory, **task)
    graphs = recorded.install(monkeypatch)
    run.optimizer, run.learn = script.make_learner(run.agent, run.rollout, args)
    replayed = train(script, args, run)
    for name in plain:
        np.testing.assert_array_equal(replayed[name], plain[name], err_msg=name)
    steps, minibatches = ITERATIONS * args.num_steps, ITERATIONS * args.update_epochs * args.num_minibatches
    fixed = script is ppo_trxl or memory["memory"] == "none"  # others learn from pieces of other lengths every time
    assert [graph.replays for graph in graphs] == ([steps - 3, minibatches - 3] if fixed else [steps - 3])


def test_uneven_pieces_are_not_recorded(as_on_a_gpu, monkeypatch):
    """Not even if they are the same again and again: how they are padded would be copied from the CPU."""
    script, args, run = as_on_a_gpu(ppo_trxl, env_id="CueRecall-v0", trxl_segment_length=5, num_minibatches=1)
    graphs = recorded.install(monkeypatch)
    _, learn = script.make_learner(run.agent, run.rollout, args)
    pieces = run.agent.memory.cut(torch.zeros(16, 4, dtype=torch.bool))
    lengths, targets = tuple(pieces.length.tolist()), (torch.zeros(16, 4), torch.zeros(16, 4))
    assert set(lengths) == {5, 1}
    for _ in range(6):
        learn(pieces.first, lengths, targets, torch.tensor(0.0))
    assert not graphs
    even = pieces.length == 5
    for _ in range(6):
        learn(pieces.first[even], int(even.sum()) * (5,), targets, torch.tensor(0.0))
    assert graphs[0].replays == 3


def test_what_differs_is_not_replayed(monkeypatch):
    """Another shape or number runs as it is; a recording needs some calls in a row that agree."""
    graphs = recorded.install(monkeypatch)
    called = []

    def add(x, parts, number):
        called.append(len(x))
        return {"sum": x + parts["y"] + number}

    graphed = ppo_gru.Graphed(add, warm_up=2)
    x = torch.arange(3.0)
    for length, number in [(3, 1), (2, 1), (3, 1), (3, 2), (3, 1), (3, 1)]:
        assert graphed(x[:length], {"y": x[:length]}, number)["sum"].equal(2 * x[:length] + number)
    assert not graphs
    for i in range(3):  # the first of these is recorded
        assert graphed(x + i, {"y": x}, 1)["sum"].equal(2 * x + i + 1)
        assert graphed(x + i, {"y": x}, 2)["sum"].equal(2 * x + i + 2)
        assert graphed(x[:1], {"y": x[:1]}, 1)["sum"].equal(torch.ones(1))
    assert graphs[0].replays == 3
    assert len(called) == 6 + 1 + 2 * 3


def test_a_recording_that_would_wait_is_refused(monkeypatch):
    """Guards the guard: the graphs of the tests refuse what CUDA's refuse."""
    recorded.install(monkeypatch)
    for waits in (lambda x: x.item(), lambda x: x.nonzero(), lambda x: x[x > 0], lambda x: x.unique()):
        graphed = ppo_gru.Graphed(waits, warm_up=0)
        with pytest.raises(RuntimeError, match="asks the device for a number"):
            graphed(torch.ones(1))


def test_a_recording_changes_nothing():
    """Guards the guard: as while a CUDA graph is captured, nothing is drawn or written until it is replayed."""
    torch.manual_seed(0)
    x, graph = torch.zeros(4), recorded.Graph()
    state = torch.get_rng_state()
    with graph:
        x[1:].add_(torch.rand(3))
    assert x.eq(0).all()
    assert torch.get_rng_state().equal(state)
    for _ in range(2):
        graph.replay()
    torch.manual_seed(0)
    torch.testing.assert_close(x[1:], torch.rand(3) + torch.rand(3))
