"""A scene as HTML, as a notebook shows it: what differs from the defaults, and everything on demand."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from html import escape
from typing import Any

from warpflag.scene import Scene

__all__ = ["scene_table"]


def scene_table(scene: Scene) -> str:
    """The settings of a scene with units and meaning: a table of those that differ, and one of all, folded up."""
    rows = list(_rows(scene))
    changed = [row for row in rows if row[-1]]
    title = f"<b>{escape(scene.name)}</b>: {1e3 * scene.duration:g} ms, {len(scene.resolved_flagella())} flagella"
    everything = f"<details><summary>all settings</summary>{_table(rows)}</details>"
    return f"<div>{title}{_table(changed) if changed else ''}{everything}</div>"


def _rows(scene: Scene) -> Iterator[tuple[str, str, str, str, bool]]:
    """Key, value, unit, meaning, and whether the value differs from the default, section by section."""
    sections = [("", scene)]
    sections += [(field.name, getattr(scene, field.name)) for field in dataclasses.fields(scene)]
    for name, section in sections:
        if name and not hasattr(section, "settings"):
            continue
        yield from _rows_of(name, section)
    for k, own in enumerate(scene.flagellum):
        yield from (row for row in _rows_of(f"flagellum.{k}", own) if row[-1])


def _rows_of(name: str, section: Any) -> Iterator[tuple[str, str, str, str, bool]]:
    defaults = {field.name: field.default for field in dataclasses.fields(section)}
    for key, setting in section.settings.items():
        value = getattr(section, key)
        shown = setting.derived or "none" if value is None else f"{value}"
        unit = setting.unit.replace("um", "µm")
        yield f"{name}.{key}" if name else key, shown, unit, setting.meaning, value != defaults[key]


def _table(rows: list[tuple[str, str, str, str, bool]]) -> str:
    cells = (
        "".join(f'<td style="text-align:left">{escape(text)}</td>' for text in (key, value, unit, meaning))
        for key, value, unit, meaning, _ in rows
    )
    return f"<table>{''.join(f'<tr>{cell}</tr>' for cell in cells)}</table>"
