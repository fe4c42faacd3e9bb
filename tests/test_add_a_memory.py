"""docs/add_a_memory.md: who follows it has a script that passes the suite and trains."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from programs import run_command

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/add_a_memory.md").read_text()
(MEMORY,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
FLAGS = re.findall(r"`(\w+)`", PAGE.split("delete the old memory's flags:")[1].split(".")[0])


def replace(text, old, new):
    assert text.count(old) == 1, f"the page says to change {old!r}"
    return text.replace(old, new)


def follow(folder):
    """Do in a copy of the repository what the page says."""
    for name in ("ppo_gru.py", "ppo_trxl.py", "evaluate.py", "enjoy.py", "enjoy.html", "pyproject.toml"):
        shutil.copy(ROOT / name, folder / name)
    for name in ("ppo_utils", "memory_gym_envs", "tests", "benchmarks"):
        ignored = shutil.ignore_patterns("__pycache__", "results", "tuning")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    script = (ROOT / "ppo_gru.py").read_text()
    memory = script[script.index("@dataclass\nclass MemoryState:") : script.index("\n\n# ---- 5 AGENT ----")]
    script = replace(script, memory, MEMORY)
    for flag in FLAGS:
        (field,) = re.findall(rf'^    {flag}: .*\n    """.*"""\n', script, re.MULTILINE)
        script = replace(script, field, "")
    (folder / "ppo_mingru.py").write_text(script)


def test_the_memory_of_the_page(tmp_path):
    follow(tmp_path)

    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"]
    command += ["tests/test_memory.py", "tests/test_resume.py", "-k", "mingru"]
    environ = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.search(r"(\d+) passed", done.stdout).group(1)) >= 19

    def python(path, *flags):
        done = run_command(tmp_path / path, *flags, folder=tmp_path, PYTHONPATH=str(tmp_path))
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    few = ["--seeds", "1", "--steps", "2e4", "--evaluations", "1", "--test-levels", "5"]
    tasks = ("--tasks", "mortar-mayhem", "--agents", "ppo_mingru.py")
    assert "\n| ppo_mingru.py | 0." in python("benchmarks/learning.py", *tasks, *few)
    (model,) = tmp_path.glob("learning/runs/*/model.pt")
    assert "| ppo_mingru-py | 1 |" in python("evaluate.py", str(model), "--levels", "1", "--repeats", "1")
