"""Play episodes of trained agents and write a page to watch them.

    python enjoy.py runs/RUN/model.pt --out page.html
    python enjoy.py agents/mortar-mayhem-grid-trxl.pt agents/mortar-mayhem-grid-gru.pt --levels 3

The page is one file that needs no network: what the agent saw beside the ground truth (and beside what it reconstructed
from memory, where it was trained to), its actions and their probabilities, its state values and its policy's entropy,
the rewards, and the steps that every block of a Transformer-XL attended to (thesis 6.5), or the state of a recurrent
memory. Two agents are shown side by side. Needs the extra `eval`.

Shape letters: T steps of the episode, A action branches, K blocks, H heads, M earlier steps that a step attends to,
P vectors of a recurrent memory's state, D its units.
"""

import base64
import contextlib
import io
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import Tensor, nn

from ppo_utils.checkpoints import Checkpoint
from ppo_utils.environments import as_tensors, envs_for, is_memory_gym, wrappers_of
from ppo_utils.errors import RunError, report_unusable_policy
from ppo_utils.evaluation import MEMORY_STEPS, first_after, with_room
from ppo_utils.flags import bounded, check_bounds
from ppo_utils.infos import final_numbers, ground_truths
from ppo_utils.terminal import one_line_exit, open_streams
from ppo_utils.video import as_image, check_draws

try:
    from PIL import Image
    from plotly.offline import get_plotlyjs
except ImportError as error:
    raise SystemExit(f'enjoy.py needs {error.name}: pip install -e ".[eval]"') from None

SHEET = 16  # frames in one picture: a neighbour costs few bytes, and a jump makes a browser decode one sheet only
VIEW, RECONSTRUCTION = "agent's view", "reconstruction"
LARGEST = 336  # pixels of a frame's longer side
FREE = {"horizontal": ["none", "left", "right"], "vertical": ["none", "up", "down"]}
GRID = {"action": ["none", "turn left", "turn right", "forward"]}
ENDLESS_PATH = {"action": ["none", "right", "up", "down"]}


@dataclass
class Family:
    """What the page says of the environments of a Memory Gym family."""

    truth: str  # what the ground truth is, and the names of its numbers, of which an endless id has fewer
    numbers: list[str]
    rewarded: str  # the event that earns a positive reward
    shown: str  # an event that the frame shows, and whether it does in a state of one lane
    shows: Callable[[Any], bool]


FAMILIES = {
    "MortarMayhem": Family(
        truth="the target tile, from 0 to 1 across the arena",
        numbers=["column", "row"],
        rewarded="command completed",
        shown="command shown",
        shows=lambda state: state.symbol[0] > 0,
    ),
    "MysteryPath": Family(
        truth="the direction of the path's next tile",
        numbers=["right", "up", "down", "left"],
        rewarded="rewarded tile",
        shown="fell off",
        shows=lambda state: state.fallen[0],
    ),
    "SearingSpotlights": Family(
        truth="positions, from 0 to 1 across the frame",
        numbers=["agent x", "agent y", "coin x", "coin y", "exit x", "exit y"],
        rewarded="coin or exit",
        shown="in a spotlight",
        shows=lambda state: state.floor[0] > 0,
    ),
}


@dataclass
class Config:
    """Play episodes of trained agents and write a page to watch them."""

    checkpoint: Annotated[str, tyro.conf.Positional]
    """model.pt or a checkpoint"""
    others: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """further ones, of agents that play the same task, to compare on the same levels"""
    seed: int | None = None
    """the level, and the seed of the actions (default: the first level after those of the training)"""
    levels: bounded(int, 1, 100) = 1
    """levels to play, from this one on"""
    deterministic: bool = False
    """take the most probable actions instead of sampling them"""
    env_options: str | None = None
    """reset options of a Memory Gym environment as JSON, over those of the training"""
    out: str = "page.html"
    """the page to write"""
    max_steps: bounded(int, 1, 100_000) = 1000
    """where to stop an episode that does not end"""


class Video:
    """Frames, packed as they come: SHEET of them below one another make a WebP picture of `sheets`, a data URL.

    What a frame shares with those above it costs nearly nothing.
    """

    def __init__(self, lossless: bool):
        self.lossless, self.sheets, self.waiting, self.shape = lossless, [], [], (0, 0)

    def add(self, frame: np.ndarray) -> None:
        """Add a frame (h, w) or (h, w, 3), uint8."""
        self.shape = frame.shape
        self.waiting.append(frame)
        if len(self.waiting) == SHEET:
            self.pack()

    def pack(self) -> None:
        """Pack the frames that are waiting for their sheet to fill."""
        if self.waiting:
            file = io.BytesIO()
            sheet = Image.fromarray(np.concatenate(self.waiting))
            sheet.save(file, "WEBP", lossless=self.lossless, quality=60, method=2)
            self.sheets.append("data:image/webp;base64," + base64.b64encode(file.getvalue()).decode())
            self.waiting = []


@dataclass
class Episode:
    """T steps: what was to be seen when the agent chose an action, what it thought, and what the action earned."""

    videos: dict[str, Video] = field(default_factory=dict)
    policy: list[list[np.ndarray]] = field(default_factory=list)  # T x A, the probabilities of a branch's actions
    actions: list[list[int]] = field(default_factory=list)  # T x A
    values: list[float] = field(default_factory=list)  # T
    entropies: list[float] = field(default_factory=list)  # T
    rewards: list[float] = field(default_factory=list)  # T
    truth: list[np.ndarray] = field(default_factory=list)  # T x (G,); empty where the environment tells none
    estimate: list[np.ndarray] = field(default_factory=list)  # T x (G,); empty without an estimator
    attention: list[list[np.ndarray]] = field(default_factory=list)  # T x K x (H, M or fewer), the oldest step first
    states: list[np.ndarray] = field(default_factory=list)  # T x (P, D), each with the step's observation in it
    events: dict[str, list[int]] = field(default_factory=dict)  # the steps of each, by its name
    finished: bool = False  # not cut short
    stacked: bool = False  # its images are stacks of grayscale ones
    final: dict[str, float] = field(default_factory=dict)  # numbers of the final info

    def film(self, name: str, frame: np.ndarray) -> None:
        """Add a frame to a video. What a network draws is noise in its last bits: that one need not be exact."""
        self.videos.setdefault(name, Video(lossless=name != RECONSTRUCTION)).add(frame)


# ---- PLAY ----
@torch.no_grad()
def play(
    agent: nn.Module,
    envs: gym.vector.VectorEnv,
    seed: int,
    max_steps: int,
    deterministic: bool = False,
    stacked: bool = False,
) -> Episode:
    """Play one episode, or max_steps of it, in the only lane of `envs`, with an empty memory.

    deterministic: take the most probable actions. stacked: whether the images that the agent gets are stacks of
    grayscale ones. Raises ValueError if there are no images, RunError as the environment does and if the policy is not
    finite.
    """
    torch.manual_seed(seed)
    family = family_of(envs.spec.id)
    episode = Episode(stacked=stacked)
    rewarded = family.rewarded if family else "reward"
    episode.events = {rewarded: [], "negative reward": []}
    if family:
        episode.events |= {"failure": [], family.shown: []}
    obs, infos = envs.reset(seed=seed)
    memory = agent.memory.begin_rollout(agent.memory.initial(1, torch.device("cpu")), MEMORY_STEPS)
    while not episode.finished and len(episode.actions) < max_steps:
        for name, frame in views(envs, obs, stacked).items():
            episode.film(name, frame)
        if family or agent.estimator is not None:  # of other packages, training has seen that there is one
            episode.truth.append(np.asarray(ground_truths(infos)[0]))
        step = len(episode.actions)
        memory = with_room(agent.memory, memory, step)
        if family and family.shows(envs.unwrapped.state):
            episode.events[family.shown].append(step)
        with watching(agent, memory, episode), report_unusable_policy():
            now = as_tensors(obs, torch.device("cpu"))
            actions, *_ = agent.get_action_and_value(now, memory, deterministic)
        episode.actions.append(actions[0].tolist())
        obs, rewards, terminated, truncated, infos = envs.step(actions.numpy())
        episode.rewards.append(float(rewards[0]))
        if rewards[0]:
            episode.events[rewarded if rewards[0] > 0 else "negative reward"].append(step)
        if family and terminated[0] and rewards[0] <= 0:
            episode.events["failure"].append(step)
        episode.finished = bool(terminated[0] or truncated[0])
    if episode.finished:
        episode.final = {name: values.item() for name, values in final_numbers(infos, np.ones(1, bool)).items()}
    return episode


@contextlib.contextmanager
def watching(agent: nn.Module, memory: Any, episode: Episode) -> Iterator[None]:
    """Add to the episode what the agent's heads and its memory, attention or a state, compute at a step of one lane."""

    def add_outputs(_: nn.Module, given: Any, outputs: tuple) -> None:
        policy, values, features = outputs
        episode.policy.append([branch.probs[0].numpy() for branch in policy])
        episode.values.append(values.item())
        episode.entropies.append(sum(branch.entropy().item() for branch in policy))
        if agent.decoder is not None:
            episode.film(RECONSTRUCTION, displayable(agent.decoder(features).sigmoid()[0].numpy(), episode.stacked))
        if agent.estimator is not None:
            episode.estimate.append(agent.estimator(features)[0].numpy())

    def add_weights(attention: nn.Module, given: tuple, _: Tensor) -> None:
        x, keys, _, age, mask = given
        weights.append(attention_weights(attention, x, keys, age, mask)[0, :, 0].numpy())  # (H, M)

    weights = []
    hooks = [agent.heads.register_forward_hook(add_outputs)]
    hooks += [block.attention.register_forward_hook(add_weights) for block in getattr(agent.memory, "blocks", ())]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()
    hidden = getattr(memory, "hidden", None)
    if weights:
        episode.attention.append(weights)
    elif isinstance(hidden, Tensor) and len(hidden) == 1 and hidden.numel():
        episode.states.append(hidden[0].reshape(-1, hidden.shape[-1]).numpy().copy())


def attention_weights(attention: nn.Module, x: Tensor, keys: Tensor, age: Tensor, mask: Tensor) -> Tensor:
    """Return the weights (S, H, L, M) that `Attention.forward` gives to the keys; its fused kernel does not."""
    query, bias, empty = attention.query_and_bias(x, age, mask)
    if bias.dtype == torch.bool:
        bias = torch.zeros_like(bias, dtype=x.dtype).masked_fill(~bias, -math.inf)
    scores = query @ attention.split(keys).transpose(2, 3) / math.sqrt(query.shape[-1])
    return (scores + bias).softmax(-1).masked_fill(empty[:, None], 0.0)


def views(envs: gym.vector.VectorEnv, obs: dict[str, np.ndarray], stacked: bool) -> dict[str, np.ndarray]:
    """Return frames by name: what the agent sees (drawn for it, if it gets vectors only) and the ground truth."""
    pictures = {name: displayable(part[0], stacked) for name, part in obs.items() if part.ndim == 4}
    frames = {VIEW if len(pictures) == 1 else name: picture for name, picture in pictures.items()}
    if not frames:
        frames["rendered frame"] = rendered(envs, "rgb_array")
    if is_memory_gym(envs.spec.id):
        frames["ground truth"] = rendered(envs, "debug_rgb_array")
    return frames


def rendered(envs: gym.vector.VectorEnv, mode: str) -> np.ndarray:
    """Return the lane's picture in this render mode, reduced to LARGEST pixels; raise ValueError if there is none."""
    envs.unwrapped.render_mode = mode  # a Memory Gym environment draws in both, whichever it was made with
    frames = envs.render()
    if frames is None or frames[0] is None:
        raise ValueError(f"{envs.spec.id} draws no images (render_mode {mode}); there would be nothing to watch")
    image = Image.fromarray(as_image(frames[0]))
    image.thumbnail((LARGEST, LARGEST))
    return np.asarray(image)


def displayable(pixels: np.ndarray, stacked: bool) -> np.ndarray:
    """Turn pixels (H, W, C), uint8 or floats in [0, 1], into a frame: a stack becomes a square of C pictures."""
    if pixels.dtype != np.uint8:
        pixels = (pixels.clip(0, 1) * 255).round().astype(np.uint8)
    height, width, channels = pixels.shape
    if channels == 3 and not stacked:
        return pixels
    side = math.ceil(math.sqrt(channels))
    frames = np.zeros((side * side, height, width), np.uint8)
    frames[:channels] = np.moveaxis(pixels, 2, 0)
    return frames.reshape(side, side, height, width).swapaxes(1, 2).reshape(side * height, side * width)


# ---- PAGE ----
def episode_data(episode: Episode, env_id: str, facts: dict[str, Any]) -> dict[str, Any]:
    """Return an episode as JSON can hold it; facts, by name, stand in the page's head."""
    lines = {"state value": episode.values, "entropy": episode.entropies}
    branches = zip(branch_names(env_id, episode.policy[0]).items(), zip(*episode.policy, strict=True), strict=True)
    family = family_of(env_id)
    return {
        "facts": facts,
        "steps": len(episode.actions),
        "videos": [video_data(name, video) for name, video in episode.videos.items()],
        "branches": [
            {"name": name, "actions": actions, "probabilities": rounded(probabilities)}
            for (name, actions), probabilities in branches
        ],
        "actions": episode.actions,
        "lines": {name: rounded(line) for name, line in lines.items()},
        "rewards": rounded(episode.rewards),
        "events": episode.events,
        "truth_is": family.truth if family else "",
        "truth_names": family.numbers[: len(episode.truth[0])] if family else [],
        "truth": rounded(episode.truth),
        "estimate": rounded(episode.estimate),
        "attention": packed(episode.attention),
        "state": packed_states(episode.states),
    }


def family_of(env_id: str) -> Family | None:
    """Return the family of a Memory Gym environment; None for all others."""
    return next((family for name, family in FAMILIES.items() if name in env_id and is_memory_gym(env_id)), None)


def video_data(name: str, video: Video) -> dict[str, Any]:
    """Return a video as JSON can hold it."""
    video.pack()
    height, width = video.shape[:2]
    return {"name": name, "height": height, "width": width, "per_sheet": SHEET, "sheets": video.sheets}


def branch_names(env_id: str, branches: list[np.ndarray]) -> dict[str, list[str]]:
    """Name the action branches and their actions: in words for Memory Gym, else by numbers."""
    sizes = [len(branch) for branch in branches]
    if family_of(env_id):
        return FREE if sizes == [3, 3] else ENDLESS_PATH if "Endless" in env_id else GRID
    names = ["action"] if len(sizes) == 1 else [f"branch {i + 1}" for i in range(len(sizes))]
    return {name: [str(action) for action in range(size)] for name, size in zip(names, sizes, strict=True)}


def rounded(numbers: list) -> list:
    """Round to what a plot can show: digits cost bytes."""
    return np.round(np.array(numbers, np.float64), 5).tolist()


def packed(attention: list[np.ndarray]) -> dict[str, Any] | None:
    """Pack attention weights as T x K x H x M bytes, 255 times their square roots: small weights keep their digits.

    Entry M - a is the weight of the step that was a steps ago; one that was not there has 0.
    """
    if not attention:
        return None
    blocks, heads = len(attention[0]), len(attention[0][0])
    window = max(each[0].shape[1] for each in attention)
    weights = np.zeros((len(attention), blocks, heads, window), np.uint8)
    for step, each in enumerate(attention):
        weights[step, :, :, window - each[0].shape[1] :] = (np.sqrt(each) * 255).round()
    return {"blocks": blocks, "heads": heads, "window": window, "weights": base64.b64encode(weights.tobytes()).decode()}


def packed_states(states: list[np.ndarray]) -> dict[str, Any] | None:
    """Pack the states of a memory as P x D x T bytes: -127 to 127, times a vector's largest number / 127, plus 128.

    Units that change together are side by side: a vector's stand in the order of its first principal component.
    """
    if not states:
        return None
    units = np.stack(states, -1)  # (P, D, T)
    components, *_ = np.linalg.svd(units - units.mean(2, keepdims=True), full_matrices=False)
    units = np.take_along_axis(units, components[:, :, :1].argsort(1), 1)
    largest = np.abs(units).max((1, 2)).clip(1e-3)  # (P,)
    levels = (128 + 127 * units / largest[:, None, None]).round().astype(np.uint8)
    return {"largest": rounded(largest), "units": units.shape[1], "levels": base64.b64encode(levels.tobytes()).decode()}


def page(data: dict[str, Any], plotly: str) -> str:
    """Fill enjoy.html with the data and the source of the plotting library."""
    template = Path(__file__).with_name("enjoy.html").read_text(encoding="utf-8")
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # no name in it may end the script
    return template.replace("{{title}}", data["title"]).replace("{{data}}", text).replace("{{plotly}}", plotly)


# ---- MAIN ----
def load(path: str, env_options: str | None = None) -> tuple[nn.Module, gym.vector.VectorEnv, Any]:
    """Return the agent in the file, one lane of its environment that draws images, and its training's arguments.

    env_options: JSON, over those of the training. Raises ValueError, OSError, ImportError, gymnasium.error.Error or
    RunError, each with one line for the user.
    """
    checkpoint = Checkpoint.read(path, env_options)
    checkpoint.args.amp = False  # one lane is little work; not all CPUs have bfloat16
    check_draws("enjoy.py", checkpoint.args.env_id)
    envs = envs_for(checkpoint.args, 1, render_mode="debug_rgb_array", asynchronous=False)
    return checkpoint.agent(envs, envs.reset()[1]), envs, checkpoint.args


def main(config: Config) -> str:
    """Play, write the page, and return one line that says how it went. Raises what `load` and `play` raise."""
    check(config)
    players = {path: load(path, config.env_options) for path in dict.fromkeys((config.checkpoint, *config.others))}
    tasks = {path: (args.env_id, options_of(args)) for path, (_, _, args) in players.items()}
    env_id, options = tasks[config.checkpoint]
    for path, task in tasks.items():
        if task != (env_id, options):
            raise ValueError(f"{path} plays another task than {config.checkpoint}; agents on one page play the same")
    seed = max(first_after(args) for _, _, args in players.values()) if config.seed is None else config.seed
    episodes = []
    for level in range(seed, seed + config.levels):
        for path, (agent, envs, args) in players.items():
            episode = play(agent, envs, level, config.max_steps, config.deterministic, stacked=args.frame_stack > 0)
            facts = {"agent": "/".join(Path(path).absolute().parts[-2:]), **outcome(episode, env_id)}
            facts |= {"memory": memory_of(args), "seed": level}
            facts["actions"] = "most probable" if config.deterministic else "sampled"
            episodes.append(episode_data(episode, env_id, facts))
    data = {"title": env_id, "options": options, "agents": len(players), "episodes": episodes}
    out = Path(config.out)
    out.write_text(page(data, get_plotlyjs()), encoding="utf-8")
    played = "; ".join("{steps} steps, return {return}".format(**episode["facts"]) for episode in episodes)
    return f"{out}: {played}, {out.stat().st_size / 1e6:.1f} MB"


def check(config: Config) -> None:
    """Raise ValueError or OSError for a flag that is out of range, or a page that cannot be written."""
    check_bounds(config)
    if config.seed is not None and not 0 <= config.seed <= 2**63 - config.levels:
        raise ValueError(f"--seed is {config.seed}; levels must be from 0 to 2 ** 63 - 1")
    if not Path(config.out).parent.is_dir() or Path(config.out).is_dir():
        raise OSError(f"--out is {config.out}; it must be a file in a folder that is there")


def options_of(args: Any) -> dict[str, Any]:
    """Return the environment's options that are not its defaults."""
    return json.loads(args.env_options) | json.loads(args.env_kwargs)


def memory_of(args: Any) -> str:
    """Name the agent's memory, its size, and what else it computes with or observes."""
    if hasattr(args, "memory"):
        parts = [{"gru": "GRU", "lstm": "LSTM", "none": "no memory"}[args.memory]]
        parts += [f"{args.num_layers} x {args.hidden_size} units"] * (args.memory != "none")
    elif hasattr(args, "trxl_gate"):
        parts = ["GTrXL" if args.trxl_gate == "gru" else "TrXL"]
        counts = {"block": args.trxl_num_layers, "head": args.trxl_num_heads}
        parts += [f"{count} {name}{'s' * (count > 1)}" for name, count in counts.items()]
        parts += [f"width {args.trxl_dim}", f"window {args.trxl_memory_length}"]
        encoding = args.trxl_positional_encoding.replace("none", "no")
        parts += [f"{encoding} positional encoding", f"{args.trxl_layer_norm}-norm"]
    else:
        parts = [args.exp_name]
    flags = {"query_position": getattr(args, "trxl_query_position", False), **wrappers_of(args)}
    for name, value in flags.items():
        if value:
            parts.append(name.replace("_", " ") + (f" {value}" if value is not True else ""))
    return ", ".join(parts)


def outcome(episode: Episode, env_id: str) -> dict[str, Any]:
    """Return what the page's head tells of the episode's end."""
    steps = len(episode.actions)
    facts = {"return": f"{sum(episode.rewards):.4g}", "steps": steps}
    shares = {"agent_health"} | ({"carried_out", "coins_collected"} if "Endless" not in env_id else set())
    for name, value in episode.final.items():
        if name not in ("reward", "length"):
            is_share = name in shares and is_memory_gym(env_id)
            facts[name.replace("_", " ")] = f"{value:.0%}".replace("%", " %") if is_share else f"{value:.4g}"
    return facts if episode.finished else facts | {"cut short": f"after {steps} steps"}


if __name__ == "__main__":
    open_streams()
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        print(main(tyro.cli(Config)))
