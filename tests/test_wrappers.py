"""The vector wrappers: each lane is what Gymnasium's own wrappers or a plain loop make of a single environment."""

import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation, TransformObservation

from memory_gym_envs.drawing import gray
from memory_gym_envs.players import choices
from memory_gym_envs.searing_spotlights.state import BEND, START, TOWARD
from ppo_utils.environments import make_envs
from ppo_utils.wrappers import (
    CommandList,
    FourierFeatures,
    GrayscaleStack,
    LastAction,
    SpotlightPerturbation,
    StepEncoding,
    VectorStack,
)

LANES = 3
SHORT = "Endless-MysteryPath-v0", "MortarMayhemB-Grid-v0"  # whose random episodes are; a picture and a Dict
EACH_SHORT = pytest.mark.parametrize("env_id", SHORT)
WRAPPERS = [GrayscaleStack, StepEncoding, SpotlightPerturbation]
EACH_WRAPPER = pytest.mark.parametrize("wrapper", WRAPPERS)


def make(env_id, **arguments):
    return gym.make_vec(env_id, num_envs=LANES, **arguments)


def sync(single):
    """Gymnasium's own vector environment over such single ones."""
    return SyncVectorEnv([single] * LANES, autoreset_mode=AutoresetMode.SAME_STEP)


def picture(observations):
    return observations["visual_observation"] if isinstance(observations, dict) else observations


def roll(envs, steps, seed=0):
    """What some steps of random actions return."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        yield envs.step(rng.integers(0, choices(envs), envs.action_space.shape))


def finals(infos):
    """The lanes whose episode ended, and their last observations."""
    return [(lane, infos["final_obs"][lane]) for lane in np.flatnonzero(infos.get("_final_obs", ()))]


# ---- what they share ----


@EACH_WRAPPER
@EACH_SHORT
def test_spaces_hold_every_observation(wrapper, env_id):
    envs, ended = wrapper(make(env_id)), 0
    assert envs.single_observation_space != gym.make(env_id).observation_space or wrapper is SpotlightPerturbation
    assert envs.reset(seed=0)[0] in envs.observation_space
    for observations, _, _, _, infos in roll(envs, 150):
        assert observations in envs.observation_space
        for _, last in finals(infos):
            assert last in envs.single_observation_space
            ended += 1
    assert ended > LANES


@EACH_WRAPPER
@EACH_SHORT
def test_nothing_but_the_observation_changes(wrapper, env_id):
    envs, bare = wrapper(make(env_id)), make(env_id)
    assert data_equivalence(envs.reset(seed=1)[1], bare.reset(seed=1)[1], exact=True)
    for wrapped, plain in zip(roll(envs, 100), roll(bare, 100), strict=True):
        for left, right in zip(wrapped[1:4], plain[1:4], strict=True):
            assert np.array_equal(left, right)
        left, right = wrapped[4], plain[4]
        assert left.keys() == right.keys()
        assert all(data_equivalence(left[key], right[key], exact=True) for key in left if key != "final_obs")


@EACH_WRAPPER
@EACH_SHORT
def test_over_gymnasiums_vector_environment(wrapper, env_id):
    """The same over SyncVectorEnv as over this package's batches."""
    ours, theirs, ended = wrapper(make(env_id)), wrapper(sync(lambda: gym.make(env_id))), 0
    mask = {"reset_mask": np.array([True, False, True])}
    for options in (None, None, mask):
        left, right = (envs.reset(seed=4, options=dict(options or {}))[0] for envs in (ours, theirs))
        assert data_equivalence(left, right, exact=True)
        for left, right in zip(roll(ours, 60), roll(theirs, 60), strict=True):
            assert data_equivalence(left[0], right[0], exact=True)
            for (_, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
                assert data_equivalence(last, other, exact=True)
                ended += 1
    assert ended > LANES


@EACH_WRAPPER
@EACH_SHORT
def test_observations_are_the_callers(wrapper, env_id):
    """Spoiling what a wrapper returned changes nothing that it returns later."""
    envs, twin = (wrapper(make(env_id)) for _ in range(2))
    spoil(envs.reset(seed=0)[0])
    twin.reset(seed=0)
    for left, right in zip(roll(envs, 80), roll(twin, 80), strict=True):
        assert data_equivalence(left[0], right[0], exact=True)
        spoil(left[0])
        for (_, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
            assert data_equivalence(last, other, exact=True)
            spoil(last)


def spoil(observations):
    for part in observations.values() if isinstance(observations, dict) else [observations]:
        part.fill(1)


@EACH_SHORT
def test_pickles_to_the_same_future(env_id):
    envs = StepEncoding(GrayscaleStack(SpotlightPerturbation(make(env_id)), 3))
    envs.reset(seed=2)
    list(roll(envs, 40))
    copy = pickle.loads(pickle.dumps(envs))
    for left, right in zip(roll(envs, 80), roll(copy, 80), strict=True):
        assert data_equivalence(left[0], right[0], exact=True)


@EACH_WRAPPER
def test_options_and_levels_pass(wrapper):
    envs = wrapper(make("MysteryPath-v0", num_levels=2))
    envs.reset(seed=0, options={"max_steps": 5})
    lengths = [infos["final_info"]["length"].tolist() for *_, infos in roll(envs, 10) if "final_info" in infos]
    assert lengths == [[5] * LANES] * 2
    assert set(envs.unwrapped.np_random_seed) <= {0, 1}
    with pytest.raises(ValueError, match="max_stepp"):
        envs.reset(options={"max_stepp": 5})


@EACH_WRAPPER
def test_failed_reset_changes_nothing(wrapper):
    envs, twin = (wrapper(make("Endless-MysteryPath-v0")) for _ in range(2))
    for each in (envs, twin):
        each.reset(seed=0)
        list(roll(each, 10))
    for wrong in ({"seed": -1}, {"seed": [1, 2]}, {"options": {"agent_skale": 1}}, {"options": [("max_steps", 5)]}):
        with pytest.raises(ValueError, match=r"seed|agent_scale|must be a dictionary"):
            envs.reset(**wrong)
    for left, right in zip(roll(envs, 80), roll(twin, 80), strict=True):
        assert data_equivalence(left[0], right[0], exact=True)


@EACH_WRAPPER
def test_needs_same_step_autoreset(wrapper):
    with pytest.raises(ValueError, match=f"{wrapper.__name__} needs .*SAME_STEP"):
        wrapper(SyncVectorEnv([lambda: gym.make("MysteryPath-v0")]))


@pytest.mark.parametrize("part", [gym.spaces.Text(9), gym.spaces.Dict({"x": gym.spaces.Discrete(3)})])
@pytest.mark.parametrize("wrapper", [LastAction, StepEncoding])
def test_needs_arrays(wrapper, part):
    """At an episode's end, others could not be put together."""
    for space in (gym.spaces.Tuple([part]), gym.spaces.Dict({"inside": part})):

        class Odd(gym.Env):
            observation_space, action_space = space, gym.spaces.Discrete(2)

        with pytest.raises(ValueError, match=f"{wrapper.__name__} needs arrays to observe, or a Dict of them, not "):
            wrapper(sync(Odd))


@pytest.mark.parametrize("wrapper", [GrayscaleStack, SpotlightPerturbation])
def test_needs_a_picture(wrapper):
    with pytest.raises(ValueError, match=f"{wrapper.__name__} needs one .* image"):
        wrapper(sync(lambda: gym.make("CartPole-v1")))
    with pytest.raises(ValueError, match=f"{wrapper.__name__} needs one .* image"):
        wrapper(GrayscaleStack(make("MysteryPath-v0")))


@pytest.mark.parametrize(
    ("wrapper", "arguments", "message"),
    [
        (GrayscaleStack, {"frames": 0}, "frames must be an integer of at least 1, not 0"),
        (GrayscaleStack, {"frames": 4.0}, "frames"),
        (VectorStack, {}, "VectorStack needs a vector to observe, or a Dict with one, not Box"),
        (CommandList, {}, "CommandList needs what an act task of Mortar Mayhem observes, not MysteryPath"),
        (StepEncoding, {"width": 15}, "width must be an even integer of at least 2, not 15"),
        (StepEncoding, {"width": 0}, "width"),
        (SpotlightPerturbation, {"opacity": 256}, "opacity must be an integer from 0 to 255, not 256"),
        (SpotlightPerturbation, {"shade": -1}, "shade"),
        (SpotlightPerturbation, {"lights": {"num_spawn": 3}}, "'num_spawn'.*'num_spawns'"),
        (SpotlightPerturbation, {"lights": {"spot_min_radius": 0}}, "'spot_min_radius'.*from 1 to 42"),
        (SpotlightPerturbation, {"lights": {"agent_health": 3}}, "no option 'agent_health'"),
    ],
)
def test_wrong_arguments(wrapper, arguments, message):
    with pytest.raises(ValueError, match=message) as error:
        wrapper(make("MysteryPath-v0"), **arguments)
    assert "\n" not in str(error.value)


def test_commands_of_another_vector():
    """Of an act task whose vector is too short to hold them."""
    envs = CommandList(make("MortarMayhemB-Grid-v0", obs_type="vector"))
    with pytest.raises(ValueError, match="needs what an act task of Mortar Mayhem observes, not <CommandList"):
        CommandList(envs)


# ---- grayscale frame stacks ----


@pytest.mark.parametrize("frames", [1, 4, 16])
@EACH_SHORT
def test_stack_is_gymnasiums_of_single_environments(env_id, frames):
    """Lane by lane the same as Gymnasium's frame stack, which begins with copies of the first frame."""

    def single():
        env = gym.make(env_id)
        shape = gym.spaces.Box(0, 255, (84, 84), np.uint8)
        return FrameStackObservation(TransformObservation(env, lambda seen: gray(picture(seen)), shape), frames)

    ours, theirs, ended = GrayscaleStack(make(env_id), frames), sync(single), 0
    left, right = ours.reset(seed=3)[0], theirs.reset(seed=3)[0]
    assert picture(left).shape == (LANES, 84, 84, frames)
    assert np.array_equal(picture(left), np.moveaxis(right, 1, -1))
    for left, right in zip(roll(ours, 120), roll(theirs, 120), strict=True):
        assert np.array_equal(picture(left[0]), np.moveaxis(right[0], 1, -1))
        for (_, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
            assert np.array_equal(picture(last), np.moveaxis(other, 0, -1))
            ended += 1
    assert ended > LANES


def test_stack_leaves_other_parts_alone():
    envs, bare = GrayscaleStack(make("MortarMayhemB-Grid-v0")), make("MortarMayhemB-Grid-v0")
    assert envs.single_observation_space["vector_observation"] == bare.single_observation_space["vector_observation"]
    assert data_equivalence(envs.reset(seed=0)[0]["vector_observation"], bare.reset(seed=0)[0]["vector_observation"])
    for left, right in zip(roll(envs, 50), roll(bare, 50), strict=True):
        assert np.array_equal(left[0]["vector_observation"], right[0]["vector_observation"])
        for (_, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
            assert np.array_equal(last["vector_observation"], other["vector_observation"])


def test_reset_mask_begins_its_stacks_alone():
    envs, bare = GrayscaleStack(make("MysteryPath-v0"), 3), make("MysteryPath-v0")
    envs.reset(seed=0)
    *_, (before, *_) = roll(envs, 5)
    bare.reset(seed=0)
    after, _ = envs.reset(seed=9, options={"reset_mask": np.array([False, True, False])})
    first, _ = bare.reset(seed=9)
    assert np.array_equal(after[[0, 2]], before[[0, 2]])
    assert np.array_equal(after[1], gray(first[1])[..., None].repeat(3, axis=-1))


@pytest.mark.parametrize("frames", [1, 4])
@EACH_SHORT
def test_vector_stack_is_gymnasiums_of_single_environments(env_id, frames):
    def single():
        return FrameStackObservation(gym.make(env_id, obs_type="vector"), frames)

    ours, theirs, ended = VectorStack(make(env_id, obs_type="vector"), frames), sync(single), 0
    assert np.array_equal(ours.reset(seed=3)[0], theirs.reset(seed=3)[0].reshape(LANES, -1))
    for left, right in zip(roll(ours, 100), roll(theirs, 100), strict=True):
        assert left[0] in ours.observation_space
        assert np.array_equal(left[0], right[0].reshape(LANES, -1))
        left[0].fill(1)  # the caller's own
        for (_, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
            assert np.array_equal(last, other.flatten())
            ended += 1
    assert ended > LANES
    with pytest.raises(ValueError, match="frames must be an integer of at least 1, not 0"):
        VectorStack(make(env_id, obs_type="vector"), 0)


def test_vector_stack_leaves_other_parts_alone():
    """Of a Dict, lists and images are as they were, in final observations too."""
    envs, bare = (CommandList(make("MortarMayhemB-Grid-v0", obs_type="vector")) for _ in range(2))
    envs = VectorStack(envs, 2)
    assert envs.single_observation_space["observation"].shape == (30,)
    assert np.array_equal(envs.reset(seed=0)[0]["commands"], bare.reset(seed=0)[0]["commands"])
    for left, right in zip(roll(envs, 50), roll(bare, 50), strict=True):
        assert left[0] in envs.observation_space
        assert np.array_equal(left[0]["commands"], right[0]["commands"])
        assert np.array_equal(left[0]["observation"][:, 15:], right[0]["observation"])
        for (_, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
            assert np.array_equal(last["commands"], other["commands"])


# ---- a list of commands ----


@pytest.mark.parametrize("env_id", ["MortarMayhemB-v0", "MortarMayhemB-Grid-v0"])
@pytest.mark.parametrize("obs_type", ["vector", "pixels", "grayscale"])
def test_commands_are_a_part_of_their_own(env_id, obs_type):
    """Side by side, the parts are what the environment shows."""

    def whole(seen):
        commands = seen["commands"].reshape(*seen["commands"].shape[:-2], 180)
        return np.concatenate([seen["observation"], commands], -1) if obs_type == "vector" else commands

    def shown(seen):
        return seen if obs_type == "vector" else seen["vector_observation"]

    envs, bare, ended = CommandList(make(env_id, obs_type=obs_type)), make(env_id, obs_type=obs_type), 0
    others = {"observation"} if obs_type == "vector" else {"visual_observation"}
    assert {*envs.single_observation_space} == {"commands", *others}
    left, right = envs.reset(seed=4)[0], bare.reset(seed=4)[0]
    assert np.array_equal(whole(left), shown(right))
    for left, right in zip(roll(envs, 300), roll(bare, 300), strict=True):
        assert left[0] in envs.observation_space
        assert np.array_equal(whole(left[0]), shown(right[0]))
        if obs_type != "vector":
            assert np.array_equal(left[0]["visual_observation"], right[0]["visual_observation"])
        for (_, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
            assert np.array_equal(whole(last), shown(other))
            ended += 1
        for part in left[0].values():
            part.fill(0)  # the caller's own
    assert ended > LANES


def test_an_id_with_a_namespace_has_a_list():
    envs = make_envs("memory_gym_envs/MortarMayhemB-Grid-v0", 2, obs_type="vector", attend_commands=True)
    assert envs.single_observation_space["commands"].shape == (20, 9)


def test_other_environments_have_no_list():
    spaces = [
        make_envs(env_id, 2, obs_type="vector", attend_commands=flag).single_observation_space
        for env_id in ("MortarMayhem-v0", "CartPole-v1")
        for flag in (True, False)
    ]
    assert spaces[0] == spaces[1]
    assert spaces[2] == spaces[3]


def test_gray():
    colors = np.array([(0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 255, 0), (0, 0, 255), (7, 7, 7)], np.uint8)
    assert gray(colors).tolist() == [0, 255, 77, 149, 29, 7]
    every = np.random.default_rng(0).integers(0, 256, (10_000, 3), dtype=np.uint8)
    # The weights are rounded to 256ths, which is a quarter of a level off at most, and the sum to whole levels.
    assert np.abs(gray(every) - every @ [0.299, 0.587, 0.114]).max() < 1


# ---- the step number ----


def encoding(steps, width):
    """(2.57) and (2.58), one number after the other; steps: one or several."""
    if np.ndim(steps):
        return [encoding(step, width) for step in steps]
    angles = [steps / 10000 ** (2 * i / width) for i in range(width // 2)]
    return [f(angle) for angle in angles for f in (math.sin, math.cos)]


def same(left, right):
    return left.keys() == right.keys() and all(np.allclose(left[key], right[key], atol=1e-6) for key in left)


@pytest.mark.parametrize("width", [16, 6])
@EACH_SHORT
def test_step_encoding_counts_from_each_reset(env_id, width):
    envs, bare, steps, lengths = StepEncoding(make(env_id), width), make(env_id), np.zeros(LANES, int), set()

    def expected(plain, step):
        parts = plain if isinstance(plain, dict) else {"observation": plain}
        return {**parts, "step_encoding": encoding(step, width)}

    assert same(envs.reset(seed=0)[0], expected(bare.reset(seed=0)[0], steps))
    for left, right in zip(roll(envs, 120), roll(bare, 120), strict=True):
        steps += 1
        for (lane, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
            assert left[4]["final_info"]["length"][lane] == steps[lane]
            assert same(last, expected(other, steps[lane]))
            lengths.add(int(steps[lane]))
            steps[lane] = 0
        assert same(left[0], expected(right[0], steps))
    assert len(lengths) > 1


def test_step_encoding_of_long_episodes_tells_steps_apart():
    envs = StepEncoding(sync(lambda: gym.make("CartPole-v1")))
    envs.reset(seed=0)
    envs._steps[:] = 5000, 5001, 100_000
    encodings = envs.wrap(np.zeros((LANES, 4)), slice(None))["step_encoding"]
    np.testing.assert_allclose(encodings, encoding((5000, 5001, 100_000), 16), atol=1e-6)


def test_step_encoding_twice():
    with pytest.raises(ValueError, match="already has a part 'step_encoding'"):
        StepEncoding(StepEncoding(make("MysteryPath-v0")))


def test_reset_mask_counts_from_zero_there_alone():
    envs = StepEncoding(make("MysteryPath-v0"))
    envs.reset(seed=0)
    list(roll(envs, 5))
    observations, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_allclose(observations["step_encoding"], encoding((5, 0, 5), 16), atol=1e-6)


# ---- the spotlight perturbation ----


def holes(perturbed, plain, opacity, shade):
    """Where a picture is as it was, (84, 84) bool; everywhere else it is under the veil."""
    veiled = (plain.astype(int) * (255 - opacity) + shade * opacity) // 255
    clear = (perturbed == plain).all(axis=-1)
    assert np.array_equal(perturbed[~clear], veiled[~clear])
    return clear


@pytest.mark.parametrize(
    ("env_id", "opacity", "shade"), [(SHORT[0], 120, 255), (SHORT[0], 255, 0), (SHORT[1], 200, 90)]
)
def test_veil_with_holes(env_id, opacity, shade):
    envs, bare, ended = SpotlightPerturbation(make(env_id), opacity, shade), make(env_id), 0
    left, right = envs.reset(seed=0)[0], bare.reset(seed=0)[0]
    shares = [holes(a, b, opacity, shade).mean() for a, b in zip(picture(left), picture(right), strict=True)]
    for left, right in zip(roll(envs, 100), roll(bare, 100), strict=True):
        pairs = list(zip(picture(left[0]), picture(right[0]), strict=True))
        pairs += [(picture(a), picture(b)) for (_, a), (_, b) in zip(finals(left[4]), finals(right[4]), strict=True)]
        ended += len(pairs) - LANES
        shares += [holes(*pair, opacity, shade).mean() for pair in pairs]
    assert ended > LANES
    # Four spotlights of radius 7 to 13, some of each outside the picture, and what the veil has the colour of.
    assert 0.02 < np.mean(shares) < (0.3 if shade else 1)


def white_veil(env_id, **arguments):
    """An opaque veil, so that a hole is where anything but white is."""
    return SpotlightPerturbation(make(env_id, **arguments), opacity=255, shade=255)


def lit(observations):
    return (observations != 255).any(axis=-1)  # (N, 84, 84)


def test_spotlights_are_disks_on_their_way():
    """One spotlight, alone where it has to be from step to step."""
    speed, radius = 0.03, 10
    lights = {"initial_spawns": 1, "num_spawns": 0, "spot_min_radius": radius, "spot_max_radius": radius}
    lights |= {"spot_min_speed": speed, "spot_max_speed": speed}
    envs, whole = SpotlightPerturbation(make("MysteryPath-v0"), 255, 255, lights), 0
    for seed in range(0, 60, LANES):
        shown = [lit(envs.reset(seed=seed)[0]), *(lit(step[0]) for step in roll(envs, 15))]
        start, toward, bend = (envs._light.state.spots[part, :, 0] for part in (START, TOWARD, BEND))  # (2, N)
        for step, lanes in enumerate(shown):
            time = 0.3 + step * speed  # the author's head start
            for lane, (x, y) in enumerate((start + time * (toward + time * bend)).T.astype(int)):
                if radius <= x <= 84 - radius and radius <= y <= 84 - radius:
                    rows, columns = lanes[lane].nonzero()
                    assert (rows.min(), rows.max() + 1) == (y - radius, y + radius)
                    assert (columns.min(), columns.max() + 1) == (x - radius, x + radius)
                    assert abs(rows.size - math.pi * radius**2) < 20
                    whole += 1
    assert whole > 100


def test_first_observation_is_perturbed():
    envs = white_veil("MysteryPath-v0")
    shown = [lit(envs.reset(seed=seed)[0]).any(axis=(1, 2)).mean() for seed in range(0, 30, LANES)]
    assert np.mean(shown) > 0.9


def test_spotlights_are_seeded_by_lane():
    envs, again = white_veil("MysteryPath-v0"), white_veil("MysteryPath-v0")
    first = lit(envs.reset(seed=5)[0])
    assert not np.array_equal(first[0], first[1])
    assert np.array_equal(first, lit(again.reset(seed=[5, 6, 7])[0]))
    for left, right in zip(roll(envs, 60), roll(again, 60), strict=True):
        assert np.array_equal(left[0], right[0])
    following = lit(envs.reset()[0])
    assert not np.array_equal(first, following)  # the generators went on,
    assert np.array_equal(following, lit(again.reset()[0]))  # both alike
    # None in a list lets that lane's go on.
    mixed = lit(envs.reset(seed=[None, 6, None])[0])
    assert np.array_equal(mixed[1], first[1])
    assert not np.array_equal(mixed[0], first[0])


def test_spotlights_are_not_the_environments_own():
    """Searing Spotlights under the perturbation with the same seed: their spotlights differ."""
    envs = white_veil("SearingSpotlights-v0")
    envs.reset(seed=0)
    own, other = (each.state.spots[START.start :, :, :4] for each in (envs.unwrapped, envs._light))
    assert not np.isclose(own, other).all(axis=0).any()


def test_spotlights_begin_anew_with_every_episode():
    envs = white_veil("MysteryPath-v0")
    envs.reset(seed=1, options={"max_steps": 60})
    counts = [envs._light.state.num_spots.tolist() for _ in roll(envs, 130)]
    # Four, and a fifth after 40 steps, in each of the episodes of 60 steps.
    assert counts[38] == counts[98] == counts[59] == counts[119] == [4] * LANES
    assert counts[39] == counts[58] == counts[99] == counts[118] == [5] * LANES
    first, second = (lit(envs.reset(seed=1)[0]) for _ in range(2))
    assert np.array_equal(first, second)


def test_reset_mask_moves_its_spotlights_alone():
    envs = white_veil("MysteryPath-v0")
    envs.reset(seed=0)
    *_, (before, *_) = roll(envs, 5)
    after, _ = envs.reset(seed=9, options={"reset_mask": np.array([False, True, False])})
    fresh, _ = white_veil("MysteryPath-v0").reset(seed=9)
    assert np.array_equal(lit(after)[[0, 2]], lit(before)[[0, 2]])
    assert np.array_equal(after[1], fresh[1])


def test_wrappers_compose():
    """The perturbed picture is what the stack takes in, beside the step number and the commands."""
    envs = StepEncoding(GrayscaleStack(SpotlightPerturbation(make("MortarMayhemB-Grid-v0")), 4))
    under = SpotlightPerturbation(make("MortarMayhemB-Grid-v0"))
    observations, first = envs.reset(seed=0)[0], under.reset(seed=0)[0]
    assert observations.keys() == {"visual_observation", "vector_observation", "step_encoding"}
    assert np.array_equal(observations["visual_observation"][..., -1], gray(first["visual_observation"]))
    for left, right in zip(roll(envs, 40), roll(under, 40), strict=True):
        assert np.array_equal(left[0]["visual_observation"][..., -1], gray(right[0]["visual_observation"]))
        for (_, last), (_, other) in zip(finals(left[4]), finals(right[4]), strict=True):
            assert np.array_equal(last["visual_observation"][..., -1], gray(other["visual_observation"]))


# ---- Fourier features ----
class Vectors(gym.Env):
    """A vector and a picture, at fixed values."""

    observation_space = gym.spaces.Dict(
        place=gym.spaces.Box(0.0, 1.0, (2,), np.float32), frame=gym.spaces.Box(0, 255, (40, 40, 3), np.uint8)
    )
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        self.t += 1
        return self.observe(), 0.0, self.t == 2, False, {}

    def observe(self):
        return {
            "place": np.array([0.25, [1.0, 0.5, 0.0][self.t]], np.float32),
            "frame": np.zeros((40, 40, 3), np.uint8),
        }


def test_fourier_features_by_hand():
    """Of pi x and 2 pi x for each entry; the rest stays, and the final observation has them too."""
    envs = FourierFeatures(SyncVectorEnv([Vectors] * 2, autoreset_mode=AutoresetMode.SAME_STEP), 2)
    obs, _ = envs.reset(seed=1)
    root = 0.5**0.5
    assert list(envs.single_observation_space.spaces) == ["place", "frame", "sines", "cosines"]
    assert envs.observation_space.contains(obs)
    assert obs["place"].tolist() == [[0.25, 1.0]] * 2
    np.testing.assert_allclose(obs["sines"], [[root, 1.0, 0.0, 0.0]] * 2, atol=1e-6)
    np.testing.assert_allclose(obs["cosines"], [[root, 0.0, -1.0, 1.0]] * 2, atol=1e-6)
    envs.step(np.zeros(2, int))
    obs, _, terminated, _, infos = envs.step(np.zeros(2, int))
    assert terminated.all()
    np.testing.assert_allclose(obs["cosines"], [[root, 0.0, -1.0, 1.0]] * 2, atol=1e-6)
    np.testing.assert_allclose(infos["final_obs"][1]["cosines"], [root, 0.0, 1.0, 1.0], atol=1e-6)


def test_fourier_features_are_those_of_all_vectors():
    """Two vectors, one after the other, as the network takes them."""
    envs = LastAction(gym.make_vec("MysteryPath-Grid-v0", num_envs=2, obs_type="vector"))
    features = FourierFeatures(envs, 3)
    features.reset(seed=1)
    obs, *_ = features.step(np.array([1, 3]))
    x = np.concatenate([obs["last_action"], obs["observation"]], axis=1)
    assert list(features.single_observation_space.spaces) == ["last_action", "observation", "sines", "cosines"]
    for name, function in (("sines", np.sin), ("cosines", np.cos)):
        wanted = [function(2**k * np.pi * x) for k in range(3)]
        np.testing.assert_allclose(obs[name], np.stack(wanted, 2).reshape(2, -1), atol=1e-5)


def test_fourier_features_are_made_of_what_is_from_0_to_1():
    """Of the vector, not of the step's encoding or the last reward, which have no such bounds."""
    flags = {"vector_frequencies": 2, "step_encoding": True, "observe_last_action": True}
    space = make_envs("MysteryPath-Grid-v0", 2, obs_type="vector", **flags).single_observation_space
    assert space["sines"].shape == space["cosines"].shape == (2 * 16,)


def test_fourier_features_without_a_vector():
    envs = gym.make_vec("MysteryPath-v0", num_envs=2)
    with pytest.raises(ValueError, match="needs an observation with a vector, not with observation alone"):
        FourierFeatures(envs, 2)


@pytest.mark.parametrize("space", [
    gym.spaces.Discrete(3, start=2), gym.spaces.MultiDiscrete([3, 2], start=[2, -1]),
])  # fmt: skip
def test_the_last_action_is_counted_from_the_space_s_start(space):
    class Some(gym.Env):
        observation_space, action_space = gym.spaces.Box(0, 1, (1,)), space

        def reset(self, *, seed=None, options=None):
            return np.zeros(1, np.float32), {}

        def step(self, action):
            return np.zeros(1, np.float32), 0.5, False, False, {}

    envs = LastAction(SyncVectorEnv([Some] * 2, autoreset_mode=AutoresetMode.SAME_STEP))
    envs.reset()
    actions = [3, 2] if isinstance(space, gym.spaces.Discrete) else [[3, -1], [2, 0]]
    last = envs.step(np.array(actions))[0]["last_action"].tolist()
    branch = [[0, 1, 0], [1, 0, 0]]
    others = [[], []] if isinstance(space, gym.spaces.Discrete) else [[1, 0], [0, 1]]
    assert last == [[*each, *other, 0.5] for each, other in zip(branch, others, strict=True)]
