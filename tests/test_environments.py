"""make_envs: every id, of this package and of others, is what a training script takes."""

import sys
import traceback
import zlib
from collections import OrderedDict
from pathlib import Path

import cue_recall  # noqa: F401 (registers CueRecall-v0)
import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

from memory_gym_envs import IDS, MortarMayhem
from memory_gym_envs.drawing import gray
from ppo_utils import video
from ppo_utils.environments import find_spec, is_memory_gym, make_envs, parse_options
from ppo_utils.infos import final_numbers, final_observations
from ppo_utils.observations import Part
from ppo_utils.video import LaneVideo, check_can_film

LANES = 3
GYMNASIUM = {  # the widths of the vectors that they become
    "CartPole-v1": 4,
    "Acrobot-v1": 6,
    "MountainCar-v0": 2,
    "FrozenLake-v1": 16,
    "FrozenLake8x8-v1": 64,
    "Taxi-v4": 500,
    "CliffWalking-v1": 48,
    "CliffWalkingSlippery-v1": 48,
}
POPGYM = {
    "Battleship": 2,
    "Concentration": 3 * 52,
    "CountRecall": 4,
    "HigherLower": 13,
    "LabyrinthEscape": 50,
    "LabyrinthExplore": 50,
    "MineSweeper": 3,
    "MultiarmedBandit": 2,
    "NoisyPositionOnlyCartPole": 2,
    "PositionOnlyCartPole": 2,
    "RepeatFirst": 4,
    "RepeatPrevious": 4,
    "VelocityOnlyCartpole": 2,
}
MINIGRID = ("S7", "S9", "S11", "S13", "S13Random", "S17Random")
VECTORS = {
    **{env_id: {"observation": width} for env_id, width in GYMNASIUM.items()},
    "Blackjack-v1": {"0": 32, "1": 11, "2": 2},
    "popgym:popgym-AutoencodeEasy-v0": {"0": 2, "1": 4},
    **{f"popgym:popgym-{name}Easy-v0": {"observation": width} for name, width in POPGYM.items()},
    **{f"minigrid:MiniGrid-Memory{name}-v0": {"direction": 4, "image": 7 * 7 * 3} for name in MINIGRID},
}
PICTURES = ("ale_py:ALE/Pong-v5", "ale_py:BreakoutNoFrameskip-v4")
OTHERS = (*VECTORS, *PICTURES)
EVERYTHING = {"frame_stack": 2, "step_encoding": True, "observe_last_action": True}


def needs(env_id):
    """Skip where the package cannot be installed: MiniGrid needs a newer Python than this project."""
    pytest.importorskip(env_id.rpartition(":")[0] or "gymnasium")
    return env_id


class Shows(gym.Env):
    """An environment that shows random observations of a space; episodes are of three steps."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, space, action_space=None, render_mode=None):
        self.observation_space = space
        self.action_space = gym.spaces.Discrete(2) if action_space is None else action_space
        self.render_mode = render_mode

    def look(self):
        self.shown.append(self.observation_space.sample())
        return self.shown[-1]

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps, self.shown, self.taken = 0, [], []
        return self.look(), {}

    def step(self, action):
        assert action in self.action_space
        self.steps += 1
        self.taken.append(action)
        return self.look(), 0.5, self.steps == 3, False, {}


def register(entry_point, **arguments):
    """Register an environment under a new id; return the id."""
    env_id = f"Made{len(gym.registry)}-v0"
    gym.register(env_id, entry_point=entry_point, kwargs=arguments, disable_env_checker=True)
    return env_id


def shows(space, **arguments):
    return register(Shows, space=space, **arguments)


def actions_of(envs, rng):
    return rng.integers(0, envs.single_action_space.nvec, envs.action_space.shape)


def roll(envs, steps, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        yield envs.step(actions_of(envs, rng))


def check_parts(observations, space):
    """Each part is as the space says, to the type, and in one piece of memory."""
    assert set(observations) == set(space)
    for name, part in space.items():
        shown = observations[name]
        assert (shown.dtype, shown.shape[-len(part.shape) :]) == (part.dtype, part.shape)
        assert shown.flags.c_contiguous


# ---- what every id has in common ----


PLAIN = [pytest.param(each, {}, id=f"{each}-plain") for each in (*IDS, *OTHERS)]
# But for the second game, which is as the first one, and slow to make.
ALL = [pytest.param(each, EVERYTHING, id=f"{each}-everything") for each in (*IDS, *OTHERS) if each != PICTURES[1]]


@pytest.mark.parametrize(("env_id", "arguments"), [*PLAIN, *ALL])
def test_every_id_is_what_a_script_takes(env_id, arguments):
    envs = make_envs(needs(env_id), LANES, seed=1, **arguments)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert (envs.num_envs, envs.spec.id) == (LANES, env_id.rpartition(":")[2])
    space, branches = envs.single_observation_space, envs.single_action_space
    assert type(space) is gym.spaces.Dict
    for part in space.values():
        picture = len(part.shape) == 3 and min(part.shape[:2]) >= 36 and part.dtype == np.uint8
        assert picture or (len(part.shape) == 1 and part.dtype == np.float32)
    assert type(branches) is gym.spaces.MultiDiscrete
    assert not branches.start.any()
    assert envs.action_space.shape == (LANES, len(branches.nvec))

    observations, _ = envs.reset()
    assert observations in envs.observation_space
    returns, lengths, counted = np.zeros(LANES), np.zeros(LANES, int), 0
    for observations, rewards, terminated, truncated, infos in roll(envs, 8 if env_id in PICTURES else 60):
        assert observations in envs.observation_space
        check_parts(observations, space)
        returns, lengths, ended = returns + rewards, lengths + 1, terminated | truncated
        assert np.array_equal(infos.get("_episode", np.zeros(LANES, bool)), ended)
        for lane in np.flatnonzero(ended):
            assert infos["final_obs"][lane] in space
            check_parts(infos["final_obs"][lane], space)
            assert (infos["episode"]["r"][lane], infos["episode"]["l"][lane]) == (returns[lane], lengths[lane])
            counted += 1
        returns[ended], lengths[ended] = 0, 0
    assert envs.episode_count == counted
    envs.close()


# POPGym's mazes draw from Python's one global generator, whatever they are seeded with.
SEEDED = [each for each in OTHERS if "Labyrinth" not in each and each != PICTURES[1]]  # one game is as the other


@pytest.mark.parametrize("env_id", ["MortarMayhemB-Grid-v0", *SEEDED])
def test_same_seed_same_episodes(env_id):
    first, again, other = (make_envs(needs(env_id), 2, seed=seed) for seed in (1, 1, 2))
    starts = [envs.reset()[0] for envs in (first, again, other)]
    assert data_equivalence(*starts[:2], exact=True)
    differs = not data_equivalence(*starts[1:], exact=True)
    for left, right, different in zip(
        *(roll(envs, 8 if env_id in PICTURES else 20) for envs in (first, again, other)), strict=True
    ):
        assert data_equivalence(left[:4], right[:4], exact=True)
        differs |= not data_equivalence(left[:4], different[:4], exact=True)
    if env_id not in ("CliffWalking-v1", *PICTURES):  # nothing there is random, or not that soon
        assert differs


@pytest.mark.parametrize("env_id", ["MysteryPath-Grid-v0", "CartPole-v1"])
def test_actions_of_another_shape(env_id):
    envs = make_envs(env_id, 2, seed=1)
    envs.reset()
    for wrong in (np.zeros(2, int), np.zeros((2, 2), int), 0, None):
        with pytest.raises(ValueError, match=r"actions must be integers of shape \(2, 1\), lanes and branches, not "):
            envs.step(wrong)


@pytest.mark.parametrize("env_id", ["Qqqqqqqqqqqq-v0", "Xxxxxxxxxxxx/Qqqqqqqqqqqq-v5"])
def test_an_id_whose_module_is_not_named(env_id):
    with pytest.raises(gym.error.Error, match="say which module registers it: module:id"):
        find_spec(env_id)


@pytest.mark.parametrize("env_id", VECTORS)
def test_vectors_are_as_wide_as_documented(env_id):
    space = make_envs(needs(env_id), 1).single_observation_space
    assert {name: part.shape for name, part in space.items()} == {k: (width,) for k, width in VECTORS[env_id].items()}
    assert list(space) == list(VECTORS[env_id])


@pytest.mark.parametrize("env_id", PICTURES)
def test_atari_pictures_are_as_large_as_they_are(env_id):
    space = make_envs(needs(env_id), 1).single_observation_space
    assert {name: part.shape for name, part in space.items()} == {"observation": (210, 160, 3)}


@pytest.mark.parametrize(("obs_type", "shape"), [("ram", (128,)), ("grayscale", (210, 160, 1))])
def test_other_observations_of_atari(obs_type, shape):
    pytest.importorskip("ale_py")
    env_id = register("ale_py.env:AtariEnv", game="pong", obs_type=obs_type)
    observations = make_envs(env_id, 1).reset(seed=3)[0]["observation"]
    assert observations.shape == (1, *shape)
    assert np.array_equal(observations.reshape(-1), gym.make(env_id).reset(seed=3)[0].reshape(-1))


def test_memory_gym_passes_through_without_a_copy():
    for obs_type in ("pixels", "vector"):
        envs, seen = make_envs("MysteryPath-v0", LANES, seed=0, obs_type=obs_type), []
        observe = envs.unwrapped.observe
        envs.unwrapped.observe = lambda lanes, observe=observe, seen=seen: seen.append(observe(lanes)) or seen[-1]
        assert np.shares_memory(envs.reset()[0]["observation"], seen[-1])
        assert all(np.shares_memory(step[0]["observation"], seen[-1]) for step in roll(envs, 3))


# ---- observations ----


def box(low, high, shape, dtype=np.float32):
    return gym.spaces.Box(low, high, shape, dtype)


@pytest.mark.parametrize(
    "space",
    [
        box(-1, 1, ()),
        box(0, 255, (7, 7, 3), np.uint8),
        box(-np.inf, np.inf, (3,), np.float64),
        box(0, np.inf, (40, 40)),  # a matrix without bounds
        box(-1e10, 1e10, (40, 50)),  # scaled to 0 to 1, it would all be gray
        box(0, 2**16, (40, 50), np.int64),
        gym.spaces.Discrete(5, start=2),
        gym.spaces.MultiDiscrete([[2, 3], [4, 1]]),
        gym.spaces.MultiBinary((2, 2)),
    ],
    ids=str,
)
def test_all_but_pictures_become_gymnasiums_flat_vectors(space):
    envs = make_envs(shows(gym.spaces.Dict({"part": space})), LANES, seed=0)
    flat = gym.spaces.flatten_space(space)
    part = envs.single_observation_space["part"]
    assert (part.shape, part.dtype) == (flat.shape, np.float32)
    assert np.array_equal(part.low, flat.low.astype(np.float32))

    def last(shown):
        return [gym.spaces.flatten(space, each[-1]["part"]).astype(np.float32) for each in shown]

    observations, steps = envs.reset()[0], roll(envs, 3)
    for _ in range(3):
        shown = [each.unwrapped.shown for each in envs.unwrapped.envs]  # the reset makes a new list
        assert np.array_equal(observations["part"], last(shown))
        observations, *_, infos = next(steps)
    assert np.array_equal([final["part"] for final in infos["final_obs"]], last(shown))


@pytest.mark.parametrize(
    ("space", "shape", "dtype", "moved"),
    [
        (box(0, 255, (40, 50), np.uint8), (40, 50, 1), np.uint8, lambda shown: shown[..., None]),
        (box(0, 255, (40, 50, 3), np.uint8), (40, 50, 3), np.uint8, lambda shown: shown),
        (box(0, 255, (4, 40, 50), np.uint8), (40, 50, 4), np.uint8, lambda shown: shown.transpose(1, 2, 0)),
        (box(0, 1, (36, 36, 3), np.float64), (36, 36, 3), np.float32, lambda shown: shown.astype(np.float32)),
        (box(0, 1, (36, 36)), (36, 36, 1), np.float32, lambda shown: shown[..., None]),
    ],
    ids=["gray", "colour", "channels first", "float64", "gray floats"],
)
def test_pictures_get_height_width_and_channels(space, shape, dtype, moved):
    envs = make_envs(shows(space), LANES, seed=0)
    part = envs.single_observation_space["observation"]
    assert (part.shape, part.dtype, list(envs.single_observation_space)) == (shape, dtype, ["observation"])
    assert (part.low.max(), part.high.min()) == (0, 255 if dtype == np.uint8 else 1)
    observations, steps = envs.reset()[0], roll(envs, 3)
    for _ in range(2):
        last = [moved(each.unwrapped.shown[-1]) for each in envs.unwrapped.envs]
        check_parts(observations, envs.single_observation_space)
        assert np.array_equal(observations["observation"], last)
        observations = next(steps)[0]
    ending = [each.unwrapped.shown for each in envs.unwrapped.envs]  # the reset makes a new list
    infos = next(steps)[-1]
    for lane in range(LANES):
        assert np.array_equal(infos["final_obs"][lane]["observation"], moved(ending[lane][-1]))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.int32, np.int64])
def test_the_largest_numbers_of_a_type_are_no_bounds(dtype):
    largest = np.finfo(dtype).max if np.issubdtype(dtype, np.floating) else np.iinfo(dtype).max
    assert Part.of((), box(-largest, largest, (40, 50), dtype)).axes is None
    with pytest.raises(ValueError, match=r"use images .* with bounds at most 65,535 apart"):
        Part.of((), box(-largest, largest, (40, 50, 3), dtype))


@pytest.mark.parametrize("dtype", [np.float16, np.uint16, np.int32, np.float64])
def test_images_of_all_types_are_scaled_from_their_bounds(dtype):
    """In float16, the difference of the bounds would be infinite."""
    low, high = (0, 65_535) if dtype == np.uint16 else (-32_016, 33_504)
    part = Part.of(("observation",), box(low, high, (40, 50), dtype))
    values = np.full((2, 40, 50), high, dtype)
    values[0, 0, 0] = low
    found = part.convert(values)
    assert found.dtype == np.float32
    assert (found[0, 0, 0, 0], found[0, 0, 1, 0], found[1].min()) == pytest.approx((0, 1, 1), abs=1e-3)


def test_parts_keep_their_names_and_their_order():
    space = gym.spaces.Dict(OrderedDict(zoo=box(0, 1, (2,)), ape=gym.spaces.Discrete(3), more=box(0, 1, (1,))))
    env_id = shows(space)
    assert list(make_envs(env_id, 2).single_observation_space) == ["zoo", "ape", "more"]
    # Where a wrapper adds or changes parts, Gymnasium sorts them.
    both = {"step_encoding": True, "observe_last_action": True}
    names = ["ape", "last_action", "more", "step_encoding", "zoo"]
    assert list(make_envs(env_id, 2, **both).single_observation_space) == names
    assert list(make_envs("MortarMayhemB-v0", 1).single_observation_space) == [
        "vector_observation",
        "visual_observation",
    ]


def test_text_is_left_out_and_a_line_says_so(capfd):
    space = gym.spaces.Dict({"mission": gym.spaces.Text(5), "seen": gym.spaces.Discrete(2)})
    envs = make_envs(shows(space), 2, seed=0)
    assert list(envs.reset()[0]) == ["seen"]
    assert capfd.readouterr().err == f"{envs.spec.id}: the text mission is left out of the observation\n"


def test_what_a_memory_gym_environment_shows():
    assert make_envs("MysteryPath-v0", 1).single_observation_space["observation"].shape == (84, 84, 3)
    vector = make_envs("MysteryPath-v0", 1, obs_type="vector").single_observation_space["observation"]
    assert vector == gym.make("MysteryPath-v0", obs_type="vector").observation_space
    assert make_envs("CartPole-v1", 1, obs_type="vector").single_observation_space["observation"].shape == (4,)


def test_stacks_of_gray_pictures_and_of_several_vectors():
    gray_id = shows(box(0, 255, (40, 50), np.uint8))
    plain, stacked = make_envs(gray_id, 2, seed=0), make_envs(gray_id, 2, seed=0, frame_stack=3)
    first = plain.reset()[0]["observation"]
    assert np.array_equal(stacked.reset()[0]["observation"], first.repeat(3, -1))
    second = next(roll(plain, 1))[0]["observation"]
    assert np.array_equal(next(roll(stacked, 1))[0]["observation"], np.concatenate([first, first, second], -1))

    mixed_id = shows(gym.spaces.Dict({"a": gym.spaces.Discrete(3), "b": box(0, 1, (2,))}))
    plain, stacked = make_envs(mixed_id, 2, seed=0), make_envs(mixed_id, 2, seed=0, frame_stack=2)
    first, both = plain.reset()[0], stacked.reset()[0]
    second, then = next(roll(plain, 1))[0], next(roll(stacked, 1))[0]
    for name in first:
        assert np.array_equal(both[name], np.concatenate([first[name], first[name]], -1))
        assert np.array_equal(then[name], np.concatenate([first[name], second[name]], -1))


def test_spotlight_perturbation_comes_before_the_stack():
    envs = make_envs("MysteryPath-v0", LANES, seed=0, spotlight_perturbation=True, frame_stack=2)
    under = make_envs("MysteryPath-v0", LANES, seed=0, spotlight_perturbation=True)
    bare = make_envs("MysteryPath-v0", LANES, seed=0)
    shown, perturbed, clear = (each.reset()[0]["observation"] for each in (envs, under, bare))
    assert np.array_equal(shown[..., -1], gray(perturbed))
    assert not np.array_equal(perturbed, clear)


# ---- actions ----


@pytest.mark.parametrize(
    ("space", "sizes", "sent", "taken"),
    [
        (gym.spaces.Discrete(3, start=4), [3], [[0], [2]], [4, 6]),
        (gym.spaces.MultiDiscrete([2, 3], start=[1, -1]), [2, 3], [[0, 0], [1, 2]], [[1, -1], [2, 1]]),
    ],
    ids=str,
)
def test_actions_are_branches_from_zero(space, sizes, sent, taken):
    envs = make_envs(shows(box(0, 1, (1,)), action_space=space), 2, seed=0)
    assert envs.single_action_space == gym.spaces.MultiDiscrete(sizes)
    envs.reset()
    envs.step(np.array(sent))
    assert [np.array(each.unwrapped.taken[-1]).tolist() for each in envs.unwrapped.envs] == taken


@pytest.mark.parametrize("env_id", ["MortarMayhemB-Grid-v0", "MortarMayhemB-v0", "popgym:popgym-BattleshipEasy-v0"])
def test_the_last_action_and_reward_are_observed(env_id):
    envs, bare = (make_envs(needs(env_id), LANES, seed=1, observe_last_action=given) for given in (True, False))
    sizes = envs.single_action_space.nvec
    assert envs.single_observation_space["last_action"].shape == (sizes.sum() + 1,)
    observations, plain = envs.reset()[0], bare.reset()[0]
    assert not observations.pop("last_action").any()
    assert data_equivalence(observations, plain, exact=True)
    rng, episodes = np.random.default_rng(0), 0
    for _ in range(120):
        actions = actions_of(envs, rng)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        plain, _, _, _, plain_infos = bare.step(actions)
        hot = [np.concatenate([np.eye(n)[a] for n, a in zip(sizes, lane, strict=True)]) for lane in actions]
        expected = np.column_stack([hot, rewards]).astype(np.float32)
        ended = terminated | truncated
        for lane in np.flatnonzero(ended):
            last = infos["final_obs"][lane]
            assert np.array_equal(last.pop("last_action"), expected[lane])
            assert data_equivalence(last, plain_infos["final_obs"][lane], exact=True)
            episodes += 1
        expected[ended] = 0
        assert np.array_equal(observations.pop("last_action"), expected)
        assert data_equivalence(observations, plain, exact=True)
    assert episodes >= LANES


# ---- seeds and statistics ----

RECORDED = [  # by the code before this module was taken apart, with seeds of 30 bits
    ("MysteryPath-Grid-v0", {"obs_type": "vector", "frame_stack": 4}, None, 26885007, 3, [128] * 3, 384, 0.0),
    (
        "MortarMayhemB-Grid-v0",
        {"step_encoding": True, "num_levels": 1000, "start_level": 7},
        {"command_count": [2]},
        *(3905382548, 76, [7, 7, 7, 7, 15], 592, 1.2),
    ),
    (
        "Endless-SearingSpotlights-v0",
        {"frame_stack": 2, "num_levels": 5},
        None,
        *(3442857501, 4, [80, 141, 160, 36], 417, 0.25),
    ),
    ("CueRecall-v0", {}, None, 2690902996, 44, [12, 13, 14, 12, 13], 578, 24.5),
    ("CartPole-v1", {"frame_stack": 3}, None, 4030354784, 22, [12, 21, 28, 28, 25], 569, 569.0),
]


@pytest.mark.parametrize(("env_id", "arguments", "options", "checksum", *"npqr"), RECORDED)
def test_episodes_are_the_recorded_ones(env_id, arguments, options, checksum, n, p, q, r):
    """Observations to the bit, final ones too, and the returns and lengths of episodes in their order."""
    envs, found, returns, lengths = make_envs(env_id, LANES, seed=11, options=options, **arguments), 0, [], []

    def take(observations):
        nonlocal found
        for name in sorted(set(observations) - {"step_encoding"}):
            found = zlib.crc32(observations[name].tobytes(), found)

    take(envs.reset(options=options)[0])
    for observations, _, terminated, truncated, infos in roll(envs, 200):
        take(observations)
        ended = terminated | truncated
        if ended.any():
            take(final_observations(observations, infos, ended))
            returns += infos["episode"]["r"][ended].tolist()
            lengths += infos["episode"]["l"][ended].tolist()
    assert (found, len(lengths), lengths[:5], sum(lengths), sum(returns)) == (checksum, n, p, q, r)


def test_neighbouring_seeds_share_no_lane_and_levels_are_the_training_s():
    seeds = [make_envs("MysteryPath-v0", 8, seed=seed).unwrapped.np_random_seed for seed in (1, 2)]
    assert len({*seeds[0], *seeds[1]}) == 16
    envs = make_envs("MysteryPath-v0", 8, seed=1, num_levels=3, start_level=10)
    assert set(envs.np_random_seed).isdisjoint({10, 11, 12})  # the seed builds a level of its own,
    envs.reset()
    assert set(envs.np_random_seed) <= {10, 11, 12}  # which is not played


LARGER_SETS = [
    ("MysteryPath-Grid-v0", {"num_levels": 5, "start_level": 3, "spotlight_perturbation": True}),
    ("MortarMayhemB-Grid-v0", {"num_levels": 1000, "obs_type": "vector"}),
    ("Endless-SearingSpotlights-v0", {"num_levels": 7}),
    ("CartPole-v1", {}),
    ("CueRecall-v0", {}),
]


# A seed of several numbers: for a batch of this package, and for Gymnasium's single environments.
LANES_AND_SEEDS = [(*each, 7) for each in LARGER_SETS] + [(*LARGER_SETS[0], (7, 3)), (*LARGER_SETS[3], (7, 3))]


@pytest.mark.parametrize(("env_id", "arguments", "seed"), LANES_AND_SEEDS)
def test_lanes_of_a_larger_set(env_id, arguments, seed):
    """Seeds, levels, observations, rewards and ends are those of these lanes, through many automatic resets."""
    whole = make_envs(env_id, 6, seed=seed, **arguments, **EVERYTHING)
    part = make_envs(env_id, 4, seed=seed, first_lane=2, **arguments, **EVERYTHING)
    seeds, ends = set(), 0
    assert whole.unwrapped.np_random_seed[2:] == part.unwrapped.np_random_seed
    starts = [envs.reset()[0] for envs in (whole, part)]
    assert data_equivalence({name: values[2:] for name, values in starts[0].items()}, starts[1], exact=True)
    rng = np.random.default_rng(0)
    for _ in range(300):
        actions = actions_of(whole, rng)
        observations, *numbers, infos = whole.step(actions)
        theirs, *their_numbers, their_infos = part.step(actions[2:])
        assert data_equivalence({name: values[2:] for name, values in observations.items()}, theirs, exact=True)
        assert data_equivalence([values[2:] for values in numbers], their_numbers, exact=True)
        assert whole.unwrapped.np_random_seed[2:] == part.unwrapped.np_random_seed
        seeds.update(part.unwrapped.np_random_seed)
        ended = their_numbers[1] | their_numbers[2]
        for lane in np.flatnonzero(ended):
            assert data_equivalence(infos["final_obs"][2 + lane], their_infos["final_obs"][lane], exact=True)
            ends += 1
    assert ends > 4
    assert len(seeds) >= 4


def test_several_seeds():
    one, same, other = (make_envs("MysteryPath-v0", 3, seed=seed).unwrapped.np_random_seed for seed in (7, [7], [7, 1]))
    assert one == same
    assert set(one).isdisjoint(other)


def test_without_a_seed_the_caller_chooses_the_levels():
    envs = make_envs("MortarMayhemB-Grid-v0", 2)
    envs.reset(seed=[5, 9], options={"command_count": [3]})
    assert envs.np_random_seed == (5, 9)
    assert envs.unwrapped.settings[0]["command_count"] == (3,)


def test_numbers_of_the_final_infos():
    envs = make_envs("MortarMayhemB-Grid-v0", LANES, seed=0)
    envs.reset()
    ends = 0
    for *_, terminated, truncated, infos in roll(envs, 30):
        found = final_numbers(infos, terminated | truncated)
        if (terminated | truncated).any():
            assert found.keys() == {"reward", "length", "carried_out"}, "without those that count a failed command"
            assert np.array_equal(np.isfinite(found["length"]), infos["_episode"])
            assert np.array_equal(found["length"][infos["_episode"]], infos["episode"]["l"][infos["_episode"]])
            ends += 1
        else:
            assert not found
    assert ends


def test_only_numbers_of_the_lanes_that_have_them():
    lanes, all_of_them = np.array([True, True, False]), np.ones(3, bool)
    final = {"score": np.array([1.0, 2.0, 3.0]), "_score": np.array([True, False, True])}
    final |= {"name": np.array(["a", "b", "c"], object), "_name": all_of_them}
    final |= {"table": np.zeros((3, 2)), "_table": all_of_them, "nested": {"x": 1}, "_nested": all_of_them}
    ((name, values),) = final_numbers({"final_info": final}, lanes).items()
    assert name == "score"
    np.testing.assert_equal(values, [1.0, np.nan, np.nan])


def test_names_of_numbers_are_texts():
    final = {3: np.array([1.0, 2.0]), "_3": np.array([True, True])}
    assert list(final_numbers({"final_info": final}, np.ones(2, bool))) == ["3"]


def test_final_observations_leave_the_others_alone():
    observations = {"observation": np.zeros((3, 2), np.float32)}
    last = np.array([None, {"observation": np.ones(2, np.float32)}, {"observation": np.ones(2, np.float32)}])
    found = final_observations(observations, {"final_obs": last}, np.array([False, True, False]))
    assert found["observation"].tolist() == [[0, 0], [1, 1], [0, 0]]
    assert not observations["observation"].any()


# ---- pictures and videos ----


def test_memory_gym_draws_in_both_modes():
    envs = make_envs("MysteryPath-v0", 2, seed=0, render_mode="debug_rgb_array")
    assert [frame.shape for frame in envs.render()] == [(336, 336, 3)] * 2
    assert np.array_equal(envs.unwrapped.render(np.array([1]))[0], envs.render()[1])
    envs.unwrapped.render_mode = "rgb_array"
    assert [frame.shape for frame in envs.render()] == [(84, 84, 3)] * 2


def filmed(env_id, num_envs, folder, options=None):
    """Environments whose first episodes have begun and are being recorded."""
    check_can_film(env_id)
    envs = make_envs(env_id, num_envs, render_mode="debug_rgb_array")
    envs.reset(seed=0, options=options)
    return LaneVideo(envs, str(folder))


def frames_of(folder):
    """The videos in the folder by name, and how many frames each has."""
    return {path.name: imageio_ffmpeg.count_frames_and_secs(str(path))[0] for path in Path(folder).glob("*.mp4")}


def test_videos_are_of_whole_episodes_of_lane_0(tmp_path, recwarn, capfd, monkeypatch):
    drawn, annotate = [], MortarMayhem.annotate
    monkeypatch.setattr(MortarMayhem, "annotate", lambda *given: (drawn.append(given[2]), annotate(*given)))
    envs = filmed("MortarMayhemB-Grid-v0", LANES, tmp_path)
    infos_of_ends = [step[-1] for step in roll(envs, 40) if (step[2] | step[3])[0]]
    lengths = [infos["episode"]["l"][0] for infos in infos_of_ends[:2]]
    envs.close()
    assert frames_of(tmp_path) == dict(zip(("episode-0.mp4", "episode-1.mp4"), lengths, strict=True))
    assert len(infos_of_ends) < 8  # the next one to be filmed
    assert drawn == [0] * sum(lengths)
    assert not recwarn.list
    assert capfd.readouterr() == ("", "")


def test_an_endless_episode_has_a_video_too(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "MAX_VIDEO_FRAMES", 10)
    for steps, expected in ((5, 5), (25, 10)):
        envs = filmed("Endless-MortarMayhem-v0", 2, tmp_path / str(steps), {"explosion_delay": [1000]})
        list(roll(envs, steps))
        envs.close()
        assert frames_of(tmp_path / str(steps)) == {"episode-0.mp4": expected}


def test_which_episodes_have_a_video(tmp_path, monkeypatch):
    monkeypatch.setattr(LaneVideo, "_film", lambda self: None)
    envs = filmed("MysteryPath-Grid-v0", 1, tmp_path, {"max_steps": 1})
    recorded = []
    for _ in range(3001):  # episodes of a step
        recorded += [envs.episode] * envs.recording
        envs.step(np.zeros((1, 1), int))
    assert recorded == [0, 1, 8, 27, 64, 125, 216, 343, 512, 729, 1000, 2000, 3000]


@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "minigrid:MiniGrid-MemoryS7-v0"])
def test_videos_of_other_packages(env_id, tmp_path):
    envs = filmed(needs(env_id), 2, tmp_path)
    list(roll(envs, 3))
    envs.close()
    assert sum(frames_of(tmp_path).values()) == 3


# ---- ids and options ----


def test_a_module_registers_its_environments_when_it_is_imported(tmp_path, monkeypatch):
    entry = "import gymnasium\ngymnasium.register('Fresh-v0', entry_point='gymnasium.envs.classic_control:CartPoleEnv')"
    (tmp_path / "fresh_envs.py").write_text(entry)
    monkeypatch.syspath_prepend(tmp_path)
    assert not is_memory_gym("fresh_envs:Fresh-v0")
    assert make_envs("fresh_envs:Fresh-v0", 2).spec.id == "Fresh-v0"
    assert is_memory_gym("memory_gym_envs:MysteryPath-v0")
    assert all(map(is_memory_gym, IDS))


def test_options():
    assert parse_options("MysteryPath-v0", "{}") == {}
    assert parse_options("CartPole-v1", "{}") == {}
    assert parse_options("MysteryPath-v0", '{"max_steps": 5}') == {"max_steps": 5}
    wrong = {"{broken": "--env-options is no JSON", "[1]": "--env-options must be a JSON object"}
    for text, message in wrong.items():
        with pytest.raises(ValueError, match=message):
            parse_options("MysteryPath-v0", text)
    with pytest.raises(ValueError, match="CartPole-v1 has none"):
        parse_options("CartPole-v1", '{"a": 1}')


# ---- what cannot work ----


class Broken(gym.Env):
    def __init__(self):
        raise KeyError("no such\nfile")


class Old(Shows):
    """An environment of before Gymnasium: its reset takes no options."""

    def reset(self):
        return super().reset()


class NextStep(gym.vector.VectorEnv):
    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, num_envs):
        self.num_envs = num_envs


NUMBER, GRAPH = box(0, 1, (1,)), gym.spaces.Graph(box(0, 1, (1,)), None)
CASES = [
    ("MortarMayhm-v0", {}, "MortarMayhem"),
    ("popgym-NoSuchTask-v0", {}, "popgym-NoSuchTask"),
    ("nowhere:Env-v0", {}, "nowhere"),
    ("Pendulum-v1", {}, r"action space Box.* is not supported; use Discrete or one-dimensional MultiDiscrete"),
    (shows(NUMBER, action_space=gym.spaces.MultiDiscrete([[2, 2]])), {}, "action space .* is not supported"),
    (shows(NUMBER, action_space=gym.spaces.MultiDiscrete([])), {}, "action space .* is not supported"),
    (shows(GRAPH), {}, "observation space observation: Graph.* is not supported; use images"),
    (shows(gym.spaces.Sequence(NUMBER)), {}, "observation space observation: Sequence.* is not supported"),
    (shows(gym.spaces.Dict({"a.b": NUMBER, "a": gym.spaces.Dict({"b": NUMBER})})), {}, "two parts have the same name"),
    (
        shows(gym.spaces.Dict({"a": NUMBER, "b": gym.spaces.Dict({"c": GRAPH})})),
        {},
        r"space b\.c: Graph.* is not supported",
    ),
    (shows(gym.spaces.OneOf((NUMBER, NUMBER))), {}, "observation: OneOf.* is not supported"),
    (shows(gym.spaces.Text(3)), {}, "Text.* is not supported; it is all text"),
    (shows(box(-np.inf, 1, (40, 40, 3))), {}, "Box.* is not supported; use images .* with bounds"),
    (shows(box(0, 1, (40, 40, 3))), {"frame_stack": 4}, "--frame-stack: .* uint8 image"),
    ("MysteryPath-v0", {"frame_stack": -1}, "--frame-stack: frames must be an integer of at least 1, not -1"),
    ("CartPole-v1", {"spotlight_perturbation": True}, "--spotlight-perturbation: .* image"),
    (
        shows(box(0, 255, (90, 84, 3), np.uint8)),
        {"spotlight_perturbation": True},
        "--spotlight-perturbation: .*84 x 84",
    ),
    ("MysteryPath-v0", {"num_levels": -1}, "MysteryPath-v0 cannot be made: num_levels"),
    ("MysteryPath-v0", {"obs_type": "sound"}, "MysteryPath-v0 cannot be made: obs_type"),
    ("MortarMayhem-v0", {"seed": 0, "options": {"comand_count": [3]}}, "comand_count.*command_count"),
    ("CartPole-v1", {"options": {"max_steps": 5}}, "CartPole-v1 has none"),
    (".foo:x-v0", {}, "the module of .foo:x-v0 begins with a dot"),
    (register(Broken), {}, "cannot be made: 'no such.*file'"),
    (register(Shows), {}, "cannot be made: .*space"),
    (register(Old, space=NUMBER), {"seed": 0}, "cannot be reset: .*unexpected keyword argument"),
]


@pytest.mark.parametrize(("env_id", "arguments", "message"), CASES, ids=[case[2] for case in CASES])
def test_what_cannot_work_is_one_line(env_id, arguments, message):
    with pytest.raises((ValueError, ImportError, gym.error.Error), match=message) as error:
        make_envs(env_id, 2, **arguments)
    assert "\n" not in str(error.value)


class Fragile(Shows):
    """An environment that raises where its seed is even: in step 5 since then, or in the reset after step 6."""

    def __init__(self, part, error):
        super().__init__(NUMBER)
        self.part, self.error, self.done = part, error, 0

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.seed, self.done = seed, 0
        self.fail("reset", 6)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        self.done += 1
        self.fail("step", 5)
        return super().step(action)

    def fail(self, part, step):
        if (self.part, self.done, self.seed % 2) == (part, step, 0):
            raise self.error


@pytest.mark.parametrize(
    "error", [ValueError("no such\nroom"), OSError("no disk"), gym.error.Error("odd"), MemoryError()]
)
@pytest.mark.parametrize(("part", "where"), [("step", "step 5"), ("reset", "the reset after step 6")])
def test_an_error_says_which_lane_and_when(part, where, error):
    envs = make_envs(register(Fragile, part=part, error=error), 4, seed=3, first_lane=10)
    seeds = [each.unwrapped.seed for each in envs.unwrapped.envs]
    lane = next(lane for lane in range(4) if seeds[lane] % 2 == 0)
    envs.reset()  # has no seed, as in the training scripts
    with pytest.raises(RuntimeError) as found:
        list(roll(envs, 6))
    raised = type(error).__name__
    message = f"environment {10 + lane} raised {raised} in {where} since its reset with seed {seeds[lane]}"
    text = " ".join(str(error).split())
    assert str(found.value) == (f"{message}: {text}" if text else message)
    cause = found.value.__cause__
    assert (type(cause), str(cause)) == (type(error), str(error))
    assert traceback.extract_tb(cause.__traceback__)[-1].name == "fail", "where it happened"


def test_an_error_after_a_reset_with_another_seed():
    envs = make_envs(register(Fragile, part="step", error=ValueError("odd")), 3, seed=3)
    list(roll(envs, 3))
    envs.reset(seed=[1, 3, 8])
    with pytest.raises(
        RuntimeError, match="environment 2 raised ValueError in step 5 since its reset with seed 8: odd"
    ):
        list(roll(envs, 6))


def test_an_error_without_a_seed():
    envs = make_envs(register(Old, space=NUMBER), 2, first_lane=3)
    message = "environment 3 raised TypeError in the reset after step 0 since it was made: "
    with pytest.raises(RuntimeError, match=message):
        envs.reset()


class Unready(Shows):
    def __init__(self, error):
        super().__init__(NUMBER)
        self.error = error

    def reset(self, *, seed=None, options=None):
        raise self.error


@pytest.mark.parametrize("error", [gym.error.Error("odd"), ImportError("odd"), OSError("odd"), MemoryError("odd")])
def test_errors_of_the_installation_stay_as_they_are_in_the_first_reset(error):
    with pytest.raises(type(error), match=r"^odd$"):
        make_envs(register(Unready, error=error), 2, seed=0)


@pytest.mark.parametrize("wrong", [-1, 1.5, "a"])
def test_lanes_count_from_zero(wrong):
    with pytest.raises(ValueError, match=f"first_lane must be an integer of at least 0, not {wrong!r}"):
        make_envs("CartPole-v1", 2, first_lane=wrong)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "MysteryPath-v0"])
def test_there_is_at_least_one_lane(env_id):
    with pytest.raises(ValueError, match="num_envs must be an integer of at least 1, not 0"):
        make_envs(env_id, 0)


@pytest.mark.parametrize("seed", [None, 1])
def test_options_are_the_defaults_of_every_reset(seed):
    envs = make_envs("MysteryPath-v0", 2, seed=seed, options={"max_steps": 5})
    envs.reset()
    ended = [envs.step(envs.action_space.sample())[3].all() for _ in range(10)]
    assert ended == ([False] * 4 + [True]) * 2
    envs.reset(options={"max_steps": 4})
    assert [envs.step(envs.action_space.sample())[3].all() for _ in range(4)] == [False] * 3 + [True]


def test_other_autoreset_is_refused():
    gym.register("NextStep-v0", vector_entry_point=NextStep)
    with pytest.raises(ValueError, match="NextStep-v0 does not reset an ended episode in the same step"):
        make_envs("NextStep-v0", 2)


def test_videos_need_the_extra_and_pictures(monkeypatch):
    with pytest.raises(ValueError, match=r"--capture-video needs .* draws images .*CueRecall-v0 draws none"):
        check_can_film("CueRecall-v0")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r'--capture-video needs imageio-ffmpeg: pip install -e "\.\[play\]"'):
        check_can_film("MysteryPath-v0")


def test_vectors_that_are_not_there_are_told(capfd):
    make_envs("CartPole-v1", 1, obs_type="vector").close()
    assert capfd.readouterr().err == "", "it shows vectors anyway"
    make_envs(needs("ale_py:ALE/Pong-v5"), 1, obs_type="vector").close()
    assert "ale_py:ALE/Pong-v5 has no vector to show instead of its observation\n" in capfd.readouterr().err
