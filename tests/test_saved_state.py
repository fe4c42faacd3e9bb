"""save_state and load_state: environments play on exactly as if they had never stopped."""

import copy
import io
import itertools

import cue_recall  # noqa: F401 (registers CueRecall-v0)
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import ClipReward
from helpers import EACH, EACH_OBS, FAMILY, HASTY, ONE_OBS, check_same
from test_lanes import CHANGED, OPTIONS

from memory_gym_envs.players import stumbling
from memory_gym_envs.saving import BIT_GENERATORS, plain, restored
from ppo_utils.environments import load_state, make_envs, save_state
from ppo_utils.video import LaneVideo

LANES = 3
WRAPPERS = {
    "frame stack": {"frame_stack": 3},
    "list": {"attend_commands": True},
    "step encoding": {"step_encoding": True},
    "Fourier features": {"obs_type": "vector", "vector_frequencies": 2},
    "last action": {"observe_last_action": True},
    "perturbation": {"spotlight_perturbation": True},
}
EVERYTHING = {"frame_stack": 2, "step_encoding": True, "observe_last_action": True}


def through_a_file(state):
    """What a checkpoint makes of a state: arrays are tensors there, and nothing but plain values is allowed."""
    file = io.BytesIO()
    torch.save(converted(state, np.ndarray, torch.from_numpy), file)
    file.seek(0)
    return converted(torch.load(file, weights_only=True), torch.Tensor, torch.Tensor.numpy)


def converted(value, kind, convert):
    """The value with all in it that is of the kind converted; fails if anything else is not plain."""
    if type(value) is kind:
        return convert(value)
    if type(value) is dict:
        assert all(type(name) is str for name in value)
        return {name: converted(each, kind, convert) for name, each in value.items()}
    if type(value) in (list, tuple):
        return type(value)(converted(each, kind, convert) for each in value)
    assert value is None or type(value) in (str, int, float, bool)
    return value


STUMBLING = np.linspace(0.1, 1.0, LANES)  # the later lanes ever more often, so that episodes of all lengths occur


def play(envs, steps, chance=STUMBLING):
    """Steps of players that stumble with these chances (N,): the actions, and a copy of what they return."""
    rng = np.random.default_rng(0)
    for _ in range(steps):
        actions = stumbling(envs.unwrapped, rng, chance).reshape(LANES, -1)
        yield actions, timeless(copy.deepcopy(envs.step(actions)))


def timeless(result):
    """The same but for the seconds that episodes took."""
    result[-1].get("episode", {}).pop("t", None)
    return result


def check_resumes(envs, make_again, saved_after, chance=STUMBLING, steps=40):
    """Save after so many steps each, and continue from there in other environments. Returns how many episodes ended."""
    saved, history, ends = {}, [], 0
    for actions, result in play(envs, max(saved_after) + steps, chance):
        history.append((actions, result))
        ends += np.count_nonzero(result[2] | result[3])
        if len(history) in saved_after:
            saved[len(history)] = save_state(envs)
    then = envs.reset()
    for after, state in saved.items():
        again = make_again()
        load_state(again, through_a_file(state))
        for actions, result in history[after : after + steps]:
            check_same(timeless(again.step(actions)), result)
        if after + steps == len(history):
            check_same(again.reset(), then)
            check_same(save_state(again), save_state(envs))
    return ends


# ---- playing on ----


@ONE_OBS
def test_plays_on_with_the_present_options(env_id, obs_type):
    check_present_options(env_id, obs_type=obs_type)


@ONE_OBS
def test_plays_on_with_all_wrappers(env_id, obs_type):
    check_present_options(env_id, obs_type=obs_type, spotlight_perturbation=obs_type == "pixels", **EVERYTHING)


def check_present_options(env_id, **arguments):
    envs = make_envs(env_id, LANES, seed=3, num_levels=50, **arguments)
    envs.reset(options=OPTIONS[env_id])
    check_resumes(envs, lambda: make_envs(env_id, LANES, num_levels=50, **arguments), (1, 100))


@ONE_OBS
def test_plays_on_after_many_episodes(env_id, obs_type):
    """Into environments that have been seeded, and reset with other options."""
    options = HASTY[FAMILY[env_id]]
    envs = make_envs(env_id, LANES, seed=3, obs_type=obs_type)
    envs.reset(options=options)
    again = make_envs(env_id, LANES, seed=8, obs_type=obs_type)
    again.reset(options=CHANGED[FAMILY[env_id]])
    ends = check_resumes(envs, lambda: again, (200,))
    assert ends > 3 * LANES


@pytest.mark.parametrize(
    ("obs_type", "wrapper", "env_id"),
    [
        (*each, env_id)
        for each, env_id in zip(
            itertools.product(("pixels", "vector"), WRAPPERS),
            itertools.cycle(["MortarMayhemB-Grid-v0", "Endless-MysteryPath-v0", "SearingSpotlights-v0"]),
        )
        if each != ("vector", "perturbation")
    ],
)
def test_plays_on_with_each_wrapper(env_id, obs_type, wrapper):
    arguments = {"obs_type": obs_type, **WRAPPERS[wrapper]}
    envs = make_envs(env_id, LANES, seed=3, **arguments)
    envs.reset()
    check_resumes(envs, lambda: make_envs(env_id, LANES, **arguments), (1, 70))


def test_lanes_that_are_not_reset_observe_what_they_did():
    """Right after loading: what a wrapper shows of the last step is kept too."""
    envs, again = (make_envs("MortarMayhem-Grid-v0", LANES, seed=1, obs_type="vector", **EVERYTHING) for _ in range(2))
    envs.reset()
    shown = [result[0] for _, result in play(envs, 9)][-1]
    load_state(again, through_a_file(save_state(envs)))
    mask = np.arange(LANES) == 0
    observed, _ = again.reset(options={"reset_mask": mask})
    for name, part in shown.items():
        assert np.array_equal(observed[name][~mask], part[~mask])


@ONE_OBS
def test_plays_on_with_options_that_differ_between_lanes(env_id, obs_type):
    envs = make_envs(env_id, LANES, obs_type=obs_type, step_encoding=True)
    envs.reset(seed=1)
    for given, mask in ((CHANGED[FAMILY[env_id]], [False, True, False]), (OPTIONS[env_id], [False, False, True])):
        envs.reset(seed=5, options={**given, "reset_mask": np.array(mask)})
        next(play(envs, 1))
    check_resumes(envs, lambda: make_envs(env_id, LANES, obs_type=obs_type, step_encoding=True), (60,))


@EACH_OBS
def test_lanes_that_a_masked_reset_leaves_out_show_what_they_showed(env_id, obs_type):
    arguments = {"obs_type": obs_type, **EVERYTHING}
    envs, again = make_envs(env_id, LANES, **arguments), make_envs(env_id, LANES, **arguments)
    envs.reset(seed=1)
    for _ in play(envs, 8):
        pass
    load_state(again, save_state(envs))
    first, second = (each.reset(options={"reset_mask": np.array([False, True, False])}) for each in (envs, again))
    check_same(first, second)


@EACH
def test_plays_on_from_before_the_first_step(env_id):
    arguments = {"num_levels": 9, "spotlight_perturbation": True, **EVERYTHING}
    for seed in (None, 2):  # never reset, and only seeded
        envs, again = make_envs(env_id, LANES, seed=seed, **arguments), make_envs(env_id, LANES, **arguments)
        load_state(again, through_a_file(save_state(envs)))
        if seed is None:
            check_same(again.reset(seed=4), envs.reset(seed=4))
        else:
            check_same(again.reset(), envs.reset())
        for actions, result in play(envs, 5):
            check_same(timeless(again.step(actions)), result)


def test_a_path_that_grows():
    """Saved when it is longer than a fresh environment has room for, it goes on growing."""
    envs = make_envs("Endless-MysteryPath-v0", LANES)
    envs.reset(seed=0, options={"agent_speed": 6.0, "stamina_level": 1000})
    room = envs.unwrapped.state.path_cell.shape[1]
    check_resumes(envs, lambda: make_envs("Endless-MysteryPath-v0", LANES), (90,), chance=np.zeros(LANES), steps=90)
    assert envs.unwrapped.state.path_cell.shape[1] > 2 * room


# ---- what is saved ----


@ONE_OBS
def test_saving_changes_nothing_and_nothing_changes_what_is_saved(env_id, obs_type):
    arguments = {"obs_type": obs_type, "num_levels": 9, **EVERYTHING}
    envs, twin = (make_envs(env_id, LANES, seed=1, **arguments) for _ in range(2))
    check_same(envs.reset(), twin.reset())
    saved = []
    for actions, result in play(twin, 40):
        state = save_state(envs)
        saved.append((state, copy.deepcopy(state)))
        check_same(timeless(envs.step(actions)), result)
    for state, copied in saved:
        check_same(state, copied)


def test_nothing_changes_what_was_loaded():
    envs, again = (make_envs("Endless-MysteryPath-v0", LANES, spotlight_perturbation=True, **EVERYTHING) for _ in "ab")
    envs.reset(seed=1)
    state = save_state(envs)
    copied = copy.deepcopy(state)
    load_state(again, state)
    for _ in play(again, 60):
        pass
    check_same(state, copied)


def test_seeds_and_statistics():
    envs, again = (make_envs("MysteryPath-Grid-v0", LANES, num_levels=4, start_level=6) for _ in range(2))
    envs.reset(seed=1, options={"max_steps": 10})
    for _ in play(envs, 35):
        pass
    load_state(again, save_state(envs))
    assert again.unwrapped.np_random_seed == envs.unwrapped.np_random_seed
    assert set(again.unwrapped.np_random_seed) <= set(range(6, 10))
    assert again.episode_count == envs.episode_count > 0
    for _ in range(10):
        *_, infos = again.step(np.zeros((LANES, 1), np.int64))
        seconds = infos.get("episode", {"t": np.zeros(1)})["t"]
        assert (seconds >= 0).all()
        assert (seconds < 60).all()


@pytest.mark.parametrize("kind", BIT_GENERATORS)
def test_every_generator_of_numpy(kind):
    rng = np.random.Generator(getattr(np.random, kind)(5))
    rng.integers(0, 9, dtype=np.uint32)
    again = restored(through_a_file(plain(rng)))
    assert rng.integers(0, 9, 50, np.uint32).tolist() == again.integers(0, 9, 50, np.uint32).tolist()
    assert rng.standard_normal(50).tolist() == again.standard_normal(50).tolist()


def test_a_video_starts_again_with_the_next_scheduled_episode(tmp_path):
    pytest.importorskip("imageio_ffmpeg")

    def filmed(folder):
        envs = make_envs("MortarMayhemB-Grid-v0", LANES, render_mode="rgb_array")
        envs.reset(seed=0, options={"command_count": [1]})
        return LaneVideo(envs, str(tmp_path / folder))

    envs = filmed("before")
    still = np.zeros((LANES, 1), np.int64)
    while envs.episode < 2:
        envs.step(still)
    state = save_state(envs)
    envs.close()
    again = filmed("after")
    load_state(again, through_a_file(state))
    while again.episode < 9:
        again.step(still)
    again.close()
    assert [path.name for path in (tmp_path / "after").iterdir()] == ["episode-8.mp4"]


# ---- what does not fit ----

MADE = {"env_id": "MysteryPath-v0", "num_envs": 2, "frame_stack": 2}


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"env_id": "MysteryPath-Grid-v0"}, "id 'MysteryPath-v0', not 'MysteryPath-Grid-v0'"),
        ({"env_id": "MortarMayhem-v0"}, "id 'MysteryPath-v0', not 'MortarMayhem-v0'"),
        ({"num_envs": 3}, "num_envs 2, not 3"),
        ({"num_levels": 7}, "num_levels 0, not 7"),
        ({"start_level": 7}, "start_level 0, not 7"),
        ({"obs_type": "vector"}, "obs_type 'pixels', not 'vector'"),
        ({"frame_stack": 3}, "GrayscaleStack's frames 2, not 3"),
        ({"frame_stack": 0}, "wrappers 'GrayscaleStack, EpisodeStatistics', not 'EpisodeStatistics'"),
        ({"step_encoding": True}, "wrappers '.*', not 'GrayscaleStack, StepEncoding, EpisodeStatistics'"),
    ],
)
def test_a_state_of_other_environments(other, message):
    envs, others = make_envs(**MADE), make_envs(**MADE | other)
    envs.reset(seed=0)
    others.reset(seed=0)
    before = save_state(others)
    with pytest.raises(ValueError, match=f"^the saved state is of environments with {message}$"):
        load_state(others, save_state(envs))
    check_same(save_state(others), before)


def test_a_state_of_another_version():
    envs = make_envs(**MADE)
    envs.reset(seed=0)
    lacking, unknown = save_state(envs), save_state(envs)
    del lacking["parts"][0]["arrays"]["walls"]
    unknown["parts"][0]["settings"][0]["max_walls"] = 3
    envs.step(np.zeros((2, 2), np.int64))
    before = save_state(envs)
    for state, message in ((lacking, "another version of MysteryPath-v0"), (unknown, "no option 'max_walls'")):
        with pytest.raises(ValueError, match=message):
            load_state(envs, state)
        check_same(save_state(envs), before)


def test_a_generator_of_no_known_kind():
    with pytest.raises(ValueError, match="unknown kind, 'seed'"):
        restored({"bit_generator": "seed"})


@pytest.mark.parametrize("part", ["environment", "wrapper"])
@pytest.mark.parametrize(
    "spoil",
    [
        lambda parts, at: parts.clear(),
        lambda parts, at: parts.__setitem__(at, {}),
        lambda parts, at: parts.__setitem__(at, None),
        lambda parts, at: parts[at].popitem(),
        lambda parts, at: parts[0]["arrays"].update(pos=np.zeros((2, 3), np.int64)),
        lambda parts, at: parts[0]["arrays"].update(path_cell=parts[0]["arrays"]["path_cell"][:1]),
        lambda parts, at: parts[0]["settings"].pop(),
    ],
    ids=["no parts", "no entries", "None", "one entry less", "shape", "lanes", "settings"],
)
def test_a_spoiled_state_changes_nothing(part, spoil):
    envs = make_envs("MysteryPath-v0", 2, step_encoding=True)
    envs.reset(seed=0)
    state = save_state(envs)
    spoil(state["parts"], 0 if part == "environment" else 1)
    envs.step(np.zeros((2, 2), np.int64))
    before = save_state(envs)
    with pytest.raises(ValueError, match="this is no state of MysteryPath-v0: "):
        load_state(envs, state)
    check_same(save_state(envs), before)


def test_what_is_no_state():
    envs = make_envs("MysteryPath-v0", 2)
    envs.reset(seed=0)
    for wrong in (None, {}, {"environments": {}}, {"environments": None, "parts": []}, "state"):
        with pytest.raises(ValueError, match="this is no state of environments: "):
            load_state(envs, wrong)
    for attempt in (save_state, lambda env: load_state(env, save_state(envs))):
        with pytest.raises(ValueError, match=r"a vector environment, by make_envs or gym\.make_vec, not of <"):
            attempt(gym.make("MysteryPath-v0"))


def test_environments_of_others_have_no_state():
    for envs in (make_envs("CueRecall-v0", 2), ClipReward(make_envs("MysteryPath-v0", 2), -1, 1)):
        envs.reset(seed=0)
        assert save_state(envs) is None
        with pytest.raises(ValueError, match="has parts of other packages, whose state cannot be set"):
            load_state(envs, save_state(make_envs("MysteryPath-v0", 2)))
