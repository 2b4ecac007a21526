"""Deformation and Adam: the per-parameter half of a training step.

N Gaussians padded to a multiple of LANES, B bases, F frames per step. The canonical state has the ROWS of
intrasplat/splat/layout.py. FDM moves the first CHANNELS of them, shared bases those, those and the colour, or all.
Arrays are rows of N floats, so that a vector is LANES Gaussians. A gradient is a sum over the frames, in their order.
Adam (Kingma and Ba 2015) has its bias correction folded into the step: rate = lr sqrt(1 - beta2^k) / (1 - beta1^k), and
eps is scaled by the same square root.
"""

from __future__ import annotations

import numpy as np

from intrasplat.machine.cache import kernel
from intrasplat.splat.constants import LOG2E, MIN_WIDTH, QUARTIC_FLOOR
from intrasplat.splat.cpu.simd import exp2, fma, load, splat, sqrt, store, where_less
from intrasplat.splat.cpu.vectors import LANES
from intrasplat.splat.layout import CHANNELS, ROWS

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_HALF_LOG2E, _LOG2E = np.float32(0.5 * LOG2E), np.float32(LOG2E)
_MIN_WIDTH, _QUARTIC_FLOOR = np.float32(MIN_WIDTH), np.float32(QUARTIC_FLOOR)
_STRETCH = 64  # vectors


@kernel(inline="always")
def _adam(value, first, second, i, gradient, rate, eps, beta1, beta2):  # type: ignore[no-untyped-def]
    """One Adam step on LANES parameters at value[i]; first and second are the moments."""
    m = fma(splat(beta1), load(first, i), splat(_ONE - beta1) * gradient)
    v = fma(splat(beta2), load(second, i), splat(_ONE - beta2) * gradient * gradient)
    store(first, i, m)
    store(second, i, v)
    store(value, i, load(value, i) - rate * m / (sqrt(v) + eps))


@kernel(inline="always")
def _scaled_step(value, second, i, gradient, rate, eps, beta2):  # type: ignore[no-untyped-def]
    """_adam with beta1 = 0: the first moment would be the gradient, so it is neither read nor written."""
    v = fma(splat(beta2), load(second, i), splat(_ONE - beta2) * gradient * gradient)
    store(second, i, v)
    store(value, i, load(value, i) - rate * gradient / (sqrt(v) + eps))


@kernel
def adam(thread, threads, value, gradient, first, second, rate, eps, beta1, beta2):  # type: ignore[no-untyped-def]
    """Adam on flat arrays whose length is a multiple of LANES."""
    vectors = value.shape[0] // LANES
    for k in range(vectors * thread // threads, vectors * (thread + 1) // threads):
        _adam(value, first, second, k * LANES, load(gradient, k * LANES), splat(rate), splat(eps), beta1, beta2)


@kernel
def deform_shared(thread, threads, canonical, weight, basis, first, last, state):  # type: ignore[no-untyped-def]
    """state [ROWS, N] = canonical + sum over j in [first, last) of basis[j] weight[j]; weight [B, C, N], C <= ROWS."""
    vectors = canonical.shape[1] // LANES
    for c in range(ROWS):  # outermost, because a processor prefetches a few streams of memory, not a hundred
        for k in range(vectors * thread // threads, vectors * (thread + 1) // threads):
            i = k * LANES
            total = load(canonical[c], i)
            if c < weight.shape[1]:
                for j in range(first, last):
                    total = fma(splat(basis[j]), load(weight[j, c], i), total)
            store(state[c], i, total)


@kernel
def update_shared(  # type: ignore[no-untyped-def]
    thread, threads, weight, first_moment, second_moment, v_state, basis, alive, rate, eps, beta1, beta2
):
    """Adam on the weights of the bases in alive; v_state [F, ROWS, N], basis [F, B], rate and eps [B, C].

    dL/dw_j = sum over the frames of dL/dpsi basis_j. Where beta1 is 0, the first moment stays as it is.
    """
    vectors = v_state.shape[2] // LANES
    for j in alive:
        for c in range(weight.shape[1]):
            if rate[j, c] == _ZERO:
                continue
            step, floor, value = splat(rate[j, c]), splat(eps[j, c]), splat(basis[0, j])
            for k in range(vectors * thread // threads, vectors * (thread + 1) // threads):
                i = k * LANES
                gradient = value * load(v_state[0, c], i)
                for frame in range(1, v_state.shape[0]):
                    gradient = fma(splat(basis[frame, j]), load(v_state[frame, c], i), gradient)
                if beta1 == _ZERO:
                    _scaled_step(weight[j, c], second_moment[j, c], i, gradient, step, floor, beta2)
                else:
                    _adam(weight[j, c], first_moment[j, c], second_moment[j, c], i, gradient, step, floor, beta1, beta2)


@kernel(inline="always")
def _basis(t, centre, width, quartic):  # type: ignore[no-untyped-def]
    """Value of a basis at t, and its logarithmic derivatives to centre and width.

    gaussian: exp(-d^2 / (2 s^2)), d = t - centre;  quartic: exp(-(d^2 / (s^2 + QUARTIC_FLOOR))^2).
    """
    zero = splat(_ZERO)
    d = t - centre
    if quartic:
        spread = fma(width, width, splat(_QUARTIC_FLOOR))
        ratio = d * d / spread
        value = exp2(zero - splat(_LOG2E) * ratio * ratio)
        slope = splat(np.float32(4.0)) * ratio / spread
        return value, slope * d, slope * ratio * width
    size = where_less(width, zero, zero - width, width)
    low = splat(_MIN_WIDTH)
    bounded = where_less(size, low, low, size)
    inverse = splat(_ONE) / bounded
    along = d * inverse
    value = exp2(zero - splat(_HALF_LOG2E) * along * along)
    sign = where_less(width, zero, splat(-_ONE), splat(_ONE))
    free = where_less(size, low, zero, sign)  # no gradient through the floor
    return value, along * inverse, along * along * inverse * free


@kernel
def deform_fdm(thread, threads, canonical, weight, centre, width, t, quartic, state):  # type: ignore[no-untyped-def]
    """state [ROWS, N] = canonical + FDM at t; weight, centre, width [10, B, N] (Deform3DGS, equations 3 and 4)."""
    vectors = canonical.shape[1] // LANES
    first, last = vectors * thread // threads, vectors * (thread + 1) // threads
    time = splat(t)
    for c in range(CHANNELS, ROWS):
        for k in range(first, last):
            store(state[c], k * LANES, load(canonical[c], k * LANES))
    for c in range(CHANNELS):
        for start in range(first, last, _STRETCH):  # the sums stay in the cache, and few streams of memory are read
            end = min(start + _STRETCH, last)
            for k in range(start, end):
                store(state[c], k * LANES, load(canonical[c], k * LANES))
            for j in range(weight.shape[1]):
                for k in range(start, end):
                    i = k * LANES
                    value, _, _ = _basis(time, load(centre[c, j], i), load(width[c, j], i), quartic)
                    store(state[c], i, fma(load(weight[c, j], i), value, load(state[c], i)))


@kernel(inline="always")
def _through_fdm(v_state, weight, centre, width, i, time, quartic):  # type: ignore[no-untyped-def]
    """dL/d weight, centre and width of LANES bases at [i], by one frame's dL/dstate."""
    value, by_centre, by_width = _basis(time, load(centre, i), load(width, i), quartic)
    to_weight = load(v_state, i) * value
    scaled = to_weight * load(weight, i)
    return to_weight, scaled * by_centre, scaled * by_width


@kernel(inline="always")
def _adam_fdm(weight, centre, width, m, v, i, gradients, step, floor, beta1, beta2):  # type: ignore[no-untyped-def]
    """Adam on all three at [i]; m and v hold the moments of each."""
    to_weight, to_centre, to_width = gradients
    _adam(weight, m[0], v[0], i, to_weight, step, floor, beta1, beta2)
    _adam(centre, m[1], v[1], i, to_centre, step, floor, beta1, beta2)
    _adam(width, m[2], v[2], i, to_width, step, floor, beta1, beta2)


@kernel
def update_fdm(  # type: ignore[no-untyped-def]
    thread, threads, weight, centre, width, first_moment, second_moment, v_state, times, quartic, rate, eps,
    beta1, beta2,
):  # fmt: skip
    """Adam on weight, centre and width of every basis; v_state [F, ROWS, N], times [F], moments [3, 10, B, N]."""
    frames, vectors = v_state.shape[0], v_state.shape[2] // LANES
    begin, end = vectors * thread // threads, vectors * (thread + 1) // threads
    time, step, floor = splat(times[0]), splat(rate), splat(eps)
    for c in range(CHANNELS):
        for j in range(weight.shape[1]):
            w, o, s = weight[c, j], centre[c, j], width[c, j]
            m = first_moment[0, c, j], first_moment[1, c, j], first_moment[2, c, j]
            v = second_moment[0, c, j], second_moment[1, c, j], second_moment[2, c, j]
            if frames == 1:  # a loop of its own, because the loop over frames makes it slower by a tenth
                for k in range(begin, end):
                    gradients = _through_fdm(v_state[0, c], w, o, s, k * LANES, time, quartic)
                    _adam_fdm(w, o, s, m, v, k * LANES, gradients, step, floor, beta1, beta2)
                continue
            for k in range(begin, end):
                i = k * LANES
                gradients = _through_fdm(v_state[0, c], w, o, s, i, time, quartic)
                for frame in range(1, frames):
                    more = _through_fdm(v_state[frame, c], w, o, s, i, splat(times[frame]), quartic)
                    gradients = gradients[0] + more[0], gradients[1] + more[1], gradients[2] + more[2]
                _adam_fdm(w, o, s, m, v, i, gradients, step, floor, beta1, beta2)
