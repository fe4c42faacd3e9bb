"""What programs say in one line of input that they cannot work with, instead of a traceback."""

from pathlib import Path

import pytest
from programs import run_command

ROOT = Path(__file__).parents[1]
FULL = "--suite full --report --agents GRU"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "benchmarks/bounds.py --levels 1001",
            "--levels must be 1 to 1000, --max-steps 1 or more; they are 1001, 10000",
        ),
        ("benchmarks/bounds.py --max-steps 0", "--max-steps 1 or more; they are 1000, 0"),
        ("benchmarks/env_fps.py --seconds nan", "--seconds, --num-envs and --many-envs must be positive"),
        ("benchmarks/env_fps.py --seconds inf", "--seconds, --num-envs and --many-envs must be positive"),
        ("benchmarks/frontier.py --out maps.xyz", "Format 'xyz' is not supported"),
        ("benchmarks/fuzz_original.py --seed -1", "--seed and --first must be 0 or more"),
        ("benchmarks/fuzz_original.py --original /bin/true", "/bin/true needs memory-gym 1.0.3 or 1.0.2; it has none"),
        (
            f"benchmarks/learning.py {FULL} --results {ROOT}/benchmarks/results --out curves.xyz",
            "'xyz' is not supported",
        ),
        ("benchmarks/train_sps.py --chunks 0", "--chunks is 0; give sizes of 1 frame or more"),
        ("benchmarks/train_sps.py --chunks", "--chunks is empty; give sizes of 1 frame or more"),
        ("benchmarks/train_sps.py --env-id CartPole-v1", "choose an environment and flags with images"),
        ("benchmarks/train_sps.py --script ppo_trxl --without packed_gru", "ppo_trxl has no packed_gru; leave it out"),
        ("benchmarks/trxl_cost.py --windows 0", "--trxl-memory-length is 0; it must be 1 or more"),
        (f"check_memory.py {ROOT}/ppo_gru.py --trunk-size 9999999999", "does not fit in the memory of cpu"),
        ("check_memory.py ppo_bare.py", "the script ppo_bare.py has no Args; give one such as ppo_gru.py"),
        ("check_memory.py ppo_half.py", "the script ppo_half.py has no Agent; give one such as ppo_gru.py"),
    ],
)
def test_one_line(tmp_path, line, message):
    (tmp_path / "ppo_bare.py").touch()
    (tmp_path / "ppo_half.py").write_text("class Args: ...")
    program, *flags = line.split()
    done = run_command(ROOT / program, *flags, folder=tmp_path)
    assert done.returncode
    assert message in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
