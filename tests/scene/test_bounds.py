"""Every setting by its key, through a scene: values at its bounds and beyond, other kinds, and what is said of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import pytest

from warpflag.scene import FlagellumOverride, Scene, SceneError, with_values
from warpflag.scene.settings import Section, Setting

SCENE = Scene(name="a")


def settings() -> Iterator[tuple[str, Setting]]:
    """Every setting of a scene with its key; those of single flagella as of the second."""
    yield from SCENE.settings.items()
    for field in dataclasses.fields(SCENE):
        section = getattr(SCENE, field.name)
        if isinstance(section, Section):
            assert field.name == section.key
            yield from ((f"{section.key}.{name}", own) for name, own in section.settings.items())
    yield from ((f"flagellum.1.{name}", own) for name, own in FlagellumOverride.settings.items())


ALL = dict(settings())


def of_kind(*kinds: str) -> list[str]:
    return [key for key, own in ALL.items() if own.kind in kinds]


def refusals(key: str, value: Any) -> list[SceneError]:
    """What is wrong with a scene that has this value; empty where nothing is."""
    try:
        with_values(SCENE, {key: value})
    except SceneError as error:
        return [error, *error.others]
    return []


def assert_refused(key: str, value: Any, words: str) -> None:
    (error,) = refusals(key, value)
    line = str(error)
    assert error.key == key and line.startswith(f"{key} = ") and line.endswith(words), line


def span(key: str) -> str:
    own = ALL[key]
    words = f"{own.low:g} to {own.high:g}" + (f" {own.unit}" if own.unit else "")
    return words + (", or " + ", ".join(own.choices) if own.choices else "")


def just_beyond(key: str) -> tuple[float, float]:
    own = ALL[key]
    if own.kind == "integer":
        return int(own.low) - 1, int(own.high) + 1
    return math.nextafter(own.low, -math.inf), math.nextafter(own.high, math.inf)


LISTED = {"number": "must be a number, ", "integer": "must be a whole number, "}
LISTED |= {"vector": "must be three numbers, each ", "numbers": "must be increasing numbers, each "}


@pytest.mark.parametrize("key", of_kind("number", "integer"))
def test_a_number_is_allowed_up_to_its_bounds_and_refused_beyond_them_with_its_key(key):
    own = ALL[key]
    words = LISTED[own.kind] + span(key)
    kind = int if own.kind == "integer" else float
    for bound in (own.low, own.high):
        for error in refusals(key, kind(bound)):  # other settings may not go with it, which says other words
            assert not str(error).endswith(words), error
    for value in (*just_beyond(key), True, "three", [1.0]):
        assert_refused(key, value, words)


@pytest.mark.parametrize("key", of_kind("vector", "numbers"))
def test_each_of_several_numbers_has_the_bounds(key):
    own, inside = ALL[key], [0.0, 1.0, 2.0]
    words = LISTED[own.kind] + span(key)
    for error in refusals(key, [own.low, own.high, own.low] if own.kind == "vector" else [own.low, own.high]):
        assert not str(error).endswith(words), error
    for beyond in just_beyond(key):
        for place in range(3):
            value = [*inside[:place], beyond, *inside[place + 1 :]]
            assert_refused(key, value, words)
    for value in (1.0, "three", [0.0, True, 2.0], [0.0, "1", 2.0], [0.0, 1.0] if own.kind == "vector" else [1.0, 1.0]):
        assert_refused(key, value, words)


@pytest.mark.parametrize("key", of_kind("choice", "switch"))
def test_a_choice_is_one_of_its_words_and_a_switch_true_or_false(key):
    own = ALL[key]
    words = "must be true or false" if own.kind == "switch" else "must be one of " + ", ".join(own.choices)
    for value in own.choices or (True, False):
        for error in refusals(key, value):
            assert "must be one of" not in str(error) and not str(error).endswith(words), error
    for value in ("xyzzy", 1, 0.0, ["xyzzy"]):
        assert_refused(key, value, words)
    if own.kind == "choice":
        assert_refused(key, True, words)


@pytest.mark.parametrize("key", ALL)
def test_only_what_has_something_to_stand_in_for_it_may_be_absent(key):
    own = ALL[key]
    for value in (None, "absent"):
        named = [error.key for error in refusals(key, value)]
        if own.derived:
            assert named == []
        elif own.kind != "text" or value is None:
            assert named == [key]
