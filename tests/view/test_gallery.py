"""The gallery is made by its script, and what it links to is there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def links_of(text: str) -> list[str]:
    return re.findall(r"\]\((gallery/[^)]+)\)", text)


def test_everything_in_the_gallery_is_there():
    linked = links_of((ROOT / "docs" / "gallery.md").read_text(encoding="utf-8"))
    assert len(linked) > 15
    assert sorted(linked) == sorted(f"gallery/{path.name}" for path in (ROOT / "docs" / "gallery").iterdir())


def test_the_script_makes_an_entry(tmp_path):
    for package in ("matplotlib", "PIL"):
        pytest.importorskip(package)
    script = [sys.executable, str(ROOT / "examples" / "gallery.py"), "--only", "one_flagellum"]
    subprocess.run([*script, "--runs", tmp_path / "runs", "--docs", tmp_path / "docs"], check=True, capture_output=True)
    linked = links_of((tmp_path / "docs" / "gallery.md").read_text(encoding="utf-8"))
    assert linked == ["gallery/one_flagellum.jpg", "gallery/one_flagellum-curves.png"]
    assert all((tmp_path / "docs" / name).stat().st_size > 5_000 for name in linked)
