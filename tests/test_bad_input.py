"""Bad input ends in one line that says what is wrong and what would be right, and writes nothing."""

import os
import subprocess
import sys

import pytest
import torch

import ppo_gru

SCRIPT = os.path.abspath(ppo_gru.__file__)
CASES = {
    "--env-id MortarMayhm-v0": "MortarMayhem",
    "--env-id nowhere:Env-v0": "nowhere",
    "--env-id Pendulum-v1": "action space .* is not supported; use Discrete",
    "--env-id FrozenLake-v1": "observation space .* is not supported; use pixels",
    "--env-options {broken": "--env-options is no JSON",
    "--env-options [1]": "--env-options must be a JSON object",
    '--env-options {"comand_count":[3]}': "comand_count.*command_count",
    '--env-options {"arena_size":9}': "arena_size.*2.*6",
    '--env-id CartPole-v1 --env-options {"a":1}': "CartPole-v1 has none",
    "--num-envs 0": "--num-envs is 0; it must be 1 or more",
    "--gamma 1.5": "--gamma is 1.5; it must be a number from 0 to 1",
    "--init-lr nan": "--init-lr is nan",
    "--clip-coef 0": "--clip-coef is 0.0; it must be above 0",
    "--target-kl -1": "--target-kl is -1.0; it must be above 0",
    "--total-timesteps 100": "--total-timesteps is 100, less than one iteration of 16384 steps",
    "--num-minibatches 64": "--num-minibatches is 64, but an iteration is sure of only 32 sequences",
    "--num-minibatches 200 --seq-len 100": "sure of only 163 sequences",
    "--load-model missing.pt": "missing.pt",
    "--load-model /dev/null": "/dev/null is not a model that --save-model wrote",
}


def run(flags, cwd):
    command = [sys.executable, SCRIPT, "--no-cuda", *flags]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


def setup_error(args):
    with pytest.raises((ValueError, OSError, ImportError, ppo_gru.gym.error.Error)) as error:
        ppo_gru.setup(args)
    assert not os.path.exists("runs"), "nothing half-written"
    return str(error.value)


@pytest.mark.parametrize("line", CASES)
def test_setup_names_the_fault(line):
    args = ppo_gru.tyro.cli(ppo_gru.Args, args=line.split())
    with pytest.raises(Exception, match=CASES[line]):
        raise RuntimeError(setup_error(args))


@pytest.mark.parametrize("line", ["--env-id MortarMayhm-v0", '--env-options {"arena_size":9}', "--num-minibatches 64"])
def test_the_command_prints_one_line_and_fails(line, tmp_path):
    done = run(line.split(), tmp_path)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()
    assert last[-1].startswith("ppo_gru.py: ")
    assert "Traceback" not in done.stderr
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("line", ["--memory gur", "--num-envs many", "--no-such-flag 1"])
def test_wrong_flags(line, tmp_path):
    done = run(line.split(), tmp_path)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr + done.stdout


def test_a_run_folder_that_cannot_be_written(tmp_path, tiny):
    (tmp_path / "runs").write_text("a file where the folder should be")
    with pytest.raises(OSError, match="runs"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0"))


def test_a_model_of_another_network(tiny):
    folder = ppo_gru.main(tiny(env_id="CueRecall-v0", save_model=True))
    path = os.path.join(folder, "model.pt")
    with pytest.raises(ValueError, match=r"another network; .* --env-id CueRecall-v0 .*--hidden-size 32"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0", load_model=path, hidden_size=64))
    torch.save({"weights": 1}, path)
    with pytest.raises(ValueError, match="is not a model"):
        ppo_gru.setup(tiny(env_id="CueRecall-v0", load_model=path))


def test_missing_extras(tiny, monkeypatch):
    for name, changes in (("moviepy", {"capture_video": True}), ("wandb", {"track": True})):
        monkeypatch.setitem(sys.modules, name, None)
        assert name in setup_error(tiny(env_id="CueRecall-v0", **changes))
