"""Bad input ends in one line that says what is wrong and what would be right, and writes nothing."""

import errno
import fcntl
import glob
import os
import re
import sys
import types
from dataclasses import asdict, replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import SCRIPTS, parse_args
from programs import run_command

import ppo_gru
import ppo_trxl
from ppo_utils import runs
from ppo_utils.environments import envs_for
from ppo_utils.errors import RunError
from ppo_utils.evaluation import make_agent
from ppo_utils.flags import check_args, check_minibatches

SCRIPT = os.path.abspath(ppo_gru.__file__)
CASES = {
    "--env-id MortarMayhm-v0": "there is no environment MortarMayhm-v0; the nearest is MortarMayhem-v0",
    "--env-id MortarMayhem-Grid": "the nearest is MortarMayhem-Grid-v0",
    "--env-id zzz": "zzz",
    "--env-id nowhere:Env-v0": "nowhere",
    "--env-id Pendulum-v1": "action space .* is not supported; use Discrete",
    "--env-options {broken": "--env-options is no JSON",
    f"--env-options {5000 * '['}": "--env-options is no JSON",
    "--env-options [1]": "--env-options must be a JSON object",
    '--env-options {"comand_count":[3]}': "comand_count.*command_count",
    '--env-options {"arena_size":9}': "arena_size.*2.*6",
    '--env-id CartPole-v1 --env-options {"a":1}': "CartPole-v1 has none",
    "--num-envs 0": "--num-envs is 0; it must be 1 or more",
    "--vector-frequencies 4": "needs an observation with a vector, not with observation alone",
    "--vector-frequencies 17": "--vector-frequencies is 17; it must be 0 to 16",
    "--gamma 1.5": "--gamma is 1.5; it must be 0 to 1",
    "--gamma 1e39": r"--gamma is 1e\+39; it must be 0 to 1$",
    "--init-lr nan": "--init-lr is nan; it must be 0 to 1",
    "--final-lr inf": "--final-lr is inf; it must be 0 to 1",
    "--clip-coef 0": "--clip-coef is 0.0; it must be above 0",
    "--target-kl -1": "--target-kl is -1.0; it must be above 0",
    "--total-timesteps 100": "--total-timesteps is 100, less than one iteration of 16384 steps",
    "--num-minibatches 64": "--num-minibatches is 64, but an iteration may have only 32 sequences",
    "--num-minibatches 200 --seq-len 100": "may have only 163 sequences",
    "--seed 99999999999999999999": r"--seed is 99999999999999999999; it must be below 2 \*\* 63",
    "--exp-name ../up": "--exp-name is '../up'; it must be a name without slashes",
    "--exp-name gr\udcc3\udcb6sse": "--exp-name is .*, no UTF-8 text; start Python with -X utf8",
    "--env-id CueRecall-v0 --capture-video": "needs an environment that draws images .*; CueRecall-v0 draws none",
    "--target-kl nan": "--target-kl is nan; it must be above 0",
    "--vf-coef inf": r"--vf-coef is inf; it must be 0 or more and at most 3\.4e\+38, where float32 ends",
    "--auxiliary-detach": "--auxiliary-detach needs --reconstruction-coef or --ground-truth-coef above 0",
    "--refresh-memory --update-epochs 1": "--refresh-memory needs --update-epochs above 1: the first epoch has fresh "
    "memory",
    "--memory none --seq-len 5": "--seq-len, --num-layers and --refresh-memory need --memory gru or lstm",
    "--memory none --refresh-memory": "--refresh-memory need --memory gru or lstm",
    "--preset quickstart --env-id MysteryPath-Grid-v0": "no option .*quickstart has options .*'{}' the default",
    '--preset quickstart --env-options {"comand_count":[4]}': "no option 'comand_count'(?!.*quickstart)",
    "--preset quickstart --env-id CartPole-v1": "CartPole-v1 has none .*quickstart has options of its own",
    "--preset quickstart --env-id MortarMayhm-v0": "the nearest is MortarMayhem-v0$",
    "--env-id .foo:x-v0": "the module of .foo:x-v0 begins with a dot",
    "--capture-video --load-model missing.pt": "there is no file missing.pt",
    "--load-model missing.pt": "there is no file missing.pt; --save-model writes model.pt",
}


TRANSFORMER_CASES = {
    "--trxl-num-heads 5": "--trxl-dim is 384; it must be even and a multiple of --trxl-num-heads",
    "--trxl-dim 9 --trxl-num-heads 3": "--trxl-dim is 9; it must be even",
    "--trxl-memory-length 0": "--trxl-memory-length is 0; it must be 1 or more",
    "--trxl-gate-bias inf": "--trxl-gate-bias is inf; it must be -100 to 100",
    "--trxl-memory-gradient --trxl-segment-length 1": "--trxl-memory-gradient needs --trxl-segment-length above 1",
    "--trxl-gate-bias 2": "--trxl-gate-bias needs --trxl-gate gru; without, it changes nothing",
    "--num-minibatches 200": "may have only 128 sequences .* at most that many, or more environments",
}


def run(flags, cwd):
    return run_command(SCRIPT, "--no-cuda", *flags, folder=cwd)


def setup_error(args, script=ppo_gru):
    """What a setup that fails says."""
    before = os.path.exists("runs") and os.listdir("runs")
    with pytest.raises((ValueError, OSError, ImportError, RunError, gym.error.Error)) as error:
        script.setup(args)
    assert (os.path.exists("runs") and os.listdir("runs")) == before, "nothing half-written"
    return str(error.value)


def opened_weights(script, args):
    """The weights of a fresh agent."""
    envs = envs_for(args, 1)
    return make_agent(script.Agent, envs, envs.reset()[1], args).state_dict()


@pytest.mark.parametrize("line", CASES)
def test_setup_names_the_fault(line):
    message = setup_error(parse_args(ppo_gru, *line.split()))
    assert re.search(CASES[line], message), message


def test_a_process_without_a_gpu_of_its_own(monkeypatch, tiny):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setenv("LOCAL_RANK", "1")
    said = setup_error(tiny(cuda=True))
    assert said == "there are more processes than GPUs on this machine; start at most 1, or use --no-cuda"


@pytest.mark.parametrize("line", TRANSFORMER_CASES)
def test_setup_names_the_transformer_s_fault(line):
    message = setup_error(parse_args(ppo_trxl, *line.split()), ppo_trxl)
    assert re.search(TRANSFORMER_CASES[line], message), message


@pytest.mark.parametrize("line", ["--env-id MortarMayhm-v0", '--env-options {"arena_size":9}', "--num-minibatches 64"])
def test_the_command_prints_one_line_and_fails(line, tmp_path):
    done = run(line.split(), tmp_path)
    assert done.returncode == 1
    (said,) = done.stderr.strip().splitlines()
    assert said.startswith("ppo_gru.py: ")
    assert os.listdir(tmp_path) == []


WRONG_FLAGS = {
    "--memory gur": "'gru'",
    "--preset desktop": "laptop",
    "--preset": "preset",
    "--resume": "resume",
    "--num-envs many": "num-envs",
    "--no-such-flag 1": "no-such-flag",
}


@pytest.mark.parametrize("line", WRONG_FLAGS)
def test_wrong_flags(line, tmp_path):
    """The parser of the command line says what is wrong with what, in a box of its own."""
    done = run(line.split(), tmp_path)
    assert done.returncode == 2
    assert WRONG_FLAGS[line] in done.stderr
    assert "Traceback" not in done.stderr
    assert os.listdir(tmp_path) == []


def test_infinity_is_no_limit(tiny):
    check_args(tiny(max_grad_norm=float("inf"), clip_coef=float("inf"), target_kl=float("inf")))


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL])
def test_a_file_system_without_locks(tiny, opened, monkeypatch, number):
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)  # of what filelock calls here
    assert opened(ppo_gru, tiny(env_id="CueRecall-v0")).folder.is_dir()


def test_as_many_minibatches_as_steps_without_memory(tiny):
    args = tiny(memory="none", num_minibatches=64)
    check_minibatches(args, ppo_gru.Memory(args, 8))


def test_a_piece_is_no_longer_than_the_rollout(tiny):
    """Sequences may be longer: the limit is that of the pieces that a rollout has."""
    args = tiny(seq_len=1000, num_minibatches=4)
    check_minibatches(args, ppo_gru.Memory(args, 8))
    with pytest.raises(ValueError, match="--num-minibatches is 5, but an iteration may have only 4"):
        check_minibatches(replace(args, num_minibatches=5), ppo_gru.Memory(args, 8))


@pytest.mark.parametrize("error", [RuntimeError("not enough memory: you tried to allocate a lot"), MemoryError()])
def test_what_does_not_fit(tiny, monkeypatch, error):
    def full(*_):
        raise error

    monkeypatch.setattr(ppo_gru.Rollout, "allocate", full)
    changes = {"num_envs": 128, "frame_stack": 7, "seq_len": 8, "total_timesteps": 4096, "checkpoint_interval": 100}
    message = setup_error(tiny(env_id="CueRecall-v0", update_epochs=9, **changes))
    assert message == "this does not fit in the memory of cpu; use less of --frame-stack 7 --num-envs 128"


@pytest.mark.parametrize("script", SCRIPTS)
def test_an_update_that_does_not_fit(tiny, monkeypatch, script):
    def full(*_):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes")

    monkeypatch.setattr(script, "ppo_loss", full)
    args = tiny(script, env_id="CueRecall-v0", num_minibatches=2, save_model=True)
    says = (
        r"^iteration 1: this does not fit in the memory of cpu; use less of .*; or more of --num-minibatches 2; there"
    )
    with pytest.raises(RunError, match=says):
        script.main(args)
    assert not glob.glob("runs/*/model.pt*")


def test_ctrl_c_while_it_is_set_up(monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["ppo_gru.py"])
    with pytest.raises(SystemExit) as ended:
        runs.command(ppo_gru.Args, ppo_gru.PRESETS, interrupted, ppo_gru.train)
    assert ended.value.code == 130


def test_a_defect_is_told_as_one(tiny, monkeypatch):
    monkeypatch.setattr(ppo_gru.Rollout, "allocate", lambda *_: torch.zeros(1, 2) @ torch.zeros(1))
    with pytest.raises(RuntimeError, match="size"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0"))


def test_tracking_that_does_not_start(tiny, monkeypatch):
    def init(**_):
        raise RuntimeError("no API key")

    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=init))
    message = setup_error(tiny(env_id="CueRecall-v0", track=True))
    assert message == "--track: no API key; log in with `wandb login`, or leave --track out"
    assert not glob.glob("runs/*")


def test_a_run_folder_that_cannot_be_written(tmp_path, tiny):
    (tmp_path / "runs").write_text("a file where the folder should be")
    with pytest.raises(OSError, match="runs"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0"))


def test_a_model_of_colors_for_a_stack_of_three_gray_images(tiny):
    shared = {"env_id": "MortarMayhemB-Grid-v0", "obs_type": "pixels"}
    folder = ppo_gru.main(tiny(**shared, save_model=True))
    with pytest.raises(ValueError, match="was trained with --frame-stack 0, not with --frame-stack 3"):
        ppo_gru.setup(tiny(**shared, load_model=f"{folder}/model.pt", frame_stack=3))


def test_a_model_of_another_network(tiny):
    folder = ppo_gru.main(tiny(env_id="CueRecall-v0", save_model=True))
    path = os.path.join(folder, "model.pt")
    with pytest.raises(ValueError, match=r"model\.pt was trained with --hidden-size 32, not with --hidden-size 64"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0", load_model=path, hidden_size=64))
    with pytest.raises(ValueError, match=r"weights of another network, trained with --env-id CueRecall-v0 .*-size 32"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0", load_model=path, trunk_size=64))
    saved = {"script": "ppo_gru", "args": asdict(tiny()), "weights": {"memory.rnn.bias_hh_l0": torch.zeros(3)}}
    torch.save(saved, path)
    with pytest.raises(ValueError, match="another network"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0", load_model=path))
    torch.save({"script": "ppo_trxl", "args": {}, "weights": {}}, path)
    with pytest.raises(ValueError, match=r"was trained by ppo_trxl\.py, not by ppo_gru\.py"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0", load_model=path))
    for wrong in ({"weights": {}}, {"script": "ppo_gru", "args": {}, "weights": 1}):
        torch.save(wrong, path)
        with pytest.raises(ValueError, match="is cut short, or neither a model nor a checkpoint"):
            ppo_gru.setup(tiny(env_id="CueRecall-v0", load_model=path))


NETWORKS = {
    "trxl_num_heads": 4,
    "trxl_memory_length": 9,
    "trxl_positional_encoding": "none",
    "trxl_query_position": True,
    "trxl_layer_norm": "post",
}


@pytest.mark.parametrize("name", NETWORKS)
def test_a_model_whose_weights_fit_but_mean_something_else(tiny, name):
    """With another number of heads, encoding or window, the same weights compute something else."""
    other = tiny(ppo_trxl, env_id="CueRecall-v0", **{name: NETWORKS[name]})
    weights = opened_weights(ppo_trxl, tiny(ppo_trxl, env_id="CueRecall-v0"))
    torch.save({"script": "ppo_trxl", "args": asdict(other), "weights": weights}, "model.pt")
    message = setup_error(tiny(ppo_trxl, env_id="CueRecall-v0", load_model="model.pt"), ppo_trxl)
    named = name.replace("_", "-")
    assert re.match(rf"model\.pt was trained with --{named}.*, not with --(no-)?{named}", message), message


def test_a_model_file_that_is_none(tiny, tmp_path):
    (tmp_path / "notes.pt").write_text("some notes")
    assert setup_error(tiny(env_id="CueRecall-v0", load_model="notes.pt")).startswith("notes.pt is cut short, or")


def test_missing_extras(tiny, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    message = '--capture-video needs imageio-ffmpeg: pip install -e ".[play]"'
    assert setup_error(tiny(capture_video=True)) == message
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert setup_error(tiny(track=True)) == '--track needs wandb: pip install -e ".[track]"'


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_training_that_diverges(tiny, opened, script):
    args = tiny(script, env_id="CueRecall-v0", vf_coef=1e38, total_timesteps=640, save_model=True)
    with pytest.raises(
        FloatingPointError,
        match="iteration 1: the loss or its gradient is not finite; try a lower --init-lr, or smaller rewards; there",
    ):
        script.main(args)
    assert not glob.glob("runs/*/model.pt*"), "nothing is left of it"
    run = opened(script, tiny(script, env_id="CueRecall-v0", exp_name="spoilt"))
    next(run.agent.parameters()).data.fill_(float("nan"))
    torch.save({"script": script.__name__, "args": vars(args), "weights": run.agent.state_dict()}, "spoilt.pt")
    message = setup_error(tiny(script, env_id="CueRecall-v0", load_model="spoilt.pt"), script)
    assert message == "spoilt.pt holds weights that are not finite: the training diverged"


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [
        ("total_timesteps", 1e6, "int"),  # an integer on the command line
        ("eval_interval", 1.5, "int"),
        ("seed", True, "int"),
        ("seed", np.int64(1), "int"),
        ("init_lr", np.float64(3e-4), "float"),  # of np.geomspace; the files could not be read again
        ("target_kl", np.float32(0.1), "float"),
        ("gamma", "0.99", "float"),
        ("step_encoding", np.True_, "bool"),
        ("load_model", Path("model.pt"), "str"),
        ("env_options", {"command_count": [3]}, "str"),
        ("optimizer", np.str_("muon"), "str"),
    ],
)
def test_a_value_of_another_type(tiny, name, value, kind):
    message = f"--{name.replace('_', '-')} is {value!r}; it must be of type {kind}"
    with pytest.raises(ValueError, match=re.escape(message)):
        check_args(tiny(**{name: value}))


@pytest.mark.parametrize(
    ("changes", "found"), [({"gamma": 1}, 1.0), ({"target_kl": None}, None), ({"target_kl": 1}, 1.0)]
)
def test_an_integer_becomes_a_float_and_none_is_optional(tiny, changes, found):
    """Else curves would tell an agent with gamma=1 from one with gamma=1.0, as the command line has it."""
    args = tiny(**changes)
    check_args(args)
    (name,) = changes
    assert repr(getattr(args, name)) == repr(found)


@pytest.mark.parametrize("name", ["my_agent", "ppo_my-net", "ppo_gru.v2", "ppo_"])
def test_a_script_that_its_files_could_not_name(tiny, name):
    """Before it trains: its models would be read by nothing."""
    with pytest.raises(ValueError, match=re.escape(f"the script {name}.py must be named ppo_NAME.py, in letters, ")):
        runs.prepare(tiny(), name)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_choice_that_there_is_not(tiny, script):
    """On the command line tyro finds it."""
    with pytest.raises(ValueError, match="--norm-adv is 'yes'; it must be one of none, minibatch, batch"):
        check_args(tiny(script, norm_adv="yes"))
