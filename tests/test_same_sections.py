"""The algorithm stands in each script, so what they share stands in both: this holds the copies together."""

import re
from pathlib import Path

import ppo_gru
import ppo_trxl
from ppo_utils.flags import RunArgs

BANNER = re.compile(r"^# ---- (\d .+) ----$", re.MULTILINE)
SHARED = ("2 TRAINING", "3 PPO", "5 AGENT", "6 MAIN")
OWN = ("1 ARGS", "4 MEMORY")


def sections(script):
    _, *parts = BANNER.split(Path(script.__file__).read_text())
    return dict(zip(parts[::2], parts[1::2], strict=True))


def test_shared_sections_are_the_same_to_the_byte():
    gru, trxl = sections(ppo_gru), sections(ppo_trxl)
    assert list(gru) == list(trxl) == sorted([*SHARED, *OWN])
    for name in SHARED:
        assert gru[name] == trxl[name], name


def test_what_is_shared_of_the_other_sections():
    gru, trxl = sections(ppo_gru)["1 ARGS"], sections(ppo_trxl)["1 ARGS"]
    gain = "    value_init_gain: NonNegativeFloat = {}\n"  # a small one helps the transformer and harms the GRU
    assert gain.format(1.0) in gru
    gru = gru.replace(gain.format(1.0), gain.format(0.01))
    begin = "    total_timesteps: PositiveInt"
    shared = gru[gru.index(begin) : gru.index("    memory: Literal")]
    assert shared == trxl[trxl.index(begin) : trxl.index("    trxl_num_layers:")]
    interface = [sections(script)["4 MEMORY"].partition("\n@dataclass")[0] for script in (ppo_gru, ppo_trxl)]
    assert interface[1].startswith(interface[0])


def test_flags_differ_in_the_memory_alone():
    gru, trxl = (list(script.Args.__dataclass_fields__) for script in (ppo_gru, ppo_trxl))
    shared = [name for name in gru if name in trxl]
    assert gru == [*shared, "memory", "hidden_size", "num_layers", "seq_len"]
    assert [name for name in trxl if not name.startswith("trxl_")] == shared
    defaults = [{name: getattr(script.Args(), name) for name in shared} for script in (ppo_gru, ppo_trxl)]
    assert defaults[0] == {**defaults[1], "exp_name": "ppo_gru", "value_init_gain": 1.0}
    assert (defaults[1]["exp_name"], defaults[1]["value_init_gain"]) == ("ppo_trxl", 0.01)


def test_flags_of_the_run_are_read_by_no_line_of_a_script():
    """And those that a script reads stand in it."""
    for script in (ppo_gru, ppo_trxl):
        text = Path(script.__file__).read_text()
        assert not [name for name in RunArgs.__dataclass_fields__ if f"args.{name}" in text]
