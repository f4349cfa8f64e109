/* Volume rendering: colours and opacities of a transfer function, blended from front to back along the rays.
 *
 * References: Levoy 1988, "Display of surfaces from volume data" (shading, opacity by gradient); Max 1995, "Optical
 * models for direct volume rendering" (opacity of a segment).  Empty space is leapt over with a map of Chebyshev
 * distances (Cohen and Sheffer 1994, "Proximity clouds").
 *
 * A work-item has LANES neighbouring rays.  They leap together, as a leap is a chain of dependent steps that would
 * leave a CPU waiting; where something shows, each goes on alone and takes LANES samples along its way at a time: no
 * ray then waits for another, and only samples that show are shaded.
 *
 * -D UNEVEN   slices at places of their own */
#include "include/field.h"
#include "include/jitter.h"
#include "include/leap.h"
#include "include/phong.h"
#include "include/view.h"

#define NODES 4096 /* of the transfer function's table */
#define OPAQUE 0.99f /* nothing behind can be seen */
#define FIRST_SEEN (1.0f / 255.0f) /* opacity that makes a first hit */

/* What a ray has seen so far. */
typedef struct {
    float4 color; /* premultiplied */
    float first_hit, sum; /* t of the first hit, negative before; sum of t, weighted */
} sight;

/* A ray in samples: sample n lies at start + n * stride, at t = t_in + (n + phase) * ray_step.  The last segment is what
 * is left of the way: its length is `rest`, and its sample has the number `last`, a fraction. */
typedef struct {
    float4 start, stride;
    float3 direction;
    float t_in, phase, offset, rest, last;
    int end, segments;
} sampled_ray;

/* Transfer function and light. */
typedef struct {
    __global const float4 *colors; /* rgb; w: log2(1 - opacity) over one ray step */
    __global const float *opacities; /* over one ray step */
    __global const float *highlights;
    __global const float4 *view;
    float low, scale; /* nearest node to a value v: (v - low) * scale + 0.5 */
    float ray_step;
    float slab_low, slab_high; /* samples with slab_low <= k < slab_high are this slab's */
    int shaded;
} looks;

static inline void add_sample(
    const field *f, const looks *look, const sampled_ray *r, const int n, const int node, const float opacity, sight *seen)
{
    const float4 color = look->colors[node];
    const float number = min((float)n, r->last), t = r->t_in + (number + r->phase) * look->ray_step;
    const float4 at = r->start + number * r->stride;
    const float a = n == r->segments - 1 ? 1.0f - exp2(color.w * (r->rest / look->ray_step)) : opacity;
    float3 rgb = color.xyz;
    if (look->shaded) {
        float4 below, above;
        const float share = find_differences(f, at.xyz, &below, &above);
        const float4 step = below + share * (above - below);
        const float3 gradient = (float3)(dot(look->view[VIEW_NORMAL_X], step), dot(look->view[VIEW_NORMAL_Y], step),
            dot(look->view[VIEW_NORMAL_Z], step));
        rgb = shade(look->view, look->highlights, rgb, gradient, r->direction);
    }
    const float weight = (1.0f - seen->color.w) * a;
    seen->color.xyz += weight * rgb;
    seen->color.w += weight;
    seen->sum += weight * t;
    if (seen->first_hit < 0.0f && seen->color.w > FIRST_SEEN)
        seen->first_hit = t;
}

/* Follow a ray from sample n until its brick is empty, it ends or nothing behind can be seen. */
static inline int follow_ray(
    const field *f, const leap_map *map, const looks *look, const sampled_ray *r, int n, sight *seen)
{
    const float4 start = r->start, stride = r->stride;
    do {
        const floats number = min((float)n + LANE_NUMBERS, (floats)(r->last));
        const floats k = start.z + number * stride.z;
        const floats value = sample_lanes(f, start.x + number * stride.x, start.y + number * stride.y, k);
        const floats place = (value - look->low) * look->scale + 0.5f;
        const ints node = to_ints(min(max(place, (floats)(0.0f)), (floats)(NODES - 1)));
        const floats found = (floats)(GATHER(look->opacities, node));
        const floats opacity = choose((k >= look->slab_low) & (k < look->slab_high), found, (floats)(0.0f));
        if (ANY_LANE(opacity > 0.0f)) {
            float lane_opacity[LANES];
            int lane_node[LANES];
            store_lanes(opacity, lane_opacity);
            store_lanes(node, lane_node);
            for (int lane = 0; lane < LANES && n + lane < r->end; ++lane)
                if (lane_opacity[lane] > 0.0f) {
                    add_sample(f, look, r, n + lane, lane_node[lane], lane_opacity[lane], seen);
                    if (seen->color.w >= OPAQUE)
                        return r->end;
                }
        }
        n += LANES;
    } while (n < r->end
             && is_shown(map, start.x + (float)n * stride.x, start.y + (float)n * stride.y, start.z + (float)n * stride.z - (float)f->first_k));
    return n;
}

/* Parameters  voxels   in   (slices, nj, ni)
 *             leaps    in   (bk, bj, bi) Chebyshev distance in bricks to what shows, 0: shows
 *             colors   in   (NODES) see looks
 *             opacities in  (NODES)
 *             highlights in (HIGHLIGHTS) see include/phong.h
 *             view     in   see include/view.h
 *             states   in/out  (height, width, 2) float4: premultiplied rgba; t of the first hit, sum of w t, -, -
 *             image    out  (height, width) rgba
 *             depths means  out  (height, width) first hit and expected depth, mm; NaN where nothing is hit
 *             background    rgb, and 1 where it fills what the rays leave
 *             last_place    indices of the volume's last voxel centres
 *             ni nj    of the buffer; first_k end_k: slices in the buffer; slab_low slab_high: samples with
 *                      slab_low <= k < slab_high are this slab's
 *             bi bj bk bricks
 *             low scale     nearest node to a value
 *             jitter   samples at random places of their segments
 *             stage    FIRST_SLAB and LAST_SLAB, see include/view.h
 * Launch      global = tiles * 64 / LANES rounded up by the host, any local
 * Guarantees  every pixel of image and depths is written with the last slab */
__kernel void composite_rays(
    __global const VOXEL *restrict voxels, __global const uchar *restrict leaps,
    __global const float4 *restrict colors, __global const float *restrict opacities,
    __global const float *restrict highlights, __global const float4 *restrict view, __global float4 *restrict states,
    __global uchar4 *restrict image, __global float *restrict depths, __global float *restrict means,
    const float4 background, const float4 last_place, const int ni, const int nj, const int first_k, const int end_k,
    const float slab_low, const float slab_high, const int bi, const int bj, const int bk, const float low,
    const float scale, const uint width, const uint height, const uint planes, const int perspective, const int shaded,
    const int jitter, const int stage, const uint queues)
{
    const uint first_pixel = (uint)get_global_id(0) * LANES;
    const field f = { voxels, ni, nj, first_k, end_k, last_place };
    const leap_map map = { leaps, bi, bj, bk };
    looks look = { colors, opacities, highlights, view, low, scale, view[VIEW_NEAR].y, slab_low, slab_high,
        shaded };

    sampled_ray rays[LANES];
    float starts[6][LANES], numbers[LANES], ends[LANES];
    sight sights[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const int2 pixel = find_pixel(first_pixel + lane, width, height, queues);
        sampled_ray *r = rays + lane;
        r->end = 0;
        numbers[lane] = 0.0f;
        r->start = r->stride = (float4)(0.0f);
        sights[lane].color = (float4)(0.0f);
        sights[lane].first_hit = -1.0f;
        sights[lane].sum = 0.0f;
        if (pixel.x < (int)width && pixel.y < (int)height) {
            ray way;
            start_ray(view, pixel, planes, perspective, &way);
            const float phase = jitter ? jitter_pixel((uint)pixel.x, (uint)pixel.y) : 0.5f;
            r->phase = phase;
            const float span = way.t_out - way.t_in;
            r->segments = span > 0.0f ? (int)ceil(span / look.ray_step) : 0;
            r->rest = span - (float)(r->segments - 1) * look.ray_step;
            r->last = (float)(r->segments - 1) - phase * (1.0f - r->rest / look.ray_step);
            r->t_in = way.t_in;
            r->offset = way.offset;
            r->direction = way.direction;
            r->stride = look.ray_step * way.step;
            r->start = way.origin + (way.t_in + phase * look.ray_step) * way.step;
            if (!(stage & FIRST_SLAB)) {
                const size_t place = (size_t)pixel.y * width + (size_t)pixel.x;
                sights[lane].color = states[2 * place];
                sights[lane].first_hit = states[2 * place + 1].x;
                sights[lane].sum = states[2 * place + 1].y;
            }
            if (r->segments > 0 && sights[lane].color.w < OPAQUE && way.focus_out > way.focus_in) {
                const float first = (way.focus_in - way.t_in) / look.ray_step - phase;
                const float past = (way.focus_out - way.t_in) / look.ray_step - phase;
                numbers[lane] = max(floor(first), 0.0f);
                r->end = min((int)ceil(past) + 1, r->segments);
            }
        }
        starts[0][lane] = r->start.x;
        starts[1][lane] = r->start.y;
        starts[2][lane] = r->start.z;
        starts[3][lane] = r->stride.x;
        starts[4][lane] = r->stride.y;
        starts[5][lane] = r->stride.z;
        ends[lane] = (float)r->end;
    }
    ray_lanes together;
    together.start_i = load_lanes(starts[0]);
    together.start_j = load_lanes(starts[1]);
    together.start_k = load_lanes(starts[2]) - (float)first_k;
    together.stride_i = load_lanes(starts[3]);
    together.stride_j = load_lanes(starts[4]);
    together.stride_k = load_lanes(starts[5]);
    together.pace_i = find_pace(together.stride_i);
    together.pace_j = find_pace(together.stride_j);
    together.pace_k = find_pace(together.stride_k);
    const floats end = load_lanes(ends);
    floats n = load_lanes(numbers);
    while (ANY_LANE(n < end)) {
        for (;;) {
            const floats free = count_free_steps(&map, &together, n);
            const ints leaping = (free > 0.0f) & (n < end);
            if (!ANY_LANE(leaping))
                break;
            n = choose(leaping, n + free, n);
        }
        store_lanes(n, numbers);
        for (int lane = 0; lane < LANES; ++lane)
            if (numbers[lane] < ends[lane])
                numbers[lane] = (float)follow_ray(&f, &map, &look, rays + lane, (int)numbers[lane], sights + lane);
        n = load_lanes(numbers);
    }
    for (int lane = 0; lane < LANES; ++lane) {
        const int2 pixel = find_pixel(first_pixel + lane, width, height, queues);
        if (pixel.x >= (int)width || pixel.y >= (int)height)
            continue;
        const size_t place = (size_t)pixel.y * width + (size_t)pixel.x;
        const sight *seen = sights + lane;
        const float4 color = seen->color;
        if (!(stage & LAST_SLAB)) {
            states[2 * place] = color;
            states[2 * place + 1] = (float4)(seen->first_hit, seen->sum, 0.0f, 0.0f);
            continue;
        }
        image[place] = finish_color(color, background);
        depths[place] = seen->first_hit < 0.0f ? NAN : seen->first_hit + rays[lane].offset;
        means[place] = seen->first_hit < 0.0f ? NAN : seen->sum / color.w + rays[lane].offset;
    }
}
