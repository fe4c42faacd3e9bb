"""Play an environment with the keyboard.

    python -m memory_gym_envs.play ID [--seed N] [--options JSON] [--debug]

WASD or the arrows move, R restarts, Page Up and Page Down change the seed, Escape quits. The first move starts the
clock. Shows what the agent sees, or the debug view. Needs pygame, the extra `play`. Gymnasium's own `play` can neither
restart nor change the seed, and begins the next episode before one has seen how the last one ended.
"""

import argparse
import difflib
import json
import os
import sys
import textwrap
from typing import Any

import gymnasium as gym
import numpy as np

from memory_gym_envs import IDS, MemoryGymEnv
from memory_gym_envs.mortar_mayhem.options import VECTOR_ORDER

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
try:
    import pygame
except ImportError:
    pygame = None  # type: ignore[assignment]

VIEW = 504  # pixels, six for each of the agent's
LINE_HEIGHT, TEXT_LINES, COLUMNS = 20, 7, 72  # of text: pixels, lines, and letters in a line
WINDOW = (VIEW, VIEW + LINE_HEIGHT * TEXT_LINES + 8)
INK, PAPER = (230, 230, 230), (30, 30, 30)
FRAMES = 60  # looks at the keyboard in a second; steps are fewer
HELP = "WASD or arrows: move, R: restart, Page Up/Down: seed, Esc: quit"

UP, DOWN, LEFT, RIGHT = "up", "down", "left", "right"
KEYS = {"w": UP, "s": DOWN, "a": LEFT, "d": RIGHT} | {way: way for way in (UP, DOWN, LEFT, RIGHT)}
RESTARTS = {"r": 0, "page up": 1, "page down": -1}  # what they add to the seed
GRID_ACTIONS = {LEFT: 1, RIGHT: 2, UP: 3}  # turn, turn, walk
PATH_ACTIONS = {RIGHT: 1, UP: 2, DOWN: 3}  # of the endless Mystery Path


class Game:
    """An environment, the keys that are down, and what there is to tell about the episode.

    Raises ValueError for a seed below 0, and for wrong options.
    """

    def __init__(self, env_id: str, seed: int, debug: bool, options: dict[str, Any] | None = None):
        self.env_id = env_id
        mode = "debug_rgb_array" if debug else "rgb_array"
        env = gym.make(f"memory_gym_envs/{env_id}", render_mode=mode, options=options).unwrapped
        assert isinstance(env, MemoryGymEnv)
        self.env = env
        self.held: list[str] = []  # directions, the last pressed last
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Begins the episode of this seed."""
        self.observation, _ = self.env.reset(seed=seed)
        self.seed, self.steps, self.reward, self.returned, self.ending = seed, 0, 0.0, 0.0, ""
        self.tapped: list[str] = []  # directions pressed since the last step, so that no short press is lost

    def press(self, key: str) -> None:
        """Takes in that a key, by pygame's name, goes down."""
        if key in KEYS:
            self.held.append(KEYS[key])
            self.tapped.append(KEYS[key])
        elif key in RESTARTS:
            self.restart(max(self.seed + RESTARTS[key], 0))

    def release(self, key: str) -> None:
        """Takes in that a key goes up."""
        if KEYS.get(key) in self.held:
            self.held.remove(KEYS[key])

    def action(self) -> Any:
        """The action that the keys ask for. Opposite ones cancel out; of an id with one branch, the last one counts."""
        ways = self.held + self.tapped
        if isinstance(self.env.action_space, gym.spaces.MultiDiscrete):
            axes = ((LEFT, RIGHT), (UP, DOWN))
            return np.array([(back in ways) + 2 * (forth in ways) for back, forth in axes]) % 3
        actions = GRID_ACTIONS if getattr(self.env.batch.variant, "grid", False) else PATH_ACTIONS
        return next((actions[way] for way in reversed(ways) if way in actions), 0)

    def step(self) -> None:
        """Takes a step, unless the episode is over or waits for the first move."""
        if self.ending or not (self.steps or self.held or self.tapped):
            return
        self.observation, self.reward, terminated, truncated, info = self.env.step(self.action())
        self.tapped = []
        self.steps, self.returned = self.steps + 1, self.returned + self.reward
        if terminated or truncated:
            shown = info.keys() - {"ground_truth", "reward", "length", "is_success"}  # the last is success once more
            numbers = ", ".join(f"{key} {value:g}" for key, value in info.items() if key in shown)
            self.ending = f"{'terminated' if terminated else 'truncated (max_steps)'}: {numbers}"

    def text(self) -> str:
        """What there is to tell, in lines."""
        lines = [f"{self.env_id}   seed {self.seed}   step {self.steps}"]
        lines.append(f"reward {self.reward:g}   return {self.returned:g}")
        if isinstance(self.observation, dict):
            lines.append("commands: " + ", ".join(commands(self.observation["vector_observation"])))
        lines.append(self.ending)
        return "\n".join([*lines, HELP])


def commands(vector: np.ndarray) -> list[str]:
    """The names of an act task's commands, from its vector observation (180,)."""
    which = vector.reshape(-1, len(VECTOR_ORDER))
    return [VECTOR_ORDER[row.argmax()].replace("_", " ") for row in which if row.any()]


def listen(game: Game) -> bool:
    """Passes on what the keyboard did; False when it is time to quit."""
    for event in pygame.event.get():
        if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
            return False
        if event.type == pygame.KEYDOWN:
            game.press(pygame.key.name(event.key))
        elif event.type == pygame.KEYUP:
            game.release(pygame.key.name(event.key))
    return True


def show(game: Game, screen: Any, font: Any) -> None:
    """Draws the environment's picture, and the text below it."""
    frame = np.ascontiguousarray(game.env.render())
    picture = pygame.image.frombuffer(frame.tobytes(), frame.shape[1::-1], "RGB")
    screen.fill(PAPER)
    screen.blit(pygame.transform.scale(picture, (VIEW, VIEW)), (0, 0))
    lines = [part for line in game.text().split("\n") for part in textwrap.wrap(line, COLUMNS) or [""]]
    for number, line in enumerate(lines):
        screen.blit(font.render(line, True, INK), (6, VIEW + 6 + LINE_HEIGHT * number))
    pygame.display.flip()


def run(game: Game) -> None:
    """Opens the window and plays until it is closed."""
    screen = pygame.display.set_mode(WINDOW)
    pygame.display.set_caption(game.env_id)
    font, clock, waited = pygame.font.Font(None, LINE_HEIGHT), pygame.time.Clock(), 0
    wait = 1000 / game.env.metadata["render_fps"]  # milliseconds
    while listen(game):
        waited += clock.tick(FRAMES)
        if waited >= wait:
            waited %= wait
            game.step()
        show(game, screen, font)


def main(arguments: list[str] | None = None) -> None:
    """Plays what the command line says. Exits with one line for wrong arguments, without pygame or a display."""
    parser = argparse.ArgumentParser(prog="python -m memory_gym_envs.play", description=HELP)
    parser.add_argument("id", help=", ".join(IDS))
    parser.add_argument("--seed", type=int, default=0, help="the level (default: 0)")
    parser.add_argument("--options", default="{}", help="""reset parameters, as '{"agent_scale": 0.3}'""")
    parser.add_argument("--debug", action="store_true", help="show the debug view, with the ground truth")
    args = parser.parse_args(arguments)
    args.id = args.id.removeprefix("memory_gym_envs/")
    if args.id not in IDS:
        (near,) = difflib.get_close_matches(args.id, IDS, n=1, cutoff=0.0)
        sys.exit(f"there is no id {args.id!r}; the nearest is {near}, and all are {', '.join(IDS)}")
    if args.seed < 0:
        sys.exit(f"--seed must be at least 0, not {args.seed}")
    try:
        game = Game(args.id, args.seed, args.debug, json.loads(args.options))
    except json.JSONDecodeError as error:
        sys.exit(f"--options is no JSON ({error}): {args.options}")
    except ValueError as error:
        sys.exit(f"--options: {error}")
    if pygame is None:
        sys.exit("playing needs pygame: pip install pygame-ce")
    try:
        pygame.display.init()
        # Without a display, SDL draws where nobody sees it, and the program would wait for keys for ever.
        if pygame.display.get_driver() in ("dummy", "offscreen") and "SDL_VIDEODRIVER" not in os.environ:
            sys.exit("no window can be opened: there is no display")
        pygame.font.init()
        run(game)
    except pygame.error as error:
        sys.exit(f"no window can be opened: {error}")
    finally:
        pygame.quit()


if __name__ == "__main__":
    main()
