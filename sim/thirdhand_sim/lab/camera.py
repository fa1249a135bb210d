"""Where a single camera sees hands: rendered hands whose places are known.

It renders the hands of npm's @webxr-input-profiles/assets with three, in a headless Chromium, as a
laptop's camera sees a person's hands in front of it, and finds them by MediaPipe. It needs
`pip install 'thirdhand[camera]'`, Chromium and npm.
"""

from __future__ import annotations

import asyncio
import base64
import io
import itertools
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from aiohttp import web
from PIL import Image
from scipy.spatial.transform import Rotation

from thirdhand.contract.records import SIDES
from thirdhand.workbench.trackers.camera import CameraError, HandCamera, HandPoints, mediapipe
from thirdhand.workbench.trackers.hand_model import HandModelError, hand_model
from thirdhand.workbench.trackers.palm import INDEX, LITTLE, WRIST, Lens, palm_pose, where_seen
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.results import Array, ExperimentError, Options, Results, brief

PACKAGES = {"three": "three@0.187.0", "hands": "@webxr-input-profiles/assets@1.0.20"}
HANDS_IN_PACKAGE = "package/dist/profiles/generic-hand/"
HAND_LENGTH_M = 0.178  # of these hands, from the wrist to the tip of the middle finger
VIEW_DEG, WIDTH_PX, HEIGHT_PX = 56.0, 640, 480
PICTURES, RATE_HZ = 40, 15.0  # of each sequence
DISTANCES_M = (0.4, 0.55, 0.75)
LENS = Lens.of_view(VIEW_DEG, WIDTH_PX, HEIGHT_PX)
SCALES = {"rigid palm, true hand length": 1.0, "5 % too short": 0.95, "5 % too long": 1.05}
BROWSER_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-first-run",
    "--remote-debugging-port=0",  # without one, a headless browser ends when its page is loaded
)
RIVAL = "MediaPipe's own shape"
RENDER_TIMEOUT_S = 900.0


class Frame(NamedTuple):
    """One picture (H, W, 3), its sequence, and the true centres of both palms [m]."""

    sequence: int
    picture: Any
    truth: dict[str, Array]


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers: errors by method, and by the distance of the hands."""
    try:
        mediapipe()
    except CameraError as error:
        raise ExperimentError(str(error)) from None
    stream = EXPERIMENTS["camera"].seeds.evaluation["hands"]
    sequences = list(stream.share(options.share, least=len(DISTANCES_M)))
    with tempfile.TemporaryDirectory() as folder:
        frames = rendered(Path(folder), stream.seed, sequences)
    results.say(f"{len(frames)} pictures of two hands are rendered")
    methods = {name: _by_palm(scale * HAND_LENGTH_M) for name, scale in SCALES.items()}
    errors = _errors(frames, sequences, methods | {RIVAL: _by_shape})
    for name, of_method in errors.items():
        results.say(f"{name}: {brief(_summary(of_method))}")
    ours = errors[next(iter(methods))]
    return {
        "pictures": len(frames),
        "hand_length_m": HAND_LENGTH_M,
        "by_distance_m": {
            f"{distance:g}": _summary({key: one for key, one in ours.items() if _distance(key[0]) == distance})
            for distance in DISTANCES_M
        },
        "methods": {name: _summary(of_method) for name, of_method in errors.items()},
    }


def _by_palm(length: float) -> Callable[[HandPoints], Array | None]:
    """The service's method, with this length of the hand [m]."""

    def position(hand: HandPoints) -> Array | None:
        pose = palm_pose("right", hand.picture, hand.shape, LENS, length)  # its position does not depend on the side
        return None if pose is None else pose.position

    return position


def _by_shape(hand: HandPoints) -> Array:
    """The rival: MediaPipe's own shape of the hand, moved to where the picture shows it."""
    centre: Array = hand.shape[[WRIST, INDEX, LITTLE]].mean(axis=0)
    return centre + where_seen(hand.shape, LENS.rays(hand.picture))


def _distance(sequence: int) -> float:
    return DISTANCES_M[sequence % len(DISTANCES_M)]


def _errors(
    frames: list[Frame], sequences: list[int], methods: Mapping[str, Callable[[HandPoints], Array | None]]
) -> dict[str, dict[tuple[int, str], Array]]:
    """Errors (N, 3) [m] of each method, sequence and hand; NaN where the hand was not found."""
    found = {name: dict[tuple[int, str], Array]() for name in methods}
    try:
        for sequence in sequences:
            pictures = [frame for frame in frames if frame.sequence == sequence]
            with HandCamera(hand_model(None, lambda _: None), view_deg=VIEW_DEG, hand_length=HAND_LENGTH_M) as camera:
                seen = [camera.hands(frame.picture, int(1000 * k / RATE_HZ)) for k, frame in enumerate(pictures)]
            for (name, method), side in itertools.product(methods.items(), SIDES):
                at = [method(hands[side]) if side in hands else None for hands in seen]
                rows = [
                    np.full(3, np.nan) if position is None else position - frame.truth[side]
                    for frame, position in zip(pictures, at, strict=True)
                ]
                found[name][sequence, side] = np.array(rows)
    except (CameraError, HandModelError) as error:
        raise ExperimentError(str(error)) from None
    return found


def _summary(errors: dict[tuple[int, str], Array]) -> dict[str, Any]:
    """Errors in mm: whole, of depth, and about each sequence's own mean, which calibration takes
    away.
    """
    whole = np.concatenate(list(errors.values()))
    seen = ~np.isnan(whole[:, 0])
    about = np.concatenate([one - np.nanmedian(one, axis=0) for one in errors.values()])[seen]
    sizes, own = (1000 * np.linalg.norm(one, axis=1) for one in (whole[seen], about))
    return {
        "found_percent": 100 * float(seen.mean()),
        "median_mm": float(np.median(sizes)),
        "p95_mm": float(np.percentile(sizes, 95)),
        "worst_mm": float(sizes.max()),
        "depth_mm": float(1000 * np.median(whole[seen, 2])),
        "sideways_mm": float(1000 * np.median(np.hypot(whole[seen, 0], whole[seen, 1]))),
        "about_own_mean_median_mm": float(np.median(own)),
        "about_own_mean_p95_mm": float(np.percentile(own, 95)),
    }


def rendered(folder: Path, seed: int, sequences: list[int]) -> list[Frame]:
    """Pictures of hands that move as in front of a laptop. Raises ExperimentError."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None or shutil.which("npm") is None:
        raise ExperimentError("the hands are rendered by Chromium, and come from npm: install chromium and npm")
    for name, package in PACKAGES.items():
        subprocess.run(["npm", "pack", "--silent", package], cwd=folder, check=True, timeout=RENDER_TIMEOUT_S)
        (file,) = folder.glob("*.tgz")
        with tarfile.open(file) as archive:
            archive.extractall(folder / name, filter="data")
        file.unlink()
    wanted = [(sequence, frame) for sequence in sequences for frame in _poses(seed, sequence)]
    got = asyncio.run(_drawn(folder, chromium, [frame for _, frame in wanted]))
    return [
        Frame(
            sequence,
            np.asarray(Image.open(io.BytesIO(base64.b64decode(one["jpeg"].split(",")[1]))).convert("RGB")),
            {side: np.array(centre) for side, centre in one["truth"].items()},
        )
        for (sequence, _), one in zip(wanted, got, strict=True)
    ]


def _poses(seed: int, sequence: int) -> Iterator[dict[str, list[float]]]:
    """Centre [m] and quaternion of both palms in the camera's frame: fingers up, palms or backs to
    the camera, turned by up to 30° or so about each axis.
    """
    rng = np.random.default_rng([seed, sequence])
    distance, facing = _distance(sequence), rng.choice((-1.0, 1.0))
    frequency, phase = rng.uniform(0.05, 0.35, (2, 2, 3, 3)), rng.uniform(0, 2 * np.pi, (2, 2, 3, 3))
    for k in range(PICTURES):
        frame = {}
        for i, side in enumerate(SIDES):
            outward = 2.0 * i - 1.0  # the right hand is at the right of the picture
            swing = 1.6 * np.sin(2 * np.pi * frequency[i] * k / RATE_HZ + phase[i]).mean(axis=-1)
            centre = np.array([0.17 * outward * distance**0.5, 0.0, distance]) + [0.06, 0.05, 0.07] * swing[0]
            x, y = np.array([0.0, -1.0, 0.0]), np.array([-outward * facing, 0.0, 0.0])
            turn = Rotation.from_rotvec(np.radians(28.0) * swing[1]) * Rotation.from_matrix(
                np.stack([x, y, np.cross(x, y)], 1)
            )
            frame[side] = [*centre.tolist(), *turn.as_quat().tolist()]
        yield frame


async def _drawn(folder: Path, chromium: str, frames: list[dict[str, list[float]]]) -> list[dict[str, Any]]:
    """The page's posts, one for each frame. Raises ExperimentError."""
    got, done = list[dict[str, Any]](), asyncio.Event()

    async def page(_: web.Request) -> web.FileResponse:
        return web.FileResponse(Path(__file__).with_name("rendered_hands.html"))

    async def poses(_: web.Request) -> web.Response:
        return web.json_response({"width": WIDTH_PX, "height": HEIGHT_PX, "focal": LENS.focal, "frames": frames})

    async def picture(request: web.Request) -> web.Response:
        got.append(await request.json())
        return web.Response()

    async def end(_: web.Request) -> web.Response:
        done.set()
        return web.Response()

    application = web.Application(client_max_size=2**22)
    application.add_routes([web.get("/", page), web.get("/poses", poses), web.post("/picture", picture)])
    application.add_routes([web.post("/done", end), web.static("/three", folder / "three" / "package")])
    application.add_routes([web.static("/hands", folder / "hands" / HANDS_IN_PACKAGE)])
    runner = web.AppRunner(application, access_log=None)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    port = runner.addresses[0][1]
    browser = await asyncio.create_subprocess_exec(
        chromium,
        *BROWSER_OPTIONS,
        f"--user-data-dir={folder / 'profile'}",
        f"http://127.0.0.1:{port}/",
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        async with asyncio.timeout(RENDER_TIMEOUT_S):
            await done.wait()
    except TimeoutError:
        raise ExperimentError(f"Chromium drew {len(got)} of {len(frames)} pictures in {RENDER_TIMEOUT_S:g} s") from None
    finally:
        browser.terminate()
        await browser.wait()
        await runner.cleanup()
    return got
