"""A terminal, a pipe or a file that is closed, or gone before the program ends; a runner of the script's text."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from programs import Program

import ppo_gru
from ppo_utils import runs, terminal

ROOT = os.path.dirname(ppo_gru.__file__)
FLAGS = "--env-id CartPole-v1 --num-envs 2 --num-steps 16 --num-minibatches 1 --total-timesteps 32 --hidden-size 8"


def in_another_program(code, **streams):
    """Run code that begins as programs here do; its exit code."""
    code = f"import sys; from ppo_utils.terminal import *; open_streams(); {code}"
    environment = {**os.environ, "PYTHONUNBUFFERED": ""}
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, timeout=60, **streams).returncode


@pytest.mark.parametrize("closed", [{0}, {1}, {2}, {0, 1, 2}])
def test_closed_streams_get_no_file(closed, tmp_path):
    code = f"file = open({str(tmp_path / 'a')!r}, 'w'); print('b'); print('c', file=sys.stderr); sys.stdin.read()"
    code += "; tell('d'); assert file.fileno() > 2"
    streams = {name: subprocess.DEVNULL for name in ("stdin", "stdout", "stderr")}
    assert in_another_program(code, preexec_fn=lambda: [os.close(each) for each in closed], **streams) == 0
    assert (tmp_path / "a").read_text() == ""


def test_a_training_without_streams(monkeypatch, tmp_path):
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    monkeypatch.setattr(sys, "argv", ["ppo_gru.py", *FLAGS.split(), "--no-cuda"])
    monkeypatch.setattr(runs.signal, "signal", lambda *_: None)
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)  # which it replaces
    with pytest.raises(SystemExit) as end:
        runs.command(ppo_gru.Args, ppo_gru.PRESETS, ppo_gru.setup, ppo_gru.train)
    assert end.value.code == 0
    assert len([*tmp_path.glob("runs/*/checkpoint-32.pt")]) == 1


@pytest.mark.parametrize(("stream", "ends", "code"), [
    ("stdout", "print('the last lines'); sys.exit(130)", 130),
    ("stderr", "tell('a line'); sys.exit(143)", 143),
    ("stderr", "\nwith one_line_exit(ValueError):\n    raise ValueError('wrong')", 1),
])  # fmt: skip
def test_a_reader_that_is_gone_changes_no_exit_code(stream, ends, code):
    """As where Ctrl-C has ended `tee` too."""
    read, write = os.pipe()
    os.close(read)
    assert in_another_program(ends, **{stream: write}) == code
    os.close(write)


def test_a_training_whose_last_lines_nobody_reads(monkeypatch, tiny):
    def gone(*_, **__):
        raise BrokenPipeError

    monkeypatch.setattr("builtins.print", gone)
    assert (ppo_gru.main(tiny(env_id="CueRecall-v0")) / "checkpoint-128.pt").is_file()
    terminal.tell("a line")


def test_a_runner_that_executes_the_text():
    """`python -m cProfile` does, whose own names `__main__` has before Python 3.12."""

    def runner():
        sys.argv, path = ["runner.py", "--env-id", "CartPole-v99"], ppo_gru.__file__
        exec(compile(Path(path).read_text(), path, "exec"), {"__name__": "__main__", "__file__": path})

    with Program(runner) as program:
        assert program.wait().stderr.startswith("runner.py: there is no environment CartPole-v99")
