"""Picture files: PNG and JPEG, animated WebP and GIF by Pillow, mp4 by ffmpeg; without Pillow, plain PNG."""

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

from warpflag.base.output import OutputError, missing, whole

__all__ = ["ANIMATIONS", "PICTURES", "check_rate", "check_writable", "write_animation", "write_picture"]

Picture = NDArray[np.uint8]
"""sRGB, shape [height, width, 3]."""
PICTURES = (".png", ".jpg", ".jpeg")
ANIMATIONS = (".webp", ".gif", ".mp4")

_FASTEST_GIF = 50.0  # pictures per second: browsers show a delay of one hundredth of a second as ten


def write_picture(path: Path, picture: Picture) -> None:
    """Writes a picture in the format of the path's ending; the file is whole or absent.

    Raises:
        OutputError: the package for this ending is missing.
    """
    with whole(path) as temporary:
        try:
            image = _pillow(path.suffix)
        except OutputError:
            if path.suffix != ".png":
                raise
            _write_plain_png(temporary, picture)
        else:
            image.fromarray(picture).save(temporary, **({} if path.suffix == ".png" else {"quality": 92}))


def _write_plain_png(path: Path, picture: Picture) -> None:
    """Writes a PNG with the standard library, its rows unfiltered: larger than Pillow's, and the same pixels."""
    height, width = picture.shape[:2]
    rows = np.hstack([np.zeros((height, 1), np.uint8), picture.reshape(height, -1)])
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows.tobytes(), 6)),
        (b"IEND", b""),
    )
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, data in chunks:
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))


def check_writable(path: Path) -> None:
    """Checks that pictures or films of the path's ending can be written.

    Raises:
        OutputError: they can't; it says what to install.
    """
    if path.suffix == ".mp4":
        _ffmpeg()
    elif path.suffix in ANIMATIONS or path.suffix in PICTURES[1:]:
        _pillow(path.suffix)
    elif path.suffix != ".png":
        raise OutputError(f"{path}: a picture must end in {', '.join(PICTURES)}, a film in {', '.join(ANIMATIONS)}")


def check_rate(path: Path, rate: float) -> None:
    """Checks that a film of the path's ending can show so many pictures per second.

    Raises:
        OutputError: it can't.
    """
    if path.suffix == ".gif" and rate > _FASTEST_GIF:
        raise OutputError(f"{path}: a GIF shows at most {_FASTEST_GIF:g} pictures per second, not {rate:g}")


def write_animation(path: Path, pictures: Iterator[Picture], count: int, rate: float) -> None:
    """Writes a film; WebP and GIF repeat it for ever. The file is whole or absent.

    Args:
        path: its ending says the format.
        pictures: all of the same shape; they are taken one at a time, as they are needed.
        count: how many there are.
        rate: pictures per second.

    Raises:
        OutputError: the program or package for this ending is missing, or the format has no such rate.
        OSError: it fails.
    """
    check_rate(path, rate)
    with whole(path) as temporary:
        if path.suffix == ".mp4":
            _write_mp4(temporary, pictures, rate)
        else:
            # Every picture whole: differences between lossy pictures leave smudges on a plain background.
            options = {"quality": 90, "method": 4, "kmin": 0, "kmax": 1} if path.suffix == ".webp" else {}
            reel = _reel(_pillow(path.suffix), pictures, count)
            reel.save(temporary, save_all=True, duration=_delays(path.suffix, count, rate), loop=0, **options)


def _delays(suffix: str, count: int, rate: float) -> list[int]:
    """How long each picture stands [ms], in the steps that the format has, so that the whole keeps its length."""
    step = 10 if suffix == ".gif" else 1
    ends = np.rint(1e3 / step / rate * np.arange(count + 1)).astype(int) * step
    return np.diff(ends).tolist()


def _pillow(suffix: str) -> Any:
    """Pillow's Image module."""
    try:
        from PIL import Image, features
    except ImportError:
        raise OutputError(f"{suffix} needs the package Pillow: {missing('Pillow', 'render')}") from None
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
    """Path of the program ffmpeg."""
    found = shutil.which("ffmpeg")
    if found:
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise OutputError(f".mp4 needs ffmpeg on the PATH, or {missing('imageio-ffmpeg', 'render')}") from None
    return get_ffmpeg_exe()


def _write_mp4(path: Path, pictures: Iterator[Picture], rate: float) -> None:
    first = next(pictures)
    height, width = first.shape[:2]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{rate:.6f}", "-i", "-"]
    # Widely played: H.264 in 4:2:0, which takes even sizes only.
    coding = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18"]
    command = [_ffmpeg(), "-loglevel", "error", "-y", *source, *coding, "-movflags", "+faststart", str(path)]
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=output)
        assert process.stdin is not None
        try:
            for picture in (first, *pictures):
                process.stdin.write(picture.tobytes())
        except BrokenPipeError:
            pass  # its exit status and its error output tell why
        finally:
            process.stdin.close()
            status = process.wait()
        if status != 0:
            output.seek(0)
            raise OSError(f"{path}: ffmpeg failed: {' '.join(output.read().decode(errors='replace').split())}")
