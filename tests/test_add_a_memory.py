"""docs/add_a_memory.md: who follows it has a script that passes the suite and trains."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

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

    def python(*command):
        done = subprocess.run(
            [sys.executable, *command],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    tests = ("tests/test_memory.py", "tests/test_resume.py", "-k", "mingru")
    told = python("-m", "pytest", "-p", "no:cacheprovider", *tests)
    assert int(re.search(r"(\d+) passed", told).group(1)) >= 19
    few = ["--seeds", "1", "--steps", "2e4", "--evaluations", "1", "--test-levels", "5"]
    learning = ("benchmarks/learning.py", "--tasks", "mortar-mayhem", "--agents", "ppo_mingru.py", *few)
    assert "\n| ppo_mingru.py | 0." in python(*learning)
    (model,) = tmp_path.glob("learning/runs/*/model.pt")
    assert "| ppo_mingru-py | 1 |" in python("evaluate.py", str(model), "--levels", "1", "--repeats", "1")
