/* Projections: the highest, the lowest or the mean value along each ray, or the water that attenuates as much as what
 * lies along it: a digitally reconstructed radiograph.
 *
 * Samples for extremes lie on the slice planes of the axis that is nearest to the ray, and evenly between them: along
 * an axis of the volume they are its own voxels.  Bricks that cannot hold a better value are skipped.  Means and
 * radiographs are integrals: samples in the middle of segments, weighted with their lengths.  A work-item has a packet
 * of LANES neighbouring rays, as in composite.cl.
 *
 * -D UNEVEN        slices at places of their own
 * -D LEAST_VALUE   of radiographs: HU of air, which lower voxels count as */
#include "rays/field.h"
#include "rays/inner_samples.h"
#include "rays/leap.h"
#include "rays/ray_packet.h"
#include "rays/stack.h"
#include "rays/view.h"

#ifdef UNEVEN
#define MEETS_PLANES 0 /* no step meets planes at any distance */
#define MAY_LEAP 0 /* rays are no lines among the bricks */
#else
#define MEETS_PLANES 1
#define MAY_LEAP 1
#endif

#define HIGHEST 0
#define LOWEST 1
#define MEAN 2
#define RADIOGRAPH 3

#define AIR_HU (-1000.0f) /* attenuates nothing: shares of water's attenuation are (HU - AIR_HU) * WATER_PER_HU */
#define WATER_PER_HU 0.001f

#define SNAP 4096.0f /* parts of a voxel: what rounding moves a sample off a voxel is less, and does not count */
#define SAMPLES_A_LOOK 8 /* samples until a packet looks for bricks without a better value again */
#define AT_ONCE 4 /* of them that are inner ones, or not, together */

/* Samples of LANES rays: number n is at t = first_t + n * step_t, n < count.  The last one, which may lie nearer than a
 * step, has the number `last_number`, a fraction, and stands for `rest` mm. */
typedef struct {
    floats first_t, step_t, count, last_number, rest;
} row_of_samples;

/* Segments of a step, with a sample in the middle of each. */
static inline void plan_segments(const ray_packet *r, const float ray_step, ray_lanes *course, row_of_samples *s)
{
    const floats span = r->t_out - r->t_in;
    s->count = choose(span > 0.0f, round_up(span / ray_step), (floats)(0.0f));
    s->rest = span - (s->count - 1.0f) * ray_step;
    s->last_number = s->count - 1.0f - 0.5f * (1.0f - s->rest / ray_step);
    s->first_t = r->t_in + 0.5f * ray_step;
    s->step_t = ray_step;
    lay_course(r, s->first_t, s->step_t, (float4)(0.0f), course);
}

/* Samples of an extreme lie where the index along the axis nearest to the ray is a whole number of parts.  A way that
 * is too short for one (a thin slab between clip planes, a corner of the volume) has one sample in its middle. */
static inline void plan_crossings(const ray_packet *r, const float ray_step, ray_lanes *course, row_of_samples *s)
{
    const floats size_i = fabs(r->step_i), size_j = fabs(r->step_j), size_k = fabs(r->step_k);
    const ints along_i = (size_i >= size_j) & (size_i >= size_k);
    const ints along_j = choose(along_i, (ints)(0), size_j >= size_k);
    const floats rate = choose(along_i, r->step_i, choose(along_j, r->step_j, r->step_k));
    const floats origin = choose(along_i, r->origin_i, choose(along_j, r->origin_j, r->origin_k));
    const floats parts = greater(round_up(1.0f / (fabs(rate) * ray_step) - 1e-3f), (floats)(1.0f));
    const floats enter = (origin + r->t_in * rate) * parts, leave = (origin + r->t_out * rate) * parts;
    const float slack = 1.0f / SNAP;
    const ints forward = rate >= 0.0f;
    const floats first = choose(forward, round_up(enter - slack), -round_up(-(enter + slack)));
    const floats last = choose(forward, -round_up(-(leave + slack)), round_up(leave - slack));
    const floats found = choose(forward, last - first, first - last) + 1.0f;
    const ints between = found < 1.0f;
    s->count = choose(r->t_out > r->t_in, greater(found, (floats)(1.0f)), (floats)(0.0f));
    s->first_t = choose(between, 0.5f * (r->t_in + r->t_out), (first / parts - origin) / rate);
    s->step_t = 1.0f / (parts * fabs(rate));
    s->last_number = s->count;
    s->rest = 0.0f;
    lay_course(r, s->first_t, s->step_t, (float4)(0.0f), course);
    /* Along their axis places are whole numbers of parts, without rounding. */
    const floats start = first / parts, stride = choose(forward, 1.0f / parts, -1.0f / parts);
    const ints exact_i = choose(between, (ints)(0), along_i), exact_j = choose(between, (ints)(0), along_j);
    const ints exact_k = choose(between | along_i | along_j, (ints)(0), (ints)(-1));
    course->start_i = choose(exact_i, start, course->start_i);
    course->stride_i = choose(exact_i, stride, course->stride_i);
    course->start_j = choose(exact_j, start, course->start_j);
    course->stride_j = choose(exact_j, stride, course->stride_j);
    course->start_k = choose(exact_k, start, course->start_k);
    course->stride_k = choose(exact_k, stride, course->stride_k);
}

/* Rounded to parts of a voxel, so that places that miss a voxel by a rounding error lie on it. */
static inline floats snap(const floats index)
{
    const floats upward = choose(index < 0.0f, (floats)(-0.5f), (floats)(0.5f));
    return to_floats(to_ints(index * SNAP + upward)) * (1.0f / SNAP);
}

/* Samples of each ray from a place on that lie in a brick with no value over `best`, k counted from the buffer's first
 * slice; 0 where the brick has one. */
static inline floats count_useless(const leap_map *map, __global const VOXEL *limits, const float sign,
    const ray_lanes *course, const floats best, const floats i, const floats j, const floats k)
{
    const float bricks_per_k = 1.0f / (float)map->cells_k;
    const ints brick_i = lesser_int(greater_int(to_ints(i * BRICKS_PER_CELL), (ints)(0)), (ints)(map->bi - 1));
    const ints brick_j = lesser_int(greater_int(to_ints(j * BRICKS_PER_CELL), (ints)(0)), (ints)(map->bj - 1));
    const ints brick_k = lesser_int(greater_int(to_ints(k * bricks_per_k), (ints)(0)), (ints)(map->bk - 1));
    const ints at = 2 * ((brick_k * map->bj + brick_j) * map->bi + brick_i);
    const floats limit = sign * (floats)(GATHER(VOXEL, limits, at));
    const ints own = 1;
    const floats to_i = count_to_face(i, course->pace_i, brick_i, own, BRICK_CELLS);
    const floats to_j = count_to_face(j, course->pace_j, brick_j, own, BRICK_CELLS);
    const floats to_k = count_to_face(k, course->pace_k, brick_k, own, map->cells_k);
    const floats steps = round_up(lesser(lesser(lesser(to_i, to_j), to_k), (floats)(1e6f)));
    return choose(limit <= best, greater(steps, (floats)(1.0f)), (floats)(0.0f));
}

/* Parameters  voxels   in   (slices, nj, ni)
 *             ranges   in   (bk, bj, bi, 2) lowest and highest value of each brick
 *             view     in   see rays/view.h
 *             states   in/out  (height, width, 2) float4: value or integral, t, length, -; -
 *             depths   out  (height, width) mm to the extreme; NaN where the ray misses, and for means
 *             values   out  (height, width) NaN where the ray misses; of radiographs mm of water, 0 there
 *             the rest as in composite.cl
 * Launch      global = tiles * 64 / LANES rounded up by the host, any local
 * Guarantees  every pixel is written with the last slab */
__kernel void project_rays(
    __global const VOXEL *restrict voxels, __global const VOXEL *restrict ranges, __global const float4 *restrict view,
    __global float4 *restrict states, __global float *restrict depths, __global float *restrict values,
    const float4 last_place, const int ni, const int nj, const int first_k, const int end_k, const float slab_low,
    const float slab_high, const int bi, const int bj, const int bk, const int cells_k, const uint width,
    const uint height, const uint planes, const int perspective, const int which, const int stage, const uint queues
    STACK_PARAMETERS)
{
    const int2 first = find_pixel((uint)get_global_id(0) * LANES, width, height, queues);
    const field f = { voxels, ni, nj, first_k, end_k, last_place };
    const slice_stack stack = STACK_TABLE;
    const leap_map map = { 0, bi, bj, bk, cells_k };
    const float ray_step = view[VIEW_NEAR].y;
    const floats x = (float)first.x + LANE_NUMBERS, y = (float)first.y;
    ray_packet way;
    start_packet(view, x, y, planes, perspective, &way);
    ray_lanes course;
    row_of_samples row;
    const int on_planes = MEETS_PLANES && (which == HIGHEST || which == LOWEST);
    const int sums = which == MEAN || which == RADIOGRAPH;
    const int leaps = MAY_LEAP && which != MEAN;
    if (on_planes)
        plan_crossings(&way, ray_step, &course, &row);
    else
        plan_segments(&way, ray_step, &course, &row);
    const floats end = choose((x < (float)width) & (y < (float)height), row.count, (floats)(0.0f));
    float inner_begin, inner_end;
    find_inner(&f, &way, row.first_t, row.step_t, row.count - 1.0f, slab_low, slab_high, &inner_begin, &inner_end);

    /* Lowest values are the highest of the field turned over. */
    const float sign = which == LOWEST ? -1.0f : 1.0f;
    __global const VOXEL *limits = ranges + (which != LOWEST);
    floats best = sums ? 0.0f : -MAXFLOAT, best_t = 0.0f, length_mm = 0.0f;
    float value_of[LANES], t_of[LANES], mm_of[LANES], offset_of[LANES]; /* states: these three, lane by lane */
    if (!(stage & FIRST_SLAB)) {
        for (int lane = 0; lane < LANES; ++lane) {
            const int inside = first.x + lane < (int)width && first.y < (int)height;
            const size_t place = (size_t)first.y * width + (size_t)(first.x + lane);
            const float4 state = inside ? states[2 * place] : (float4)(0.0f);
            value_of[lane] = state.x;
            t_of[lane] = state.y;
            mm_of[lane] = state.z;
        }
        best = load_lanes(value_of);
        best_t = load_lanes(t_of);
        length_mm = load_lanes(mm_of);
    }
    float n = 0.0f;
    while (ANY_LANE(n < end)) {
        if (leaps) {
            const floats i = snap(course.start_i + n * course.stride_i), j = snap(course.start_j + n * course.stride_j);
            const floats k = snap(course.start_k + n * course.stride_k) - (float)first_k;
            const floats least = which == RADIOGRAPH ? (floats)(AIR_HU) : best;
            const floats useless = count_useless(&map, limits, sign, &course, least, i, j, k);
            const float free = LEAST_LANE(choose(n < end, useless, (floats)(MAXFLOAT)));
            if (free > 0.0f) {
                n += free;
                continue;
            }
        }
        for (int part = 0; part < SAMPLES_A_LOOK && ANY_LANE(n < end); part += AT_ONCE) {
            const int inner = HAS_INNER && n >= inner_begin && n + (float)AT_ONCE <= inner_end;
            for (int sample = 0; sample < AT_ONCE; ++sample) {
                const float number = n + (float)sample;
                const floats at = lesser((floats)(number), row.last_number);
                floats i = course.start_i + at * course.stride_i, j = course.start_j + at * course.stride_j;
                floats k = course.start_k + at * course.stride_k;
                to_indices(&stack, &i, &j, &k);
                if (on_planes) {
                    i = snap(i);
                    j = snap(j);
                    k = snap(k);
                }
                const ints counts
                    = (number < end) & (k >= slab_low) & (k < slab_high) & lie_in_slice(&f, i, j);
                const floats value = sign * sample_lanes(&f, i, j, k, inner);
                if (sums) {
                    const floats mm = choose(number < row.count - 1.0f, (floats)(ray_step), row.rest);
                    const floats weight = choose(counts, greater(mm, (floats)(0.0f)), (floats)(0.0f));
                    const floats water = greater(value - AIR_HU, (floats)(0.0f)) * WATER_PER_HU;
                    best += weight * (which == MEAN ? value : water);
                    length_mm += weight;
                } else {
                    const ints better = counts & (value > best);
                    best = choose(better, value, best);
                    best_t = choose(better, row.first_t + at * row.step_t, best_t);
                    length_mm = choose(counts, (floats)(1.0f), length_mm);
                }
            }
            n += (float)AT_ONCE;
        }
    }
    store_lanes(best, value_of);
    store_lanes(best_t, t_of);
    store_lanes(length_mm, mm_of);
    store_lanes(way.offset, offset_of);
    for (int lane = 0; lane < LANES; ++lane) {
        if (first.x + lane >= (int)width || first.y >= (int)height)
            continue;
        const size_t place = (size_t)first.y * width + (size_t)(first.x + lane);
        if (!(stage & LAST_SLAB)) {
            states[2 * place] = (float4)(value_of[lane], t_of[lane], mm_of[lane], 0.0f);
            continue;
        }
        const int missed = !(mm_of[lane] > 0.0f);
        const float mean = value_of[lane] / mm_of[lane];
        const float missing = which == RADIOGRAPH ? 0.0f : NAN; /* what is not scanned is air */
        values[place] = missed ? missing : which == MEAN ? mean : sign * value_of[lane];
        depths[place] = missed || sums ? NAN : t_of[lane] + offset_of[lane];
    }
}
