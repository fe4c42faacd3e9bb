"""What macOS and Windows have not, as far as Linux can play it: on these systems themselves, no test has been run."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Python runs this before all else, in the processes of environments too. As in Windows, a file that is open for reading
# alone cannot be synced, and some characters are in no name.
SITECUSTOMIZE = """
import fcntl, os, re, sys, warnings

def sync(file, flags_of=fcntl.fcntl, fsync=os.fsync):
    if flags_of(file, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(9, "Bad file descriptor")
    fsync(file)

def refuse(event, given):
    name = given[0] if event in ("open", "os.mkdir", "os.rename") else ""
    if isinstance(name, str) and re.search(r'[<>:"|?*]', name):
        raise OSError(22, "Invalid argument", name)

os.fsync = sync
sys.addaudithook(refuse)
sys.modules |= dict.fromkeys(["fcntl", "resource", "pwd", "grp", "termios"])
for name in ("fork", "setsid", "getsid", "killpg", "getuid", "geteuid", "mkfifo"):
    delattr(os, name)
warnings.filterwarnings("ignore", "only soft file lock", UserWarning)  # of filelock, which has another in Windows
"""
CODE = """
import importlib, multiprocessing, pkgutil
import memory_gym_envs, ppo_gru, ppo_utils

for package in (memory_gym_envs, ppo_utils):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        importlib.import_module(module.name)
for name in ("ppo_trxl", "evaluate", "enjoy", "learning", "trxl_cost"):
    importlib.import_module(name)
multiprocessing.set_start_method("spawn")
ppo_gru.command(ppo_gru.Args, ppo_gru.PRESETS, ppo_gru.setup, ppo_gru.train)
"""


def test_a_training_on_another_system(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(SITECUSTOMIZE)
    path = os.pathsep.join(map(str, (tmp_path, ROOT, ROOT / "benchmarks")))
    flags = "--env-id CartPole-v1 --async-envs --num-envs 1 --num-steps 16 --num-minibatches 1 --total-timesteps 32"
    command = [sys.executable, "-c", CODE, *flags.split(), "--hidden-size", "8", "--no-cuda", "--exp-name", "a:b?"]
    environ = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("CartPole-v1__a-b-__1__")
    assert (folder / "checkpoint-32.pt").is_file()
