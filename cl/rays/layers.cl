/* Layers of a picture: what lies behind each other in a pixel, blended from front to back.
 *
 *      camera --->   volume     | layer 0 |    volume     | layer 1 |   volume  ...
 *                    nearest = -inf     its depth       its depth
 *
 * A layer has one depth a pixel: the nearest triangle behind the layer before (cl/rays/triangles.cl), or of a picture
 * that was made before, its still: whatever is nearer.  Between two layers a ray caster adds what a volume shows there
 * to the states of the rays, see -D BETWEEN in cl/rays/composite.cl and cl/rays/slices.cl.
 *
 * Passes
 *   1. clear_rays         nothing is seen yet
 *   for each layer
 *   2. begin_layer        no depth but that of the still, no number
 *      (triangles are drawn)
 *   3. show_still         the still, or nothing, where no triangle is nearer
 *      (triangles are shaded, and a volume is sampled up to the layer)
 *   4. blend_layer        the layer behind what the rays have seen
 *   5. count_open         pixels that may have a further layer
 *   6. finish_rays        the picture */
#include "rays/eye.h"
#include "rays/view.h"

#define FIRST_SEEN (1.0f / 255.0f) /* opacity that makes a first hit */
#define NO_HIT (-MAXFLOAT)
#define COUNTED 32 /* pixels that a work-item counts */

/* Parameters  states  out  (pixels, 2) float4: premultiplied rgba; t of the volume's first hit (below 0: none), sum of
 *                          its w t, -, -; t as in cl/rays/composite.cl
 *             marks   out  (pixels) float4: mm to the first hit, or NO_HIT; of the layers sum of w mm, and of w; -
 *             floor_keys, floor_numbers  out  (pixels) before everything
 * Launch      global = pixels rounded up by the host, any local */
__kernel void clear_rays(__global float4 *restrict states, __global float4 *restrict marks,
    __global uint *restrict floor_keys, __global uint *restrict floor_numbers, const uint pixels)
{
    const uint at = get_global_id(0);
    if (at >= pixels)
        return;
    states[2 * at] = (float4)(0.0f);
    states[2 * at + 1] = (float4)(NO_HIT, 0.0f, 0.0f, 0.0f);
    marks[at] = (float4)(NO_HIT, 0.0f, 0.0f, 0.0f);
    floor_keys[at] = 0;
    floor_numbers[at] = EMPTY;
}

/* Parameters  depths  out  (pixels) depth
 * Launch      global = pixels rounded up by the host, any local */
__kernel void fill_depths(__global float *restrict depths, const float depth, const uint pixels)
{
    if (get_global_id(0) < pixels)
        depths[get_global_id(0)] = depth;
}

/* Parameters  still_depths  in   (height, width) mm along the ray, NaN where nothing is; nothing is read without has_still
 *             view          in   see rays/eye.h
 *             floor_keys, floor_numbers  in  (height, width) of the layer before
 *             keys, numbers out  (height, width) key of the still where it lies behind the floor; EMPTY
 * Launch      global = width * height rounded up by the host, any local */
__kernel void begin_layer(__global const float *restrict still_depths, __global const float4 *restrict view,
    __global const uint *restrict floor_keys, __global const uint *restrict floor_numbers,
    __global uint *restrict keys, __global uint *restrict numbers, const int has_still, const int width,
    const int height)
{
    const uint at = get_global_id(0);
    if (at >= (uint)width * (uint)height)
        return;
    uint key = EMPTY;
    if (has_still && !isnan(still_depths[at])) {
        const float3 ray = find_ray(view, (int)(at % (uint)width), (int)(at / (uint)width));
        const uint own = key_of(still_depths[at] / sqrt(dot3(ray, ray)));
        /* The still comes after the triangles at its depth, and once. */
        const uint below = floor_keys[at];
        key = own > below || (own == below && floor_numbers[at] != EMPTY) ? own : EMPTY;
    }
    keys[at] = key;
    numbers[at] = EMPTY;
}

/* Parameters  still, still_depths  in  (pixels) rgba, not premultiplied, and mm; nothing is read without has_still
 *             numbers       in   (pixels) of the nearest triangle, EMPTY where none is before the still
 *             keys          in/out  (pixels) of the layer; EMPTY where the still is opaque: nothing is behind
 *             layer         out  (pixels) rgb and opacity; 0 where the layer has nothing
 *             layer_depths  out  (pixels) mm along the ray; infinite where the layer has nothing
 * Launch      global = pixels rounded up by the host, any local
 * Guarantees  every pixel of the layer is written; shade_triangles overwrites those with a triangle */
__kernel void show_still(__global const uchar4 *restrict still, __global const float *restrict still_depths,
    __global const uint *restrict numbers, __global uint *restrict keys, __global float4 *restrict layer,
    __global float *restrict layer_depths, const int has_still, const uint pixels)
{
    const uint at = get_global_id(0);
    if (at >= pixels)
        return;
    layer[at] = (float4)(0.0f);
    layer_depths[at] = INFINITY;
    if (!has_still || keys[at] == EMPTY || numbers[at] != EMPTY)
        return;
    const uchar4 seen = still[at];
    layer[at] = convert_float4(seen) / 255.0f;
    layer_depths[at] = still_depths[at];
    if (seen.w == 255)
        keys[at] = EMPTY;
}

/* Parameters  layer, layer_depths  in  (height, width) see show_still
 *             view    in      see rays/eye.h
 *             states  in/out  see clear_rays
 *             marks   in/out  see clear_rays
 *             near_mm depth from which the volume's t count, times the length of the ray
 * Launch      global = width * height rounded up by the host, any local */
__kernel void blend_layer(__global const float4 *restrict layer, __global const float *restrict layer_depths,
    __global const float4 *restrict view, __global float4 *restrict states, __global float4 *restrict marks,
    const float near_mm, const int width, const int height)
{
    const uint at = get_global_id(0);
    if (at >= (uint)width * (uint)height)
        return;
    const float4 own = layer[at];
    if (own.w <= 0.0f)
        return;
    float4 seen = states[2 * at], mark = marks[at];
    const float volume_hit = states[2 * at + 1].x, depth = layer_depths[at];
    if (mark.x == NO_HIT && volume_hit >= 0.0f) {
        const float3 ray = find_ray(view, (int)(at % (uint)width), (int)(at / (uint)width));
        mark.x = volume_hit + near_mm * sqrt(dot3(ray, ray));
    }
    const float weight = (1.0f - seen.w) * own.w;
    seen.xyz += weight * own.xyz;
    seen.w += weight;
    mark.y += weight * depth;
    mark.z += weight;
    if (mark.x == NO_HIT && seen.w > FIRST_SEEN)
        mark.x = depth;
    states[2 * at] = seen;
    marks[at] = mark;
}

/* Parameters  keys  in      (pixels) EMPTY where nothing can be behind the layer
 *             open  in/out  (1) pixels that may have a further layer
 * Launch      global = pixels / COUNTED rounded up by the host, any local */
__kernel void count_open(__global const uint *restrict keys, __global uint *open, const uint pixels)
{
    const uint first = (uint)get_global_id(0) * COUNTED;
    uint found = 0;
    for (uint at = first; at < min(first + COUNTED, pixels); ++at)
        found += keys[at] != EMPTY;
    if (found > 0)
        atomic_add(open, found);
}

/* Parameters  states, marks, view, near_mm  in  see blend_layer
 *             image    out  (height, width) rgba
 *             depths, means  out  (height, width) first hit and expected depth, mm along the ray; NaN where nothing is
 *             background    rgb, and 1 where it fills what the rays leave
 * Launch      global = width * height rounded up by the host, any local */
__kernel void finish_rays(__global const float4 *restrict states, __global const float4 *restrict marks,
    __global const float4 *restrict view, __global uchar4 *restrict image, __global float *restrict depths,
    __global float *restrict means, const float4 background, const float near_mm, const int width, const int height)
{
    const uint at = get_global_id(0);
    if (at >= (uint)width * (uint)height)
        return;
    const float4 seen = states[2 * at], volume = states[2 * at + 1], mark = marks[at];
    const float3 ray = find_ray(view, (int)(at % (uint)width), (int)(at / (uint)width));
    const float offset = near_mm * sqrt(dot3(ray, ray));
    const float first = mark.x != NO_HIT ? mark.x : volume.x >= 0.0f ? volume.x + offset : NAN;
    image[at] = finish_color(seen, background);
    depths[at] = first;
    means[at] = isnan(first) ? NAN : (mark.y + volume.y + offset * (seen.w - mark.z)) / seen.w;
}
