"""Picture files: PNG by the standard library, animated WebP and GIF by Pillow, mp4 by ffmpeg."""

from __future__ import annotations

import shutil
import struct
import subprocess
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.base.output import OutputError, whole

__all__ = ["ANIMATIONS", "check_writable", "write_animation", "write_png"]

Picture = NDArray[np.uint8]

ANIMATIONS = (".webp", ".gif", ".mp4")


def write_png(path: Path, picture: Picture) -> None:
    """Writes a picture, shape [height, width, 3]."""
    height, width = picture.shape[:2]
    raw = picture.astype(np.int16)
    left, above, corner = np.zeros_like(raw), np.zeros_like(raw), np.zeros_like(raw)
    left[:, 1:], above[1:], corner[1:, 1:] = raw[:, :-1], raw[:-1], raw[:-1, :-1]
    guess = left + above - corner
    to_left, to_above, to_corner = (abs(guess - other) for other in (left, above, corner))
    paeth = np.where(
        (to_left <= to_above) & (to_left <= to_corner), left, np.where(to_above <= to_corner, above, corner)
    )
    filters = (0, 1, 2, 4)
    rests = np.stack([(raw - base).astype(np.uint8).reshape(height, -1) for base in (0, left, above, paeth)])
    # The usual choice per row: the filter that leaves the smallest rests.
    chosen = abs(rests.view(np.int8).astype(np.int32)).sum(axis=2).argmin(axis=0)
    rows = np.hstack([np.take(filters, chosen)[:, None].astype(np.uint8), rests[chosen, np.arange(height)]])
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"sRGB", b"\0"),
        (b"IDAT", zlib.compress(rows.tobytes(), 6)),
        (b"IEND", b""),
    )
    with whole(path) as temporary, temporary.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, data in chunks:
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))


def check_writable(path: Path) -> None:
    """Raises OutputError where nothing here writes pictures or animations of that ending."""
    if path.suffix == ".mp4":
        _ffmpeg()
    elif path.suffix in ANIMATIONS:
        _pillow(path.suffix)
    elif path.suffix != ".png":
        raise OutputError(f"{path}: a picture must end in .png, a film in {', '.join(ANIMATIONS)}")


def write_animation(path: Path, pictures: Iterator[Picture], count: int, seconds: float) -> None:
    """Writes a film of `count` pictures, shape [height, width, 3], that stand for `seconds` each.

    WebP and GIF repeat it for ever. Pictures are taken one at a time, as they are needed. Raises OutputError where
    the program or package for this ending is missing, OSError where it fails.
    """
    with whole(path) as temporary:
        if path.suffix == ".mp4":
            _write_mp4(temporary, pictures, seconds)
        else:
            # Every picture whole: differences between lossy pictures leave smudges on a plain background.
            options = {"quality": 90, "method": 4, "kmin": 0, "kmax": 1} if path.suffix == ".webp" else {}
            reel = _reel(_pillow(path.suffix), pictures, count)
            reel.save(temporary, save_all=True, duration=1e3 * seconds, loop=0, **options)


def _pillow(suffix: str) -> Any:
    """Pillow's Image module."""
    try:
        from PIL import Image, features
    except ImportError:
        raise OutputError(f"{suffix} needs the package Pillow: pip install 'warpflag[render]'") from None
    if suffix == ".webp" and not features.check("webp"):
        raise OutputError(".webp needs a Pillow with WebP")
    return Image


def _reel(image: Any, pictures: Iterator[Picture], count: int) -> Any:
    """An image of many frames that draws the next one when it is asked to go on: Pillow keeps none of them."""

    class Reel(image.Image):
        n_frames = count
        position = 0

        def tell(self) -> int:
            return self.position

        def seek(self, frame: int) -> None:
            if frame >= count:
                raise EOFError("no more frames")
            if frame == self.position + 1:
                self.paste(image.fromarray(next(pictures)))
                self.position = frame

    reel = image.fromarray(next(pictures))
    reel.__class__ = Reel
    return reel


def _ffmpeg() -> str:
    found = shutil.which("ffmpeg")
    if found:
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise OutputError(".mp4 needs ffmpeg on the PATH, or pip install 'warpflag[render]'") from None
    return get_ffmpeg_exe()


def _write_mp4(path: Path, pictures: Iterator[Picture], seconds: float) -> None:
    first = next(pictures)
    height, width = first.shape[:2]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{1 / seconds:.6f}", "-i", "-"]
    # Widely played: H.264 in 4:2:0, which takes even sizes only.
    coding = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18"]
    command = [_ffmpeg(), "-loglevel", "error", "-y", *source, *coding, "-movflags", "+faststart", str(path)]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=said)
        assert process.stdin is not None
        try:
            for picture in (first, *pictures):
                process.stdin.write(picture.tobytes())
        except BrokenPipeError:
            pass  # its status and its words tell why
        finally:
            process.stdin.close()
            status = process.wait()
        if status != 0:
            said.seek(0)
            raise OSError(f"{path}: ffmpeg failed: {' '.join(said.read().decode(errors='replace').split())}")
