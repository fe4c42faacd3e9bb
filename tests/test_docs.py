"""What the README and docs/ name exists, and their commands are commands that the programs take."""

import argparse
import contextlib
import importlib
import inspect
import io
import itertools
import json
import os
import re
import shlex
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import gymnasium as gym
import pytest
import torch
import tyro
from torch.distributed import run as torchrun

import learning
import memory_gym_envs  # noqa: F401 (registers the ids)
import ppo_gru
import ppo_trxl
from ppo_utils import flags, runs
from ppo_utils.scores import own_metric

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [README, ROOT / "agents/README.md", *DOCS]
SCRIPTS = (ppo_gru, ppo_trxl)
PROGRAMS = [*ROOT.glob("*.py"), *(ROOT / "benchmarks").glob("*.py"), ROOT / "examples/export_step.py"]

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


class Parsed(Exception):
    """A program's command line was parsed, and the program need not run."""


def code(page: Path) -> list[str]:
    """Return a page's lines of fenced code, and its code spans."""
    text = page.read_text().replace("\\\n", " ")
    fence = re.compile(r"^```\w*\n(.*?)^```", re.MULTILINE | re.DOTALL)
    lines = [line for block in fence.findall(text) for line in block.splitlines()]
    spans = re.findall(r"`((?:[^`\n]|\n(?!\n))+)`", fence.sub("", text))
    return lines + [" ".join(span.split()).replace("\\|", "|") for span in spans]


def commands(page: Path) -> list[str]:
    """Return the page's calls of Python programs and of torchrun, without what the shell does with them."""
    calls = [part.split(" > ")[0].strip() for text in code(page) for part in text.split(" && ")]
    return sorted({call for call in calls if call.startswith(("python ", "torchrun "))})


COMMANDS = {
    f"{page.relative_to(ROOT)}-{i}": (page.name, call) for page in PAGES for i, call in enumerate(commands(page))
}
FLAGS = {text: page.name for page in PAGES for text in code(page) if text.startswith("--")}
each_command = pytest.mark.parametrize(("page", "command"), COMMANDS.values(), ids=COMMANDS)
each_flag = pytest.mark.parametrize(("flag", "page"), FLAGS.items(), ids=FLAGS)


def parser(module: ModuleType) -> Callable[[list[str]], object]:
    """Return the function that parses a program's arguments; SystemExit is what it raises for wrong ones."""
    if hasattr(module, "Args"):
        return partial(parse_training, module)
    if hasattr(module, "Config"):
        return lambda arguments: tyro.cli(module.Config, args=arguments)
    if hasattr(module, "argparse"):
        return lambda arguments: parse_with_argparse(module.main, arguments)
    return parse_without_flags


def parse_training(script: ModuleType, arguments: list[str]) -> object:
    """Parse a training's arguments; a run that it goes on with need not exist."""
    with patch.object(runs, "read_checkpoint", lambda folder: {"args": {}}):
        return runs.parse_args(script.Args, script.PRESETS, arguments)


def parse_with_argparse(main: Callable[[], None], arguments: list[str]) -> None:
    """Run a program up to the point where its arguments are parsed."""
    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(self, *args):
        parse(self, *args)
        raise Parsed

    with (
        patch.object(argparse.ArgumentParser, "parse_args", parse_and_stop),
        patch.object(sys, "argv", ["program", *arguments]),
        contextlib.suppress(Parsed),
    ):
        main()
        raise AssertionError("the program ran without parsing its arguments")


def parse_without_flags(arguments: list[str]) -> None:
    """Take what a program without a parser takes."""
    if any(argument.startswith("-") for argument in arguments):
        raise SystemExit(f"the program has no flags, but is given {arguments}")


def error(parse: Callable[[list[str]], object], arguments: list[str]) -> str | None:
    """Return what a program says of wrong arguments, None for right ones."""
    output = io.StringIO()
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            parse(arguments)
    except SystemExit as end:
        return f"{end.code} {output.getvalue()}"
    return None


def import_program(path: str) -> ModuleType:
    """Import a program by its path or its module's name, leaving the environment's variables as they are."""
    with patch.dict(os.environ):
        return importlib.import_module(Path(path).stem if path.endswith(".py") else path)


@cache
def all_flags() -> set[str]:
    """Return the flags that the help of any program lists."""
    found = set()
    for path in PROGRAMS:
        source = path.read_text()
        if any(part in source for part in ("tyro.cli(", "ArgumentParser(", "class Args(")):
            with patch.dict(os.environ, COLUMNS="200"):
                text = error(parser(import_program(str(path))), ["--help"])
            for line in re.findall(r"^[\s│]*((?:-\w, )?--\S.*)$", text, re.MULTILINE):
                found |= set(re.findall(r"(?:^|, )(--[a-z][a-z0-9-]*)", line))
    return found


def slug(heading: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def test_pages_are_short():
    """Bars of tables are no words."""
    lines = README.read_text().splitlines()
    assert len(lines) <= 180
    words = [
        word for page in (ROOT / "docs").glob("*.md") for word in page.read_text().split() if re.search(r"\w", word)
    ]
    assert len(words) <= 13_000
    first = next(line for line in lines if line.startswith("pip install"))
    assert len(first) <= 220
    assert "python ppo_gru.py" in first


def test_readme_has_the_line_that_ci_runs():
    pattern = re.search(r"grep -m 1 -o '([^']+)'", (ROOT / ".ci/run").read_text()).group(1)
    line = re.search(pattern, README.read_text()).group()
    assert line.strip() == 'pip install -e ".[test]" && pytest -n auto'


@each_page
def test_links(page):
    text = page.read_text()
    links = re.findall(r"\]\(([^)\s]+)\)", text)
    for link in links:
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        if anchor:
            assert anchor in [slug(heading) for heading in re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)]


def test_readme_links_every_page():
    links = re.findall(r"\]\((docs/[^)#]+\.md)", README.read_text())
    assert set(links) == {f"docs/{page.name}" for page in DOCS}


@each_page
def test_files_exist(page):
    copies = re.findall(r"^cp \S+ (\S+)$", page.read_text(), re.MULTILINE)  # that the page says to make
    for text in code(page):
        for name in re.findall(r"(?<![\w./<-])[\w./-]+\.(?:py|md|toml|yml|cff)\b", text):
            assert name in copies or (ROOT / name).exists(), f"{name}, in `{text}`"


@each_page
def test_extras_exist(page):
    project = (ROOT / "pyproject.toml").read_text().split("[project.optional-dependencies]")[1].split("\n[")[0]
    extras = set(re.findall(r"^(\w+) = \[", project, re.MULTILINE))
    assert set(re.findall(r"\.\[(\w+)\]", page.read_text())) <= extras


@each_command
def test_command(page, command):
    program, *words = shlex.split(command)
    if program == "torchrun":
        given = torchrun.get_args_parser().parse_args(words)
        words = [given.training_script, *given.training_script_args]
    path, *arguments = words[1:] if words[0] == "-m" else words
    assert words[0] == "-m" or (ROOT / path).exists()
    module = import_program(path)
    wrong = error(parser(module), arguments)
    assert wrong is None, f"{page}: {command}\n{wrong}"
    if hasattr(module, "Args") and "--resume" not in arguments:
        processes = int(given.nproc_per_node) * int(given.nnodes.split(":")[0]) if program == "torchrun" else 1
        with patch.object(flags, "rank_and_size", lambda: (0, processes)):
            args = parse_training(module, arguments)
            flags.check_args(args)
            flags.check_minibatches(args, module.Memory(args, module.Memory.input_width(args)))


DRAWN = sorted({call for _, call in COMMANDS.values() if "learning.py" in call and "--results benchmarks/res" in call})
DRAWN = [call for call in DRAWN if "--report" not in call and "--csv" not in call]  # these show what there is alone


@pytest.mark.parametrize("command", DRAWN, ids=range(len(DRAWN)))
def test_nobody_has_to_train_again_what_is_in_the_repository(command):
    """Where a page's command names the results that are there, all that it wants is among them, and complete."""
    config = tyro.cli(learning.Config, args=shlex.split(command)[2:])
    config.results = ROOT / config.results
    for plan in learning.plans_of(config).values():
        run = learning.result_of(config, plan)
        assert run is not None, f"there is no result of {plan}"
        assert learning.has_all_steps(run)
        assert len(run.curves[f"eval/{plan.task.score}"][0]) >= config.evaluations


OPTIONS = sorted({call for _, call in COMMANDS.values() if "--env-options" in call})


@pytest.mark.parametrize("command", OPTIONS, ids=range(len(OPTIONS)))
def test_options_exist(command):
    words = shlex.split(command)
    given = dict(itertools.pairwise(words))
    options = json.loads(given["--env-options"])
    _, info = gym.make(given.get("--env-id", ppo_gru.Args.env_id)).reset(seed=1, options=options)
    assert "ground_truth" in info


@each_flag
def test_flag_exists(page, flag):
    assert set(re.findall(r"(?:^|\s)(--[a-z][a-z0-9-]*)", flag)) <= all_flags(), page


@pytest.mark.parametrize("flag", sorted(flag for flag in FLAGS if re.fullmatch(r"--[a-z-]+ [^A-Z|]+", flag)))
def test_flag_takes_its_value(flag):  # capitals stand for a value, and bars divide the values that there are
    wrong = [error(parser(script), shlex.split(flag)) for script in SCRIPTS]
    assert None in wrong, wrong


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.__name__)
def test_readme_names_the_sections(script):
    named = re.findall(r"^\| (\d [A-Z ]+) \|", README.read_text(), re.MULTILINE)
    assert named == re.findall(r"^# ---- (.+) ----$", inspect.getsource(script), re.MULTILINE)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.__name__)
def test_readme_names_the_memory_interface(script):
    section = README.read_text().split("## Add your own memory")[1].split("\n## ")[0]
    methods = re.findall(r"`(\w+)\(([^)]*)\)`", section)
    assert len(methods) >= 5
    for name, parameters in methods:
        called = script.Memory.__init__ if name == "Memory" else getattr(script.Memory, name)
        named = parameters.split(", ")
        parameters = [name for name in inspect.signature(called).parameters if name != "self"]
        assert parameters == ["state", "hidden"] if name == "advance" else parameters == named


def test_page_names_the_curves(tiny, scalars):
    page = (ROOT / "docs/logging.md").read_text()
    rows = re.findall(r"^\| (`\w+/.+?) \|", page, re.MULTILINE)
    changes = {"env_id": "MortarMayhemB-Grid-v0", "total_timesteps": 128, "eval_interval": 2, "eval_levels": 1}
    changes |= {"reconstruction_coef": 0.1, "ground_truth_coef": 0.1}
    logged = set()
    for script in SCRIPTS:
        logged |= set(scalars(script.main(tiny(script, **changes))))
    logged = {re.sub("^(episode|eval)/.*", r"\1/NAME", name) for name in logged} | {"eval_levels/NAME"}
    named = {name for row in rows for name in re.findall(r"`([^`]+)`", row)}
    assert named == logged | {"episode_count/NAME"}  # which only environments of others need


def test_page_plays_an_agent(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    source = re.search(r"```python\n(.*?)```", (ROOT / "docs/evaluation.md").read_text(), re.DOTALL).group(1)
    torch.manual_seed(1)
    exec(source, {})
    assert 0 < float(capsys.readouterr().out.split()[-1]) <= 1


@each_page
def test_nothing_is_left_open(page):
    assert "TODO" not in page.read_text()


def test_what_an_episode_ends_with():
    """The page's table has all numbers of an info but reward and length, and the ground truth's shape."""
    page = (ROOT / "docs/environments.md").read_text()
    rows = re.findall(r"^  \| [\w ]+ \| \((\d),\): .*? \| (.*) \|$", page, re.MULTILINE)
    families = ("MortarMayhem", "MysteryPath", "SearingSpotlights")
    ids = [f"{kind}{family}-v0" for family in families for kind in ("", "Endless-")]
    for env_id, (size, text) in zip(ids, rows, strict=True):
        env = gym.make(env_id, obs_type="vector")
        env.reset(seed=0)
        is_over = False
        while not is_over:
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            is_over = terminated or truncated
        assert info["ground_truth"].shape == (int(size),)
        keys = re.findall(r"`(\w+)`", text)
        assert {*keys, "reward", "length", "ground_truth"} == set(info)
        assert keys[0] == own_metric(env_id).replace("return", "reward")
