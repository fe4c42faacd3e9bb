"""Mystery Path: its paths, what falling off does, how endless episodes end, and what is drawn of the path."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest

from memory_gym_envs import EASY_MYSTERY_PATH, MysteryPath
from memory_gym_envs.character import BODY, PAD
from memory_gym_envs.mystery_path.levels import FIRST_SEGMENTS, read_ahead, sample_segments
from memory_gym_envs.mystery_path.options import SEGMENT, SIDE, TILE
from memory_gym_envs.mystery_path.rules import trail
from memory_gym_envs.mystery_path.state import EAST, NORTH, PIT, PIT_ROWS, ROWS, SOUTH, WEST
from memory_gym_envs.players import player, stumbling, turn_or_walk

EACH = pytest.mark.parametrize("env_id", MysteryPath.variants)
FINITE = pytest.mark.parametrize("env_id", ["MysteryPath-v0", "MysteryPath-Grid-v0"])
ENDLESS = "Endless-MysteryPath-v0"
RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)


def made(env_id, seed=0, **options):
    env = gym.make(env_id).unwrapped
    env.reset(seed=seed, options=options)
    return env, env.batch.state


def path_of(state, lane=0):
    """The path as (column, row) tiles."""
    cells = state.path_cell[lane, 1 : state.path_length[lane] + 1]
    return list(zip((cells // ROWS).tolist(), (cells % ROWS - PIT_ROWS).tolist(), strict=True))


def has(frame, color):
    return (frame == color).all(axis=-1).any()


# ---- paths ----


@FINITE
@pytest.mark.parametrize("side", range(4))
def test_paths_lead_to_the_opposite_side(env_id, side):
    ends, lengths = set(), set()
    for seed in range(40):
        _, s = made(env_id, seed, cardinal_origin_choice=[side])
        path = path_of(s)
        axis, near = (0, 0, 1, 1)[side], (0, SIDE - 1, 0, SIDE - 1)[side]
        assert (path[0][axis], path[-1][axis]) == (near, SIDE - 1 - near)
        assert all(0 <= x < SIDE and 0 <= y < SIDE for x, y in path)
        check_path(s, path)
        assert s.walls[0].any()
        assert not s.walls[0, s.path_cell[0, 1 : len(path) + 1]].any()
        ends.add((path[0], path[-1]))
        lengths.add(len(path))
    assert len(ends) > 20
    assert min(lengths) <= SIDE + 1
    assert max(lengths) > SIDE + 2


def check_path(s, path):
    """Whole steps without a crossing, and the other arrays say the same."""
    assert len(set(path)) == len(path)
    moves = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path)]
    directions = {(1, 0): EAST, (0, -1): NORTH, (0, 1): SOUTH, (-1, 0): WEST}
    assert s.direction_at[0, 1 : len(path)].tolist() == [directions[move] for move in moves]
    assert np.count_nonzero(s.step_at[0]) == len(path)
    assert [s.step_at[0, x * ROWS + PIT_ROWS + y] for x, y in path] == list(range(1, len(path) + 1))


def test_endless_paths_are_joined_by_transition_tiles():
    for seed in range(40):
        _, s = made(ENDLESS, seed)
        path = path_of(s)
        check_path(s, path)
        assert path[0][0] == 0
        assert s.segments[0] == FIRST_SEGMENTS
        joints = [x for x, _ in path if x % SEGMENT == SIDE]
        assert joints == [SIDE, SEGMENT + SIDE, 2 * SEGMENT + SIDE]  # one tile each
        assert path[-1][0] == joints[-1]
        assert s.direction_at[0, s.path_length[0]] == EAST


def further(rng, *arguments):
    """The endless path's next segments from this generator."""
    buffer = read_ahead(rng, FIRST_SEGMENTS)
    level = sample_segments(buffer, *arguments)
    buffer.close()
    return level


def test_endless_path_grows_when_its_last_segment_is_entered():
    env, s = made(ENDLESS, 1)
    rng, _ = gym.utils.seeding.np_random(1)
    level = further(rng, int(rng.integers(0, SIDE)), 0, FIRST_SEGMENTS)
    for _ in range(700):
        segments, state = int(s.segments[0]), env.batch.np_random[0].bit_generator.state
        *_, over, _, _ = env.step(player(env.batch)[0])
        assert not over
        if s.tile[0, 0] == (segments - 1) * SEGMENT and s.segments[0] > segments:
            row = level.path[-1] % ROWS - PIT_ROWS
            level.path.extend(further(rng, row, segments, 1).path)
        else:
            assert (s.segments[0], env.batch.np_random[0].bit_generator.state) == (segments, state)
    assert s.segments[0] > 8
    assert s.path_cell[0, 1 : s.path_length[0] + 1].tolist() == level.path
    check_path(s, path_of(s))


# ---- falling off ----


def step_into_the_pit(env, s):
    """Walks on to where the tile below is none of the path, then down: how many steps it took, and the last one."""
    down = 3 if env.batch.variant.endless else [0, 2]
    for steps in range(1, 400):
        column, row = s.tile[0].tolist()
        if row == SIDE - 1 or s.step_at[0, column * ROWS + PIT_ROWS + row + 1] != PIT:
            result = env.step(player(env.batch)[0])
        else:
            result = env.step(turn_or_walk(s.facing, 4)[0] if env.batch.variant.grid else down)
        if s.fallen[0]:
            return steps, result
    raise AssertionError("never fell off")


@EACH
@pytest.mark.parametrize("feedback", [True, False])
def test_falling_off(env_id, feedback):
    env, s = made(env_id, 4, visual_feedback=feedback, reward_fall_off=-0.5, reward_step=-0.25)
    origin = s.pos[0].tolist()
    _, (frame, reward, terminated, _, _) = step_into_the_pit(env, s)
    assert not terminated
    assert reward == -0.75
    assert has(frame, RED) == feedback
    at = int(s.last_path_step[0])
    # Back at the origin, whatever the action.
    facing = int(s.facing[0])
    action = 3 if env.action_space.shape == () else [2, 2]
    frame, reward, terminated, _, info = env.step(action)
    assert (reward, terminated) == (-0.25, False)
    assert s.pos[0].tolist() == origin
    assert s.facing[0] == facing
    assert not has(frame, RED)
    assert info["ground_truth"].argmax() == s.direction_at[0, 1]
    assert (s.fails[0], s.last_path_step[0]) == (1, 1)
    # The way back earns nothing.
    while s.last_path_step[0] < at:
        assert env.step(player(env.batch)[0])[1] == -0.25


@FINITE
def test_goal_at_the_last_step(env_id):
    """Terminated only; one step earlier is too early, and truncated only."""
    env, s = made(env_id, 3)
    terminated = False
    while not terminated:
        *_, terminated, _, _ = env.step(player(env.batch)[0])
    length = int(s.length[0])
    for limit, ends in ((length, (True, False)), (length - 1, (False, True))):
        env.reset(seed=3, options={"max_steps": limit})
        for _ in range(limit):
            _, _, terminated, truncated, info = env.step(player(env.batch)[0])
        assert (terminated, truncated) == ends
        assert info["success"] == ends[0]


@pytest.mark.parametrize("scale", [0.3, 0.47, 0.48, 1.0])
def test_large_agents_start_beside_the_origin(scale):
    env, s = made("MysteryPath-v0", 2, agent_scale=scale)
    column, row = path_of(s)[0]
    beside = int(25 * scale) // TILE
    assert s.tile[0].tolist() == [column + beside, row + beside]
    assert env.batch.reset(options={"agent_scale": scale})[0] in env.batch.observation_space


@pytest.mark.parametrize("speed", [14, 15, 16, 17, 84])
def test_the_largest_agent_leaves_the_screen_at_any_speed(speed):
    env, s = made(ENDLESS, 7, agent_scale=1.0, agent_speed=speed)
    assert path_of(s)[0] == (0, SIDE - 1)  # the bottom row, from which the agent walks down
    frame, *_ = env.step(3)
    assert s.pos[0, 1] == (SIDE - 1) * TILE + 25 + speed + PAD
    assert not has(frame, BODY)
    frame, *_ = env.step(3)
    assert has(frame, BODY)


@pytest.mark.parametrize("scale", [0.25, 0.66, 0.72, 1.0])
@pytest.mark.parametrize("left", [-30, -1, 0, 1, 2, 5])
def test_what_shows_of_an_agent_above_the_screen(scale, left):
    """Its lowest rows: so many are left when it has walked up from the top row."""
    radius = int(25 * scale)
    options = {"agent_scale": scale, "agent_speed": 2 * radius - left}
    env, s = made(ENDLESS, 11, **options)
    assert path_of(s)[0] == (0, 0)
    frame, *_ = env.step(2)
    assert s.pos[0, 1] - PAD == left - radius
    rows = (frame == BODY).all(axis=-1).any(axis=1).nonzero()[0]
    assert rows.max(initial=-1) == max(0, left) - 1
    vectors = gym.make_vec(ENDLESS, num_envs=1, obs_type="vector")
    vectors.reset(seed=11, options=options)
    assert bool(vectors.step([2])[0][0, 0]) == (left > 0)


@FINITE
def test_the_easy_task_shows_both_ends_and_pays_for_tiles(env_id):
    env = gym.make(env_id, options=EASY_MYSTERY_PATH).unwrapped
    frame, _ = env.reset(seed=3)
    assert has(frame, BLUE)
    assert has(frame, GREEN)
    rewards, over = [], False
    while not over:
        _, reward, over, _, info = env.step(player(env.batch)[0])
        rewards.append(round(reward, 6))
    between = len(path_of(env.batch.state)) - 2
    assert sorted(rewards)[-between - 1 :] == [0.1] * between + [1.0]
    assert info["reward"] == pytest.approx(0.1 * between + 1)


# ---- endless episodes ----


@pytest.mark.parametrize("stamina", [1, 2, 20])
def test_stamina_runs_out(stamina):
    env, _ = made(ENDLESS, 0, stamina_level=stamina)
    for step in range(1, stamina + 1):
        _, _, terminated, truncated, info = env.step(0)
        # The first step is on the origin, which gives back stamina, before it is used.
        assert terminated == (step == stamina)
        assert not truncated
    assert info["length"] == stamina
    assert (info["reward"], info["num_fails"], info["max_x"], info["tiles_visited"]) == (0.0, 0, 0, 0)


def test_new_tiles_and_falls_give_stamina_back():
    env, s = made(ENDLESS, 0, stamina_level=20)
    while s.last_path_step[0] == 1:
        env.step(player(env.batch)[0])
    assert s.stamina[0] == 19
    step_into_the_pit(env, s)
    assert s.stamina[0] == 19
    env.step(0)
    assert (s.last_path_step[0], s.stamina[0]) == (1, 19)
    env.step(0)
    assert s.stamina[0] == 18
    while s.last_path_step[0] == 1:  # a tile that was reached before the fall
        env.step(player(env.batch)[0])
    assert s.stamina[0] == 19


def test_falling_off_at_the_same_place_ends_the_episode():
    env, s = made(ENDLESS, 4)
    steps, (*_, terminated, _, _) = step_into_the_pit(env, s)
    assert not terminated
    fall = s.tile[0].tolist()
    env.step(0)
    again, (*_, terminated, truncated, info) = step_into_the_pit(env, s)
    assert s.tile[0].tolist() == fall
    assert again == steps
    assert (terminated, truncated) == (True, False)
    assert (info["num_fails"], info["length"]) == (2, 2 * steps + 1)


def test_falling_off_before_the_best_progress_ends_the_episode():
    env, s = made(ENDLESS, 4)
    while s.tile[0, 0] < 4:
        env.step(player(env.batch)[0])
    while not s.fallen[0]:
        _, _, terminated, _, _ = env.step(2)  # up, off the path or the screen
    assert not terminated
    assert s.max_column[0] == 4
    env.step(0)
    while not s.fallen[0]:
        *_, terminated, _, info = env.step(2)
    assert terminated
    assert (info["max_x"], info["num_fails"]) == (4, 2)


@pytest.mark.parametrize("seed", [156, 168, 811, 1548])
def test_ground_truth_skips_the_west(seed):
    """Where the endless path goes left, which few do, the direction before stays, and the player cannot go on."""
    env, s = made(ENDLESS, seed)
    assert WEST in s.direction_at[0, 1 : s.path_length[0]]
    truth, terminated = env.batch.ground_truth()[0], False
    while not terminated:
        before = truth
        *_, terminated, _, info = env.step(player(env.batch)[0])
        truth, heading = info["ground_truth"], int(s.direction_at[0, s.last_path_step[0]])
        assert np.array_equal(truth, before if heading == WEST else np.eye(3)[heading])
    assert heading == WEST
    assert (info["num_fails"], s.stamina[0]) == (0, 0)


@FINITE
def test_ground_truth_of_finite_paths(env_id):
    env, s = made(env_id, 5)
    terminated, seen = False, set()
    while not terminated:
        path, at = path_of(s), int(s.last_path_step[0])
        truth = env.batch.ground_truth()[0]
        assert truth.sum() == 1
        move = tuple(np.subtract(path[at], path[at - 1]).tolist())
        assert move == ((1, 0), (0, -1), (0, 1), (-1, 0))[truth.argmax()]
        seen.add(move)
        *_, terminated, _, info = env.step(player(env.batch)[0])
    assert len(seen) > 1
    assert np.array_equal(info["ground_truth"], truth)  # at the goal, the direction that led to it


# ---- pictures ----


@FINITE
def test_origin_and_goal_are_shown_on_request(env_id):
    for shown in (True, False):
        env, s = made(env_id, 7, show_origin=shown, show_goal=shown)
        frame = env.batch.frames(slice(None))[0]
        assert has(frame, GREEN) == has(frame, BLUE) == shown
        if shown:
            for color, (column, row) in ((BLUE, path_of(s)[0]), (GREEN, path_of(s)[-1])):
                rows, columns = (frame == color).all(axis=-1).nonzero()
                assert set(rows // TILE) == {row}
                assert set(columns // TILE) == {column}
            assert (frame == GREEN).all(axis=-1).sum() == TILE * TILE


def test_the_endless_id_ignores_show_origin():
    frames = [made(ENDLESS, 1, show_origin=shown)[0].batch.frames(slice(None)) for shown in (True, False)]
    assert np.array_equal(*frames)


@pytest.mark.parametrize("camera", [0.0, 0.6, 2.0, 5.0, 5.5])
def test_past_path(camera):
    """The steps that a loop over the path, one by one, would draw."""
    envs = gym.make_vec(ENDLESS, num_envs=16)
    envs.reset(seed=3, options={"camera_offset_scale": camera, "agent_speed": 6.0})
    rng, drawn, longest = np.random.default_rng(0), 0, 0
    for _ in range(120):
        envs.step(stumbling(envs, rng, np.linspace(0.0, 0.3, 16)))
        s = envs.state
        lanes = np.flatnonzero(s.tile[:, 0] > 0)
        if not lanes.size:
            continue
        owner, cells = trail(s, lanes, envs._lane_path)
        for lane in lanes.tolist():
            expected, left = [], max(0, int(s.tile[lane, 0]) - 1 - int(camera))
            for step in range(int(s.last_path_step[lane]) - 1, 0, -1):
                expected.append(int(s.path_cell[lane, step]))
                if expected[-1] // ROWS <= left:
                    break
            assert cells[owner == lane].tolist() == expected
            drawn, longest = drawn + len(expected), max(longest, len(expected))
    assert drawn > 300
    assert longest > camera + 1


def test_past_path_is_hidden_on_request():
    for shown in (True, False):
        env, s = made(ENDLESS, 2, show_past_path=shown)
        while s.tile[0, 0] < 2:
            frame, *_ = env.step(player(env.batch)[0])
        assert has(frame, WHITE) == shown


def test_stamina_bar():
    env, _ = made(ENDLESS, 0, show_stamina=True, stamina_level=12)
    bar = env.batch.frames(slice(None))[0][:, 80:]
    for left in range(12, 0, -1):
        red = (bar == RED).all(axis=-1).sum(axis=0)
        assert red.tolist() == [int(84 * (1 - left / 12))] * 4
        assert (bar == GREEN).all(axis=-1).sum() == 4 * 84 - red.sum()
        bar = env.step(0)[0][:, 80:]
    assert (bar == RED).all()


@EACH
def test_debug_render_shows_the_path(env_id):
    env = gym.make(env_id, render_mode="debug_rgb_array").unwrapped
    env.reset(seed=2)
    endless, s = "Endless" in env_id, env.batch.state
    for _ in range(30):
        frame = env.render()
        assert frame.shape == (336, 336, 3)
        assert frame.dtype == np.uint8
        offset = s.pos[0, 0] - s.origin[0, 0] - 60 if endless else 0
        path = path_of(s)
        kinds = {place: BLUE if place[0] % SEGMENT == SIDE else WHITE for place in path}
        kinds |= {path[0]: BLUE} | ({} if endless else {path[-1]: GREEN})
        kinds |= {(cell // ROWS, cell % ROWS - PIT_ROWS): RED for cell in np.flatnonzero(s.walls[0]).tolist()}
        shown = 0
        for (column, row), color in kinds.items():
            x, y = 4 * (column * TILE - offset), 4 * row * TILE
            seen = tuple(frame[y + 6, x + 6].tolist()) if 0 <= x < 330 else None
            if seen in (GREEN, BLUE, RED, WHITE):  # not the agent
                assert seen == color
                shown += 1
        assert shown >= 5
        _, _, terminated, truncated, _ = env.step(player(env.batch)[0])
        if terminated or truncated:
            env.reset()
