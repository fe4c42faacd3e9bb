"""Vector observations hold what the frame shows and nothing that it hides: equal frames have equal vectors.

And different frames have different vectors, but for the exceptions in SAME.
"""

from collections import defaultdict

import gymnasium as gym
import numpy as np
import pytest
from helpers import EACH, FAMILY, MORTAR, check_same

from memory_gym_envs import IDS, MortarMayhem, MysteryPath, SearingSpotlights
from memory_gym_envs.base import ALL
from memory_gym_envs.character import FACINGS, PAD
from memory_gym_envs.entries import vector_slices, vector_space
from memory_gym_envs.mortar_mayhem.arena import COMMANDS
from memory_gym_envs.mortar_mayhem.drawing import SYMBOL, SYMBOL_AT
from memory_gym_envs.mystery_path.options import SIDE
from memory_gym_envs.mystery_path.state import PIT_ROWS, ROWS
from memory_gym_envs.players import player, spot_player, stumbling
from memory_gym_envs.searing_spotlights.state import AGENT, COIN, EXIT

LANES, STEPS = 48, 80
OPTIONS = {  # played one after the other, each by the ids that have its options
    MortarMayhem: [
        {},
        {"agent_scale": 0.04, "agent_speed": 2.0, "explosion_delay": [4]},
        {"agent_scale": 0.45, "agent_speed": 4.0},
        {"agent_scale": 1.0, "agent_speed": 8.0, "visual_feedback": False},
        {"arena_size": 2, "agent_scale": 1.0},
        {"arena_size": 3, "explosion_delay": [4], "explosion_duration": [3]},
        {"command_show_duration": [1, 2], "command_show_delay": [0], "explosion_delay": [3]},
    ],
    MysteryPath: [
        {},
        {"show_origin": True, "show_goal": True},
        {"show_origin": True, "show_goal": True, "agent_scale": 0.6, "visual_feedback": False},
        {"agent_scale": 0.04},
        {"show_background": True, "show_stamina": True},
        {"camera_offset_scale": 2.3, "agent_speed": 4.6, "show_background": True},
        {"camera_offset_scale": 0.6},
        {"camera_offset_scale": 1.331},
        {"camera_offset_scale": 1.331, "agent_scale": 0.6},
        {"camera_offset_scale": 5.5, "agent_scale": 1.0, "show_stamina": True},
        {"camera_offset_scale": 1.0, "agent_scale": 0.5, "agent_speed": 1.0},
        {"show_past_path": False, "agent_speed": 15.0},
    ],
    SearingSpotlights: [
        {},
        {"initial_spawns": 0, "num_spawns": 0},
        {"initial_spawns": 0, "num_spawns": 0, "coins_visible": True, "num_coins": [5]},
        {"initial_spawns": 1, "spot_damage": 0.0, "light_dim_off_duration": 0},
        {"coin_feedback": False, "spot_damage": 0.0},
        {"initial_spawns": 1, "spot_damage": 0.0, "black_background": True, "hide_chessboard": True},
    ],
}
CASES = [
    pytest.param(env_id, options, id="-".join([env_id, *map(str, options)]))
    for env_id in IDS
    for options in OPTIONS[FAMILY[env_id]]
    if set(options) <= {option.name for option in FAMILY[env_id].variants[env_id].options}
    if not options or env_id not in ("MortarMayhem-Grid-v0", "MortarMayhemB-Grid-v0")  # whose agents have one size
]
# Different frames may have equal vectors where large agents hide most of a tile, where only the edge of a past tile
# shows on the background, and in some corners of the torus. How few vectors there may be, as a share of the frames:
SAME = 0.8


def play(env_id, options, seed):
    """Hashes of all frames (with the B ids' commands), last ones of episodes too, with their vectors and truths."""
    envs, twin = gym.make_vec(env_id, num_envs=LANES), gym.make_vec(env_id, num_envs=LANES, obs_type="vector")
    for each in (envs, twin):
        each.reset(seed=seed, options=options)
    twin.state = envs.state  # it plays no levels of its own, which would take as long again
    space, pixels, seen = twin.single_observation_space, envs.pixels, []

    def observe(lanes):
        frames, vectors = pixels(lanes), twin.vectors(lanes)
        assert ((space.low <= vectors) & (vectors <= space.high)).all()
        seen.extend(zip(unique(frames), vectors, envs.ground_truth()[lanes], strict=True))
        return frames

    envs.pixels = observe
    observe(ALL)
    rng, chances = np.random.default_rng(seed), np.linspace(0, 1, LANES)
    for _ in range(STEPS):
        envs.step(stumbling(envs, rng, chances))
    return seen


def unique(observations):
    """What each lane sees as a number."""
    parts = observations.values() if isinstance(observations, dict) else [observations]
    return [hash(b"".join(each.tobytes() for each in lane)) for lane in zip(*parts, strict=True)]


def check(pairs):
    """Equal frames have equal vectors. Counts observations, frames, vectors, and the frames that hide a truth."""
    seen, truths, count = {}, defaultdict(set), 0
    for frame, vector, truth in pairs:
        count += 1
        vector = vector.tobytes()
        assert seen.setdefault(frame, vector) == vector
        truths[frame].add(truth.tobytes())
    return count, len(seen), len(set(seen.values())), sum(len(each) > 1 for each in truths.values())


@pytest.mark.parametrize(("env_id", "options"), CASES)
def test_equal_frames_have_equal_vectors(env_id, options):
    count, frames, vectors, hiding = check(play(env_id, options, seed=1))
    assert count - frames > count / 20  # the same frame of another state
    assert hiding > 3  # of another one by the ground truth
    assert vectors >= frames * SAME
    if not options and FAMILY[env_id] in (MortarMayhem, MysteryPath):
        assert vectors == frames
        assert hiding > 20


# ---- states set by hand ----


def combinations(*values):
    """Every combination of the values, an array a position."""
    return [each.reshape(-1) for each in np.meshgrid(*values, indexing="ij")]


def look(env_id, options, **state):
    """The frames and vectors of an environment whose lanes are in this state: as check() counts them."""
    count = len(state["facing"])
    one, envs = (gym.make_vec(env_id, num_envs=lanes, obs_type="vector") for lanes in (1, count))
    one.reset(seed=0, options=options)
    envs.settings = one.settings * count
    envs.configure(np.arange(count))
    assert state.keys() <= vars(one.state).keys()
    # All lanes have the same level, but for what is set.
    for name, field in vars(one.state).items():
        setattr(envs.state, name, np.repeat(field, count, axis=0))
    for name, values in state.items():
        getattr(envs.state, name)[:] = values
    envs.place_tables()
    return envs, check(zip(unique(envs.frames(ALL)), envs.vectors(ALL), envs.ground_truth(), strict=True))


@pytest.mark.parametrize("scale", [0.04, 0.08, 0.12, 0.25, 0.5])
@pytest.mark.parametrize("corner", [0, 84])
def test_corners_of_the_torus(scale, corner):
    """Places and facings that look the same: not only the facing may be unknown, but also the place."""
    places = np.arange(-8, 9) + corner + PAD
    beyond = (int(25 * scale) + 1) // 2
    places = places[(places >= PAD - beyond) & (places <= PAD + 84 + beyond)]
    x, y, facing = combinations(places, places, np.arange(FACINGS))
    pos = np.stack([x, y], axis=1)
    envs, (count, frames, vectors, _) = look("Endless-MortarMayhem-v0", {"agent_scale": scale}, pos=pos, facing=facing)
    assert frames < count
    assert vectors > frames * 0.95
    at = vector_slices(envs.variant.entries)
    seen, facings = envs.vectors(ALL)[:, at["size"].start] > 0, envs.vectors(ALL)[:, at["facing"]]
    assert (facings[seen, facing[seen]] == 1).all()  # the true one is among them
    assert not facings[~seen].any()
    inside = ((pos - PAD >= 8) & (pos - PAD <= 76)).all(axis=1)
    assert np.array_equal(envs.vectors(ALL)[inside, at["place"]], ((pos[inside] - PAD) / 84).astype(np.float32))


@pytest.mark.parametrize("env_id", ["MortarMayhem-v0", "Endless-MortarMayhem-v0"])
@pytest.mark.parametrize("symbol", [1, 5, 7])
def test_agents_behind_symbols(env_id, symbol):
    """The smallest agents vanish behind a command's symbol, others do not."""
    places = np.arange(SYMBOL_AT, SYMBOL_AT + SYMBOL) + PAD
    for scale, hidden in ((0.04, True), (0.12, False)):
        x, y, facing = combinations(places, places, [0, 5])
        state = {"pos": np.stack([x, y], axis=1), "facing": facing, "symbol": np.full(len(x), symbol)}
        envs, (_, frames, vectors, _) = look(env_id, {"agent_scale": scale}, **state)
        assert vectors == frames
        assert (envs.vectors(ALL)[:, 0] == 0).any() == hidden


@pytest.mark.parametrize("arena", [2, 3, 5])
@pytest.mark.parametrize("scale", [0.25, 0.4, 0.6, 0.8, 1.0])
def test_tiles_behind_large_agents(arena, scale):
    """Whether tiles burn and which does not, as long as the agent does not stand on all there is to see."""
    first = 42 - 7 * arena + PAD
    places, tiles = first + 7 + 14 * np.arange(arena), np.arange(1 + arena * arena)
    x, y, facing, tile = combinations(np.append(places, [42 + PAD, 45 + PAD]), places, [0, 3], tiles)
    envs = gym.make_vec("MortarMayhemB-v0")
    envs.reset(options={"arena_size": arena})
    floor = envs.state.calm_floor[0] + tile
    goal = first + 14 * np.stack(np.divmod(np.maximum(tile - 1, 0), arena), axis=1)
    state = {
        "pos": np.stack([x, y], axis=1),
        "facing": facing,
        "floor": floor,
        "target_corner": goal,
        "burning": tile > 0,
    }
    envs, (_, frames, vectors, _) = look("MortarMayhemB-v0", {"arena_size": arena, "agent_scale": scale}, **state)
    assert vectors >= frames * SAME
    at, seen = vector_slices(envs.variant.entries), envs.vectors(ALL)
    fire, safe = seen[:, at["fire"]][:, 0] > 0, seen[:, at["safe"]]
    shown = safe.any(axis=1)
    assert np.allclose(safe[shown] * 84, goal[shown] - PAD + 7, atol=1e-4)
    assert not fire[tile == 0].any()
    assert not shown[~fire].any()
    if scale < 0.4:
        assert np.array_equal(fire, tile > 0)
        assert np.array_equal(shown, fire)
        assert vectors == frames
    elif scale > 0.5:
        assert (fire & ~shown).any()
    if arena == 2 and scale == 1.0:
        assert (~fire & (tile > 0)).any()


@pytest.mark.parametrize("env_id", MysteryPath.variants)
@pytest.mark.parametrize("scale", [0.04, 0.15, 0.25, 0.7])
def test_crosses_over_agents(env_id, scale):
    """A cross hides much of a small agent, and the screen's edge hides crosses."""
    endless = env_id.startswith("Endless")
    rows = np.r_[-PAD:26, 60 : 84 + PAD] if endless else np.arange(25, 50)  # edges hide nothing in between
    x, y, facing, shows_cross = combinations([42], rows, np.arange(FACINGS), [False, True])
    state = {"pos": np.stack([x, y], axis=1) + PAD, "facing": facing, "shows_cross": shows_cross}
    envs, (count, frames, vectors, _) = look(env_id, {"agent_scale": scale}, **state)
    assert vectors == frames
    cross = envs.vectors(ALL)[:, vector_slices(envs.variant.entries)["cross"]][:, 0] > 0
    red = (envs.frames(ALL) == (255, 0, 0)).all(axis=-1).any(axis=(1, 2))
    assert np.array_equal(cross, red)
    assert (frames < count) == (endless or (scale < 0.2 and "Grid" not in env_id))


@pytest.mark.parametrize("scale", [0.76, 0.84])
def test_crosses_on_the_stamina_bar(scale):
    """Red on red, they do not show: with and without one, frames and so vectors are the same there."""
    rows, crossed, stamina = combinations(np.arange(0, 84, 3), [False, True], [1, 10, 20])
    options = {"agent_scale": scale, "show_stamina": True, "camera_offset_scale": 5.5}
    pos = np.stack([np.full_like(rows, 66 + PAD), rows + PAD], axis=1)
    state = {"pos": pos, "facing": np.zeros_like(rows), "shows_cross": crossed, "stamina": stamina}
    _, (count, frames, vectors, _) = look("Endless-MysteryPath-v0", options, **state)
    assert frames < count
    assert vectors > 28


@pytest.mark.parametrize("scale", [0.25, 0.5, 1.0])
def test_origins_behind_large_agents(scale):
    columns, rows, x = combinations(np.arange(SIDE), np.arange(SIDE), [36, 42, 45])
    cell = np.ones((len(x), SIDE * SIDE + 1), int)
    cell[:, 1] = columns * ROWS + PIT_ROWS + rows
    state = {"pos": np.stack([x, x], axis=1) + PAD, "facing": np.zeros_like(x), "path_cell": cell}
    envs, (count, frames, vectors, _) = look("MysteryPath-v0", {"agent_scale": scale, "show_origin": True}, **state)
    origin = envs.vectors(ALL)[:, vector_slices(envs.variant.entries)["origin"]]
    shown = origin.any(axis=1)
    middle = np.stack([columns, rows], axis=1) * 12 + 6
    assert np.allclose(origin[shown] * 84, middle[shown], atol=1e-4)
    assert shown.all() == (scale < 0.5)
    assert (frames < count) == (scale == 1.0)  # more than one at a time
    assert vectors >= frames * 0.95


# ---- what entries say ----


def made(env_id, seed=0, **options):
    """An environment with vectors, its state, and a function that gives some of its entries."""
    envs = gym.make_vec(env_id, num_envs=1, obs_type="vector")
    envs.reset(seed=seed, options=options)
    at = vector_slices(envs.variant.entries)
    return envs, envs.state, lambda name: envs.vectors(ALL)[0, at[name]]


@EACH
def test_space(env_id):
    rows = FAMILY[env_id].variants[env_id].entries
    env, envs = (make(env_id, obs_type="vector") for make in (gym.make, gym.make_vec))
    assert env.observation_space == envs.single_observation_space == vector_space(rows)
    assert envs.observation_space.shape == (1, sum(row.width for row in rows))
    names = [row.name for row in rows]
    assert len(set(names)) == len(names)
    assert all(row.meaning and row.low < row.high for row in rows)


@EACH
def test_the_same_game_with_pixels(env_id):
    """The same frames and rewards, to the end of some episodes."""
    pixels, vectors = (gym.make_vec(env_id, num_envs=4, obs_type=obs_type) for obs_type in ("pixels", "vector"))
    pixels.reset(seed=1)
    vectors.reset(seed=1)
    rng, ended = np.random.default_rng(1), False
    for _ in range(STEPS):
        actions = stumbling(pixels, rng, np.linspace(0, 1, 4))
        (frames, *numbers, infos), (_, *same, _) = pixels.step(actions), vectors.step(actions)
        check_same(frames, vectors.pixels(ALL))
        check_same(numbers, same)
        ended |= "final_obs" in infos
    assert ended


@EACH
def test_no_frame_is_drawn(env_id, monkeypatch):
    def draws(*_):
        raise AssertionError("a frame was drawn")

    monkeypatch.setattr(FAMILY[env_id], "frames", draws)
    monkeypatch.setattr(FAMILY[env_id], "pixels", draws)
    envs = gym.make_vec(env_id, num_envs=LANES, obs_type="vector")
    envs.reset(seed=0)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(STEPS):
        *_, infos = envs.step(stumbling(envs, rng, np.linspace(0, 1, LANES)))
        ended += "final_obs" in infos
    assert ended > 3
    gym.make(env_id, obs_type="vector").reset(seed=0)


@pytest.mark.parametrize("env_id", ["MortarMayhem-v0", "MortarMayhem-Grid-v0", "Endless-MortarMayhem-v0"])
def test_commands_are_there_while_they_are_shown(env_id):
    envs, s, entries = made(env_id, seed=3)
    shown = []
    for _ in range(60):
        white = (envs.frames(ALL)[0] == 255).all(axis=-1).any()
        command = entries("command")
        assert command.sum() == white
        if white:
            shown.append(COMMANDS[int(command.argmax())])
        envs.step(player(envs))
    expected = [COMMANDS[command] for command in s.commands[0, : s.count[0]].tolist() for _ in range(3)]
    assert shown == expected


def test_commands_of_act_tasks():
    for env_id in ("MortarMayhemB-v0", "MortarMayhemB-Grid-v0"):
        pixels, vectors = gym.make(env_id), gym.make(env_id, obs_type="vector")
        at = vector_slices(FAMILY[env_id].variants[env_id].entries)["commands"]
        assert np.array_equal(pixels.reset(seed=4)[0]["vector_observation"], vectors.reset(seed=4)[0][at])


@MORTAR
@pytest.mark.parametrize("feedback", [True, False])
def test_fire(env_id, feedback):
    envs, s, entries = made(env_id, seed=5, visual_feedback=feedback)
    burnt, size = 0, 6 if env_id.startswith("Endless") else 5
    for _ in range(110):
        fire = bool(s.burning[0]) and feedback
        assert (entries("fire")[0], entries("arena")[0]) == (fire, np.float32(size / 6))
        tile = 42 - 7 * size + 14 * envs.ground_truth()[0] * (size - 1) + 7
        assert np.allclose(entries("safe") * 84, tile * fire, atol=1e-4)
        burnt += fire
        envs.step(player(envs))
    assert (burnt > 5) == feedback


@pytest.mark.parametrize("env_id", ["MysteryPath-v0", "MysteryPath-Grid-v0"])
def test_origin_and_goal(env_id):
    for shown in (False, True):
        envs, _, entries = made(env_id, seed=5, show_origin=shown, show_goal=shown)
        frame = envs.frames(ALL)[0]
        for name, color in (("origin", (0, 0, 255)), ("goal", (0, 255, 0))):
            rows, columns = (frame == color).all(axis=-1).nonzero()
            middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2 + 0.5 if shown else 0
            assert np.allclose(entries(name) * 84, middle, atol=0.5 if name == "origin" else 1e-4)


@pytest.mark.parametrize("options", [{}, {"show_background": True}, {"show_stamina": True}])
def test_past_path(options):
    """Each white tile on the screen has its entry, and the other entries are zero."""
    envs, _, entries = made("Endless-MysteryPath-v0", seed=2, **options)
    tiles = 0
    for _ in range(120):
        white = (envs.frames(ALL)[0] == 255).all(axis=-1)
        past = entries("past").reshape(8, 7)
        first = round(float(entries("scroll")[0]) * 12) - 12  # the left edge of the first column's tiles
        expected = np.zeros((8, 7), bool)
        for column, row in np.ndindex(8, 7):
            left = first + 12 * column
            expected[column, row] = white[12 * row : 12 * row + 12, max(left, 0) : max(left + 12, 0)].any()
        if first + 12 > 1:  # of narrower ones, only the grey edge is on the screen
            assert np.array_equal(past > 0, expected)
        tiles += past.sum()
        envs.step(player(envs))
    assert tiles > 300


def test_stamina_and_background():
    envs, s, entries = made("Endless-MysteryPath-v0", seed=1, show_stamina=True, show_background=True)
    for _ in range(60):
        green = (envs.frames(ALL)[0, :, 80:] == (0, 255, 0)).all(axis=-1).mean()
        assert entries("bar")[0] == 1
        assert entries("stamina")[0] == pytest.approx(green)
        assert round(float(entries("ground")[0]) * 12) - 1 == (s.pos[0, 0] - s.origin[0, 0]) % 12
        envs.step(player(envs))
    _, _, entries = made("Endless-MysteryPath-v0")
    assert not np.concatenate([entries(name) for name in ("ground", "bar", "stamina", "cross", "past", "scroll")]).any()


# ---- what entries of Searing Spotlights say, against the state and the picture ----
NO_LIGHTS = {
    "SearingSpotlights-v0": {"initial_spawns": 0, "num_spawns": 0},
    "Endless-SearingSpotlights-v0": {"initial_spawns": 0, "spawn_interval": 1000},
}
IN_VIEW = {"agent_visible": True, "coins_visible": True}
EIGHT = ("up", "up-left", "left", "down-left", "down", "down-right", "right", "up-right")
WAYS = {"none": (0, 0), "left": (1, 0), "right": (2, 0), "up": (0, 1), "down": (0, 2)}
WAYS |= {"up-left": (1, 1), "down-left": (1, 2), "down-right": (2, 2), "up-right": (2, 1)}


@pytest.mark.parametrize("env_id", SearingSpotlights.variants)
def test_the_action_in_the_bar(env_id):
    """One-hot, horizontal and vertical, of the step before the last one, as in the original; and the facing it gave."""
    envs, _, entries = made(env_id, seed=1, **NO_LIGHTS[env_id], **IN_VIEW)
    before = (0, 0)
    for name in (*WAYS, "none"):
        envs.step(np.array([WAYS[name]]))
        assert (entries("horizontal").argmax(), entries("vertical").argmax()) == before
        assert entries("horizontal").sum() == entries("vertical").sum() == 1
        if name != "none":
            assert EIGHT[int(entries("facing").argmax())] == name
        assert entries("facing").sum() == 1
        before = WAYS[name]


@pytest.mark.parametrize("env_id", SearingSpotlights.variants)
def test_places_in_the_light(env_id):
    """Of the agent, the first coin and the exit: pixels over 144, then x and y of the middle, which differ."""
    finite = env_id == "SearingSpotlights-v0"
    options = {"exit_visible": True} if finite else {"coin_show_duration": 1000}
    envs, s, entries = made(env_id, seed=2, **NO_LIGHTS[env_id], **IN_VIEW, **options)
    bodies = {"agent": AGENT, "coin": COIN} | ({"exit": EXIT} if finite else {})
    rng, apart = np.random.default_rng(0), 0
    for _ in range(25):
        envs.step(rng.integers(0, 3, (1, 2)))
        for name, body in bodies.items():
            size, *middle = entries(name)
            assert size > 0.1, name
            assert np.array(middle) * 84 == pytest.approx(s.bodies[:, 0, body], abs=2.5), name
            apart += abs(middle[0] - middle[1]) > 0.1
    assert apart > 25


@pytest.mark.parametrize("env_id", SearingSpotlights.variants)
def test_health_and_reward_in_the_bar(env_id):
    """The bar's left half is green by the share of health that is left; its right half yellow after a reward."""
    envs, s, entries = made(env_id, seed=3, initial_spawns=40, agent_health=200, **IN_VIEW)
    health, rewarded, gain = [], [], 0.0
    for t in range(160):  # the lights come first, then the coins
        _, rewards, *_, infos = envs.step(spot_player(envs) if t > 80 else np.zeros((1, 2), np.int64))
        if "_final_obs" in infos:
            break
        assert entries("rewarded")[0] == (gain > 0)
        assert entries("health")[0] == pytest.approx(s.health[0] / 200, abs=1 / 42)
        health.append(entries("health")[0])
        rewarded.append(entries("rewarded")[0])
        gain = rewards[0]
    assert health[0] > health[-1] > 0
    assert sorted(health, reverse=True) == health
    assert 0 < sum(rewarded) < len(rewarded)


def test_an_exit_opens():
    envs, _, entries = made(
        "SearingSpotlights-v0", seed=2, initial_spawns=0, num_spawns=0, **IN_VIEW, exit_visible=True, num_coins=[1]
    )
    found = []
    for _ in range(40):
        *_, infos = envs.step(spot_player(envs))
        if "_final_obs" in infos:
            break
        found.append((entries("exit_open")[0], entries("coin")[0] > 0))
    assert found[0] == (0, True)
    assert found[-1] == (1, False)


def test_tiles_of_the_light():
    """Row by row: their middle is that of the bright pixels below the bar."""
    envs, _, entries = made("SearingSpotlights-v0", seed=5, initial_spawns=1, num_spawns=0, light_dim_off_duration=0)
    seen = 0
    for _ in range(200):
        envs.step(np.zeros((1, 2), np.int64))
        light = entries("light").reshape(7, 7)
        rows, columns = (envs.frames(ALL)[0, 6:].max(axis=-1) > 60).nonzero()
        if len(rows) > 150:
            middle = [(light.sum(axis) * (np.arange(7) + 0.5)).sum() / light.sum() for axis in (1, 0)]
            assert middle == pytest.approx([(rows.mean() + 6) / 12, columns.mean() / 12], abs=0.5)
            seen += abs(middle[0] - middle[1]) > 1
    assert seen > 10
