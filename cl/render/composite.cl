/* Volume rendering: colours and opacities of a transfer function, blended from front to back along the rays.
 *
 * References: Levoy 1988, "Display of surfaces from volume data" (shading, opacity by gradient); Max 1995, "Optical
 * models for direct volume rendering" (opacity of a segment).  Empty space is leapt over with a map of Chebyshev
 * distances (Cohen and Sheffer 1994, "Proximity clouds").
 *
 * A CPU takes LANES samples along one ray at a time: they share bricks, pages and cache lines, no ray waits for
 * another, and only samples that show are shaded, one after the other.
 *
 * -D UNEVEN        slices at places of their own
 * -D GRADIENT_OPACITY   opacity times a function of the gradient's magnitude */
#include "include/field.h"
#include "include/leap.h"
#include "include/phong.h"
#include "include/view.h"

#define BINS 4096 /* of the transfer function's table */
#define OPAQUE 0.99f /* nothing behind can be seen */
#define FIRST_SEEN (1.0f / 255.0f) /* opacity that makes a first hit */

/* Parameters  voxels   in   (slices, nj, ni)
 *             leaps    in   (bk, bj, bi) Chebyshev distance in bricks to what shows, 0: shows
 *             colors   in   (BINS) rgb of the transfer function; w: log2(1 - opacity) over one ray step
 *             opacities in  (BINS) over one ray step
 *             view     in   see include/view.h
 *             states   in/out  (height, width, 2) float4: premultiplied rgba; t of the first hit, sum of w t, -, -
 *             image    out  (height, width) rgba
 *             depths   out  (height, width, 2) first hit and expected depth, mm; NaN where nothing is hit
 *             last_place    indices of the volume's last voxel centres
 *             ni nj    of the buffer; first_k end_k: slices in the buffer; slab_low slab_high: samples with
 *                      slab_low <= k < slab_high are this slab's
 *             bins_low bins_scale  nearest node to a value v: (v - bins_low) * bins_scale + 0.5
 *             jitter   samples at random places of their segments
 *             stage    bit 0: first slab, bit 1: last slab
 * Launch      global = tiles * 64 rounded up by the host, any local
 * Guarantees  every pixel of image and depths is written with the last slab */
__kernel void composite_rays(
    __global const VOXEL *restrict voxels, __global const uchar *restrict leaps,
    __global const float4 *restrict colors, __global const float *restrict opacities,
    __global const float4 *restrict view, __global float4 *restrict states, __global uchar4 *restrict image,
    __global float2 *restrict depths, const float4 last_place, const int ni, const int nj, const int first_k,
    const int end_k, const float slab_low, const float slab_high, const int bi, const int bj, const int bk,
    const float bins_low, const float bins_scale, const uint width, const uint height, const uint planes,
    const int perspective, const int shaded, const int jitter, const int stage, const uint queues)
{
    const int2 pixel = find_pixel((uint)get_global_id(0), width, height, queues);
    if (pixel.x >= (int)width || pixel.y >= (int)height)
        return;
    const size_t place = (size_t)pixel.y * width + (size_t)pixel.x;
    field f;
    f.voxels = voxels;
    f.ni = ni;
    f.nj = nj;
    f.first_k = first_k;
    f.end_k = end_k;
    f.last = last_place;
    ray r;
    start_ray(view, pixel, planes, perspective, &r);

    float4 seen = (float4)(0.0f);
    float first_hit = -1.0f, sum = 0.0f;
    if (!(stage & 1)) {
        seen = states[2 * place];
        first_hit = states[2 * place + 1].x;
        sum = states[2 * place + 1].y;
    }
    const float ray_step = view[VIEW_NEAR].y;
    const float phase = 0.5f;
    const float span = r.t_out - r.t_in;
    const int segments = span > 0.0f ? (int)ceil(span / ray_step) : 0;
    int n = segments > 0 ? max((int)floor((r.focus_in - r.t_in) / ray_step - phase), 0) : 0;
    const int end = segments > 0 ? min((int)ceil((r.focus_out - r.t_in) / ray_step - phase) + 1, segments) : 0;
    const float4 start = r.origin + (r.t_in + phase * ray_step) * r.step, stride = ray_step * r.step;
    const float rest = span - (float)(segments - 1) * ray_step; /* length of the last segment */
    const leap_map map = { leaps, bi, bj, bk };

    while (n < end && seen.w < OPAQUE) {
        const float4 from = start + (float)n * stride;
        const int free = count_free_steps(&map, from, stride);
        if (free > 0) {
            n += free;
            continue;
        }
        const floats number = (float)n + LANE_NUMBERS;
        const floats i = start.x + number * stride.x, j = start.y + number * stride.y, k = start.z + number * stride.z;
        const floats value = sample_lanes(&f, i, j, k);
        const ints bin = to_ints(clamp((value - bins_low) * bins_scale + 0.5f, (floats)(0.0f), (floats)(BINS - 1)));
        const floats opacity = (floats)(GATHER(opacities, bin));
        if (largest_lane(opacity) > 0.0f) {
            float lane_opacity[LANES];
            int lane_bin[LANES];
            store_lanes(opacity, lane_opacity);
            store_lanes(bin, lane_bin);
            for (int lane = 0; lane < LANES; ++lane) {
                float a = lane_opacity[lane];
                if (!(a > 0.0f) || n + lane >= end || seen.w >= OPAQUE)
                    continue;
                const float number_here = (float)(n + lane);
                float4 at = start + number_here * stride;
                float t = r.t_in + (number_here + phase) * ray_step;
                const float4 color = colors[lane_bin[lane]];
                if (n + lane == segments - 1) {
                    a = 1.0f - exp2(color.w * (rest / ray_step));
                    t = r.t_in + number_here * ray_step + phase * rest;
                }
                float3 rgb = color.xyz;
                if (shaded) {
                    float4 below, above;
                    const float share = find_differences(&f, at.xyz, &below, &above);
                    const float4 step = below + share * (above - below);
                    const float3 gradient = (float3)(
                        dot(view[VIEW_NORMAL_X], step), dot(view[VIEW_NORMAL_Y], step), dot(view[VIEW_NORMAL_Z], step));
                    rgb = shade(view, rgb, gradient, r.direction);
                }
                const float weight = (1.0f - seen.w) * a;
                seen.xyz += weight * rgb;
                seen.w += weight;
                sum += weight * t;
                if (first_hit < 0.0f && seen.w > FIRST_SEEN)
                    first_hit = t;
            }
        }
        n += LANES;
    }
    if (!(stage & 2)) {
        states[2 * place] = seen;
        states[2 * place + 1] = (float4)(first_hit, sum, 0.0f, 0.0f);
        return;
    }
    const float4 straight = seen.w > 0.0f ? (float4)(seen.xyz / seen.w, seen.w) : (float4)(0.0f);
    image[place] = convert_uchar4_sat_rte(255.0f * straight);
    depths[place]
        = first_hit < 0.0f ? (float2)(NAN) : (float2)(first_hit + r.offset, sum / seen.w + r.offset);
}
