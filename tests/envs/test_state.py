"""An environment's state: it can be copied, nobody else has a hand in it, and no episode leaves anything behind."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from helpers import EACH, EACH_OBS, FAMILY, HASTY, ONE_OBS, check_same, make, roll

from memory_gym_envs.players import choices


@ONE_OBS
@pytest.mark.parametrize(
    ("clone", "num_levels"),
    [(lambda e: pickle.loads(pickle.dumps(e)), None), (copy.deepcopy, 5)],
    ids=["pickle", "deepcopy of levels"],
)
def test_copies_have_the_same_future(env_id, obs_type, clone, num_levels):
    envs = make(env_id, obs_type=obs_type, num_levels=num_levels)
    envs.reset(seed=1, options=HASTY[FAMILY[env_id]] | {"agent_scale": 0.3})
    roll(envs, 40)
    twin = clone(envs)
    check_same(roll(envs, 50, seed=2), roll(twin, 50, seed=2))
    for ours, theirs in zip(envs.np_random, twin.np_random, strict=True):
        assert ours is not theirs
        assert ours.bit_generator.state == theirs.bit_generator.state


@EACH
def test_closing_one_leaves_the_others(env_id):
    first, second = gym.make(env_id, render_mode="rgb_array"), gym.make(env_id, render_mode="rgb_array")
    vector = make(env_id)
    for each in (first, second, vector):
        each.reset(seed=0)
    first.close()
    first.close()
    vector.close()
    second.step(second.action_space.sample())
    assert second.render().shape == (84, 84, 3)


@ONE_OBS
def test_returned_arrays_are_the_callers(env_id, obs_type):
    """Overwriting everything that was returned changes nothing later."""
    envs, twin = make(env_id, obs_type=obs_type), make(env_id, obs_type=obs_type)
    results = [envs.reset(seed=0)]
    twin.reset(seed=0)
    for _ in range(3):
        spoil(results.pop())
        for left, right in zip(roll_and_spoil(envs, 30), roll(twin, 30), strict=True):
            check_same(left, right)
        results.append(envs.reset())
        twin.reset()


def roll_and_spoil(envs, steps):
    rng = np.random.default_rng(0)
    for _ in range(steps):
        result = envs.step(rng.integers(0, choices(envs), envs.action_space.shape))
        yield copy.deepcopy(result)
        spoil(result)


def spoil(part):
    if isinstance(part, np.ndarray) and part.dtype == object:
        for each in part:
            spoil(each)
    elif isinstance(part, np.ndarray):
        part.fill(77)
    elif isinstance(part, dict):
        for each in part.values():
            spoil(each)
    elif isinstance(part, (tuple, list)):
        for each in part:
            spoil(each)


@EACH_OBS
def test_an_observation_depends_on_this_episode_alone(env_id, obs_type):
    """The original shows the last episode's agent until the new one moves."""
    env, fresh = gym.make(env_id, obs_type=obs_type), gym.make(env_id, obs_type=obs_type)
    still = np.zeros_like(env.action_space.sample())
    env.reset(seed=1, options=HASTY[FAMILY[env_id]])
    over = False
    while not over:
        _, _, terminated, truncated, _ = env.step(still + choices(env.unwrapped.batch) - 1)
        over = terminated or truncated
    check_same(env.reset(seed=8), fresh.reset(seed=8))
    for _ in range(5):
        check_same(env.step(still), fresh.step(still))


@EACH_OBS
def test_a_single_environment_goes_on_from_its_state(env_id, obs_type):
    arguments = {"obs_type": obs_type, "options": HASTY[FAMILY[env_id]]}
    env, other = (gym.make(env_id, **arguments).unwrapped for _ in range(2))
    env.reset(seed=3, options={"agent_scale": 0.3})
    other.reset(seed=8)
    actions = [env.action_space.sample() for _ in range(60)]
    play_on(env, actions[:30])
    state = env.get_state()
    first = play_on(env, actions[30:])
    for each in (other, env):  # the state is as it was
        each.set_state(state)
        check_same(first, play_on(each, actions[30:]))


def play_on(env, actions):
    """All that steps return, with resets where an episode has ended."""
    results = []
    for action in actions:
        results.append(env.step(action))
        if results[-1][2] or results[-1][3]:
            results.append(env.reset())
    return results


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"id": "MysteryPath-Grid-v0"}, "of one with id 'MysteryPath-Grid-v0', not 'MysteryPath-v0'"),
        ({"id": "MortarMayhem-v0"}, "of one with id 'MortarMayhem-v0', not 'MysteryPath-v0'"),  # it has other options
        ({"obs_type": "vector"}, "the saved state is of one with obs_type 'vector', not 'pixels'"),
        ({"num_levels": 4}, "the saved state is of one with num_levels 4, not 0"),
        ({"options": {"max_steps": 9}}, "the saved state is of one with options {'max_steps': 9, "),
    ],
)
def test_the_state_of_another_environment(other, message):
    env, theirs = gym.make("MysteryPath-v0").unwrapped, gym.make(**{"id": "MysteryPath-v0", **other}).unwrapped
    theirs.reset(seed=0)
    check_refused(env, theirs.get_state(), message)


@pytest.mark.parametrize(
    "other",
    [
        {"id": "MysteryPath-Grid-v0"},
        {"num_envs": 2},
        {"obs_type": "vector"},
        {"num_levels": 4},
        {"start_level": 4},
        {"max_episode_steps": 20},
        {"autoreset_mode": "NextStep"},
        {"options": {"max_steps": 9}},
    ],
)
def test_the_state_of_another_vector_environment(other):
    """Ids of a family have arrays of the same shapes."""
    arguments = {"id": "MysteryPath-v0", "num_envs": 3}
    envs, theirs = (gym.make_vec(**arguments | changes) for changes in ({}, other))
    for each in (envs, theirs):
        each.reset(seed=0)
    before = pickle.dumps(envs.get_state())
    ((name, value),) = other.items()
    with pytest.raises(ValueError, match=f"the saved state is of one with {name} {repr(value).rstrip('}')}.*, not "):
        envs.set_state(theirs.get_state())
    for state in ({}, None):
        with pytest.raises(ValueError, match=f"this is no state of MysteryPath-v0: {state}"):
            envs.set_state(state)
    assert pickle.dumps(envs.get_state()) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.pop("settings"), "this is no state of MysteryPath-v0: KeyError"),
        (lambda state: state.update(arrays=None), "this is no state of MysteryPath-v0: AttributeError"),
        (lambda state: state["arrays"].update(length=[1, 2, 3]), "this is no state of MysteryPath-v0: AttributeError"),
        (lambda state: state["arrays"].update(pos=np.zeros((3, 2))), "its array pos is of float64, not of int64"),
        (lambda state: state.update(ready=1), "its ready must be like True, not 1"),
        (lambda state: state.update(_over=np.zeros(3)), "its _over must be like .*False.*, not array"),
        (lambda state: state.update(_seeds=[1, 2.0, 3]), "its _seeds must be integers or None, not 2.0"),
        (lambda state: state.update(settings=[{}, None, {}]), "its settings must be reset options, not None"),
    ],
)
def test_a_state_that_is_not_whole(change, message):
    envs = gym.make_vec("MysteryPath-v0", num_envs=3, num_levels=5)
    envs.reset(seed=0)
    state = envs.get_state()
    change(state)
    check_unchanged(envs, state, message)


def check_unchanged(envs, state, message):
    """One line says what is wrong with the vector environment's state, and it goes on as it was."""
    before = pickle.dumps(envs.get_state())
    with pytest.raises(ValueError, match=message) as error:
        envs.set_state(state)
    assert "\n" not in str(error.value)
    assert pickle.dumps(envs.get_state()) == before


PCG = np.random.PCG64(0).state


@pytest.mark.parametrize("name", ["_rngs", "_level_rngs"])
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (5, "must be states of generators or None, not 5"),
        ("PCG64", "must be states of generators or None, not 'PCG64'"),
        ({"state": PCG["state"]}, "must be states of generators or None, not {'state'"),
        (np.random.default_rng(0), "must be states of generators or None, not Generator"),
        ({**PCG, "bit_generator": "PCG65"}, "a generator of an unknown kind, 'PCG65'"),
        ({"bit_generator": "PCG64"}, "a generator that is no PCG64: KeyError"),
        ({**PCG, "state": None}, "a generator that is no PCG64: TypeError"),
        ({**PCG, "state": {"state": 2**200, "inc": 1}}, "a generator that is no PCG64: OverflowError"),
        ({**PCG, "bit_generator": "SFC64"}, "a generator that is no SFC64: "),
        ({"bit_generator": "MT19937", "state": {"key": [1], "pos": 0}}, "a generator that is no MT19937: IndexError"),
    ],
)
def test_generators_that_are_none(name, wrong, message):
    """Of the last lane: the others must not be taken over, either."""
    envs, env = gym.make_vec("MysteryPath-v0", num_envs=3, num_levels=5), gym.make("MysteryPath-v0").unwrapped
    envs.reset(seed=0)
    roll(envs, 3)
    other = gym.make_vec("MysteryPath-v0", num_envs=3, num_levels=5)
    other.reset(seed=7)
    state = other.get_state()
    state[name][2] = wrong
    check_unchanged(envs, state, message)
    env.reset(seed=0)
    state = env.get_state()
    state["batch"][name][0] = wrong
    check_refused(env, state, message)


def test_options_of_the_state_of_another_version():
    """It may have saved none, or not all of them."""
    envs = gym.make_vec("MysteryPath-v0", num_envs=2)
    envs.reset(seed=0)
    state = envs.get_state()
    before = pickle.dumps(state)
    for made_with in ({"options": {}}, {"options": {"max_steps": 512}}):
        envs.set_state({**state, "made_with": {**state["made_with"], **made_with}})
    state["made_with"].pop("options")
    envs.set_state(state)
    assert pickle.dumps(envs.get_state()) == before
    envs.get_state()["made_with"]["options"]["max_steps"] = 3  # the caller's own
    assert pickle.dumps(envs.get_state()) == before


def test_what_is_no_state():
    env = gym.make("MysteryPath-v0").unwrapped
    env.reset(seed=0)
    check_refused(env, None, "TypeError")
    check_refused(env, {}, "KeyError('needs_reset')")
    check_refused(env, {**env.get_state(), "needs_reset": "no"}, "its needs_reset must be True or False, not 'no'")
    for change, message in (
        ({"settings": [{"arena_size": 3}]}, "MysteryPath-v0 has no option 'arena_size'"),
        ({"settings": [{"max_steps": -2}]}, "option 'max_steps' must be"),
        ({"arrays": {}}, "the saved state is of another version of MysteryPath-v0"),
        ({"_rngs": []}, "its _rngs are of 0 lanes, not of 1"),
    ):
        state = env.get_state()
        check_refused(env, {**state, "batch": {**state["batch"], **change}}, message)
    state = env.get_state()
    state["batch"]["arrays"]["pos"] = np.zeros((2, 2), np.int64)
    check_refused(env, state, "its array pos has the shape (2, 2), not (1, 2)")


def check_refused(env, state, message):
    """One line says what is wrong with the state, and the environment is as it was."""
    env.reset(seed=0)
    before = pickle.dumps(env.get_state())
    with pytest.raises(ValueError, match="this is no state of this environment, MysteryPath-v0: ") as error:
        env.set_state(state)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert pickle.dumps(env.get_state()) == before
