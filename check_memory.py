"""Check the memory of an agent that `ppo_gru.py`, `ppo_trxl.py` or a copy of either would train.

    python check_memory.py ppo_gru.py --preset laptop --memory lstm

The script's flags follow its name; the agent is untrained and observes a vector. Prints a line for each check, and ends
with 1 if there is a fault. Agents of other packages: docs/check_your_memory.md.
"""

import argparse
import importlib
import re
import sys
from pathlib import Path

import torch

from ppo_utils.checkpoints import SCRIPT_NAME
from ppo_utils.errors import RunError
from ppo_utils.flags import check_bounds
from ppo_utils.memory_adapters import ScriptAdapter
from ppo_utils.memory_check import check
from ppo_utils.runs import parse_args, report_out_of_memory
from ppo_utils.terminal import one_line_exit, open_streams


def main() -> int:
    """Check what the command line says.

    Raises ValueError, OSError, ImportError or RunError for a script or flags that make no agent.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("script", help="a script, ppo_NAME.py")
    parser.add_argument("flags", nargs=argparse.REMAINDER, help="its flags")
    given = parser.parse_args()
    path = Path(given.script).resolve()
    if not path.is_file():
        raise ValueError(f"there is no {given.script}; give a script, such as ppo_gru.py")
    if not re.fullmatch(SCRIPT_NAME, path.stem):
        raise ValueError(f"the script {given.script} must be named ppo_NAME.py")
    sys.path.insert(0, str(path.parent))  # before this folder, which may have a script of the same name
    script = importlib.import_module(path.stem)
    if lacks := [name for name in ("Args", "Agent") if not hasattr(script, name)]:
        raise ValueError(f"the script {given.script} has no {lacks[0]}; give one such as ppo_gru.py")
    args = parse_args(script.Args, getattr(script, "PRESETS", {}), given.flags)
    check_bounds(args)
    torch.manual_seed(args.seed)
    with report_out_of_memory(args, torch.device("cpu")):
        adapter = ScriptAdapter(script, args)
        try:
            report = check(adapter)
        except (ValueError, OSError, ImportError) as error:  # the memory's own: with its traceback
            raise AssertionError(f"{given.script} has an error") from error
    print(report)
    return bool(report.failed)


if __name__ == "__main__":
    open_streams()
    with one_line_exit(ValueError, OSError, ImportError, RunError):
        sys.exit(main())
