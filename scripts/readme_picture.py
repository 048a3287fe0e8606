#!/usr/bin/env python
"""Make README's moving picture: one episode of a trained agent with its live subgoal and the remaining time.

Example::

    python scripts/readme_picture.py results/Drawbridge/model.zip --output docs/images/agent.webp

Writes an animated WebP (or a GIF, by the file's name) of less than --megabytes, coarser in time or size until it fits.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sb3_tbc.evaluate import identify
from sb3_tbc.files import replacing
from sb3_tbc.zoo.algorithms import load_model
from sb3_tbc.zoo.environments import make_env
from sb3_tbc.zoo.video import film, frames_per_second

Frame = NDArray[np.uint8]
WIDTHS = (640, 480, 400, 320)


def frames_of(path: Path, seed: int, trust: bool) -> tuple[list[Frame], float]:
    """The frames of one episode and how many of them make a second."""
    info = identify(path, None)
    env = make_env(info["env_id"], **info["env_kwargs"])
    try:
        return list(film(load_model(path, trust=trust), env, seed)), frames_per_second(env)
    finally:
        env.close()


def animation(frames: list[Frame], kind: str, width: int, milliseconds: float) -> bytes:
    """Encode frames, each shown for a time, at a width in pixels."""
    pictures = [Image.fromarray(frame) for frame in frames]
    if pictures[0].width > width:
        size = width, round(pictures[0].height * width / pictures[0].width)
        pictures = [picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures]
    options = {"quality": 70, "method": 4} if kind == "webp" else {"optimize": True}
    buffer = io.BytesIO()
    pictures[0].save(
        buffer, kind, save_all=True, append_images=pictures[1:], duration=round(milliseconds), loop=0, **options
    )
    return buffer.getvalue()


def fitted(frames: list[Frame], fps: float, kind: str, limit: int, most: int) -> bytes:
    """The finest animation that stays below a limit in bytes and has at most ``most`` frames."""
    for width in WIDTHS:
        stride = max(1, -(-len(frames) // most))
        while len(frames) // stride > 20:
            data = animation([*frames[::stride], frames[-1]], kind, width, 1000.0 * stride / fps)
            if len(data) < limit:
                return data
            stride *= 2
    raise SystemExit(f"no size of the picture stays below {limit} bytes; allow more by --megabytes")


def main() -> None:
    """Make the picture; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, metavar="MODEL.zip", help="a trained agent")
    parser.add_argument("--output", type=Path, required=True, help="a file ending in .webp or .gif")
    parser.add_argument("--seed", type=int, default=0, help="of the episode (default: %(default)s)")
    parser.add_argument("--megabytes", type=float, default=3.0, help="largest size (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=400, help="most frames (default: %(default)s)")
    parser.add_argument("--trust", action="store_true", help="load the agent even if its file can run code")
    args = parser.parse_args()
    kind = args.output.suffix.removeprefix(".")
    if kind not in ("webp", "gif"):
        parser.error(f"--output must end in .webp or .gif, got {args.output}")
    frames, fps = frames_of(args.model, args.seed, args.trust)
    data = fitted(frames, fps, kind, int(args.megabytes * 1e6), args.frames)
    with replacing(args.output) as temporary:
        temporary.write_bytes(data)
    print(f"written: {args.output} ({len(data) / 1e6:.2f} MB, {len(frames)} steps)", file=sys.stderr)


if __name__ == "__main__":
    main()
