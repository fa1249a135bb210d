"""Images of recordings as videos of a LeRobot data set: an image for each of its rows."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thirdhand.contract.images import CompressedImage
from thirdhand.process.progress import say
from thirdhand.recordings.recording import Recording

CODEC = "h264"
PIXELS = "yuv420p"
# a key frame at every second picture, as training reads at random
OPTIONS = {
    "g": "2",
    "crf": "23",
}
SAMPLED = 10  # the statistics are those of one picture in this number


class CameraRows(NamedTuple):
    """An episode's recording, and the times (N,) [ns] of its rows."""

    recording: Recording
    times_ns: NDArray[np.int64]


class _Video:
    """The MP4 file of one camera, with sampled pixels (P, 3) of each episode."""

    def __init__(self, path: Path, fps: int) -> None:
        import av  # an extra, as its libraries are large

        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.fps = fps
        self.sampled = list[list[NDArray[np.float64]]]()
        self.has_damaged = False
        self.container = av.open(path, "w")
        self._encoded = av.VideoFrame.from_image
        self._stream: Any = self.container.add_stream(CODEC, rate=fps, options=OPTIONS)
        self._stream.pix_fmt = PIXELS
        self._stream.time_base = Fraction(1, fps)
        self._size: tuple[int, int] | None = None

    def begin(self, episodes: Sequence[CameraRows]) -> None:
        """Begin a recording with these episodes, whose images follow."""
        self.rows = [
            (time_ns, i)
            for episode in episodes
            for i, time_ns in enumerate(episode.times_ns.tolist())
        ][::-1]
        self._newest: CompressedImage | None = None
        self._picture: Image.Image | None = None  # the last one that could be decoded

    def show(self, image: CompressedImage | None, at_ns: float) -> None:
        """Write the rows before an image's time with the image before it, else with itself; None
        ends the recording. In place of an image that cannot be decoded, the one before it is
        written, or else the next one.
        """
        newest = self._newest or image
        picture = None
        if newest is not None and self.rows and self.rows[-1][0] < at_ns:
            picture = _opened(newest.data)
            self.has_damaged = self.has_damaged or picture is None
            self._picture = picture = picture or self._picture
        while picture is not None and self.rows and self.rows[-1][0] < at_ns:
            self._write(picture, self.rows.pop()[1])
        self._newest = image

    def _write(self, picture: Image.Image, row: int) -> None:
        if self._size is None:
            # even, for the colours
            self._size = (max(2, picture.width // 2 * 2), max(2, picture.height // 2 * 2))
            self._stream.width, self._stream.height = self._size
        frame = picture if picture.size == self._size else picture.resize(self._size)
        if row == 0:
            self.sampled.append([])
        if row % SAMPLED == 0:
            self.sampled[-1].append(
                np.asarray(frame, np.float64).reshape(-1, 3)[:: SAMPLED**2] / 255
            )
        self.container.mux(self._stream.encode(self._encoded(frame)))

    def feature(self) -> dict[str, Any]:
        """End the stream; the feature of the data set's description."""
        self.container.mux(self._stream.encode(None))
        assert self._size is not None
        width, height = self._size
        about = {
            "height": height,
            "width": width,
            "channels": 3,
            "codec": CODEC,
            "pix_fmt": PIXELS,
            "fps": self.fps,
        }
        info = {f"video.{name}": value for name, value in about.items()}
        info |= {"video.is_depth_map": False, "has_audio": False}
        return {
            "dtype": "video",
            "shape": (height, width, 3),
            "names": ["height", "width", "channels"],
            "info": info,
        }


def _opened(file: bytes) -> Image.Image | None:
    """The picture in a file; None if it is damaged."""
    try:
        image: Image.Image = Image.open(io.BytesIO(file))
        if image.mode.startswith("I"):  # a grey picture of 16 bits
            image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
        return image.convert("RGB")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None


def write_videos(  # noqa: C901 - one pass over a video
    episodes: Sequence[CameraRows], path_of: Callable[[str], Path], *, fps: int
) -> dict[str, tuple[dict[str, Any], list[Any]]]:
    """Write a video of each camera that all recordings have, reading each recording once.

    Return, by key, the feature of the data set's description, and sampled pixels of each episode.
    """
    videos: dict[str, _Video] = {}
    with contextlib.ExitStack() as closing:
        for number, (_, group) in enumerate(
            itertools.groupby(episodes, lambda one: id(one.recording))
        ):
            parts = list(group)
            begun_keys = set[str]()
            for key, image, at_ns in parts[0].recording.images():
                if number == 0 and key not in videos:
                    videos[key] = _Video(path_of(key), fps)
                    closing.enter_context(videos[key].container)
                if key in videos:
                    if key not in begun_keys:
                        begun_keys.add(key)
                        videos[key].begin(parts)
                    videos[key].show(image, at_ns)
            for key in begun_keys:
                videos[key].show(None, math.inf)
            for key in [key for key in videos if key not in begun_keys or videos[key].rows]:
                video = videos.pop(key)
                video.container.close()
                video.path.unlink(missing_ok=True)
                if video.has_damaged:
                    say(f"images of {key} cannot be decoded; it has no video")
        for key, video in videos.items():
            if video.has_damaged:
                say(
                    f"images of {key} cannot be decoded; in their place, its video has those "
                    "beside them"
                )
        return {key: (video.feature(), video.sampled) for key, video in sorted(videos.items())}
