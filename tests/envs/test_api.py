"""Every id keeps Gymnasium's contract: spaces, metadata, clear errors."""

import pickle
import re
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from helpers import EACH, EACH_OBS, FAMILIES, FAMILY, HASTY, LANES, check_same, make, picture, roll

import memory_gym_envs
from memory_gym_envs.players import player


@EACH_OBS
def test_check_env(env_id, obs_type):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id, obs_type=obs_type).unwrapped)


@EACH_OBS
def test_spaces(env_id, obs_type):
    env, envs = gym.make(env_id, obs_type=obs_type), make(env_id, obs_type=obs_type)
    four, act_only = "Grid" in env_id or env_id == "Endless-MysteryPath-v0", "B-" in env_id
    assert env.action_space == (gym.spaces.Discrete(4) if four else gym.spaces.MultiDiscrete([3, 3]))
    image = gym.spaces.Box(0, 255, (84, 84, 3), np.uint8)
    if obs_type == "vector":
        width = sum(row.width for row in env.unwrapped.batch.variant.entries)
        assert (env.observation_space.shape, env.observation_space.dtype) == ((width,), np.float32)
    elif act_only:
        vector = gym.spaces.Box(0.0, 1.0, (180,), np.float32)
        assert env.observation_space == gym.spaces.Dict(visual_observation=image, vector_observation=vector)
    else:
        assert env.observation_space == image
    assert envs.single_action_space == env.action_space
    assert envs.single_observation_space == env.observation_space
    assert envs.reset(seed=0)[0] in envs.observation_space
    for observations, rewards, terminated, truncated, _ in roll(envs, 60):
        assert observations in envs.observation_space
        assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)
        assert rewards.shape == terminated.shape == truncated.shape == (LANES,)


@EACH
def test_grayscale(env_id):
    """Pictures of one channel that are the luminance of the others, in every observation that a step returns."""
    color, shades = make(env_id), make(env_id, obs_type="grayscale")
    space = shades.single_observation_space
    shown = space["visual_observation"] if isinstance(space, gym.spaces.Dict) else space
    assert (shown.shape, shown.dtype) == ((84, 84, 1), np.uint8)
    single = gym.make(env_id, obs_type="grayscale")
    check_env(single.unwrapped)
    assert single.observation_space == space

    options = HASTY[FAMILY[env_id]]
    seen = [(envs.reset(seed=3, options=options)[0], *roll(envs, 90)) for envs in (color, shades)]
    ends = 0
    check_gray(seen[0][0], seen[1][0])
    for (left, *numbers, infos), (right, *others, their_infos) in zip(seen[0][1:], seen[1][1:], strict=True):
        check_gray(left, right)
        check_same(numbers, others)
        for one, other in zip(infos.get("final_obs", []), their_infos.get("final_obs", []), strict=True):
            if one is not None:
                check_gray(one, other)
                ends += 1
    assert ends > LANES


def check_gray(colored, shades):
    """The second observation is the first one with its picture's luminance, rounded; the rest is the same."""
    luminance = picture(colored) @ np.array([77, 150, 29]) / 256  # 0.299, 0.587, 0.114
    assert np.abs(picture(shades)[..., 0] - luminance).max() <= 0.5
    if isinstance(colored, dict):
        check_same(colored["vector_observation"], shades["vector_observation"])


@EACH
def test_metadata(env_id):
    fps = {"MortarMayhem-Grid-v0": 6, "MortarMayhemB-Grid-v0": 1, "MysteryPath-Grid-v0": 3}.get(env_id, 25)
    env, envs = gym.make(env_id), make(env_id)
    for each in (env, envs):
        assert each.metadata["render_modes"] == ["rgb_array", "debug_rgb_array"]
        assert each.metadata["render_fps"] == fps
    # TorchRL's GymWrapper asks for the attribute, Gymnasium's wrappers for the metadata.
    assert envs.metadata["autoreset_mode"] is envs.autoreset_mode is AutoresetMode.SAME_STEP
    assert envs.spec.id == env_id


def test_ids():
    assert set(memory_gym_envs.IDS) >= {
        "MortarMayhem-v0",
        "MortarMayhem-Grid-v0",
        "MortarMayhemB-v0",
        "MortarMayhemB-Grid-v0",
        "Endless-MortarMayhem-v0",
        "MysteryPath-v0",
        "MysteryPath-Grid-v0",
        "Endless-MysteryPath-v0",
        "SearingSpotlights-v0",
        "Endless-SearingSpotlights-v0",
    }
    assert all(env_id in gym.registry for env_id in memory_gym_envs.IDS)


@EACH
def test_two_branches_as_one_number(env_id):
    """Nine actions, all of which are played; ids with one branch keep theirs."""
    two, one = make(env_id, obs_type="vector"), make(env_id, obs_type="vector", action_type="discrete")
    assert one.single_action_space == gym.make(env_id, action_type="discrete").action_space
    if isinstance(two.single_action_space, gym.spaces.Discrete):
        assert (one.action_space, one.arguments) == (two.action_space, two.arguments)
        return
    assert one.single_action_space == gym.spaces.Discrete(9)
    check_same(two.reset(seed=3), one.reset(seed=3))
    for step in range(36):
        actions = np.array([divmod((step + lane) % 9, 3) for lane in range(LANES)])
        check_same(two.step(actions), one.step(actions @ [3, 1]))
        check_same(player(two) @ [3, 1], player(one))
    with pytest.raises(ValueError, match=r"integers from 0 to 8 of shape \(4,\)"):
        one.step(actions)
    with pytest.raises(ValueError, match="action_type"):
        two.set_state(one.get_state())


# ---- wrong arguments and actions ----


@FAMILIES
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render_mode": "ansi"}, "render_mode"),
        ({"obs_type": "pixel"}, "obs_type"),
        ({"action_type": "multi"}, "action_type must be 'native' or 'discrete', not 'multi'"),
        ({"num_levels": -1}, "num_levels"),
        ({"num_levels": 1.5}, "num_levels"),
        ({"num_levels": False}, "num_levels"),
        ({"num_levels": 2**63}, "num_levels must be an integer from 0 to 9223372036854775807"),
        ({"start_level": -1}, "start_level"),
        ({"start_level": "a"}, "start_level"),
        ({"num_envs": 0}, "num_envs"),
        ({"num_envs": 2.0}, "num_envs"),
        ({"variant": "Nothing-v9"}, "variant must be one of .*-v0, .*Nothing-v9"),
    ],
)
def test_wrong_arguments(env_id, arguments, message):
    with pytest.raises(ValueError, match=message) as error:
        FAMILY[env_id](**{"variant": env_id, **arguments})
    assert "\n" not in str(error.value)


@FAMILIES
@pytest.mark.parametrize("seed", [-1, 1.5, "a", [1, 2], [1, 2, 3, -4], True, np.array(1.5), np.ones((4, 2))])
def test_wrong_seeds(env_id, seed):
    envs, env = make(env_id), gym.make(env_id).unwrapped
    envs.reset(seed=0)
    before = pickle.dumps(envs)
    for each in (envs, env):
        with pytest.raises(ValueError, match="seed"):
            each.reset(seed=seed)
    assert pickle.dumps(envs) == before


@FAMILIES
@pytest.mark.parametrize("mask", [[1, 0, 0, 0], [[1], [1, 2]], np.zeros(4, bool), np.ones(3, bool), None])
def test_wrong_reset_mask(env_id, mask):
    envs = make(env_id)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask"):
        envs.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="reset_mask"):
        gym.make(env_id).reset(options={"reset_mask": np.ones(1, bool)})


@FAMILIES
def test_first_reset_holds_every_lane(env_id):
    with pytest.raises(ValueError, match="reset_mask"):
        make(env_id).reset(options={"reset_mask": np.array([True, False, True, True])})


@EACH
def test_wrong_actions(env_id):
    env, envs = gym.make(env_id), make(env_id)
    env.reset(seed=0)
    envs.reset(seed=0)
    right = np.zeros_like(envs.action_space.sample())
    before = pickle.dumps(envs)
    for wrong in (right - 1, right + 4, right.astype(float), right[:-1], right[None], None, "ab", [[1], [1, 2]], True):
        with pytest.raises(ValueError, match="actions must be integers from 0 to"):
            envs.step(wrong)
    for wrong in (right[0] - 1, right[0] + 4, right[0] + 0.5, right[:2], None, [1, [2]], [1, 1, 1]):
        with pytest.raises(ValueError, match=re.escape(f"{env_id}: the action must be in {env.action_space}, not ")):
            env.step(wrong)
    assert pickle.dumps(envs) == before
    for fine in (right, right.tolist(), right.astype(np.int8), right.astype(np.uint64)):
        envs.step(fine)
    env.step(right[0].tolist())
    env.step(right[:1])


@EACH
def test_reset_needed(env_id):
    env, envs = gym.make(env_id).unwrapped, make(env_id, render_mode="rgb_array")
    for each in (env, envs):
        with pytest.raises(gym.error.ResetNeeded):
            each.step(each.action_space.sample())
    with pytest.raises(gym.error.ResetNeeded):
        envs.render()
    env.reset(seed=0, options=HASTY[FAMILY[env_id]])
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        over = terminated or truncated
    assert set(info) > {"reward", "length", "ground_truth"}
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.reset()
    env.step(env.action_space.sample())


ALONE = """
import sys

class OnlyThese:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        ours = {"memory_gym_envs", "numpy", "gymnasium", "cloudpickle", "farama_notifications", "typing_extensions"}
        if top not in ours | sys.stdlib_module_names:
            raise ImportError(f"{top} is not to be imported")

sys.meta_path.insert(0, OnlyThese())
import gymnasium
import memory_gym_envs
for env_id in memory_gym_envs.IDS:
    envs = gymnasium.make_vec(env_id, num_envs=2)
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
print([name for name in ("pygame", "torch", "memory_gym") if name in sys.modules])
try:
    import torch
except ImportError:
    print("made without it")
"""


def test_needs_numpy_and_gymnasium_only():
    folder = Path(memory_gym_envs.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, cwd=folder)
    assert (done.stdout, done.stderr, done.returncode) == ("[]\nmade without it\n", "", 0)
