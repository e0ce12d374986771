"""Signed distance to rigid indenters, as Warp functions of the position in the indenter's own frame.

Positive outside. Every shape is a smaller sharp shape grown by a fillet radius, so that distance and normal are exact
and continuous where the gel can be. Shapes are numbered by `KINDS`; `shape` packs their lengths (mm) as described at
each function. A triangle mesh is sampled on a grid and interpolated by cubic B-splines (twice continuously
differentiable, so that Newton's method keeps its order).
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

KINDS = {"sphere": 0, "cylinder": 1, "box": 2, "cone": 3, "torus": 4, "mesh": 5}
SHAPE_LENGTH = 8
"""Numbers that describe a shape."""
shape_vector = wp.types.vector(length=SHAPE_LENGTH, dtype=wp.float64)

TINY = wp.constant(wp.float64(1.0e-12))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.func
def _unit(v: wp.vec3d, otherwise: wp.vec3d) -> wp.vec3d:
    length = wp.length(v)
    if length < TINY:
        return otherwise
    return v / length


@wp.func
def _sphere(y: wp.vec3d, radius: wp.float64) -> wp.vec4d:
    n = _unit(y, wp.vec3d(ZERO, ZERO, ONE))
    return wp.vec4d(n[0], n[1], n[2], wp.length(y) - radius)


@wp.func
def _sign(x: wp.float64) -> wp.float64:
    if x < ZERO:
        return -ONE
    return ONE


@wp.func
def _box(y: wp.vec3d, half: wp.vec3d) -> wp.vec4d:
    """Sharp box; inside, the distance to the nearest face."""
    q = wp.vec3d(wp.abs(y[0]) - half[0], wp.abs(y[1]) - half[1], wp.abs(y[2]) - half[2])
    out = wp.vec3d(wp.max(q[0], ZERO), wp.max(q[1], ZERO), wp.max(q[2], ZERO))
    length = wp.length(out)
    sign = wp.vec3d(_sign(y[0]), _sign(y[1]), _sign(y[2]))
    if length > TINY:
        return wp.vec4d(sign[0] * out[0] / length, sign[1] * out[1] / length, sign[2] * out[2] / length, length)
    if q[0] > q[1] and q[0] > q[2]:
        return wp.vec4d(sign[0], ZERO, ZERO, q[0])
    if q[1] > q[2]:
        return wp.vec4d(ZERO, sign[1], ZERO, q[1])
    return wp.vec4d(ZERO, ZERO, sign[2], q[2])


@wp.func
def _revolve(y: wp.vec3d, gradient: wp.vec2d, distance: wp.float64) -> wp.vec4d:
    """From the half plane (distance from the axis, z) to space; on the axis any radial direction will do."""
    rho = wp.sqrt(y[0] * y[0] + y[1] * y[1])
    if rho < TINY:
        return wp.vec4d(gradient[0], ZERO, gradient[1], distance)
    return wp.vec4d(gradient[0] * y[0] / rho, gradient[0] * y[1] / rho, gradient[1], distance)


@wp.func
def _cylinder(y: wp.vec3d, radius: wp.float64, half_length: wp.float64) -> wp.vec4d:
    rho = wp.sqrt(y[0] * y[0] + y[1] * y[1])
    flat = _box(wp.vec3d(rho, ZERO, y[2]), wp.vec3d(radius, wp.float64(1.0e9), half_length))
    return _revolve(y, wp.vec2d(flat[0], flat[2]), flat[3])


@wp.func
def _nearest_on_segment(p: wp.vec2d, a: wp.vec2d, b: wp.vec2d) -> wp.vec2d:
    t = wp.clamp(wp.dot(p - a, b - a) / wp.dot(b - a, b - a), ZERO, ONE)
    return a + t * (b - a)


@wp.func
def _cone(y: wp.vec3d, radius: wp.float64, height: wp.float64) -> wp.vec4d:
    """Sharp cone with its apex at the origin and its base of that radius at z = -height."""
    p = wp.vec2d(wp.sqrt(y[0] * y[0] + y[1] * y[1]), y[2])
    rim = wp.vec2d(radius, -height)
    side = _nearest_on_segment(p, wp.vec2d(ZERO, ZERO), rim)
    base = _nearest_on_segment(p, wp.vec2d(ZERO, -height), rim)
    side_normal = wp.normalize(wp.vec2d(height, radius))
    inside = wp.dot(p, side_normal) < ZERO and p[1] > -height
    nearest = side
    normal = side_normal
    if wp.length(p - base) < wp.length(p - side):
        nearest = base
        normal = wp.vec2d(ZERO, -ONE)
    distance = wp.length(p - nearest)
    gradient = normal
    if distance > TINY:
        gradient = (p - nearest) / distance
        if inside:
            gradient = -gradient
    if inside:
        distance = -distance
    return _revolve(y, gradient, distance)


@wp.func
def _torus(y: wp.vec3d, radius: wp.float64) -> wp.vec4d:
    """Circle of that radius in the xy plane."""
    d = wp.vec2d(wp.sqrt(y[0] * y[0] + y[1] * y[1]) - radius, y[2])
    length = wp.length(d)
    if length < TINY:
        return wp.vec4d(ZERO, ZERO, ONE, length)
    return _revolve(y, d / length, length)


@wp.func
def _bspline(t: wp.float64) -> wp.vec4d:
    """Weights of the four cubic B-splines around a point at fraction t of its cell."""
    r = ONE - t
    six = wp.float64(6.0)
    return wp.vec4d(
        r * r * r / six,
        (wp.float64(3.0) * t * t * t - six * t * t + wp.float64(4.0)) / six,
        (wp.float64(3.0) * r * r * r - six * r * r + wp.float64(4.0)) / six,
        t * t * t / six,
    )


@wp.func
def _bspline_slope(t: wp.float64) -> wp.vec4d:
    r = ONE - t
    half = wp.float64(0.5)
    return wp.vec4d(
        -half * r * r,
        half * (wp.float64(3.0) * t * t - wp.float64(4.0) * t),
        -half * (wp.float64(3.0) * r * r - wp.float64(4.0) * r),
        half * t * t,
    )


@wp.func
def _grid(
    y: wp.vec3d,
    corner: wp.vec3d,
    cell: wp.float64,
    counts: wp.vec3d,
    s: int,
    coefficients: wp.array4d(dtype=wp.float64),
) -> wp.vec4d:
    """Cubic B-spline on a grid of counts points (the batch's array is as large as its largest grid); beyond the grid
    the distance from its border is added.
    """
    upper = counts - wp.vec3d(wp.float64(3.0), wp.float64(3.0), wp.float64(3.0))
    g = (y - corner) / cell
    held = wp.vec3d(wp.clamp(g[0], ONE, upper[0]), wp.clamp(g[1], ONE, upper[1]), wp.clamp(g[2], ONE, upper[2]))
    i = wp.min(int(held[0]), int(upper[0]) - 1)
    j = wp.min(int(held[1]), int(upper[1]) - 1)
    k = wp.min(int(held[2]), int(upper[2]) - 1)
    tx = held[0] - wp.float64(i)
    ty = held[1] - wp.float64(j)
    tz = held[2] - wp.float64(k)
    wx, wy, wz = _bspline(tx), _bspline(ty), _bspline(tz)
    sx, sy, sz = _bspline_slope(tx), _bspline_slope(ty), _bspline_slope(tz)
    value = wp.float64(0.0)
    slope = wp.vec3d(ZERO, ZERO, ZERO)
    for a in range(4):
        for b in range(4):
            for c in range(4):
                v = coefficients[s, i + a - 1, j + b - 1, k + c - 1]
                value += wx[a] * wy[b] * wz[c] * v
                slope += v * wp.vec3d(sx[a] * wy[b] * wz[c], wx[a] * sy[b] * wz[c], wx[a] * wy[b] * sz[c])
    beyond = cell * (g - held)
    n = _unit(slope / cell, wp.vec3d(ZERO, ZERO, ONE))
    if wp.length(beyond) > TINY:
        n = _unit(value * n + beyond, n)
        value = wp.length(value * n + beyond)
    return wp.vec4d(n[0], n[1], n[2], value)


@wp.func
def signed_distance(
    kind: int, shape: shape_vector, y: wp.vec3d, s: int, coefficients: wp.array4d(dtype=wp.float64)
) -> wp.vec4d:
    """Outward unit normal (first three) and signed distance (last) at y, mm in the indenter's frame.

    shape: [fillet, then: sphere radius | cylinder radius, half length | box half edges | cone base radius, height
    | torus ring radius | mesh grid corner x, y, z, cell, counts x, y, z], of the sharp shape.
    """
    if kind == 0:
        d = _sphere(y, shape[1])
    elif kind == 1:
        d = _cylinder(y, shape[1], shape[2])
    elif kind == 2:
        d = _box(y, wp.vec3d(shape[1], shape[2], shape[3]))
    elif kind == 3:
        d = _cone(y, shape[1], shape[2])
    elif kind == 4:
        d = _torus(y, shape[1])
    else:
        corner = wp.vec3d(shape[1], shape[2], shape[3])
        d = _grid(y, corner, shape[4], wp.vec3d(shape[5], shape[6], shape[7]), s, coefficients)
    return wp.vec4d(d[0], d[1], d[2], d[3] - shape[0])


@wp.func
def normal_derivative(
    kind: int, shape: shape_vector, y: wp.vec3d, s: int, coefficients: wp.array4d(dtype=wp.float64)
) -> wp.mat33d:
    """Symmetrised derivative of the normal (1/mm) by central differences of the exact normal (error about 1e-9)."""
    h = wp.float64(1.0e-5)
    columns = wp.mat33d()
    for i in range(3):
        step = wp.vec3d(ZERO, ZERO, ZERO)
        step[i] = h
        ahead = signed_distance(kind, shape, y + step, s, coefficients)
        behind = signed_distance(kind, shape, y - step, s, coefficients)
        for j in range(3):
            columns[j, i] = (ahead[j] - behind[j]) / (wp.float64(2.0) * h)
    return wp.float64(0.5) * (columns + wp.transpose(columns))
