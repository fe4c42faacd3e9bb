"""The search of benchmarks/tune.py: its space, its score, and that it stops, goes on and reports."""

import itertools
import json
import math
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import optuna
import pytest
from conftest import parse_args
from optuna.trial import TrialState, create_trial

import learning
import ppo_gru
import ppo_trxl
import tune
from ppo_utils.flags import check_args, check_minibatches
from ppo_utils.runs import close

SCRIPTS = (ppo_gru, ppo_trxl)
TASK = learning.TASKS["mortar-mayhem"]
each_script = pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.__name__)


@pytest.fixture
def quick(monkeypatch):
    """Replace trainings by curves that rise faster the larger the learning rate; return a configuration."""

    def slices(script, args, task):
        for i in range(tune.SLICES):
            yield min(1.0, i * args.init_lr * 20)

    monkeypatch.setattr(tune, "slices", slices)
    return tune.Config(trials=2, folder=Path("search").absolute())


# ---- space ----
@each_script
def test_sampled_settings_are_valid(script):
    config = tune.Config(script=script.__name__)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    for _ in range(10):
        params = study.ask(tune.space_of(config.script)).params
        for name, task in learning.TASKS.items():
            args = tune.arguments(config, task, params, 1, name)
            check_args(args)
            assert (args.final_lr <= args.init_lr, args.final_ent_coef <= args.init_ent_coef) == (True, True)
            assert args.total_timesteps == args.anneal_steps == int(task.total_timesteps * config.steps_scale)


@each_script
def test_every_layout_has_enough_pieces(script):
    config, params = tune.Config(script=script.__name__), tune.preset_params(script.__name__)
    space = tune.space_of(config.script)
    for layout, minibatches in itertools.product(space["layout"].choices, space["num_minibatches"].choices):
        changed = params | {"layout": layout, "num_minibatches": minibatches}
        check_minibatches(args := tune.arguments(config, TASK, changed, 1, "pieces"), script.Memory.longest_piece(args))


@each_script
def test_the_first_trial_is_the_preset(script):
    params = tune.preset_params(script.__name__)
    space = tune.space_of(script.__name__)
    assert params.keys() == space.keys()
    assert all(space[name]._contains(space[name].to_internal_repr(value)) for name, value in params.items())
    preset = parse_args(script, "--preset", "laptop")
    assert replace(preset, **tune.settings(params)) == preset


def test_a_parameter_wins_over_the_task_s_flag():
    task = learning.TASKS["mystery-path"]
    args = tune.arguments(tune.Config(), task, tune.preset_params("ppo_gru") | {"init_lr": 0.002}, 1, "name")
    assert (args.init_lr, args.vector_frequencies) == (0.002, 4)


@each_script
def test_flags_are_those_of_the_settings(script):
    params = tune.preset_params(script.__name__) | {"init_lr": 0.00123456, "clip_vloss": False, "vf_coef": 1.0}
    args = parse_args(script, *tune.flags_of(params).split())
    assert tune.settings(params).items() <= asdict(args).items()
    assert (args.init_lr, args.clip_vloss, args.vf_coef) == (0.00123, False, 1.0)


# ---- score ----
def test_score_of_a_flat_curve():
    assert tune.area_and_low(np.full(24, 0.5)) == (0.5, 0.5)
    assert tune.score(np.array([[0.5] * 24, [0.0] * 24])) == 0.25


def test_score_worked_by_hand():
    curve = np.array([0.0, 0.0, 0.6, 0.9, 0.3, 0.6])  # the last third: 0.3 and 0.6
    assert tune.area_and_low(curve) == pytest.approx((0.4, 0.3))
    assert tune.score(curve[None]) == pytest.approx(0.35)


def test_early_beats_late():
    early, late = np.zeros((2, 1, 24))
    early[0, 6:] = late[0, 12:] = 1.0
    assert tune.score(early) > tune.score(late)


def test_falling_back_costs():
    steady, falls, late = np.zeros((3, 1, 24))
    steady[0, 6:] = falls[0, 6:] = late[0, 14:] = 1.0
    falls[0, 20] = 0.2
    assert tune.score(falls) < tune.score(late) < tune.score(steady), "even learning much later is better"


def test_the_lower_bound_grows_to_at_most_the_score():
    curves = np.random.default_rng(1).random((3, 24))
    reports = [tune.lower_bound(curves[:, : i + 1]) for i in range(24)]
    assert reports == sorted(reports)
    assert reports[-1] == pytest.approx(curves.mean() / 2)
    assert reports[-1] < tune.score(curves)


def test_the_endless_score_does_not_saturate():
    task = learning.TASKS["endless-mortar-mayhem"]
    five, ten, twenty, more = (tune.normalized(task, [commands]) for commands in (5, 10, 20, 60))
    assert twenty == 1
    assert more > 1.2
    assert twenty - ten == pytest.approx(ten - five, rel=0.1)
    assert tune.normalized(TASK, [0.25, 0.75]) == 0.5


# ---- training ----
@each_script
def test_slices_of_a_real_training(script, tiny):
    args = replace(
        tiny(script, total_timesteps=64 * 6, obs_type="vector"),
        **{"env_id": TASK.env_id, "env_options": json.dumps(TASK.options), "exp_name": "slices"},
    )
    curve = list(itertools.islice(tune.slices(script, args, TASK), tune.SLICES))
    assert len(curve) == tune.SLICES
    assert all(0 <= value <= 1 for value in curve)
    assert max(curve) > 0
    assert not list(Path("runs").iterdir()), "nothing is left behind"


@each_script
def test_iterations_train_as_the_script_does(script, tiny):
    args = tiny(script, total_timesteps=192, anneal_steps=192, env_id="CartPole-v1", obs_type="vector")
    run = script.setup(args)
    script.train(args, run)
    close(run)
    own = tune.start(script, replace(args, checkpoint_interval=0))
    for _ in range(3):
        returns = tune.iteration(script, replace(args, checkpoint_interval=0), own, "return")
        assert returns  # of the episodes that ended
    close(own)
    pairs = zip(run.agent.parameters(), own.agent.parameters(), strict=True)
    assert all(theirs.equal(ours) for theirs, ours in pairs)


def test_trainings_in_turns_are_those_of_each_alone(tiny):
    args = tiny(total_timesteps=64 * 24, env_id=TASK.env_id, obs_type="vector")
    alone = [[*itertools.islice(tune.slices(ppo_gru, replace(args, seed=seed), TASK), 24)] for seed in (1, 2)]
    turns = [tune.slices(ppo_gru, replace(args, seed=seed), TASK) for seed in (1, 2)]
    assert [[*each] for each in zip(*([next(each) for each in turns] for _ in range(24)), strict=True)] == alone
    assert alone[0] != alone[1]


def test_a_slice_without_an_episode_has_the_last_one_s_score(tiny, monkeypatch):
    found = iter([[], [0.5], [], [0.7]])
    monkeypatch.setattr(tune, "iteration", lambda *rest: next(found))
    monkeypatch.setattr(tune, "SLICES", 4)
    args = tiny(total_timesteps=256)
    assert list(tune.slices(ppo_gru, args, TASK)) == [0.0, 0.5, 0.5, 0.7]


def test_a_training_that_diverges_scores_nothing_from_there_on(tiny, monkeypatch):
    played = []

    def iteration(script, args, run, metric):
        played.append(1)
        if len(played) > 2:
            raise FloatingPointError
        return [0.5]

    monkeypatch.setattr(tune, "iteration", iteration)
    args = tiny(total_timesteps=24 * 64)
    assert list(itertools.islice(tune.slices(ppo_gru, args, TASK), 24)) == [0.5] * 2 + [0.0] * 22


# ---- search ----
def trials_of(config):
    return tune.open_study(config).get_trials()


def test_a_search_ends_goes_on_and_reports(monkeypatch, capsys):
    small = {"layout": tune.one_of("4x16", "8x16"), "num_minibatches": tune.one_of(2, 4)}
    preset = tune.preset_params("ppo_gru") | {"layout": "4x16", "num_minibatches": 2}
    monkeypatch.setattr(tune, "SPACE", tune.SPACE | small)
    monkeypatch.setattr(tune, "preset_params", lambda script: preset)
    config = tune.Config(trials=2, steps_scale=0.0002, folder=Path("search"))
    tune.main(config)
    assert "2 complete" in capsys.readouterr().out
    before = trials_of(config)
    assert before[0].params == preset
    tune.main(replace(config, trials=3))
    after = trials_of(config)
    assert [trial.number for trial in after] == [0, 1, 2]
    assert [trial.value for trial in after[:2]] == [trial.value for trial in before]
    assert len({trial.params["init_lr"] for trial in after}) == 3
    text = capsys.readouterr().out
    assert "3 complete" in text
    assert "| preset |" in text
    assert Path("search/ppo_gru.png").stat().st_size > 10_000


def test_a_search_finds_what_is_better_and_prunes_what_is_worse(quick, capsys):
    config = replace(quick, trials=24)
    tune.main(config)
    trials = trials_of(config)
    states = [trial.state for trial in trials]
    assert states.count(TrialState.COMPLETE) + states.count(TrialState.PRUNED) == 24
    pruned = [trial for trial in trials if trial.state == TrialState.PRUNED]
    assert pruned
    assert all(tune.WARM_UP <= len(trial.user_attrs["curves"][0]) < tune.SLICES for trial in pruned)
    best = max((trial for trial in trials if trial.state == TrialState.COMPLETE), key=lambda trial: trial.value)
    assert best.params["init_lr"] > 2e-3
    text = capsys.readouterr().out
    assert "| init_lr | " in text.split("| parameter | importance |")[1].splitlines()[2]


def test_a_killed_trial_is_tried_again_first(quick):
    study = tune.open_study(quick)
    study.ask(tune.space_of("ppo_gru"))
    tune.work(replace(quick, trials=1), math.inf)
    failed, again = trials_of(quick)
    assert (failed.state, again.state) == (TrialState.FAIL, TrialState.COMPLETE)
    assert failed.params == again.params
    assert again.user_attrs["name"] == "preset"


def test_a_running_trial_is_left_alone(quick):
    running = tune.open_study(quick).ask(tune.space_of("ppo_gru"))
    with tune.locked(tune.lock_path(quick, running.number)):
        tune.work(quick, math.inf)
        assert [trial.state for trial in trials_of(quick)] == [TrialState.RUNNING, TrialState.COMPLETE]


def test_ctrl_c_leaves_the_trial_for_the_next_start(quick, monkeypatch, capsys):
    def interrupted(*rest):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tune, "run_trial", interrupted)
        tune.search(quick)
    assert "stopped" in capsys.readouterr().out
    tune.search(quick)
    assert [trial.state.name for trial in trials_of(quick)] == ["FAIL", "COMPLETE", "COMPLETE"]


def test_hours_and_seeds(quick):
    tune.search(replace(quick, hours=1e-9))
    assert [trial.state for trial in trials_of(quick)] == [TrialState.WAITING]
    config = replace(quick, folder=quick.folder / "seeds", seeds=(1, 2))
    tune.search(config)
    assert np.shape(trials_of(config)[0].user_attrs["curves"]) == (2 * len(config.tasks), tune.SLICES)


def test_again(quick, capsys):
    tune.search(replace(quick, trials=8))
    best = tune.best_trials(tune.load_study(quick))[:5]
    config = replace(quick, trials=6, folder=quick.folder / "again", again=quick.folder, seeds=(2, 3))
    tune.main(config)
    trials = trials_of(config)
    assert len(trials) == 6
    assert trials[0].params == tune.preset_params("ppo_gru")
    numbers = [trial.number for trial in best if trial.number]
    assert [trial.params for trial in trials[1 : 1 + len(numbers)]] == [trial.params for trial in best if trial.number]
    assert f"| trial {numbers[0]} of search |" in capsys.readouterr().out


def test_draws_differ_from_trial_to_trial(quick):
    drawn = set()
    for number in (1, 2, 3):
        study = optuna.create_study(sampler=tune.sampler(quick, number))
        drawn.add(study.ask(tune.space_of("ppo_gru")).params["init_lr"])
    assert len(drawn) == 3


# ---- bad input ----
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trials": 0}, "--trials is 0; it must be 1 or more"),
        ({"hours": -1.0}, "--hours is -1.0; it must be above 0"),
        ({"steps_scale": 0.001}, "--steps-scale is 0.001; it must be 0.00819 or more"),
        ({"keep": 0.0}, "--keep is 0.0"),
        ({"sampler_seed": -1}, "--sampler-seed and --seeds must be 0 or more"),
        ({"seeds": (1, -1)}, "--sampler-seed and --seeds must be 0 or more"),
        ({"steps_scale": math.inf}, "--steps-scale is inf; it must be a number above 0"),
        ({"seeds": ()}, "--seeds needs one or more, each of them once"),
        ({"seeds": (1, 1)}, "--seeds needs one or more, each of them once"),
        ({"tasks": ("nowhere",)}, "there is no task nowhere; there are mortar-mayhem, "),
        ({"tasks": ()}, "--tasks needs one or more"),
        ({"out": Path("nowhere/picture")}, "there is no folder nowhere"),
        ({"report": True}, "there is no search of ppo_gru in "),
    ],
)
def test_the_fault_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        tune.main(tune.Config(**changes))
    assert not Path("tune").exists()


def test_a_wrong_folder_of_another_search_begins_none(quick):
    with pytest.raises(ValueError, match="there is no search of ppo_gru in nowhere"):
        tune.open_study(replace(quick, again=Path("nowhere")))
    assert not tune.journal(quick).exists()


@pytest.mark.parametrize(("name", "value"), [("steps_scale", 0.5), ("seeds", (2,)), ("tasks", ("mystery-path",))])
def test_scores_that_do_not_compare_are_not_mixed(quick, name, value):
    tune.open_study(quick)
    with pytest.raises(ValueError, match=f"another --{name.replace('_', '-')}; use another --folder"):
        tune.open_study(replace(quick, **{name: value}))


def test_tasks_are_in_one_order(quick):
    tune.main(replace(quick, trials=1, tasks=("mystery-path", "mortar-mayhem")))
    tune.main(replace(quick, trials=2, tasks=("mortar-mayhem", "mystery-path")))
    assert list(tune.load_study(quick).user_attrs["search"]["--tasks"]) == ["mortar-mayhem", "mystery-path"]


@each_script
def test_the_committed_search_can_be_gone_on_with(script, quick):
    config = replace(quick, script=script.__name__)
    shutil.copytree(Path(tune.__file__).parent / "tuning", config.folder)
    assert len(tune.open_study(config).get_trials()) >= 8


def test_report_without_a_complete_trial(quick):
    tune.open_study(quick)
    with pytest.raises(ValueError, match="no trial of ppo_gru is complete yet"):
        tune.main(replace(quick, report=True))


def test_no_importances_from_a_few_trials(quick):
    study = tune.open_study(quick)
    params = tune.preset_params("ppo_gru")
    study.add_trial(create_trial(params=params, distributions=tune.space_of("ppo_gru"), value=0.5))
    assert tune.importances(study, tune.best_trials(study)) == {}
