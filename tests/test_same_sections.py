"""The scripts are self-contained, so what they share stands in both: this holds the copies together."""

import inspect
import re
from pathlib import Path

import ppo_gru
import ppo_trxl

BANNER = re.compile(r"^# ---- (\d .+) ----$", re.MULTILINE)
SHARED = ("2 PPO", "3 ENCODERS AND HEADS", "5 AGENT", "6 TRAINING", "7 EVALUATION", "8 RUNNING")
OWN = ("1 ARGS", "4 MEMORY", "9 FAST PATHS")


def sections(script):
    _, *parts = BANNER.split(Path(script.__file__).read_text())
    return dict(zip(parts[::2], parts[1::2], strict=True))


def test_shared_sections_are_the_same_to_the_byte():
    gru, trxl = sections(ppo_gru), sections(ppo_trxl)
    assert list(gru) == list(trxl) == sorted([*SHARED, *OWN])
    for name in SHARED:
        assert gru[name] == trxl[name], name


def test_what_is_shared_of_the_other_sections():
    for name in ("Bounds", "bounded", "UniqueObservations", "first_occurrences", "in_chunks"):
        assert inspect.getsource(getattr(ppo_gru, name)) == inspect.getsource(getattr(ppo_trxl, name))
    assert ppo_gru.CHUNK == ppo_trxl.CHUNK
    gru, trxl = sections(ppo_gru)["1 ARGS"], sections(ppo_trxl)["1 ARGS"]
    begin = "    preset: Literal"
    shared = gru[gru.index(begin) : gru.index("    memory: Literal")]
    assert shared == trxl[trxl.index(begin) : trxl.index("    trxl_num_layers:")]


def test_flags_differ_in_the_memory_alone():
    gru, trxl = (list(script.Args.__dataclass_fields__) for script in (ppo_gru, ppo_trxl))
    shared = [name for name in gru if name in trxl]
    assert gru == [*shared, "memory", "hidden_size", "num_layers", "seq_len"]
    assert [name for name in trxl if not name.startswith("trxl_")] == shared
    defaults = [{name: getattr(script.Args(), name) for name in shared} for script in (ppo_gru, ppo_trxl)]
    assert defaults[0] == {**defaults[1], "exp_name": "ppo_gru"}
