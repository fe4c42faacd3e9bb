"""Both distributions: all of the repository, and the environments alone."""

import subprocess
import sys
from email import message_from_bytes
from pathlib import Path
from zipfile import ZipFile

import pytest
from programs import Program, elsewhere, module

ROOT = Path(__file__).parents[1]
ENVS = ROOT / "memory_gym_envs"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Give a function that builds a wheel of the project in a folder, without network."""

    def build(project):
        out = tmp_path_factory.mktemp("wheel")
        command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(out)]
        subprocess.run(command, cwd=project, check=True, capture_output=True)
        (path,) = out.iterdir()
        return ZipFile(path)

    return build


@pytest.fixture(scope="module")
def alone(wheel):
    """Give the wheel of the environments alone."""
    return wheel(ENVS)


@pytest.fixture(scope="module")
def whole(wheel):
    """Give the wheel of the whole repository."""
    return wheel(ROOT)


def modules(built):
    return {name for name in built.namelist() if ".dist-info/" not in name}


def metadata(built):
    (name,) = (name for name in built.namelist() if name.endswith(".dist-info/METADATA"))
    return message_from_bytes(built.read(name))


def run(site, *arguments):
    """Run Python with what was installed into the folder, from there, so that the clone is not found."""
    return subprocess.run([sys.executable, *arguments], cwd=site, capture_output=True, text=True, check=False)


def test_the_environments_alone(alone):
    sources = {str(path.relative_to(ROOT)) for path in ENVS.rglob("*.py")}
    assert modules(alone) == sources | {"memory_gym_envs/py.typed"}
    for name in modules(alone):
        assert alone.read(name) == (ROOT / name).read_bytes()


def test_they_need_numpy_and_gymnasium(alone):
    needed = metadata(alone).get_all("Requires-Dist")
    assert [line for line in needed if "extra ==" not in line] == ["gymnasium<2,>=0.29", "numpy>=1.26"]
    assert set(metadata(alone).get_all("Provides-Extra")) == {"play", "sb3"}


def test_they_say_who_made_them(alone, whole):
    for built in (alone, whole):
        about = metadata(built)
        assert about["Author"] == "The memory-gym-baselines authors"
        assert about["License-Expression"] == "MIT"
        assert len(about.get_all("Project-URL")) == 2
        assert "Programming Language :: Python :: 3" in about.get_all("Classifier")
        (licence,) = (name for name in built.namelist() if name.endswith("LICENSE"))
        assert built.read(licence) == (ROOT / "LICENSE").read_bytes()
    assert metadata(alone)["Version"] == metadata(whole)["Version"]


def test_they_work_alone(alone, tmp_path):
    alone.extractall(tmp_path)
    code = "import gymnasium, memory_gym_envs as m; gymnasium.make_vec(m.IDS[0], num_envs=2).reset(); print(m.__file__)"
    # The whole repository is installed, too, where tests run.
    done = run(tmp_path, "-W", "ignore:memory-gym-envs and", "-c", code)
    assert (done.stdout.strip(), done.stderr) == (str(tmp_path / "memory_gym_envs" / "__init__.py"), "")


def test_two_installations_are_told(alone, whole, tmp_path):
    for built in (whole, alone):
        built.extractall(tmp_path)
    done = run(tmp_path, "-c", "import memory_gym_envs")
    assert "memory-gym-envs and memory-gym-baselines both install memory_gym_envs" in done.stderr


def test_the_whole_repository_leaves_common_names_free(whole):
    top = {name.partition("/")[0] for name in modules(whole)}
    assert top == {"memory_gym_envs", "ppo_utils", "ppo_gru.py", "ppo_trxl.py"}
    for name in ("evaluate.py", "enjoy.py", "enjoy.html"):
        assert whole.read(f"ppo_utils/{name}") == (ROOT / name).read_bytes()
    assert "memory_gym_envs/py.typed" in modules(whole)


def test_a_training_of_an_installed_script_ends_with_commands_that_work(whole, tmp_path):
    whole.extractall(tmp_path)

    def run_module(option, name, *flags):
        assert option == "-m"
        with Program(elsewhere(module(name, *flags), tmp_path), tmp_path) as program:
            return program.wait()

    few = "--preset quickstart --num-envs 8 --num-steps 16 --total-timesteps 128 --save-model --no-cuda"
    done = run_module("-m", "ppo_gru", *few.split())
    commands = dict(line.split(": python ") for line in done.stdout.splitlines() if ": python " in line)
    assert set(commands) == {"evaluate", "watch"}, done.stderr
    for command in commands.values():
        done = run_module(*command.split())
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("project", "name"), [(ROOT, "ppo_utils"), (ROOT, "evaluate"), (ENVS, "memory_gym_envs")])
def test_an_editable_installation_is_the_clone(project, name, tmp_path):
    build = f"from hatchling.build import build_editable; print(build_editable({str(tmp_path)!r}))"
    made = subprocess.run([sys.executable, "-c", build], cwd=project, capture_output=True, text=True, check=True)
    ZipFile(tmp_path / made.stdout.strip()).extractall(tmp_path)
    # -S: without what else is installed. Found are the folder and then, by the .pth file in it, the clone.
    find = f"import site, importlib.util as u; site.addsitedir('.'); print(u.find_spec({name!r}).origin)"
    done = run(tmp_path, "-S", "-c", find)
    assert Path(done.stdout.strip()).is_relative_to(ROOT), done.stderr
