"""Videos of the first environment while an agent trains."""

import importlib
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv, VectorWrapper

from memory_gym_envs.base import MemoryGymVectorEnv
from memory_gym_envs.options import brief
from memory_gym_envs.saving import Saved
from ppo_utils.environments import find_spec
from ppo_utils.lanes import creator
from ppo_utils.terminal import tell

MAX_VIDEO_FRAMES = 1000


class LaneVideo(Saved, VectorWrapper):
    """Videos of lane 0: of episodes 0, 1, 8, 27, ..., all cubes up to 1,000, then every thousandth.

    env: its present episode is number 0. folder: is made with the first video.
    A video shows every observation that was acted on, one frame each, up to the first 1,000. One that cannot be written
    costs itself and a line on stderr, never the run. Its state is the number of the episode.
    """

    kept = ("episode",)

    def __init__(self, env: VectorEnv, folder: str):
        super().__init__(env)
        self.folder, self.episode, self.frames, self.recording = Path(folder), 0, 0, True
        self.fps = float(env.metadata.get("render_fps") or 30)
        self.writer: Generator | None = None  # takes frames, from an episode's first one on

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over the number of the episode, of which the beginning is missing: it has no video."""
        super().set_state(state)
        self._end()

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], Any, Any, Any, dict[str, Any]]:
        """Film what lane 0 acts on, and step every lane."""
        if self.recording:
            self._film()
        result = self.env.step(actions)
        _, _, terminated, truncated, _ = result
        if terminated[0] or truncated[0]:
            self._end()
            self.episode, self.frames = self.episode + 1, 0
            is_cube = round(self.episode ** (1 / 3)) ** 3 == self.episode
            self.recording = is_cube if self.episode < 1000 else self.episode % 1000 == 0
        return result

    def close(self, **kwargs: Any) -> None:
        """Close the video that is being recorded, and the environments."""
        self._end()
        super().close(**kwargs)

    def _film(self) -> None:
        """Write lane 0's image; lanes that are processes all draw theirs."""
        envs = self.unwrapped
        try:
            if isinstance(envs, MemoryGymVectorEnv):
                (frame,) = envs.render(np.zeros(1, np.intp))
            else:
                frame = envs.envs[0].render() if isinstance(envs, SyncVectorEnv) else envs.render()[0]
            image = as_image(frame)
            if self.writer is None:
                self.folder.mkdir(parents=True, exist_ok=True)
                self.writer = video_writer(self.folder / f"episode-{self.episode}.mp4", image.shape, self.fps)
                self.shape = image.shape
            if image.shape != self.shape:
                raise ValueError(f"its images change their size, from {self.shape} to {image.shape}")
            self.writer.send(even(image))
            self.frames += 1
            if self.frames == MAX_VIDEO_FRAMES:
                self._end()
        except Exception as error:  # of the environment, ffmpeg or the disk
            self._end()
            what = " ".join(str(error).split()) or repr(error)
            tell(f"the video of episode {self.episode} ends after {self.frames} frames: {what}")

    def _end(self) -> None:
        writer, self.writer, self.recording = self.writer, None, False
        if writer is not None:
            writer.close()


def video_writer(path: Path, shape: tuple[int, ...], fps: float) -> Generator:
    """Return what takes images of this shape, made `even`, and writes each as a frame of an H.264 video."""
    imageio_ffmpeg = importlib.import_module("imageio_ffmpeg")  # of the extra `play`
    size = tuple(side + side % 2 for side in (shape[1], shape[0]))
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=fps, macro_block_size=1, ffmpeg_log_level="error")
    writer.send(None)
    return writer


def even(image: np.ndarray) -> np.ndarray:
    """Return an image (H, W, 3) with even height and width, as H.264 needs: the last row and column are repeated."""
    height, width, _ = image.shape
    return np.ascontiguousarray(np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))


def as_image(frame: Any) -> np.ndarray:
    """Return a rendered frame as bytes (H, W, 3): of bytes or of floats from 0 to 1, gray or in color, of a list too.

    Raises ValueError for what is no image.
    """
    image = np.asarray(frame) if frame is not None else np.zeros(0)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4) or 0 in image.shape or image.dtype.kind not in "biuf":
        raise ValueError(f"render() returned no image (height, width, 3), but {brief(frame)}")
    if image.dtype.kind in "bf" and image.max() <= 1:
        image = image * 255.0
    image = np.clip(np.nan_to_num(image), 0, 255).astype(np.uint8)
    return np.repeat(image, 3, 2) if image.shape[2] == 1 else image[..., :3]


def check_can_film(env_id: str) -> None:
    """Raise ImportError without the extra `play`, ValueError if the environment says that it draws no images."""
    try:
        importlib.import_module("imageio_ffmpeg")
    except ImportError:
        raise ImportError('--capture-video needs imageio-ffmpeg: pip install -e ".[play]"') from None
    check_draws("--capture-video", env_id)


def check_draws(what: str, env_id: str) -> None:
    """Raise ValueError, which begins with what needs them, if the environment says that it draws no images."""
    spec = find_spec(env_id)
    metadata = getattr(creator(spec.entry_point or spec.vector_entry_point), "metadata", None)
    if metadata is not None and "rgb_array" not in metadata.get("render_modes", ()):
        raise ValueError(f"{what} needs an environment that draws images (rgb_array); {spec.id} draws none")
