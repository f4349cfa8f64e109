/* Samples of a packet that are taken together before any is blended: whether one of them may show is decided once, and
 * their loads need not wait for each other.
 *
 *      value[0] ...         with TAKES_PARTS        n - 1   n   n + 1 ... n + AT_ONCE
 *                           without                         n   n + 1 ... n + AT_ONCE - 1
 *
 * In each variant:
 *
 *      find_number        number of sample n, seen `shift` samples beside it; unless `inner` it may be the last of its ray
 *      forget_samples     the rays leap: no sample before the next one is known
 *      begin_samples      find what the samples from n on need of those before; n may go back
 *      note_before        take the values of those before
 *      note_sample        take one more value; `before` is the one before it
 *      end_samples        whether one of them may show, lane by lane
 *      find_segment       the segment of entry `at` of the values, and what is beside it */
#ifndef CLRECON_SAMPLE_RUN_H
#define CLRECON_SAMPLE_RUN_H

#include "rays/inner_samples.h"
#include "rays/steep_segments.h"

#define AT_ONCE 4

#if TAKES_PARTS
typedef struct {
    floats before, here; /* values of samples n - 1 and n, where `goes_on` */
    int goes_on;
    floats least, most, widest; /* of the values: extremes, and the largest step */
    int may_be_steep;
} sample_run;

static inline floats find_number(
    const packet *rays, const looks *look, const float n, const int inner, const floats shift)
{
    if (inner)
        return n + shift;
    return choose(rays->last == n, rays->last_number + shift * (rays->rest / look->ray_step), n + shift);
}

static inline void forget_samples(sample_run *run) { run->goes_on = 0; }

static inline void begin_samples(const field *f, const slice_stack *stack, const looks *look, const ray_lanes *course,
    const packet *rays, const int one_sided, float *n, sample_run *run)
{
    if (run->goes_on)
        return;
    int inner = HAS_INNER && *n >= rays->inner_begin && *n + 1.0f <= rays->inner_end;
    floats here = find_value(f, stack, look, course, rays, (floats)(*n), inner), before = here;
    /* The segment of the sample before reaches half way to this one.  Where one side of the values shows, and this one
     * does not, that segment shows nothing either. */
    if (!one_sided || ANY_LANE((here >= look->first_value) & (here < look->last_value))) {
        *n = max(*n - 1.0f, 0.0f);
        inner = HAS_INNER && *n - 1.0f >= rays->inner_begin && *n + 1.0f <= rays->inner_end;
        const floats place = *n > 0.0f ? (floats)(*n - 1.0f) : -lesser(rays->phase, (floats)(0.5f));
        here = find_value(f, stack, look, course, rays, (floats)(*n), inner);
        before = find_value(f, stack, look, course, rays, place, inner);
        before = *n > 0.0f ? before : before + (before - here);
    }
    run->here = here;
    run->before = before;
    run->goes_on = 1;
}

static inline void note_before(sample_run *run, floats *value)
{
    value[0] = run->before;
    value[1] = run->here;
    run->least = lesser(run->before, run->here);
    run->most = greater(run->before, run->here);
    run->widest = fabs(run->here - run->before);
}

static inline void note_sample(const looks *look, const floats before, const floats value, sample_run *run)
{
    run->least = lesser(run->least, value);
    run->most = greater(run->most, value);
    run->widest = greater(run->widest, fabs(value - before));
}

static inline ints end_samples(const looks *look, const floats *value, const int has_dense, sample_run *run)
{
    run->before = value[AT_ONCE];
    run->here = value[AT_ONCE + 1];
    run->may_be_steep = has_dense || ANY_LANE(run->widest > look->narrow);
    return (run->most >= look->first_value) & (run->least < look->last_value);
}

static inline segment_values find_segment(
    const sample_run *run, const floats *value, const int at, const float segment)
{
    const segment_values v
        = { value[at], value[at + 1], value[at + 2], segment > 0.0f ? 2.0f : 1.0f, run->may_be_steep };
    return v;
}
#else
typedef struct {
    ints may_show;
} sample_run;

static inline floats find_number(
    const packet *rays, const looks *look, const float n, const int inner, const floats shift)
{
    return inner ? (floats)(n) : lesser((floats)(n), rays->last_number);
}

static inline void forget_samples(sample_run *run) {}

static inline void begin_samples(const field *f, const slice_stack *stack, const looks *look, const ray_lanes *course,
    const packet *rays, const int one_sided, float *n, sample_run *run)
{
}

static inline void note_before(sample_run *run, floats *value) { run->may_show = 0; }

static inline void note_sample(const looks *look, const floats before, const floats value, sample_run *run)
{
    run->may_show |= (value >= look->first_value) & (value < look->last_value);
}

static inline ints end_samples(const looks *look, const floats *value, const int has_dense, sample_run *run)
{
    return run->may_show;
}

static inline segment_values find_segment(
    const sample_run *run, const floats *value, const int at, const float segment)
{
    const segment_values v = { value[at] };
    return v;
}
#endif

/* Take the values of AT_ONCE samples from n on, with those BESIDE them.  Returns whether one of them may show. */
static inline ints take_samples(const field *f, const slice_stack *stack, const looks *look, const ray_lanes *course,
    const packet *rays, const float n, const int inner, const int has_dense, floats *value, sample_run *run)
{
    note_before(run, value);
#if LANES == 1
#pragma unroll
#endif
    for (int sample = 2 * BESIDE; sample < AT_ONCE + 2 * BESIDE; ++sample) {
        value[sample] = find_value(f, stack, look, course, rays, (floats)(n + (float)(sample - BESIDE)), inner);
        note_sample(look, value[max(sample - 1, 0)], value[sample], run);
    }
    return end_samples(look, value, has_dense, run);
}

#endif
