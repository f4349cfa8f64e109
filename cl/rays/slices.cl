/* Slices of a volume in space: each drawn translucent at its own place, and blended from front to back.
 *
 * A ray crosses each slice plane once, so no marching is needed, and only the shown slices have to be on the device.
 * All rays cross the slices in the same order: by height for parallel rays, by distance from the camera's height for
 * rays from a camera.
 *
 * -D BETWEEN   only what lies between two depths of each pixel, see cl/rays/layers.cl */
#include "include/volume.h"
#include "rays/between.h"
#include "rays/ray_state.h"
#include "rays/view.h"

#define BINS 4096 /* of the table of colours */

/* Shorten a ray to what lies between two depths of its pixel.  Returns t from which on slices are left out. */
#ifdef BETWEEN
static inline float shorten_ray(
    ray *r, const size_t at_pixel, __global const float *nearest, __global const float *farthest)
{
    r->t_in = max(r->t_in, nearest[at_pixel] - r->offset);
    return farthest[at_pixel] - r->offset;
}
#else
static inline float shorten_ray(ray *r, const size_t at_pixel) { return INFINITY; }
#endif

/* Parameters  slices   in   (slices, nj, ni) all slices of the volume, or those that are shown
 *             places   in   (count) for each slice that is shown, in the order in which rays cross them: x, y: what i and
 *                           j are counted from there, in steps of a voxel; z: third field coordinate; w: its number in
 *                           `slices`
 *             colors   in   (BINS) rgb by value
 *             view     in   see rays/view.h
 *             states   in/out  (height, width, 2) float4: see rays/ray_state.h
 *             image    out  (height, width) rgba
 *             depths means  out  (height, width) first hit and expected depth, mm; NaN where nothing is hit
 *             background    rgb, and 1 where it fills what the rays leave
 *             ni nj    of a slice;  count: slices that are shown
 *             bins_low bins_scale  nearest node to a value v: (v - bins_low) * bins_scale + 0.5
 *             opacity  of a slice;  lowest: values below are transparent
 *             stage    FIRST_SLAB and LAST_SLAB, see rays/view.h
 *             with BETWEEN nearest, farthest  in  (height, width) mm along the ray: a slice at the farther end is left out
 * Launch      global = tiles * 64 rounded up by the host, any local
 * Guarantees  every pixel of image and depths is written with the last slices */
__kernel void overlay_slices(
    __global const VOXEL *restrict slices, __global const float4 *restrict places,
    __global const float4 *restrict colors, __global const float4 *restrict view,
    __global float4 *restrict states, __global uchar4 *restrict image, __global float *restrict depths, __global float *restrict means,
    const float4 background, const int ni, const int nj, const int count,
    const float bins_low, const float bins_scale, const float opacity, const float lowest, const uint width,
    const uint height, const uint planes, const int perspective, const int stage, const uint queues
    BETWEEN_PARAMETERS)
{
    const int2 pixel = find_pixel((uint)get_global_id(0), width, height, queues);
    if (pixel.x >= (int)width || pixel.y >= (int)height)
        return;
    const size_t at_pixel = (size_t)pixel.y * width + (size_t)pixel.x;
    ray r;
    start_ray(view, convert_float2(pixel), planes, perspective, &r);
    const float beyond = shorten_ray(&r, at_pixel BETWEEN_ARGUMENTS);

    ray_state seen = { (float4)(0.0f), NO_HIT, 0.0f, 0.0f };
    if (!(stage & FIRST_SLAB))
        load_state(states, at_pixel, &seen);
    const int crossed = r.t_out > r.t_in && fabs(r.step.z) > 1e-12f ? count : 0;
    for (int n = 0; n < crossed; ++n) {
        const float4 place = places[n];
        const int k = (int)place.w;
        const float t = (place.z - r.origin.z) / r.step.z;
        const float i = r.origin.x + t * r.step.x - place.x, j = r.origin.y + t * r.step.y - place.y;
        /* Half a voxel around the outermost centres belongs to them. */
        if (t < r.t_in || t > r.t_out || t >= beyond || i < -0.5f || j < -0.5f || i > (float)ni - 0.5f || j > (float)nj - 0.5f)
            continue;
        const float in_i = clamp(i, 0.0f, (float)(ni - 1)), in_j = clamp(j, 0.0f, (float)(nj - 1));
        const int low_i = (int)in_i, low_j = (int)in_j;
        const int high_i = min(low_i + 1, ni - 1), high_j = min(low_j + 1, nj - 1);
        const float part_i = in_i - (float)low_i, part_j = in_j - (float)low_j;
        const float near_low = (float)slices[voxel_index(low_i, low_j, k, ni, nj)];
        const float near_high = (float)slices[voxel_index(high_i, low_j, k, ni, nj)];
        const float far_low = (float)slices[voxel_index(low_i, high_j, k, ni, nj)];
        const float far_high = (float)slices[voxel_index(high_i, high_j, k, ni, nj)];
        const float near = near_low + part_i * (near_high - near_low);
        const float value = near + part_j * (far_low + part_i * (far_high - far_low) - near);
        if (!(value >= lowest))
            continue;
        const int bin = (int)clamp((value - bins_low) * bins_scale + 0.5f, 0.0f, (float)(BINS - 1));
        const float weight = (1.0f - seen.color.w) * opacity;
        seen.color.xyz += weight * colors[bin].xyz;
        seen.color.w += weight;
        seen.sum += weight * t;
        if (seen.first_hit == NO_HIT && seen.color.w > FIRST_SEEN)
            seen.first_hit = t;
    }
    store_state(&seen, r.offset, stage, at_pixel, states, image, depths, means, background);
}
