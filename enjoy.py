"""Play one episode of a trained agent and write a page to watch it think.

    python enjoy.py runs/RUN/model.pt --out page.html

The page is one file that needs no network: what the agent saw beside the ground truth (and beside what it painted from
memory, where it was trained to), the probabilities of its actions, its state values and its policy's entropy, the
rewards, and what every block of a Transformer-XL looked at (thesis 6.5). Needs the extra `eval`.

Shape letters: T steps of the episode, A action branches, K blocks, H heads, M items that the last step could look at.
"""

import base64
import io
import json
import math
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import Tensor, nn

from ppo_utils.checkpoints import import_script, load_weights, make_agent, read_model, saved_args
from ppo_utils.environments import as_tensors, envs_for, final_numbers, is_memory_gym
from ppo_utils.video import check_draws

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
class Config:
    """Play one episode of a trained agent and write a page to watch it think."""

    checkpoint: Annotated[str, tyro.conf.Positional]
    """a file that --save-model wrote"""
    seed: int | None = None
    """the level, and the seed of the actions (default: the first level after those of the training)"""
    out: str = "page.html"
    """the page to write"""
    max_steps: int = 1000
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
    attention: list[np.ndarray] = field(default_factory=list)  # T x (K, H, M or fewer), the oldest item first
    finished: bool = False  # not cut short
    stacked: bool = False  # its images are stacks of grayscale ones
    final: dict[str, float] = field(default_factory=dict)  # numbers of the final info

    def film(self, name: str, frame: np.ndarray) -> None:
        """Add a frame to a video. What a network draws is noise in its last bits: that one need not be exact."""
        self.videos.setdefault(name, Video(lossless=name != RECONSTRUCTION)).add(frame)


# ---- PLAY ----
@torch.no_grad()
def play(agent: nn.Module, envs: gym.vector.VectorEnv, seed: int, max_steps: int, stacked: bool = False) -> Episode:
    """Play one episode, or max_steps of it, in the only lane of `envs`: fresh memory, stochastic policy.

    stacked: whether the images that the agent gets are stacks of grayscale ones.

    """
    torch.manual_seed(seed)
    episode = Episode(stacked=stacked)
    obs, infos = envs.reset(seed=seed)
    memory = agent.memory.initial_state(1, max_steps, torch.device("cpu"))
    while not episode.finished and len(episode.actions) < max_steps:
        for name, frame in views(envs, obs, stacked).items():
            episode.film(name, frame)
        if "ground_truth" in infos:
            episode.truth.append(infos["ground_truth"][0])
        actions = act(agent, as_tensors(obs, torch.device("cpu")), memory, episode)
        obs, rewards, terminated, truncated, infos = envs.step(actions.numpy())
        episode.rewards.append(float(rewards[0]))
        episode.finished = bool(terminated[0] or truncated[0])
    if episode.finished:
        episode.final = {name: values.item() for name, values in final_numbers(infos, np.ones(1, bool)).items()}
    return episode


def act(agent: nn.Module, obs: dict[str, Tensor], memory: Any, episode: Episode) -> Tensor:
    """Return actions (1, A), as `Agent.get_action_and_value` does; add what was computed to the episode."""
    x = agent.encoder(obs)
    y, stored = agent.memory.step(memory, x)
    if hasattr(agent.memory, "attended_rows"):  # a transformer
        episode.attention.append(attention_of(agent.memory, memory, x)[0].numpy())
    agent.memory.advance(memory, stored)
    logits, values, features = agent.heads(y)
    policy = agent.heads.distributions(logits)
    actions = torch.stack([branch.sample() for branch in policy], -1)
    episode.policy.append([branch.probs[0].numpy() for branch in policy])
    episode.actions.append(actions[0].tolist())
    episode.values.append(values.item())
    episode.entropies.append(sum(branch.entropy().item() for branch in policy))
    if agent.decoder is not None:
        episode.film(RECONSTRUCTION, displayable(agent.decoder(features).sigmoid()[0].numpy(), episode.stacked))
    if agent.estimator is not None:
        episode.estimate.append(agent.estimator(features)[0].numpy())
    return actions


def attention_of(memory: nn.Module, state: Any, x: Tensor) -> Tensor:
    """Return what the next step, x (N, D), attends to: weights (N, K, H, M) of the last M steps, the oldest first.

    memory, state: a transformer's Memory and MemoryState, as in ppo_trxl.py.
    """
    rows, age, mask = memory.attended_rows(state)
    x, found = x[:, None], []  # (N, 1, D)
    query = memory.first_query(x, state.episode_step[:, None], state.hidden[state.now - 1, :, -1:])
    for k, block in enumerate(memory.blocks):
        keys_values = state.keys[k][:, rows], state.values[k][:, rows]
        found.append(attention_weights(block.attention, block.norm_query(query), keys_values[0], age, mask)[:, :, 0])
        x = query = block(x, query, keys_values, age, mask)
    return torch.stack(found, 1)


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
    frame = (envs.render() or [None])[0]
    if not isinstance(frame, np.ndarray):
        raise ValueError(f"{envs.spec.id} draws no pictures (render_mode {mode}); there would be nothing to watch")
    image = Image.fromarray(frame)
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
def page_data(episode: Episode, env_id: str, facts: dict[str, Any]) -> dict[str, Any]:
    """Return all that the page shows, as JSON can hold it; facts, by name, stand in its head."""
    lines = {"state value": episode.values, "entropy": episode.entropies, "reward": episode.rewards}
    branches = zip(branch_names(env_id, episode.policy[0]).items(), zip(*episode.policy, strict=True), strict=True)
    return {
        "title": env_id,
        "facts": facts,
        "steps": len(episode.actions),
        "videos": [video_data(name, video) for name, video in episode.videos.items()],
        "branches": [
            {"name": name, "actions": actions, "probabilities": rounded(probabilities)}
            for (name, actions), probabilities in branches
        ],
        "actions": episode.actions,
        "lines": {name: rounded(line) for name, line in lines.items()},
        "truth": rounded(episode.truth),
        "estimate": rounded(episode.estimate),
        "attention": packed(episode.attention),
    }


def video_data(name: str, video: Video) -> dict[str, Any]:
    """Return a video as JSON can hold it."""
    video.pack()
    height, width = video.shape[:2]
    return {"name": name, "height": height, "width": width, "per_sheet": SHEET, "sheets": video.sheets}


def branch_names(env_id: str, branches: list[np.ndarray]) -> dict[str, list[str]]:
    """Name the action branches and their actions: in words for Memory Gym, else by numbers."""
    sizes = [len(branch) for branch in branches]
    if is_memory_gym(env_id):
        return FREE if sizes == [3, 3] else ENDLESS_PATH if "Endless" in env_id else GRID
    return {f"branch {i + 1}": [str(action) for action in range(size)] for i, size in enumerate(sizes)}


def rounded(numbers: list) -> list:
    """Round to what a plot can show: digits cost bytes."""
    return np.round(np.array(numbers, np.float64), 5).tolist()


def packed(attention: list[np.ndarray]) -> dict[str, Any] | None:
    """Pack scores, summed over the heads, as T x K x M 16-bit numbers of which 65,535 is the sum of all heads.

    Column M - a is the step that was a steps ago; one that was not there has score 0.
    """
    if not attention:
        return None
    blocks, heads, _ = attention[0].shape
    items = max(each.shape[2] for each in attention)
    scores = np.zeros((len(attention), blocks, items))
    for step, each in enumerate(attention):
        scores[step, :, items - each.shape[2] :] = each.mean(1)
    integers = (scores * 65535).round().astype("<u2")
    return {"blocks": blocks, "heads": heads, "items": items, "scores": base64.b64encode(integers.tobytes()).decode()}


def page(data: dict[str, Any], plotly: str) -> str:
    """Fill enjoy.html with the data and the source of the plotting library."""
    template = Path(__file__).with_name("enjoy.html").read_text(encoding="utf-8")
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # no name in it may end the script
    return template.replace("{{title}}", data["title"]).replace("{{data}}", text).replace("{{plotly}}", plotly)


# ---- MAIN ----
def load(path: str) -> tuple[nn.Module, gym.vector.VectorEnv, Any]:
    """Return the agent in the file, one lane of its environment that draws pictures, and its training's arguments.

    Raises ValueError, OSError, ImportError or gymnasium.error.Error, each with one line for the user.
    """
    saved = read_model(path)
    script = import_script(saved, path)
    args = replace(saved_args(script.Args, saved), amp=False)  # one lane is little work; not all CPUs have bfloat16
    check_draws("enjoy.py", args.env_id)
    envs = envs_for(args, 1, render_mode="debug_rgb_array")
    _, infos = envs.reset()
    agent = make_agent(script.Agent, envs, infos, args)
    load_weights(agent, saved, path)
    return agent, envs, args


def main(config: Config) -> str:
    """Play, write the page, and return one line that says how it went. Raises what `load` and `play` raise."""
    if not 1 <= config.max_steps <= 100_000:
        raise ValueError(f"--max-steps is {config.max_steps}; it must be from 1 to 100000")
    if config.seed is not None and not 0 <= config.seed < 2**63:
        raise ValueError(f"--seed is {config.seed}; it must be from 0 to 2 ** 63 - 1")
    out = Path(config.out)
    if not out.parent.is_dir():
        raise OSError(f"--out is {out}, but there is no folder {out.parent}")
    agent, envs, args = load(config.checkpoint)
    seed = args.start_level + args.num_levels if config.seed is None else config.seed
    episode = play(agent, envs, seed, config.max_steps, stacked=args.frame_stack > 0)
    facts = summary(episode, args, seed)
    out.write_text(page(page_data(episode, args.env_id, facts), get_plotlyjs()), encoding="utf-8")
    size = out.stat().st_size / 1e6
    return f"{out}: {facts['steps']} steps, return {facts['return']}, {size:.1f} MB"


def kind(args: Any) -> str:
    """Name the agent's memory."""
    if hasattr(args, "memory"):
        return {"gru": "GRU", "lstm": "LSTM", "none": "no memory"}[args.memory]
    if hasattr(args, "trxl_gate"):
        return "GTrXL" if args.trxl_gate == "gru" else "TrXL"
    return args.exp_name


def summary(episode: Episode, args: Any, seed: int) -> dict[str, Any]:
    """Return what the page's head tells of the episode."""
    steps = len(episode.actions)
    facts = {"agent": kind(args), "seed": seed}
    facts |= {"steps": steps, "return": f"{sum(episode.rewards):.4g}"}
    facts |= {
        name.replace("_", " "): f"{value:.4g}"
        for name, value in episode.final.items()
        if name not in ("reward", "length")
    }
    return facts if episode.finished else facts | {"cut short": f"after {steps} steps"}


if __name__ == "__main__":
    try:
        print(main(tyro.cli(Config)))
    except (ValueError, OSError, ImportError, gym.error.Error) as error:
        sys.exit(f"enjoy.py: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit(130)
