"""Ids with and without namespace; another package, as the original, may register the same bare ids."""

import inspect
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from helpers import EACH, FAMILY, check_same

import memory_gym_envs
from memory_gym_envs import MemoryGymEnv, MemoryGymVectorEnv, MysteryPath

OTHERS = """
import gymnasium as gym
{first}
for env_id in {ids}:
    gym.register(env_id, "gymnasium.envs.classic_control.cartpole:CartPoleEnv")
{last}
for env_id in {ids}:
    name = "memory_gym_envs/" + env_id
    print(type(gym.make(name).unwrapped.batch) is type(gym.make_vec(name, num_envs=2)))
"""


@EACH
def test_both_names_are_the_same(env_id):
    name = f"memory_gym_envs/{env_id}"
    check_same(gym.make(name).reset(seed=3), gym.make(env_id).reset(seed=3))
    envs = gym.make_vec(name, num_envs=2)
    check_same(envs.reset(seed=3), gym.make_vec(env_id, num_envs=2).reset(seed=3))
    assert (envs.spec.id, envs.variant_id) == (name, env_id)


@pytest.mark.parametrize("order", ["first", "last"])
def test_other_packages_may_take_the_bare_ids(order):
    """The single environments of the namespace are ours, too, and so are their batches."""
    code = {"first": "", "last": "", order: "import memory_gym_envs"}
    text = OTHERS.format(ids=memory_gym_envs.IDS, **code)
    folder = Path(memory_gym_envs.__file__).parents[1]
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", text], capture_output=True, text=True, cwd=folder)
    assert done.stdout.split() == ["True"] * len(memory_gym_envs.IDS), done.stderr


# ---- what an environment tells of itself ----


@EACH
def test_docstring_and_signature(env_id):
    env = gym.make(env_id).unwrapped
    assert isinstance(env, MemoryGymEnv)
    for text in (env.__doc__, type(env).__doc__, FAMILY[env_id].__doc__):
        assert env_id in text
        for heading in ("Description", "Action Space", "Observation Space", "Rewards", "Episode End", "Arguments"):
            assert f"## {heading}\n" in text
        assert "## Version History\n" in text
        assert "| 0 " in text
    names = [*inspect.signature(type(env)).parameters]
    assert names == ["variant", "render_mode", "num_levels", "start_level", "obs_type", "options", "action_type"]


EVERYTHING = "variants, spaces, allocate, begin, advance, vectors, frames, ground_truth, summary"


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (MemoryGymEnv, r"gym.make\(id\) makes an environment: MemoryGymEnv lacks family"),
        (type("Single", (MemoryGymEnv,), {}), "Single lacks family"),
        (MemoryGymVectorEnv, rf"gym.make_vec\(id\) makes an environment: MemoryGymVectorEnv lacks {EVERYTHING}$"),
        (type("Half", (MemoryGymVectorEnv,), {"variants": MysteryPath.variants}), "Half lacks spaces, allocate, begin"),
    ],
)
def test_classes_of_no_environment(kind, message):
    with pytest.raises(TypeError, match=message) as error:
        kind("MysteryPath-v0")
    assert "\n" not in str(error.value)


def test_wrong_argument_of_a_single_environment():
    with pytest.raises(TypeError, match="unexpected keyword argument 'levels'"):
        gym.make("MysteryPath-v0", levels=3)
