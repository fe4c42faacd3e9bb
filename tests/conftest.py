import os

os.environ["OMP_NUM_THREADS"] = "1"  # of the programs that tests start, too: as many threads, to the bit the same

import gc
import importlib
import random
from pathlib import Path
from types import SimpleNamespace

import cue_recall  # noqa: F401 (registers CueRecall-v0)
import numpy as np
import pytest
import torch
import torch._dynamo  # the first optimizer needs it: here once, and not again in each forked program
from gymnasium.utils import seeding
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer import event_file_writer
from tensorboard.util.tensor_util import make_ndarray
from xdist.scheduler import WorkStealingScheduling

import ppo_gru
import ppo_trxl
from ppo_utils import runs

torch.set_num_threads(1)  # the networks here are so small that threads would mostly wait for each other
# TensorBoard reads the files of a run in the order of their names: the second, then a process's count of its files,
# where 10 comes before 9. Only tests open two files of a run within a second.
event_file_writer._global_uid = event_file_writer.AtomicCounter(1000)

ROOT = Path(__file__).parents[1]
# A script with another memory needs no more than to lie beside these two: its memory is held to the same contract.
OTHERS = [importlib.import_module(path.stem) for path in sorted(ROOT.glob("ppo_*.py"))]
OTHERS = [script for script in OTHERS if script not in (ppo_gru, ppo_trxl)]
SCRIPTS = [ppo_gru, ppo_trxl, *OTHERS]
SMALL = {"trunk_size": 32, "hidden_size": 32, "trxl_dim": 32}
SMALL |= {"trxl_num_heads": 2, "trxl_num_layers": 2, "trxl_memory_length": 7}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Let a process of `-n auto` that has nothing left to do take tests from another, so that all end together."""
    return WorkStealingScheduling(config, log) if config.option.dist == "load" else None


def pytest_collection_finish():
    """Collect garbage among what the tests make, and no more in what stays: PyTorch and thousands of tests."""
    gc.freeze()


def pytest_terminal_summary(terminalreporter):
    """Say in one line what no browser could look at."""
    skipped = [report for report in terminalreporter.stats.get("skipped", ()) if "no browser" in str(report.longrepr)]
    if skipped:
        terminalreporter.write_line(
            f"no browser: {len(skipped)} tests of the page of enjoy.py are skipped; apt-get install chromium "
            "chromium-driver",
            yellow=True,
        )


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Let every test write its runs to a folder of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def same_draws(monkeypatch):
    """Let what a test draws without a seed be the same in every run of the tests."""
    torch.manual_seed(0)
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 (environments of others draw from it)
    seeded = SimpleNamespace(np_random=lambda seed=None: seeding.np_random(0 if seed is None else seed))
    monkeypatch.setattr("gymnasium.spaces.space.seeding", seeded)


def parse_args(script, *flags):
    """What a script's command line stands for."""
    return runs.parse_args(script.Args, script.PRESETS, [*flags])


def collect(script, run, args):
    """Play a rollout, and keep it in run.rollout; return the metrics of its episodes."""
    run.rollout, run.carry, episodes = script.collect(run.agent, run.envs, run.carry, args)
    return episodes


@pytest.fixture(scope="session")
def tiny():
    """Arguments of a script for a training of two short iterations; keyword arguments replace some of them."""

    def make(script=ppo_gru, **changes):
        small = {name: size for name, size in SMALL.items() if hasattr(script.Args, name)}
        few = {"num_envs": 4, "num_steps": 16, "num_minibatches": 2, "update_epochs": 2, **small}
        few["value_init_gain"] = 1.0  # values that are far from 0, so that a test sees what changes them
        return script.Args(**{"cuda": False, "total_timesteps": 128, **few, **changes})

    return make


@pytest.fixture
def scalars():
    """Read a run folder's curves: a list of values by name."""

    def read(folder):
        events = EventAccumulator(str(folder))
        events.Reload()
        return {name: [point.value for point in events.Scalars(name)] for name in events.Tags()["scalars"]}

    return read


@pytest.fixture
def curves():
    """Read all that a run has logged but what a clock measures: lists of (step, value) by name."""

    def read(folder):
        events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "tensors": 0})
        events.Reload()
        tags = events.Tags()
        names = [name for name in tags["scalars"] if not name.startswith(("charts/SPS", "charts/seconds"))]
        found = {name: [(point.step, point.value) for point in events.Scalars(name)] for name in names}
        for name in tags["tensors"]:
            if name.startswith("eval_levels/"):
                points = events.Tensors(name)
                last = {point.step: make_ndarray(point.tensor_proto).tolist() for point in points}
                found[name] = list(last.items())  # of tensors that were logged twice, the reader keeps both
        return found

    return read


@pytest.fixture
def opened():
    """Set up runs, which are closed when the test ends."""
    found = []

    def open_run(script, args):
        found.append(script.setup(args))
        return found[-1]

    yield open_run
    for run in found:
        runs.close(run)


@pytest.fixture
def played(tiny, opened):
    """Set up an agent and play some rollouts, without learning; the last one stays in run.rollout, its
    advantages and returns are zeros. Returns its last value too, and the metrics of its episodes."""

    def play(iterations=1, weights_scale=1.0, script=ppo_gru, **changes):
        args = tiny(script, **changes)
        run = opened(script, args)
        with torch.no_grad():  # the initial policy hardly depends on its input; a test needs one that does
            for parameter in run.agent.heads.parameters():
                parameter.mul_(weights_scale)
        for _ in range(iterations):
            episodes = collect(script, run, args)
        run.rollout.advantages, run.rollout.returns = run.rollout.values.new_zeros(2, *run.rollout.values.shape)
        return args, run, run.rollout.last_value, episodes

    return play
