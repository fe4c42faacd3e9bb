"""Videos of the first environment while an agent trains."""

import importlib
import warnings
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import RecordVideo

from memory_gym_envs.base import MemoryGymVectorEnv
from memory_gym_envs.saving import Saved
from ppo_utils.environments import creator, find_spec

MAX_VIDEO_FRAMES = 1000


class LaneVideo(Saved, RecordVideo):
    """Videos of lane 0: of the episodes that Gymnasium's capped cubic schedule picks (0, 1, 8, 27, ...).

    env: has been reset; its present episode is number 0. folder: is made if it is not there.
    A video shows every observation that was acted on, up to the first 1,000. What is being recorded is written by
    close(). Its state is the numbers of the episode and the step.
    """

    kept = ("episode_id", "step_id")

    def __init__(self, env: VectorEnv, folder: str):
        with warnings.catch_warnings():
            # That the observation after an episode's last action is missing, and that the folder is there already.
            warnings.simplefilter("ignore")
            super().__init__(env, folder, record_first_only=True)
        self.episode_id = 0
        self.start_recording(f"{self.name_prefix}-episode-0")
        self._capture_frame()

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over the number of the episode, of which the beginning is missing: it has no video."""
        super().set_state(state)
        self.recording, self.recorded_frames = False, []

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], Any, Any, Any, dict[str, Any]]:
        """Step every lane; a video that is long enough ends here."""
        result = super().step(actions)
        if self.recording and len(self.recorded_frames) >= MAX_VIDEO_FRAMES:
            self.stop_recording()
        return result

    def _capture_frame(self) -> None:
        """Keep lane 0's picture; Gymnasium's own method has all lanes draw theirs."""
        envs = self.unwrapped
        if isinstance(envs, MemoryGymVectorEnv):
            (picture,) = envs.render(np.zeros(1, np.intp))
        else:
            picture = envs.envs[0].render() if isinstance(envs, SyncVectorEnv) else envs.render()[0]
        self.recorded_frames.append(picture)


def check_can_film(env_id: str) -> None:
    """Raise ImportError without the extra `play`, ValueError if the environment says that it draws no pictures."""
    try:
        importlib.import_module("moviepy")
    except ImportError:
        raise ImportError('--capture-video needs moviepy: pip install -e ".[play]"') from None
    check_draws("--capture-video", env_id)


def check_draws(what: str, env_id: str) -> None:
    """Raise ValueError, which begins with what needs them, if the environment says that it draws no pictures."""
    spec = find_spec(env_id)
    metadata = getattr(creator(spec.entry_point or spec.vector_entry_point), "metadata", None)
    if metadata is not None and "rgb_array" not in metadata.get("render_modes", ()):
        raise ValueError(f"{what} needs an environment that draws pictures (rgb_array); {spec.id} draws none")
