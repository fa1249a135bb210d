"""Images of recordings as videos of a LeRobot data set: an image for each of its rows."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from service.contract.explain import ExplainedError, in_words
from service.files.recording import Recording

CODEC, PIXELS = "h264", "yuv420p"
OPTIONS = {"g": "2", "crf": "23"}  # a key frame at every second picture, as training reads at random
SAMPLED = 10  # the statistics are those of one picture in this number


class CameraRows(NamedTuple):
    """An episode's recording, and the times (N,) [ns] of its rows."""

    recording: Recording
    times_ns: NDArray[np.int64]


def cameras(recordings: Sequence[Recording]) -> list[str]:
    """The keys of the images that all recordings hold."""
    found = [{key for key, *_ in recording.images()} for recording in recordings]
    return sorted(set.intersection(*found)) if found else []


def pictures(rows: CameraRows, key: str) -> Iterator[Image.Image]:
    """For each row the newest image of a camera at its time, else the first one."""
    images = ((image, at_ns) for name, image, at_ns in rows.recording.images() if name == key)
    now, after = next(images), next(images, None)
    shown = _opened(now[0].data)
    for time_ns in rows.times_ns.tolist():
        before = now
        while after is not None and after[1] <= time_ns:
            now, after = after, next(images, None)
        if now is not before:
            shown = _opened(now[0].data)
        yield shown


def _opened(file: bytes) -> Image.Image:
    try:
        return Image.open(io.BytesIO(file)).convert("RGB")
    except OSError as error:
        raise ExplainedError(f"an image of the recording cannot be decoded: {in_words(error)}") from None


def write_video(path: Path, episodes: Sequence[CameraRows], key: str, *, fps: int) -> tuple[dict[str, Any], list[Any]]:
    """Write the pictures of a camera in all episodes to one MP4 file. Return the feature of the
    data set's description, and the statistics of each episode. Raises ExplainedError without PyAV.
    """
    try:
        import av  # an extra, as its libraries are large
    except ImportError:
        raise ExplainedError(f"images of {key} need PyAV for a video: pip install 'thirdhand[video]'") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    size: tuple[int, int] | None = None
    statistics = []
    with av.open(path, "w") as container:
        stream: Any = container.add_stream(CODEC, rate=fps, options=OPTIONS)
        stream.pix_fmt, stream.time_base = PIXELS, Fraction(1, fps)
        for rows in episodes:
            sampled = []
            for i, picture in enumerate(pictures(rows, key)):
                if size is None:
                    size = picture.width // 2 * 2, picture.height // 2 * 2  # even, as the colours need it
                    stream.width, stream.height = size
                shown = picture if picture.size == size else picture.resize(size)
                if i % SAMPLED == 0:
                    sampled.append(np.asarray(shown, np.float64).reshape(-1, 3)[:: SAMPLED**2] / 255)
                container.mux(stream.encode(av.VideoFrame.from_image(shown)))
            statistics.append(sampled)
        container.mux(stream.encode(None))
    assert size is not None
    about = {"height": size[1], "width": size[0], "channels": 3, "codec": CODEC, "pix_fmt": PIXELS, "fps": fps}
    info = {f"video.{name}": value for name, value in about.items()} | {"video.is_depth_map": False, "has_audio": False}
    names = ["height", "width", "channels"]
    return {"dtype": "video", "shape": (size[1], size[0], 3), "names": names, "info": info}, statistics
