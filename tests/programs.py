"""Programs in processes of their own, forked off the one of the tests: each real, but nothing is imported again."""

import contextlib
import gc
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


class Program:
    """A function that runs in another process: it ends, and what it prints is kept, as if Python had started it.

    As a context manager it ends with its block at the latest.
    """

    def __init__(self, function, folder=".", **environ):
        self.files = [tempfile.TemporaryFile() for _ in range(2)]  # noqa: SIM115 (they close with this object)
        sys.stdout.flush(), sys.stderr.flush()
        self.code, self.pid = None, os.fork()
        if self.pid == 0:
            self._become(function, folder, environ)

    def _become(self, function, folder, environ):
        """In the new process: run the function, and end. Nothing of the tests goes on here."""
        code = 1
        gc.freeze()  # a progress bar that a test has left would end its line here, when it is collected
        with contextlib.suppress(BaseException):
            for number, file in enumerate(self.files, 1):
                os.dup2(file.fileno(), number)
            sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.chdir(folder)
            os.environ.update(environ)
            code = exit_code(function)
            sys.stdout.flush()
        os._exit(code)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.code is None:
            os.kill(self.pid, signal.SIGKILL)
            self.wait()

    def said(self, number=2):
        """What it has printed so far: on 1, standard output, or 2, standard error."""
        size = os.fstat(self.files[number - 1].fileno()).st_size
        return os.pread(self.files[number - 1].fileno(), size, 0).decode(errors="replace")

    def is_running(self):
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.code = os.waitstatus_to_exitcode(status) if pid else None
        return self.code is None

    def wait(self, timeout=300):
        """Wait for its end; return what subprocess.run would."""
        self.wait_until(lambda: not self.is_running(), timeout)
        return subprocess.CompletedProcess((), self.code, self.said(1), self.said(2))

    def wait_until(self, holds, timeout=300):
        """Wait until something holds."""
        deadline = time.monotonic() + timeout
        while not holds():
            assert time.monotonic() < deadline, self.said()
            time.sleep(0.01)


def exit_code(function):
    """Run a function as Python runs a program; return what the program would exit with."""
    try:
        function()
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return 1 if isinstance(end.code, str) else end.code or 0
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def command(path, *flags):
    """Return a function that does what `python path flags` does."""

    def run():
        sys.argv = [str(path), *map(str, flags)]
        runpy.run_path(str(path), run_name="__main__")

    return run


def module(name, *flags):
    """Return a function that does what `python -m name flags` does."""

    def run():
        sys.argv = [name, *map(str, flags)]
        runpy.run_module(name, run_name="__main__", alter_sys=True)

    return run


def is_here(path):
    """Whether a path is of this repository; a virtual environment in its folder is not."""
    path = Path(path).resolve()
    return path.is_relative_to(ROOT) and not path.is_relative_to(Path(sys.prefix).resolve())


def elsewhere(function, *folders):
    """Return a function that does the same where this repository is not: its modules are those in the folders."""

    def run():
        sys.path[:] = [*map(str, folders), *(path for path in sys.path if not is_here(path))]
        for name in [name for name, each in sys.modules.items() if is_here(getattr(each, "__file__", None) or "/")]:
            del sys.modules[name]
        function()

    return run


def run_command(path, *flags, folder=".", **environ):
    """Do what `python path flags` does; return what subprocess.run would."""
    with Program(command(path, *flags), folder, **environ) as program:
        return program.wait()


@contextlib.contextmanager
def together(function, processes=2):
    """Run a function in several processes that find each other as those of torchrun do."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "TORCHELASTIC_RUN_ID": "tests"}
    with contextlib.ExitStack() as stack:
        ranks = [{"RANK": str(rank), "LOCAL_RANK": str(rank)} for rank in range(processes)]
        sizes = {"WORLD_SIZE": str(processes), "LOCAL_WORLD_SIZE": str(processes)}
        yield [stack.enter_context(Program(function, ".", **shared, **sizes, **rank)) for rank in ranks]


def run_together(function, processes=2):
    """Run a function in several processes; return what each printed."""
    with together(function, processes) as programs:
        return [program.wait() for program in programs]
