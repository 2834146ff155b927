"""The C of an exported controller: `autotune.runtime.step` operation by operation, with `$words` to be filled in."""

from .c_guard_text import SOURCE_GUARD

SOURCE_DATA = """\
/* format: autotune/c, version 1: $prefix.c, written by autotune $tool_version; see $prefix.h. */
#include "$prefix.h"

#if ${PREFIX}_CHECKSUM_HEAD != 0x${head}UL
#error "$prefix.h and $prefix.c are of different controllers; export both again."
#endif
#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "With -ffast-math a number that is not finite would not be noticed; compile without it."
#endif

enum { TUNED = $tuned, RESPONSE = $response }; /* response: 0 none, 1 reset, 2 stop */

/* Rows: integrator, lag, velocity filter, acceleration (each direct, pole, gain); then B_fb, P and whether the
 * compensation is ideal; then its gain on the derivative, on x, and on x into the lag. */
typedef struct {
    int index;
    int is_subtractive;
    double deadband;
    double low;
    double high;
    double speed;  /* largest, and its largest change in a period */
    double change;
    double b[6][3];
} law_of_axis;

static const law_of_axis laws[TUNED] = {
$laws
};
static const double threshold_n = $threshold;

/* The limits in periods: ways per period (m, rad), numbers of periods, squares of magnitudes. */
static const double force_n = $force;
static const double torque_n_m = $torque;
static const double way_m = $way_m;
static const double way_rad = $way_rad;
static const double rest_force = $rest_force;
static const double rest_torque = $rest_torque;
static const double least_weight = $least_weight;
enum { WRENCH_PERIODS = $wrench_periods, POSE_PERIODS = $pose_periods, WEIGHT_PERIODS = $weight_periods };
enum { REST_SAMPLES = $rest_samples, MOST_HELD = $most_held, MOST_PERIODS = $most_periods };

const char $prefix_checksum[65] = "$checksum";
const char $prefix_signed_by[17] = "$signed_by";
const double $prefix_sample_time_s = $sample_time;
const $prefix_payload $prefix_file_payload = {
    $mass, /* kg */
    {$com}, /* m */
    {$force_bias}, /* N */
    {$torque_bias}, /* N m */
    {$gravity} /* m/s^2 */
};
"""

SOURCE_CODE = (
    """
static double magnitude(double a)
{
    return a < 0.0 ? -a : a;
}

static int is_finite(double a)
{
    return a - a == 0.0;
}

static int are_finite(const double *a, int count)
{
    int i;
    for (i = 0; i < count; ++i) {
        if (!is_finite(a[i])) return 0;
    }
    return 1;
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void columns(const double R[9], double out[3][3])
{
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) out[j][i] = R[3 * i + j];
    }
}

static void into_sensor(const double R[9], const double v[3], double out[3])
{
    int j;
    for (j = 0; j < 3; ++j) out[j] = R[j] * v[0] + R[3 + j] * v[1] + R[6 + j] * v[2];
}

static int is_rotation(const double R[9])
{
    double c[3][3], n[3];
    int i, j;
    columns(R, c);
    for (i = 0; i < 3; ++i) {
        for (j = i; j < 3; ++j) {
            if (!(magnitude(dot(c[i], c[j]) - (i == j ? 1.0 : 0.0)) <= $skew)) return 0;
        }
    }
    cross(c[0], c[1], n);
    return dot(n, c[2]) > 0.0;
}

/* F = F_raw - b_F - m R_WS' g, tau = tau_raw - b_tau - c x m R_WS' g */
static void external_wrench(const $prefix_payload *p, const double raw[6], const double R[9], double out[6])
{
    double weight[3], moment[3];
    int i;
    into_sensor(R, p->gravity_W_m_s2, weight);
    for (i = 0; i < 3; ++i) weight[i] = p->mass_kg * weight[i];
    cross(p->com_S_m, weight, moment);
    for (i = 0; i < 3; ++i) {
        out[i] = raw[i] - p->force_bias_S_n[i] - weight[i];
        out[3 + i] = raw[3 + i] - p->torque_bias_S_n_m[i] - moment[i];
    }
}

/* The way from one pose to the next in the axes of S, the angle by the series of arcsin; 0 where it is too long. */
static int way_between(const double start[3], const double A[9], const double end[3], const double B[9],
    double largest_m, double largest_rad, double out[6])
{
    double u[3][3], v[3][3], path[3], x, y, z, q, trace, per_sine;
    int i;
    for (i = 0; i < 3; ++i) path[i] = end[i] - start[i];
    into_sensor(B, path, out);
    columns(A, u);
    columns(B, v);
    x = 0.5 * (dot(u[2], v[1]) - dot(u[1], v[2]));
    y = 0.5 * (dot(u[0], v[2]) - dot(u[2], v[0]));
    z = 0.5 * (dot(u[1], v[0]) - dot(u[0], v[1]));
    q = x * x + y * y + z * z;
    trace = dot(u[0], v[0]) + dot(u[1], v[1]) + dot(u[2], v[2]);
    if (dot(out, out) > $way * $way || q > $way * $way || trace < $trace) return 0;
    per_sine = 1.0 + q * (1.0 / 6.0 + q * (3.0 / 40.0 + q * (5.0 / 112.0 + q * (35.0 / 1152.0))));
    out[3] = x * per_sine;
    out[4] = y * per_sine;
    out[5] = z * per_sine;
    if (dot(out, out) > largest_m * largest_m || dot(out + 3, out + 3) > largest_rad * largest_rad) return 0;
    return 1;
}

static double through_deadband(const law_of_axis *law, double force)
{
    if (magnitude(force) <= law->deadband) return 0.0;
    if (!law->is_subtractive) return force;
    return force > 0.0 ? force - law->deadband : force + law->deadband;
}

/* The difference equation: x^d from F^d + F and x; `added` is what the robot's motion adds to it, `drive` what drives
 * the admittance. */
static double next_command(const double b[6][3], const double s[4], double force, double position, double following[4],
    double *added, double *drive)
{
    double velocity = b[2][0] * position + s[2];
    double source = position * b[4][2] + velocity * (1.0 - b[4][2]);
    double acceleration = b[3][0] * source + s[3];
    double driven = force + b[4][1] * acceleration;
    *added = b[5][0] * acceleration - b[4][0] * velocity;
    *drive = driven;
    following[0] = b[0][1] * s[0] + b[0][2] * driven;
    following[1] = b[1][1] * s[1] + b[1][2] * driven + b[5][2] * position;
    following[2] = b[2][1] * s[2] + b[2][2] * position;
    following[3] = b[3][1] * s[3] + b[3][2] * source;
    return s[0] + s[1] + (b[0][0] + b[1][0]) * driven - b[4][0] * velocity + b[5][0] * acceleration
        + b[5][1] * position;
}

/* Integrator and lag with which the difference equation goes on from the same output y twice; u is the drive. */
static void go_on(const double b[6][3], double y, const double u[2], const double x[2], double control[4])
{
    double pole = b[1][1], direct = b[0][0] + b[1][0];
    double n_1 = b[0][2] + b[1][2] - (1.0 + pole) * direct, n_2 = pole * (direct - b[0][2]) - b[1][2];
    double m_1 = b[5][2] - (1.0 + pole) * b[5][1], m_2 = pole * b[5][1] - b[5][2];
    double both = (1.0 + pole) * y - pole * y + n_1 * u[1] + n_2 * u[0] + m_1 * x[1] + m_2 * x[0];
    double lag = (pole * (y - both) - n_2 * u[1] - m_2 * x[1]) / (1.0 - pole);
    control[0] = both - lag;
    control[1] = lag;
}

static int opposes(double force, double way)
{
    return (way > 0.0 && -force > threshold_n) || (way < 0.0 && force > threshold_n);
}

static int held($prefix_state *state, $prefix_command *command, int fault)
{
    int i;
    for (i = 0; i < 6; ++i) command->increment_S[i] = command->twist_S[i] = command->wrench_S[i] = 0.0;
    command->missing_mass_kg = state->missing_kg;
    command->phase = state->phase;
    command->fault = state->fault = fault;
    command->is_started = 0;
    return fault;
}

static void keep_pose($prefix_state *state, const $prefix_reading *reading)
{
    int i;
    for (i = 0; i < 3; ++i) state->position_W_m[i] = reading->position_W_m[i];
    for (i = 0; i < 9; ++i) state->R_WS[i] = reading->R_WS[i];
    state->has_pose = 1;
}

"""
    + SOURCE_GUARD
    + """/* Step the tuned axes from `state` into `next`, whose wrench and way are given; 1 where the command rests. */
static int step_axes(const $prefix_state *state, const double desired[6], const double wrench[6], const double way[6],
    $prefix_state *next)
{
    double added[TUNED];
    int k, i, met = 0, resting;
    for (k = 0; k < TUNED; ++k) {
        double seen = through_deadband(&laws[k], wrench[laws[k].index]);
        i = laws[k].index;
        next->position[i] = state->position[i] + way[i];
        next->command[i] = next_command(laws[k].b, state->control[i], desired[i] + seen, next->position[i],
            next->control[i], &added[k], &next->drive[i]);
        if (i < 3 && opposes(seen, way[i])) met = 1;
    }
    resting = state->phase == ${PREFIX}_STOPPED;
    if (met && RESPONSE != 0 && state->phase == ${PREFIX}_WATCHING) {
        next->phase = RESPONSE == 1 ? ${PREFIX}_RESPONDED : ${PREFIX}_STOPPED;
        resting = 1;
    }
    for (k = 0; resting && k < TUNED; ++k) {
        double u[2], x[2];
        i = laws[k].index;
        u[0] = state->drive[i];
        u[1] = next->drive[i];
        x[0] = state->position[i];
        x[1] = next->position[i];
        go_on(laws[k].b, state->command[i] - added[k], u, x, next->control[i]);
        next->command[i] = state->command[i];
    }
    return resting;
}

int $prefix_check(const $prefix_payload *payload, double sample_time_s, const double inertia_kg_m2[3])
{
    int k;
    if (!(magnitude(sample_time_s - $prefix_sample_time_s) <= $same * $prefix_sample_time_s)) {
        return ${PREFIX}_OTHER_SAMPLE_TIME;
    }
    for (k = 0; k < TUNED; ++k) {
        int turns = laws[k].index >= 3;
        double value = turns ? inertia_kg_m2[laws[k].index - 3] : payload->mass_kg;
        if (!(laws[k].low <= value && value <= laws[k].high)) {
            return turns ? ${PREFIX}_INERTIA_NOT_CERTIFIED : ${PREFIX}_MASS_NOT_CERTIFIED;
        }
    }
    return ${PREFIX}_ACCEPTED;
}

void $prefix_start($prefix_state *state)
{
    static const $prefix_state beginning = {{{0.0}}, {0.0}, {0.0}, {0.0}, {0.0}, {0.0}, {0.0}, {0.0}, {0.0}, 0.0, 0.0,
        0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    *state = beginning;
}

void $prefix_rearm($prefix_state *state)
{
    state->phase = ${PREFIX}_WATCHING;
}

int $prefix_step($prefix_state *state, const $prefix_payload *payload, const $prefix_reading *reading,
    $prefix_command *command)
{
    $prefix_state next = *state;
    double way[6], periods;
    int i, fault, resting;
    if (state->fault != ${PREFIX}_NO_FAULT) return held(state, command, state->fault);
    fault = unsound(state, reading);
    if (fault != ${PREFIX}_NO_FAULT) return held(state, command, fault);
    see(&next, reading);
    periods = (double)(state->pose_same + 1 < MOST_HELD ? state->pose_same + 1 : MOST_HELD);
    if (!way_between(state->has_pose ? state->position_W_m : next.position_W_m,
            state->has_pose ? state->R_WS : next.R_WS, next.position_W_m, next.R_WS, way_m * periods, way_rad * periods,
            way)) {
        return held(state, command, ${PREFIX}_JUMP);
    }
    external_wrench(payload, reading->wrench_S, reading->R_WS, command->wrench_S);
    if (!are_finite(command->wrench_S, 6)) return held(state, command, ${PREFIX}_NOT_FINITE);
    command->phase = next.phase;
    command->fault = ${PREFIX}_NO_FAULT;
    if (state->resting < REST_SAMPLES) {
        fault = rest(&next, payload, command->wrench_S);
        *state = next;
        if (fault) return held(state, command, ${PREFIX}_RESIDUAL_WRENCH);
        for (i = 0; i < 6; ++i) command->increment_S[i] = command->twist_S[i] = 0.0;
        command->missing_mass_kg = next.missing_kg;
        command->is_started = 0;
        return ${PREFIX}_NO_FAULT;
    }
    if (next.wrench_same >= WRENCH_PERIODS && next.wrench_way > $unfelt) {
        return held(state, command, ${PREFIX}_STALE_WRENCH);
    }
    if (next.pose_same >= POSE_PERIODS && next.pose_way > $unseen) return held(state, command, ${PREFIX}_STALE_POSE);
    resting = step_axes(state, reading->desired_S, command->wrench_S, way, &next);
    for (i = 0; i < 6; ++i) {
        command->increment_S[i] = next.command[i] - state->command[i];
        next.twist[i] = command->twist_S[i] = command->increment_S[i] / $prefix_sample_time_s;
        if (!(is_finite(next.twist[i]) && are_finite(next.control[i], 4))) {
            return held(state, command, ${PREFIX}_NOT_FINITE);
        }
    }
    fault = resting ? ${PREFIX}_NO_FAULT : too_fast(next.twist, state->twist);
    if (fault != ${PREFIX}_NO_FAULT) return held(state, command, fault);
    if (weigh(&next, payload, command->wrench_S, command->increment_S)) {
        state->missing_kg = next.missing_kg;
        return held(state, command, ${PREFIX}_OTHER_PAYLOAD);
    }
    send(&next, command->increment_S);
    command->phase = next.phase;
    command->missing_mass_kg = next.missing_kg;
    command->is_started = 1;
    *state = next;
    return ${PREFIX}_NO_FAULT;
}
"""
)
