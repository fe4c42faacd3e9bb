"""Environments of other packages: whatever they show and say is right in the numbers, or one line says what is wrong.

Lanes of the small environments here know their number: they are made in order.
"""

import itertools
import multiprocessing
import os
import random
import signal
import sys
import threading
import types
from pathlib import Path

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from conftest import SCRIPTS, parse_args
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from test_environments import box, register, roll

import evaluate
import ppo_gru
import ppo_trxl
from ppo_utils import environments, evaluation, runs, video
from ppo_utils.checkpoints import read_model
from ppo_utils.environments import env_actions, envs_for, find_spec, make_envs
from ppo_utils.errors import LaneError, RunError
from ppo_utils.infos import final_numbers, ground_truth_of, tell_left_out
from ppo_utils.lanes import Levels, make_lane
from ppo_utils.observations import Part, WrongValue
from ppo_utils.video import LaneVideo, as_image, even, video_writer

EACH_SCRIPT = pytest.mark.parametrize("script", SCRIPTS)
NUMBER = box(-np.inf, np.inf, (1,))


class Small(gym.Env):
    """An environment whose every step is what functions of it return: of `number` (its lane), `episode` and `t`.

    All functions are arguments, so that a test can say in a line what is odd about its environment.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, count=None, space=NUMBER, length=3, see=None, earn=None, tell=None, draw=None, render_mode=None):
        self.number = next(count) if count else 0
        self.observation_space, self.action_space = space, gym.spaces.Discrete(2)
        self.length, self.see, self.earn, self.tell, self.draw = length, see, earn, tell, draw
        self.render_mode, self.episode, self.seeds = render_mode, -1, []

    def _now(self):
        observation = np.full(1, self.t, np.float32) if self.see is None else self.see(self)
        return observation, {} if self.tell is None else self.tell(self)

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        self.episode, self.t, self.ended = self.episode + 1, 0, False
        return self._now()

    def step(self, action):
        self.action, self.t = action, self.t + 1
        self.ended = self.t == (self.length(self) if callable(self.length) else self.length)
        observation, info = self._now()
        return observation, 1.0 if self.earn is None else self.earn(self), self.ended, False, info

    def render(self):
        return self.draw(self)


def small(**arguments):
    return register(lambda **more: Small(**arguments, **more))


def lanes(envs):
    return [each.unwrapped for each in envs.unwrapped.envs]


# ---- numbers ----
KINDS = [0, 0.5, True, np.float32(2.5), np.array([3.0]), 10**30, np.int64(7), torch.tensor(1.5)]
NO_NUMBERS = [None, "text", np.zeros(2), [1, 2], {"a": 1}, float("nan"), 10**400]


@pytest.mark.parametrize("order", [1, -1, 3], ids=["as they are", "backwards", "rotated"])
def test_a_metric_is_what_each_lane_said(order, capfd):
    """Gymnasium makes an array of the first lane's type, in which 0.5 after 0 is 0, and 3 after False is True."""
    tell_left_out.cache_clear()
    kinds = [*KINDS, *NO_NUMBERS]
    kinds = kinds[order:] + kinds[:order] if order > 1 else kinds[::order]
    env_id = small(count=itertools.count(), tell=lambda env: {"score": kinds[env.number]} if env.ended else {})
    envs = make_envs(env_id, len(kinds), seed=1)
    envs.reset()
    *_, infos = [*roll(envs, 3)][-1]
    found = final_numbers(infos, np.ones(len(kinds), bool))["score"]
    expected = [
        np.nan if any(kind is each for each in NO_NUMBERS) else float(np.asarray(kind).item()) for kind in kinds
    ]
    assert found.dtype == np.float64
    np.testing.assert_equal(found, expected)
    line = "score, in the info that ends an episode, is no finite number there, and is left out\n"
    assert capfd.readouterr().err.count(line) == 1


def test_infos_that_gymnasium_cannot_batch():
    """Arrays that grow, keys that come and go, an `episode` and a `final_info` of one's own."""

    def tell(env):
        info = {"seen": np.zeros(env.t), "episode": {"r": 99.0, "l": 99}, "final_info": 5, "score": env.number}
        return info | {"once": "only here"} if env.t == env.number else info

    envs = make_envs(small(count=itertools.count(), tell=tell), 3, seed=1)
    envs.reset()
    *_, infos = [*roll(envs, 3)][-1]
    assert infos["episode"]["r"].tolist() == [3.0, 3.0, 3.0]
    assert final_numbers(infos, np.ones(3, bool))["score"].tolist() == [0, 1, 2]


@EACH_SCRIPT
def test_over_how_many_episodes_a_mean_is(tiny, script, scalars):
    """Lanes 0 and 1 say it, lanes 2 and 3 do not: 16 steps are 5 episodes of each."""
    tell = lambda env: {"score": 0.5 * env.number, "score_count": 3} if env.number < 2 else {}  # noqa: E731
    found = scalars(script.main(tiny(script, env_id=small(count=itertools.count(), tell=tell))))
    assert found["episode/score"] == [0.25, 0.25]
    assert found["episode/score_count"] == [3, 3], "the environment's own"
    counts = {name: values for name, values in found.items() if name.startswith("episode_count/")}
    assert counts == {"episode_count/score": [10, 10], "episode_count/score_count": [10, 10]}


def test_evaluations_say_which_metric_they_leave_out(tiny, capfd, scalars):
    evaluation.tell_incomplete.cache_clear()
    tell = lambda env: {"success": 1.0} if env.ended and env.number % 2 else {}  # noqa: E731
    args = tiny(env_id=small(count=itertools.count(), tell=tell), eval_interval=1, eval_levels=2)
    found = scalars(ppo_gru.main(args))
    assert "eval/return" in found
    assert "eval/success" not in found
    assert capfd.readouterr().err.count("evaluations leave out success: not all of their episodes report it\n") == 1


# ---- ground truth ----
@pytest.mark.parametrize(("reports", "lane"), [
    (lambda env: env.number % 2, 0), (lambda env: env.number != 2, 2), (lambda env: env.t == 0, 0)
])  # fmt: skip
def test_a_ground_truth_that_not_all_report(reports, lane, tiny):
    tell = lambda env: {"ground_truth": np.ones(2)} if reports(env) else {}  # noqa: E731
    message = f"every info, of every reset and step; environment {lane} reports none; use 0"
    with pytest.raises(RunError, match=f"--ground-truth-coef needs ground_truth in {message}"):
        ppo_gru.main(tiny(env_id=small(count=itertools.count(), tell=tell), ground_truth_coef=0.1))


def test_the_environments_of_a_second_process_have_the_numbers_that_follow(tiny):
    _, infos = make_envs(small(), 2, seed=1, first_lane=6).reset()
    with pytest.raises(RunError, match="environment 6 reports none"):
        ground_truth_of(infos, tiny(ground_truth_coef=0.1))


@pytest.mark.parametrize("truth", ["text", np.nan, [[1.0]], None, lambda env: np.ones(1 + env.t)])
def test_a_ground_truth_that_is_none(tiny, truth):
    tell = lambda env: {"ground_truth": truth(env) if callable(truth) else truth}  # noqa: E731
    with pytest.raises(RunError, match="--ground-truth-coef needs ground_truth in every info"):
        ppo_gru.main(tiny(env_id=small(tell=tell), ground_truth_coef=0.1))


def test_the_ground_truth_is_each_lanes(tiny):
    tell = lambda env: {"ground_truth": [env.number, env.t]}  # noqa: E731
    envs = make_envs(small(count=itertools.count(), tell=tell), 3, seed=1)
    args = tiny(ground_truth_coef=0.1)
    assert ground_truth_of(envs.reset()[1], args).tolist() == [[0, 0], [1, 0], [2, 0]]
    *_, infos = next(roll(envs, 1))
    assert ground_truth_of(infos, args).tolist() == [[0, 1], [1, 1], [2, 1]]


def test_a_mask_of_integers_says_who_reports_a_ground_truth(tiny):
    args, infos = tiny(ground_truth_coef=0.1), {"ground_truth": np.eye(3)}
    assert np.array_equal(ground_truth_of({**infos, "_ground_truth": np.ones(3, np.int8)}, args), np.eye(3))
    with pytest.raises(RunError, match="environment 1 reports none"):
        ground_truth_of({**infos, "_ground_truth": np.array([1, 0, 1])}, args)


# ---- observations ----
PICTURE = box(0, 255, (40, 48, 3), np.uint8)


def test_parts_are_found_at_any_depth():
    inside = gym.spaces.Dict({"eye": PICTURE, "hand": gym.spaces.Tuple((gym.spaces.Discrete(3, start=-1), NUMBER))})
    space = gym.spaces.Tuple((inside, gym.spaces.Dict({"deeper": gym.spaces.Dict({"eye": PICTURE})})))
    shown = []
    envs = make_envs(small(space=space, see=lambda env: shown.append(space.sample()) or shown[-1]), 1, seed=0)
    parts = {name: part.shape for name, part in envs.single_observation_space.items()}
    assert parts == {"0.eye": (40, 48, 3), "0.hand.0": (3,), "0.hand.1": (1,), "1.deeper.eye": (40, 48, 3)}
    observations, _ = envs.reset()
    assert np.array_equal(observations["0.eye"][0], shown[-1][0]["eye"])
    assert np.array_equal(observations["1.deeper.eye"][0], shown[-1][1]["deeper"]["eye"])
    assert observations["0.hand.0"][0].tolist() == [float(shown[-1][0]["hand"][0] == each) for each in (-1, 0, 1)]
    assert observations["0.hand.1"][0] == shown[-1][0]["hand"][1]
    assert observations["0.eye"].dtype == np.uint8


def test_two_parts_with_one_name():
    space = gym.spaces.Dict({"a.b": NUMBER, "a": gym.spaces.Dict({"b": NUMBER})})
    with pytest.raises(ValueError, match="two parts have the same name"):
        make_envs(small(space=space), 1)


@pytest.mark.parametrize(("shape", "joined"), [
    ((4, 40, 48, 3), lambda shown: np.concatenate([*shown], -1)),
    ((40, 48, 3, 2), lambda shown: shown.reshape(40, 48, 6)),
    ((4, 3, 40, 48), lambda shown: shown.reshape(12, 40, 48).transpose(1, 2, 0)),
])  # fmt: skip
def test_a_stack_of_pictures_is_one_of_more_channels(shape, joined):
    shown = []
    space = box(0, 255, shape, np.uint8)
    envs = make_envs(small(space=space, see=lambda env: shown.append(space.sample()) or shown[-1]), 1, seed=0)
    assert np.array_equal(envs.reset()[0]["observation"][0], joined(shown[-1]))


@pytest.mark.parametrize(("low", "high", "dtype"), [
    (0, 1, np.uint8), (16, 235, np.uint8), (5, 5, np.uint8), (0, 9, np.int64), (-1, 1, np.float32), (0, 255, np.float32)
])  # fmt: skip
def test_pictures_are_scaled_by_their_bounds(low, high, dtype):
    shown, space = [], box(low, high, (40, 48, 1), dtype)
    envs = make_envs(small(space=space, see=lambda env: shown.append(space.sample()) or shown[-1]), 1, seed=0)
    part, (observations, _) = envs.single_observation_space["observation"], envs.reset()
    assert (part.low.min(), part.high.max(), part.dtype) == (0, 1, np.float32)
    scaled = (shown[-1] - float(low)) / max(high - low, 1)
    assert observations["observation"].dtype == np.float32
    assert observations["observation"][0] == pytest.approx(scaled, abs=1e-7)


def test_an_environment_that_returns_the_same_array_at_every_step():
    """Its last observation is not the next episode's first one, nor is that of its parts."""
    one = {"a": np.zeros(1, np.float32), "b": (np.zeros(1, np.float32),)}

    def see(env):
        one["a"][:] = one["b"][0][:] = env.t
        return one

    space = gym.spaces.Dict({"a": NUMBER, "b": gym.spaces.Tuple((NUMBER,))})
    envs = make_envs(small(space=space, see=see, length=5), 1, seed=0, frame_stack=2)
    envs.reset()
    observations, *_, infos = [*roll(envs, 5)][-1]
    assert {name: part[0].tolist() for name, part in observations.items()} == {"a": [0, 0], "b.0": [0, 0]}
    assert {name: part.tolist() for name, part in infos["final_obs"][0].items()} == {"a": [4, 5], "b.0": [4, 5]}


WRONG = [
    (gym.spaces.MultiDiscrete([4, 4]), np.array([1, 4]), "observation is 4, outside of 0 to 3"),
    (gym.spaces.Discrete(5), -1, "observation is -1, outside of 0 to 4"),
    (gym.spaces.Discrete(5, start=2), 7, "observation is 7, outside of 2 to 6"),
    (NUMBER, np.array([np.nan], np.float32), "observation has an entry nan"),
    (box(-1, 1, (40, 40, 3)), np.full((40, 40, 3), np.inf, np.float32), "observation has an entry inf"),
    (box(0, 1, (40, 40, 3)), np.full((40, 40, 3), 7, np.float32), r"observation is 7\.0, outside of 0\.0 to 1\.0"),
    (gym.spaces.MultiBinary(2), np.array([0, 5], np.int8), "observation is 5, outside of 0 to 1"),
    (gym.spaces.Dict({"a": gym.spaces.Tuple((gym.spaces.Discrete(2),))}), {"a": (2,)}, r"a\.0 is 2, outside of 0 to 1"),
]


@pytest.mark.parametrize(("space", "wrong", "message"), WRONG, ids=[case[2] for case in WRONG])
@pytest.mark.parametrize("last", [False, True], ids=["in an episode", "at its end"])
def test_a_wrong_observation_is_one_line(space, wrong, message, last):
    def see(env):
        return wrong if env.number == 1 and env.episode == 2 and env.t == (3 if last else 2) else right

    right = space.sample() if space is not NUMBER else np.zeros(1, np.float32)
    env_id = small(count=itertools.count(), space=space, see=see)
    envs = make_envs(env_id, 2, seed=3, first_lane=4)
    seed, steps = lanes(envs)[1].seeds[0], 3 * 1 + (3 if last else 2)
    envs.reset()
    where = rf"environment 5, step {steps} since its reset with seed {seed}"
    with pytest.raises(RunError, match=rf"^{env_id}: {message} \({where}\)$"):
        [*roll(envs, 10)]


@EACH_SCRIPT
@pytest.mark.parametrize(("what", "earned"), [("observation", 1.0), ("reward", np.inf), ("reward", 1e39)])
def test_a_training_stops_before_what_is_not_finite(tiny, script, what, earned):
    """In float32, as 1e39 is not. The line names the level and the last checkpoint, not the learning rate."""
    levels = []

    def bad(env, now):
        if not (env.number == 2 and env.episode == 8 and env.t == 1 and what == now):
            return False
        levels.append(env.seeds[-1])
        return True

    see = lambda env: np.array([np.nan if bad(env, "observation") else 0.0], np.float32)  # noqa: E731
    earn = lambda env: earned if bad(env, "reward") else 1.0  # noqa: E731
    env_id = small(count=itertools.count(), see=see, earn=earn)
    args = tiny(script, env_id=env_id, checkpoint_interval=1, observe_last_action=True)
    with pytest.raises(RunError) as error:
        script.main(args)
    says = "observation has an entry nan" if what == "observation" else f"the reward is {earned}"
    where = f"environment 2, step 1 since its reset with seed {levels[0]}"
    assert f"iteration 2: {args.env_id}: {says} ({where})" in str(error.value)
    assert 0 <= levels[0] < args.num_levels
    assert "the last checkpoint is runs/" in str(error.value)
    assert "checkpoint-64.pt" in str(error.value)
    assert "init-lr" not in str(error.value)


class Together(gym.vector.VectorEnv):
    """A vector environment that resets in the same step; its final_obs is one array for all lanes, or objects.

    kind: the type of what says that an episode ended.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs, as_objects, nested, kind=bool, render_mode=None):
        self.num_envs, self.as_objects, self.nested, self.kind = num_envs, as_objects, nested, kind
        self.single_action_space = gym.spaces.Discrete(2)
        self.action_space = gym.spaces.MultiDiscrete([2] * num_envs)
        self.single_observation_space = gym.spaces.Dict({"a": NUMBER, "b": NUMBER}) if nested else NUMBER
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)

    def _observations(self, values):
        values = values.astype(np.float32)[:, None]
        return {"a": values, "b": -values} if self.nested else values

    def reset(self, *, seed=None, options=None):
        self.t = np.zeros(self.num_envs)
        return self._observations(self.t), {}

    def step(self, actions):
        self.t += 1
        ended, last = self.t == 2 + np.arange(self.num_envs), self._observations(self.t)
        self.t[ended] = 0
        infos = {}
        if ended.any():
            final = last
            if self.as_objects:
                final = np.full(self.num_envs, None)
                for lane in np.flatnonzero(ended):
                    final[lane] = {k: v[lane] for k, v in last.items()} if self.nested else last[lane]
            infos = {"final_obs": final, "_final_obs": ended, "final_info": {"score": 3 * self.t + 1}}
        truncated = np.zeros(self.num_envs, self.kind)
        return self._observations(self.t), np.ones(self.num_envs), ended.astype(self.kind), truncated, infos


def test_ends_that_are_no_bools(tiny):
    trained = []
    for kind in (bool, np.int8, np.float32, object):
        env_id = f"Ends-{kind.__name__}-v0"
        gym.register(env_id, vector_entry_point=Together, kwargs={"as_objects": True, "nested": False, "kind": kind})
        folder = ppo_gru.main(tiny(env_id=env_id, total_timesteps=64, save_model=True))
        trained.append(read_model(folder / "model.pt")["weights"])
    for weights in trained[1:]:
        assert all(weight.equal(trained[0][name]) for name, weight in weights.items())


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("as_objects", [False, True])
def test_vector_environments_of_others(as_objects, nested):
    env_id = f"Together{as_objects}{nested}-v0"
    gym.register(env_id, vector_entry_point=Together, kwargs={"as_objects": as_objects, "nested": nested})
    envs = make_envs(env_id, 3, seed=0, frame_stack=2)
    envs.reset()
    for t, (observations, *_, infos) in enumerate(roll(envs, 4), 1):
        name = "b" if nested else "observation"
        sign = -1 if nested else 1
        if 2 <= t <= 4:
            lane = t - 2
            assert infos["final_obs"][lane][name].tolist() == [sign * (t - 1), sign * t]
            if t < 4:
                assert observations[name][lane].tolist() == [0, 0]
            assert final_numbers(infos, np.arange(3) == lane)["score"][lane] == 1


@pytest.mark.parametrize("seed", range(1, 31))
def test_seeds_fit_in_31_bits(seed):
    assert all(0 <= lane.seeds[0] < 2**31 for lane in lanes(make_envs(small(), 3, seed=seed, first_lane=1000)))


# ---- levels ----
def test_levels_of_other_packages_are_seeds(tiny):
    """Resets take seeds of the set, all of them and each as often; evaluation takes those after it."""
    envs = make_envs(small(length=1), 4, seed=1, num_levels=5, start_level=20)
    envs.reset()
    list(roll(envs, 100))
    seeds = [seed for lane in lanes(envs) for seed in lane.seeds[1:]]
    assert set(seeds) == {20, 21, 22, 23, 24}
    assert np.bincount(seeds)[20:].min() > 50
    assert len({tuple(lane.seeds[1:]) for lane in lanes(envs)}) == 4, "each lane draws its own"
    again = make_envs(small(length=1), 4, seed=1, num_levels=5, start_level=20)
    again.reset()
    list(roll(again, 100))
    assert [lane.seeds for lane in lanes(again)] == [lane.seeds for lane in lanes(envs)]
    args = tiny(num_levels=5, start_level=20)
    assert evaluation.evaluation_levels(args, 2, 1) == [25, 26]


def test_without_levels_resets_have_no_seed():
    envs = make_envs(small(length=1), 2, seed=1)
    envs.reset()
    list(roll(envs, 3))
    assert all(lane.seeds[1:] == [None] * 4 for lane in lanes(envs))


# ---- constructor arguments ----
class Sized(Small):
    def __init__(self, size, color="red", render_mode=None):
        super().__init__(space=box(0, 1, (size,)), see=lambda env: np.zeros(size, np.float32))


def test_constructor_arguments(tiny):
    args = parse_args(ppo_gru, "--env-id", register(Sized), "--env-kwargs", '{"size": 9}')
    assert envs_for(args, 2).single_observation_space["observation"].shape == (9,)
    assert make_envs("FrozenLake-v1", 1, env_kwargs={"map_name": "8x8"}).single_observation_space[
        "observation"
    ].shape == (64,)


@pytest.mark.parametrize(("env_id", "text", "message"), [
    (register(Sized), '{"sizes": 9}', "has no argument 'sizes'; it has size, color"),
    ("CartPole-v1", '{"size": 9}', "CartPole-v1 has no argument 'size'; it has sutton_barto_reward"),
    ("CartPole-v1", "[9]", '--env-kwargs must be a JSON object such as {"size": 9}, not [9]'),
    ("CartPole-v1", "{size", "--env-kwargs is no JSON"),
    ("MysteryPath-v0", '{"size": 9}', "MysteryPath-v0 has options"),
])  # fmt: skip
def test_wrong_constructor_arguments(tiny, env_id, text, message):
    with pytest.raises(ValueError, match=r"(?s).*") as error:
        envs_for(tiny(env_id=env_id, env_kwargs=text), 1)
    assert message in str(error.value)


# ---- processes of their own ----
@EACH_SCRIPT
def test_environments_in_processes_of_their_own(tiny, script, curves):
    args = tiny(script, env_id="CartPole-v1", observe_last_action=True)
    assert curves(script.main(args)) == curves(script.main(tiny(script, **{**vars(args), "async_envs": True})))


def test_an_error_in_another_process():
    def see(env):
        if env.t == 2:
            raise ValueError("no such room")
        return np.zeros(1, np.float32)

    envs = make_envs(small(see=see), 2, seed=1, asynchronous=True)
    envs.reset()
    with pytest.raises(RuntimeError, match=r"environment \d raised ValueError in step 2 .*: no such room"):
        list(roll(envs, 3))
    envs.close()


@pytest.mark.parametrize("async_envs", [False, True])
def test_an_error_that_sounds_as_if_memory_were_too_small(tiny, async_envs):
    def see(env):
        if env.t == 2:
            raise ValueError("the list of rooms overflowed")
        return np.zeros(1, np.float32)

    says = r"environment \d raised ValueError in step 2 .*: the list of rooms overflowed"
    with pytest.raises(RuntimeError, match=says):
        ppo_gru.main(tiny(env_id=small(see=see), async_envs=async_envs))


# ---- videos ----
def marked(number, bits=8, side=16):
    """A picture whose columns are the bits of a number."""
    columns = [255 * (number >> bit & 1) for bit in range(bits)]
    return np.repeat(np.repeat(np.array(columns, np.uint8)[None], side, 0), side, 1)


def marks_in(path):
    """The numbers of the frames of a video, in order."""
    reader = imageio_ffmpeg.read_frames(
        str(path), pix_fmt="gray", bits_per_pixel=8, output_params=["-fps_mode", "passthrough"]
    )
    width, height = next(reader)["size"]
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width) for frame in reader]
    return [sum(int(frame[8, 8 + 16 * bit] > 127) << bit for bit in range(8)) for frame in frames]


@pytest.mark.parametrize("first", [1, 4, 8])
def test_every_step_is_in_the_video_once_and_in_order(first, tmp_path):
    """18 lengths, each with another of the frame rates from 1 to 60."""
    for length in range(first, 131, 22):
        fps = 1 + 7 * length % 60
        path, writer = tmp_path / "some.mp4", None
        writer = video_writer(path, (16, 128, 3), fps)
        for number in range(length):
            writer.send(even(as_image(marked(number))))
        writer.close()
        assert marks_in(path) == [*range(length)], (length, fps)


@pytest.mark.parametrize("fps", [3, 6, 30])
def test_a_video_holds_every_observation_that_was_acted_on(fps, tmp_path, monkeypatch):
    monkeypatch.setitem(Small.metadata, "render_fps", fps)
    length = lambda env: 128 if env.episode else 46  # noqa: E731
    envs = make_envs(small(length=length, draw=lambda env: marked(env.t)), 2, render_mode="rgb_array")
    envs.reset(seed=0)
    envs = LaneVideo(envs, str(tmp_path))
    list(roll(envs, 46 + 128))
    envs.close()
    assert marks_in(tmp_path / "episode-0.mp4") == [*range(46)]
    assert marks_in(tmp_path / "episode-1.mp4") == [*range(128)]


def test_every_video_has_its_own_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "MAX_VIDEO_FRAMES", 4)
    envs = make_envs(small(draw=lambda env: marked(env.t)), 2, render_mode="rgb_array")
    envs.reset(seed=0)
    envs = LaneVideo(envs, str(tmp_path))
    list(roll(envs, 6))
    envs.close()
    for episode in (0, 1):
        assert marks_in(tmp_path / f"episode-{episode}.mp4") == [0, 1, 2]


GRAY = np.arange(48, dtype=np.uint8).reshape(6, 8)
FRAMES = {
    "gray": GRAY,
    "gray with a channel": GRAY[..., None],
    "color": np.repeat(GRAY[..., None], 3, 2),
    "with alpha": np.concatenate([np.repeat(GRAY[..., None], 3, 2), np.full((6, 8, 1), 9, np.uint8)], 2),
    "floats": GRAY / 255,
    "integers": GRAY.astype(np.int64),
    "a list": GRAY.tolist(),
}


@pytest.mark.parametrize("name", FRAMES)
def test_every_picture_is_one_of_bytes(name):
    picture = as_image(FRAMES[name])
    assert (picture.dtype, picture.shape) == (np.uint8, (6, 8, 3))
    assert np.array_equal(picture[..., 1], GRAY)


@pytest.mark.parametrize("frame", [None, [], "text", np.zeros((3, 4, 5)), np.zeros((0, 4)), np.zeros(4), [None]])
def test_what_is_no_picture(frame):
    with pytest.raises(ValueError, match=r"render\(\) returned no image"):
        as_image(frame)


DRAWS = {
    "nothing": lambda env: None,
    "a picture in a list": lambda env: [np.zeros((4, 4, 3), np.uint8)],
    "other sizes": lambda env: np.zeros((16 + 2 * env.t, 16, 3), np.uint8),
    "an error": lambda env: 1 / 0,
}


@pytest.mark.parametrize("async_envs", [False, True])
@pytest.mark.parametrize("name", DRAWS)
def test_a_video_that_cannot_be_written_costs_itself(name, async_envs, tiny, capfd):
    folder = ppo_gru.main(tiny(env_id=small(draw=DRAWS[name]), capture_video=True, async_envs=async_envs))
    assert (folder / "checkpoint-128.pt").exists()
    frames = 1 if name == "other sizes" else 0
    assert f"the video of episode 0 ends after {frames} frames: " in capfd.readouterr().err


# ---- lines ----
@pytest.mark.parametrize(("number", "shown"), [(3e38, r"3e\+38"), (-1.1e18, r"-1\.1e\+18")])
def test_numbers_that_a_network_cannot_take(tiny, number, shown):
    see = lambda env: np.array([number if env.number == 1 and env.t == 2 else 1e18], np.float32)  # noqa: E731
    says = rf"observation has an entry {shown}; networks take none beyond 1e\+18 \(environment 1, step 2 since"
    with pytest.raises(RunError, match=says):
        ppo_gru.main(tiny(env_id=small(count=itertools.count(), see=see)))


def test_a_policy_that_is_not_finite(tiny):
    args = tiny(ppo_trxl, env_id=small(earn=lambda env: 3e38), observe_last_action=True)
    says = r"^iteration 1: the policy is not finite: .* try a lower --init-lr, .*; there is no checkpoint yet"
    with pytest.raises(RunError, match=says):
        ppo_trxl.main(args)


@pytest.mark.parametrize(("what", "space"), [
    ("observation", gym.spaces.Discrete(2**40)),
    ("observation", gym.spaces.MultiDiscrete([2**23] * 4)),
    ("action", gym.spaces.Discrete(2**40)),
    ("action", gym.spaces.MultiDiscrete([2**62] * 4)),
])  # fmt: skip
def test_spaces_that_no_memory_holds(what, space):
    def make(**_):
        env = Small()
        setattr(env, f"{what}_space", space)
        return env

    with pytest.raises(ValueError, match=f"the {what} space .* is not supported; .*16,777,216"):
        make_envs(register(make), 1)


def test_too_little_memory_for_an_evaluation(tiny, monkeypatch):
    def full(*_, **__):
        raise MemoryError

    monkeypatch.setattr(evaluate, "envs_for", full)
    agent = types.SimpleNamespace(args=tiny())
    for given, named in (({}, "--levels 50 --repeats 3"), ({"levels": 400, "max_steps": 10**6}, "--levels 400")):
        with pytest.raises(RunError, match=f"does not fit in the memory of cpu; use less of {named}$"):
            evaluate.play(agent, evaluate.Config(cuda=False, **given))


def test_a_large_observation_is_named_where_memory_is_short(tiny):
    large, small = gym.spaces.Dict({"a": box(0, 1, (10**7,))}), gym.spaces.Dict({"a": NUMBER})
    for space, named in ((large, "the observation, 40 MB each time; or of --num-envs 64"), (small, "--num-envs 64")):
        with (
            pytest.raises(RunError, match=f"does not fit in the memory of cpu; use less of {named}$"),
            runs.report_out_of_memory(tiny(num_envs=64), torch.device("cpu"), space),
        ):
            raise MemoryError


def test_a_module_in_the_current_folder(tmp_path, monkeypatch):
    """Wherever the script lies: Python looks in its folder alone."""
    text = "import gymnasium\ngymnasium.register('Here-v0', entry_point='gymnasium.envs.classic_control:CartPoleEnv')"
    (tmp_path / "here_envs.py").write_text(text)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", os.getcwd())])
    assert find_spec("here_envs:Here-v0").id == "Here-v0"


@EACH_SCRIPT
def test_a_loop_past_its_room(script, tiny, opened):
    run = opened(script, tiny(script, env_id="CartPole-v1"))
    memory, obs = run.agent.memory.begin_rollout(run.carry.memory, 2), run.carry.obs
    act = lambda: run.agent.get_action_and_value(environments.as_tensors(obs, torch.device("cpu")), memory)  # noqa: E731
    act(), act()
    with pytest.raises(IndexError, match=r"no room for this step; begin_rollout\(carry\(state\), num_steps\)"):
        act()
    memory = run.agent.memory.begin_rollout(run.agent.memory.carry(memory), 2)
    act()


@pytest.mark.parametrize(
    ("text", "steps"), [("1e6", 10**6), ("1_000_000", 10**6), ("2.5e5", 250_000), ("3e7", 3 * 10**7)]
)
def test_step_counts(text, steps):
    assert parse_args(ppo_gru, "--total-timesteps", text, "--anneal-steps", text).total_timesteps == steps
    assert parse_args(ppo_gru, "--total-timesteps", text, "--anneal-steps", text).anneal_steps == steps


@pytest.mark.parametrize("text", ["1.5", "1e-3", "nan", "inf", "1e6x"])
def test_what_is_no_step_count(text, capfd):
    with pytest.raises(SystemExit):
        parse_args(ppo_gru, "--total-timesteps", text)
    assert "total-timesteps" in capfd.readouterr().err


def test_actions_are_the_environments_own():
    assert env_actions(gym.spaces.Discrete(3, start=5), np.array([[2], [0]])).tolist() == [7, 5]
    branches = gym.spaces.MultiDiscrete([2, 3], start=[1, 0])
    assert env_actions(branches, np.array([[1, 2]])).tolist() == [[2, 2]]


# ---- what environments do wrong, or differently ----
def test_an_info_that_is_reused():
    """Its arrays are overwritten by the reset that follows an episode's end."""
    info = {"score": np.zeros(1)}

    def tell(env):
        info["score"][:] = env.t
        return info

    envs = make_envs(small(tell=tell), 2, seed=1)
    envs.reset()
    *_, infos = [*roll(envs, 3)][-1]
    assert final_numbers(infos, np.ones(2, bool))["score"].tolist() == [3, 3]


class Strict(Small):
    """An environment that takes no other actions than those of its space."""

    def __init__(self, action_space):
        super().__init__()
        self.action_space = action_space

    def step(self, action):
        assert self.action_space.contains(action)
        return super().step(action)


@pytest.mark.parametrize("space", [
    gym.spaces.Discrete(3, dtype=np.int32), gym.spaces.Discrete(3, dtype=np.int8, start=-1),
    gym.spaces.MultiDiscrete([3, 2], dtype=np.int32), gym.spaces.MultiDiscrete([3, 2], dtype=np.uint8, start=[9, 0]),
])  # fmt: skip
def test_actions_have_the_type_of_their_space(space):
    envs = make_envs(register(Strict, action_space=space), 2, seed=1)
    envs.reset()
    list(roll(envs, 10))


def test_a_small_type_holds_its_values():
    space = gym.spaces.MultiDiscrete([200, 3], dtype=np.uint8, start=[56, 0])
    envs = make_envs(small(space=space, see=lambda env: np.array([255, 2], np.uint8)), 1, seed=1)
    assert np.flatnonzero(envs.reset()[0]["observation"]).tolist() == [199, 202]


def test_bytes_do_not_wrap_around():
    """Of a vector environment of another package, whatever type of numbers it returns."""
    part = Part.of(("observation",), PICTURE)
    right = np.full((2, *PICTURE.shape), 200)
    assert part.convert({"observation": right}).tolist() == right.tolist()
    right[1, 0, 0, 0] = 300
    with pytest.raises(WrongValue, match="outside of 0 to 255") as error:
        part.convert({"observation": right})
    assert error.value.args == (1, "is 300, outside of 0 to 255")


SHAPES = [
    (box(0, 255, (2,), np.uint8), np.array([300, 0], np.uint16), "observation has an entry 300, outside of 0 to 255"),
    (NUMBER, np.zeros(2, np.float32), r"observation is of float32, shape \(2,\), and its space float32, \(1,\)"),
    (PICTURE, np.zeros((40, 48, 3)), r"observation is of float64, shape \(40, 48, 3\), and its space uint8"),
    (gym.spaces.Dict({"a": gym.spaces.Tuple((NUMBER, NUMBER))}), {"a": (np.zeros(1),)}, r"observation\.a has no 1: "),
    (gym.spaces.Dict({"a": NUMBER}), None, "observation has no 'a': None"),
]


@pytest.mark.parametrize(("space", "wrong", "message"), SHAPES, ids=[case[2] for case in SHAPES])
@pytest.mark.parametrize("asynchronous", [False, True])
def test_an_observation_of_another_shape(space, wrong, message, asynchronous):
    see = lambda env: wrong if env.t == 2 else right  # noqa: E731
    right = space.sample()
    env_id = small(space=space, see=see)
    envs = make_envs(env_id, 2, seed=1, asynchronous=asynchronous)
    envs.reset()
    where = r"environment \d, step 2 since its reset with seed \d+"
    with pytest.raises(RunError, match=rf"^{env_id}: {message}.* \({where}\)$"):
        list(roll(envs, 3))
    envs.close()


@pytest.mark.parametrize("asynchronous", [False, True])
def test_a_reward_is_one_number(asynchronous):
    envs = make_envs(small(earn=lambda env: np.array([0.25])), 2, seed=1, asynchronous=asynchronous)
    envs.reset()
    assert next(roll(envs, 1))[1].tolist() == [0.25, 0.25]
    envs.close()
    for wrong in (np.zeros(2), None, 1j):
        envs = make_envs(small(earn=lambda env, wrong=wrong: wrong), 2, seed=1, asynchronous=asynchronous)
        envs.reset()
        with pytest.raises(RunError, match=r"the reward is .*, not a number \(environment \d, step 1 since its reset"):
            list(roll(envs, 1))
        envs.close()


def test_a_process_that_dies():
    dying = small(earn=lambda env: os._exit(3) if env.t == 2 else 0.0)
    envs = make_envs(dying, 2, seed=1, first_lane=6, asynchronous=True)
    envs.reset()
    with pytest.raises(RunError, match=r"the process of environment [67] ended, with exit code 3"):
        list(roll(envs, 3))
    envs.close()
    assert not any(process.is_alive() for process in envs.unwrapped.processes)


def draws():
    """A number of each global generator."""
    return [np.random.rand(), random.random(), torch.rand(1).item()]  # noqa: NPY002


def test_each_process_has_global_generators_of_its_own():
    """What an environment draws from them when it is made, and when it is reset."""

    def make(**_):
        drawn = draws()
        return Small(space=box(0, 1, (6,)), see=lambda env: np.array([*drawn, *draws()], np.float32))

    def first(seed, first_lane=0):
        envs = make_envs(env_id, 2, seed=seed, first_lane=first_lane, asynchronous=True)
        observations = envs.reset()[0]["observation"].tolist()
        envs.close()
        return observations

    env_id = register(make)
    random.seed(0)
    zero, one = first(7)
    after = random.random()
    random.seed(0)
    assert after == [random.random(), random.random()][1], (
        "the training's own go on, after one that asks for the spaces"
    )
    assert len({*zero, *one}) == 12
    assert first(7, first_lane=1)[0] == one
    others = [first(seed) for seed in (8, None, None)]
    assert len({*zero, *one, *np.ravel(others)}) == 48


@pytest.mark.parametrize(("fails", "error", "message"), [
    (lambda: 1 / 0, ValueError, "cannot be made: environment 7 raised ZeroDivisionError when it was made: division by"),
    (lambda: os._exit(3), RunError, "the process of environment 7 ended, with exit code 3"),
    (sys.exit, RunError, "the process of environment 7 ended, with exit code 0"),
])  # fmt: skip
def test_an_environment_that_cannot_be_made_in_its_process(fails, error, message):
    def make(**_):
        if multiprocessing.current_process().name.endswith("-1"):
            fails()
        return Small()

    with pytest.raises(error, match=message):
        make_envs(register(make), 2, seed=1, first_lane=6, asynchronous=True)
    assert not multiprocessing.active_children()


def test_an_info_that_cannot_leave_its_process():
    env_id = small(tell=lambda env: {"door": threading.Lock()} if env.t == 2 else {})
    list(roll(make_envs(env_id, 2, seed=1), 3))
    envs = make_envs(env_id, 2, seed=1, first_lane=6, asynchronous=True)
    envs.reset()
    what = "cannot pickle '_thread.lock' object; what it returns has to be sent from its process"
    with pytest.raises(RunError, match=f"environment [67]: TypeError: {what}; train without --async-envs"):
        list(roll(envs, 3))
    envs.close()


def test_signals_are_for_the_first_process(tiny):
    """Each environment is in a session of its own: Ctrl-C and `timeout` do not end it before the iteration ends."""
    handler = signal.getsignal(signal.SIGINT)
    envs = make_envs(small(), 2, seed=1, asynchronous=True)
    assert signal.getsignal(signal.SIGINT) is handler
    envs.reset()
    list(roll(envs, 1))  # they have begun
    processes = envs.unwrapped.processes
    assert [os.getsid(process.pid) for process in processes] == [process.pid for process in processes]
    envs.close()


def test_processes_are_closed_while_a_call_is_pending(monkeypatch):
    """As after a second Ctrl-C: the answers that were read already do not come again."""

    def interrupted(envs, **_):
        envs.parent_pipes[0].recv()
        raise KeyboardInterrupt

    envs = make_envs("CartPole-v1", 2, seed=1, asynchronous=True)
    envs.reset()
    with monkeypatch.context() as patch:
        patch.setattr(AsyncVectorEnv, "step_wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            list(roll(envs, 1))
    envs.close()
    assert not any(process.is_alive() for process in envs.unwrapped.processes)


def test_reset_mask_counts_returns_and_lengths_from_zero_there_alone():
    envs = make_envs(small(length=9), 3, seed=1)
    envs.reset()
    list(roll(envs, 5))
    envs.reset(options={"reset_mask": np.array([True, False, False])})
    assert envs.episode_lengths.tolist() == [0, 5, 5]


def test_an_error_when_it_is_made_is_told_in_its_own_words():
    def make(render_mode=None):
        raise RuntimeError("no license; set SIM_LICENSE") from FileNotFoundError("license.txt")

    with pytest.raises(ValueError, match=r"cannot be made: no license; set SIM_LICENSE$"):
        make_envs(register(make), 1)


@pytest.mark.parametrize(
    ("seed", "where"), [(7, "its reset with seed 7"), (None, "the reset after step 2 since it was made")]
)
def test_where_a_reset_raised(seed, where):
    broken = small(see=lambda env: 1 / 0 if env.episode and env.t == 0 else np.zeros(1, np.float32))
    lane = make_lane(gym.spec(broken), {}, Levels(), 4)
    lane.reset()
    lane.step(0)
    lane.step(0)
    with pytest.raises(LaneError, match=f"^environment 4 raised ZeroDivisionError in {where}: division by zero$"):
        lane.reset(seed=seed)


@pytest.mark.parametrize(("interval", "last"), [(0, "there is no checkpoint yet"), (1, r"runs/.*/checkpoint-64\.pt")])
def test_an_environment_that_raises_while_it_is_trained_in(tiny, interval, last):
    """In the second iteration: what was learned is kept, and its error names the last checkpoint."""
    broken = small(length=30, see=lambda env: np.full(1, 1 / (20 - env.t), np.float32))
    args = tiny(env_id=broken, save_model=True, checkpoint_interval=interval)
    says = r"^iteration 2: environment \d raised ZeroDivisionError in step .*: division by zero; "
    with pytest.raises(LaneError, match=f"{says}.*{last}$"):
        ppo_gru.main(args)
    assert [*Path("runs").glob("*/model.pt")]


class Unclosable(Small):
    def close(self):
        raise KeyError("no sim")


@pytest.mark.parametrize("async_envs", [False, True])
def test_an_environment_that_cannot_be_closed(tiny, async_envs, capfd):
    folder = ppo_gru.main(tiny(env_id=register(Unclosable), async_envs=async_envs, num_envs=2))
    assert capfd.readouterr().err.count("raised KeyError('no sim') when it was closed\n") >= 2
    assert (folder / "checkpoint-128.pt").exists()


def test_environments_are_closed_if_they_cannot_be_used():
    closed = []

    class Closes(Small):
        def close(self):
            closed.append(1)

    with pytest.raises(ValueError, match="--frame-stack"):
        make_envs(register(Closes), 2, frame_stack=-1)
    assert closed == [1, 1]


class ReadOnly(Together):
    def _observations(self, values):
        values = super()._observations(values)
        values.flags.writeable = False
        return values


@pytest.mark.parametrize("wrapper", ["step_encoding", "observe_last_action", "frame_stack", "vector_frequencies"])
def test_arrays_that_are_read_only(wrapper):
    if "ReadOnly-v0" not in gym.registry:
        gym.register("ReadOnly-v0", vector_entry_point=ReadOnly, kwargs={"as_objects": False, "nested": False})
    envs = make_envs("ReadOnly-v0", 2, seed=1, **{wrapper: 1})
    envs.reset()
    assert sum(step[2].sum() for step in roll(envs, 5)) == 3


def test_evaluations_are_in_one_process(tiny, opened):
    run = opened(ppo_gru, tiny(env_id="CartPole-v1", async_envs=True, eval_interval=1, eval_levels=2))
    assert len(run.envs.unwrapped.processes) == 4
    assert not hasattr(run.eval_envs.unwrapped, "processes")


def test_another_time_limit():
    envs = make_envs("CartPole-v1", 1, seed=1, env_kwargs={"max_episode_steps": 3})
    envs.reset()
    assert [step[3].tolist() for step in roll(envs, 3)] == [[False], [False], [True]]
