"""enjoy.py: what the page holds is what happened, and in a browser it goes where one clicks."""

import base64
import dataclasses
import importlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.actions.action_builder import ActionBuilder
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

import enjoy
import memory_gym_envs
import ppo_gru
import ppo_trxl
from memory_gym_envs.character import PAD
from ppo_utils.checkpoints import make_agent
from ppo_utils.environments import as_tensors, envs_for

AGENTS = {
    "GRU": (ppo_gru, {"env_id": "MysteryPath-Grid-v0", "reconstruction_coef": 0.1, "ground_truth_coef": 0.1}),
    "LSTM": (ppo_gru, {"env_id": "MortarMayhemB-v0", "memory": "lstm"}),
    "no memory": (ppo_gru, {"env_id": "MysteryPath-v0", "memory": "none", "frame_stack": 4, "step_encoding": True}),
    "TrXL": (ppo_trxl, {"env_id": "MortarMayhem-Grid-v0", "ground_truth_coef": 0.1}),
    "GTrXL": (ppo_trxl, {"env_id": "SearingSpotlights-v0", "obs_type": "vector", "trxl_gate": "gru", "amp": True}),
    "CartPole": (ppo_gru, {"env_id": "CartPole-v1"}),
}


@pytest.fixture
def saved(tiny):
    """Save an agent with random weights as model.pt, and return its arguments."""

    def save(script=ppo_gru, **changes):
        args = tiny(script, **{"env_id": "MysteryPath-Grid-v0", **changes})
        torch.manual_seed(1)
        envs = envs_for(args, 1)
        _, infos = envs.reset(seed=1)
        agent = make_agent(script.Agent, envs, infos, args)
        with torch.no_grad():  # the initial policy hardly depends on its input
            for parameter in agent.heads.parameters():
                parameter.mul_(3)
        saved = {"script": script.__name__, "args": dataclasses.asdict(args), "weights": agent.state_dict()}
        torch.save(saved, "model.pt")
        return args

    return save


def played(seed=3, max_steps=60):
    agent, envs, _ = enjoy.load("model.pt")
    return enjoy.play(agent, envs, seed, max_steps)


def data_of(page):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)[1])


def picture(url):
    """The pixels (h, w, 3) of a data URL."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"))


def frames_of(video):
    """The frames (T, h, w, 3) of a video on the page."""
    shape = (-1, video["height"], video["width"], 3)
    return np.concatenate([picture(sheet).reshape(shape) for sheet in video["sheets"]])


# ---- what is recorded ----
@pytest.mark.parametrize("name", AGENTS)
def test_every_kind_of_agent(name, saved):
    script, changes = AGENTS[name]
    args = saved(script, **changes)
    line = enjoy.main(enjoy.Config("model.pt", seed=3, max_steps=60))
    with open("page.html") as file:
        page = data_of(file.read())
    steps = page["steps"]
    assert line.startswith(f"page.html: {steps} steps, return {page['facts']['return']}, ")
    assert page["facts"]["agent"] == ("GRU" if name == "CartPole" else name)
    assert all(len(each) == steps for each in (page["actions"], *page["lines"].values()))
    names = ["rendered frame" if name in ("GTrXL", "CartPole") else "agent's view"]
    names += ["ground truth"] * (name != "CartPole") + ["reconstruction"] * bool(args.reconstruction_coef)
    assert [video["name"] for video in page["videos"]] == names
    assert all(len(frames_of(video)) == steps for video in page["videos"])
    assert len(page["truth"]) == steps * (name != "CartPole")
    assert len(page["estimate"]) == steps * bool(args.ground_truth_coef)
    assert (page["attention"] is not None) == (script is ppo_trxl)
    for branch in page["branches"]:
        assert np.allclose(np.sum(branch["probabilities"], 1), 1, atol=1e-4)
        assert len(branch["actions"]) == len(branch["probabilities"][0])


@pytest.mark.parametrize("flags", [{}, {"trxl_query_output": True, "trxl_query_position": True}], ids=str)
def test_the_episode_is_the_agents(flags, saved, monkeypatch):
    """Played again with the agent's own `act`: the same pictures, numbers and attention, step for step."""
    saved(ppo_trxl, env_id="MortarMayhem-Grid-v0", **flags)
    agent, envs, _ = enjoy.load("model.pt")
    episode = enjoy.play(agent, envs, 3, 60)
    page = enjoy.page_data(episode, "MortarMayhem-Grid-v0", {})
    view, truth = map(frames_of, page["videos"])
    used, forward = [], ppo_trxl.Attention.forward

    def noted(attention, x, keys, values, age, seen):
        used.append(enjoy.attention_weights(attention, x, keys, age, seen)[0, :, 0])
        return forward(attention, x, keys, values, age, seen)

    monkeypatch.setattr(ppo_trxl.Attention, "forward", noted)
    torch.manual_seed(3)
    obs, infos = envs.reset(seed=3)
    memory, cpu = agent.memory.initial_state(1, 60, torch.device("cpu")), torch.device("cpu")
    for t, actions in enumerate(episode.actions):
        assert np.array_equal(view[t], obs["observation"][0])
        envs.unwrapped.render_mode = "debug_rgb_array"
        assert np.array_equal(truth[t], envs.render()[0])
        assert np.array_equal(episode.truth[t], infos["ground_truth"][0])
        with torch.no_grad():
            used.clear()
            taken, log_probs, value = agent.get_action_and_value(as_tensors(obs, cpu), memory)
        assert episode.values[t] == value.item()
        assert episode.policy[t][0][actions[0]] == pytest.approx(log_probs.exp().item())
        assert np.array_equal(episode.attention[t], torch.stack(used).numpy())
        assert taken.tolist() == [actions]
        obs, rewards, terminated, truncated, infos = envs.step(taken.numpy())
        assert episode.rewards[t] == rewards[0]
        assert (terminated | truncated)[0] == (episode.finished and t == len(episode.actions) - 1)
    assert episode.finished
    assert episode.final["length"] == len(episode.actions)


def test_the_entropy_is_that_of_all_branches(saved):
    saved(env_id="MortarMayhem-v0", obs_type="vector")
    episode = played()
    for branches, entropy in zip(episode.policy, episode.entropies, strict=True):
        assert len(branches) == 2
        assert entropy == pytest.approx(-sum((p * np.log(p)).sum() for p in branches), rel=1e-5)


MOVES = {"left": (-1, 0), "right": (1, 0), "up": (0, -1), "down": (0, 1), "none": (0, 0)}
FACINGS = {"none": 0, "turn left": 2, "turn right": 6, "forward": 0}  # counter-clockwise from above, in eighths


@pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
def test_actions_do_what_the_page_calls_them(env_id):
    """From the middle of the field, and on a grid from facing up; in Mortar Mayhem once a command has been shown."""
    env = gym.make(env_id).unwrapped
    shown = 5 if "MortarMayhem-" in env_id else 0
    options = {"command_count": [1]} if shown and "Endless" not in env_id else {}
    sizes = getattr(env.action_space, "nvec", [getattr(env.action_space, "n", 0)])
    idle = np.zeros(len(sizes), int)
    names = enjoy.branch_names(env_id, [np.ones(size) for size in sizes])
    for branch, (_, actions) in enumerate(names.items()):
        for action, name in enumerate(actions):
            env.reset(seed=1, options=options)
            for _ in range(shown):
                env.step(idle if len(sizes) > 1 else 0)
            s = env.batch.state
            s.pos[:] = 42 + PAD
            s.facing[:] = 0
            choice = np.where(np.arange(len(sizes)) == branch, action, 0)
            env.step(choice if len(sizes) > 1 else action)
            moved = tuple(np.sign(s.pos[0] - 42 - PAD).tolist())
            if "forward" in actions:
                assert (int(s.facing[0]), moved == (0, -1)) == (FACINGS[name], name == "forward"), name
            else:
                assert moved == MOVES[name], name


def test_seed_is_the_level_and_the_actions(saved):
    saved()
    first, again, other = (played(seed).actions for seed in (3, 3, 4))
    assert first == again != other


def test_default_level_was_not_trained_on(saved):
    saved(num_levels=7, start_level=5)
    enjoy.main(enjoy.Config("model.pt", max_steps=2))
    with open("page.html") as file:
        facts = data_of(file.read())["facts"]
    assert facts == {"agent": "GRU", "seed": 12, "steps": 2, "return": "0", "cut short": "after 2 steps"}


# ---- how it is packed ----
def test_attention_is_packed_by_age():
    looks = [np.zeros((1, 2, 1)), np.array([[[1.0], [1.0]]]), np.array([[[0.25, 0.75], [0.75, 0.25]]])]
    looks.append(np.array([[[0.0, 1.0], [0.5, 0.5]]]))  # a window of two
    packed = enjoy.packed(looks)
    scores = np.frombuffer(base64.b64decode(packed["scores"]), "<u2").reshape(4, 1, 2)[:, 0] / 65535 * packed["heads"]
    assert np.allclose(scores, [[0, 0], [0, 2], [1, 1], [0.5, 1.5]], atol=1e-4)
    assert enjoy.packed([]) is None


def test_displayable():
    stack = np.arange(5, dtype=np.uint8) * np.ones((2, 3, 1), np.uint8)
    shown = enjoy.displayable(stack, stacked=True)
    assert shown.shape == (6, 9)  # three by three, the last four of them black
    assert shown[::2, ::3].tolist() == [[0, 1, 2], [3, 4, 0], [0, 0, 0]]
    colours = np.array([[[0.0, 0.5, 1.0]]])
    assert enjoy.displayable(colours, stacked=False).tolist() == [[[0, 128, 255]]]
    assert enjoy.displayable(colours, stacked=True).tolist() == [[0, 128], [255, 0]]


def test_text_in_the_data_cannot_end_the_script():
    episode = enjoy.Episode(policy=[[np.ones(1)]], actions=[[0]], values=[0.0], entropies=[0.0], rewards=[0.0])
    page = enjoy.page(enjoy.page_data(episode, "CartPole-v1", {"</script>": "<!--"}), "")
    assert page.count("</script>") == 3
    assert data_of(page)["facts"] == {"</script>": "<!--"}


def test_the_page_is_installed_with_the_module(tmp_path):
    """From a wheel, not only in a checkout; building it writes nothing to the checkout."""
    site = str(tmp_path / "site")
    offline = ["--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    pip = [sys.executable, "-m", "pip", "install", "--quiet", *offline, "--target", site]
    subprocess.run([*pip, Path(__file__).parents[1]], check=True)
    code = "import enjoy; print(enjoy.__file__); print(enjoy.page({'title': 'CartPole-v1'}, ''))"
    environ = {**os.environ, "PYTHONPATH": site}
    made = subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True, check=True)
    file, page = made.stdout.split("\n", 1)
    assert file == os.path.join(site, "enjoy.py")
    assert page.rstrip() == enjoy.page({"title": "CartPole-v1"}, "").rstrip()
    assert data_of(page) == {"title": "CartPole-v1"}


def test_a_thousand_steps_stay_small(saved):
    options = '{"agent_health": 1000000, "steps_per_coin": 1000000}'
    window = {"trxl_memory_length": 256, "trxl_num_layers": 3, "reconstruction_coef": 0.1}
    saved(ppo_trxl, env_id="Endless-SearingSpotlights-v0", env_options=options, **window)
    assert enjoy.main(enjoy.Config("model.pt", seed=3, max_steps=100)).startswith("page.html: 100 steps")
    library, longest_look = len(enjoy.get_plotlyjs()), 3 * 256 * 2 * 4 / 3  # three blocks, two bytes, in base64
    assert library + 10 * (os.path.getsize("page.html") - library) + 1000 * longest_look < 15e6


# ---- in a browser ----
@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless Chromium that logs its console."""
    program, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if not program or not driver:
        pytest.skip("no browser: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    flags = "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking"
    flags += " disable-component-update disable-sync disable-dev-shm-usage window-size=1400,1000"
    for flag in (*flags.split(), f"user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
    yield browser
    browser.quit()


@pytest.fixture
def watch(browser, saved, tmp_path_factory):
    """Open the page of a transformer's episode at a step; return what it holds, and its videos' frames.

    In the end there is nothing in the browser's console, and the page has loaded nothing.
    """
    path = tmp_path_factory.getbasetemp() / "watched.html"  # one page for all tests

    def open_page(step):
        if not path.exists():
            saved(ppo_trxl, env_id="MortarMayhem-Grid-v0", trxl_memory_length=128)
            enjoy.main(enjoy.Config("model.pt", seed=3, out=str(path)))
        browser.get("about:blank")  # or the same page at another step would not be loaded anew
        browser.get(f"{path.as_uri()}#{step}")
        page = data_of(path.read_text())
        return page, [frames_of(video) for video in page["videos"]]

    yield open_page
    assert browser.get_log("browser") == []
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0


def step_of(browser):
    return int(browser.find_element("tag name", "output").text.split()[1].strip(","))


def check_step(browser, videos, step):
    """The page says that it is at the step, and every video shows the frame of it, to the pixel."""
    assert step_of(browser) == step
    check_shown(browser, videos, step)


def check_shown(browser, videos, step):
    def is_shown(_):
        urls = browser.execute_script("return [...document.querySelectorAll('canvas')].map(each => each.toDataURL())")
        return all(np.array_equal(picture(url), video[step]) for url, video in zip(urls, videos, strict=True))

    WebDriverWait(browser, 10).until(is_shown)


def place(browser, selector, index):
    """Where the index-th selected part of the page is in the window: left, top, width, height."""
    script = "const box = document.querySelectorAll(arguments[0])[arguments[1]].getBoundingClientRect();"
    return browser.execute_script(script + "return [box.x, box.y, box.width, box.height]", selector, index)


def point(browser, x, y):
    actions = ActionBuilder(browser)
    actions.pointer_action.move_to_location(round(x), round(y))
    actions.perform()


def click(browser, x, y):
    point(browser, x, y)
    ActionChains(browser).click().perform()


def press(browser, *keys):
    ActionChains(browser).send_keys(*keys).perform()


def test_click_on_a_line(browser, watch):
    page, videos = watch(5)
    check_step(browser, videos, 5)
    for line, step in enumerate((31, 12, 40)):
        x, y, width, height = place(browser, "#curves .scatterlayer .js-line", line)
        click(browser, x + width * step / (page["steps"] - 1), y + height / 2)
        check_step(browser, videos, step)


def test_click_on_an_attention_score(browser, watch):
    page, videos = watch(40)
    look = page["attention"]
    scores = np.frombuffer(base64.b64decode(look["scores"]), "<u2").reshape(page["steps"], 2, -1)
    for block, i in ((0, 0), (1, 9)):
        best = np.argsort(-scores[40, block].astype(int))[:16] + 40 - look["items"]
        x, y, width, height = place(browser, "#curves .scatterlayer .points .point", 16 * block + i)
        point(browser, x + width / 2, y + height / 2)
        check_shown(browser, videos, best[i])
        point(browser, 0, 0)
        check_step(browser, videos, 40)
        click(browser, x + width / 2, y + height / 2)
        check_step(browser, videos, best[i])
        press(browser, Keys.HOME)
        ActionChains(browser).key_down(Keys.SHIFT).send_keys(*[Keys.ARROW_RIGHT] * 4).key_up(Keys.SHIFT).perform()
        check_step(browser, videos, 40)


def test_keys(browser, watch):
    page, videos = watch(0)
    press(browser, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    check_step(browser, videos, 2)
    press(browser, Keys.HOME, Keys.ARROW_LEFT)
    check_step(browser, videos, 0)
    press(browser, Keys.END, Keys.ARROW_RIGHT)
    check_step(browser, videos, page["steps"] - 1)
    press(browser, Keys.SPACE)  # plays, from the beginning as it is at the end
    button = browser.find_element("id", "play")
    assert button.text == "Pause"
    WebDriverWait(browser, 10).until(lambda _: 3 <= step_of(browser) < page["steps"] - 1)
    press(browser, Keys.SPACE)
    assert button.text == "Play"
    check_step(browser, videos, step_of(browser))
    button.click()
    assert browser.switch_to.active_element.tag_name == "body"
    press(browser, Keys.SPACE)  # pauses, and does not press the button again
    assert button.text == "Play"
    Select(browser.find_element("tag name", "select")).select_by_value("25")
    press(browser, Keys.HOME, Keys.ARROW_RIGHT)  # of the video, not of the list
    check_step(browser, videos, 1)
    press(browser, Keys.SPACE)
    WebDriverWait(browser, 10).until(lambda _: button.text == "Play")  # stops at the end
    check_step(browser, videos, page["steps"] - 1)


def test_bars_and_numbers_are_those_of_the_step(browser, watch):
    page, _ = watch(7)
    texts = [each.text for each in browser.find_elements("css selector", "#bars .bartext")]
    assert texts == [f"{each:.2f}" for each in page["branches"][0]["probabilities"][7]]
    colors = browser.execute_script(
        "return [...document.querySelectorAll('#bars .point path')].map(bar => bar.style.fill)"
    )
    red, blue = "rgb(200, 85, 61)", "rgb(185, 203, 220)"
    assert colors == [red if action == page["actions"][7][0] else blue for action in range(4)]
    row = browser.find_element("css selector", "#truth tr").text
    assert row == " ".join(["true", *(f"{each:.3f}" for each in page["truth"][7])])


def test_narrow_window(browser, watch):
    watch(3)
    browser.set_window_size(500, 900)
    try:
        fits = "return document.documentElement.scrollWidth <= innerWidth"
        WebDriverWait(browser, 10).until(lambda _: browser.execute_script(fits))
    finally:
        browser.set_window_size(1400, 1000)


# ---- bad input ----
def test_bad_input_is_one_line(saved):
    saved()
    program = os.path.abspath(enjoy.__file__)
    made = subprocess.run([sys.executable, program, "missing.pt"], capture_output=True, text=True)
    assert (made.returncode, made.stdout) == (1, "")
    assert made.stderr == "enjoy.py: there is no file missing.pt; --save-model writes model.pt to the run folder\n"


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"checkpoint": enjoy.__file__}, "enjoy.py is cut short, or neither a model nor a checkpoint"),
        ({"seed": -1}, "--seed is -1; it must be from 0 to 2 ** 63 - 1"),
        ({"max_steps": 0}, "--max-steps is 0; it must be from 1 to 100000"),
        ({"out": "nowhere/page.html"}, "there is no folder nowhere"),
        ({"out": "."}, "directory"),
    ],
)
def test_bad_input(config, message, saved):
    saved()
    with pytest.raises((ValueError, OSError), match=re.escape(message)):
        enjoy.main(enjoy.Config(**{"checkpoint": "model.pt", **config}))
    assert not os.path.exists("page.html")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"env_id": "CueRecall-v0"}, r"enjoy\.py needs .* that draws pictures \(rgb_array\); CueRecall-v0 draws none"),
        ({"env_options": '{"agent_scal": 1}'}, "agent_scal.*agent_scale"),
        ({"obs_type": "vector"}, "holds the weights of another network"),
    ],
)
def test_checkpoint_that_cannot_play(change, message, saved):
    args = saved()
    model = torch.load("model.pt", weights_only=True)
    torch.save({**model, "args": dataclasses.asdict(dataclasses.replace(args, **change))}, "model.pt")
    with pytest.raises(ValueError, match=message):
        enjoy.main(enjoy.Config("model.pt"))


def test_diverged_weights(saved):
    saved()
    model = torch.load("model.pt", weights_only=True)
    model["weights"]["heads.value.2.bias"].fill_(torch.nan)
    torch.save(model, "model.pt")
    with pytest.raises(ValueError, match="holds weights that are not finite: the training diverged"):
        enjoy.main(enjoy.Config("model.pt"))


def test_missing_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    monkeypatch.delitem(sys.modules, "enjoy")
    with pytest.raises(SystemExit, match=re.escape('enjoy.py needs plotly.offline: pip install -e ".[eval]"')):
        importlib.import_module("enjoy")
