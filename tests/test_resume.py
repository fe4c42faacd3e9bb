"""A run that stops and goes on gives, to the last bit, the curves of the run that never stopped."""

import dataclasses
import errno
import itertools
import os
import pickle
import random
import re
import resource
import shutil
import signal
import sys
import time
import types
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import SCRIPTS, parse_args
from programs import Program, command, run_command
from tensorboard.summary.writer.record_writer import RecordWriter

import enjoy
import evaluate
import ppo_gru
import ppo_trxl
from ppo_utils import checkpoints, runs
from ppo_utils.checkpoints import model_of, read_checkpoint, read_model, write_file
from ppo_utils.errors import RunError
from ppo_utils.run_logs import read_run

ROOT = Path(__file__).parents[1]

GRID = {"env_id": "MortarMayhemB-Grid-v0", "obs_type": "vector"}
ENDLESS = {"env_id": "Endless-SearingSpotlights-v0", "obs_type": "vector"}
PIXELS = {"num_steps": 8, "update_epochs": 1}  # of pictures fewer, since each takes long
# What has a state of its own is in one of these; together, where neither hides the other.
RUNS = {
    "GRU, pixels, veil": {"env_id": "MortarMayhemB-Grid-v0", "spotlight_perturbation": True, **PIXELS},
    "GRU, endless": {**ENDLESS, "seq_len": 5, "num_layers": 2, "refresh_memory": True},
    "LSTM, pixels, reconstruction": {
        "env_id": "MortarMayhemB-Grid-v0", "memory": "lstm", "reconstruction_coef": 0.1, **PIXELS
    },
    "no memory, stack": {**GRID, "memory": "none", "frame_stack": 3, "step_encoding": True, "norm_adv": "batch"},
    "GRU, probe": {
        "env_id": "MysteryPath-Grid-v0", "obs_type": "vector", "ground_truth_coef": 0.1, "auxiliary_detach": True,
        "observe_last_action": True,
    },
    "GRU, no embedding, scaled rewards, evaluations": {
        **GRID, "embedding": False, "norm_reward": True, "eval_interval": 2, "eval_levels": 2
    },
    "GRU, Muon, truncated": {
        "env_id": "SearingSpotlights-v0", "obs_type": "vector", "env_options": '{"max_steps": 9}',
        "bootstrap_truncated": True, "optimizer": "muon",
    },
    "TrXL, endless": {"script": ppo_trxl, "env_id": "Endless-MysteryPath-v0", "obs_type": "vector"},
    "TrXL, learned": {
        "script": ppo_trxl, **ENDLESS, "trxl_positional_encoding": "learned", "trxl_query_position": True
    },
    "TrXL, relative": {
        "script": ppo_trxl, **ENDLESS, "trxl_positional_encoding": "relative", "trxl_segment_length": 5,
        "trxl_memory_gradient": True, "refresh_memory": True,
    },
    "TrXL, no encoding, post-norm": {
        "script": ppo_trxl, **ENDLESS, "trxl_positional_encoding": "none", "trxl_layer_norm": "post"
    },
    "GTrXL, Muon, pixels, evaluations": {
        "script": ppo_trxl, "env_id": "MortarMayhem-Grid-v0", "trxl_gate": "gru", "optimizer": "muon",
        "eval_interval": 1, "eval_levels": 1, "eval_max_steps": 20, **PIXELS,
    },
    "TrXL, both heads": {
        "script": ppo_trxl, "env_id": "SearingSpotlights-v0", "ground_truth_coef": 0.1, "reconstruction_coef": 0.1,
        "auxiliary_detach": True, **PIXELS,
    },
}  # fmt: skip


def stop_after(monkeypatch, script, iteration):
    """Have the training get SIGTERM in this iteration."""
    update, updates = script.update, []

    def updated(*given):
        updates.append(1)
        if len(updates) == iteration:
            os.kill(os.getpid(), signal.SIGTERM)
        return update(*given)

    monkeypatch.setattr(script, "update", updated)


def interrupted(monkeypatch, script, args, iteration):
    """Train until SIGTERM; return the run folder."""
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with monkeypatch.context() as patch:
        stop_after(patch, script, iteration)
        run = script.setup(args)
        runs.stop_on_signals(run)
        try:
            runs.run_to_end(args, run, script.train)
        finally:
            for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
                signal.signal(number, handler)
    assert run.received_signal == signal.SIGTERM
    assert run.step == iteration * args.num_envs * args.num_steps
    return run.folder


def resumed(script, folder, *flags):
    return script.main(parse_args(script, "--resume", str(folder), *flags))


def copied_after(monkeypatch, step):
    """Copy the folder of the next run when it has written the checkpoint of a step; return where the copy will be."""
    save, copy = runs.save_checkpoint, Path("runs/copy").absolute()

    def saved(args, run):
        save(args, run)
        if run.step == step:
            shutil.copytree(run.folder, copy)

    monkeypatch.setattr(runs, "save_checkpoint", saved)
    return copy


@pytest.mark.parametrize("name", RUNS)
def test_a_resumed_run_is_the_unstopped_one(tiny, curves, monkeypatch, name):
    changes = dict(RUNS[name])
    script = changes.pop("script", ppo_gru)
    batch = 4 * changes.get("num_steps", 16)
    few = {"total_timesteps": 4 * batch, "checkpoint_interval": 2, "num_levels": 50}
    args = tiny(script, **few, seed=3, **changes)
    folder = copied_after(monkeypatch, 2 * batch)
    whole = curves(script.main(args))
    assert {step for step, _ in curves(folder)["losses/loss"]} == {batch, 2 * batch}
    torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002
    assert resumed(script, folder) == folder
    assert curves(folder) == whole
    assert len(whole["losses/loss"]) == 4
    assert ("eval/return" in whole) == ("eval_interval" in changes)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_run_that_a_signal_stopped_goes_on(tiny, curves, monkeypatch, script):
    args = tiny(script, **GRID, total_timesteps=4 * 64)
    whole = curves(script.main(args))
    folder = interrupted(monkeypatch, script, args, 2)
    assert {step for step, _ in curves(folder)["losses/loss"]} == {64, 128}
    assert resumed(script, folder) == folder
    assert curves(folder) == whole


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_longer_training_goes_on_where_the_shorter_one_ended(tiny, curves, script):
    args = tiny(script, **GRID, anneal_steps=200)
    short = script.main(args)
    whole = curves(script.main(tiny(script, **GRID, anneal_steps=200, total_timesteps=256)))
    resumed(script, short, "--total-timesteps", "256")
    assert curves(short) == whole
    assert resumed(script, short) == short, "there is nothing left to do"
    assert curves(short) == whole


def test_a_run_goes_on_with_the_arguments_that_it_began_with(tiny, curves):
    """In Python, where some are None until the others are known, as on the command line."""
    args = tiny(env_id="MysteryPath-Grid-v0", obs_type="vector", anneal_steps=None)
    assert args.vector_frequencies is None
    folder = ppo_gru.main(dataclasses.replace(args))
    longer = dataclasses.replace(args, resume=str(folder), total_timesteps=192)
    assert ppo_gru.main(longer) == folder
    assert {step for step, _ in curves(folder)["losses/loss"]} == {64, 128, 192}
    with pytest.raises(ValueError, match=r"--vector-frequencies is 0, but the run in .* has 4"):
        ppo_gru.main(dataclasses.replace(longer, vector_frequencies=0))


@pytest.mark.parametrize("script", SCRIPTS)
def test_what_was_played_twice_is_logged_once(tiny, curves, monkeypatch, script):
    """A crash after the checkpoint: an iteration and its evaluation are done again."""
    few = {"eval_interval": 1, "eval_levels": 2, "eval_max_steps": 20}
    args = tiny(script, **GRID, total_timesteps=6 * 64, checkpoint_interval=2, **few)
    whole = curves(script.main(args))
    with monkeypatch.context() as patch:
        updates, update = [], script.update

        def crash(*given):
            updates.append(1)
            if len(updates) == 4:
                raise RuntimeError("crash")
            return update(*given)

        patch.setattr(script, "update", crash)
        run = script.setup(args)
        with pytest.raises(RuntimeError, match="crash"):
            runs.run_to_end(args, run, script.train)
    assert curves(run.folder)["losses/loss"] == whole["losses/loss"][:3]
    assert resumed(script, run.folder) == run.folder
    assert curves(run.folder) == whole
    steps, scores = read_run(str(run.folder)).curves["eval/return"]
    assert steps.tolist() == [64, 128, 192, 256, 320, 384]
    assert scores.shape == (6, 2, 3), "each level's"


def test_copies_of_a_checkpoint_are_left_alone(tiny):
    folder = ppo_gru.main(tiny(**GRID))
    for name in ("checkpoint-128-good.pt", "checkpoint-128 (copy).pt", "checkpoint-best.pt"):
        (folder / name).write_bytes((folder / "checkpoint-128.pt").read_bytes())
    resumed(ppo_gru, folder, "--total-timesteps", "512")
    assert read_checkpoint(folder)["step"] == 512
    assert len(list(folder.glob("checkpoint-128*"))) == 3


def test_a_run_that_is_being_trained(tiny, opened):
    args = tiny(**GRID, total_timesteps=256, checkpoint_interval=1)
    run = opened(ppo_gru, args)
    ppo_gru.train(tiny(**GRID, checkpoint_interval=1), run)
    with pytest.raises(OSError, match=r"--resume .*: another process is training this run"):
        ppo_gru.setup(parse_args(ppo_gru, "--resume", str(run.folder)))
    runs.close(run)
    assert resumed(ppo_gru, run.folder) == run.folder


def test_which_files_are_kept(tiny):
    folder = ppo_gru.main(tiny(**GRID, total_timesteps=5 * 64, checkpoint_interval=2))
    assert sorted(path.name for path in folder.glob("*.pt")) == ["checkpoint-256.pt", "checkpoint-320.pt"]
    assert read_model(folder / "checkpoint-256.pt")["step"] == 256
    folder = ppo_gru.main(tiny(**GRID, checkpoint_interval=0, exp_name="none"))
    assert not list(folder.glob("*.pt"))


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_checkpoint_is_a_model_too(tiny, opened, script):
    args = tiny(script, **GRID, num_levels=50, save_model=True)
    folder = script.main(args)
    model, checkpoint = folder / "model.pt", folder / "checkpoint-128.pt"
    scores = [
        evaluate.score_checkpoints(evaluate.Config(checkpoints=(str(path),), levels=2, repeats=1, cuda=False))
        for path in (model, checkpoint)
    ]
    assert scores[0][0]["agents"][0]["metrics"] == scores[1][0]["agents"][0]["metrics"]
    enjoy.main(enjoy.Config(checkpoint=str(checkpoint), out="page.html", max_steps=5))
    assert os.path.getsize("page.html") > 1000
    run = opened(script, tiny(script, **GRID, load_model=str(checkpoint), exp_name="again"))
    for name, weight in read_model(model)["weights"].items():
        assert run.agent.state_dict()[name].equal(weight)
    assert run.step == 0


def test_environments_of_other_packages_begin_new_episodes(tiny, opened, curves, monkeypatch, capfd):
    args = tiny(env_id="CartPole-v1", total_timesteps=5 * 64, norm_reward=True)
    folder = interrupted(monkeypatch, ppo_gru, args, 2)
    capfd.readouterr()
    run = opened(ppo_gru, parse_args(ppo_gru, "--resume", str(folder)))
    assert "CartPole-v1 has no state to save: every environment begins a new episode" in capfd.readouterr().err
    first = opened(ppo_gru, tiny(env_id="CartPole-v1", exp_name="first"))
    for name, part in run.carry.obs.items():
        assert not (part == first.carry.obs[name]).all(axis=1).any(), "not the episodes that it began with"
    assert not run.carry.memory["hidden"].any()
    scale = run.return_scale
    assert (scale.count, scale.discounted) == (128, None), "no reward of an earlier episode counts"
    runs.run_to_end(args, run, ppo_gru.train)
    assert [step for step, _ in curves(folder)["losses/loss"]] == [64, 128, 192, 256, 320]


@pytest.mark.parametrize("when", ["made", "stepped"])
def test_an_environment_that_changes_the_folder(tiny, tmp_path, monkeypatch, capsys, when):
    """A run, one that goes on, and one with loaded weights, all named from where they were started."""

    class Away(type(gym.make("CueRecall-v0").unwrapped)):
        def __init__(self):
            super().__init__()
            if when == "made":
                os.chdir("/")

        def step(self, action):
            os.chdir("/")
            return super().step(action)

    env_id = f"Away{len(gym.registry)}-v0"
    gym.register(env_id, Away)
    args = tiny(env_id=env_id, checkpoint_interval=1, save_model=True)
    (folder,) = {ppo_gru.main(args)}
    assert folder.parent == tmp_path / "runs"
    assert {"model.pt", "checkpoint-64.pt", "checkpoint-128.pt"} < {*os.listdir(folder)}
    assert f"evaluate: python {ROOT}/evaluate.py runs/{folder.name}/model.pt" in capsys.readouterr().out
    for flags in (
        {"resume": f"runs/{folder.name}", "total_timesteps": 192},
        {"load_model": f"runs/{folder.name}/model.pt"},
    ):
        monkeypatch.chdir(tmp_path)
        assert ppo_gru.main(dataclasses.replace(args, **flags)).parent == tmp_path / "runs"
    assert (folder / "checkpoint-192.pt").is_file()
    assert len(os.listdir(tmp_path / "runs")) == 2


@pytest.mark.parametrize("draw", [np.random.rand, random.random])
def test_episodes_drawn_from_a_global_generator_are_not_repeated(tiny, opened, monkeypatch, draw):
    class Drawn(type(gym.make("CueRecall-v0").unwrapped)):
        def reset(self, *, seed=None, options=None):
            _, info = super().reset(seed=seed, options=options)
            return np.full(3, draw(), np.float32), info

    env_id = f"Drawn{len(gym.registry)}-v0"
    gym.register(env_id, Drawn)
    args = tiny(env_id=env_id, total_timesteps=3 * 64)
    first = opened(ppo_gru, args).carry.obs["observation"]
    folder = interrupted(monkeypatch, ppo_gru, args, 1)
    run = opened(ppo_gru, parse_args(ppo_gru, "--resume", str(folder)))
    assert not (run.carry.obs["observation"] == first).any()


def test_what_else_a_run_goes_on_with(tiny, opened):
    """NumPy's and Python's generators, the seconds, and the last returns and lengths of the progress bar."""
    args = tiny(env_id="CartPole-v1", total_timesteps=256)
    run = opened(ppo_gru, args)
    ppo_gru.train(tiny(env_id="CartPole-v1", checkpoint_interval=0), run)
    np.random.seed(5)  # noqa: NPY002
    random.seed(6)
    checkpoints.save_checkpoint(args, run)
    wanted = np.random.rand(), random.random(), torch.rand(1).item()  # noqa: NPY002
    runs.close(run)
    again = opened(ppo_gru, parse_args(ppo_gru, "--resume", str(run.folder)))
    assert (np.random.rand(), random.random(), torch.rand(1).item()) == wanted  # noqa: NPY002
    assert (again.step, again.seconds) == (run.step, run.seconds)
    assert again.bar.n == run.step
    assert run.seconds > 0
    assert (list(again.returns), list(again.lengths)) == (list(run.returns), list(run.lengths))
    assert run.returns


def test_curves_are_there_before_their_checkpoint(tiny, scalars, monkeypatch):
    """A kill right after a checkpoint leaves no gap: the run goes on after what was logged."""
    seen, write, record = [], checkpoints.write_file, RecordWriter.write
    slow = lambda writer, data: (time.sleep(0.02), record(writer, data))  # noqa: E731 (as a disk that is busy)
    monkeypatch.setattr(RecordWriter, "write", slow)

    def write_file(saved, path):
        seen.append((saved["step"], len(scalars(path.parent).get("charts/SPS", ()))))  # the last that is logged
        write(saved, path)

    monkeypatch.setattr(checkpoints, "write_file", write_file)
    ppo_gru.main(tiny(**GRID, checkpoint_interval=1))
    assert seen == [(64, 1), (128, 2)]


def test_files_of_a_process_that_was_killed_while_it_wrote(trained):
    """They go when the run goes on, and are no checkpoint."""
    leftover = trained / "checkpoint-150.pt.part"  # of a step whose file is not written again
    leftover.write_bytes(b"half of a file")
    assert resumed(ppo_gru, trained, "--total-timesteps", "192") == trained
    assert not leftover.exists()
    assert read_checkpoint(trained)["step"] == 192


def test_a_checkpoint_holds_what_the_next_rollout_begins_with(tiny):
    """Of the transformer's timeline the window, not the rollout; of the GRU's hidden states the last."""
    changes = {"num_steps": 64, "total_timesteps": 256}
    folder = ppo_trxl.main(tiny(ppo_trxl, **GRID, **changes))
    memory = read_checkpoint(folder)["processes"][0]["carry"]["memory"]
    assert {name: tuple(part.shape) for name, part in memory.items()} == {
        "hidden": (7, 4, 2, 32), "row_step": (7, 4), "episode_step": (4,)
    }  # fmt: skip
    folder = ppo_gru.main(tiny(**GRID, **changes))
    (hidden,) = read_checkpoint(folder)["processes"][0]["carry"]["memory"].values()
    assert hidden.shape == (4, 1, 32)


def test_videos_go_on(tiny, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    short = {"env_options": '{"command_count": [1]}', "total_timesteps": 4 * 64}
    args = tiny(**GRID, **short, capture_video=True)
    whole = ppo_gru.main(args)
    folder = interrupted(monkeypatch, ppo_gru, args, 2)
    resumed(ppo_gru, folder)
    names = [sorted(path.name for path in each.glob("videos*/*.mp4")) for each in (whole, folder)]
    assert names[0] == names[1]
    assert len(names[0]) > 2
    assert list(folder.glob("videos-128/*.mp4")), "what is there already is never written over"


def test_a_second_interrupt_ends_the_training_at_once(tiny, opened, monkeypatch):
    run = opened(ppo_gru, tiny(**GRID))
    handlers = {}
    monkeypatch.setattr(runs.signal, "signal", handlers.__setitem__)
    runs.stop_on_signals(run)
    handlers[signal.SIGTERM](signal.SIGTERM, None)
    handlers[signal.SIGTERM](signal.SIGTERM, None)  # whoever sends it twice does not mean more by it
    assert run.received_signal == signal.SIGTERM
    with pytest.raises(KeyboardInterrupt):
        handlers[signal.SIGINT](signal.SIGINT, None)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_to_the_command(curves, tmp_path, number):
    """As a cluster sends it at a time limit: checkpoint and model are written, and the curve goes on."""
    flags = [*FEW, "--num-steps", "32", "--total-timesteps", "640000", "--save-model"]
    with Program(command(ppo_gru.__file__, *flags), tmp_path) as program:
        program.wait_until(lambda: "SPS=" in program.said() or not program.is_running())
        os.kill(program.pid, number)
        done = program.wait()
    assert done.returncode == 128 + number, done.stderr
    assert "Traceback" not in done.stderr
    (folder,) = tmp_path.glob("runs/*")
    step = curves(folder)["losses/loss"][-1][0]
    assert read_model(folder / "model.pt")["step"] == read_checkpoint(folder)["step"] == step < 640_000


CONTRADICTIONS = {
    "--env-id MysteryPath-v0": "--env-id is MysteryPath-v0, but the run in .* has MortarMayhemB-Grid-v0",
    "--hidden-size 64": "--hidden-size is 64, but the run in .* has 32; leave the flag out, or begin another run",
    "--seed 7": "--seed is 7, but the run in .* has 1",
    "--preset laptop": "--preset is laptop, but the run in .* has thesis",
    "--total-timesteps 64": "--total-timesteps is 64, but the run in .* has 128; it may be extended only",
}


@pytest.fixture(scope="session")
def trained_once(tiny, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("trained"))
        return ppo_gru.main(tiny(**GRID, checkpoint_interval=1)).absolute()


@pytest.fixture(scope="session")
def transformer_once(tiny, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("transformer"))
        return ppo_trxl.main(tiny(ppo_trxl, **GRID)).absolute()


@pytest.fixture
def trained(trained_once, tmp_path):
    """The folder of a run of two iterations, with the checkpoints of both, for this test alone."""
    return shutil.copytree(trained_once, tmp_path / "runs" / trained_once.name)


def fault(folder, *flags):
    """Resume by command; return the one line that it ends in, having changed nothing."""
    before = {path.name: path.read_bytes() for path in folder.iterdir()} if folder.is_dir() else None
    done = run_command(ppo_gru.__file__, "--resume", folder, *flags)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    if before is not None:
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    return line


@pytest.mark.parametrize("flags", CONTRADICTIONS)
def test_flags_that_contradict_the_run(trained, flags):
    with pytest.raises(ValueError, match=CONTRADICTIONS[flags]):
        resumed(ppo_gru, trained, *flags.split())


def test_flags_that_repeat_the_run_s_are_no_contradiction(trained):
    assert resumed(ppo_gru, trained, "--hidden-size", "32", "--env-id", "MortarMayhemB-Grid-v0") == trained


def test_another_script_s_run(trained):
    with pytest.raises(ValueError, match=r"this run is ppo_gru\.py's, not ppo_trxl\.py's"):
        ppo_trxl.setup(parse_args(ppo_trxl, "--resume", str(trained), "--num-minibatches", "1000"))


def test_a_checkpoint_that_is_cut_short(trained, tmp_path):
    last = trained / "checkpoint-128.pt"
    content = last.read_bytes()
    last.write_bytes(content[: len(content) // 2])
    line = fault(trained)
    assert re.fullmatch(
        r"ppo_gru\.py: .*checkpoint-128\.pt is cut short, or neither a model nor a checkpoint; "
        r"remove it to go on from .*checkpoint-64\.pt",
        line,
    )
    last.unlink()
    assert resumed(ppo_gru, trained) == trained
    assert last.read_bytes() != content[: len(content) // 2]


def test_a_folder_without_a_checkpoint(tmp_path):
    with pytest.raises(OSError, match=r"--resume nowhere: there is no such folder; give a run's, runs/RUN"):
        parse_args(ppo_gru, "--resume", "nowhere")
    with pytest.raises(OSError, match=rf"--resume {tmp_path}: there is no checkpoint-STEP\.pt in this folder"):
        parse_args(ppo_gru, "--resume", str(tmp_path))
    with pytest.raises(OSError, match=rf"^{tmp_path} is a folder; give a file in it, as {tmp_path}/model\.pt"):
        read_model(tmp_path)


def test_a_folder_that_cannot_be_written(trained, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: not (path == trained and mode == os.W_OK))
    with pytest.raises(OSError, match=f"--resume {trained}: this folder cannot be written"):
        resumed(ppo_gru, trained)


@pytest.mark.parametrize("missing", ["carry", "rates", "hidden states", "return_scale", "optimizers", "optimizer"])
def test_a_checkpoint_of_another_version(transformer_once, tmp_path, missing):
    folder = shutil.copytree(transformer_once, tmp_path / "runs" / transformer_once.name)
    path = folder / "checkpoint-128.pt"
    saved = read_model(path)
    if missing == "carry":  # before, its parts were beside the environments
        saved["processes"][0] |= saved["processes"][0].pop("carry")
    elif missing == "rates":  # before, an optimizer did not say in what relation to others
        del saved["optimizers"][0]["param_groups"][0]["lr_ratio"]
    elif missing == "hidden states":  # before, the last block's output was stored always
        memory = saved["processes"][0]["carry"]["memory"]
        memory["hidden"] = torch.cat([memory["hidden"], memory["hidden"][:, :, -1:]], 2)
    elif missing == "return_scale":
        del saved["processes"][0]["return_scale"]
    elif missing == "optimizers":
        (saved["optimizer"],) = saved.pop("optimizers")
    else:
        saved["optimizers"] = []
    torch.save(saved, path)
    before = sorted(folder.iterdir())
    with pytest.raises(ValueError, match=r"is of another version, .*; --load-model takes its weights"):
        resumed(ppo_trxl, folder, "--total-timesteps", "256")
    assert sorted(folder.iterdir()) == before


def test_flags_that_no_longer_exist(trained, capfd):
    path = trained / "checkpoint-128.pt"
    saved = read_model(path)
    torch.save({**saved, "args": saved["args"] | {"eval_repeats": 5}}, path)
    assert resumed(ppo_gru, trained) == trained
    assert f"--resume {trained}: it goes on without --eval-repeats, which no longer exist" in capfd.readouterr().err


def test_a_flag_that_is_newer_than_the_run(trained):
    """The run has its default, with which it goes on, and no other value."""
    path = trained / "checkpoint-128.pt"
    saved = read_model(path)
    torch.save({**saved, "args": {name: value for name, value in saved["args"].items() if name != "clip_vloss"}}, path)
    with pytest.raises(ValueError, match=r"--clip-vloss is False, but the run in .* has True; leave the flag out"):
        resumed(ppo_gru, trained, "--no-clip-vloss")
    assert resumed(ppo_gru, trained) == trained


def test_a_run_that_another_process_has_gone_on_with(trained, monkeypatch):
    """Between reading the checkpoint and locking the folder."""
    monkeypatch.setattr(runs, "read_checkpoint", lambda _: read_model(trained / "checkpoint-64.pt"))
    with pytest.raises(OSError, match=r"another process has just gone on with this run; start again"):
        ppo_gru.setup(parse_args(ppo_gru, "--resume", str(trained)))


def test_tracking_waits_for_the_lock(tiny, opened, monkeypatch):
    started = []
    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=lambda **given: started.append(given["id"])))
    args = tiny(**GRID, total_timesteps=256, checkpoint_interval=1, track=True)
    run = opened(ppo_gru, args)
    ppo_gru.train(dataclasses.replace(args, total_timesteps=64), run)
    with pytest.raises(OSError, match=r"--resume .*: another process is training this run"):
        ppo_gru.setup(parse_args(ppo_gru, "--resume", str(run.folder)))
    assert started == [run.folder.name]


def test_weights_alone_are_no_checkpoint(trained):
    torch.save(read_model(trained / "checkpoint-128.pt") | {"processes": None}, trained / "checkpoint-128.pt")
    saved = read_model(trained / "checkpoint-128.pt")
    del saved["processes"]
    torch.save(saved, trained / "checkpoint-128.pt")
    with pytest.raises(ValueError, match="its last checkpoint holds weights alone; --load-model takes these"):
        resumed(ppo_gru, trained)


def test_a_checkpoint_whose_arguments_were_changed(trained):
    """Another network, and other environments, than the rest of the file is of."""
    path = trained / "checkpoint-128.pt"
    saved = read_model(path)
    torch.save({**saved, "args": saved["args"] | {"hidden_size": 64}}, path)
    with pytest.raises(ValueError, match="holds the weights of another network"):
        resumed(ppo_gru, trained)
    torch.save({**saved, "args": saved["args"] | {"num_levels": 7}}, path)
    with pytest.raises(ValueError, match="the saved state is of environments with num_levels 100000, not 7"):
        resumed(ppo_gru, trained)


class Malicious:
    def __reduce__(self):
        return os.system, ("touch owned",)


@pytest.mark.parametrize("package", [pickle, torch])
def test_a_malicious_pickle_runs_nothing(trained, package):
    with (trained / "checkpoint-192.pt").open("wb") as file:
        saved = {"script": "ppo_gru", "args": {}, "weights": {}, "processes": [Malicious()]}
        pickle.dump(saved, file, protocol=2) if package is pickle else torch.save(saved, file)
    assert "checkpoint-192.pt is cut short, or neither a model nor a checkpoint; remove it" in fault(trained)
    assert not os.path.exists("owned")


def limited(size, *flags):
    """Train by command, with no file larger than size; return the line that it ends in."""

    def train():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        command(ppo_gru.__file__, *flags)()

    with Program(train) as program:
        done = program.wait()
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    return done.stderr.strip().splitlines()[-1]


FEW = "--hidden-size 8 --trunk-size 8 --num-envs 2 --num-steps 8 --num-minibatches 2 --no-cuda --obs-type vector"
FEW = ["--env-id", "MortarMayhemB-Grid-v0", *FEW.split()]


def test_no_room_for_curves():
    line = limited(20_000, *FEW, "--total-timesteps", "9600", "--checkpoint-interval", "0")
    said = r"ppo_gru\.py: iteration \d+: cannot write to runs/\S+ \(File too large\); there is no checkpoint yet"
    assert re.fullmatch(said, line), line


def test_no_room_for_an_evaluation(tiny, monkeypatch):
    """A defect of the disk that TensorBoard's thread found before is raised by whatever is logged next."""
    args = tiny(env_id="CueRecall-v0", eval_interval=1, eval_levels=2, save_model=True)
    run = ppo_gru.setup(args)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(run.writer, "add_tensor", full)
    message = r"iteration 1: cannot write to .* \(No space left on device\); there is no checkpoint yet"
    with pytest.raises(RunError, match=message):
        runs.run_to_end(args, run, ppo_gru.train)
    assert not (run.folder / "model.pt").exists()


def test_a_disk_that_became_read_only(tiny, monkeypatch):
    args = tiny(env_id="CueRecall-v0")
    run = ppo_gru.setup(args)

    def read_only(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    for name in ("open", "unlink"):
        monkeypatch.setattr(Path, name, read_only)
    with pytest.raises(RunError, match=r"iteration 2: cannot write to .*Read-only file system"):
        runs.run_to_end(args, run, ppo_gru.train)


def test_no_room_for_a_checkpoint(curves):
    """The one before stays whole, and the run goes on from it when there is room again."""
    interval = ["--checkpoint-interval", "2"]
    folder = ppo_gru.main(parse_args(ppo_gru, *FEW, *interval, "--total-timesteps", "32"))
    kept = (folder / "checkpoint-32.pt").read_bytes()
    line = limited(len(kept) // 2, "--resume", str(folder), "--total-timesteps", "96")
    said = (
        rf"ppo_gru\.py: iteration 4: cannot write to runs/{folder.name}/checkpoint-64\.pt \(File too large\); "
        rf"the last checkpoint is runs/{folder.name}/checkpoint-32\.pt"
    )
    assert re.fullmatch(said, line), line
    assert [path.name for path in folder.glob("checkpoint*")] == ["checkpoint-32.pt"]
    assert (folder / "checkpoint-32.pt").read_bytes() == kept
    time.sleep(1)  # TensorBoard sorts files by the second at which they begin, then by process: of one second, wrongly
    resumed(ppo_gru, folder, "--total-timesteps", "96")
    assert curves(folder) == curves(ppo_gru.main(parse_args(ppo_gru, *FEW, "--total-timesteps", "96")))


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_gradient_that_is_no_number(tiny, monkeypatch, script):
    """Training stops with its iteration, and no file of spoilt weights is written."""
    args = tiny(script, **GRID, total_timesteps=5 * 64, checkpoint_interval=1, save_model=True)
    run = script.setup(args)
    count, ppo_loss = itertools.count(1), script.ppo_loss

    def spoilt(*given):
        loss, log = ppo_loss(*given)
        return (loss * float("nan"), log) if next(count) == 12 else (loss, log)  # the last one of iteration 3

    monkeypatch.setattr(script, "ppo_loss", spoilt)
    said = r"iteration 3: the loss or its gradient is not finite; .*; the last checkpoint is \S+checkpoint-128\.pt"
    with pytest.raises(FloatingPointError, match=said):
        runs.run_to_end(args, run, script.train)
    assert sorted(path.name for path in run.folder.glob("*.pt")) == ["checkpoint-128.pt", "checkpoint-64.pt"]


def test_weights_that_are_no_numbers_are_not_written(tiny, opened, tmp_path):
    run = opened(ppo_gru, tiny(**GRID))
    next(run.agent.parameters()).data[0] = float("inf")
    with pytest.raises(FloatingPointError, match=r"file\.pt is not written, since weights are not finite; try a lower"):
        write_file(model_of(tiny(**GRID), run), tmp_path / "file.pt")
    assert not list(tmp_path.glob("file*"))
