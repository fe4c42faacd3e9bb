"""What training runs have logged, read again: from run folders, and from the files that benchmarks/learning.py writes.

Shape letters: R runs, M levels, E episodes on each, I iterations of a run, P points of a curve.
"""

import glob
import gzip
import itertools
import json
import logging
import os
import shutil
import tempfile
import zlib
from dataclasses import asdict, dataclass, replace

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.util.tensor_util import make_ndarray

from ppo_utils.checkpoints import FORMER_DEFAULTS, RENAMED, import_script
from ppo_utils.scores import bare_id, own_metric

POINTS = 200  # of a curve; one that has more is averaged over neighbours
# Scalars of every iteration, in seconds: the first is the sum of the others. Evaluations are in none of them.
SECONDS = {name: f"charts/seconds_{name}" for name in ("iteration", "collect", "update")}


class NoCurvesError(ValueError):
    """A run that was stopped in its first iteration, or no run at all."""


@dataclass
class RunLog:
    """What a training run logged. A curve is steps (P,) and values (P, M, E), by the name of its TensorBoard scalar.

    Of evaluations it has every episode. Runs of earlier versions kept the levels' means (E = 1); of losses and training
    episodes there is one number a step (M = E = 1).
    """

    path: str
    args: dict[str, str]  # the script's name and its arguments, as text
    curves: dict[str, tuple[np.ndarray, np.ndarray]]
    machine: str = "not recorded"  # what trained it, if such a file names it

    def seconds(self, name: str) -> np.ndarray:
        """Return the seconds (I,) of each iteration: a name in SECONDS."""
        return self.curves[SECONDS[name]][1][:, 0, 0]

    def hours(self, steps: np.ndarray) -> np.ndarray:
        """Return the hours (P,) that it had been training for at these steps (P,), interpolated within iterations."""
        ends = self.curves[SECONDS["iteration"]][0]
        return np.interp(steps, [0, *ends], [0, *np.cumsum(self.seconds("iteration")) / 3600])

    @property
    def last_step(self) -> int:
        """The last step that a curve has a point at."""
        return int(max(steps[-1] for steps, _ in self.curves.values()))

    def has_seconds(self) -> bool:
        """Return whether it has the seconds of its iterations, which runs of earlier versions do not have."""
        return set(SECONDS.values()) <= set(self.curves)


Runs = dict[str, list[RunLog]]  # the seeds of each agent, by its label


def read_run(path: str) -> RunLog:
    """Read a run folder's TensorBoard files, or such a file; raise NoCurvesError if it holds none."""
    if path.endswith(".json.gz"):
        try:
            with gzip.open(path, "rt") as file:
                saved = json.load(file)
            curves = {name: (np.cumsum(steps), np.array(values)) for name, (steps, values) in saved["curves"].items()}
            machine = saved.get("machine", RunLog.machine)
            return with_carried_out(RunLog(path, with_defaults(saved["args"]), curves, machine))
        except (KeyError, TypeError, AttributeError, ValueError, EOFError, zlib.error, gzip.BadGzipFile):
            raise NoCurvesError(f"{path} holds no curves of a training run") from None
    if not os.path.isdir(path):
        raise NoCurvesError(f"there is no run folder {path}")
    logging.getLogger("tensorboard").setLevel(logging.ERROR)  # it warns of a crash where a run was resumed
    events = read_events(path)
    tags = events.Tags()
    if not tags["scalars"] or "hyperparameters/text_summary" not in tags["tensors"]:
        if glob.glob(f"{path}/*.json.gz"):
            raise NoCurvesError(f"{path} is a folder of results; give the files themselves, as {path}/*.json.gz")
        raise NoCurvesError(f"{path} holds no curves of a training run")
    return with_carried_out(RunLog(path, hyperparameters(events), event_curves(events)))


def with_carried_out(run: RunLog) -> RunLog:
    """Return a run of Mortar Mayhem with the commands carried out, which earlier versions did not log.

    In the endless task, they had the same number under another name. In the others, the return tells the share: it is
    0.1 for each command unless reset options say otherwise.
    """
    if bare_id(run.args.get("env_id", "")).startswith("Endless-MortarMayhem"):
        curves = {name.replace("commands_completed", "carried_out"): each for name, each in run.curves.items()}
        return replace(run, curves=curves)
    options = json.loads(run.args.get("env_options", "{}"))
    counts = options.get("command_count", [10])
    is_told = len(counts) == 1 and not any(name.startswith("reward_") for name in options)
    if is_told and own_metric(run.args.get("env_id", "")) == "carried_out":
        names = {f"{levels}/return": f"{levels}/carried_out" for levels in ("eval", "test")}
        for of_return, name in (names | {"charts/episodic_return": "episode/carried_out"}).items():
            if of_return in run.curves and name not in run.curves:
                steps, returns = run.curves[of_return]
                run.curves[name] = steps, returns / (0.1 * counts[0])
    return run


def read_events(folder: str) -> EventAccumulator:
    """Read a run folder's TensorBoard files in the order of the steps that they begin at.

    That of their names is by the clocks of the machines that wrote them, one of which may have been behind.
    """
    with tempfile.TemporaryDirectory() as ordered:
        for number, path in enumerate(sorted(glob.glob(f"{glob.escape(folder)}/*tfevents*"), key=beginning)):
            shutil.copyfile(path, f"{ordered}/events.out.tfevents.{number:010}")
        events = EventAccumulator(ordered, size_guidance={"scalars": 0, "tensors": 0})
        events.Reload()
        return events


def beginning(path: str) -> tuple[int, float]:
    """Return the step that a TensorBoard file begins at, and the time of its first entry."""
    first = list(itertools.islice(EventFileLoader(path).Load(), 2))  # the version, then the step that was resumed at
    return max((event.step for event in first), default=0), min((event.wall_time for event in first), default=0.0)


def event_curves(events: EventAccumulator) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the curves in a run's TensorBoard files. There is no point where a scalar is not a finite number.

    Of steps that a resumed run played twice, the last count, and those that it has not played again do not.
    """
    points = {}  # by name, values (M, E) by step
    for name in events.Tags()["scalars"]:
        found = {point.step: np.full((1, 1), point.value) for point in events.Scalars(name)}
        points[name] = {step: value for step, value in found.items() if np.isfinite(value)}
    for name in events.Tags()["tensors"]:
        if name.startswith("eval_levels/"):
            means = name.replace("eval_levels/", "eval/")
            found = {point.step: make_ndarray(point.tensor_proto) for point in events.Tensors(name)}
            # The reader forgets what lies beyond the step of --resume, but of scalars only.
            points[means] = {
                step: scores.reshape(len(scores), -1) for step, scores in found.items() if step in points.get(means, ())
            }
    return {name: (np.array([*each]), stack_scores([*each.values()])) for name, each in points.items() if each}


def stack_scores(scores: list[np.ndarray]) -> np.ndarray:
    """Stack scores, (..., M, E) each; where only some have every episode, the levels' means (..., M, 1) of all.

    Where they have different levels too, which do not compare, the means over these, (..., 1, 1).
    """
    for axis in (-1, -2):
        if len({each.shape for each in scores}) > 1:
            scores = [each.mean(axis, keepdims=True) for each in scores]
    return np.stack(scores)


def hyperparameters(events: EventAccumulator) -> dict[str, str]:
    """Return a run's arguments as text, from the Markdown table in its TensorBoard file.

    A resumed run has written them more than once; the last ones count.
    """
    rows = events.Tensors("hyperparameters/text_summary")[-1].tensor_proto.string_val[0].decode().splitlines()[2:]
    return with_defaults(dict(row[1:-1].split("|", 1) for row in rows))


def with_defaults(given: dict[str, str]) -> dict[str, str]:
    """Return a run's arguments as today's version has them.

    An argument that is newer than the run has the value that it stood for then, or its default; one that no longer
    exists is left out.
    """
    name = given.get("script", "ppo_trxl" if "trxl_dim" in given else "ppo_gru")  # an older run does not say it
    try:
        defaults = asdict(import_script({"script": name}, name).Args())
    except ValueError:  # the script is not here
        defaults = given
    given = FORMER_DEFAULTS | {RENAMED.get(key, key): value for key, value in given.items()}
    return {"script": name} | {key: str(given.get(key, value)) for key, value in defaults.items()}


def align(runs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Bring curves, x (P,) and values (P, M, E) of each run, to a common x (P,): return it and scores (P, R, M, E).

    x is steps or hours. The common x is that of all runs, as far as every run reaches, at most POINTS. Between its own,
    a run has its last evaluation's scores: a mixture of two would have another IQM than either. Numbers that are means
    already (M = E = 1) are interpolated, and averaged over neighbours. Raises ValueError if the runs do not overlap.
    """
    first, last = max(x[0] for x, _ in runs), min(x[-1] for x, _ in runs)
    if first > last:
        raise ValueError("the curves of an agent's seeds do not overlap; leave out the shortest run")
    common = np.unique(np.concatenate([x for x, _ in runs]))
    common = common[(first <= common) & (common <= last)]
    parts = np.array_split(np.arange(len(common)), min(len(common), POINTS))
    if all(values[0].size == 1 for _, values in runs):
        curves = np.stack([np.interp(common, x, values[:, 0, 0]) for x, values in runs], axis=1)  # (all x, R)
        scores = np.stack([curves[part].mean(0) for part in parts])[..., None, None]
        return np.array([common[part].mean() for part in parts]), scores
    common = common[[part[-1] for part in parts]]  # (P,)
    latest = [values[np.searchsorted(x, common, side="right") - 1] for x, values in runs]  # of (P, M, E)
    return common, np.moveaxis(stack_scores(latest), 0, 1)
