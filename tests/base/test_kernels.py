"""Kernels are found before they run, compiled together, and what is compiled is said."""

from __future__ import annotations

import io
import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from tests.helpers import cell
from warpflag.base.device import find_device
from warpflag.base.kernel_cache import keep_checksums, remove_damaged
from warpflag.base.kernels import load_kernels, noted_launches
from warpflag.run.simulation import Simulation

ROOT = Path(__file__).parents[2]
_NUMBER = itertools.count()


class Screen(io.StringIO):
    def isatty(self):
        return True


def two_kernels():
    """Kernels in modules of their own, and what launches them: the second under a condition that is not met."""

    def made():
        module = wp.get_module(f"tests.base.{next(_NUMBER)}")  # one that no other test has loaded
        module.options["enable_backward"] = False

        @wp.kernel(module=module)
        def fill(
            # Out:
            values: wp.array(dtype=wp.int32),
        ):
            values[wp.tid()] = 7

        return fill

    first, second = made(), made()
    values = wp.zeros(3, dtype=wp.int32, device="cpu")

    def launch() -> None:
        wp.launch(first, 3, inputs=[values], device="cpu")
        wp.capture_if(values[:1], lambda: wp.launch(second, 3, inputs=[values], device="cpu"))

    return {first, second}, values, launch


def test_noted_launches_are_not_made():
    both, values, launch = two_kernels()
    with noted_launches() as noted:
        launch()
    assert {kernel for kernel, _ in noted} == both and not values.numpy().any()
    launch()
    assert (values.numpy() == 7).all()


@pytest.mark.parametrize("stream", [Screen, io.StringIO])
def test_what_is_compiled_is_said_once(stream, tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "60")
    said = stream()
    monkeypatch.setattr("sys.stderr", said)
    _, values, launch = two_kernels()
    assert load_kernels(launch, find_device("cpu"), explained_after=0.0) > 0.0
    assert len(list(tmp_path.iterdir())) == 2 and not values.numpy().any()
    lines = [line.rpartition("\r")[2] for line in said.getvalue().removesuffix("\n").split("\n")]
    assert lines[0].startswith("warpflag: compiling 2 modules of kernels, once") and str(tmp_path) in lines[0]
    shown = [line for line in lines[1:] if line.startswith("compiling kernels, 2 of 2")]
    assert len(shown) == (stream is Screen) and len(lines) == 1 + len(shown)
    assert load_kernels(launch, find_device("cpu"), explained_after=0.0) == 0.0  # from the cache
    assert said.getvalue().count("modules of kernels") == 1


def test_quiet_says_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    load_kernels(two_kernels()[2], find_device("cpu"), quiet=True, explained_after=0.0)
    assert len(list(tmp_path.iterdir())) == 2 and capfd.readouterr() == ("", "")


RUN = """
from warpflag.base.device import find_device, start_warp
from warpflag.base.kernels import load_kernels

wp = start_warp()

@wp.kernel(enable_backward=False, module="unique")
def fill(
    # Out:
    values: wp.array(dtype=wp.int32),
):
    values[wp.tid()] = 7

values = wp.zeros(3, dtype=wp.int32, device="cpu")
launch = lambda: wp.launch(fill, 3, inputs=[values], device="cpu")
compiling = load_kernels(launch, find_device("cpu"))
launch()
print(values.numpy().tolist(), compiling > 0.0)
"""


def test_a_damaged_file_of_the_kernel_cache_is_compiled_again(tmp_path):
    script, cache = tmp_path / "run.py", tmp_path / "cache"
    script.write_text(RUN)

    def run(anew):
        own = {**os.environ, "WARP_CACHE_PATH": str(cache)}
        ended = subprocess.run([sys.executable, str(script)], cwd=ROOT, env=own, capture_output=True, text=True)
        assert ended.returncode == 0 and ended.stdout == f"[7, 7, 7] {anew}\n", ended.stderr
        return [line for line in ended.stderr.splitlines() if "compiling" not in line]

    assert run(anew=True) == []
    (compiled,) = cache.rglob("*.o")
    content = bytearray(compiled.read_bytes())
    content[len(content) // 2] ^= 4
    compiled.write_bytes(content)
    (said,) = run(anew=True)
    assert "damaged" in said and str(cache) in said
    assert compiled.read_bytes() != content and run(anew=False) == []


@pytest.mark.parametrize("suffix", [".o", ".cubin", ".ptx", ".meta", ".o.crc32"])
@pytest.mark.parametrize("content", [b"", b"0", b"compile", b"complied", b"\xff\xfe"])
def test_whatever_changed_since_it_was_loaded_is_removed(suffix, content, tmp_path):
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
        for kind in (".o", ".cubin", ".ptx", ".meta", ".cpp"):
            (folder / f"module{kind}").write_bytes(b"compiled")
    keep_checksums([*folders, tmp_path / "not there"])
    assert remove_damaged([*folders, tmp_path / "not there"]) == []
    (folders[0] / f"module{suffix}").write_bytes(content)
    assert remove_damaged(folders) == [folders[0]]
    assert [path.name for path in folders[0].iterdir()] == ["module.cpp"]
    assert len(list(folders[1].iterdir())) == 9


def test_a_cache_that_cannot_be_written_is_used_as_it_is(tmp_path, monkeypatch):
    (tmp_path / "module.o").write_bytes(b"compiled")

    def refuse(*_arguments, **_options):
        raise PermissionError

    monkeypatch.setattr(Path, "write_text", refuse)
    keep_checksums([tmp_path])
    assert remove_damaged([tmp_path]) == []
    assert [path.name for path in tmp_path.iterdir()] == ["module.o"]


@pytest.mark.parametrize(
    "values",
    [
        {"numerics.stepper": "implicit"},
        {"numerics.stepper": "implicit", "flagella.count": 3, "hydrodynamics.mode": "consistent"},
        {"numerics.stepper": "rkc"},
        {"numerics.stepper": "implicit", "fluid.temperature": 300.0},
    ],
)
def test_a_run_launches_no_kernel_that_was_not_loaded_before(values, monkeypatch):
    loaded, late, launch = set(), set(), wp.launch
    simulation = Simulation(cell({"duration": 2e-5, "frames": 3, **values}), device="cpu", capture=False)
    with monkeypatch.context() as patch:
        patch.setattr(wp, "force_load", lambda _device, modules, *_: loaded.update(modules))
        simulation.prepare(recording=True)

    def spied(kernel, *arguments, **options):
        if kernel.module not in loaded:
            late.add(kernel.key)
        launch(kernel, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", spied)
        frames = list(simulation.cell_frames())
    assert len(frames) == 4 and len(loaded) > 10 and not late
