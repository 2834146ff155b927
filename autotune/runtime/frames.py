"""What the wrench says without the payload's weight, and how far the sensor frame went: plain arithmetic on rows.

A rotation is nine numbers, R_WS row by row, so that v_W = R_WS v_S. Neither square root nor sine is needed, so that the
exported C does without its mathematical library, and each line is the same operation in the same order as there.
"""

from problems.model.difference import Entry

from .law import Payload

Six = tuple[float, float, float, float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]
Place = tuple[Entry, Nine]
"""Position [m] of the sensor's origin in W, and R_WS."""

# How far an orientation may be from a rotation: a thousandth of the weight is below every deadband.
LARGEST_SKEW = 1e-3
# Farther between two readings than any robot goes, m and rad, whatever the limits; the series below ends there.
LARGEST_WAY = 0.1
# cos of an angle somewhat above LARGEST_WAY, times 2, plus 1: the trace of such a rotation.
SMALLEST_TRACE = 2.98


def is_rotation(R: Nine) -> bool:
    """Return whether R is a rotation to `LARGEST_SKEW`: unit columns at right angles, right-handed."""
    a, b, c = (R[0], R[3], R[6]), (R[1], R[4], R[7]), (R[2], R[5], R[8])
    skew = max(
        abs(_dot(a, a) - 1.0),
        abs(_dot(b, b) - 1.0),
        abs(_dot(c, c) - 1.0),
        abs(_dot(a, b)),
        abs(_dot(b, c)),
        abs(_dot(c, a)),
    )
    return skew <= LARGEST_SKEW and _dot(_cross(a, b), c) > 0.0


def external_wrench(payload: Payload, wrench: Six, R: Nine) -> Six:
    """Return what acts on the flange beside weight and bias (6,), N and N·m, in S about the sensor's origin.

    F = F_raw − b_F − m R_WSᵀ g, τ = τ_raw − b_τ − c × m R_WSᵀ g. Like F_raw it is the payload's force on the flange.
    """
    weight = into_sensor(R, payload.gravity_W_m_s2)
    weight = (payload.mass_kg * weight[0], payload.mass_kg * weight[1], payload.mass_kg * weight[2])
    moment, force, torque = _cross(payload.com_S_m, weight), payload.force_bias_S_n, payload.torque_bias_S_n_m
    return (
        wrench[0] - force[0] - weight[0],
        wrench[1] - force[1] - weight[1],
        wrench[2] - force[2] - weight[2],
        wrench[3] - torque[0] - moment[0],
        wrench[4] - torque[1] - moment[1],
        wrench[5] - torque[2] - moment[2],
    )


def way_between(before: Place, now: Place, largest_m: float = 1.0, largest_rad: float = 1.0) -> Six | None:
    """Return the way from one place to the next (6,): m and the rotation vector in rad, both in the axes of S.

    None where it is longer than `largest_m` or `largest_rad`, or it or its sine than `LARGEST_WAY`. The angle θ comes
    from the sines in R_beforeᵀ R_now by the series of arcsin, whose first term left out is 2e-13 rad at the largest
    way.
    """
    (start, A), (end, B) = before, now
    path = into_sensor(B, (end[0] - start[0], end[1] - start[1], end[2] - start[2]))
    u, v = (
        ((A[0], A[3], A[6]), (A[1], A[4], A[7]), (A[2], A[5], A[8])),
        ((B[0], B[3], B[6]), (B[1], B[4], B[7]), (B[2], B[5], B[8])),
    )
    x = 0.5 * (_dot(u[2], v[1]) - _dot(u[1], v[2]))
    y = 0.5 * (_dot(u[0], v[2]) - _dot(u[2], v[0]))
    z = 0.5 * (_dot(u[1], v[0]) - _dot(u[0], v[1]))
    q = x * x + y * y + z * z
    trace = _dot(u[0], v[0]) + _dot(u[1], v[1]) + _dot(u[2], v[2])
    far = _dot(path, path) > LARGEST_WAY * LARGEST_WAY
    if far or q > LARGEST_WAY * LARGEST_WAY or trace < SMALLEST_TRACE:
        return None
    per_sine = 1.0 + q * (1.0 / 6.0 + q * (3.0 / 40.0 + q * (5.0 / 112.0 + q * (35.0 / 1152.0))))
    x, y, z = x * per_sine, y * per_sine, z * per_sine
    if _dot(path, path) > largest_m * largest_m or x * x + y * y + z * z > largest_rad * largest_rad:
        return None
    return path[0], path[1], path[2], x, y, z


def into_sensor(R: Nine, vector: Entry) -> Entry:
    """Return R_WSᵀ v, a vector of W in the axes of S."""
    x, y, z = vector
    return R[0] * x + R[3] * y + R[6] * z, R[1] * x + R[4] * y + R[7] * z, R[2] * x + R[5] * y + R[8] * z


def _dot(a: Entry, b: Entry) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Entry, b: Entry) -> Entry:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
