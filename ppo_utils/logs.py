"""What a run logs: to TensorBoard, to the progress bar, and with --track to Weights and Biases."""

import contextlib
import math
from collections import defaultdict
from dataclasses import asdict

import numpy as np
import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from ppo_utils.flags import RunArgs
from ppo_utils.run import Run


def open_logs(args: RunArgs, run: Run) -> None:
    """Open a TensorBoard file, which hides older entries beyond the run's step, and the progress bar."""
    run.writer = SummaryWriter(str(run.folder), purge_step=run.step + 1 if run.step else None)
    hyperparameters = {"script": run.script, **asdict(args)}
    rows = "\n".join(f"|{key}|{' '.join(str(value).split())}|" for key, value in hyperparameters.items())
    run.writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}", run.step)
    batch_size = args.num_envs * args.num_steps
    total = args.total_timesteps // batch_size * batch_size
    run.bar = tqdm(total=total, initial=run.step, unit=" steps", unit_scale=True)


def start_tracking(args: RunArgs, name: str) -> None:
    """Mirror the TensorBoard curves to Weights and Biases; its environment variables name the project and the team.

    Raises ValueError if that does not start, ImportError without the extra `track`.
    """
    try:
        import wandb
    except ImportError:
        raise ImportError('--track needs wandb: pip install -e ".[track]"') from None
    how = {"resume": "allow", "reinit": "finish_previous", "sync_tensorboard": True, "save_code": True}
    try:
        wandb.init(name=name, id=name, config=asdict(args), **how)
    except Exception as error:  # whatever wandb raises: no account, no such team, no network
        raise ValueError(f"--track: {error}; log in with `wandb login`, or leave --track out") from None


def mean_logs(step_logs: list[dict[str, Tensor]], values: Tensor, returns: Tensor) -> dict[str, float]:
    """Return the means of what an update logged of its minibatches; values and returns (T, N) are the rollout's.

    The minibatch at which --target-kl ended the update has no gradient norm. Raises FloatingPointError if a loss or a
    gradient was not finite: the weights are unusable then.
    """
    logged = {name: [logs[name] for logs in step_logs if name in logs] for name in step_logs[0]}
    losses = {name: torch.stack(each).mean().item() for name, each in logged.items()}
    if not (math.isfinite(losses["loss"]) and math.isfinite(losses["grad_norm"])):
        raise FloatingPointError("the loss or its gradient is not finite; try a lower --init-lr, or smaller rewards")
    # Before the first gradient step, ratios differ from 1 by rounding only, if the update recomputes what acted.
    losses["ratio_error"] = step_logs[0]["ratio_error"].item()
    losses["explained_variance"] = explained_variance(values, returns)
    gradient_steps = len(logged["grad_norm"])
    return {f"losses/{name}": value for name, value in losses.items()} | {"charts/gradient_steps": gradient_steps}


@torch.no_grad()
def policy_metrics(log_ratio: Tensor, clip_coef: float) -> dict[str, Tensor]:
    """Return what to log of a minibatch's log_ratio (B, A): how far the policy has moved from the rollout's."""
    deviation = log_ratio.exp() - 1
    joint = log_ratio.sum(-1)  # the branches are independent: log-ratios add up
    return {
        "old_approx_kl": -joint.mean(),
        "approx_kl": (joint.exp() - 1 - joint).mean(),  # http://joschu.net/blog/kl-approx.html
        "clipfrac": (deviation.abs() > clip_coef).float().mean(),
        "ratio_error": deviation.abs().max(),
    }


def explained_variance(values: Tensor, returns: Tensor) -> float:
    """Return the share of the returns' variance that the values explain; NaN if the returns do not vary."""
    variance = returns.var().item()
    return 1 - (returns - values).var().item() / variance if variance > 0 else math.nan


def combine_logs(parts: list[tuple[dict, dict]]) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Return the means of what the processes logged, of losses/ratio_error the maximum, and the episodes of all."""
    logs, episodes = zip(*parts, strict=True)
    values_of = {name: [each[name] for each in logs if name in each] for name in logs[0]}
    combined = {
        name: float(np.max(values) if name == "losses/ratio_error" else np.mean(values))
        for name, values in values_of.items()
    }
    joined = defaultdict(list)
    for each in episodes:
        for name, values in each.items():
            joined[name] += values
    return combined, joined


def write_logs(args: RunArgs, run: Run, logs: dict[str, float], episodes: dict[str, list[float]]) -> None:
    """Write an iteration's numbers to TensorBoard and the progress bar; the first process does."""
    run.seconds += logs["charts/seconds_iteration"]
    run.returns.extend(episodes.get("charts/episodic_return", []))
    run.lengths.extend(episodes.get("charts/episodic_length", []))
    if run.writer is None:
        return
    ended = len(episodes.get("charts/episodic_return", []))
    for name, values in episodes.items():
        logs[name] = float(np.mean(values))
        if len(values) < ended:  # a metric that not all of them report
            logs[name.replace("episode/", "episode_count/", 1)] = len(values)
    logs["charts/SPS"] = run.step / run.seconds
    for name, value in logs.items():
        run.writer.add_scalar(name, value, run.step)
    last = {"return": run.returns, "length": run.lengths}
    shown = {name: f"{np.mean(values):.2f}" for name, values in last.items() if values}
    with contextlib.suppress(OSError):  # where the bar is shown may be gone, and the training goes on
        run.bar.set_postfix({**shown, "SPS": f"{logs['charts/SPS']:.0f}"}, refresh=False)
        run.bar.update(args.num_envs * args.num_steps)
