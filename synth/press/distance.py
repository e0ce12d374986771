"""Signed distance to rigid indenters, as Warp functions of the position in the indenter's own frame.

Positive outside. Every shape is a smaller sharp shape grown by a fillet radius, so that distance and normal are exact
and continuous where the gel can be. Shapes are numbered by `KINDS`; `shape` packs their lengths (mm) as described at
each function. A triangle mesh is sampled on a grid and interpolated by cubic B-splines (twice continuously
differentiable, so that Newton's method keeps its order).
"""

import warp as wp

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
def _box(y: wp.vec3d, half: wp.vec3d) -> wp.vec4d:
    """Sharp box; inside, the distance to the nearest face."""
    q = wp.vec3d(wp.abs(y[0]) - half[0], wp.abs(y[1]) - half[1], wp.abs(y[2]) - half[2])
    out = wp.vec3d(wp.max(q[0], ZERO), wp.max(q[1], ZERO), wp.max(q[2], ZERO))
    length = wp.length(out)
    sign = wp.vec3d(wp.sign(y[0]), wp.sign(y[1]), wp.sign(y[2]))
    if length > TINY:
        return wp.vec4d(sign[0] * out[0] / length, sign[1] * out[1] / length, sign[2] * out[2] / length, length)
    if q[0] > q[1] and q[0] > q[2]:
        return wp.vec4d(sign[0], ZERO, ZERO, q[0])
    if q[1] > q[2]:
        return wp.vec4d(ZERO, sign[1], ZERO, q[1])
    return wp.vec4d(ZERO, ZERO, sign[2], q[2])


@wp.func
def _revolve(y: wp.vec3d, gradient: wp.vec2d, distance: wp.float64) -> wp.vec4d:
    """Turns a distance in the half plane (rho, z) about the axis; on the axis any radial direction will do."""
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
def _bspline_curvature(t: wp.float64) -> wp.vec4d:
    three = wp.float64(3.0)
    return wp.vec4d(ONE - t, three * t - wp.float64(2.0), ONE - three * t, t)


@wp.func
def _in_grid(y: wp.vec3d, shape: shape_vector) -> wp.vec3d:
    """The nearest point of the grid where splines are defined, in spacings from its first sample."""
    g = (y - wp.vec3d(shape[1], shape[2], shape[3])) / shape[4]
    three = wp.float64(3.0)
    for axis in range(3):
        g[axis] = wp.clamp(g[axis], ONE, shape[5 + axis] - three)
    return g


@wp.func
def _spline(held: wp.vec3d, shape: shape_vector, s: int, coefficients: wp.array4d(dtype=wp.float64)):
    """Value, gradient and Hessian (xx, yy, zz and yz, zx, xy) of the cubic B-spline, by spacings."""
    i = wp.min(int(held[0]), int(shape[5]) - 4)
    j = wp.min(int(held[1]), int(shape[6]) - 4)
    k = wp.min(int(held[2]), int(shape[7]) - 4)
    tx = held[0] - wp.float64(i)
    ty = held[1] - wp.float64(j)
    tz = held[2] - wp.float64(k)
    wx, wy, wz = _bspline(tx), _bspline(ty), _bspline(tz)
    sx, sy, sz = _bspline_slope(tx), _bspline_slope(ty), _bspline_slope(tz)
    cx, cy, cz = _bspline_curvature(tx), _bspline_curvature(ty), _bspline_curvature(tz)
    value = wp.float64(0.0)
    slope = wp.vec3d(ZERO, ZERO, ZERO)
    straight = wp.vec3d(ZERO, ZERO, ZERO)
    mixed = wp.vec3d(ZERO, ZERO, ZERO)
    for a in range(4):
        for b in range(4):
            line = wp.vec3d(ZERO, ZERO, ZERO)
            for c in range(4):
                line += coefficients[s, i + a - 1, j + b - 1, k + c - 1] * wp.vec3d(wz[c], sz[c], cz[c])
            value += wx[a] * wy[b] * line[0]
            slope += wp.vec3d(sx[a] * wy[b] * line[0], wx[a] * sy[b] * line[0], wx[a] * wy[b] * line[1])
            straight += wp.vec3d(cx[a] * wy[b] * line[0], wx[a] * cy[b] * line[0], wx[a] * wy[b] * line[2])
            mixed += wp.vec3d(wx[a] * sy[b] * line[1], sx[a] * wy[b] * line[1], sx[a] * sy[b] * line[0])
    return value, slope, straight, mixed


@wp.func
def beyond_grid(kind: int, shape: shape_vector, y: wp.vec3d) -> wp.float64:
    """How far (mm) a point is outside a mesh's grid, which holds all that can touch; 0 for other shapes."""
    if kind != 5:
        return ZERO
    return wp.length(y - wp.vec3d(shape[1], shape[2], shape[3]) - shape[4] * _in_grid(y, shape))


@wp.func
def _grid(y: wp.vec3d, shape: shape_vector, s: int, coefficients: wp.array4d(dtype=wp.float64)) -> wp.vec4d:
    """Cubic B-spline on a grid (the batch's array is as large as its largest grid); beyond the grid the distance from
    its border is added.
    """
    held = _in_grid(y, shape)
    value, slope, _straight, _mixed = _spline(held, shape, s, coefficients)
    beyond = y - wp.vec3d(shape[1], shape[2], shape[3]) - shape[4] * held
    n = _unit(slope / shape[4], wp.vec3d(ZERO, ZERO, ONE))
    if wp.length(beyond) > TINY:
        n = _unit(value * n + beyond, n)
        value = wp.length(value * n + beyond)
    return wp.vec4d(n[0], n[1], n[2], value)


@wp.func
def _grid_normal_derivative(y: wp.vec3d, shape: shape_vector, s: int, coefficients: wp.array4d(dtype=wp.float64)):
    """Derivative of the normal within the grid, (I - n n^T) H / |g| with the spline's gradient g and Hessian H; |g|."""
    _value, slope, d, m = _spline(_in_grid(y, shape), shape, s, coefficients)
    hessian = wp.mat33d(d[0], m[2], m[1], m[2], d[1], m[0], m[1], m[0], d[2])
    n = _unit(slope, wp.vec3d(ZERO, ZERO, ONE))
    length = wp.max(wp.length(slope), TINY)
    return (hessian - wp.outer(n, hessian * n)) / (shape[4] * length), length / shape[4]


@wp.func
def signed_distance(
    kind: int, shape: shape_vector, y: wp.vec3d, s: int, coefficients: wp.array4d(dtype=wp.float64)
) -> wp.vec4d:
    """Outward unit normal (first three) and signed distance (last) at y, mm in the indenter's frame.

    shape: [fillet, then: sphere radius | cylinder radius, half length | box half edges | cone base radius, height
    | torus ring radius | mesh grid corner x, y, z, cell, counts x, y, z], of the sharp shape. The last three of all
    but meshes are the place of the frame's origin in the body's own.
    """
    if kind != 5:
        y += wp.vec3d(shape[5], shape[6], shape[7])
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
        d = _grid(y, shape, s, coefficients)
    return wp.vec4d(d[0], d[1], d[2], d[3] - shape[0])


@wp.func
def normal_derivative(kind: int, shape: shape_vector, y: wp.vec3d, s: int, coefficients: wp.array4d(dtype=wp.float64)):
    """Derivative of the normal (1/mm), of shapes by central differences of it (error about 1e-9), of meshes not quite
    symmetric; and the length of the distance's gradient, of meshes not quite 1.
    """
    h = wp.float64(1.0e-5)
    columns = wp.mat33d()
    steepness = ONE
    if kind == 5:
        columns, steepness = _grid_normal_derivative(y, shape, s, coefficients)
    else:
        for i in range(3):
            step = wp.vec3d(ZERO, ZERO, ZERO)
            step[i] = h
            ahead = signed_distance(kind, shape, y + step, s, coefficients)
            behind = signed_distance(kind, shape, y - step, s, coefficients)
            for j in range(3):
                columns[j, i] = (ahead[j] - behind[j]) / (wp.float64(2.0) * h)
        columns = wp.float64(0.5) * (columns + wp.transpose(columns))
    return columns, steepness
