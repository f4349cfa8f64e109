/* Samples along lines through the closed field, and the place of the first one inside. */
#ifndef CLRECON_SURFACE_LINES_H
#define CLRECON_SURFACE_LINES_H

#include "rays/closed_field.h"
#include "rays/leap.h"
#include "rays/stack.h"

#define SPLIT (LANES > 1 ? LANES : 2)
#define NARROWED 64 /* a crossing is sought in a part of a step this small, and there on a line */

/* Samples along a line in field coordinates: number n is at start + min(n, last) * stride. */
typedef struct {
    float4 start, stride;
    float last;
} line;

typedef struct {
    closed_field field;
    leap_map map;
    slice_stack stack;
    float4 slope; /* see find_pace() */
} scene;

static inline floats sample_line(const scene *s, const line *along, const floats number)
{
    const floats n = min(number, (floats)(along->last));
    floats i = along->start.x + n * along->stride.x, j = along->start.y + n * along->stride.y;
    floats k = along->start.z + n * along->stride.z;
    to_indices(&s->stack, &i, &j, &k);
    return sample_closed(&s->field, i, j, k);
}

static inline float4 place_on(const line *along, const float number)
{
    return along->start + min(number, along->last) * along->stride;
}

/* Index coordinates of a place in field coordinates. */
static inline float3 index_of(const scene *s, const float4 place)
{
    floats i = (floats)(place.x), j = (floats)(place.y), k = (floats)(place.z);
    to_indices(&s->stack, &i, &j, &k);
    return (float3)(FIRST_LANE(i), FIRST_LANE(j), FIRST_LANE(k));
}

/* Samples of LANES lines, those from `numbers` to below `ends`.  With `last_counts` no leap may skip the last of them:
 * it is less than a stride from the one before. */
typedef struct {
    line lines[LANES];
    float numbers[LANES], ends[LANES];
    int last_counts;
} bundle;

static inline void gather_lines(const scene *s, const bundle *all, ray_lanes *together)
{
    float parts[6][LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const float4 start = all->lines[lane].start, stride = all->lines[lane].stride;
        parts[0][lane] = start.x;
        parts[1][lane] = start.y;
        parts[2][lane] = start.z;
        parts[3][lane] = stride.x;
        parts[4][lane] = stride.y;
        parts[5][lane] = stride.z;
    }
    together->start_i = load_lanes(parts[0]);
    together->start_j = load_lanes(parts[1]);
    together->start_k = load_lanes(parts[2]);
    together->stride_i = load_lanes(parts[3]);
    together->stride_j = load_lanes(parts[4]);
    together->stride_k = load_lanes(parts[5]);
    find_pace(together, s->slope);
}

/* Follow a line from sample n until one is inside, its brick cannot reach the level, or it ends.  (rusticl of Mesa 22
 * goes wrong where such a loop returns from its middle.) */
static inline int follow_line(const scene *s, const line *along, int n, const int end, int *found)
{
    int going = 1;
    while (going) {
        const floats value = sample_line(s, along, (float)n + LANE_NUMBERS);
        if (ANY_LANE(value >= s->field.level)) {
            n += (int)LEAST_LANE(choose(value >= s->field.level, LANE_NUMBERS, (floats)(LANES)));
            *found = n < end;
            going = 0;
        } else {
            n += LANES;
            const float3 next = index_of(s, along->start + (float)n * along->stride);
            going = n < end && is_shown(&s->map, next.x, next.y, next.z - (float)s->field.inner.first_k);
        }
    }
    return min(n, end);
}

/* Move `numbers` of all lines to their first sample that is inside, or to their ends. */
static inline void find_inside(const scene *s, bundle *all)
{
    ray_lanes together;
    gather_lines(s, all, &together);
    float limits[LANES];
    for (int lane = 0; lane < LANES; ++lane)
        limits[lane] = all->ends[lane];
    floats n = load_lanes(all->numbers), limit = load_lanes(limits);
    while (ANY_LANE(n < limit)) {
        const floats furthest = limit - (all->last_counts ? 1.0f : 0.0f);
        for (;;) {
            const floats free = count_free_steps(&s->map, &s->stack, &together, n, s->field.inner.first_k, 0);
            const ints leaping = (free > 0.0f) & (n < furthest);
            if (!ANY_LANE(leaping))
                break;
            n = choose(leaping, min(n + free, furthest), n);
        }
        store_lanes(n, all->numbers);
        for (int lane = 0; lane < LANES; ++lane)
            if (all->numbers[lane] < limits[lane]) {
                int found = 0;
                all->numbers[lane] = (float)follow_line(
                    s, all->lines + lane, (int)all->numbers[lane], (int)limits[lane], &found);
                limits[lane] = found ? -1.0f : limits[lane];
            }
        n = load_lanes(all->numbers);
        limit = load_lanes(limits);
    }
}

/* Where on a line the field reaches the level: between sample n - 1, which is outside, and n, which is inside. */
static inline float find_crossing(const scene *s, const line *along, const int n)
{
    float low = (float)(n - 1), high = min((float)n, along->last);
    for (int parts = 1; parts < NARROWED; parts *= SPLIT) {
        const float part = (high - low) / (float)SPLIT;
        const floats number = low + part * (LANE_NUMBERS + 1.0f);
        const floats value = sample_line(s, along, number);
        high = LEAST_LANE(choose(value >= s->field.level, number, (floats)(high)));
        low = high - part;
    }
    const float at_low = FIRST_LANE(sample_line(s, along, (floats)(low)));
    const float at_high = FIRST_LANE(sample_line(s, along, (floats)(high)));
    const float share = (s->field.level - at_low) / max(at_high - at_low, 1e-20f);
    return low + clamp(share, 0.0f, 1.0f) * (high - low);
}

#endif
