"""The play program under SDL's dummy driver: keys that are posted move the agent, and the window shows what happens."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import memory_gym_envs
from memory_gym_envs import play
from memory_gym_envs.play import VIEW, WINDOW, Game

EACH = pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
WITHOUT_PYGAME = "import sys; sys.modules['pygame'] = None; from memory_gym_envs.play import main; main(sys.argv[1:])"


@pytest.fixture
def pygame(monkeypatch):
    """Give pygame with a window, and close it afterwards."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    pygame.display.init()
    pygame.font.init()
    pygame.display.set_mode(WINDOW)
    yield pygame
    pygame.quit()


@pytest.fixture
def keyboard(pygame):
    """Give a function that posts keys, lets the game hear them, and takes a step."""

    def post(game, *names, up=False):
        for name in names:
            kind = pygame.KEYUP if up else pygame.KEYDOWN
            pygame.event.post(pygame.event.Event(kind, key=pygame.key.key_code(name)))
        return play.listen(game)

    return post


def place(game):
    return (game.env.batch.state.pos[0] - 16).tolist()


# ---- keys ----


@pytest.mark.parametrize(("keys", "way"), [("d", (3, 0)), ("left", (-3, 0)), ("w", (0, -3)), ("down", (0, 3))])
@pytest.mark.parametrize(("env_id", "seed"), [("SearingSpotlights-v0", 0), ("MortarMayhemB-v0", 1)])
def test_key_moves_the_agent(keyboard, env_id, seed, keys, way):
    game = Game(env_id, seed, debug=False)  # the agent is not at a wall
    first, before = place(game), game.observation
    assert keyboard(game, keys)
    game.step()
    assert np.subtract(place(game), first).tolist() == list(way)
    assert game.steps == 1
    assert game.observation is not before


@EACH
def test_every_direction_has_its_action(keyboard, env_id):
    game = Game(env_id, 0, debug=False)
    actions = []
    for key in ("w", "a", "s", "d"):
        keyboard(game, key)
        actions.append(np.array(game.action()).tolist())
        keyboard(game, key, up=True)
        game.tapped = []
    if "Grid" in env_id:
        assert actions == [3, 1, 0, 2]  # forward, turn left, nothing, turn right
    elif env_id == "Endless-MysteryPath-v0":
        assert actions == [2, 0, 3, 1]  # up, nothing, down, right
    else:
        assert actions == [[0, 1], [1, 0], [0, 2], [2, 0]]
    assert not np.any(game.action())


def test_two_keys_at_once(keyboard):
    game = Game("MysteryPath-v0", 0, debug=False)
    keyboard(game, "w", "right")
    assert game.action().tolist() == [2, 1]
    keyboard(game, "a")
    assert game.action().tolist() == [0, 1]  # left and right cancel out
    grid = Game("MysteryPath-Grid-v0", 0, debug=False)
    keyboard(grid, "w", "a")
    assert grid.action() == 1  # the last one


def test_short_press_is_not_lost_and_counts_once(keyboard):
    game = Game("MysteryPath-Grid-v0", 0, debug=False)
    keyboard(game, "a")
    keyboard(game, "a", up=True)
    assert game.action() == 1
    game.step()
    assert game.action() == 0
    keyboard(game, "a")
    game.step()
    assert game.action() == 1  # still held
    keyboard(game, "a", up=True)
    assert game.action() == 0


def test_first_move_starts_the_clock(keyboard):
    game = Game("SearingSpotlights-v0", 0, debug=False)
    game.step()
    assert game.steps == 0
    keyboard(game, "r")
    game.step()
    assert game.steps == 0
    keyboard(game, "d")
    keyboard(game, "d", up=True)
    for _ in range(3):
        game.step()
    assert game.steps == 3


def test_seed_and_restart(keyboard):
    game = Game("SearingSpotlights-v0", 1, debug=False)
    second = game.observation
    keyboard(game, "page down")
    assert (game.seed, np.array_equal(game.observation, second)) == (0, False)
    keyboard(game, "page down")
    assert game.seed == 0
    keyboard(game, "page up")
    assert (game.seed, np.array_equal(game.observation, second)) == (1, True)
    keyboard(game, "d")
    game.step()
    keyboard(game, "r")
    assert (game.seed, game.steps, np.array_equal(game.observation, second)) == (1, 0, True)


def test_escape_and_closing_quit(pygame, keyboard):
    game = Game("MysteryPath-v0", 0, debug=False)
    assert keyboard(game)
    assert not keyboard(game, "escape")
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert not keyboard(game)


# ---- what is shown ----


def test_text_tells_the_reward_and_what_ended_the_episode(keyboard):
    game = Game("MysteryPath-Grid-v0", 2, debug=False)
    game.env.reset(seed=2, options={"reward_fall_off": -0.5, "max_steps": 8})
    assert "seed 2   step 0" in game.text()
    told = set()
    keyboard(game, "w")
    for _ in range(9):
        game.step()
        told.add(game.text().split("\n")[1])
    assert game.steps == 8  # no step after the end
    assert "truncated (max_steps): success 0, num_fails" in game.text()
    keyboard(game, "r")
    assert "truncated" not in game.text()
    assert "reward 0   return 0" in game.text()
    assert len(told) > 1


def test_text_tells_how_it_went(keyboard):
    game = Game("SearingSpotlights-v0", 41, debug=False)
    keyboard(game, "s")
    while not game.ending:
        game.step()
    assert game.ending == "terminated: agent_health 0, coins_collected 0, success 0"


def test_text_tells_the_commands_that_are_not_in_the_picture():
    game = Game("MortarMayhemB-v0", 0, debug=False)
    s = game.env.batch.state
    names = [play.VECTOR_ORDER[row.argmax()] for row in game.observation["vector_observation"].reshape(20, 9)[:10]]
    assert f"commands: {', '.join(names).replace('_', ' ')}" in game.text()
    assert len(names) == s.count[0] == 10


@pytest.mark.parametrize("debug", [False, True])
@EACH
def test_window_shows_the_picture_and_the_text(pygame, env_id, debug):
    game, screen = Game(env_id, 0, debug), pygame.display.get_surface()
    play.show(game, screen, pygame.font.Font(None, 20))
    shown = pygame.surfarray.array3d(screen).swapaxes(0, 1)
    frame = game.env.render()
    zoom = VIEW / len(frame)
    at = ((np.arange(len(frame)) + 0.5) * zoom).astype(int)
    assert np.array_equal(shown[at][:, at], frame)
    assert (shown[VIEW:] != play.PAPER).any()
    text = (shown[VIEW:] != play.PAPER).any(axis=(1, 2)).nonzero()[0]
    assert text.max() < len(shown) - VIEW - 1  # all of it


def test_program_plays_until_the_window_is_closed(pygame, monkeypatch):
    """The whole program, from the command line to its end: a key held down walks the agent to the wall."""
    games, show = [], play.show

    def show_and_stop(game, *rest):
        games.append(game)
        show(game, *rest)
        if game.steps >= 5:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    monkeypatch.setattr(play, "show", show_and_stop)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_a))
    play.main(["MysteryPath-v0", "--seed", "3", "--debug", "--options", '{"max_steps": 6}'])
    assert games[-1].steps == 5
    assert games[-1].seed == 3
    assert games[-1].env.render_mode == "debug_rgb_array"
    assert games[-1].env.batch.settings[0]["max_steps"] == 6
    fresh = Game("MysteryPath-v0", 3, debug=False)
    for _ in range(5):
        fresh.env.step([1, 0])
    assert place(games[-1]) == place(fresh)


# ---- bad input ----


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["MysteryPth-v0"],
            "there is no id 'MysteryPth-v0'; the nearest is MysteryPath-v0, and all are MortarMayhem-v0,",
        ),
        (["MysteryPath-v0", "--seed", "-1"], "--seed must be at least 0, not -1"),
        (["MysteryPath-v0", "--options", "{"], "--options is no JSON (Expecting property name"),
        (["MysteryPath-v0", "--options", "[3]"], "--options: MysteryPath-v0: options must be a dictionary or None"),
        (["MysteryPath-v0", "--options", '{"max_step": 3}'], "--options: MysteryPath-v0 has no option 'max_step'"),
        (["MysteryPath-v0"], "playing needs pygame: pip install pygame-ce"),
        (["memory_gym_envs/MysteryPath-v0"], "playing needs pygame: pip install pygame-ce"),
    ],
)
def test_one_clear_line(arguments, message, monkeypatch):
    monkeypatch.setattr(play, "pygame", None)
    with pytest.raises(SystemExit) as error:
        play.main(arguments)
    assert error.value.code.startswith(message)
    assert "\n" not in error.value.code


def test_without_pygame():
    folder = Path(memory_gym_envs.__file__).parents[1]
    command = [sys.executable, "-c", WITHOUT_PYGAME, "MysteryPath-v0"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    assert (result.returncode, result.stderr) == (1, "playing needs pygame: pip install pygame-ce\n")


def test_without_a_display_it_ends():
    pytest.importorskip("pygame")
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    environ = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-m", "memory_gym_envs.play", "MysteryPath-v0"]
    folder = Path(memory_gym_envs.__file__).parents[1]
    result = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environ, timeout=60, check=False)
    assert result.returncode == 1
    # Libraries that looked for a display may have said something before.
    assert result.stderr.splitlines()[-1].startswith("no window can be opened: ")
