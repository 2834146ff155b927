"""The header of an exported controller, with `$words` to be filled in."""

HEADER = """\
/* format: autotune/c, version 1: $prefix.h, written by autotune $tool_version. Do not edit; export it again.
 *
 * The six-axis admittance controller of a validated controller file
$about
 * $signature
 *
 * Compile $prefix.c as C99 and without -ffast-math. No allocation, no library, no global state.
 *
 *     $prefix_state state;
 *     $prefix_payload payload = $prefix_file_payload;
 *     if ($prefix_check(&payload, period_s, inertia_kg_m2) != ${PREFIX}_ACCEPTED) refuse();
 *     $prefix_start(&state);
 *     each period: $prefix_step(&state, &payload, &reading, &command);
 */
#ifndef ${PREFIX}_H
#define ${PREFIX}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The first digits of the checksum, by which $prefix.c refuses the header of another controller. */
#define ${PREFIX}_CHECKSUM_HEAD 0x${head}UL

/* Why a cell is refused. */
enum {
    ${PREFIX}_ACCEPTED = 0,
    ${PREFIX}_OTHER_SAMPLE_TIME = 1,
    ${PREFIX}_MASS_NOT_CERTIFIED = 2,
    ${PREFIX}_INERTIA_NOT_CERTIFIED = 3
};

/* Why the command is held; a fault lasts until $prefix_start, with the robot at rest. */
enum {
    ${PREFIX}_NO_FAULT = 0,
    ${PREFIX}_NOT_FINITE = 1,
    ${PREFIX}_NOT_A_ROTATION = 2,
    ${PREFIX}_JUMP = 3,
    ${PREFIX}_FORCE_RANGE = 4,
    ${PREFIX}_TORQUE_RANGE = 5,
    ${PREFIX}_SPEED = 6,
    ${PREFIX}_ACCELERATION = 7,
    ${PREFIX}_STALE_WRENCH = 8,
    ${PREFIX}_STALE_POSE = 9,
    ${PREFIX}_RESIDUAL_WRENCH = 10,
    ${PREFIX}_OTHER_PAYLOAD = 11,
    ${PREFIX}_MISSED_TICK = 12,
    ${PREFIX}_REPEATED_TICK = 13
};

/* Where the collision response is; it responds once and then waits for $prefix_rearm. */
enum { ${PREFIX}_WATCHING = 0, ${PREFIX}_RESPONDED = 1, ${PREFIX}_STOPPED = 2 };

/* What the gravity compensation takes off the wrench: in the sensor frame S, gravity in the world frame W, down. */
typedef struct {
    double mass_kg;
    double com_S_m[3];
    double force_bias_S_n[3];
    double torque_bias_S_n_m[3];
    double gravity_W_m_s2[3];
} $prefix_payload;

/* One period's input: the raw wrench that the payload puts on the flange (N, N m; in S, about its origin), the
 * measured pose of S (R_WS row by row, v_W = R_WS v_S), F^d (N, N m; positive presses along the axis), and, unless
 * has_tick is 0, the caller's count of the periods, one more in each; without it no missing period is noticed. */
typedef struct {
    double wrench_S[6];
    double position_W_m[3];
    double R_WS[9];
    double desired_S[6];
    uint32_t tick;
    int has_tick;
} $prefix_reading;

/* One period's output: how the commanded pose goes on (m, rad), the same per second, both in the axes of S, and the
 * wrench without weight and bias. Axes that are not tuned do not move. is_started is 0 while the first readings are
 * held against rest; missing_mass_kg is what the compensation leaves along gravity: of their mean, later of the last
 * ones. */
typedef struct {
    double increment_S[6];
    double twist_S[6];
    double wrench_S[6];
    double missing_mass_kg;
    int phase;
    int fault;
    int is_started;
} $prefix_command;

typedef struct {
    double control[6][4];
    double drive[6];
    double position[6];
    double command[6];
    double position_W_m[3];
    double R_WS[9];
    double twist[6];
    double wrench[6];
    double sums[6];
    double wrench_way;
    double pose_way;
    double missing_kg;
    double weight_kg;
    double weight_work;
    int wrench_same;
    int pose_same;
    int resting;
    int weight_since;
    int has_pose;
    int phase;
    int fault;
    int has_tick;
    uint32_t tick;
} $prefix_state;

extern const char $prefix_checksum[65];
/* The fingerprint of the key whose signature of the file was verified at the export, "" where none was asked for. */
extern const char $prefix_signed_by[17];
extern const double $prefix_sample_time_s;
extern const $prefix_payload $prefix_file_payload;

/* Return whether the certificate holds for the cell: its period, the mass in `payload`, and the payload's inertia about
 * rx, ry, rz, of which those that are not tuned are not looked at. */
int $prefix_check(const $prefix_payload *payload, double sample_time_s, const double inertia_kg_m2[3]);

/* Begin, with the robot at rest and nothing touching it. */
void $prefix_start($prefix_state *state);

/* Do one period and return the fault, which is also in the command. */
int $prefix_step($prefix_state *state, const $prefix_payload *payload, const $prefix_reading *reading,
    $prefix_command *command);

/* Watch for the next collision, and go on after a full stop. */
void $prefix_rearm($prefix_state *state);

#ifdef __cplusplus
}
#endif

#endif
"""
