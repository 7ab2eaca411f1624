"""The floating-point type of a run, and the compiler options of its kernels."""

from dataclasses import dataclass
from typing import Any

import warp as wp

# Vector code for this machine's CPU. Reassociation lets sums vectorise; NaN and infinity keep their meaning, because
# the guards need them.
FAST_CPU_FLAGS = (
    "-march=native -mreassociate -fno-signed-zeros -freciprocal-math -ffp-contract=fast "
    "-mprefer-vector-width=512 -mllvm=-inline-threshold=9000"
)
STRICT_CPU_FLAGS = "-march=native -ffp-contract=off"


@dataclass(frozen=True)
class Precision:
    """One floating-point type and the build that uses it.

    Attributes:
        name: "float64" or "float32".
        strict: build without reassociation, contraction or reciprocals (reproducible to the last bit).
    """

    name: str
    strict: bool = False

    @property
    def real(self) -> Any:
        """Warp's scalar type."""
        return {"float64": wp.float64, "float32": wp.float32}[self.name]

    @property
    def vec3(self) -> Any:
        """Warp's vector of three."""
        return {"float64": wp.vec3d, "float32": wp.vec3f}[self.name]

    @property
    def vec4(self) -> Any:
        """Warp's vector of four."""
        return {"float64": wp.vec4d, "float32": wp.vec4f}[self.name]

    @property
    def quat(self) -> Any:
        """Warp's quaternion (x, y, z, w)."""
        return {"float64": wp.quatd, "float32": wp.quatf}[self.name]

    @property
    def mat33(self) -> Any:
        """Warp's 3 x 3 matrix."""
        return {"float64": wp.mat33d, "float32": wp.mat33f}[self.name]

    @property
    def c_name(self) -> str:
        """Name of the type in C++."""
        return {"float64": "double", "float32": "float"}[self.name]

    @property
    def single(self) -> "Precision":
        """Single precision in the same build."""
        return Precision("float32", self.strict)

    @property
    def double(self) -> "Precision":
        """Double precision in the same build."""
        return Precision("float64", self.strict)

    @property
    def cpu_flags(self) -> str:
        """Flags of the compiler for CPU kernels."""
        return STRICT_CPU_FLAGS if self.strict else FAST_CPU_FLAGS

    def module(self, stage: str, variant: str = "") -> Any:
        """Warp module of one stage in this precision; a variant names the switches compiled in."""
        parts = ["warpflag_kernels", stage, self.name, "strict" if self.strict else "fast", variant]
        module = wp.get_module(".".join(part for part in parts if part))
        module.options.update({"enable_backward": False, "cpu_compiler_flags": self.cpu_flags, "fast_math": False})
        return module
