"""What has each seed reached, beside random actions, a scripted player and the thesis? Pictures of docs/results.md.

    python benchmarks/seeds.py

docs/seeds.png has a panel for each task and a dot for each seed: the score of the final weights on new test levels. The
dots of seeds with which no settings were chosen are open. docs/endless.png has the curves of endless tasks on
development levels, with steps on a logarithmic axis up to the thesis', docs/commands.png after how many commands
episodes of Endless Mortar Mayhem end, which a table says, too.
"""

import sys
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
import tables
from ppo_utils.run_logs import Runs, align
from ppo_utils.terminal import one_line_exit
from suites import CHOOSING_SEEDS, COLORS, LONGER, SEEDS, TASKS

AGENTS = ("no memory", "16 frames", "GRU", "TrXL+, before", "TrXL+")
LONG_AGENTS = ("GRU", "GRU --num-envs 32 --num-steps 512", "TrXL+, before", "TrXL+")  # of the last picture
IN_WINDOW = 10  # commands of Endless Mortar Mayhem before a window of 256 steps no longer has the first clue


def draw_seeds(results: dict[str, Runs], out: Path) -> None:
    """Draw a panel for each task, a dot for each seed. Endless tasks have a logarithmic axis."""
    bounds, thesis = tables.read_bounds(), tables.read_thesis()
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    for axis, (env_id, agents) in zip(figure.subplots(2, 5).flat, results.items(), strict=True):
        task = TASKS[env_id]
        theirs = thesis.get(env_id, {})
        for column, (agent, runs) in enumerate(agents.items()):
            for chose, fill, shift in ((True, COLORS[agent], 0), (False, "none", 0.25)):
                members = [run for run in runs if (int(run.args["seed"]) in CHOOSING_SEEDS) == chose]
                scores = [float(tables.final_scores(task.score, [run]).mean()) for run in members]
                axis.plot([column + shift] * len(scores), scores, "o", color=COLORS[agent], mfc=fill, alpha=0.6)
            if level := theirs.get(agent.removesuffix("+")):
                marker, size, label = ("k^", 7, "thesis: more") if level.startswith("> ") else ("k_", 28, "thesis")
                axis.plot(column, float(level.removeprefix("> ")), marker, markersize=size, label=label)
        axis.axhline(bounds[env_id].random, color="gray", linestyle=":", label="random actions")
        axis.axhline(bounds[env_id].scripted, color="gray", linestyle="--", label="scripted player")
        if task.best_score is None:
            axis.set_yscale("log")
        axis.set_xticks(range(len(AGENTS)), [agent.replace(" ", "\n") for agent in AGENTS], fontsize=6)
        axis.set_xlim(-0.5, len(AGENTS) - 0.5)
        axis.set_title(f"{env_id.removesuffix('-v0')}, {task.total_timesteps / 1e6:g} M", fontsize=9)
        axis.set_ylabel(task.score, fontsize=8)
    for fill, which in (("k", "seed that settings were chosen with"), ("none", "other seed")):
        figure.axes[0].plot([], [], "ko", mfc=fill, label=which)
    handles = dict(zip(*reversed(figure.axes[0].get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    figure.savefig(out, dpi=110)


def with_longer(results: dict[str, Runs]) -> dict[str, Runs]:
    """Return the results with longer runs in place of shorter ones of the same agents."""
    found = dict(results)
    for env_id, steps in LONGER.items():
        (longer,) = learning.stored_results(tasks=(env_id,), steps=steps, agents=AGENTS).values()
        found[env_id] = results[env_id] | {agent: runs for agent, runs in longer.items() if runs}
    return found


def draw_endless(results: dict[str, Runs], out: Path) -> None:
    """Draw the mean curves of the endless tasks, and what the thesis has after how many steps."""
    thesis = tables.read_thesis()
    endless = [env_id for env_id in results if env_id in thesis and thesis[env_id]["GRU million steps"]]
    figure = Figure(figsize=(13, 3.4), layout="constrained")
    for axis, env_id in zip(figure.subplots(1, len(endless)), endless, strict=True):
        for agent, runs in results[env_id].items():
            if runs:
                steps, scores = align([run.curves[f"eval/{TASKS[env_id].score}"] for run in runs])
                axis.plot(steps, scores.mean((1, 2, 3)), color=COLORS[agent], label=agent)
        for theirs, agent in (("GRU", "GRU"), ("TrXL", "TrXL+")):
            where = 1e6 * float(thesis[env_id][f"{theirs} million steps"]), float(thesis[env_id][theirs])
            axis.plot(*where, "D", color=COLORS[agent], label=f"thesis, {theirs}")
        axis.set(xscale="log", yscale="log", xlabel="steps", ylabel=TASKS[env_id].score)
        axis.set_title(env_id, fontsize=10)
        axis.grid(alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.savefig(out, dpi=110)


def draw_commands(out: Path) -> None:
    """Draw the share of episodes of Endless Mortar Mayhem in which each seed carries out so many commands, or more.

    Print a table of after how many they end, in percent, all seeds of an agent together.
    """
    task = "Endless-MortarMayhem-v0"
    (agents,) = learning.stored_results(tasks=(task,), steps=LONGER[task], agents=LONG_AGENTS).values()
    figure = Figure(figsize=(7, 3), layout="constrained")
    axis = figure.subplots()
    ends = range(4, IN_WINDOW + 1)
    print(f"| % of episodes that end after | {' | '.join(map(str, ends))} | more |\n|---|{(len(ends) + 1) * '---:|'}")
    for agent, runs in agents.items():
        style = {"color": COLORS.get(agent, COLORS["GRU"]), "linestyle": "-" if agent in COLORS else "--"}
        for seed, run in enumerate(runs):
            scores = tables.final_scores("carried_out", [run])  # (1, M, E)
            commands = np.arange(scores.max() + 2)
            shares = (scores.reshape(-1, 1) >= commands).mean(0)
            axis.step(commands, shares, where="mid", label=agent if seed == 0 else None, **style)
        every = tables.final_scores("carried_out", runs)
        cells = [(every == end).mean() for end in ends] + [(every > IN_WINDOW).mean()]
        print(f"| {agent} | {' | '.join(f'{100 * share:.0f}' for share in cells)} |")
    axis.axvline(IN_WINDOW + 0.5, color="gray", linestyle=":", label="window of TrXL+")
    axis.set(xlabel="commands carried out", ylabel="share of episodes", xlim=(1, 20), xticks=(1, 5, 10, 15, 20), ylim=0)
    axis.legend(frameon=False)
    figure.savefig(out, dpi=110)


def main(folder: Path = Path("docs")) -> None:
    """Draw the pictures to a folder, and print the table."""
    results = learning.stored_results(suite="full", agents=AGENTS, seeds=SEEDS)
    draw_seeds(results, folder / "seeds.png")
    draw_endless(with_longer(results), folder / "endless.png")
    draw_commands(folder / "commands.png")


if __name__ == "__main__":
    with one_line_exit(OSError):
        tyro.cli(main)
