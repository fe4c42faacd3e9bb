"""benchmarks/learning.py: its command lines, and which runs it need not train again."""

import fcntl
import gzip
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import programs
import pytest
import torch
from conftest import parse_args
from tqdm import tqdm

import claims
import evaluate
import learning
import ppo_gru
import tables
from ppo_utils.checkpoints import Checkpoint, read_checkpoint
from ppo_utils.run_logs import SECONDS, RunLog
from ppo_utils.runs import run_to_end
from ppo_utils.scores import iqm
from suites import short

ROOT = Path(__file__).parents[1]


# Flags of tasks and of agents do not depend on each other: each agent in a task, and two scripts in each task.
EACH = [(agent, "MortarMayhem-Grid-v0") for agent in learning.AGENTS]
EACH += [(agent, task) for agent in ("GRU", "TrXL+") for task in learning.TASKS if task != "MortarMayhem-Grid-v0"]


@pytest.mark.parametrize(("agent", "task"), EACH)
def test_every_agent_s_command_can_be_parsed(task, agent):
    args = learning.plan(learning.Config(steps=6_000_000), learning.TASKS[task], agent, 2).args
    assert args.total_timesteps == args.anneal_steps == 6_000_000
    # The thesis' queries do not know their step.
    plus = "TrXL+" in agent
    assert getattr(args, "trxl_query_position", False) == getattr(args, "trxl_memory_gradient", False) == plus
    gate = {"TrXL": "none", "TrXL+": "none", "GTrXL+": "gru"}.get(agent.split(",")[0])
    assert getattr(args, "trxl_gate", None) == gate
    low_rate = "low rate" in agent or (agent == "GRU" and task in ("MysteryPath-v0", "MysteryPath-Grid-v0"))
    of_preset = agent in ("TrXL", "TrXL+", "GTrXL+")
    assert (args.init_lr == 3e-4) == (args.gamma == 0.995) == (low_rate or of_preset)
    assert (args.clip_coef == 0.1) == low_rate


def test_an_agent_may_have_further_flags(tmp_path):
    task = learning.TASKS["MysteryPath-Grid-v0"]
    agent = "GRU --hidden-size 64 --init-lr 1e-2"
    args = learning.plan(learning.Config(), task, agent, 1).args
    assert (args.clip_coef, args.hidden_size, args.init_lr) == (0.1, 64, 0.01)  # the task's own flags come first
    assert args.exp_name == "GRU-hidden-size-64-init-lr-1e-2"
    with pytest.raises(SystemExit, match=r"there is no 'TrXXL'; there are no memory; 4 frames; .*GRU"):
        learning.main(learning.Config(agents=("GRU", "TrXXL --trxl-num-layers 3"), folder=tmp_path, report=True))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"seeds": ()}, "--seeds is empty; give at least one, and each once"),
        ({"seeds": (1, 2, 1)}, "--seeds is 1 2 1; give at least one, and each once"),
        ({"jobs": 0}, "--jobs is 0; it must be 1 or more"),
        ({"evaluations": 0}, "--evaluations is 0; it must be 1 or more"),
        ({"steps": 0}, "--steps is 0; it must be 1 or more"),
        ({"steps": 2**63}, r"--steps is 9223372036854775808; it must be below 2 \*\* 63"),
    ],
)
def test_numbers_that_no_training_can_have(wrong, message):
    for program in (learning, claims):
        with pytest.raises(SystemExit, match=message):
            program.main(program.Config(report=True, **wrong))


@pytest.mark.parametrize(
    "flags",
    [
        "--seed 3",
        "--exp-name mine",
        "--env-id MysteryPath-v0",
        "--env-options {}",
        "--total-timesteps 50000",
        "--eval-interval 3",
    ],
)
def test_an_agent_has_no_task_of_its_own(flags):
    with pytest.raises(SystemExit, match=f"GRU {flags}: an agent has no task, steps, name, seed or evaluations of its"):
        learning.plan(learning.Config(), learning.TASKS["mortar-mayhem"], f"GRU {flags}", 1)


@pytest.mark.parametrize(
    ("agent", "seed", "message"),
    [
        ("GRU --no-save-model", 1, "GRU --no-save-model: --no-save-model leaves no weights to score"),
        ("GRU --start-level 950000", 1, "levels below 1,000,000 are for .*; it has 100,000 from 950,000 on, and 50 "),
        ("GRU --num-levels 1000000", 1, "levels below 1,000,000 are for .*; it has 1,000,000 from 0 on, and 50 "),
        ("GRU --num-envs 0", 1, "GRU --num-envs 0: --num-envs is 0; it must be 1 or more"),
        ("GRU", -1, "GRU: --seed is -1; it must be 0 or more"),
        ("GRU --num-minibatches 99999", 1, "GRU --num-minibatches 99999: .* an iteration may have only 128 sequences"),
    ],
)
def test_what_a_script_refuses_is_told_before_anything_is_trained(agent, seed, message):
    with pytest.raises(SystemExit, match=message):
        learning.plan(learning.Config(), learning.TASKS["mortar-mayhem"], agent, seed)


def test_leftovers_among_the_results_are_no_runs(tmp_path):
    plan = learning.plan(learning.Config(), learning.TASKS["mortar-mayhem"], "GRU", 1)
    for ending in ("json.gz.part", "txt"):
        (tmp_path / f"{plan.task.env_id}__GRU__1__7.{ending}").touch()
    assert learning.result_of(learning.Config(results=tmp_path), plan) is None


def test_agents_to_draw_and_names_are_checked():
    with pytest.raises(SystemExit, match="there is no 'LSTM'; there are GRU; TrXL"):
        learning.main(learning.Config(agents=("GRU", "TrXL"), draw=("LSTM",), report=True))
    with pytest.raises(SystemExit, match="two of these agents have the same name in tables: TrXL, TrXL"):
        learning.main(learning.Config(agents=("TrXL", "TrXL"), report=True))


def test_an_agent_goes_on_with_no_other_run(tmp_path):
    with pytest.raises(SystemExit, match="GRU --resume nowhere: --resume nowhere: there is no such folder"):
        learning.plan(learning.Config(), learning.TASKS["mortar-mayhem"], "GRU --resume nowhere", 1)


def test_a_stopped_run_goes_on_and_a_whole_one_is_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(learning, "TEST_LEVELS", 5)
    small = "--num-envs 4 --num-steps 32 --num-minibatches 2 --hidden-size 8 --eval-levels 2"
    agent, task = f"GRU --refresh-memory {small}", learning.TASKS["mortar-mayhem"]
    config = learning.Config(
        tasks=("mortar-mayhem",),
        agents=(agent,),
        steps=3 * 128,
        seeds=(1,),
        evaluations=3,
        folder=tmp_path / "learning",
        results=tmp_path / "results",
        out=tmp_path / "curves.png",
    )
    config.folder.mkdir()
    monkeypatch.chdir(config.folder)
    plan = learning.plan(config, task, agent, 1)
    args = parse_args(ppo_gru, *plan.command[2:])
    run = ppo_gru.setup(args)
    assert args == plan.args
    run.received_signal = signal.SIGTERM  # during the first of three iterations
    run_to_end(args, run, ppo_gru.train)

    def trainings():
        return learning.runs_in(str(config.folder / "runs"), plan)

    def train(config, plan):  # in this process
        (stopped,) = trainings()
        ppo_gru.main(parse_args(ppo_gru, "--resume", stopped.path))
        tqdm.write(f"trained {plan}")

    monkeypatch.setattr(learning, "train", train)
    monkeypatch.setattr(learning, "commit", lambda: "abc1234")
    monkeypatch.setattr(subprocess, "run", lambda line, **how: programs.run_command(*line[1:], **how["env"]))

    assert [learning.is_complete(each) for each in trainings()] == [False]
    assert learning.result_of(config, plan) is None

    learning.main(config)
    assert f"trained {agent} on {task.env_id}, seed 1" in capsys.readouterr().out
    (whole,) = trainings()
    assert (learning.is_complete(whole), whole.path) == (True, str(config.folder / run.folder))
    kept = learning.result_of(config, plan)
    assert kept.args == whole.args
    assert (kept.machine, whole.machine) == (learning.machine(), "not recorded")
    assert f" {os.cpu_count()} cores, PyTorch {torch.__version__}" in kept.machine
    scores = ("eval/carried_out", "eval/return", "eval/length")
    for name in (*scores, "charts/seconds_iteration", *learning.UPDATE_CURVES):
        for one, other in zip(kept.curves[name], whole.curves[name], strict=True):
            assert one == pytest.approx(other, rel=1e-3)
    assert kept.curves["eval/return"][1].shape == (3, 2, 3)
    steps, tested = kept.curves["test/carried_out"]
    assert (steps.tolist(), tested.shape) == ([whole.last_step], (1, 5, 1))
    played = evaluate.Config(start_level=1_000_000, levels=5, repeats=1, seed=1)
    returns = evaluate.play(Checkpoint.read(f"{whole.path}/model.pt"), played)["return"]
    assert tested[0] == pytest.approx(returns / 0.4), "of four commands, 0.1 each"
    carried_out = kept.curves["eval/carried_out"][1]
    assert carried_out == pytest.approx(kept.curves["eval/return"][1] / 0.4), "of four commands, 0.1 each"

    shutil.rmtree(config.folder)
    learning.main(config)  # its result is enough
    told = capsys.readouterr().out
    assert "trained" not in told
    score = tested.mean()
    assert f"\n| {short(agent)} | {score:.2f} | {iqm(tested):.2f} | {score:.2f} |" in told
    assert f"\nRuns: 1, together 0.0 hours without evaluations. Machines: {kept.machine}\n" in told
    assert config.out.stat().st_size > 10_000

    other = f"LSTM {small}"
    config = replace(config, report=True, agents=(agent, other), seeds=(1, 2))
    learning.main(config)
    told = capsys.readouterr().out
    missing = f"mortar-mayhem: runs without a result: 1 of {short(agent)}; 2 of {short(other)}\n"
    assert ("trained" not in told, missing in told, f"| {short(agent)} | {score:.2f} |" in told) == (True,) * 3
    assert not config.folder.exists() or not [*config.folder.iterdir()]
    with pytest.raises(SystemExit, match="nowhere has no results of these agents; without --report they are trained"):
        learning.main(replace(config, results=tmp_path / "nowhere"))


@pytest.mark.parametrize("error", [SystemExit("seed 1 failed"), OSError(28, "No space left on device")])
def test_a_failed_run_stops_no_other(error, tmp_path, monkeypatch):
    done = []

    def train(config, plan):
        done.append(plan.seed)
        if plan.seed == 1:
            raise error

    monkeypatch.setattr(learning, "train", train)
    config = learning.Config(tasks=("mortar-mayhem",), agents=("GRU",), seeds=(1, 2), jobs=1, folder=tmp_path)
    with pytest.raises(SystemExit, match=rf"{re.escape(str(error))}; GRU on .*, seed 2, was stopped; the same"):
        learning.main(config)
    assert done == [1, 2]


def test_a_training_that_is_about_to_begin_is_stopped_too(tmp_path, monkeypatch):
    config = learning.Config(folder=tmp_path)
    plan = learning.plan(config, learning.TASKS["mortar-mayhem"], "GRU", 1)
    plan = replace(plan, command=(sys.executable, "-c", "import time; time.sleep(600)"))
    monkeypatch.setattr(learning, "STOPPING", threading.Event())
    learning.STOPPING.set()
    began = time.monotonic()
    learning.train(config, plan)
    assert time.monotonic() - began < 300
    assert not learning.RUNNING


@pytest.mark.parametrize(
    ("total", "last", "complete"), [(96, 64, False), (96, 96, True), (100, 64, False), (100, 96, True)]
)
def test_a_run_is_complete_when_no_iteration_is_left(total, last, complete, tmp_path):
    """Of 32 steps each; and when it has written its final weights: it may have been stopped, resumed and killed."""
    seconds = {name: (np.array([last]), np.ones((1, 1, 1))) for name in SECONDS.values()}
    args = {"total_timesteps": str(total), "num_envs": "4", "num_steps": "8"}
    run = RunLog(str(tmp_path), args, seconds)
    assert not learning.is_complete(run)
    write_model(tmp_path, last - 32)
    assert not learning.is_complete(run)
    write_model(tmp_path, last)
    assert learning.is_complete(run) == complete


def write_model(folder, step):
    torch.save({"script": "ppo_gru", "args": {}, "weights": {}, "step": step}, folder / "model.pt")


def test_final_weights_are_scored_as_their_evaluations_are(tmp_path, monkeypatch):
    agent = {"metrics": {"return": {"scores": [[[1.0]]]}}}
    (tmp_path / "test_scores.json").write_text(json.dumps([{"agents": [agent]}]))
    lines = []
    done = subprocess.CompletedProcess((), 0)
    monkeypatch.setattr(subprocess, "run", lambda line, **how: (lines.append(" ".join(line)), done)[1])
    config = learning.Config(folder=tmp_path)
    plan = learning.plan(config, learning.TASKS["mortar-mayhem"], "GRU --eval-max-steps 123", 1)
    run = RunLog(str(tmp_path), {}, {name: (np.array([96]), np.ones(1)) for name in SECONDS.values()})
    assert learning.test_scores(config, plan, run) == {"test/return": ([96], 1.0)}
    assert "--max-steps 123" in lines[0]


@pytest.mark.parametrize(("last", "tested"), [(None, True), (64, True), ("end", False)])
def test_a_run_without_a_score_at_its_end_is_no_result(last, tested, tmp_path, monkeypatch):
    """It has none, or only one of an earlier evaluation, or none on the test levels."""
    config = learning.Config(folder=tmp_path, results=tmp_path / "results")
    plan = learning.plan(config, learning.TASKS["mortar-mayhem"], "GRU", 1)
    end = plan.args.total_timesteps // 4096 * 4096
    curves = {name: (np.array([end]), np.ones((1, 1, 1))) for name in SECONDS.values()}
    if last is not None:
        curves["eval/carried_out"] = np.array([end if last == "end" else last]), np.ones((1, 1, 1))
    folder = tmp_path / "run"
    folder.mkdir()
    write_model(folder, end)
    run = RunLog(str(folder), plan.logged_args(), curves)
    monkeypatch.setattr(learning, "runs_in", lambda place, plan: [run])
    test = {"test/carried_out": ([end], np.ones((1, 5, 1)))} if tested else {}
    monkeypatch.setattr(learning, "test_scores", lambda *_: test)
    monkeypatch.setattr(learning, "train", lambda *_: pytest.fail("it has been trained"))
    with pytest.raises(SystemExit, match=r"GRU on .*, has no carried_out at its end: an evaluation was cut"):
        learning.write_result(config, plan)
    assert not (tmp_path / "results").exists()


def test_runs_share_the_cores_unless_told_how_many_threads_to_have(tmp_path, monkeypatch):
    config = learning.Config(jobs=1, folder=tmp_path)
    command = (sys.executable, "-c", "import os; print(os.environ['OMP_NUM_THREADS'])")
    vectors, pixels = (
        replace(learning.plan(config, learning.TASKS["mortar-mayhem"], f"GRU --obs-type {kind}", 1), command=command)
        for kind in ("vector", "pixels")
    )
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    learning.train(config, vectors)
    monkeypatch.delenv("OMP_NUM_THREADS")
    learning.train(config, vectors)
    learning.train(config, pixels)
    learning.train(replace(config, jobs=2), pixels)
    assert [log.read_text() for log in sorted(tmp_path.glob("*.log"))] == ["7\n3\n", "3\n1\n"]


def test_a_log_tells_how_far_its_training_is(tmp_path):
    config = learning.Config(folder=tmp_path)
    plan, other = (learning.plan(config, learning.TASKS["mortar-mayhem"], "GRU", seed) for seed in (1, 2))
    with learning.log_of(config, plan).open("w") as log:
        bar = tqdm(total=1_000_000, unit=" steps", unit_scale=True, file=log, mininterval=0)  # as the scripts have it
        for steps, seen in ((500, 500), (299_500, 300_000), (700_000, 1_000_000)):
            bar.update(steps)
            bar.set_postfix({"SPS": 12_345})
            log.flush()
            assert learning.steps_so_far(config, plan) == seen
        bar.close()
    assert learning.steps_so_far(config, other) == 0, "another seed has not begun"
    learning.log_of(config, other).write_text("10%|#   | 1.10G/11.0G [10:00<99:00, 12.3k steps/s]")
    assert learning.steps_so_far(config, other) == 1_100_000_000
    longer = learning.plan(replace(config, steps=12_000_000), learning.TASKS["mortar-mayhem"], "GRU", 1)
    assert learning.steps_so_far(config, longer) == 0, "nor has a longer training"


def test_results_as_one_table(tmp_path, capsys, monkeypatch):
    """Of the test levels, those that were not trained on: the first four."""
    new = np.arange(7) < 4
    monkeypatch.setattr(learning.tables, "read_new_levels", lambda: {("X-v0", "{}"): new})
    args = {"env_id": "X-v0", "env_options": "{}", "exp_name": "GRU", "script": "ppo_gru", "seed": "3"}
    args |= {"total_timesteps": "300", "start_level": "0", "num_levels": "1000"}
    scores = np.broadcast_to(np.reshape([1, 2, 3], (3, 1, 1)), (3, 4, 2))
    run = RunLog("", args, {"eval/return": (np.array([100, 200, 300]), scores)})
    seconds = {name: (np.array([100, 200, 300]), np.full((3, 1, 1), 36.0)) for name in SECONDS.values()}
    test = {"test/return": ([300], np.where(new, 2.0, 9.0)[None, :, None])}
    (tmp_path / "X-v0").mkdir()
    learning.write_run(replace(run, curves=run.curves | seconds | test), f"{tmp_path}/X-v0/run.json.gz")
    unmeasured = {"eval/return": (np.array([100]), scores[:1])}  # as earlier versions did, which had no seconds
    # Another seed, which has an older name.
    other = args | {"seed": "4", "exp_name": "before"}
    learning.write_run(RunLog("", other, unmeasured), f"{tmp_path}/X-v0/unmeasured.json.gz")
    learning.write_run(RunLog("", args | {"gamma": "0.9"}, unmeasured), f"{tmp_path}/X-v0/other.json.gz")
    learning.main(learning.Config(results=tmp_path, csv=tmp_path / "all.csv"))
    assert capsys.readouterr().out == f"{tmp_path}/all.csv: the scores of 3 runs\n"
    head, another, *lines = (tmp_path / "all.csv").read_text().splitlines()
    names = "run,env_id,env_options,exp_name,script,seed,total_timesteps,settings"
    assert head == f"{names},levels,metric,step,hours,mean,episodes"
    settings = lines[0].split(",")[7]
    assert re.fullmatch("[0-9a-f]{8}", settings)
    assert another.split(",")[7] != settings
    assert lines == [
        f"run,X-v0,{{}},GRU,ppo_gru,3,300,{settings},development,return,100,0.0100,1,8",
        f"run,X-v0,{{}},GRU,ppo_gru,3,300,{settings},development,return,200,0.0200,2,8",
        f"run,X-v0,{{}},GRU,ppo_gru,3,300,{settings},development,return,300,0.0300,3,8",
        f"run,X-v0,{{}},GRU,ppo_gru,3,300,{settings},test,return,300,0.0300,2,4",
        f"unmeasured,X-v0,{{}},before,ppo_gru,4,300,{settings},development,return,100,nan,1,8",
    ]


def test_a_result_names_the_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "ROOT", tmp_path)
    assert learning.commit() == "", "there is no repository"

    def git(*words):
        identity = ("-c", "user.name=A", "-c", "user.email=a@b.c")
        return subprocess.run(["git", "-C", tmp_path, *identity, *words], capture_output=True, text=True, check=True)

    git("init")
    (tmp_path / "agent.py").write_text("1")
    git("add", ".")
    git("commit", "-m", "first")
    first = git("rev-parse", "--short", "HEAD").stdout.strip()
    learning.write_run(RunLog("", {"env_id": "X-v0"}, {}), f"{tmp_path}/run.json.gz")
    with gzip.open(tmp_path / "run.json.gz") as file:
        assert json.load(file)["commit"] == first
    (tmp_path / "agent.py").write_text("2")
    assert learning.commit() == f"{first}-dirty"


def test_results_in_a_folder_with_brackets(tmp_path):
    config = learning.Config(results=tmp_path / "a[1]")
    plan = learning.plan(config, learning.TASKS["mortar-mayhem"], "GRU", 1)
    folder = config.results / plan.task.env_id
    folder.mkdir(parents=True)
    curves = {"eval/carried_out": (np.array([100]), np.ones((1, 1, 1)))}
    learning.write_run(RunLog("", plan.logged_args(), curves), f"{folder}/{plan.task.env_id}__GRU__1__0.json.gz")
    assert learning.result_of(config, plan) is not None


def test_stored_results_have_all_seeds_or_three_or_none(monkeypatch):
    runs = {"GRU": [RunLog("", {}, {})] * 2, "TrXL": []}
    monkeypatch.setattr(learning, "results_of", lambda config, plans: {"mortar-mayhem": runs})
    assert learning.stored_results(tasks=("mortar-mayhem",), seeds=(1, 2)) == {"mortar-mayhem": runs}
    with pytest.raises(SystemExit, match=r"has 2 of 3 seeds of GRU in mortar-mayhem$"):
        learning.stored_results(tasks=("mortar-mayhem",))
    runs["GRU"] *= 2
    assert learning.stored_results(tasks=("mortar-mayhem",), seeds=(1, 2, 3, 4, 5)) == {"mortar-mayhem": runs}


def test_hours_of_trainings_are_expected_by_those_that_are_there(tmp_path):
    config = learning.Config(results=tmp_path, jobs=2)
    plans = [learning.plan(config, learning.TASKS["mortar-mayhem"], "GRU", seed) for seed in (1, 2)]
    assert learning.expected_hours(config, plans) == ""
    (tmp_path / "X-v0").mkdir()
    for speed in (100, 200, 900):  # steps a second; what counts is the middle one
        curves = {name: (np.array([36 * speed]), np.full((1, 1, 1), 36.0)) for name in SECONDS.values()}
        learning.write_run(RunLog("", plans[0].logged_args(), curves), f"{tmp_path}/X-v0/{speed}.json.gz")
    assert learning.expected_hours(config, plans) == ", about 1.4 hours"  # two million steps, two at a time
    assert learning.expected_hours(config, plans[:1]) == ", about 1.4 hours"  # one is no faster


def test_a_stopped_program_stops_its_trainings_with_a_checkpoint(tmp_path, curves):
    agent = "GRU --num-envs 4 --num-steps 32 --num-minibatches 2 --eval-levels 1 --checkpoint-interval 1"
    flags = ["--tasks", "mortar-mayhem", "--agents", agent, "--jobs", "1", "--folder", "."]
    with programs.Program(programs.command(learning.__file__, *flags), tmp_path) as program:
        program.wait_until(lambda: [*tmp_path.glob("runs/*/checkpoint-*.pt")])
        # To it alone. Ctrl-C is treated as the same, but a shell's background jobs do not get it.
        os.kill(program.pid, signal.SIGTERM)
        done = program.wait()
    assert done.returncode == 1
    assert done.stderr.endswith("stopped; the same command goes on\n")
    (folder,) = tmp_path.glob("runs/*")
    assert read_checkpoint(folder)["step"] == curves(folder)["losses/loss"][-1][0]
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # nothing trains any more


def test_the_full_suite():
    """The ten environments with their default options."""
    tasks, agents = learning.SUITES["full"]
    assert len(tasks) == 10
    assert [(name, task.env_id, task.options) for name, task in tasks.items()] == [(i, i, {}) for i in tasks]
    assert [*agents] == ["no memory", "16 frames", "GRU", "TrXL+"]


def test_a_run_goes_on_only_from_a_checkpoint(tmp_path, monkeypatch):
    """One that was stopped before its first begins again."""
    config, script = learning.Config(folder=tmp_path), tmp_path / "script.py"
    script.write_text("import sys; print(sys.argv[1:])")
    plan = learning.plan(config, learning.TASKS["mortar-mayhem"], "GRU", 1)
    plan = replace(plan, command=(sys.executable, str(script), "--seed", "1"))
    run = tmp_path / "runs/a"
    run.mkdir(parents=True)
    monkeypatch.setattr(learning, "runs_in", lambda place, plan: [RunLog(str(run), {}, {})])
    learning.train(config, plan)
    (run / "checkpoint-64.pt").touch()
    learning.train(config, plan)
    (log,) = tmp_path.glob("*.log")
    assert log.read_text() == "['--seed', '1']\n['--resume', 'runs/a']\n"


def test_only_the_agents_to_draw_are_drawn(tmp_path, monkeypatch):
    drawn, task = {}, "MortarMayhem-Grid-v0"
    monkeypatch.setattr(tables, "draw", lambda tasks, out: drawn.update(tasks))
    config = learning.Config(suite="full", tasks=(task,), draw=("GRU",), report=True)
    learning.main(replace(config, results=ROOT / "benchmarks/results"))
    assert [*drawn[task]] == ["GRU"]
