"""What the tests stand on: programs in forked processes, and what a run of the tests says at its end."""

import os
import sys
from types import SimpleNamespace

import conftest
import programs
import pytest
import torch


def run(function, **environ):
    with programs.Program(function, **environ) as program:
        return program.wait()


@pytest.mark.parametrize(
    ("end", "code", "said"),
    [
        (lambda: None, 0, ""),
        (lambda: sys.exit(), 0, ""),
        (lambda: sys.exit(143), 143, ""),
        (lambda: sys.exit("no room"), 1, "no room\n"),
        (lambda: os.kill(os.getpid(), 15), -15, ""),
    ],
)
def test_a_program_ends_as_python_would(end, code, said):
    def program():
        print("done")
        sys.stdout.flush()
        end()

    done = run(program)
    assert (done.returncode, done.stdout, done.stderr) == (code, "done\n", said)


def test_an_error_is_told_with_its_traceback():
    done = run(lambda: 1 / 0)
    assert done.returncode == 1
    assert done.stderr.startswith("Traceback")
    assert done.stderr.endswith("ZeroDivisionError: division by zero\n")


def test_a_program_has_its_folder_its_environment_and_its_arguments(tmp_path):
    path = tmp_path / "program.py"
    path.write_text("import os, sys\nprint(os.getcwd(), os.environ['GIVEN'], sys.argv, __name__)")
    done = programs.run_command(path, "--flag", 3, folder=tmp_path, GIVEN="yes")
    assert done.stdout == f"{tmp_path} yes {[str(path), '--flag', '3']} __main__\n"
    assert "GIVEN" not in os.environ


def test_programs_find_each_other():
    def meet():
        torch.distributed.init_process_group("gloo")
        ranks = [None, None]
        torch.distributed.all_gather_object(ranks, torch.distributed.get_rank())
        print(ranks)

    assert [done.stdout for done in programs.run_together(meet)] == 2 * ["[0, 1]\n"]


def test_what_no_browser_looked_at_is_said_at_the_end():
    told, why = [], ("test_enjoy.py", 7, "Skipped: no browser: apt-get install chromium")
    skipped = [SimpleNamespace(longrepr=why), SimpleNamespace(longrepr=why)]
    summary = SimpleNamespace(stats={"skipped": skipped}, write_line=lambda line, **_: told.append(line))
    conftest.pytest_terminal_summary(summary)
    assert len(told) == 1
    assert told[0].startswith("no browser: 2 tests of the page of enjoy.py are skipped")
