"""The C of what an exported controller watches beside its law: `autotune.runtime.guard` operation by operation."""

SOURCE_GUARD = """\
static int are_equal(const double *a, const double *b, int count)
{
    int i;
    for (i = 0; i < count; ++i) {
        if (a[i] < b[i] || a[i] > b[i]) return 0;
    }
    return 1;
}

static int one_more(int count)
{
    return count < MOST_PERIODS ? count + 1 : count;
}

static int all_below(const double *a, int count, double limit)
{
    int i;
    for (i = 0; i < count; ++i) {
        if (!(magnitude(a[i]) < limit)) return 0;
    }
    return 1;
}

/* What is wrong with a reading by itself, and with its count. */
static int unsound(const $prefix_state *state, const $prefix_reading *reading)
{
    if (state->has_tick) {
        uint32_t further = reading->has_tick ? reading->tick - state->tick : 2u;
        if (further == 0u || further >= 0x80000000u) return ${PREFIX}_REPEATED_TICK;
        if (further > 1u) return ${PREFIX}_MISSED_TICK;
    }
    if (!(are_finite(reading->wrench_S, 6) && are_finite(reading->desired_S, 6) && are_finite(reading->position_W_m, 3)
            && are_finite(reading->R_WS, 9))) {
        return ${PREFIX}_NOT_FINITE;
    }
    if (!is_rotation(reading->R_WS)) return ${PREFIX}_NOT_A_ROTATION;
    if (!all_below(reading->wrench_S, 3, force_n)) return ${PREFIX}_FORCE_RANGE;
    if (!all_below(reading->wrench_S + 3, 3, torque_n_m)) return ${PREFIX}_TORQUE_RANGE;
    return ${PREFIX}_NO_FAULT;
}

/* Keep a sound reading: what did not change counts on, what did begins again. */
static void see($prefix_state *next, const $prefix_reading *reading)
{
    int i, still = next->has_pose && are_equal(next->position_W_m, reading->position_W_m, 3)
        && are_equal(next->R_WS, reading->R_WS, 9);
    int same = next->has_pose && are_equal(next->wrench, reading->wrench_S, 6);
    next->wrench_same = same ? one_more(next->wrench_same) : 0;
    next->wrench_way = same ? next->wrench_way : 0.0;
    next->pose_same = still ? one_more(next->pose_same) : 0;
    next->pose_way = still ? next->pose_way : 0.0;
    next->tick = reading->tick;
    next->has_tick = reading->has_tick != 0;
    for (i = 0; i < 6; ++i) next->wrench[i] = reading->wrench_S[i];
    keep_pose(next, reading);
}

/* Count what was sent since a reading changed. */
static void send($prefix_state *next, const double increment[6])
{
    double way = 0.0;
    int i;
    for (i = 0; i < 6; ++i) way += magnitude(increment[i]);
    next->wrench_way = next->wrench_way + way;
    next->pose_way = next->pose_way + way;
}

/* F g / g^2, the mass whose weight the compensation leaves of the wrench; 0 without gravity. */
static double missing_mass(const $prefix_payload *p, double square, const double force[3], const double R[9])
{
    double down[3];
    if (!(square > 0.0)) return 0.0;
    into_sensor(R, p->gravity_W_m_s2, down);
    return dot(force, down) / square;
}

/* Take one of the first readings; 1 where their mean is no rest. */
static int rest($prefix_state *next, const $prefix_payload *p, const double wrench[6])
{
    double mean[6];
    int i;
    next->resting = next->resting + 1;
    for (i = 0; i < 6; ++i) next->sums[i] = next->sums[i] + wrench[i];
    if (next->resting < REST_SAMPLES) return 0;
    for (i = 0; i < 6; ++i) mean[i] = next->sums[i] / (double)next->resting;
    next->missing_kg = missing_mass(p, dot(p->gravity_W_m_s2, p->gravity_W_m_s2), mean, next->R_WS);
    return dot(mean, mean) > rest_force || dot(mean + 3, mean + 3) > rest_torque;
}

/* 1 where a constant weight that is not compensated moves the command: the payload is another one. */
static int weigh($prefix_state *next, const $prefix_payload *p, const double force[6], const double increment[6])
{
    double square = dot(p->gravity_W_m_s2, p->gravity_W_m_s2), now = missing_mass(p, square, force, next->R_WS);
    double mean = next->missing_kg + (now - next->missing_kg) / $mean_periods;
    double along = mean * mean * square, moved = mean - next->weight_kg;
    double across = dot(force, force) - now * now * square, least = $least_share * p->mass_kg;
    next->missing_kg = mean;
    if (!(moved * moved * square <= rest_force && across <= $across * along + rest_force && along >= least_weight
            && mean * mean >= least * least)) {
        next->weight_kg = mean;
        next->weight_since = 0;
        next->weight_work = 0.0;
        return 0;
    }
    next->weight_since = one_more(next->weight_since);
    next->weight_work = next->weight_work + dot(force, increment);
    return next->weight_since >= WEIGHT_PERIODS && next->weight_work > 0.0
        && next->weight_work * next->weight_work >= $weight_way * $weight_way * along;
}

/* Which limit of the command a twist breaks. */
static int too_fast(const double twist[6], const double before[6])
{
    int k;
    for (k = 0; k < TUNED; ++k) {
        if (magnitude(twist[laws[k].index]) > laws[k].speed) return ${PREFIX}_SPEED;
    }
    for (k = 0; k < TUNED; ++k) {
        int i = laws[k].index;
        if (magnitude(twist[i] - before[i]) > laws[k].change) return ${PREFIX}_ACCELERATION;
    }
    return ${PREFIX}_NO_FAULT;
}

"""
