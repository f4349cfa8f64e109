/* Projections: the highest, the lowest or the mean value along each ray.
 *
 * Extremes are taken of samples on every slice plane of the axis that runs most along the ray, and evenly between
 * them: along an axis of the volume they are its own voxels.  Bricks that cannot hold a better value are passed over.
 * Means are integrals: samples in the middle of segments, weighted with their lengths.
 *
 * -D UNEVEN   slices at places of their own */
#include "include/field.h"
#include "include/leap.h"
#include "include/stack.h"
#include "include/view.h"

#define HIGHEST 0
#define LOWEST 1
#define MEAN 2

#define SNAP 4096.0f /* parts of a voxel: what rounding moves a sample off a voxel is less, and does not count */

/* Samples of an extreme: sample n lies where the axis' index is (first + n * toward) / parts.  A way so short that none
 * falls into it (a thin slab between clip planes, a corner of the volume) has one in its middle: `between`. */
typedef struct {
    int axis, toward, parts;
    int first, count, between;
    float origin, step; /* of the ray, along the axis */
} crossings;

static inline float component(const float4 v, const int axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }

static inline void plan_crossings(const ray *r, const float ray_step, crossings *c)
{
    const float i = fabs(r->step.x), j = fabs(r->step.y), k = fabs(r->step.z);
    c->axis = i >= j && i >= k ? 0 : j >= k ? 1 : 2;
    c->step = component(r->step, c->axis);
    c->origin = component(r->origin, c->axis);
    c->toward = c->step < 0.0f ? -1 : 1;
    c->parts = max(1, (int)ceil(1.0f / (fabs(c->step) * ray_step) - 1e-3f));
    const float parts = (float)c->parts, slack = 1.0f / SNAP;
    const float from = (c->origin + r->t_in * c->step) * parts, to = (c->origin + r->t_out * c->step) * parts;
    c->first = c->toward > 0 ? (int)ceil(from - slack) : (int)floor(from + slack);
    const int last = c->toward > 0 ? (int)floor(to + slack) : (int)ceil(to - slack);
    const int found = (last - c->first) * c->toward + 1;
    c->between = found < 1;
    c->count = r->t_out > r->t_in ? max(found, 1) : 0;
}

/* Parameters  voxels   in   (slices, nj, ni)
 *             ranges   in   (bk, bj, bi, 2) lowest and highest value of each brick
 *             view     in   see include/view.h
 *             states   in/out  (height, width, 2) float4: value or integral, t, length, -; -
 *             depths   out  (height, width) mm to the extreme; NaN where the ray misses, and for means
 *             values   out  (height, width) NaN where the ray misses
 *             the rest as in composite.cl
 * Launch      global = tiles * 64 rounded up by the host, any local
 * Guarantees  every pixel is written with the last slab */
__kernel void project_rays(
    __global const VOXEL *restrict voxels, __global const VOXEL *restrict ranges, __global const float4 *restrict view,
    __global float4 *restrict states, __global float *restrict depths, __global float *restrict values,
    const float4 last_place, const int ni, const int nj, const int first_k, const int end_k, const float slab_low,
    const float slab_high, const int bi, const int bj, const int bk, const int cells_k, const uint width,
    const uint height,
    const uint planes, const int perspective, const int which, const int stage, const uint queues STACK_PARAMETERS)
{
    const int2 pixel = find_pixel((uint)get_global_id(0), width, height, queues);
    if (pixel.x >= (int)width || pixel.y >= (int)height)
        return;
    const size_t place = (size_t)pixel.y * width + (size_t)pixel.x;
    const field f = { voxels, ni, nj, first_k, end_k, last_place };
    ray r;
    start_ray(view, convert_float2(pixel), planes, perspective, &r);
    const float ray_step = view[VIEW_NEAR].y;
    const float span = r.t_out - r.t_in;

    const slice_stack stack = STACK_TABLE;
    crossings c;
    plan_crossings(&r, ray_step, &c);
    const int segments = span > 0.0f ? (int)ceil(span / ray_step) : 0;
#ifdef UNEVEN
    const int on_planes = 0; /* no step meets planes at any distance */
#else
    const int on_planes = which != MEAN;
#endif
    const int count = on_planes ? c.count : segments;
    /* Lowest values are the highest of the field turned over. */
    const float sign = which == LOWEST ? -1.0f : 1.0f;
    float best = which == MEAN ? 0.0f : -MAXFLOAT, t_best = 0.0f, length_mm = 0.0f;
    if (!(stage & FIRST_SLAB)) {
        best = states[2 * place].x;
        t_best = states[2 * place].y;
        length_mm = states[2 * place].z;
    }
    const float rate = (float)c.toward / ((float)c.parts * c.step); /* mm from one sample to the next */
    int n = 0;
    while (n < count) {
        const floats number = (float)n + LANE_NUMBERS;
        floats t, weight;
        if (!on_planes) {
            const floats from = number * ray_step;
            weight = min((floats)(ray_step), span - from);
            t = r.t_in + from + 0.5f * weight;
        } else {
            const floats along = ((float)c.first + number * (float)c.toward) / (float)c.parts;
            t = c.between ? (floats)(0.5f * (r.t_in + r.t_out)) : (along - c.origin) / c.step;
            weight = choose(number < (float)count, (floats)(1.0f), (floats)(0.0f));
        }
        floats i = r.origin.x + t * r.step.x, j = r.origin.y + t * r.step.y, k = r.origin.z + t * r.step.z;
        to_indices(&stack, &i, &j, &k);
        if (on_planes) {
            i = rint(i * SNAP) / SNAP;
            j = rint(j * SNAP) / SNAP;
            k = rint(k * SNAP) / SNAP;
            const float from_i = FIRST_LANE(i), from_j = FIRST_LANE(j), from_k = FIRST_LANE(k) - (float)first_k;
            const int brick_i = clamp((int)(from_i * BRICKS_PER_CELL), 0, bi - 1);
            const int brick_j = clamp((int)(from_j * BRICKS_PER_CELL), 0, bj - 1);
            const int brick_k = clamp((int)(from_k / (float)cells_k), 0, bk - 1);
            const size_t brick = ((size_t)brick_k * bj + brick_j) * bi + brick_i;
            if (sign * (float)ranges[2 * brick + (which == HIGHEST)] <= best) {
                const float room_i = (float)((brick_i + (r.step.x >= 0.0f)) * BRICK_CELLS) - from_i;
                const float room_j = (float)((brick_j + (r.step.y >= 0.0f)) * BRICK_CELLS) - from_j;
                const float room_k = (float)((brick_k + (r.step.z >= 0.0f)) * cells_k) - from_k;
                const float t_i = fabs(r.step.x) > 1e-9f ? room_i / r.step.x : MAXFLOAT;
                const float t_j = fabs(r.step.y) > 1e-9f ? room_j / r.step.y : MAXFLOAT;
                const float t_k = fabs(r.step.z) > 1e-9f ? room_k / r.step.z : MAXFLOAT;
                n += max(1, (int)ceil(min(min(min(t_i, t_j), t_k) / rate, 1e6f)));
                continue;
            }
        }
        ints counts = (k >= slab_low) & (k < slab_high);
#ifdef UNEVEN
        counts &= (i >= -0.5f) & (i <= f.last.x + 0.5f) & (j >= -0.5f) & (j <= f.last.y + 0.5f);
#endif
        weight = choose(counts, max(weight, (floats)(0.0f)), (floats)(0.0f));
        const floats value = sign * sample_lanes(&f, i, j, k);
        float lane_value[LANES], lane_weight[LANES], lane_t[LANES];
        store_lanes(value, lane_value);
        store_lanes(weight, lane_weight);
        store_lanes(t, lane_t);
        for (int lane = 0; lane < LANES; ++lane) {
            length_mm += lane_weight[lane];
            if (which == MEAN)
                best += lane_weight[lane] * lane_value[lane];
            else if (lane_weight[lane] > 0.0f && lane_value[lane] > best) {
                best = lane_value[lane];
                t_best = lane_t[lane];
            }
        }
        n += LANES;
    }
    if (!(stage & LAST_SLAB)) {
        states[2 * place] = (float4)(best, t_best, length_mm, 0.0f);
        return;
    }
    const int missed = !(length_mm > 0.0f);
    values[place] = missed ? NAN : which == MEAN ? best / length_mm : sign * best;
    depths[place] = missed || which == MEAN ? NAN : t_best + r.offset;
}
