"""Any options inside their documented ranges work, whatever the others are; any outside are told in one clear line.

Hypothesis makes the values from the rows of the options' tables: the same ones in every run. `MORE_EXAMPLES=10` in the
environment tries ten times as many, new ones every time.
"""

import os
import warnings

import gymnasium as gym
import numpy as np
import pytest
from helpers import EACH, FAMILY, ONE_OBS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from memory_gym_envs.options import LONGEST_LIST, brief
from memory_gym_envs.players import stumbling

TIMES = int(os.environ.get("MORE_EXAMPLES", 1))
LANES, STEPS = 5, 120
SECOND = np.array([False, False, False, True, True])  # the lanes that have other options than the rest


def examples(count):
    slow = [HealthCheck.too_slow, HealthCheck.data_too_large]
    return settings(
        max_examples=count * TIMES, derandomize=TIMES == 1, deadline=None, database=None, suppress_health_check=slow
    )


def rows(env_id):
    return FAMILY[env_id].variants[env_id].options


# ---- inside ----


def right_values(option):
    """Everything that the option allows: the ends of its range and small values more often than the rest."""
    low, high = option.bounds
    if option.kind == "bool":
        return st.booleans()
    if option.kind == "float":
        few, whole = st.sampled_from([low, high, option.default]), st.integers(int(np.ceil(low)), int(high))
        return few | whole | st.floats(low, high)
    number = st.sampled_from([low, high, *option.also]) | st.integers(low, min(low + 20, high)) | st.integers(low, high)
    if option.kind == "int":
        return number
    short = st.lists(number, min_size=0 if option.empty else 1, max_size=3)
    return short | short.map(lambda values: (values * LONGEST_LIST)[:LONGEST_LIST])


def right_options(env_id):
    return st.fixed_dictionaries({}, optional={option.name: right_values(option) for option in rows(env_id)})


@ONE_OBS
def test_every_option_in_its_range(env_id, obs_type):
    @examples(4)
    @given(seed=st.integers(0, 2**32), first=right_options(env_id), second=right_options(env_id))
    def check(seed, first, second):
        play(env_id, obs_type, seed, first, second)

    check()


def play(env_id, obs_type, seed, first, second):
    """Steps in which lanes with both options, playing well or badly, see and earn nothing but proper numbers."""
    envs = gym.make_vec(env_id, num_envs=LANES, obs_type=obs_type, render_mode="debug_rgb_array")
    rng, chances = np.random.default_rng(seed), np.array([0.1, 0.5, 1.0, 0.1, 1.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy's of an overflow, for example
        envs.reset(seed=seed, options=first)
        observations, infos = envs.reset(options={**second, "reset_mask": SECOND})
        check_step(envs, observations, np.zeros(LANES), infos)
        for _ in range(STEPS):
            observations, rewards, _, _, infos = envs.step(stumbling(envs, rng, chances))
            check_step(envs, observations, rewards, infos)
        assert all(frame.dtype == np.uint8 and frame.shape == (336, 336, 3) for frame in envs.render())


def check_step(envs, observations, rewards, infos):
    assert observations in envs.observation_space
    assert np.isfinite(rewards).all()
    # A Searing Spotlights agent may start up to two pixels outside the screen.
    assert ((infos["ground_truth"] >= 0) & (infos["ground_truth"] <= 86 / 84)).all()
    for name, values in infos.get("final_info", {}).items():
        assert np.isfinite(values).all(), name
    for lane in np.flatnonzero(infos.get("_final_obs", ())):
        assert infos["final_obs"][lane] in envs.single_observation_space


# ---- outside ----


def wrong_values(option):
    """Everything else: numbers beyond the range, other types, and for lists one such entry or too many."""
    other_types = [st.none(), st.text(max_size=20), st.dictionaries(st.text(), st.none(), max_size=2)]
    other_types += [st.sampled_from([np.zeros((3, 3), int), np.array(1), 1j, (), object, 10**5000, -(10**5000)])]
    if option.kind == "bool":
        return st.one_of(st.integers(), st.floats(), *other_types)
    single, short = wrong_numbers(option), st.lists(right_numbers(option), min_size=1, max_size=3)
    if option.kind != "ints":
        return st.one_of(single, st.booleans(), st.lists(st.integers(), max_size=3), *other_types)
    with_one_wrong = st.tuples(short, single | st.booleans() | st.none(), short).map(lambda t: [*t[0], t[1], *t[2]])
    too_long = short.map(lambda values: (values * (LONGEST_LIST + 1))[: LONGEST_LIST + 1])
    wrong = st.one_of(st.integers(), st.floats(), with_one_wrong, too_long, *other_types)
    return wrong.filter(lambda value: not option.empty or not isinstance(value, tuple))


def right_numbers(option):
    return st.integers(*option.bounds)


def wrong_numbers(option):
    low, high = option.bounds
    outside = st.integers(max_value=int(np.ceil(low)) - 1) | st.integers(min_value=int(high) + 1)
    outside = outside.filter(lambda number: number not in option.also) | st.sampled_from([10**400, -(10**400), 2**63])
    if option.kind == "float":
        below, above = st.floats(max_value=low, exclude_max=True), st.floats(min_value=high, exclude_min=True)
        return outside | below | above | st.just(np.nan)
    return outside | st.floats().filter(lambda number: not number.is_integer())


@EACH
def test_any_value_outside_its_range(env_id):
    envs, env = gym.make_vec(env_id, num_envs=2), gym.make(env_id)
    envs.reset(seed=0)
    env.reset(seed=0)
    named = [st.tuples(st.just(option.name), wrong_values(option)) for option in rows(env_id)]

    @examples(50)
    @given(wrong=st.one_of(named), others=right_options(env_id))
    def check(wrong, others):
        name, value = wrong
        for each in (envs, env):
            check_refused(each, {**others, name: value}, f"option {name!r} must be ")

    check()


@EACH
def test_any_unknown_name(env_id):
    env = gym.make(env_id)
    known = {option.name for option in rows(env_id)}
    names = st.one_of(st.text(max_size=200), st.integers(), st.none(), st.just(10**5000)).filter(
        lambda n: n not in known
    )

    @examples(15)
    @given(name=names, others=right_options(env_id))
    def check(name, others):
        check_refused(env, {**others, name: 1}, f"no option {brief(name)}; the nearest is ")

    check()


def check_refused(env, options, part):
    with pytest.raises(ValueError, match=r"option") as error:
        env.reset(seed=1, options=options)
    message = str(error.value)
    assert part in message
    assert len(message.splitlines()) == 1
    assert len(message) < 400
