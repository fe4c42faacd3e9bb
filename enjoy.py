"""Play one episode of a trained agent and write a page to watch it think.

    python enjoy.py runs/RUN/model.pt --out page.html

The page is one file that needs no network: what the agent saw beside the ground truth (and beside what it painted from
memory, where it was trained to), the probabilities of its actions, its state values and its policy's entropy, the
rewards, and what every block of a Transformer-XL looked at (thesis 6.5). Needs plotly and pillow, the extra `eval`.

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

import ppo_gru
import ppo_trxl

try:
    from PIL import Image
    from plotly.offline import get_plotlyjs
except ImportError:  # main tells how to get them
    Image = get_plotlyjs = None

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
    final: dict[str, float] = field(default_factory=dict)  # numbers of the final info

    def film(self, name: str, frame: np.ndarray) -> None:
        """Add a frame to a video. What a network draws is noise in its last bits: that one need not be exact."""
        self.videos.setdefault(name, Video(lossless=name != RECONSTRUCTION)).add(frame)


# ---- PLAY ----
@torch.no_grad()
def play(agent: nn.Module, envs: gym.vector.VectorEnv, seed: int, options: dict | None, max_steps: int) -> Episode:
    """Play one episode, or max_steps of it, in the only lane of `envs`: fresh memory, stochastic policy.

    Raises ValueError for options that the environment does not have, or an episode that the memory cannot hold.
    """
    torch.manual_seed(seed)
    episode = Episode()
    obs, infos = envs.reset(seed=seed, options=options)
    live = agent.memory.initial(max_steps, 1, torch.device("cpu"))
    while not episode.finished and len(episode.actions) < max_steps:
        for name, frame in views(envs, obs).items():
            episode.film(name, frame)
        if "ground_truth" in infos:
            episode.truth.append(infos["ground_truth"][0])
        actions, live = think(agent, ppo_gru.as_tensors(obs), live, episode)
        chosen = ppo_gru.to_env_actions(actions, envs.single_action_space)
        obs, rewards, terminated, truncated, infos = envs.step(chosen)
        episode.rewards.append(float(rewards[0]))
        episode.finished = bool(terminated[0] or truncated[0])
    if episode.finished:
        episode.final = {name: values.item() for name, _, values in ppo_gru.final_numbers(infos, np.ones(1, bool))}
    return episode


def think(agent: nn.Module, obs: dict[str, Tensor], live: Any, episode: Episode) -> tuple[Tensor, Any]:
    """Choose actions (1, A) and add what went on in the agent's head; return also its new memory."""
    x = agent.encoder(ppo_gru.on_device(obs, torch.device("cpu")))
    if hasattr(agent.memory, "attention"):
        episode.attention.append(agent.memory.attention(x, live)[0].numpy())
    y, live, _ = agent.memory.step(x, live)
    policy, values, features = agent.heads(y)
    actions = ppo_gru.draw(policy)
    episode.policy.append([branch.probs[0].numpy() for branch in policy])
    episode.actions.append(actions[0].tolist())
    episode.values.append(values.item())
    episode.entropies.append(sum(branch.entropy().item() for branch in policy))
    if agent.decoder is not None:
        episode.film(RECONSTRUCTION, displayable(agent.decoder(features).sigmoid()[0].numpy()))
    if agent.estimator is not None:
        episode.estimate.append(agent.estimator(features)[0].numpy())
    return actions, live


def views(envs: gym.vector.VectorEnv, obs: np.ndarray | dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return frames by name: what the agent sees (drawn for it, if it gets vectors only) and the ground truth."""
    parts = obs if isinstance(obs, dict) else {"observation": obs}
    pictures = {name: displayable(part[0]) for name, part in parts.items() if part.ndim == 4}
    frames = {VIEW if len(pictures) == 1 else name: picture for name, picture in pictures.items()}
    if not frames:
        frames["rendered frame"] = rendered(envs, "rgb_array")
    if ppo_gru.is_memory_gym(envs.spec.id):
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


def displayable(pixels: np.ndarray) -> np.ndarray:
    """Turn pixels (H, W, C), uint8 or floats in [0, 1], into a frame: a stack of pictures becomes a square of them."""
    if pixels.dtype != np.uint8:
        pixels = (pixels.clip(0, 1) * 255).round().astype(np.uint8)
    height, width, channels = pixels.shape
    if channels == 3:
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
    if ppo_gru.is_memory_gym(env_id):
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
    """Fill the template with the data and the source of the plotting library."""
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # no name in it may end the script
    return TEMPLATE.replace("{{title}}", data["title"]).replace("{{data}}", text).replace("{{plotly}}", plotly)


TEMPLATE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{{title}}</title>
<style>
  :root { --ink: #23282f; --soft: #6a7280; --rule: #e4e6ea; --accent: #c8553d; --line: #2d5d8c; }
  * { box-sizing: border-box; }
  body { margin: 0; padding: 18px 22px 100px; font: 14px/1.45 system-ui, sans-serif; color: var(--ink);
    background: #f7f7f5; }
  header { display: flex; flex-wrap: wrap; align-items: baseline; gap: 2px 22px; margin-bottom: 14px; }
  h1 { margin: 0; font-size: 19px; font-weight: 600; }
  header span, figcaption, footer, th { color: var(--soft); }
  header b, td { color: var(--ink); font-weight: 500; font-variant-numeric: tabular-nums; }
  main { display: grid; grid-template-columns: minmax(0, 500px) minmax(0, 1fr); gap: 14px; align-items: start; }
  section { background: #fff; border: 1px solid var(--rule); border-radius: 8px; padding: 12px; }
  h2 { margin: 0 0 6px; font-size: 13px; font-weight: 600; }
  #left { display: grid; grid-template-columns: 1fr 1fr; gap: 12px; }
  #left.even #chances, #truth { grid-column: span 2; }
  figure { margin: 0; }
  canvas { display: block; width: 100%; image-rendering: pixelated; border-radius: 4px; background: #eee; }
  figcaption { padding-top: 4px; }
  .elsewhere canvas { outline: 3px solid var(--accent); }
  table { border-collapse: collapse; font-size: 13px; }
  th { font-weight: 400; text-align: left; padding-right: 12px; }
  td { padding: 0 10px 0 0; text-align: right; }
  footer { position: fixed; inset: auto 0 0 0; display: flex; flex-wrap: wrap; align-items: center; gap: 4px 14px;
    padding: 9px 22px; background: #fff; border-top: 1px solid var(--rule); }
  footer input[type=range] { flex: 1 1 200px; accent-color: var(--line); }
  button, select { font: inherit; color: var(--ink); background: #fff; border: 1px solid #cfd3d9; border-radius: 6px;
    padding: 3px 10px; }
  button { min-width: 34px; cursor: pointer; } button:hover { background: #f0f2f5; }
  output { min-width: 104px; color: var(--ink); font-variant-numeric: tabular-nums; }
  kbd { font: 12px ui-monospace, monospace; border: 1px solid #cfd3d9; border-radius: 4px; padding: 0 4px; }
  #plots { position: relative; }
  label { position: absolute; z-index: 1; right: 20px; top: 11px; color: var(--soft); }
  @media (max-width: 900px) { main { grid-template-columns: minmax(0, 1fr); } footer small { display: none; } }
</style>
<header><h1>{{title}}</h1></header>
<main>
  <section id="left">
    <div id="chances"><h2>Action probabilities</h2><div id="bars"></div></div>
    <div id="truth"><h2>Ground truth</h2><table></table></div>
  </section>
  <section id="plots">
    <label id="top-only"><input type="checkbox"> only the top 16 scores (red)</label><div id="curves"></div>
  </section>
</main>
<footer>
  <button id="back" title="one step back">&#9664;</button><button id="play" title="play or pause">Play</button>
  <button id="forth" title="one step forth">&#9654;</button>
  <input id="slider" type="range" min="0" value="0" aria-label="step"><output></output>
  <select aria-label="speed"></select>
  <small><kbd>space</kbd> plays, <kbd>&larr;</kbd> <kbd>&rarr;</kbd> step, with <kbd>shift</kbd> ten;
    click a curve or a score to go to its step</small>
</footer>
<script>{{plotly}}</script>
<script type="application/json" id="data">{{data}}</script>
<script>
"use strict";
const page = JSON.parse(document.getElementById("data").textContent);
const find = selector => document.querySelector(selector);
const INK = "#23282f", SOFT = "#6a7280", LINE = "#2d5d8c", ACCENT = "#c8553d", PALE = "#b9cbdc";
const FONT = {family: "system-ui, sans-serif", size: 12, color: SOFT};
const CALM = {displayModeBar: false, responsive: true, doubleClick: "reset"};
const AXIS = {zeroline: false, gridcolor: "#eef0f2", linecolor: "#cfd3d9", fixedrange: true, nticks: 4};
const nth = (axis, i) => axis + (i ? i + 1 : "");  // what Plotly calls the i-th axis, from 0
let now = 0, shown = 0, pointing = false, timer = null;

// Header.
for (const [name, value] of Object.entries(page.facts)) {
  const fact = document.createElement("span"), strong = document.createElement("b");
  strong.textContent = value;
  fact.append(name + " ", strong);
  find("header").append(fact);
}

// Videos: a frame is cut out of its sheet.
const videos = page.videos.map(video => {
  const figure = document.createElement("figure"), canvas = document.createElement("canvas");
  const caption = document.createElement("figcaption");
  canvas.width = video.width; canvas.height = video.height; caption.textContent = video.name;
  figure.append(canvas, caption);
  find("#chances").before(figure);
  const draw = () => {
    const sheet = sheets[Math.floor(shown / video.per_sheet)];
    if (sheet.complete) canvas.getContext("2d").drawImage(sheet, 0, -(shown % video.per_sheet) * video.height);
  };
  const sheets = video.sheets.map(source => Object.assign(new Image(), {onload: draw, src: source}));
  return draw;
});
find("#left").classList.toggle("even", videos.length % 2 === 0);
function show(step) {
  shown = step;
  videos.forEach(draw => draw());
  find("#left").classList.toggle("elsewhere", shown !== now);
  find("output").textContent = shown === now ? `step ${now} of ${page.steps - 1}` : `step ${now}, at ${shown}`;
}

// Bars: one group a branch, the chosen action in another colour.
const bars = page.branches.map((branch, i) => ({type: "bar", x: branch.actions.map(name => name.replace(" ", "<br>")),
  y: branch.probabilities[0], xaxis: nth("x", i), cliponaxis: false, textposition: "outside", hoverinfo: "skip"}));
const barsLayout = {height: 196, margin: {l: 34, r: 4, t: 20, b: 44}, font: FONT, showlegend: false,
  yaxis: {...AXIS, range: [0, 1]}};
page.branches.forEach((branch, i, {length}) => barsLayout[nth("xaxis", i)] = {type: "category", fixedrange: true,
  tickangle: 0, domain: [(i + (i && 0.06)) / length, (i + 1) / length], title: {text: length > 1 ? branch.name : ""}});
Plotly.newPlot("bars", bars, barsLayout, CALM);
function drawBars() {
  const chances = page.branches.map(branch => branch.probabilities[now]);
  Plotly.restyle("bars", {y: chances, text: chances.map(each => each.map(chance => chance.toFixed(2))),
    "marker.color": page.actions[now].map((chosen, i) => chances[i].map((_, j) => j === chosen ? ACCENT : PALE))});
}

// Curves, and below them each block's attention: rows that share the steps.
const steps = Array.from({length: page.steps}, (_, step) => step);
const look = page.attention;
const scores = look && new Uint16Array(Uint8Array.from(atob(look.scores), letter => letter.charCodeAt(0)).buffer);
const rows = Object.keys(page.lines).concat(Array.from({length: look ? look.blocks : 0}, (_, k) => `block ${k + 1}`));
const hover = "step %{x}: %{y:.4g}<extra></extra>";
const curves = Object.entries(page.lines).map(([name, y], row) => ({x: steps, y, yaxis: nth("y", row), mode: "lines",
  line: {color: LINE, width: 1.5, shape: name === "reward" ? "hvh" : "linear"}, hovertemplate: hover}));
const firstBlock = curves.length;
for (let k = 0; look && k < look.blocks; k++) {
  const yaxis = nth("y", firstBlock + k);
  curves.push({x: [], y: [], yaxis, mode: "lines", fill: "tozeroy", fillcolor: "#dbe5ee", hovertemplate: hover,
    line: {color: PALE, width: 1, shape: "hvh"}});
  curves.push({x: [], y: [], yaxis, mode: "markers", marker: {color: ACCENT, size: 5}, hovertemplate: hover,
    error_y: {type: "data", symmetric: false, array: [], arrayminus: [], width: 0, thickness: 1.5, color: ACCENT}});
}
const unit = 1 / (rows.length - 0.24);  // a row and the room above it for its name; the first name is in the margin
const layout = {height: 62 + Math.max(112 * rows.length, 690), margin: {l: 58, r: 10, t: 22, b: 40}, font: FONT,
  showlegend: false, hovermode: "x", hoverdistance: -1, bargap: 0, annotations: [],
  xaxis: {...AXIS, fixedrange: false, range: [-0.5, page.steps - 0.5], nticks: 12, title: {text: "step", standoff: 6},
    anchor: nth("y", rows.length - 1)},
  shapes: [{type: "line", x0: 0, x1: 0, yref: "paper", y0: 0, y1: 1, line: {color: ACCENT, width: 1}}]};
rows.forEach((name, row) => {
  const top = 1 - row * unit, rangemode = row < firstBlock ? "normal" : "tozero";
  layout[nth("yaxis", row)] = {...AXIS, domain: [Math.max(top - 0.76 * unit, 0), top], rangemode};
  const text = row < firstBlock ? name : `attention of ${name}, sum over ${look.heads} heads`;
  layout.annotations.push({text, xref: "paper", yref: "paper", x: 0, y: top, xanchor: "left", yanchor: "bottom",
    showarrow: false, font: {color: INK, size: 13}});
});
Plotly.newPlot("curves", curves, layout, CALM);
find("#curves").on("plotly_click", event => go(event.points[0].x));
// Pointing at a score shows what was looked at. Plotly tells of it after every redrawing, too: that does not count.
find("#curves").addEventListener("mousemove", () => pointing = true, true);
find("#curves").on("plotly_hover", ({points: [{curveNumber, x}]}) => pointing && curveNumber >= firstBlock && show(x));
find("#curves").on("plotly_unhover", () => show(now));

// The scores of a block at the current step: the steps looked at, oldest first.
function attention(k) {
  const found = {x: [], y: []};
  for (let step = Math.max(0, now - look.items); step < now; step++) {
    found.x.push(step);
    found.y.push(scores[(now * look.blocks + k) * look.items + look.items - now + step] / 65535 * look.heads);
  }
  return found;
}
function drawCurves() {
  const update = {x: [], y: [], "error_y.arrayminus": [], "error_y.array": []}, only = find("#top-only input").checked;
  for (let k = 0; look && k < look.blocks; k++) {
    const all = attention(k), best = all.y.map((_, i) => i).sort((i, j) => all.y[j] - all.y[i]).slice(0, 16);
    const x = best.map(i => all.x[i]), y = best.map(i => all.y[i]);
    update.x.push(only ? [] : all.x, x); update.y.push(only ? [] : all.y, y);
    update["error_y.arrayminus"].push([], y); update["error_y.array"].push([], y.map(() => 0));
  }
  const cursor = {"shapes[0].x0": now, "shapes[0].x1": now};
  if (look) Plotly.update("curves", update, cursor, update.x.map((_, i) => firstBlock + i));
  else Plotly.relayout("curves", cursor);
}

// The ground truth's numbers, and what the agent took them for.
function drawTruth() {
  const table = find("#truth table");
  table.replaceChildren();
  for (const [name, numbers] of [["true", page.truth], ["estimate", page.estimate]]) {
    if (!numbers.length) continue;
    const row = table.insertRow(), head = document.createElement("th");
    head.textContent = name;
    row.append(head);
    numbers[now].forEach(number => row.insertCell().textContent = number.toFixed(3));
  }
}

// The player.
function go(step) {
  now = Math.min(Math.max(step, 0), page.steps - 1);
  pointing = false;
  show(now); drawBars(); drawCurves(); drawTruth();
  find("#slider").value = now;
}
function pause() { clearInterval(timer); timer = null; find("#play").textContent = "Play"; }
function play() {
  if (now === page.steps - 1) go(0);
  find("#play").textContent = "Pause";
  timer = setInterval(() => now < page.steps - 1 ? go(now + 1) : pause(), 1000 / find("select").value);
}
const toggle = () => timer ? pause() : play();
for (const speed of [2, 5, 10, 25]) find("select").add(new Option(`${speed} steps/s`, speed));
find("select").selectedIndex = 1;
find("select").onchange = event => { event.target.blur(); if (timer) { pause(); play(); } };
find("#slider").max = page.steps - 1;
find("#slider").oninput = event => go(Number(event.target.value));
find("#play").onclick = toggle;
find("#back").onclick = () => { pause(); go(now - 1); };
find("#forth").onclick = () => { pause(); go(now + 1); };
find("#top-only").hidden = !look;
find("#top-only input").onchange = drawCurves;
find("#truth").hidden = !page.truth.length;
// A focused button is pressed by the space bar too, in some browsers whatever onkeydown says. An open list needs focus.
document.onclick = event => event.target.tagName === "SELECT" || document.activeElement.blur();
document.onkeydown = event => {
  if (event.altKey || event.ctrlKey || event.metaKey) return;
  const way = {ArrowLeft: -1, ArrowRight: 1}[event.key];
  if (way) { pause(); go(now + way * (event.shiftKey ? 10 : 1)); } else if (event.key === " ") toggle();
  else if (event.key === "Home") go(0); else if (event.key === "End") go(page.steps - 1); else return;
  event.preventDefault();
};
go(parseInt(location.hash.slice(1)) || 0);  // page.html#40 opens at step 40
</script>
</html>
"""


# ---- MAIN ----
def load(path: str) -> tuple[nn.Module, gym.vector.VectorEnv, Any]:
    """Return the agent in the file, one lane of its environment that draws pictures, and its training's arguments.

    Raises ValueError, OSError, ImportError or gymnasium.error.Error, each with one line for the user.
    """
    try:
        script, (args, _) = ppo_gru, ppo_gru.load_model(path)
    except ValueError:  # of the other script, or of none, which it says then
        script, (args, _) = ppo_trxl, ppo_trxl.load_model(path)
    args = replace(args, amp=False)  # one lane is no work, and not every processor has bfloat16
    envs = script.make_envs(args, 1, "debug_rgb_array")
    _, infos = envs.reset(options=script.reset_options(args.env_id, args.env_options))
    agent = script.make_agent(envs, infos, args, torch.device("cpu"))
    script.load_weights(agent, path)
    return agent, envs, args


def main(config: Config) -> str:
    """Play, write the page, and return one line that says how it went. Raises what `load` and `play` raise."""
    if get_plotlyjs is None:
        raise ImportError('enjoy.py needs plotly and pillow: pip install -e ".[eval]"')
    if not 1 <= config.max_steps <= 100_000:
        raise ValueError(f"--max-steps is {config.max_steps}; it must be from 1 to 100000")
    if config.seed is not None and config.seed < 0:
        raise ValueError(f"--seed is {config.seed}; it must be 0 or more")
    out = Path(config.out)
    if not out.parent.is_dir():
        raise OSError(f"--out is {out}, but there is no folder {out.parent}")
    agent, envs, args = load(config.checkpoint)
    seed = args.start_level + args.num_levels if config.seed is None else config.seed
    options = ppo_gru.reset_options(args.env_id, args.env_options)
    episode = play(agent, envs, seed, options, config.max_steps)
    facts = summary(episode, args, seed)
    out.write_text(page(page_data(episode, args.env_id, facts), get_plotlyjs()), encoding="utf-8")
    size = out.stat().st_size / 1e6
    return f"{out}: {facts['steps']} steps, return {facts['return']}, {size:.1f} MB"


def kind(args: Any) -> str:
    """Name the agent's memory."""
    if hasattr(args, "memory"):
        return {"gru": "GRU", "lstm": "LSTM", "none": "no memory"}[args.memory]
    return "GTrXL" if args.trxl_gate == "gru" else "TrXL"


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
