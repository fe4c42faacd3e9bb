"""Other autoreset modes than same-step, and a limit of steps: as Gymnasium's own vector environment does it."""

import re
import warnings
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as wrappers
from helpers import EACH, FAMILY, HASTY, ONE_OBS, check_same, make, roll
from test_lanes import CHANGED, LANES, LEVELS, OPTIONS, Told, check_resets_and_steps, mixed_actions, reset_both

from memory_gym_envs.old_gymnasium import warn_of

NEXT, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED


def both(env_id, mode, **arguments):
    """N environments of ours, and N single ones in Gymnasium's vector environment."""
    ours = gym.make_vec(env_id, num_envs=LANES, autoreset_mode=mode, **arguments)
    lanes = [lambda: Told(gym.make(env_id, disable_env_checker=True, **arguments))] * LANES
    return ours, SyncVectorEnv(lanes, autoreset_mode=mode)


@ONE_OBS
def test_next_step_is_gymnasiums(env_id, obs_type):
    ours, theirs = both(env_id, NEXT, obs_type=obs_type, **LEVELS[obs_type])
    resets = [
        (11, HASTY[FAMILY[env_id]], None),
        ([5, None, 0], OPTIONS[env_id], None),
        (None, CHANGED[FAMILY[env_id]], np.array([True, False, True])),  # some in the wait for a reset
        (None, None, None),
    ]
    check_resets_and_steps(ours, theirs, resets)


@EACH
def test_a_step_that_was_interrupted_skips_no_level(env_id, monkeypatch):
    """All episodes have just ended, so the step that is tried again resets all lanes."""
    envs, again = (make(env_id, autoreset_mode=NEXT, max_episode_steps=3) for _ in range(2))
    for each in (envs, again):
        each.reset(seed=5)
        roll(each, 3)
    with monkeypatch.context() as patch:
        patch.setattr(again.unwrapped, "advance", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            again.step(again.action_space.sample())
    actions = envs.action_space.sample()
    check_same(envs.step(actions), again.step(actions))


@EACH
def test_without_autoreset_the_caller_resets(env_id):
    ours, theirs = both(env_id, DISABLED)
    reset_both(ours, theirs, 3, HASTY[FAMILY[env_id]])
    rng, ended = np.random.default_rng(0), 0
    for _ in range(100):
        actions = mixed_actions(ours, rng)
        result = ours.step(actions)
        check_same(result, theirs.step(actions))
        over = result[2] | result[3]
        if over.any():
            ended += over.sum()
            with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
                ours.step(actions)
            reset_both(ours, theirs, None, HASTY[FAMILY[env_id]], over)
    assert ended > LANES


@EACH
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, NEXT])
def test_limit_of_steps_is_gymnasiums(env_id, mode):
    ours, theirs = both(env_id, mode, max_episode_steps=23)
    reset_both(ours, theirs, 0, None)
    rng, limits = np.random.default_rng(0), 0
    for _ in range(60):
        actions = mixed_actions(ours, rng)
        *result, infos = ours.step(actions)
        check_same(result, [*theirs.step(actions)[:4]])
        ended = infos.get("final_info", infos)
        if result[3].any():
            assert (ended["length"][result[3]] == 23).all()  # Gymnasium's do not know that the episode has ended
            limits += 1
    assert limits


def test_what_gymnasium_wraps():
    """Its wrappers of observations take no same-step autoreset."""
    envs = make("SearingSpotlights-v0", obs_type="vector", autoreset_mode=NEXT)
    assert envs.metadata["autoreset_mode"] is NEXT
    wrapped = wrappers.NormalizeObservation(wrappers.RecordEpisodeStatistics(envs))
    wrapped.reset(seed=0, options=HASTY[FAMILY["SearingSpotlights-v0"]])
    *_, infos = zip(*roll(wrapped, 60), strict=True)
    ends = [info for info in infos if "episode" in info]
    assert ends
    for info in ends:
        assert np.array_equal(info["episode"]["l"][info["_episode"]], info["length"][info["_episode"]])


WRONG_BEFORE_1_4 = pytest.mark.parametrize(
    ("wrapper", "words"),
    [
        (wrappers.RecordEpisodeStatistics, "leaves out the first step .* Use Gymnasium 1.4 or later, or .*NEXT_STEP"),
        (wrappers.NormalizeReward, "adds up rewards beyond the end of an episode. Use Gymnasium 1.4 or later"),
    ],
)


@pytest.fixture
def old_gymnasium(monkeypatch):
    """Let memory_gym_envs take this Gymnasium for an older one, of which it has not warned yet."""
    monkeypatch.setattr(gym, "__version__", "1.3.0")
    warn_of.cache_clear()
    yield
    warn_of.cache_clear()


def warnings_of(reset):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        reset(seed=0)
    return [str(each.message) for each in caught]


@WRONG_BEFORE_1_4
def test_old_wrappers_are_told(wrapper, words, old_gymnasium):
    """Once in a process, wherever among others the wrapper is; and nobody else is told."""
    envs = make("MysteryPath-v0")
    for fine in (envs, wrappers.ClipReward(envs, 0, 1), wrapper(make("MysteryPath-v0", autoreset_mode=NEXT))):
        assert warnings_of(fine.reset) == []
    wrapped = wrappers.ClipReward(type("Own", (wrapper,), {})(wrappers.ClipReward(envs, 0, 1)), 0, 1)
    (told,) = warnings_of(wrapped.reset)
    assert re.search(
        f"vector.{wrapper.__name__} of Gymnasium 1.3.0 is wrong with same-step autoreset: it {words}", told
    )
    assert warnings_of(wrapped.reset) == []


@WRONG_BEFORE_1_4
def test_wrappers_of_this_version_are_right_or_told(wrapper, words):
    """Four steps of reward 1 an episode: their number, and the discounted return from 1 on in each."""
    warn_of.cache_clear()
    envs = wrapper(make("MysteryPath-v0", options={"max_steps": 4, "reward_step": 1.0, "reward_path_progress": 0.0}))
    told, lengths, returns = warnings_of(envs.reset), [], []
    for step in range(1, 13):
        infos = envs.step(np.zeros((4, 2), int))[-1]
        if step % 4:
            returns += getattr(envs, "accumulated_reward", np.array([])).tolist()
        lengths += [*infos.get("episode", {}).get("l", [])]
    right = set(lengths) <= {4} and set(np.round(returns, 4)) <= {1, 1.99, 2.9701}
    assert lengths or returns
    assert right != bool(told)


@EACH
def test_the_wait_for_a_reset_is_part_of_the_state(env_id):
    envs, other = (make(env_id, autoreset_mode=NEXT) for _ in range(2))
    envs.reset(seed=0, options=HASTY[FAMILY[env_id]])
    while not envs._over.any():
        envs.step(envs.action_space.sample())
    other.set_state(envs.get_state())
    check_same(roll(envs, 50), roll(other, 50))


def test_modes_by_name_and_wrong_ones():
    assert make("MysteryPath-v0", autoreset_mode="NextStep").autoreset_mode is NEXT
    with pytest.raises(ValueError, match=r"autoreset_mode must be one of .*'NextStep'.*, not 'next'") as error:
        make("MysteryPath-v0", autoreset_mode="next")
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="max_episode_steps must be an integer of at least 1, not 0"):
        make("MysteryPath-v0", max_episode_steps=0)
