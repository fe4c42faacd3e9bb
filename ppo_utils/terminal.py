"""Where programs write to: a terminal, a pipe or a file, which may be closed, or gone before the program ends."""

import atexit
import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path


def open_streams() -> None:
    """Open standard streams that are closed (`2>&-`), to nowhere; let the program end with its own exit code.

    Else a file of the training would get the number of such a stream, and what is written there.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115
    atexit.register(drop_unwritten)


def drop_unwritten() -> None:
    """Throw away what cannot be written, as where Ctrl-C has ended `tee` too; Python would exit with code 120."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            with contextlib.suppress(OSError):  # a stream of a program's own, without a number
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def tell(text: str) -> None:
    """Print to stderr; nothing stops because nobody reads it."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr)


@contextlib.contextmanager
def one_line_exit(*errors: type[Exception]) -> Iterator[None]:
    """Exit with one line that begins with the program's name for any of the errors, and with 130 for Ctrl-C."""
    try:
        yield
    except errors as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit(130)
