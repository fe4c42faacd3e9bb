"""A short training of each kind, through `main` and through the command line."""

import dataclasses
import glob
import math
import os
import random
import re
import subprocess
import sys
import time
import traceback
import types
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import SCRIPTS, parse_args
from programs import Program, run_command
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import ppo_gru
import ppo_trxl
from ppo_utils import logs, runs
from ppo_utils.checkpoints import read_model, saved_args
from ppo_utils.flags import check_args, flag

ROOT = Path(__file__).parents[1]
MEMORIES = [
    *({"memory": memory} for memory in ("gru", "lstm", "none")),
    {"script": ppo_trxl},
    {"script": ppo_trxl, "trxl_positional_encoding": "relative", "trxl_gate": "gru", "trxl_gate_bias": 2.0},
    {"script": ppo_trxl, "trxl_positional_encoding": "learned", "trxl_query_position": True},
]
CURVES = {
    "charts/SPS", "charts/seconds_iteration", "charts/seconds_collect", "charts/seconds_update",
    "charts/learning_rate", "charts/entropy_coefficient", "charts/gradient_steps",
    "losses/policy_loss", "losses/value_loss", "losses/entropy", "losses/log_barrier", "losses/loss",
    "losses/approx_kl", "losses/old_approx_kl", "losses/clipfrac", "losses/explained_variance", "losses/grad_norm",
    "losses/ratio_error",
}  # fmt: skip
EPISODES = {"charts/episodic_return", "charts/episodic_length"}


class Image(gym.Env):
    """Channels other than three, float pixels beside a vector, and a Discrete action space that starts at 1.

    What its infos call ground truth is no number, and nobody asks for it.
    """

    observation_space = gym.spaces.Dict(
        frame=gym.spaces.Box(0.0, 1.0, (40, 36, 2), np.float32),
        speed=gym.spaces.Box(-1.0, 1.0, (3,), np.float64),
        state=gym.spaces.Box(0, 255, (2,), np.uint8),
    )
    action_space = gym.spaces.Discrete(3, start=1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        assert action in self.action_space
        self.t += 1
        info = {"solved": np.bool_(self.t == 5), "ground_truth": "left"}
        return self.observation_space.sample(), float(action), False, self.t == 5, info


gym.register("Image-v0", entry_point=Image)


class GlobalGenerators(gym.Env):
    """Draws from NumPy's and Python's own generators, as older environments do."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.random.rand(1).astype(np.float32), {}  # noqa: NPY002

    def step(self, action):
        return np.random.rand(1).astype(np.float32), 0.0, random.random() < 0.2, False, {}  # noqa: NPY002


gym.register("GlobalGenerators-v0", entry_point=GlobalGenerators)


class Faulty(gym.Env):
    """Works for 20 steps."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (3,))
    action_space = gym.spaces.Discrete(2)
    t = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        self.t += 1
        if self.t == 20:
            raise ValueError("out of order")
        return self.observation_space.sample(), 0.0, False, False, {}


gym.register("Faulty-v0", entry_point=Faulty)


OTHER_ENVS = ["MortarMayhem-Grid-v0", "MortarMayhemB-v0", "Image-v0"]  # vectors with each memory, others with two
PAIRS = [*(("CartPole-v1", memory) for memory in MEMORIES), *zip(2 * OTHER_ENVS, MEMORIES, strict=True)]


@pytest.mark.parametrize(("env_id", "memory"), PAIRS)
def test_trains(tiny, scalars, env_id, memory):
    script = memory.get("script", ppo_gru)
    curves = scalars(script.main(tiny(env_id=env_id, num_steps=32, total_timesteps=256, **memory)))
    assert curves.keys() >= CURVES
    assert all(math.isfinite(value) for name in CURVES for value in curves[name])
    assert all(error < 1e-5 for error in curves["losses/ratio_error"])
    if env_id != "MortarMayhem-Grid-v0":
        assert curves.keys() >= EPISODES
    if env_id == "Image-v0":
        assert set(curves["episode/solved"]) == {1.0}


def test_numbers_that_slow_a_cpu_down_are_zero(tiny):
    """Also in a thread that is started later."""

    def products():
        return torch.tensor([1e-38]) * 0.1

    torch.set_flush_denormal(False)
    assert products().any()
    ppo_gru.main(tiny())
    with ThreadPoolExecutor(1) as pool:
        assert not products().any()
        assert not pool.submit(products).result().any()


@pytest.mark.parametrize(
    ("changes", "variable", "threads"),
    [
        ({"env_id": "MysteryPath-Grid-v0", "obs_type": "vector"}, None, 1),
        ({"env_id": "MysteryPath-Grid-v0", "obs_type": "vector"}, "2", 2),
        ({"env_id": "MysteryPath-Grid-v0"}, None, 2),
        ({"env_id": "MortarMayhemB-Grid-v0", "obs_type": "vector", "attend_commands": True}, None, 1),
        ({"env_id": "CartPole-v1"}, None, 1),
        ({"env_id": "Image-v0", "obs_type": "vector"}, None, 2),
    ],
)
def test_threads_of_a_training(tiny, monkeypatch, changes, variable, threads):
    """One without images, unless told otherwise; afterwards as many as before."""
    monkeypatch.delenv("OMP_NUM_THREADS")
    if variable:
        monkeypatch.setenv("OMP_NUM_THREADS", variable)

    def count():
        torch.set_num_threads(2)
        run = ppo_gru.setup(tiny(**changes))
        print(torch.get_num_threads())
        runs.close(run)
        print(torch.get_num_threads())

    with Program(count) as program:  # what was forked after two threads have computed would wait for them
        assert program.wait().stdout == f"{threads}\n2\n"


def test_trains_on_vectors_and_their_frequencies(tiny, scalars):
    """The network takes the Fourier features, and a model that is older than the flag is one without them."""
    vectors = {"env_id": "MysteryPath-Grid-v0", "obs_type": "vector", "save_model": True}
    folder = ppo_gru.main(tiny(**vectors))
    assert all(error < 1e-5 for error in scalars(folder)["losses/ratio_error"])
    path = os.path.join(folder, "model.pt")
    saved = torch.load(path, weights_only=True)
    assert saved["weights"]["encoder.mlp.weight"].shape[1] == 16 * 9
    del saved["args"]["vector_frequencies"]
    torch.save(saved, path)
    assert saved_args(ppo_gru.Args, read_model(path)).vector_frequencies == 0


@pytest.mark.parametrize(
    ("changes", "frequencies"),
    [
        ({"env_id": "MysteryPath-v0"}, 4),
        ({"env_id": "memory_gym_envs/MysteryPath-Grid-v0"}, 4),
        ({"env_id": "memory_gym_envs:MysteryPath-v0"}, 4),
        ({"env_id": "another/MysteryPath-v0"}, 0),
        ({"env_id": "Endless-MysteryPath-v0", "vector_frequencies": 0}, 0),
        ({"env_id": "MysteryPath-v0", "obs_type": "pixels"}, 0),
        ({"env_id": "MortarMayhem-v0"}, 0),
        ({"env_id": "MortarMayhem-v0", "vector_frequencies": 2}, 2),
    ],
)
def test_frequencies_are_mystery_path_s_unless_asked_for(changes, frequencies):
    args = ppo_gru.Args(**{"obs_type": "vector", **changes})
    check_args(args)
    assert args.vector_frequencies == frequencies


def test_a_newer_flag_keeps_its_value():
    """A former default is for files that are older than the flag."""
    saved = {"args": {"value_init_gain": 0.25}}
    assert saved_args(ppo_trxl.Args, saved).value_init_gain == 0.25
    assert saved_args(ppo_trxl.Args, {"args": {}}).value_init_gain == 1.0


def test_flags_that_were_renamed(tiny):
    """An older file has them by their former names."""
    args = {"head_size": 7, "seed": 3, "no_longer": 1}
    torch.save({"script": "ppo_gru", "args": args, "weights": {}}, "model.pt")
    expected = ppo_gru.Args(trunk_size=7, seed=3, value_init_gain=1.0, vector_frequencies=0)
    assert saved_args(ppo_gru.Args, read_model("model.pt")) == expected


def test_weights_that_were_renamed(tiny):
    args = tiny(ppo_trxl, env_id="CueRecall-v0", total_timesteps=64, save_model=True, trxl_gate="gru")
    path = ppo_trxl.main(args) / "model.pt"
    saved = torch.load(path, weights_only=True)
    written = names = list(saved["weights"])
    for now, before in (
        (".norm_memory.", ".norm_items."),
        (".norm_projection.", ".norm_output."),
        (".merge_projection.", ".merge_output."),
    ):
        assert any(now in name for name in names)
        names = [name.replace(now, before) for name in names]
    torch.save(saved | {"weights": dict(zip(names, saved["weights"].values(), strict=True))}, path)
    assert list(read_model(path)["weights"]) == written


def test_logs_every_number_of_the_final_info(tiny, scalars):
    options = '{"command_count": [2], "explosion_delay": [3], "explosion_duration": [1]}'
    curves = scalars(ppo_gru.main(tiny(env_id="MortarMayhemB-Grid-v0", env_options=options)))
    numbers = {"episode/reward", "episode/length", "episode/carried_out"}
    assert {name for name in curves if name.startswith("episode/")} == numbers
    assert curves["episode/reward"] == curves["charts/episodic_return"]
    assert curves["episode/length"] == curves["charts/episodic_length"]
    assert 4 <= min(curves["episode/length"]) <= max(curves["episode/length"]) <= 8, "the options are in force"


def test_no_finished_episode_yet(tiny, scalars):
    curves = scalars(ppo_gru.main(tiny(num_steps=8, total_timesteps=32)))
    assert curves.keys() >= CURVES
    assert not EPISODES & curves.keys()


def test_episodes_are_counted_across_rollouts(played):
    # Six episodes of 12 to 14 steps each in 5 x 16 steps; their lengths must not restart with the rollout.
    *_, episodes = played(iterations=5, env_id="CueRecall-v0")
    assert episodes["charts/episodic_length"]
    assert all(12 <= length <= 14 for length in episodes["charts/episodic_length"])
    assert episodes["charts/episodic_return"] == episodes["episode/right"]


@pytest.mark.parametrize(
    ("script", "env_id"),
    [*((script, "MortarMayhemB-Grid-v0") for script in SCRIPTS), (ppo_gru, "GlobalGenerators-v0")],
)
def test_same_seed_same_curves(tiny, curves, script, env_id):
    """Of pixels too: tests/test_resume.py goes on from them."""
    first, second, other = (
        curves(script.main(tiny(script, env_id=env_id, obs_type="vector", exp_name=name, seed=seed)))
        for name, seed in (("a", 1), ("b", 1), ("c", 2))
    )
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)
    assert first["losses/policy_loss"] != other["losses/policy_loss"]


def test_an_environment_that_fails(tiny):
    """What the user sees is its own traceback, and in the last line which environment it is; checkpoints stay."""
    with pytest.raises(RuntimeError, match=r"environment 0 raised ValueError in step 20 since .* seed \d+: ") as error:
        ppo_gru.main(tiny(env_id="Faulty-v0", checkpoint_interval=1))
    assert 'raise ValueError("out of order")' in "".join(traceback.format_exception(error.value))
    assert glob.glob("runs/*/checkpoint-64.pt")


def test_lanes_differ_and_neighbouring_seeds_share_none(tiny, opened):
    first = [opened(ppo_gru, tiny(env_id="MortarMayhem-v0", seed=seed, exp_name=str(seed))) for seed in (1, 2)]
    seeds = [set(run.envs.np_random_seed) for run in first]
    assert len(seeds[0]) == len(seeds[1]) == 4
    assert not seeds[0] & seeds[1]


def test_trains_on_the_levels_asked_for_from_the_first_episode_on(played):
    changes = {"env_id": "MortarMayhemB-Grid-v0", "num_levels": 3, "start_level": 10}
    seen = set(played(num_steps=1, num_minibatches=1, **changes)[1].envs.np_random_seed)
    _, run, *_ = played(**changes)
    assert run.rollout.done.any()
    assert seen | set(run.envs.np_random_seed) <= {10, 11, 12}


def test_runs_that_begin_in_the_same_second_keep_apart(tiny, monkeypatch):
    monkeypatch.setattr(runs.time, "time", lambda: 7.0)
    folders = [ppo_gru.main(tiny(env_id="CueRecall-v0")) for _ in range(3)]
    assert [folder.name.rpartition("__")[2] for folder in folders] == ["7", "7-2", "7-3"]


def test_hyperparameters_are_written_down(tiny):
    folder = ppo_gru.main(tiny(env_id="CueRecall-v0", gamma=0.123))
    events = EventAccumulator(str(folder))
    events.Reload()
    (text,) = events.Tensors("hyperparameters/text_summary")
    assert b"|gamma|0.123|" in text.tensor_proto.string_val[0]


def test_tracking(tiny, monkeypatch):
    started = {}
    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=lambda **given: started.update(given)))
    folder = ppo_gru.main(tiny(env_id="CueRecall-v0", track=True))
    assert started["sync_tensorboard"]
    assert started["name"] == started["id"] == os.path.basename(folder)
    assert started["resume"] == "allow", "a resumed run goes on with the same one"
    assert started["reinit"] == "finish_previous", "a second training in this process has a run of its own"
    assert started["config"]["env_id"] == "CueRecall-v0"


def test_interrupting_keeps_what_was_learned(tiny, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(ppo_gru, "collect", interrupted)
    with pytest.raises(KeyboardInterrupt):  # a loop over seeds is not to go on
        ppo_gru.main(tiny(env_id="CueRecall-v0", save_model=True))
    assert glob.glob("runs/*/model.pt")


def test_steps_are_counted_without_a_progress_bar(tiny, curves, monkeypatch):
    """As with TQDM_DISABLE=1, which tqdm reads when it is imported."""
    monkeypatch.setattr(logs, "tqdm", partial(logs.tqdm, disable=True))
    logged = curves(ppo_gru.main(tiny(env_id="CartPole-v1")))
    assert [step for step, _ in logged["losses/loss"]] == [64, 128]


def test_bfloat16_is_used_and_changes_little(tiny, scalars):
    """A change of precision moves the curves, but not by much."""
    changes = {"env_id": "MortarMayhem-Grid-v0", "num_steps": 8, "total_timesteps": 32}
    for script in SCRIPTS:
        exact, rough = (
            scalars(script.main(tiny(script, exp_name=str(amp), amp=amp, **changes))) for amp in (False, True)
        )
        assert exact["losses/value_loss"] != rough["losses/value_loss"]
        assert rough["losses/value_loss"] == pytest.approx(exact["losses/value_loss"], rel=0.2)


def test_deterministic_algorithms_are_asked_for(tiny, opened, monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "deterministic", False)
    opened(ppo_gru, tiny(env_id="CueRecall-v0"))
    assert torch.backends.cudnn.deterministic


def test_seconds_of_an_iteration_are_those_of_its_parts(tiny, scalars):
    found = scalars(ppo_gru.main(tiny(env_id="CueRecall-v0")))
    parts = np.add(found["charts/seconds_collect"], found["charts/seconds_update"])
    assert parts == pytest.approx(found["charts/seconds_iteration"], rel=1e-4)
    assert found["charts/SPS"] == pytest.approx(np.array([64, 128]) / np.cumsum(parts), rel=1e-4), "since it began"


@pytest.mark.parametrize("script", SCRIPTS)
def test_an_update_takes_until_its_numbers_are_read(tiny, scalars, monkeypatch, script):
    """As on a GPU, where reading them waits for the work that was queued."""
    mean_logs = script.mean_logs
    monkeypatch.setattr(script, "mean_logs", lambda *args: time.sleep(0.5) or mean_logs(*args))
    assert min(scalars(script.main(tiny(script, env_id="CueRecall-v0")))["charts/seconds_update"]) >= 0.5


@pytest.mark.parametrize("script", SCRIPTS)
def test_arguments_stay_as_they_were(tiny, script):
    """What is None is filled in for one training, not for the next one of a longer sweep."""
    args = tiny(script, env_id="CueRecall-v0", anneal_steps=None)
    before = dataclasses.replace(args)
    script.main(args)
    assert args == before


class Product(gym.Env):
    """An environment that computes with torch: its reward is a product of matrices."""

    observation_space, action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(2)
    factor = torch.full((1, 3), 1.001)
    reward = float(factor @ factor.T)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), float(self.factor @ self.factor.T), True, False, {}


@pytest.mark.parametrize("script", SCRIPTS)
def test_precision_of_agents_is_not_that_of_environments(tiny, scalars, script):
    gym.register("Product-v0", entry_point=Product)
    found = scalars(script.main(tiny(script, env_id="Product-v0", amp=True, eval_interval=1, eval_levels=1)))
    del gym.registry["Product-v0"]
    assert {*found["charts/episodic_return"]} | {*found["eval/return"]} == {np.float32(Product.reward)}


def test_annealing(tiny, scalars):
    rates = {"init_lr": 1e-3, "final_lr": 1e-4, "init_ent_coef": 0.1, "final_ent_coef": 0.01}
    down = scalars(ppo_gru.main(tiny(env_id="CueRecall-v0", total_timesteps=256, anneal_steps=128, **rates)))
    assert down["charts/learning_rate"] == pytest.approx([1e-3, 5.5e-4, 1e-4, 1e-4])
    assert down["charts/entropy_coefficient"] == pytest.approx([0.1, 0.055, 0.01, 0.01])
    still = scalars(ppo_gru.main(tiny(env_id="CueRecall-v0", anneal_steps=0, exp_name="still", **rates)))
    assert still["charts/learning_rate"] == pytest.approx([1e-3, 1e-3])


def update_with(played, monkeypatch, target_kl):
    """Update with plain gradient descent; return the divergence of each minibatch, and the number of steps."""
    args, run, *_ = played(env_id="CueRecall-v0", update_epochs=5, target_kl=target_kl)
    torch.manual_seed(5)
    run.rollout.advantages.normal_()
    divergences, loss_of = [], ppo_gru.ppo_loss

    def recorded(*given):
        loss, log = loss_of(*given)
        divergences.append(log["approx_kl"].item())
        return loss, log

    with monkeypatch.context() as patch:
        patch.setattr(ppo_gru, "ppo_loss", recorded)
        optimizer = torch.optim.SGD(run.agent.parameters(), lr=0.1)
        logs, _ = ppo_gru.update(run.agent, [optimizer], run.rollout, 0.0, args)
    assert [each["approx_kl"].item() for each in logs] == divergences, "the one that is too large is logged, too"
    return divergences, sum("grad_norm" in each for each in logs)


def test_target_kl_ends_the_update_at_the_first_minibatch_beyond_it(played, monkeypatch):
    """Limits a hair above and below a divergence: the update goes on, or ends before that minibatch's step."""
    divergences, steps = update_with(played, monkeypatch, None)
    assert steps == len(divergences) == 10
    k = next(i for i in range(3, 10) if divergences[i] > 1.2 * max(divergences[:i]))
    _, steps = update_with(played, monkeypatch, divergences[k] * 0.999)
    assert steps == k
    _, steps = update_with(played, monkeypatch, divergences[k] * 1.001)
    assert steps > k


def test_target_kl_never_ends_an_update_before_its_first_step(played, monkeypatch):
    assert update_with(played, monkeypatch, 1e-30)[1] == 1


def test_logged_divergences(played):
    """KL and clip fraction are what their names say: log-ratios of 0.2 in one of two branches, on every step."""
    args, run, *_ = played(env_id="CueRecall-v0", clip_coef=0.1)
    rollout = run.rollout
    rollout.log_probs[..., 0] -= 0.2
    pieces = run.agent.memory.cut(rollout.done)
    _, logs = ppo_gru.ppo_loss(run.agent, rollout, pieces, 0.0, args)
    assert logs["old_approx_kl"].item() == pytest.approx(-0.2, abs=1e-5)
    assert logs["approx_kl"].item() == pytest.approx(math.exp(0.2) - 1 - 0.2, abs=1e-5)
    assert logs["clipfrac"].item() == 0.5
    assert logs["ratio_error"].item() == pytest.approx(math.exp(0.2) - 1, abs=1e-5)


@pytest.mark.parametrize("memory", [{"script": ppo_trxl, "trxl_gate": "gru"}, {"memory": "lstm"}])
def test_save_and_load(tiny, opened, memory):
    script = memory.get("script", ppo_gru)
    folder = script.main(tiny(env_id="CueRecall-v0", save_model=True, **memory))
    path = os.path.join(folder, "model.pt")
    saved = read_model(path)
    args, weights = saved_args(script.Args, saved), saved["weights"]
    assert args == tiny(env_id="CueRecall-v0", save_model=True, vector_frequencies=0, **memory)
    assert all(weight.device.type == "cpu" for weight in weights.values())
    run = opened(script, tiny(env_id="CueRecall-v0", load_model=path, exp_name="again", seed=9, **memory))
    for name, weight in run.agent.state_dict().items():
        assert weight.equal(weights[name])
    assert [name for name in os.listdir(folder) if name.startswith("model")] == ["model.pt"]


@pytest.fixture(scope="session")
def trained_on_90_levels(tiny, tmp_path_factory):
    """The weights of a training on levels 12 to 101."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("trained"))
        return str((ppo_gru.main(tiny(start_level=12, num_levels=90, save_model=True)) / "model.pt").absolute())


@pytest.mark.parametrize(
    ("flags", "levels"),
    [
        ({"num_levels": 50}, "50 to 59"),
        ({"num_levels": 101}, "101 to 110"),
        ({"num_levels": 102}, None),
        ({"start_level": 1, "num_levels": 2}, "3 to 12"),
        ({"start_level": 1, "num_levels": 1}, None),
        ({"num_levels": 50, "env_id": "MysteryPath-Grid-v0"}, None),
    ],
)
def test_levels_of_an_evaluation_that_loaded_weights_were_trained_on(
    tiny, opened, capsys, trained_on_90_levels, flags, levels
):
    path = trained_on_90_levels
    opened(ppo_gru, tiny(**{"eval_levels": 10, "load_model": path, **flags}))
    told = (
        f"{path} was trained on levels 12 to 101, and evaluations of this run play levels {levels}; "
        "with --start-level 102, "
    )
    assert (told in capsys.readouterr().err) == (levels is not None)


def test_capture_video(tiny):
    pytest.importorskip("imageio_ffmpeg")
    folder = ppo_gru.main(tiny(env_id="MortarMayhemB-Grid-v0", capture_video=True))
    videos = glob.glob(os.path.join(folder, "videos", "*.mp4"))
    assert len(videos) >= 2
    assert all(os.path.getsize(video) > 1000 for video in videos)


@pytest.mark.parametrize("script", SCRIPTS)
def test_presets(script):
    """What a preset holds is a default; what is given wins. It is recorded, from Python too."""
    assert parse_args(script) == script.Args()
    for name, held in script.PRESETS.items():
        args = parse_args(script, "--preset", name)
        assert args == script.Args(**held)
        assert args.preset == name
        check_args(args)
        assert args.anneal_steps == args.total_timesteps
    for flags, steps in (([], 2_000_000), (["--anneal-steps", "7"], 7), (["--anneal-steps", "0"], 0)):
        args = parse_args(script, "--preset", "laptop", "--total-timesteps", "2e6", *flags)
        check_args(args)
        assert args.anneal_steps == steps, "the schedules are as long as the training, unless another length is given"
    held = script.PRESETS["laptop"]
    given = parse_args(script, "--num-steps", "7", "--preset=laptop", "--env-id", "CartPole-v1")
    assert (given.num_steps, given.env_id, given.trunk_size) == (7, "CartPole-v1", held["trunk_size"])


def test_a_run_that_is_extended_keeps_its_schedule(monkeypatch):
    args = ppo_gru.Args(**ppo_gru.PRESETS["laptop"])
    check_args(args)  # as a training does
    saved = {"args": dataclasses.asdict(args)}
    monkeypatch.setattr(runs, "read_checkpoint", lambda folder: saved)
    args = parse_args(ppo_gru, "--resume", "runs/x", "--total-timesteps", "2e8")
    assert (args.preset, args.total_timesteps, args.anneal_steps) == ("laptop", 2e8, 6_000_000)


def test_the_last_lines(tiny, capsys, monkeypatch):
    """The folder with the score, and the commands that evaluate, watch and plot."""
    args = tiny(env_id="MortarMayhemB-Grid-v0", obs_type="vector", total_timesteps=256, num_steps=64)
    folder = ppo_gru.main(args).relative_to(os.getcwd())
    score, *commands = capsys.readouterr().out.splitlines()
    assert re.fullmatch(rf"{folder}: 256 steps, return -?\d\.\d\d, mean of the last \d+ episodes", score)
    checkpoint = folder / "checkpoint-256.pt"
    assert commands == [
        f"evaluate: python {ROOT}/evaluate.py {checkpoint}",
        f"watch: python {ROOT}/enjoy.py {checkpoint} --out page.html",
        f"plot: tensorboard --logdir {folder}",
    ]
    find_spec = runs.importlib.util.find_spec
    monkeypatch.setattr(runs.importlib.util, "find_spec", lambda name: None if name == "plotly" else find_spec(name))
    folder = ppo_gru.main(dataclasses.replace(args, eval_interval=1, eval_levels=2, save_model=True, exp_name="b"))
    folder = folder.relative_to(os.getcwd())
    score, *commands = capsys.readouterr().out.splitlines()
    assert re.fullmatch(rf"{folder}: 256 steps, return -?\d\.\d\d on 2 other levels", score)
    assert commands[0] == f"evaluate: python {ROOT}/evaluate.py {folder / 'model.pt'}"
    assert commands[1].startswith(f'watch: pip install -e "{ROOT}[eval]" && python {ROOT}/enjoy.py')
    args = tiny(env_id="MysteryPath-v0", obs_type="vector", checkpoint_interval=0, exp_name="c d")
    folder = ppo_gru.main(args).relative_to(os.getcwd())
    told = [f"{folder}: 128 steps, no episode ended", f"plot: tensorboard --logdir '{folder}'"]
    assert capsys.readouterr().out.splitlines() == told


def test_commands_are_short_in_the_repository(tiny, opened):
    args = tiny(env_id="CueRecall-v0", total_timesteps=64)
    run = opened(ppo_gru, args)
    ppo_gru.train(args, run)
    run.started_in, run.stop = ROOT, True
    programs = [line.split()[2] for line in runs.summary(args, run).splitlines()[1:3]]
    assert programs == ["ppo_gru.py", "evaluate.py"]


def test_the_last_lines_of_a_run_that_was_stopped(tiny, opened, capsys):
    args = tiny(env_id="CueRecall-v0", total_timesteps=256, eval_interval=1)
    run = opened(ppo_gru, args)
    run.received_signal = 15
    runs.run_to_end(args, run, ppo_gru.train)
    told = capsys.readouterr().out.splitlines()
    folder = run.folder.relative_to(os.getcwd())
    assert told[1:] == [
        f"resume: python {ROOT}/ppo_gru.py --resume {folder}",
        f"evaluate: python {ROOT}/evaluate.py {folder / 'checkpoint-64.pt'}",  # this environment draws nothing to watch
        f"plot: tensorboard --logdir {folder}",
    ]


def test_a_terminal_that_is_gone(tiny, opened, monkeypatch):
    """Ctrl-C ends `tee` too: the training still ends with its checkpoint."""
    args = tiny(env_id="CueRecall-v0", total_timesteps=256)
    run = opened(ppo_gru, args)

    def gone(*_, **__):
        raise BrokenPipeError

    for owner, name in ((run.bar, "set_postfix"), (run.bar, "update"), (run.bar, "close"), (os, "write")):
        monkeypatch.setattr(owner, name, gone)
    handlers = {}
    monkeypatch.setattr(runs.signal, "signal", handlers.__setitem__)
    runs.stop_on_signals(run)
    handlers[runs.signal.SIGINT](runs.signal.SIGINT, None)
    assert (runs.run_to_end(args, run, ppo_gru.train) / "checkpoint-64.pt").is_file()


def test_closing_goes_on_where_a_part_cannot_be_closed(tiny, opened, monkeypatch):
    run = opened(ppo_gru, tiny(env_id="CueRecall-v0"))

    def broken():
        raise RuntimeError("the simulator is gone")

    with monkeypatch.context() as patch:
        patch.setattr(run.envs, "close", broken)
        with pytest.raises(RuntimeError, match="the simulator is gone"):
            runs.close(run)
    assert run.lock.closed
    assert run.writer.file_writer is None


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_preset_is_good_for_environments_without_vectors(scalars, script):
    few = "--num-envs 2 --num-steps 32 --num-minibatches 2 --total-timesteps 64 --no-cuda"
    args = parse_args(script, "--preset", "laptop", "--env-id", "CartPole-v1", *few.split())
    assert len(scalars(script.main(args))["losses/loss"]) == 1


WITHOUT_EXTRAS = """
import contextlib, runpy, sys
sys.modules |= dict.fromkeys(["imageio_ffmpeg", "wandb", "pygame", "matplotlib", "scipy", "PIL", "plotly", "pytest"])
for script in {scripts}:
    with contextlib.suppress(SystemExit):
        runpy.run_path(script, run_name="__main__")
"""


def test_scripts_need_no_extra(tmp_path):
    """In an interpreter of its own, where nothing is imported yet, and none of what an extra brings can be."""
    flags = "--env-id MortarMayhem-Grid-v0 --obs-type vector --total-timesteps 128 --num-envs 2 --num-steps 64"
    flags = [*flags.split(), "--num-minibatches", "2", "--trunk-size", "16", "--no-cuda", "--save-model"]
    code = WITHOUT_EXTRAS.format(scripts=[script.__file__ for script in SCRIPTS])
    environ = {**os.environ, "PYTHONPATH": os.path.dirname(ppo_gru.__file__)}
    line = [sys.executable, "-c", code, *flags]
    done = subprocess.run(line, cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert len(re.findall(r"return=-?\d.*length=\d.*SPS=\d", done.stderr)) >= len(SCRIPTS), "the progress bars"
    for script in SCRIPTS:
        assert len([*tmp_path.glob(f"runs/MortarMayhem-Grid-v0__{script.__name__}__1__*/model.pt")]) == 1, done.stderr


@pytest.mark.parametrize("script", SCRIPTS)
def test_help(script):
    shown = run_command(script.__file__, "--help")
    assert shown.returncode == 0
    for name in script.Args.__dataclass_fields__:
        assert flag(name) in shown.stdout
    said = " ".join(shown.stdout.split())
    for bounds in ("INT (1 or more)", "FLOAT (0 to 1)", "INT (0 to 16)", "FLOAT (above 0)"):
        assert bounds in said
    assert "--preset laptop stands for --obs-type vector" in said
    assert "--preset quickstart stands for --obs-type vector" in said
    assert """--env-options '{"command_count": [2],""" in said
