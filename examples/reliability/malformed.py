"""Malformed scene files, each kind by a seed: values of the wrong kind, broken syntax, extremes of size and depth."""

from __future__ import annotations

import random

__all__ = ["malformed"]

_KEYS = [
    *("name", "duration", "frames", "flagella", "flagellum", "motor", "start", "unknown", "flagellum.0.torque"),
    *("flagella.count", "flagella.length", "flagella.intrinsic_curvature", "motor.torque", "motor.bearing_torque"),
    *("hydrodynamics.mode", "steric.strength", "body.width", "numerics.stepper", "numerics.time_step"),
    *("start.record", "start.frame", "flagella.anchor_offset", "motor.torqe", "flagellum.torque", "flagella.count.x"),
]
_VALUES = [
    *("1", "-1", "0", "1.5", "1e-300", "1e300", "nan", "inf", "-inf", "true", "false", '""', '"all"', "'a\\b'"),
    *("[]", "[1, 2, 3]", "[[1], [2], [3]]", "[nan, 0, 1]", "['a', 2, 3]", "{}", "{a = 1}", "{torque = {torque = 2}}"),
    *("1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "0x7fffffffffffffffff", "1_000", '"\\u0000"', '"\\n"', "0o7"),
    *("9" * 30, "9" * 999, "9" * 5000, "0x" + "f" * 5000, "1." + "3" * 3000, '"' + "x" * 70000 + '"', "1e999999999"),
    *("[" * 15 + "1" + "]" * 15, "[" * 1000 + "]" * 1000, "{a = " * 500 + "1" + "}" * 500, '"""' + "\n" * 9 + '"""'),
]
_LINES = [
    *("[motor", "motor]", "= 3", "torque", "[[flagellum]]", "[flagellum]", "[[motor]]", "[motor]", "[motor.torque]"),
    *('"motor.torque" = 2.0', '["motor.torque"]', '"flagellum.0.phase" = 3', "[[flagellum]]\ntorque = 1", '"" = 1'),
    *("[[flagellum]]\n[[flagellum]]\nphase = 'x'", '"a\\nb" = 1', '"\\u0007" = 1', "\x00", "\ufeff", "# [[[[", '"""'),
    *(
        ".".join(["a"] * 2000) + " = 1",
        "[" + ".".join(["b"] * 2000) + "]",
        "k" * 100000 + " = 1",
        "flagellum.00.phase = 1",
    ),
]


def malformed(seed: int) -> bytes:
    """A scene file that is malformed in a few places, or now and then sound.

    Args:
        seed: which; the same seed gives the same file.
    """
    chance = random.Random(seed)
    lines = []
    for _ in range(chance.randint(1, 4)):
        if chance.random() < 0.6:
            lines.append(f"{chance.choice(_KEYS)} = {chance.choice(_VALUES)}")
        else:
            lines.append(chance.choice(_LINES))
    content = "\n".join(lines).encode()
    if chance.random() < 0.15:
        place = chance.randrange(len(content) + 1)
        content = content[:place] + chance.randbytes(chance.choice([1, 4])) + content[place:]
    return content
