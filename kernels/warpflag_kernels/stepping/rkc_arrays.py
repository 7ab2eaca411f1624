"""The struct `Rkc`: what stabilised explicit stepping keeps of every cell."""

import functools
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel
from warpflag_kernels.rod.comoving_chart import vec6d


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Rkc`: earlier stages of a step, the probe, and the stage counter of every cell."""
    real, vec4 = p.real, p.vec4

    @wp.struct
    class Rkc:
        previous: wp.array(dtype=vec4)  # [E], Y_(j-1)
        before_previous: wp.array(dtype=vec4)  # [E], Y_(j-2)
        start_rate: wp.array(dtype=vec4)  # [E], F_0
        probe: wp.array(dtype=vec4)  # [E], direction of the power method, any length
        body_previous: wp.array(dtype=vec6d)  # [C]
        body_before_previous: wp.array(dtype=vec6d)  # [C]
        body_start_rate: wp.array(dtype=vec6d)  # [C]
        stage: wp.array(dtype=wp.int32)  # [C]
        stages: wp.array(dtype=wp.int32)  # [C], s; fixed to 1 for Euler
        probes_left: wp.array(dtype=wp.int32)  # [C], before the next step starts
        probe_norm: wp.array(dtype=wp.float64)  # [C]
        probe_sum: wp.array(dtype=wp.float64)  # [K], squared norm of the flagellum's part
        error: wp.array(dtype=real)  # [K], largest node error estimate [um]
        round_off: wp.array(dtype=real)  # [K], an estimate below this is taken to be round-off [um]
        spectral_radius: wp.array(dtype=wp.float64)  # [C] [1/s]
        coefficients: wp.array(dtype=wp.vec4d)  # [C]: mu, nu, and m dt, g dt [s]
        evaluations: wp.array(dtype=wp.int32)  # [C], right-hand sides so far

    return Rkc


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Rkc`, zero."""
    p, device = model.precision, model.device
    cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    r = struct(p)()
    r.previous, r.before_previous, r.start_rate, r.probe = (zeros(elements, p.vec4) for _ in range(4))
    r.body_previous, r.body_before_previous, r.body_start_rate = (zeros(cells, vec6d) for _ in range(3))
    r.stage, r.stages, r.probes_left, r.evaluations = (zeros(cells, wp.int32) for _ in range(4))
    r.probe_norm, r.spectral_radius = zeros(cells, wp.float64), zeros(cells, wp.float64)
    r.probe_sum, r.coefficients = zeros(flagella, wp.float64), zeros(cells, wp.vec4d)
    r.error, r.round_off = zeros(flagella, p.real), zeros(flagella, p.real)
    return r
