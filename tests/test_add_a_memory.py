"""docs/extend.md, a memory: who follows it has a script that passes the suite and trains."""

import re
import shutil
import sys
from pathlib import Path

import pytest
from programs import Program, command, elsewhere

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/extend.md").read_text().split("\n## ")[1]
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
        ignored = shutil.ignore_patterns("__pycache__", "results")
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

    def said(function):
        """What a program prints that has its modules from the copy alone."""
        there = elsewhere(function, tmp_path, tmp_path / "benchmarks")
        with Program(there, tmp_path, PYTHONPATH=str(tmp_path)) as program:
            done = program.wait()
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def train_and_evaluate():
        few = ["--seeds", "1", "--steps", "3e3", "--evaluations", "1"]
        tasks = ("--tasks", "mortar-mayhem", "--agents", "ppo_mingru.py --num-envs 16")
        command(tmp_path / "benchmarks/learning.py", *tasks, *few)()
        (model,) = tmp_path.glob("learning/runs/*/model.pt")
        command(tmp_path / "evaluate.py", model, "--levels", "1", "--repeats", "1")()

    files = ["tests/test_memory.py", "tests/test_resume.py"]
    tests = said(lambda: sys.exit(pytest.main(["-p", "no:cacheprovider", *files, "-k", "mingru"])))
    assert int(re.search(r"(\d+) passed", tests).group(1)) >= 19
    scores = said(train_and_evaluate)
    assert "\n| ppo_mingru.py, num envs 16 | 0." in scores
    assert "| ppo_mingru-py-num-envs-16 | 1 |" in scores
