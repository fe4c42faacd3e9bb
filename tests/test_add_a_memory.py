"""docs/add_a_memory.md: who follows it has a script that passes the suite and trains."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/add_a_memory.md").read_text()
MEMORY, FLAGS, NEW_FLAGS = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
REPLACED = re.findall(r"^\| [^|/.]+ \| `(.+)` \| `(.+)` \|$", PAGE, re.MULTILINE)
ADDED = re.findall(r"^\| `(\S+/\S+|evaluate)\.py` \| `(\w+)` \| `(.+)` \|$", PAGE, re.MULTILINE)


def replace(text, old, new):
    assert text.count(old) == 1, f"the page says to change {old!r}"
    return text.replace(old, new)


def follow(folder):
    """Do in this folder what the page says."""
    script = (ROOT / "ppo_gru.py").read_text()
    memory = script[script.index("class MemoryState(") : script.index("\n\n# ---- 5 AGENT ----")]
    for_gru = script[script.index("def packed_gru(") : script.index('if __name__ == "__main__":')]
    for old, new in [(memory, MEMORY), (for_gru, ""), (FLAGS, NEW_FLAGS), *REPLACED]:
        script = replace(script, old, new)
    (folder / "ppo_mingru.py").write_text(script)
    for name in ("ppo_gru.py", "ppo_trxl.py", "tests/cue_recall.py"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    (folder / "benchmarks").mkdir()
    for name, table, line in ADDED:
        text = (ROOT / name).with_suffix(".py").read_text()
        begins = re.search(rf"^{table} = [{{\[]\n?", text, re.MULTILINE).group()
        text = replace(text, begins, f"{begins}{line}\n")
        if name != "benchmarks/learning":
            text = replace(text, "\nimport ppo_gru\n", "\nimport ppo_gru, ppo_mingru\n")
        (folder / name).with_suffix(".py").write_text(text)


def test_the_memory_of_the_page(tmp_path):
    assert (len(REPLACED), len(ADDED)) == (4, 5)
    follow(tmp_path)

    def python(*command):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (tmp_path, ROOT)))}
        done = subprocess.run(
            [sys.executable, *command], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    tests = ("tests/test_memory.py", "tests/test_resume.py", "-k", "mingru")
    told = python("-m", "pytest", "-p", "no:cacheprovider", *tests)
    assert int(re.search(r"(\d+) passed", told).group(1)) >= 19
    few = ["--seeds", "1", "--steps-scale", "0.01", "--evaluations", "1"]
    assert "\n| minGRU | 0." in python("benchmarks/learning.py", "--tasks", "mortar-mayhem", "--agents", "minGRU", *few)
    (model,) = tmp_path.glob("learning/runs/*/model.pt")
    assert "| minGRU | 1 |" in python("evaluate.py", str(model), "--levels", "1", "--repeats", "1")
